"""Empirical sample complexity: how many environment steps until most runs are good enough.

S_hat(V*, delta) = steps per epoch x number of epochs t with P_hat_t < delta, where P_hat_t is the fraction
of the N runs with V_t >= V* (paper, definition "Estimator empirical sample complexity", section "Sample
Complexity Estimator", and its general case in the appendix). Every epoch counts, also one after the first
crossing: an algorithm that forgets pays for it. An entry that never gets there has S_hat equal to its
horizon, so an unreached goal is a lower bound and not infinity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from qrlsuite.statistics.curves import Curve, checked, reached
from qrlsuite.statistics.grid import BoolArray, Grid, IntArray, whole


def sample_complexity(curves: ArrayLike, grid: Grid, steps_per_epoch: int) -> IntArray:
    """Return S_hat in environment steps, shape (E, D).

    Parameters
    ----------
    curves:
        Shape (N, T): scores in [0, 1] where the grid is relative to a known maximum, else any numbers, infinities
        included.
    grid:
        The E x D cells: `Grid.relative(epsilons, deltas)` or `Grid.absolute(thresholds, deltas)`.
    steps_per_epoch:
        Environment steps per epoch.

    Raises
    ------
    OptionError
        If the curves are empty, of the wrong shape, not numbers or outside [0, 1], or the steps are not positive.

    >>> import numpy as np
    >>> sample_complexity(np.array([[0.5, 0.9, 0.9]]), Grid.relative([0.2], [1.0]), 1000).tolist()
    [[1000]]
    """
    steps = whole(steps_per_epoch, "steps_per_epoch", at_least=1)
    return complexity(checked(curves, relative=grid.is_relative), grid, steps)


def complexity(curves: Curve, grid: Grid, steps_per_epoch: int) -> IntArray:
    """Return S_hat in environment steps, shape (E, D), for checked curves of shape (N, T)."""
    steps: IntArray = epochs_below(curves, grid) * steps_per_epoch
    return steps


def epochs_below(curves: Curve, grid: Grid) -> IntArray:
    """Return, shape (E, D), the number of epochs with P_hat_t < delta, for checked curves of shape (N, T)."""
    counts = np.count_nonzero(reached(curves, grid), axis=2)
    required = grid.required_counts(curves.shape[0])
    below = counts[:, None, :] < required[None, :, None]
    epochs: IntArray = np.count_nonzero(below, axis=2).astype(np.int64)
    return epochs


def unsettled(curves: ArrayLike, grid: Grid) -> BoolArray:
    """Return, shape (E, D), where P_hat < delta at the last epoch: there S_hat is only a lower bound.

    Parameters and errors as in `sample_complexity`.
    """
    values = checked(curves, relative=grid.is_relative)
    return epochs_below(values[:, -1:], grid) > 0


def at_cap(intervals: ArrayLike, horizon: int) -> BoolArray:
    """Return, shape (E, D), where the upper percentile equals the horizon (the paper fades such bars).

    Parameters
    ----------
    intervals:
        Shape (E, D, 2), in environment steps, as `bootstrap_interval` returns them.
    horizon:
        T x steps per epoch.
    """
    upper: BoolArray = np.asarray(intervals)[..., 1] >= whole(horizon, "horizon", at_least=1)
    return upper
