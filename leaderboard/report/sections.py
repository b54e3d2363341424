"""One section of the page: a task at one horizon, with all that its tables and figures show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrlsuite.leaderboard.board import Row, Section, undecided_reason
from qrlsuite.leaderboard.report import ladder
from qrlsuite.leaderboard.report.entries import EntryView
from qrlsuite.leaderboard.report.judge import Judgement, judge
from qrlsuite.leaderboard.report.words import counted, in_unit, listed, short
from qrlsuite.statistics import Evidence, Grid, Outcome, at_cap, unsettled, unsettled_at
from qrlsuite.task import RankingSection

LEVELS = 10
"""Shades of a surface."""
BARS = ((0.2, 0.15, 0.1), (0.5, 0.75))
"""The paper's cells for bars: epsilons and deltas (its figure 6)."""
SIGNS = {Outcome.OUTPERFORMS: "win", Outcome.OUTPERFORMED: "loss", Outcome.TRADE_OFF: "both"}


@dataclass(frozen=True)
class RowView:
    """A line of the leaderboard; `low`, `point` and `high` are shares of the horizon in percent."""

    place: int
    entry: EntryView
    row: Row
    steps: str
    interval: str
    low: float
    point: float
    high: float
    wins: int
    losses: int
    reason: str


@dataclass(frozen=True)
class CellView:
    """A cell of a surface: its text, its shade and what a pointer shows."""

    text: str
    level: int
    capped: bool
    unsettled: bool
    reference: bool
    title: str


@dataclass(frozen=True)
class SectionView:
    """Everything that the template needs; see the template for the meaning of each."""

    id: str
    number: int
    section: Section
    judgement: Judgement
    horizon: str
    lead: str
    rows: tuple[RowView, ...]
    wanted: int
    ladder: ladder.Ladder
    matrix: tuple[tuple[tuple[str, str, str], ...], ...]
    surfaces: tuple[tuple[tuple[CellView, ...], ...], ...]
    bars: tuple[tuple[CellView, ...], ...]
    bar_names: tuple[str, ...]
    thresholds: tuple[str, ...]
    threshold_name: str
    threshold_symbol: str
    framed: bool
    deltas: tuple[str, ...]
    unit: str
    data: dict[str, Any]

    @property
    def others(self) -> int:
        """Number of other entries that each one may outperform."""
        return len(self.rows) - 1

    @property
    def quantum(self) -> bool:
        """Whether any entry has quantum parameters."""
        return any(row.entry.quantum for row in self.rows)


def view(section: Section, number: int, entries: dict[int, EntryView]) -> SectionView:
    """Return a section of the page.

    Parameters
    ----------
    entries:
        The page's entries by the identity of their curves.
    """
    judgement = judge([row.entry for row in section.rows], section.horizon)
    ranking = section.rows[0].entry.task_file.ranking
    rows = tuple(
        _row(place, row, entries[id(row.entry)], judgement) for place, row in enumerate(section.rows)
    )
    unit = 1000 if section.horizon >= 20_000 else 1
    grid = judgement.grid
    bars = _bar_grid(ranking)
    bar_evidence = [Evidence(curves, bars, curves.n_runs) for curves in judgement.entries]
    names = [f"{float(value):g}" for value in grid.epsilons or grid.thresholds]
    deltas = tuple(f"{float(delta):g}" for delta in grid.deltas)
    surfaces = tuple(_surface(judgement.own(place), ranking, unit) for place in range(len(rows)))
    return SectionView(
        id=f"board-{number}",
        number=number,
        section=section,
        judgement=judgement,
        horizon=short(section.horizon),
        lead=_lead(rows),
        rows=rows,
        wanted=section.rows[0].entry.task_file.protocol.seeds,
        ladder=ladder.draw(judgement.beats(), [row.tier for row in section.rows]),
        matrix=tuple(
            tuple(_matrix_cell(judgement, i, j) for j in range(len(rows))) for i in range(len(rows))
        ),
        surfaces=surfaces,
        bars=tuple(
            tuple(cell for line in _surface(evidence, ranking, unit) for cell in line)
            for evidence in bar_evidence
        ),
        bar_names=tuple(
            f"{_symbol(bars)} {float(value):g}, δ {float(delta):g}"
            for value in bars.epsilons or bars.thresholds
            for delta in bars.deltas
        ),
        thresholds=tuple(names),
        threshold_name="epsilon" if grid.epsilons else "return",
        threshold_symbol=_symbol(grid),
        framed=any(cell.reference for line in surfaces[0] for cell in line),
        deltas=deltas,
        unit="thousands of environment steps" if unit == 1000 else "environment steps",
        data=_data(section, judgement, rows, bars, bar_evidence, ranking),
    )


def _row(place: int, row: Row, entry: EntryView, judgement: Judgement) -> RowView:
    reference, horizon = row.reference, judgement.horizon
    beats = judgement.beats()
    return RowView(
        place=place,
        entry=entry,
        row=row,
        steps=("≥ " if reference.unsettled else "") + short(reference.steps),
        interval=f"{short(reference.low)} to {short(reference.high)}",
        low=100 * reference.low / horizon,
        point=100 * reference.steps / horizon,
        high=100 * reference.high / horizon,
        wins=int(beats[place].sum()),
        losses=int(beats[:, place].sum()),
        reason="" if row.tier is not None else undecided_reason(row),
    )


def _lead(rows: Sequence[RowView]) -> str:
    """Say in one sentence who is in front."""
    ranked = [row for row in rows if row.row.tier is not None]
    if not ranked:
        return "No pair is decided: " + rows[0].reason.partition(": ")[2] + "."
    first = [row for row in ranked if row.row.tier == 1]
    if len(ranked) == len(first):
        return f"No entry of {len(ranked)} stands above the others: nobody is ranked before anybody."
    if len(first) > 1:
        names = listed([row.entry.label for row in first]) if len(first) <= 4 else f"{len(first)} entries"
        return f"{names} share the first tier."
    best = first[0]
    rest = len(ranked) - 1
    if best.wins == rest:
        return f"{best.entry.label} outperforms " + (
            "the other entry." if rest == 1 else f"all {rest} others."
        )
    return f"{best.entry.label} stands in the first tier and outperforms {best.wins} of {rest} others."


def _matrix_cell(judgement: Judgement, row: int, column: int) -> tuple[str, str, str]:
    """Return the text, the style and the words of a cell of the matrix of pairs."""
    if row == column:
        return "", "self", ""
    pair = judgement.pair(row, column)
    outcome, (wins, losses) = pair.outcome(row), pair.counts(row)
    texts = {
        Outcome.OUTPERFORMS: f"+{wins}",
        Outcome.OUTPERFORMED: f"−{losses}",
        Outcome.TRADE_OFF: f"+{wins} −{losses}",
        Outcome.UNDECIDED: "?",
    }
    return texts.get(outcome, "·"), SIGNS.get(outcome, "tie"), pair.words(row)


def _surface(evidence: Evidence, ranking: RankingSection, unit: int) -> tuple[tuple[CellView, ...], ...]:
    """Return E lines of D cells: S_hat of an entry at all its runs."""
    grid, horizon = evidence.grid, evidence.entry.horizon
    point, interval = evidence.point, evidence.interval()
    capped = at_cap(interval, horizon)
    open_end = _unsettled(evidence)
    wanted = ranking.reference.epsilon if grid.epsilons else ranking.reference.threshold
    lines = []
    for i, value in enumerate(grid.epsilons or grid.thresholds):
        cells = []
        for j, delta in enumerate(grid.deltas):
            sign = "≥ " if open_end[i, j] else ""
            low, high = (short(float(v)) for v in interval[i, j])
            mark = ", at cap" if capped[i, j] else ""
            share = float(point[i, j]) / horizon
            cells.append(
                CellView(
                    text=in_unit(float(point[i, j]), unit),
                    level=min(LEVELS - 1, int(LEVELS * share)),
                    capped=bool(capped[i, j]),
                    unsettled=bool(open_end[i, j]),
                    reference=value == wanted and float(delta) == ranking.reference.delta,
                    title=f"{sign}{short(float(point[i, j]))} ({low} to {high}{mark})",
                )
            )
        lines.append(tuple(cells))
    return tuple(lines)


def _unsettled(evidence: Evidence) -> np.ndarray[Any, np.dtype[np.bool_]]:
    grid, values = evidence.grid, evidence.entry.values
    if grid.epsilons is not None:
        return unsettled(values, grid.epsilons, [float(d) for d in grid.deltas])
    return unsettled_at(values, grid.thresholds, [float(d) for d in grid.deltas])


def _bar_grid(ranking: RankingSection) -> Grid:
    """Return the cells of the bars: the paper's where the task's grid has its epsilons, else like them."""
    levels = ranking.epsilons or ranking.thresholds or []
    if ranking.epsilons and set(BARS[0]) <= set(ranking.epsilons):
        return Grid.relative(BARS[0], BARS[1])
    chosen = sorted({levels[i] for i in (0, len(levels) // 2, -1)}, reverse=ranking.epsilons is not None)
    make = Grid.relative if ranking.epsilons else Grid.absolute
    return make(chosen, BARS[1])


def _symbol(grid: Grid) -> str:
    return "ε" if grid.epsilons else "V*"


def _data(
    section: Section,
    judgement: Judgement,
    rows: Sequence[RowView],
    bars: Grid,
    bar_evidence: Sequence[Evidence],
    ranking: RankingSection,
) -> dict[str, Any]:
    """Return what the page's scripts need of a section."""
    reference = ranking.reference
    level = 1 - reference.epsilon if reference.epsilon is not None else reference.threshold
    relative = section.rows[0].entry.task_file.score.source == "info"
    return {
        "horizon": section.horizon,
        "entries": [row.entry.index for row in rows],
        "level": level,
        "score": "validation score (received / optimal)" if relative else "validation score",
        "levelName": _symbol(judgement.grid),
        "levels": [f"{float(value):g}" for value in judgement.grid.epsilons or judgement.grid.thresholds],
        "deltas": [f"{float(delta):g}" for delta in judgement.grid.deltas],
        "pairs": [[pair.first, pair.second, pair.n_runs, pair.cells] for pair in judgement.pairs],
        "evidence": {
            f"{place}/{n_runs}": _numbers(evidence)
            for (place, n_runs), evidence in judgement.evidence.items()
        },
        "bars": {
            "levels": [f"{_symbol(bars)} = {float(value):g}" for value in bars.epsilons or bars.thresholds],
            "deltas": [f"δ = {float(delta):g}" for delta in bars.deltas],
            "entries": [_numbers(evidence) for evidence in bar_evidence],
        },
    }


def _numbers(evidence: Evidence) -> dict[str, list[int]]:
    """Return S_hat and its interval in whole steps, cell by cell."""
    interval = evidence.interval()
    return {
        "s": [round(float(v)) for v in evidence.point.ravel()],
        "l": [round(float(v)) for v in interval[..., 0].ravel()],
        "h": [round(float(v)) for v in interval[..., 1].ravel()],
    }


def headline(sections: Sequence[SectionView], entries: Sequence[EntryView]) -> str:
    """Say how much the page rests on."""
    tasks = {view.section.task for view in sections}
    runs = sum(len(entry.curves.seeds) for entry in entries)
    hours = sum(entry.curves.hours for entry in entries)
    spent = f"{hours:,.0f}" if hours >= 10 else f"{hours:.2g}"
    return (
        f"{counted(len(entries), 'entry')} on {counted(len(tasks), 'task')}, "
        f"{counted(runs, 'run')}, {spent} core-hours"
    )
