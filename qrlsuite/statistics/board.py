"""All pairs of a board: who outperforms whom among M entries.

The same verdicts as `qrlsuite.statistics.compare.compare` for every pair, but each entry is resampled once
per number of runs and horizon that its pairs need, and a rule that can judge one entry against many does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from qrlsuite.statistics.compare import MIN_RUNS, judge_cells, never_reached
from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.grid import BoolArray, Grid, IntArray, whole
from qrlsuite.statistics.ranking import Ranking, rank
from qrlsuite.statistics.significance import Evidence, IntervalRule, Resampling, SignificanceRule, Signs


@dataclass(frozen=True, eq=False, slots=True)
class Board:
    """The result of `outperformance`.

    Attributes
    ----------
    signs:
        Shape (M, M, E, D): +1 where the row's entry needs significantly fewer samples than the column's, -1 where
        more, else 0.
    capped:
        Shape (M, M, E, D): cells without a significant difference in which both intervals end at the horizon: too few
        steps to tell.
    decided:
        Shape (M, M): whether both have at least 20 runs, and all requested ones.
    not_reached:
        Shape (M,): whether S_hat is the horizon in every cell.
    evidence:
        The evidence of verdicts by entry and number of runs, if all entries were judged at one horizon.
    """

    names: tuple[str, ...]
    rule: str
    signs: Signs
    capped: BoolArray
    decided: BoolArray
    not_reached: BoolArray
    evidence: Mapping[tuple[int, int], Evidence] = field(default_factory=dict, repr=False)

    @property
    def better_cells(self) -> IntArray:
        """Shape (M, M): in how many cells the row's entry needs significantly fewer samples than the column's."""
        cells: IntArray = (self.signs > 0).sum(axis=(2, 3))
        return cells

    @property
    def outperforms(self) -> BoolArray:
        """Shape (M, M): whether the row's entry outperforms the column's."""
        better = self.better_cells
        matrix: BoolArray = (better > 0) & (better.T == 0)
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
    all_signs = np.zeros((size, size, *grid.shape), dtype=np.int8)
    all_capped = np.zeros((size, size, *grid.shape), dtype=np.bool_)
    runs = np.array([entry.n_runs for entry in entries], dtype=np.int64)
    ends = np.array([_end(entry, horizon) for entry in entries], dtype=np.int64)
    shared_runs, shared_ends = np.minimum.outer(runs, runs), np.minimum.outer(ends, ends)
    complete = np.array([entry.complete for entry in entries], dtype=np.bool_)
    decided: BoolArray = (shared_runs >= MIN_RUNS) & np.logical_and.outer(complete, complete)
    np.fill_diagonal(decided, False)
    todo = np.triu(decided)
    _check_horizons(entries, horizon, todo, shared_ends)
    kept: dict[tuple[int, int], Evidence] = {}
    for n_runs, end in sorted(set(zip(shared_runs[todo].tolist(), shared_ends[todo].tolist()))):
        group = todo & (shared_runs == n_runs) & (shared_ends == end)
        members = np.flatnonzero(group.any(axis=0) | group.any(axis=1)).tolist()
        evidence = {i: Evidence(entries[i].cut(end), grid, n_runs, resampling) for i in members}
        if len(set(ends.tolist())) == 1:
            kept |= {(i, n_runs): each for i, each in evidence.items()}
        for first in np.flatnonzero(group.any(axis=1)).tolist():
            others = np.flatnonzero(group[first]).tolist()
            signs, capped = judge_cells(chosen, evidence[first], [evidence[other] for other in others], end)
            all_signs[first, others], all_signs[others, first] = signs, -signs
            all_capped[first, others] = all_capped[others, first] = capped
    reached_nothing = [never_reached(entry.cut(end), grid) for entry, end in zip(entries, ends.tolist())]
    return Board(
        names=tuple(entry.name for entry in entries),
        rule=chosen.name,
        signs=all_signs,
        capped=all_capped,
        decided=decided,
        not_reached=np.array(reached_nothing, dtype=bool),
        evidence=kept,
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
