"""All pairs of a board: who outperforms whom among M entries.

The same verdicts as `qrlsuite.statistics.compare.compare` for every pair, but each entry is resampled once
per number of runs and horizon that its pairs need, and a rule that can judge one entry against many does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qrlsuite.statistics.compare import MIN_RUNS, never_reached, shown_percentiles
from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.estimator import at_cap
from qrlsuite.statistics.grid import BoolArray, Grid, IntArray, whole
from qrlsuite.statistics.ranking import Ranking, rank
from qrlsuite.statistics.significance import (
    Evidence,
    IntervalRule,
    Resampling,
    SignificanceRule,
    check_signs,
)


@dataclass(frozen=True, eq=False, slots=True)
class Board:
    """The result of `outperformance`.

    Attributes
    ----------
    names:
        The M entries.
    rule:
        Name of the rule that judged.
    better_cells:
        Shape (M, M): in how many cells the row's entry needs significantly fewer samples than the column's.
    capped_cells:
        Shape (M, M), symmetric: cells without a significant difference in which both intervals end at the
        horizon: too few steps to tell.
    n_cells:
        Cells of the grid.
    decided:
        Shape (M, M): whether both have at least 20 runs.
    not_reached:
        Shape (M,): whether S_hat is the horizon in every cell.
    """

    names: tuple[str, ...]
    rule: str
    better_cells: IntArray
    capped_cells: IntArray
    n_cells: int
    decided: BoolArray
    not_reached: BoolArray

    @property
    def outperforms(self) -> BoolArray:
        """Shape (M, M): whether the row's entry outperforms the column's."""
        matrix: BoolArray = (self.better_cells > 0) & (self.better_cells.T == 0)
        return matrix

    @property
    def ranking(self) -> Ranking:
        """The tiers."""
        return rank(self.names, self.outperforms, self.decided, self.better_cells, self.not_reached)


def outperformance(
    entries: Sequence[LearningCurves],
    grid: Grid,
    rule: SignificanceRule | None = None,
    resampling: Resampling | None = None,
    horizon: int | None = None,
) -> Board:
    """Judge every pair of M entries.

    Parameters
    ----------
    entries:
        The entries; their names must differ for a ranking.
    grid, rule, resampling, horizon:
        As in `qrlsuite.statistics.compare.compare`.

    Raises
    ------
    OptionError
        As `compare`, naming the pair.
    """
    chosen = rule or IntervalRule()
    size = len(entries)
    better = np.zeros((size, size), dtype=np.int64)
    capped = np.zeros((size, size), dtype=np.int64)
    runs = np.array([entry.n_runs for entry in entries], dtype=np.int64)
    ends = np.array([_end(entry, horizon) for entry in entries], dtype=np.int64)
    shared_runs, shared_ends = np.minimum.outer(runs, runs), np.minimum.outer(ends, ends)
    decided: BoolArray = shared_runs >= MIN_RUNS
    np.fill_diagonal(decided, False)
    todo = np.triu(decided)
    _check_horizons(entries, horizon, todo, shared_ends)
    for n_runs, end in sorted(set(zip(shared_runs[todo].tolist(), shared_ends[todo].tolist()))):
        group = todo & (shared_runs == n_runs) & (shared_ends == end)
        members = np.flatnonzero(group.any(axis=0) | group.any(axis=1)).tolist()
        evidence = {i: Evidence(entries[i].cut(end), grid, n_runs, resampling) for i in members}
        at_end = {i: at_cap(evidence[i].interval(shown_percentiles(chosen)), end) for i in members}
        for first in np.flatnonzero(group.any(axis=1)).tolist():
            others = np.flatnonzero(group[first]).tolist()
            signs = _judge(chosen, evidence[first], [evidence[other] for other in others])
            better[first, others] = (signs > 0).sum(axis=(1, 2))
            better[others, first] = (signs < 0).sum(axis=(1, 2))
            both = at_end[first] & np.stack([at_end[other] for other in others]) & (signs == 0)
            capped[first, others] = capped[others, first] = both.sum(axis=(1, 2))
    reached_nothing = [never_reached(entry.cut(end), grid) for entry, end in zip(entries, ends.tolist())]
    return Board(
        names=tuple(entry.name for entry in entries),
        rule=chosen.name,
        better_cells=better,
        capped_cells=capped,
        n_cells=grid.size,
        decided=decided,
        not_reached=np.array(reached_nothing, dtype=bool),
    )


def _end(entry: LearningCurves, horizon: int | None) -> int:
    return entry.horizon if horizon is None else min(entry.horizon, whole(horizon, "horizon", at_least=1))


def _check_horizons(
    entries: Sequence[LearningCurves], horizon: int | None, todo: BoolArray, ends: IntArray
) -> None:
    """Raise for the first pair whose common horizon is not a whole number of epochs for both."""
    steps = np.array([entry.steps_per_epoch for entry in entries], dtype=np.int64)
    for i, j in np.argwhere(todo & ((ends % steps[:, None] != 0) | (ends % steps[None, :] != 0))).tolist():
        common_horizon(entries[i], entries[j], horizon)


def _judge(rule: SignificanceRule, first: Evidence, others: Sequence[Evidence]) -> IntArray:
    """Return the signs of one entry against M others, shape (M, E, D)."""
    shape = (len(others), *first.grid.shape)
    against = getattr(rule, "against", None)
    if against is not None:
        return check_signs(against(first, others), shape, rule)
    return check_signs(np.stack([rule(first, other) for other in others]), shape, rule)
