"""BeamManagement6G in lanes: many episodes at once, one random stream per group of lanes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from numpy.typing import NDArray

from qrlsuite.environment import LaneEnv, State, batched_spaces, require_state
from qrlsuite.errors import StoreError
from qrlsuite.plugins.environments.beam6g import trajectory
from qrlsuite.plugins.environments.beam6g.episodes import EpisodeGenerator, Tables, reset_options
from qrlsuite.plugins.environments.beam6g.options import BeamOptions, parse
from qrlsuite.plugins.environments.beam6g.physics import BEAMS


class BeamLanes(LaneEnv):
    """Vector form of `BeamManagement6G` with same-step autoreset; see there for spaces and rewards.

    An episode's paths are tabulated for all lanes together, at the first step after a reset: the reset
    itself needs no more than the first support point. `reset(options={"support_points": ...})` takes (L,
    degree, 2). At an episode's end `infos["final_info"]` holds `score`, `received` and `optimal` (L,), each
    with its mask.

    Parameters
    ----------
    options:
        Options of the environment, common to all lanes.
    num_envs:
        Number of lanes L, at least 1.
    """

    def __init__(self, options: BeamOptions, num_envs: int) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.options = options
        observation, action = spaces(options)
        batched_spaces(self, observation, action, num_envs)
        self.streams = []
        self._simulator = EpisodeGenerator(options)
        self._lane = np.arange(num_envs)
        self._support: NDArray[np.float64] | None = None
        self._step = np.zeros(num_envs, dtype=np.int64)
        self._received = np.zeros(num_envs)
        self._observations = np.zeros((num_envs, 3 * options.stack), dtype=np.float32)
        self._tables: Tables | None = None
        self._pending = np.ones(num_envs, dtype=np.bool_)
        """Lanes whose tables are still to be computed."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; returns observations (L, 3 * stack) and an empty dictionary."""
        settings = reset_options(options)
        support = None if settings is None else self._simulator.support(settings, self.num_envs)
        if seed is not None or not self.streams:
            self.seed_from(seed)
        if self._support is None:
            self._support = np.empty((self.num_envs, self.options.degree, 2))
        self._begin(self._lane, support)
        return self._observations.copy(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Let antenna `actions` (L,) serve each lane's user at its next position."""
        from qrlsuite.plugins.environments.beam6g import compiled

        if self._support is None:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.dtype.kind not in "iu":
            raise InvalidAction(
                f"actions must be {self.num_envs} integers, not {actions.dtype} of shape {actions.shape}"
            )
        tables = self.tabulate()
        rewards, terminated = np.empty(self.num_envs), np.empty(self.num_envs, np.bool_)
        served = compiled.serve(
            np.ascontiguousarray(actions, np.int64), tables.intensity, tables.beam, BEAMS - 1, self._step,
            self._received, self._observations, rewards, terminated,
        )  # fmt: skip
        if not served:
            raise InvalidAction(
                f"actions must lie in 0..{len(self.options.antennas) - 1}, not {actions.min()}..{actions.max()}"
            )
        infos: dict[str, Any] = {}
        if terminated.any():
            infos = self._finish(tables, terminated)
        return self._observations.copy(), rewards, terminated, np.zeros_like(terminated), infos

    def state_dict(self) -> State:
        """Return the episodes' state, lane-first.

        `support_points` (L, degree, 2), `step` (L,), `received` (L,), `observations` (L, 3 * stack), whose
        last three values hold the last action. The tables are computed again when they are needed.
        """
        if self._support is None:
            raise ResetNeeded("call reset() before state_dict()")
        return {
            "support_points": self._support.copy(),
            "step": self._step.copy(),
            "received": self._received.copy(),
            "observations": self._observations.copy(),
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue where `state_dict` was taken; states may be sliced and joined along the lanes."""
        shapes = {
            "support_points": (self.num_envs, self.options.degree, 2),
            "step": (self.num_envs,),
            "received": (self.num_envs,),
            "observations": self._observations.shape,
        }
        require_state("beam6g", state, shapes)
        trajectory.require_inside("beam6g", state["support_points"])
        if state["step"].min() < 0 or state["step"].max() >= self.options.steps:
            raise StoreError(f"beam6g: 'step' must lie in 0..{self.options.steps - 1}")
        self._support = np.array(state["support_points"], dtype=np.float64)
        self._step = np.array(state["step"], dtype=np.int64)
        self._received = np.array(state["received"], dtype=np.float64)
        self._observations = np.array(state["observations"], dtype=np.float32)
        self._pending[:] = True

    def _begin(self, lanes: NDArray[np.intp], support: NDArray[np.float64] | None = None) -> None:
        """Put `lanes` (ascending) at the beginning of new episodes, drawn unless `support` is given."""
        assert self._support is not None  # the callers made it
        if support is None:
            per_stream = self.num_envs // len(self.streams)
            counts = np.bincount(lanes // per_stream, minlength=len(self.streams)).tolist()
            support = self._simulator.draw(self.streams, counts)
        self._support[lanes] = support
        antenna, intensity, beam = self._simulator.start(support)
        self._step[lanes] = 0
        self._received[lanes] = intensity
        first = self._simulator.observation(antenna, intensity, beam)
        self._observations[lanes] = np.tile(first, (1, self.options.stack))
        self._pending[lanes] = True

    def restart(self) -> None:
        """Begin the next episode in every lane."""
        self._begin(self._lane)

    @property
    def steps(self) -> NDArray[np.int64]:
        """Actions so far of every lane's episode (L,)."""
        return self._step.copy()

    @property
    def support_points(self) -> NDArray[np.float64]:
        """Support points of every lane's path (L, degree, 2)."""
        if self._support is None:
            raise ResetNeeded("call reset() before support_points")
        return self._support.copy()

    def tabulate(self) -> Tables:
        """Return the tables of all lanes; tables of newly begun episodes are computed now."""
        if self._support is None:
            raise ResetNeeded("call reset() before tabulate()")
        if self._tables is None:
            self._tables = Tables.empty(self.num_envs, len(self.options.antennas), self.options.steps)
        if self._pending.any():
            lanes = np.flatnonzero(self._pending)
            self._simulator.fill(self._tables, lanes, self._support[lanes])
            self._pending[:] = False
        return self._tables

    def _finish(self, tables: Tables, done: NDArray[np.bool_]) -> dict[str, Any]:
        """Report the episodes that end and, with `autoreset`, begin the next ones in their lanes."""
        final: dict[str, Any] = {}
        for name, values in (
            ("score", self._received / tables.optimal),
            ("received", self._received),
            ("optimal", tables.optimal),
        ):
            final[name] = np.where(done, values, 0.0)
            final[f"_{name}"] = done.copy()
        infos = {
            "final_obs": np.where(done[:, None], self._observations, np.float32(0.0)),
            "_final_obs": done.copy(),
            "final_info": final,
            "_final_info": done.copy(),
        }
        if self.autoreset:
            self._begin(np.flatnonzero(done))
        return infos


def spaces(options: BeamOptions) -> tuple[gymnasium.Space[NDArray[np.float32]], gymnasium.Space[np.int64]]:
    """Return the observation and the action space of one lane."""
    observation: Any = gymnasium.spaces.Box(0.0, 1.0, (3 * options.stack,), np.float32)
    return observation, gymnasium.spaces.Discrete(len(options.antennas))


def make_vector(options: BeamOptions, num_envs: int) -> LaneEnv:
    """Return the vector environment of `options` with `num_envs` lanes."""
    return BeamLanes(options, num_envs)


def make_vec(num_envs: int = 1, **kwargs: Any) -> LaneEnv:
    """Return the vector environment for `gymnasium.make_vec`; `kwargs` are fields of `BeamOptions`."""
    return BeamLanes(parse(kwargs), num_envs)
