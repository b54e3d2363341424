"""Every pair of a section as the board decided it: the matrix of adjusted p."""

from __future__ import annotations

from qrlsuite.leaderboard.boards.times import TimeRanking
from qrlsuite.results.text import p_text
from qrlsuite.statistics import Direction

STYLES = {Direction.FEWER: "win", Direction.MORE: "loss"}


def matrix(ranking: TimeRanking) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Return text and style of each cell, row against column, in the order of the ranking."""
    places = range(len(ranking.rows))
    return tuple(tuple(_cell(ranking, one, other) for other in places) for one in places)


def _cell(ranking: TimeRanking, one: int, other: int) -> tuple[str, str]:
    board, i, j = ranking.board, ranking.order[one], ranking.order[other]
    if i == j:
        return "", "self"
    direction = board.directions[i][j]
    if direction is Direction.UNDECIDED:
        return "?", "tie"
    return p_text(board.adjusted[i, j]) + "!" * bool(board.few[i, j]), STYLES.get(direction, "tie")
