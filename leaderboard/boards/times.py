"""A section of a board by steps below threshold: who outperforms whom, and the ranks that remain.

`rank_by_time` computes everything once; tables, files and the page write its result. The statistics are in
`qrlsuite.statistics.times_board`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from qrlsuite.leaderboard.boards.columns import ranks_text
from qrlsuite.leaderboard.boards.ranked import learning_curves
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import interval_text, p_text, percent
from qrlsuite.statistics import (
    Direction,
    Grid,
    MeanTime,
    TimesBoard,
    times_board,
)

ALPHA = 0.05


@dataclass(frozen=True, eq=False)
class TimeRow:
    """One entry, ordered by M: its mean steps below threshold over its runs and the grid's thresholds.

    Attributes
    ----------
    place:
        1 for the smallest M; None below 20 seeds, and where seeds are missing.
    place_at_half:
        The place if all entries had ended at half the horizon.
    ranks:
        Best and worst rank that the decided pairs leave; None without a place.
    at_cap:
        Share of the times, over runs and thresholds, that are the horizon: the run never reached the threshold.
    difference:
        M over the M of the first shown entry, minus 1, and its interval; None for the first, and without a place.
    few:
        Whether it has fewer than 50 seeds, and another ranked entry has another number of seeds.
    """

    entry: EntryResults
    place: int | None
    place_at_half: int | None
    ranks: tuple[int, int] | None
    mean: MeanTime
    at_cap: float
    difference: tuple[float, float, float] | None
    few: bool

    @property
    def rank_text(self) -> str:
        """`3`, `3-5`, or `-` without a place."""
        return "-" if self.ranks is None else ranks_text(self.ranks)

    @property
    def difference_text(self) -> str:
        """`+12% (+8% to +17%)`, `-` where there is none."""
        if self.difference is None:
            return "-"
        return interval_text(percent, *self.difference)


@dataclass(frozen=True, eq=False)
class TimeRanking:
    """The result of `rank_by_time`.

    Attributes
    ----------
    board:
        All pairs, in the order in which the entries were given.
    rows:
        The shown entries, in the order of M.
    order:
        Index in `board` of each row.
    kind, levels:
        The kind of the grid's thresholds, `epsilon` or `threshold`, and their values.
    """

    board: TimesBoard
    rows: tuple[TimeRow, ...]
    order: tuple[int, ...]
    kind: str
    levels: tuple[str, ...]

    @property
    def level(self) -> str:
        """The level of every interval: `95%`."""
        return f"{100 * (1 - self.board.alpha):g}%"

    @property
    def n_pairs(self) -> int:
        """Pairs that were tested, and over which Holm's procedure goes."""
        return self.n_ranked * (self.n_ranked - 1) // 2

    @property
    def n_decided(self) -> int:
        """Number of decided pairs, whether or not the entries are shown."""
        return sum(decided(each) for row in self.board.directions for each in row) // 2

    @property
    def n_ranked(self) -> int:
        """Entries of 20 seeds or more, none missing: the family over whose pairs Holm's procedure goes."""
        return int(self.board.ranks.all(axis=1).sum())

    def special(self) -> list[str]:
        """Name every pair whose decision more relabelings could turn."""
        return [
            f"within Monte Carlo error of its level after 10 million permutations: {self._label(i)} and "
            f"{self._label(j)}, adjusted p = {p_text(self.board.adjusted[i, j])} +- {self.board.p_error[i, j]:.1g}"
            for place, i in enumerate(self.order)
            for j in self.order[place + 1 :]
            if self.board.p_error[i, j]
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON. Matrices are in the order of `rows`, from the row's side."""
        order = list(self.order)
        return {
            "alpha": self.board.alpha,
            "level": 1 - self.board.alpha,
            self.kind: [float(level) for level in self.levels],
            "pairs": self.n_pairs,
            "decided": self.n_decided,
            "adjusted_p": [[_number(self.board.adjusted[i, j]) for j in order] for i in order],
            "verdicts": [
                [None if i == j else str(self.board.directions[i][j]) for j in order] for i in order
            ],
            "difference": [[_number(self.board.difference[i, j]) for j in order] for i in order],
            "difference_interval": [
                [[_number(end) for end in self.board.difference_interval[i, j]] for j in order] for i in order
            ],
            "unequal_and_few": [[bool(self.board.few[i, j]) for j in order] for i in order],
            "within_monte_carlo_error": self.special(),
        }

    def told_apart_from_next(self, row: TimeRow) -> bool | None:
        """Return whether a row and the one below are decided; None where one of them is not ranked."""
        index = self.rows.index(row)
        below = self.rows[index + 1 : index + 2]
        if row.ranks is None or not below or below[0].ranks is None:
            return None
        return decided(self.board.directions[self.order[index]][self.order[index + 1]])

    def against(self, row: TimeRow) -> dict[str, object]:
        """Return a row's pairs for a spreadsheet: every adjusted p as `entry: p`."""
        i, names = self.order[self.rows.index(row)], self.board.names
        return {
            "adjusted_p": [
                f"{names[j]}: {self.board.adjusted[i, j]:.6g}"
                for j in self.order
                if not math.isnan(self.board.adjusted[i, j])
            ],
        }

    def _label(self, index: int) -> str:
        return self.rows[self.order.index(index)].entry.label


def rank_by_time(
    entries: Sequence[EntryResults],
    grid: Grid,
    horizon: int,
    alpha: float = ALPHA,
    shown: Callable[[EntryResults], bool] | None = None,
) -> TimeRanking:
    """Rank the entries of a section by mean steps below threshold.

    Parameters
    ----------
    entries:
        All of one task, all reaching the horizon.
    grid:
        The task's; its deltas do not count.
    horizon:
        Environment steps at which all are cut.
    alpha:
        In (0, 1): probability of any false decision among entries of equal laws; intervals have level 1 - alpha.
    shown:
        Which entries have a row; all are compared, and counted by Holm's procedure. None means all.
    """
    board = times_board([learning_curves(entry) for entry in entries], grid, alpha, horizon)
    ranked = [index for index in board.order if board.ranks[index, 0]]
    order = tuple(index for index in board.order if shown is None or shown(entries[index]))
    at_half = [index for index in board.order_at_half if index in ranked]
    rows = []
    for index in order:
        known = index in ranked
        first, difference = order[0], None
        if known and index != first and not math.isnan(board.difference[index, first]):
            low, high = board.difference_interval[index, first]
            difference = (
                float(board.difference[index, first]),
                float(low),
                float(high),
            )
        best, worst = board.ranks[index].tolist()
        rows.append(
            TimeRow(
                entry=entries[index],
                place=ranked.index(index) + 1 if known else None,
                place_at_half=at_half.index(index) + 1 if known else None,
                ranks=(best, worst) if known else None,
                mean=board.means[index],
                at_cap=float(board.means[index].at_cap.mean()),
                difference=difference,
                few=known
                and any(
                    board.few[index, other] and board.n_runs[index] < board.n_runs[other] for other in ranked
                ),
            )
        )
    return TimeRanking(
        board,
        tuple(rows),
        order,
        grid.level_name,
        tuple(f"{float(level):g}" for level in grid.levels),
    )


def decided(direction: Direction) -> bool:
    """Return whether a pair is decided."""
    return direction in (Direction.FEWER, Direction.MORE)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
