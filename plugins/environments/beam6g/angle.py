"""BeamAngle: steer one antenna's beam after a moving user, by its angle: the environment `beam-angle`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator
from pydantic.dataclasses import dataclass

from qrlsuite.actions import check_actions
from qrlsuite.environment import (
    LaneEnv,
    State,
    batched_spaces,
    endings,
    require_lanes,
    require_state,
)
from qrlsuite.errors import StoreError
from qrlsuite.plugins.environments.beam6g import trajectory
from qrlsuite.plugins.environments.beam6g.options import checked
from qrlsuite.plugins.environments.beam6g.physics import Antenna, FloatArray, offsets, physics
from qrlsuite.plugins.environments.single import Single


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class AngleOptions:
    """Options of BeamAngle."""

    antenna: Annotated[
        Antenna,
        Field(description="((x, y), (d_x, d_y)): position in [0, 6] x [0, 6] and orientation, normalized"),
    ] = ((3.0, 0.0), (1.0, 0.0))
    degree: Annotated[int, Field(ge=2, le=32, description="number of support points of a trajectory")] = 3
    steps: Annotated[int, Field(ge=1, le=100_000, description="actions per episode, the horizon")] = 200
    turn: Annotated[
        float | None,
        Field(
            gt=0,
            le=3.2,
            description="most that a beam turns in a step, radians; absent: to any angle at once",
        ),
    ] = 0.2
    stack: Annotated[
        int, Field(ge=1, le=1000, description="number of last observations that make one, the oldest first")
    ] = 4

    @field_validator("antenna")
    @classmethod
    def _antenna(cls, antenna: Antenna) -> Antenna:
        return checked(0, antenna)


class BeamAngle(Single):
    """Steer the beam of one antenna after a moving user, knowing only angles and how well they served.

    ## Description

    A user walks through the field of `beam6g`, on paths of the same law. One antenna serves it, a phased array of N_s =
    17 senders along the unit vector d. The agent turns its beam, or chooses the direction theta of it, measured from d,
    at every step. It sees neither the field nor the user.

    The physics is from the paper, "Benchmarking Quantum Reinforcement Learning", appendix "6G Beam forming and RL
    environment". Its codebook is a list of angles theta_i with the phase gradients phi_i = pi cos(theta_i); here theta
    is any angle. For the offset (dx, dy) from the antenna to the user,

        I   = sin^2(N_s xi / 2) / (N_s^2 R^2 sin^2(xi / 2))      (final intensity; 1 / R^2 where xi = 0)
        xi  = k R . d / R - phi = u - phi,   u = pi (dx d_x + dy d_y) / R
        phi = pi cos(theta)                                      (the equation of the codebook's angles)
        R^2 = dx^2 + dy^2 + 1

    k is pi in units of the distance of two senders, and R is softened, as in `beam6g` with `physics = "text"`. The best
    angle is cos(theta) = u / pi, which always exists, and gives 1 / R^2. A beam serves within |xi| < 2 pi / N_s, about
    6 percent of the range of phi to either side; beyond, side lobes have a twentieth of its intensity or less.

    The paper's agents choose antennas, not angles: this environment is ours, from its equations.

    ## Action Space

    `Box(-turn, turn, (1,), float32)`: by how much theta changes, radians; it stays in 0 .. pi, for an array of senders
    in a line cannot tell theta from -theta. Without `turn`, `Box(0, pi, (1,), float32)`: theta itself.

    ## Observation Space

    `Box(0, 1, (2 * stack,), float32)`, the last angles and how they served; the oldest comes first.

    | Num | Observation                  | Unit                            |
    |-----|------------------------------|---------------------------------|
    | 0   | theta, divided by pi         | -                               |
    | 1   | received intensity           | that on the beam's peak at R = 1 |

    ## Rewards

    The intensity at the user's new position, in [0, 1].

    ## Starting State

    The user stands at the beginning of a random path, in the beam; this intensity counts in the score. The first
    observation is repeated.

    ## Episode End

    After `steps` actions the episode is *terminated*. `info["score"]` is then the sum of the received intensities over
    the sum of the best ones, over the steps 0 to `steps`, in [0, 1]. `info["metrics"]["angle-error"]` is the mean
    distance of the angle to the best one, radians.

    Arguments are the fields of `AngleOptions`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(AngleLanes, AngleOptions, options)


class AngleLanes(LaneEnv):
    """Vector form of `BeamAngle` with same-step autoreset; see there for spaces and rewards."""

    name = "beam-angle"

    def __init__(self, options: AngleOptions, num_envs: int) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.options = options
        observation = Box(0.0, 1.0, (2 * options.stack,), np.float32)
        low, high = (0.0, np.pi) if options.turn is None else (-options.turn, options.turn)
        batched_spaces(self, observation, Box(np.float32(low), np.float32(high), (1,), np.float32), num_envs)
        self.streams = []
        self._physics = physics("text")
        self._lane = np.arange(num_envs)
        self._support = np.zeros((num_envs, options.degree, 2))
        self._step = np.zeros(num_envs, np.int64)
        self._angle = np.zeros(num_envs)
        self._sums = np.zeros((num_envs, 2))
        """Received intensity, and distance to the best angle."""
        self._seen = np.zeros((num_envs, 2 * options.stack), np.float32)
        self._u = np.zeros((num_envs, options.steps + 1))
        self._r2 = np.ones((num_envs, options.steps + 1))
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; returns observations (L, 2 * stack) and an empty dictionary."""
        if seed is not None or not self.streams:
            self.seed_from(seed)
        self._begin(self._lane)
        self._begun = True
        return self._seen.copy(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Turn the beams by `actions` (L, 1), or point them there, radians."""
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions)
        check_actions(actions, self.num_envs, self.single_action_space)
        running = self._step < self.options.steps
        self._step += running
        angles = actions[:, 0].astype(np.float64)
        if self.options.turn is not None:
            angles = np.clip(self._angle + angles, 0.0, np.pi)
        self._angle[running] = angles[running]
        u, r2 = self._u[self._lane, self._step], self._r2[self._lane, self._step]
        rewards = self._physics.intensity(u, r2, np.pi * np.cos(angles)) * running
        error = np.abs(angles - np.arccos(u / np.pi)) * running
        self._sums += np.stack([rewards, error], axis=1)
        newest = np.stack([angles / np.pi, rewards], axis=1).astype(np.float32)
        self._seen[running] = np.concatenate([self._seen[:, 2:], newest], axis=1)[running]
        terminated = (self._step == self.options.steps) & running
        infos: dict[str, Any] = {}
        if terminated.any():
            best = np.cumsum(1.0 / self._r2, axis=1)[:, -1]  # in the order of the steps, as the received one
            infos = endings(terminated, self._seen, score=np.minimum(self._sums[:, 0] / best, 1.0))
            mean = self._sums[:, 1] / self.options.steps
            infos["final_info"]["metrics"] = {"angle-error": np.where(terminated, mean, np.nan)}
            if self.autoreset:
                self._begin(np.flatnonzero(terminated))
        return self._seen.copy(), rewards, terminated, np.zeros_like(terminated), infos

    def state_dict(self) -> State:
        """Return the episodes' state, lane-first.

        `support_points` (L, degree, 2), `step` and `angle` (L,), `sums` (L, 2) and `observations` (L, 2 * stack).
        """
        if not self._begun:
            raise ResetNeeded("call reset() before state_dict()")
        return {name: value.copy() for name, value in self._state().items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue where `state_dict` was taken; states may be sliced and joined along the lanes."""
        known = self._state()
        require_state(self.name, state, {name: value.shape for name, value in known.items()})
        trajectory.require_inside(self.name, state["support_points"])
        if state["step"].min() < 0 or state["step"].max() > self.options.steps:
            raise StoreError(f"{self.name}: 'step' must lie in 0..{self.options.steps}")
        for name, value in known.items():
            value[...] = state[name]
        self._tabulate(self._lane)
        self._begun = True

    def best_angles(self) -> FloatArray:
        """Return the best angles at the users' next positions (L,), radians."""
        following = np.minimum(self._step + 1, self.options.steps)
        angles: FloatArray = np.arccos(self._u[self._lane, following] / np.pi)
        return angles

    def _state(self) -> dict[str, NDArray[Any]]:
        return {
            "support_points": self._support,
            "step": self._step,
            "angle": self._angle,
            "sums": self._sums,
            "observations": self._seen,
        }

    def _begin(self, lanes: NDArray[np.intp]) -> None:
        """Put `lanes` (ascending) at the beginning of new episodes."""
        counts = np.bincount(lanes // (self.num_envs // len(self.streams)), minlength=len(self.streams))
        self._support[lanes] = trajectory.sample(self.streams, counts.tolist(), self.options.degree)
        self._tabulate(lanes)
        self._step[lanes] = 0
        self._angle[lanes] = np.arccos(self._u[lanes, 0] / np.pi)
        best = 1.0 / self._r2[lanes, 0]
        self._sums[lanes] = np.stack([best, np.zeros_like(best)], axis=1)
        first = np.stack([self._angle[lanes] / np.pi, best], axis=1)
        self._seen[lanes] = np.tile(first.astype(np.float32), (1, self.options.stack))

    def _tabulate(self, lanes: NDArray[np.intp]) -> None:
        """Compute u and R^2 along the paths of `lanes`."""
        x, y = trajectory.positions(self._support[lanes], self.options.steps)
        self._u[lanes], self._r2[lanes] = offsets(x, y, self.options.antenna)


class BestAngle:
    """The reference policy that knows where the user will be: a score of 1, where the beam turns fast enough."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, AngleLanes)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the turns to the best angles, or these (L, 1)."""
        space: Any = self.envs.single_action_space
        from_ = 0.0 if self.envs.options.turn is None else self.envs.state_dict()["angle"]
        actions = (self.envs.best_angles() - from_)[:, None].astype(np.float32)
        clipped: NDArray[np.float32] = np.clip(actions, space.low, space.high)
        return clipped


class SameAngle:
    """The reference policy that leaves the beam where the user was at first."""

    def __init__(self, envs: LaneEnv) -> None:
        self._low, self._high = envs.single_action_space.low, envs.single_action_space.high  # type: ignore[attr-defined]

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return no turn, or the last angles (L, 1)."""
        if self._low[0] < 0:
            return np.zeros((len(observations), 1), np.float32)
        angles: NDArray[np.float32] = np.clip(observations[:, -2:-1] * np.float32(np.pi), 0, self._high)
        return angles
