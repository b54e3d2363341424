"""One pair by its steps below threshold: the verdict of the pair, and every threshold with an interval of its own.

The verdict is the one on a board of these two (`times_board`): rule `steps` at level alpha, from 4 runs on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray
from qrlsuite.statistics.permutation import CHUNK, MaxT, with_half_epoch
from qrlsuite.statistics.steps import LEAST_RUNS, least_p, ratio_interval, settle
from qrlsuite.statistics.times import check_probability, student_quantile, times_below
from qrlsuite.statistics.times_board import Direction, log_ratios, named_direction, spread

POWER = 0.8
"""The power with which a pair's runs would have shown `TimesPair.detectable`."""


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
        The verdict; undecided where an entry has fewer than 4 runs, or no labeling of so few could decide.
    p, p_error:
        p of the pair, NaN if undecided; its Monte Carlo error where more relabelings could turn the verdict, else 0.
    difference:
        Shape (3,): mean steps of the first over mean steps of the second, minus 1, and its interval at level 1 - alpha,
        half an epoch's steps added to both. The interval is NaN if undecided.
    detectable:
        The share of steps that one entry would have to save for these runs to show it with a power of .8.
    failed:
        Runs of each that never reach a threshold.
    spreads:
        Standard deviation over mean of each entry's runs.
    signs:
        Shape (E,): +1 where the first needs significantly fewer steps, -1 where more, at level alpha for all
        thresholds together.
    p_each:
        Shape (E,): p of each threshold, adjusted for all of them.
    means:
        Shape (2, E): mean steps below each threshold.
    differences:
        Shape (E, 3): as `difference`, for each threshold; all intervals together at level 1 - alpha.
    at_cap:
        Shape (2, E): share of the runs that never reach each threshold.
    """

    n_runs: tuple[int, int]
    horizon: int
    alpha: float
    direction: Direction
    p: float
    p_error: float
    difference: FloatArray = field(repr=False)
    detectable: float
    failed: tuple[int, int]
    spreads: tuple[float, float]
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
    seconds: float = math.inf,
) -> TimesPair:
    """Compare two entries by their steps below the grid's E thresholds.

    Parameters
    ----------
    first, second:
        The entries; their numbers of runs may differ.
    grid:
        Its thresholds count; its deltas do not.
    alpha:
        In (0, 1).
    horizon:
        Environment steps after which scores do not count; None means the shorter horizon.
    seconds:
        After which relabeling stops, even if the verdict may still turn.

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
    epoch = max(first.steps_per_epoch, second.steps_per_epoch)
    by_threshold = [with_half_epoch(each, epoch) for each in (one, other)]
    of_runs = [each.sum(axis=1) for each in by_threshold]
    verdict, p, p_error = Direction.UNDECIDED, math.nan, 0.0
    signs, p_each = np.zeros(grid.shape[0], dtype=np.int64), np.full(grid.shape[0], np.nan)
    ratio, error, freedom = (matrix[0, 1] for matrix in log_ratios([each[:, None] for each in of_runs]))
    difference = np.array([np.expm1(ratio), np.nan, np.nan])
    means = [each.mean(axis=0) for each in by_threshold]
    differences = np.stack([means[0] / means[1] - 1, *np.full((2, grid.shape[0]), np.nan)], axis=1)
    if can_decide(len(one), len(other), alpha):
        test = MaxT([(of_runs[0][:, None], of_runs[1][:, None])], seed=seed, ratio=True)
        [turns] = settle(test, alpha, seconds)
        p = float(test.p[0])
        p_error = float(np.sqrt(p * (1 - p) / test.n_relabelings[0])) if turns else 0.0
        verdict = named_direction(int(np.sign(test.t[0, 0])) if p <= alpha else 0)
        difference = ratio_interval(of_runs[0], of_runs[1], alpha, p <= alpha, seed)
        each = MaxT([(by_threshold[0], by_threshold[1])], seed=seed, ratio=True)
        each.extend(CHUNK)
        p_each = each.p_each[0]
        signs = np.where(p_each <= alpha, np.sign(each.t[0]), 0).astype(np.int64)
        critical = float(each.critical(alpha)[0])
        places = range(grid.shape[0])
        differences = np.stack([_interval(by_threshold[0], by_threshold[1], k, critical) for k in places])
    return TimesPair(
        n_runs=(len(one), len(other)),
        horizon=end,
        alpha=alpha,
        direction=verdict,
        p=p,
        p_error=p_error,
        difference=difference,
        detectable=-math.expm1(
            -float(error * (student_quantile(1 - alpha / 2, freedom) + student_quantile(POWER, freedom)))
        ),
        failed=(int((one == end).all(axis=1).sum()), int((other == end).all(axis=1).sum())),
        spreads=(spread(of_runs[0]), spread(of_runs[1])),
        signs=signs,
        p_each=p_each,
        means=np.stack([one.mean(axis=0), other.mean(axis=0)]),
        differences=differences,
        at_cap=np.stack([(times == end).mean(axis=0) for times in (one, other)]),
    )


def can_decide(n_first: int, n_second: int, alpha: float) -> bool:
    """Return whether so many runs can have a verdict: 4 or more, and a labeling could have a p of at most alpha."""
    return min(n_first, n_second) >= LEAST_RUNS and least_p(n_first, n_second) <= alpha


def _interval(first: IntArray, second: IntArray, place: int, critical: float) -> FloatArray:
    """Return, shape (3,), the difference at a threshold, and the interval that leaves out 0 where p is significant."""
    ratio, error, _ = (matrix[0, 1] for matrix in log_ratios([each[:, [place]] for each in (first, second)]))
    reach = critical * error if error else 0.0
    ends: FloatArray = np.expm1(np.array([ratio, ratio - reach, ratio + reach]))
    return ends
