"""Every pair of a section as the board decided it: the matrix of adjusted p."""

from __future__ import annotations

from collections.abc import Sequence

from qrlsuite.leaderboard.boards.times import TimeRanking, p_text
from qrlsuite.statistics import Direction
from qrlsuite.statistics.compare import TOO_FEW

STYLES = {Direction.FEWER: "win", Direction.MORE: "loss", Direction.TRADE_OFF: "both"}
Cell = tuple[str, str, str]


def matrix(ranking: TimeRanking, labels: Sequence[str]) -> tuple[tuple[Cell, ...], ...]:
    """Return text, style and words of each cell, row against column.

    Parameters
    ----------
    labels:
        The entries' names, in the order of the ranking.
    """
    places = range(len(labels))
    return tuple(tuple(_cell(ranking, labels, one, other) for other in places) for one in places)


def _cell(ranking: TimeRanking, labels: Sequence[str], one: int, other: int) -> Cell:
    board, i, j = ranking.board, ranking.order[one], ranking.order[other]
    if i == j:
        return "", "self", ""
    direction = board.directions[i][j]
    if direction is Direction.UNDECIDED:
        return "?", "tie", TOO_FEW
    title = f"{labels[one]} against {labels[other]}: {direction}, adjusted p = {board.adjusted[i, j]:.4g}"
    if board.few[i, j]:
        title += "; unequal numbers of seeds, the smaller below 50: errors are likelier than alpha says"
    return p_text(board.adjusted[i, j]) + "!" * bool(board.few[i, j]), STYLES.get(direction, "tie"), title
