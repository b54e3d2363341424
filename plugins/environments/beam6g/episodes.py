"""Whole episodes as tables: every antenna's intensity at every step, which no action changes.

The user's path does not depend on the actions. So everything an episode can show is tabulated when it begins,
and a step is a look-up. The single environment and the vector environment both use this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError
from qrlsuite.plugins.environments.beam6g import physics, trajectory
from qrlsuite.plugins.environments.beam6g.options import BeamOptions
from qrlsuite.plugins.environments.beam6g.physics import BEAMS, FIELD, SENDERS, BeamArray, FloatArray

_BLOCK = 32
"""Episodes that are tabulated at once: so many stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Tables:
    """Episodes of L users, A antennas and K steps.

    Attributes
    ----------
    intensity:
        Intensity of each antenna's best beam at each step, (L, A, K + 1), in [0, 1].
    beam:
        Index of that beam, (L, A, K + 1).
    optimal:
        Sum over the steps 0..K, in their order, of the best antenna's intensity, (L,).
    """

    intensity: FloatArray
    beam: BeamArray
    optimal: FloatArray

    @classmethod
    def empty(cls, lanes: int, antennas: int, steps: int) -> Tables:
        """Return tables to be filled."""
        shape = (lanes, antennas, steps + 1)
        return cls(np.empty(shape), np.empty(shape, dtype=np.int8), np.empty(lanes))


class EpisodeGenerator:
    """Draws support points and tabulates episodes for given options."""

    def __init__(self, options: BeamOptions) -> None:
        self.options = options
        self.physics = physics.physics(options.physics)

    def draw(self, streams: list[np.random.Generator], counts: list[int]) -> FloatArray:
        """Draw support points of `counts[g]` episodes from stream g: (sum of counts, degree, 2)."""
        return trajectory.sample(streams, counts, self.options.degree, self.options.rejection)

    def support(self, raw_points: ArrayLike, lanes: int | None = None) -> FloatArray:
        """Check support points given by a user and return them, (degree, 2) or (lanes, degree, 2)."""
        points = np.array(raw_points, dtype=np.float64)
        shape = (self.options.degree, 2) if lanes is None else (lanes, self.options.degree, 2)
        if points.shape != shape:
            raise OptionError(f"support_points must have the shape {shape}, not {points.shape}")
        if not ((points >= 0.0) & (points <= FIELD)).all():
            raise OptionError("support_points must lie in the field [0, 6] x [0, 6]")
        if (np.ptp(points, axis=-2).max(axis=-1) == 0.0).any():
            raise OptionError("support_points must not all be the same point: the user has to move")
        return points

    def start(self, support: FloatArray) -> tuple[NDArray[np.int64], FloatArray, BeamArray]:
        """Return best antenna, its intensity and its beam at step 0 of each path, all (L,)."""
        x, y = support[:, 0, 0].copy(), support[:, 0, 1].copy()
        table = [physics.best_intensity(self.physics, x, y, antenna) for antenna in self.options.antennas]
        intensity = np.stack([row[0] for row in table])
        beam = np.stack([row[1] for row in table])
        antenna = intensity.argmax(axis=0)
        lanes = np.arange(len(support))
        return antenna, intensity[antenna, lanes], beam[antenna, lanes]

    def fill(self, tables: Tables, lanes: NDArray[np.intp], support: FloatArray) -> None:
        """Tabulate the episodes of paths (len(lanes), degree, 2) into the rows `lanes` of `tables`."""
        from qrlsuite.plugins.environments.beam6g import compiled

        own, antennas = self.physics, np.array(self.options.antennas).reshape(-1, 4)
        room = np.empty((4, min(len(lanes), _BLOCK), len(antennas), self.options.steps + 1))
        for first in range(0, len(lanes), _BLOCK):
            rows = lanes[first : first + _BLOCK]
            halves, r2, below, above = room[:, : len(rows)]
            x, y = trajectory.positions(support[first : first + _BLOCK], self.options.steps)
            compiled.aim(x, y, antennas, own.steps, own.best, own.phases, rows, halves, r2, tables.beam)
            np.sin(halves, out=below)  # numpy's, whose bits numba's need not be
            np.sin(np.multiply(halves, SENDERS, out=halves), out=above)
            compiled.tabulate(
                below, above, r2, float(SENDERS), own.fourth_power, own.peak, rows, tables.intensity, tables.optimal
            )  # fmt: skip

    def observation(
        self, antenna: NDArray[np.int64], intensity: FloatArray, beam: BeamArray
    ) -> NDArray[np.float32]:
        """Return observations (L, 3) float32 in [0, 1] of the last antenna, intensity and beam, all (L,)."""
        result = np.empty((len(antenna), 3), dtype=np.float32)
        result[:, 0] = antenna / (len(self.options.antennas) - 1)
        result[:, 1] = intensity
        result[:, 2] = beam / (BEAMS - 1)
        return result


def reset_options(options: dict[str, Any] | None) -> Any:
    """Return `support_points` of a reset's options, or None."""
    unknown = sorted(set(options or {}) - {"support_points"})
    if unknown:
        raise OptionError(f"unknown reset option '{unknown[0]}'; known: support_points")
    return (options or {}).get("support_points")
