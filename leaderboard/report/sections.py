"""One section of the page: a task at one horizon, with its tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from qrlsuite.experiment.task import RankingSection
from qrlsuite.leaderboard import tables
from qrlsuite.leaderboard.absent import absent
from qrlsuite.leaderboard.board import Row, Section, ranking_of
from qrlsuite.leaderboard.report import ladder, timed
from qrlsuite.leaderboard.report.encode import clean
from qrlsuite.leaderboard.report.entries import EntryView
from qrlsuite.leaderboard.report.judge import Judgement, judge
from qrlsuite.leaderboard.report.surfaces import CellView, bar_grid, surface, symbol
from qrlsuite.leaderboard.report.words import listed
from qrlsuite.results.text import counted, steps_text
from qrlsuite.statistics import Evidence, Grid, Outcome

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
class SectionView:
    """Everything that the template needs; see the template for the meaning of each."""

    id: str
    number: int
    section: Section
    judgement: Judgement
    horizon: str
    lead: str
    rows: tuple[RowView, ...]
    protocol_seeds: int
    missing: str
    first_alone: str
    tuning: str
    flattered: str
    """Entries whose settings were chosen on the protocol's seeds."""
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
    data: dict[str, Any]
    times: timed.TimesView

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
    judgement = judge(section)
    ranking = ranking_of([row.entry for row in section.rows])
    rows = tuple(
        _row(place, row, entries[id(row.entry)], judgement) for place, row in enumerate(section.rows)
    )
    grid = judgement.grid
    bars = bar_grid(ranking)
    bar_evidence = [Evidence(curves, bars, curves.n_runs) for curves in judgement.entries]
    names = [f"{float(value):g}" for value in grid.levels]
    deltas = tuple(f"{float(delta):g}" for delta in grid.deltas)
    missing = sorted({clean(name) for row in section.rows for name in absent(row.entry)})
    surfaces = tuple(surface(judgement.own(place), ranking) for place in range(len(rows)))
    return SectionView(
        id=f"board-{number}",
        number=number,
        section=section,
        judgement=judgement,
        horizon=steps_text(section.horizon),
        lead=_lead(rows),
        rows=rows,
        protocol_seeds=section.rows[0].entry.task_file.protocol.seeds,
        missing=listed(missing) if missing else "",
        first_alone=", ".join(row.entry.label for row in rows if row.row.entry.first_network_alone),
        tuning=clean("; ".join(tables.unequal_tuning(section))),
        flattered=", ".join(row.entry.label for row in rows if row.row.entry.on_protocol_seeds),
        ladder=ladder.draw(judgement.beats(), [row.depth for row in section.rows]),
        matrix=tuple(
            tuple(_matrix_cell(judgement, i, j) for j in range(len(rows))) for i in range(len(rows))
        ),
        surfaces=surfaces,
        bars=tuple(
            tuple(cell for line in surface(evidence, ranking) for cell in line) for evidence in bar_evidence
        ),
        bar_names=tuple(
            f"{symbol(bars)} {float(value):g}, δ {float(delta):g}"
            for value in bars.levels
            for delta in bars.deltas
        ),
        thresholds=tuple(names),
        threshold_name="epsilon" if grid.epsilons else "return",
        threshold_symbol=symbol(grid),
        framed=any(cell.reference for line in surfaces[0] for cell in line),
        deltas=deltas,
        data=_data(section, judgement, rows, bars, bar_evidence, ranking),
        times=timed.view(section.times, entries),
    )


def _row(place: int, row: Row, entry: EntryView, judgement: Judgement) -> RowView:
    reference, horizon = row.reference, judgement.horizon
    beats = judgement.beats()
    return RowView(
        place=place,
        entry=entry,
        row=row,
        steps=("≥ " if reference.unsettled else "") + steps_text(reference.steps),
        interval=f"{steps_text(reference.low)} to {steps_text(reference.high)}",
        low=100 * reference.low / horizon,
        point=100 * reference.steps / horizon,
        high=100 * reference.high / horizon,
        wins=int(beats[place].sum()),
        losses=int(beats[:, place].sum()),
        reason=row.reason,
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
        if rest > 1:
            return f"{best.entry.label} outperforms all {rest} others."
        win = next(row.row.rests_on for row in ranked if row is not best)
        cells = f", in {win.text} cells that are not at the cap for both" if win is not None else ""
        return f"{best.entry.label} outperforms the other entry{cells}."
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
        "levelName": symbol(judgement.grid),
        "levels": [f"{float(value):g}" for value in judgement.grid.levels],
        "deltas": [f"{float(delta):g}" for delta in judgement.grid.deltas],
        "pairs": [[pair.first, pair.second, pair.n_runs, pair.cells] for pair in judgement.pairs],
        "evidence": {
            f"{place}/{n_runs}": _numbers(evidence)
            for (place, n_runs), evidence in judgement.evidence.items()
        },
        "bars": {
            "levels": [f"{symbol(bars)} = {float(value):g}" for value in bars.levels],
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
