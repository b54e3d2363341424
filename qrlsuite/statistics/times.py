"""Steps below threshold: one number per run behind the sample-complexity surface.

T_i(eps) = steps per epoch x number of epochs in which run i scores less than 1 - eps, from 0 to the horizon.
S_hat(eps, delta) counts the epochs with P_hat_t < delta, and the integral of that over delta in (0, 1] is
1 - P_hat_t. So the mean of T over the runs is the area of the surface's column: exactly,

    mean over delta = 1/N, 2/N, ..., 1 of S_hat(eps, delta) = mean over runs of T_i(eps).

Unlike S_hat, this mean is unbiased at every N, so that it can be compared at unequal numbers of runs. It is a
mean restricted to the horizon: a run that never gets there counts with the horizon, and not with more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from qrlsuite.errors import OptionError
from qrlsuite.statistics.curves import Curve, LearningCurves, checked, reached
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, whole


def times_below(curves: ArrayLike, grid: Grid, steps_per_epoch: int) -> IntArray:
    """Return T, shape (N, E): the environment steps that each run spends on the wrong side of each threshold.

    That is below it, or above it where the grid's goal is `below`.

    Parameters
    ----------
    curves:
        Shape (N, T): the validation score of run i after epoch t. In [0, 1] if the grid has epsilons.
    grid:
        Its E thresholds count; its deltas do not.
    steps_per_epoch:
        Environment steps per epoch.

    Raises
    ------
    OptionError
        If the curves are empty, of the wrong shape or not numbers, or a relative score lies outside [0, 1].

    Examples
    --------
    Two runs of four epochs; the second loses the goal once.

    >>> grid = Grid.relative([0.1], [0.5])
    >>> times_below([[0.0, 0.0, 0.9, 1.0], [0.0, 0.9, 0.5, 0.9]], grid, 2000).tolist()
    [[4000], [4000]]
    """
    values = checked(curves, relative=grid.epsilons is not None)
    return epochs_of_runs(values, grid) * whole(steps_per_epoch, "steps_per_epoch", at_least=1)


def times_lost(curves: ArrayLike, grid: Grid, steps_per_epoch: int) -> IntArray:
    """Return, shape (N, E), the forgotten part of `times_below`: the steps after each threshold was first reached.

    It is 0 for a run that never loses a threshold again, and for one that never reaches it.

    Examples
    --------
    >>> times_lost([[0.0, 0.9, 0.5, 0.9], [0.0, 0.0, 0.0, 0.0]], Grid.relative([0.1], [0.5]), 2000).tolist()
    [[2000], [0]]
    """
    there = reached(checked(curves, relative=grid.epsilons is not None), grid)
    lost = np.count_nonzero(np.logical_or.accumulate(there, axis=1) & ~there, axis=1).T.astype(np.int64)
    return np.asarray(lost * whole(steps_per_epoch, "steps_per_epoch", at_least=1))


def epochs_of_runs(curves: Curve, grid: Grid) -> IntArray:
    """Return, shape (N, E), the number of epochs before each threshold, for checked curves of shape (N, T)."""
    epochs: IntArray = (curves.shape[1] - np.count_nonzero(reached(curves, grid), axis=1)).T.astype(np.int64)
    return epochs


@dataclass(frozen=True, eq=False, slots=True)
class MeanTime:
    """The mean steps below threshold of one entry, over its runs and the grid's E thresholds.

    Attributes
    ----------
    mean:
        M in environment steps.
    interval:
        Lower and upper end in steps: Student's t for N runs, kept within 0 and the horizon.
    at_cap:
        Shape (E,): share of the runs that are never at or above the threshold. For them T is the horizon.
    half:
        M if the entry had ended at half the horizon (rounded down to whole epochs), in steps: where it orders
        entries differently, the order depends on the horizon.
    """

    mean: float
    interval: tuple[float, float]
    at_cap: FloatArray
    half: float


def mean_time(entry: LearningCurves, grid: Grid, level: float = 0.95) -> MeanTime:
    """Return the mean steps below threshold, with an interval.

    Parameters
    ----------
    entry:
        The entry; with a single run the interval is all from 0 to the horizon.
    grid:
        Its E thresholds count; its deltas do not.
    level:
        Of the interval: about how often it covers the mean of infinitely many runs. See docs/error-rates.md for
        how often it does.

    Raises
    ------
    OptionError
        If `level` is not between 0 and 1, or a relative score lies outside [0, 1].
    """
    check_probability(level, "level")
    times = times_below(entry.values, grid, entry.steps_per_epoch)
    of_runs = times.mean(axis=1)
    mean = float(of_runs.mean())
    horizon, n_runs = entry.horizon, entry.n_runs
    interval = (0.0, float(horizon))
    if n_runs > 1:
        reach = (
            float(student_quantile((1 + level) / 2, n_runs - 1)) * float(of_runs.std(ddof=1)) / n_runs**0.5
        )
        interval = (max(0.0, mean - reach), min(float(horizon), mean + reach))
    epochs = entry.values.shape[1] // 2
    half = 0.0
    if epochs:
        half = float(times_below(entry.values[:, :epochs], grid, entry.steps_per_epoch).mean())
    return MeanTime(mean, interval, (times == horizon).mean(axis=0), half)


def check_probability(value: float, name: str) -> float:
    """Return a number between 0 and 1, or raise OptionError."""
    if not 0 < value < 1:
        raise OptionError(f"{name} = {value!r} is outside (0, 1)")
    return float(value)


def student_quantile(probability: ArrayLike, freedom: ArrayLike) -> FloatArray:
    """Return quantiles of Student's t distribution; `freedom` (degrees of freedom) may be infinite."""
    from scipy.special import stdtrit  # imported here: importing the statistics costs no more than numpy

    quantile: FloatArray = np.asarray(stdtrit(np.asarray(freedom, np.float64), np.asarray(probability)))
    return quantile
