"""Reference policies, which know the user's next position; agents do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from qrlsuite.environment import LaneEnv, require_lanes
from qrlsuite.plugins.environments.beam6g import trajectory
from qrlsuite.plugins.environments.beam6g.vector import BeamLanes


class Optimal:
    """Serves the user by the antenna that is best at its next position: a score of 1 (paper: "ground truth")."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, BeamLanes)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the antennas (L,)."""
        intensity = self.envs.tabulate().intensity
        lanes = np.arange(self.envs.num_envs)
        best: NDArray[np.int64] = intensity[lanes, :, self.envs.steps + 1].argmax(axis=1).astype(np.int64)
        return best


class NearestAntenna:
    """Serves the user by the antenna that stands nearest to its next position, the first of equals.

    The antenna takes its own best beam, as with every policy. The paper calls the closest antenna sub-optimal
    (section "Performance of Trained Policies") and gives no numbers for it.
    """

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, BeamLanes)
        self._nearest = np.zeros((envs.num_envs, self.envs.options.steps + 1), dtype=np.int64)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the antennas (L,)."""
        steps = self.envs.steps
        begun = np.flatnonzero(steps == 0)
        if begun.size:
            self._nearest[begun] = self._table(self.envs.support_points[begun])
        chosen: NDArray[np.int64] = self._nearest[np.arange(len(steps)), steps + 1]
        return chosen

    def _table(self, support: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the nearest antenna at every step (n, K + 1) of paths (n, degree, 2)."""
        x, y = trajectory.positions(support, self.envs.options.steps)
        squared = [(x - a) ** 2 + (y - b) ** 2 for (a, b), _ in self.envs.options.antennas]
        nearest: NDArray[np.int64] = np.argmin(squared, axis=0).astype(np.int64)
        return nearest
