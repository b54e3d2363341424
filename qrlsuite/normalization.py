"""Normalization of observations; the choice is an option of the environment.

Three kinds are fixed before training, and the environment applies them. Running statistics are gathered while a seed
trains, and training and validation need equal ones: they belong to the agent, which applies them itself
(`qrlsuite.training.standardization`), and its environment only asks for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from qrlsuite.errors import OptionError

Kind = Literal["none", "bounds", "arctan", "running"]
KIND = (
    "none: as they are; bounds: low..high linearly to -1..1, not clipped; "
    "arctan: the arcus tangens of each value, in -pi/2..pi/2; "
    "running: standardized by the mean and variance of what the agent has trained on, clipped to -10..10"
)
"""The description of an option of this kind."""


class Normalization:
    """Maps observations (..., n) float32 to observations (..., n) float32, each value by itself.

    - `none` does not change them.
    - `bounds` maps [low, high] linearly to [-1, 1]. Values outside are not clipped: nothing is lost.
    - `arctan` bounds values that have no bounds to (-pi/2, pi/2), angles a circuit can take (Skolik, Jerbi &
      Dunjko 2022, "Quantum agents in the Gym", section 3.2, for CartPole's velocities).
    - `running` does not change them, either: the agent standardizes them, see `qrlsuite.training.standardization`.

    Parameters
    ----------
    space:
        The observations' box, of shape (n,).
    low, high:
        For `bounds`: the n values that become -1 and 1; by default the box's own.
    what:
        Owner of the option, for messages.

    Attributes
    ----------
    space:
        The box of normalized observations.

    Raises
    ------
    qrlsuite.errors.OptionError
        If the bounds are missing, infinite, of the wrong number or empty, or given to another kind.
    """

    def __init__(
        self,
        kind: Kind,
        space: Box,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        what: str = "environment",
    ) -> None:
        self.kind = kind
        if kind != "bounds" and (low is not None or high is not None):
            raise OptionError(f"{what}: low and high are for normalization = 'bounds', not '{kind}'")
        limits = np.stack([space.low, space.high]).astype(np.float64)
        if kind == "bounds":
            bottom = _bounds(low, limits[0], "low", what)
            top = _bounds(high, limits[1], "high", what)
            if not (bottom < top).all():
                k = int(np.argmin(bottom < top))
                raise OptionError(f"{what}: low[{k}] = {bottom[k]:g} is not below high[{k}] = {top[k]:g}")
            self._center = ((bottom + top) / 2).astype(np.float32)
            self._scale = (2 / (top - bottom)).astype(np.float32)
        bounds: NDArray[np.float32] = self(limits.astype(np.float32))
        self.space = Box(bounds[0], bounds[1], dtype=np.float32)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return normalized observations, a new array unless there is nothing to do."""
        if self.kind == "bounds":
            return (observations - self._center) * self._scale
        if self.kind == "arctan":
            result: NDArray[np.float32] = np.arctan(observations)
            return result
        return observations


def _bounds(
    replacement: Sequence[float] | None, declared: NDArray[np.float64], name: str, what: str
) -> NDArray[np.float64]:
    """Return one side's bounds (n,), the given or the box's own."""
    values: NDArray[Any] = declared if replacement is None else np.array(replacement, dtype=np.float64)
    if values.shape != declared.shape:
        raise OptionError(f"{what}: {name} has {values.size} values, an observation has {declared.size}")
    if not np.isfinite(values).all() or np.abs(values).max() > 1e30:
        k = int(np.argmax(~np.isfinite(values) | (np.abs(values) > 1e30)))
        raise OptionError(
            f"{what}: normalization = 'bounds' needs finite bounds, and {name}[{k}] is {values[k]:g}: "
            f"give {name} as a list of {declared.size} numbers, or take normalization = 'arctan'"
        )
    return values
