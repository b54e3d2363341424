"""The learning curves of one entry: N independent runs of T epochs, checked once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.grid import BoolArray, Grid, settled, whole

Curve = NDArray[np.floating[Any]]


def checked(curves: ArrayLike, *, relative: bool = False, name: str = "curves") -> Curve:
    """Return learning curves as a floating-point array of shape (N, T).

    Parameters
    ----------
    curves:
        Shape (N, T): the validation score V_t of run i after epoch t. An array that is already floating
        point is neither copied nor converted.
    relative:
        Whether scores are fractions of a known maximum, in [0, 1].
    name:
        Name of the curves in an error message.

    Raises
    ------
    OptionError
        If there is no run or no epoch, the shape is not (N, T), a value is not a number, or a relative score
        lies outside [0, 1].
    """
    try:
        values = np.asarray(curves)
    except ValueError:
        raise OptionError(f"{name}: the runs differ in length; cut them to as many epochs") from None
    if values.dtype.kind in "iub":
        values = values.astype(np.float64)
    if values.dtype.kind != "f":
        raise OptionError(f"{name}: expected numbers, not dtype {values.dtype}")
    if values.ndim != 2:
        raise OptionError(f"{name}: expected shape (runs, epochs), got {values.shape}")
    if values.size == 0:
        raise OptionError(f"{name}: there is no run or no epoch in shape {values.shape}")
    bad = np.isnan(values)
    if bad.any():
        run, epoch = np.argwhere(bad)[0]
        raise OptionError(f"{name}: run {run} is NaN at epoch {epoch} ({int(bad.sum())} such values)")
    if relative and (values.min() < 0 or values.max() > 1):
        run, epoch = np.argwhere((values < 0) | (values > 1))[0]
        raise OptionError(
            f"{name}: run {run} has score {values[run, epoch]:.6g} at epoch {epoch}, outside [0, 1]; "
            "without a known maximum give thresholds instead of epsilons"
        )
    return values


def reached(curves: Curve, grid: Grid) -> BoolArray:
    """Return, shape (E, T, N), whether run i is on the goal's side of V* at epoch t: V_t >= V*, or V_t <= V*.

    Scores are stored rounded (`qrlsuite.statistics.grid.settled`). So a threshold that this would round to its far side
    is rounded, too: 6 of 11 reaches 6 / 11. And it has the precision of the curves: a float32 score of 0.7 reaches 0.7.
    """
    nearer = np.minimum if grid.goal == "above" else np.maximum
    thresholds = nearer(grid.thresholds, settled(grid.thresholds)).astype(curves.dtype)
    values, levels = curves.T[None], thresholds[:, None, None]
    there: BoolArray = values >= levels if grid.goal == "above" else values <= levels
    return there


@dataclass(frozen=True, eq=False, slots=True)
class LearningCurves:
    """All runs of one entry.

    Attributes
    ----------
    values:
        Shape (N, T): the validation score of run i after epoch t.
    steps_per_epoch:
        Environment steps between two validations.
    name:
        Name of the entry in sentences and rankings.
    complete:
        Whether it has all requested runs: a board ranks only complete entries.

    Raises
    ------
    OptionError
        If the curves are empty, not two-dimensional or contain NaN, or `steps_per_epoch` is not a positive
        integer.
    """

    values: Curve
    steps_per_epoch: int
    name: str = "entry"
    complete: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", checked(self.values, name=f"'{self.name}'"))
        steps = whole(self.steps_per_epoch, f"'{self.name}': steps_per_epoch", at_least=1)
        object.__setattr__(self, "steps_per_epoch", steps)

    @property
    def n_runs(self) -> int:
        """N, the number of independent runs."""
        return int(self.values.shape[0])

    @property
    def horizon(self) -> int:
        """Environment steps of every run."""
        return int(self.values.shape[1]) * self.steps_per_epoch

    def cut(self, horizon: int) -> LearningCurves:
        """Return the same runs up to a horizon in environment steps.

        Raises
        ------
        OptionError
            If the horizon is not a whole number of this entry's epochs, or beyond its last one.
        """
        horizon = whole(horizon, "horizon", at_least=1)
        if horizon % self.steps_per_epoch:
            raise OptionError(
                f"a horizon of {horizon} steps is not a whole number of epochs for '{self.name}' "
                f"({self.steps_per_epoch} steps per epoch); give one that is for both entries"
            )
        if horizon > self.horizon:
            raise OptionError(f"'{self.name}' ends at {self.horizon} steps, before the horizon of {horizon}")
        if horizon == self.horizon:
            return self
        return replace(self, values=self.values[:, : horizon // self.steps_per_epoch])

    def require_unit_interval(self) -> None:
        """Raise OptionError unless every score lies in [0, 1], as tolerances epsilon presuppose."""
        checked(self.values, relative=True, name=f"'{self.name}'")


def common_horizon(first: LearningCurves, second: LearningCurves, horizon: int | None = None) -> int:
    """Return the steps to which two entries are cut: the shortest of both and of an optional limit.

    Raises
    ------
    OptionError
        If it is not a whole number of epochs for both.
    """
    shortest = min(first.horizon, second.horizon)
    if horizon is not None:
        shortest = min(shortest, whole(horizon, "horizon", at_least=1))
    for entry in (first, second):
        if shortest % entry.steps_per_epoch:
            raise OptionError(
                f"'{first.name}' and '{second.name}' cannot be compared at {shortest} steps, the shorter "
                f"horizon: it is not a whole number of epochs for '{entry.name}' "
                f"({entry.steps_per_epoch} steps per epoch)"
            )
    return shortest
