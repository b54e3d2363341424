"""A section's entries by mean time below threshold, as the page shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from qrlsuite.leaderboard.report.entries import EntryView
from qrlsuite.leaderboard.times import TimeRanking, TimeRow, p_text
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Direction
from qrlsuite.statistics.compare import TOO_FEW

STYLES = {Direction.FEWER: "win", Direction.MORE: "loss", Direction.TRADE_OFF: "both"}
LINKS = {"/": "start", "|": "through", "\\": "end", "": ""}


@dataclass(frozen=True)
class TimeRowView:
    """A line of the table; `low`, `point` and `high` are shares of the horizon in percent."""

    entry: EntryView
    row: TimeRow
    link: str
    mean: str
    interval: str
    low: float
    point: float
    high: float
    at_cap: str


@dataclass(frozen=True)
class TimesView:
    """The table, and the matrix of adjusted p: text, style and words of each cell."""

    ranking: TimeRanking
    rows: tuple[TimeRowView, ...]
    matrix: tuple[tuple[tuple[str, str, str], ...], ...]


def view(ranking: TimeRanking, entries: Mapping[int, EntryView]) -> TimesView:
    """Return a section's ranking for the template.

    Parameters
    ----------
    entries:
        The page's entries by the identity of their curves.
    """
    rows = tuple(_row(row, entries[id(row.entry)], ranking) for row in ranking.rows)
    matrix = tuple(
        tuple(_cell(ranking, rows, one, other) for other in range(len(rows))) for one in range(len(rows))
    )
    return TimesView(ranking, rows, matrix)


def _row(row: TimeRow, entry: EntryView, ranking: TimeRanking) -> TimeRowView:
    horizon = ranking.board.horizon
    low, high = row.mean.interval
    mean, least, most = (steps_text(steps, digits=3) for steps in (row.mean.mean, low, high))
    shares = (f"{ranking.kind} {level}: {share:.0%}" for level, share in zip(ranking.levels, row.mean.at_cap))
    return TimeRowView(
        entry=entry,
        row=row,
        link=LINKS[row.joined],
        mean=mean,
        interval=f"{least} to {most}",
        low=100 * low / horizon,
        point=100 * row.mean.mean / horizon,
        high=100 * high / horizon,
        at_cap=f"at half the horizon M is {steps_text(round(row.mean.half))}; at cap: {', '.join(shares)}",
    )


def _cell(ranking: TimeRanking, rows: tuple[TimeRowView, ...], one: int, other: int) -> tuple[str, str, str]:
    board, i, j = ranking.board, ranking.order[one], ranking.order[other]
    if i == j:
        return "", "self", ""
    direction = board.directions[i][j]
    if direction is Direction.UNDECIDED:
        return "?", "tie", TOO_FEW
    names = f"{rows[one].entry.label} against {rows[other].entry.label}"
    title = f"{names}: {direction}, adjusted p = {board.adjusted[i, j]:.4g}"
    if board.few[i, j]:
        title += "; unequal numbers of seeds, the smaller below 50: errors are likelier than alpha says"
    return p_text(board.adjusted[i, j]) + "!" * bool(board.few[i, j]), STYLES.get(direction, "tie"), title
