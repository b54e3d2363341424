"""One pair by its times below threshold: the verdict of the pair, and every threshold with an interval of its own.

The verdict equals the verdict of a board of these two (`times_board`): the max-T permutation test at level alpha.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from qrlsuite.statistics.compare import MIN_RUNS
from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray
from qrlsuite.statistics.permutation import MaxT
from qrlsuite.statistics.times import check_probability, student_quantile, times_below
from qrlsuite.statistics.times_board import Direction, direction, log_ratios, named_direction, refine


@dataclass(frozen=True, eq=False, slots=True)
class TimesPair:
    """The result of `times_pair`, from the first entry's side, for E thresholds.

    Attributes
    ----------
    n_runs:
        Runs of both; they may differ.
    horizon, alpha:
        Environment steps to which both were cut, and the error probability of the verdict.
    direction:
        The verdict; undecided where an entry has fewer than 20 runs.
    p:
        p of the pair, NaN if undecided.
    difference:
        Shape (3,): mean time of the first over mean time of the second, minus 1, and its interval at level 1 - alpha.
        NaN if the second's is 0; the interval is NaN if an entry has a single run.
    signs:
        Shape (E,): +1 where the first needs significantly fewer steps, -1 where more, at level alpha for all
        thresholds together.
    p_each:
        Shape (E,): p of each threshold, adjusted for all of them.
    means:
        Shape (2, E): mean time below each threshold in steps.
    differences:
        Shape (E, 3): as `difference`, for each threshold by itself.
    at_cap:
        Shape (2, E): share of the runs that never reach each threshold.
    """

    n_runs: tuple[int, int]
    horizon: int
    alpha: float
    direction: Direction
    p: float
    difference: FloatArray = field(repr=False)
    signs: IntArray = field(repr=False)
    p_each: FloatArray = field(repr=False)
    means: FloatArray = field(repr=False)
    differences: FloatArray = field(repr=False)
    at_cap: FloatArray = field(repr=False)


def times_pair(
    first: LearningCurves,
    second: LearningCurves,
    grid: Grid,
    alpha: float = 0.05,
    horizon: int | None = None,
    seed: int = 0,
) -> TimesPair:
    """Compare two entries by their time below the grid's E thresholds.

    Parameters
    ----------
    first, second:
        The entries; their numbers of runs may differ.
    grid:
        Its thresholds count; its deltas do not.
    alpha:
        In (0, 1).
    horizon:
        Environment steps beyond which neither entry is looked at; None means the shorter horizon.
    seed:
        Of the relabelings.

    Raises
    ------
    OptionError
        If the common horizon is not a whole number of epochs for both, or a relative score lies outside [0, 1].
    """
    check_probability(alpha, "alpha")
    end = common_horizon(first, second, horizon)
    one, other = (
        times_below(entry.cut(end).values, grid, entry.steps_per_epoch) for entry in (first, second)
    )
    verdict, p = Direction.UNDECIDED, float("nan")
    signs, p_each = np.zeros(grid.shape[0], dtype=np.int64), np.full(grid.shape[0], np.nan)
    if min(len(one), len(other)) >= MIN_RUNS:
        test = MaxT([(one, other)], seed=seed)
        refine(test, alpha)
        p, p_each = float(test.p[0]), test.p_each[0]
        signs = np.where(p_each <= alpha, np.sign(test.t[0]), 0).astype(np.int64)
        verdict = named_direction(direction(test.t[0], signs) if p <= alpha else None)
    each = [ratio_interval(one[:, [k]], other[:, [k]], 1 - alpha) for k in range(grid.shape[0])]
    return TimesPair(
        n_runs=(len(one), len(other)),
        horizon=end,
        alpha=alpha,
        direction=verdict,
        p=p,
        difference=ratio_interval(one, other, 1 - alpha),
        signs=signs,
        p_each=p_each,
        means=np.stack([one.mean(axis=0), other.mean(axis=0)]),
        differences=np.array(each).reshape(-1, 3),
        at_cap=np.stack([(times == end).mean(axis=0) for times in (one, other)]),
    )


def ratio_interval(first: IntArray, second: IntArray, level: float) -> FloatArray:
    """Return, shape (3,): mean of the first's times (N, E) over the second's, minus 1, and the interval of this."""
    ratio, error, freedom = (matrix[0, 1] for matrix in log_ratios([first, second]))
    reach = student_quantile((1 + level) / 2, freedom) * error
    ends: FloatArray = np.expm1(np.array([ratio, ratio - reach, ratio + reach]))
    return ends
