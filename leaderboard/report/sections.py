"""One section of the page: a task at one horizon, with its tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrlsuite.columns import Column
from qrlsuite.experiment.task import RankingSection
from qrlsuite.leaderboard.boards import columns, scores, tables
from qrlsuite.leaderboard.boards.pair import pair_on
from qrlsuite.leaderboard.boards.ranked import ranking_of, unranked_since
from qrlsuite.leaderboard.boards.steps import Section
from qrlsuite.leaderboard.boards.times import TimeRanking
from qrlsuite.leaderboard.report import ladder
from qrlsuite.leaderboard.report.cite import Citation, cite
from qrlsuite.leaderboard.report.encode import clean
from qrlsuite.leaderboard.report.entries import EntryView, changed_options, paint
from qrlsuite.leaderboard.report.judge import Judgement, judge
from qrlsuite.leaderboard.report.rows import RowView
from qrlsuite.leaderboard.report.surfaces import CellView, bar_grid, surface, symbol
from qrlsuite.leaderboard.report.winners import Winners, winners
from qrlsuite.results.text import counted, hours_text, p_text, steps_text
from qrlsuite.statistics import Direction, Evidence, Outcome

SIGNS = {Outcome.OUTPERFORMS: "win", Outcome.OUTPERFORMED: "loss", Outcome.TRADE_OFF: "both"}


@dataclass(frozen=True)
class SectionView:
    """Everything that the template needs; see the template for the meaning of each."""

    id: str
    number: int
    section: Section
    judgement: Judgement
    horizon: str
    changed: str
    """Options of the environment in which the task differs from the registered one."""
    algorithm: str
    """The algorithm of all entries; empty if they differ."""
    lead: str
    answers: tuple[str, ...]
    """The board's verdicts, in sentences, on the pairs that a reader asks for first."""
    winners: Winners
    citation: Citation
    picked: tuple[int, ...]
    """Places of the entries whose learning curves are drawn at first."""
    sentences: tuple[tuple[int, int, str], ...]
    """Two places, and the verdict of the board on them."""
    rows: tuple[RowView, ...]
    columns: tuple[Column[Any], ...]
    notes: tuple[str, ...]
    tier_columns: tuple[Column[Any], ...]
    tier_notes: tuple[str, ...]
    ladder: ladder.Ladder
    matrix: tuple[tuple[tuple[str, str], ...], ...]
    surfaces: tuple[tuple[tuple[CellView, ...], ...], ...]
    bars: tuple[tuple[CellView, ...], ...]
    bar_names: tuple[str, ...]
    thresholds: tuple[str, ...]
    threshold_name: str
    threshold_symbol: str
    framed: bool
    deltas: tuple[str, ...]
    data: dict[str, Any]
    decisions: tuple[tuple[tuple[str, str], ...], ...]


def view(section: Section, number: int, entries: dict[int, EntryView]) -> SectionView:
    """Return a section of the page.

    Parameters
    ----------
    entries:
        The page's entries by the identity of their curves.
    """
    tier_columns = tuple(each for each in columns.tiers(section) if each.shown)
    judgement = judge(section)
    ranking = ranking_of([row.entry for row in section.rows])
    algorithms = {row.entry.algorithm for row in section.rows}
    algorithm = clean(algorithms.pop()) if len(algorithms) == 1 else ""
    shown = [entries[id(row.entry)] for row in section.rows]
    names = [entry.label.removeprefix(f"{algorithm} ") for entry in shown]
    if len(set(names)) < len(names):
        names = [entry.label for entry in shown]
    rows = tuple(
        RowView(place, entry, name, row)
        for place, (row, entry, name) in enumerate(zip(section.rows, shown, names, strict=True))
    )
    order = np.array(section.times.order)
    grid = judgement.grid
    bars = bar_grid(ranking)
    bar_evidence = [Evidence(curves, bars, curves.n_runs) for curves in judgement.entries]
    levels = [f"{float(value):g}" for value in grid.levels]
    deltas = tuple(f"{float(delta):g}" for delta in grid.deltas)
    surfaces = tuple(surface(judgement.own(place), ranking) for place in range(len(rows)))
    winning = winners(rows, section.times)
    asked, finals = winning.asked(rows), scores.finals(section)

    def verdict(one: RowView, other: RowView, kinds: bool = False) -> str:
        """Return the board's verdict on two rows in a sentence; `kinds` says which is classical and which quantum."""
        kinds = kinds and {one.kind, other.kind} == {"classical", "quantum"}
        first, second = (f"{row.kind} {row.name}" if kinds else row.name for row in (one, other))
        said = pair_on(section.times, finals, one.time, other.time, grid, (first, second)).sentence
        return f"{said}.".replace("p = ", "p\u00a0=\u00a0").replace("p < ", "p\u00a0<\u00a0")

    picked = sorted({row.place for pair in asked for row in pair} or {row.place for row in rows[:3]})
    paint(rows[place].entry for place in picked)
    return SectionView(
        id=f"board-{number}",
        number=number,
        section=section,
        judgement=judgement,
        horizon=steps_text(section.horizon),
        changed=clean(", ".join(changed_options(section.rows[0].entry) or ())),
        algorithm=algorithm,
        lead=_lead(rows, section.times),
        answers=tuple(verdict(*pair, kinds=len(asked) < 3) for pair in asked),
        winners=winning,
        citation=cite(section, rows),
        picked=tuple(picked),
        sentences=tuple(
            (one.place, other.place, verdict(one, other)) for one, other in itertools.combinations(rows, 2)
        ),
        rows=rows,
        columns=tuple(
            each
            for each in (*columns.ranks(section), *columns.facts(section))
            if each.shown and (each.name == "ranks" or any(each.written(row) != "-" for row in section.rows))
        ),
        notes=tuple(tables.notes(section, by_tiers=False)),
        tier_columns=tier_columns,
        tier_notes=(
            *(f"{each.title}: {each.meaning}" for each in tier_columns if each.meaning),
            *tables.tier_notes(section),
        ),
        ladder=ladder.draw(
            section.times.board.outperforms[np.ix_(order, order)],
            [0.0 if time.ranks is None else float(time.ranks[0]) for time in section.times.rows],
        ),
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
        thresholds=tuple(levels),
        threshold_name=clean(ranking.level_name),
        threshold_symbol=symbol(grid),
        framed=any(cell.reference for line in surfaces[0] for cell in line),
        deltas=deltas,
        data=_data(section, judgement, rows, ranking),
        decisions=tuple(
            tuple(_decision_cell(section.times, i, j) for j in order.tolist()) for i in order.tolist()
        ),
    )


def _lead(rows: Sequence[RowView], times: TimeRanking) -> str:
    """Return a sentence that names the leading entry among all compared entries."""
    ranked = [row for row in rows if row.time.ranks is not None]
    if not ranked:
        return f"No entry is ranked: {unranked_since(rows[0].time.entry).partition(': ')[2]}."
    best, relation = ranked[0], times.board.outperforms
    if times.n_ranked == 1:
        return f"{best.name} is the only ranked entry."
    if times.n_ranked == len(rows) == 2:
        return ""  # the verdict says it
    if not relation.any():
        return f"No entry of {times.n_ranked} outperforms another."
    first = [row for row in ranked if row.time.ranks is not None and row.time.ranks[0] == 1]
    if not first:
        return f"{best.name} has rank {best.time.rank_text} of {times.n_ranked} entries."
    if len(first) > 4:
        return f"No entry outperforms any of {len(first)}, from {first[0].name} on."
    if len(first) > 1:
        names = [row.name for row in first]
        return f"No entry outperforms {', '.join(names[:-1])} or {names[-1]}."
    wins, rest = int(relation[times.order[first[0].place]].sum()), times.n_ranked - 1
    if wins == rest:
        return f"{first[0].name} outperforms {f'all {rest} others' if rest > 1 else 'the other entry'}."
    return f"{first[0].name} has rank 1 and outperforms {wins} of {rest} others."


def _decision_cell(times: TimeRanking, i: int, j: int) -> tuple[str, str]:
    """Return a cell's text and style in the matrix of adjusted p."""
    board, direction = times.board, times.board.directions[i][j]
    if i == j or direction is Direction.UNDECIDED:
        return ("", "self") if i == j else ("?", "tie")
    style = {Direction.FEWER: "win", Direction.MORE: "loss"}.get(direction, "tie")
    return p_text(board.adjusted[i, j]) + "!" * bool(board.few[i, j]), style


def _matrix_cell(judgement: Judgement, row: int, column: int) -> tuple[str, str]:
    """Return a cell's text and style in the matrix of pairs."""
    if row == column:
        return "", "self"
    pair = judgement.pair(row, column)
    outcome, (wins, losses) = pair.outcome(row), pair.counts(row)
    texts = {
        Outcome.OUTPERFORMS: f"+{wins}",
        Outcome.OUTPERFORMED: f"−{losses}",
        Outcome.TRADE_OFF: f"+{wins} −{losses}",
        Outcome.UNDECIDED: "?",
    }
    return texts.get(outcome, "·"), SIGNS.get(outcome, "tie")


def _data(
    section: Section, judgement: Judgement, rows: Sequence[RowView], ranking: RankingSection
) -> dict[str, Any]:
    """Return a section's data for the page's scripts."""
    reference = ranking.reference
    external = any(row.entry.curves.external for row in rows)
    level = 1 - reference.epsilon if reference.epsilon is not None else reference.threshold
    words = dict.fromkeys(pair.words(side) for pair in judgement.pairs for side in (pair.first, pair.second))
    numbers = {text: number for number, text in enumerate(words)}  # many pairs share their words
    return {
        "task": clean(section.task),
        "horizon": section.horizon,
        "entries": [row.entry.index for row in rows],
        "names": [row.name for row in rows],
        "level": level,
        "policies": [[clean(name), value] for name, value in section.ranking.policies.items()],
        "score": f"{'' if external else 'validation '}{clean(section.score.called)}"
        f"{' (received / optimal)' * section.score.of_optimum}",
        "levelName": symbol(judgement.grid),
        "levels": [f"{float(value):g}" for value in judgement.grid.levels],
        "deltas": [f"{float(delta):g}" for delta in judgement.grid.deltas],
        "pairs": [
            [pair.first, pair.second, pair.n_runs, pair.cells]
            + [numbers[pair.words(side)] for side in (pair.first, pair.second)]
            for pair in judgement.pairs
        ],
        "words": list(words),
        "evidence": {
            f"{place}/{n_runs}": _numbers(evidence)
            for (place, n_runs), evidence in judgement.evidence.items()
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


def extent(sections: Sequence[SectionView], entries: Sequence[EntryView]) -> str:
    """Return the numbers of entries, tasks, runs and core-hours behind the page."""
    tasks = {view.section.task for view in sections}
    runs = sum(len(entry.curves.seeds) for entry in entries)
    hours = sum(entry.curves.hours for entry in entries)
    told = f"{counted(len(entries), 'entry')} on {counted(len(tasks), 'task')}, {counted(runs, 'run')}"
    return told + f", {hours_text(hours)} core-hours" * bool(hours)
