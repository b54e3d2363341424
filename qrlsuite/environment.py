"""Lane environments: vector environments in which every lane has its own random stream.

Lanes are seed-major: with S seeds and E environments each, lane = s * E + e.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from qrlsuite.actions import check_actions
from qrlsuite.errors import OptionError, StoreError

if TYPE_CHECKING:
    from qrlsuite.device import DeviceLanes

State = dict[str, NDArray[Any]]
"""A checkpointed state: arrays whose first axis is the lane, without random streams (the core keeps those)."""


class LaneEnv(VectorEnv[Any, Any, Any]):
    """A `gymnasium.vector.VectorEnv` with same-step autoreset and given random streams.

    A subclass sets `num_envs`, `single_observation_space`, `single_action_space`, `observation_space` and
    `action_space`, and implements `reset`, `step`, `state_dict` and `load_state_dict`. `step` takes actions in the
    shape and type of their space, (num_envs,) int64 where it is discrete (`qrlsuite.actions`). It returns observations
    (num_envs, ...) float32, rewards (num_envs,) float64, terminated and truncated (num_envs,) bool, and infos: a time
    limit truncates, and learners estimate what would have followed (`arrived`). Where an episode ends, the lane is
    reset in the same step; then infos hold, as Gymnasium's same-step mode does, `final_obs` (num_envs, ...) with mask
    `_final_obs`, and `final_info`, a dict that may hold `score` (num_envs,) with mask `_score`. Infos may hold
    `action_mask` (num_envs, choices), 1 for each allowed action, several numbers' choices one after another; where a
    time limit ends an episode, `final_info` then holds the mask of the last observation.

    All randomness comes from `self.streams`: stream g serves the lanes `g*m .. (g+1)*m - 1`, m =
    num_envs / len(streams), in lane order, so that an episode never depends on lanes of another stream.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    streams: list[np.random.Generator]
    autoreset: bool = True
    """False in validation: an ended lane need not be reset; stepping it on is allowed and means nothing."""
    running_statistics: bool = False
    """True: agents standardize this environment's observations, see `qrlsuite.training.standardization`."""
    on_device: DeviceLanes | None = None
    """The same lanes as torch operations, where an algorithm may play its epochs by them; None: by `step` alone."""
    unflattened_space: gymnasium.Space[Any] | None = None
    """The space of observations before lanes flattened them, an image or a Dict; None: `single_observation_space`."""

    def seed_lanes(self, streams: Sequence[np.random.Generator]) -> None:
        """Replace the random streams; their number divides `num_envs`. Takes effect at the next reset."""
        if not streams or self.num_envs % len(streams):
            raise ValueError(f"{len(streams)} streams cannot serve {self.num_envs} lanes evenly")
        self.streams = list(streams)

    def seed_from(self, seed: int | None) -> None:
        """Give every lane a stream of its own, derived from one integer: Gymnasium's `reset(seed=...)`."""
        children = np.random.SeedSequence(seed).spawn(self.num_envs)
        self.seed_lanes([np.random.Generator(np.random.PCG64(child)) for child in children])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; `seed` is Gymnasium's, None continues the lanes' streams."""
        raise NotImplementedError

    def state_dict(self) -> State:
        """Return everything but the random streams that the rest of the episodes depends on, lane-first."""
        raise NotImplementedError

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a result of `state_dict`."""
        raise NotImplementedError


def batched_spaces(
    env: LaneEnv, observation: gymnasium.Space[Any], action: gymnasium.Space[Any], lanes: int
) -> None:
    """Set the number of lanes and the four spaces of a lane environment."""
    env.num_envs = lanes
    env.single_observation_space = observation
    env.single_action_space = action
    env.observation_space = gymnasium.vector.utils.batch_space(observation, lanes)
    env.action_space = gymnasium.vector.utils.batch_space(action, lanes)


def require_state(
    owner: str, state: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Refuse a state that lanes cannot continue from; `owner` is the environment's name.

    Raises
    ------
    qrlsuite.errors.StoreError
        If an array is missing, is one too many, or has another shape.
    """
    if set(state) != set(shapes):
        raise StoreError(f"{owner}: a state has {', '.join(sorted(shapes))}, not {', '.join(sorted(state))}")
    for name, shape in shapes.items():
        if state[name].shape != shape:
            raise StoreError(f"{owner}: '{name}' has the shape {state[name].shape}, not {shape}")


def endings(
    done: NDArray[np.bool_], observations: NDArray[np.float32], **final: NDArray[Any]
) -> dict[str, Any]:
    """Return the infos of a step in which the episodes of the lanes `done` (num_envs,) ended.

    Parameters
    ----------
    observations:
        (num_envs, ...), before any reset.
    final:
        Facts on an episode at its end, (num_envs,) by name, such as `score`.
    """
    ended = done.reshape(-1, *[1] * (observations.ndim - 1))
    known = {name: np.where(done, values, 0.0) for name, values in final.items()}
    return {
        "final_obs": np.where(ended, observations, np.float32(0.0)),
        "_final_obs": done.copy(),
        "final_info": known | {f"_{name}": done.copy() for name in final},
        "_final_info": done.copy(),
    }


class EpisodeLanes(LaneEnv):
    """Lanes of episodes of at most `options.steps` steps, with same-step autoreset; a base for environments.

    A subclass makes its arrays in `_arrays`, lane first, and defines the begin of episodes (`_draw`, `_begin`), the
    effect of an action (`_act`), observations (`_seen`) and the score of an ended episode (`_scores`). A lane whose
    episode ended does not change until it is reset.
    """

    name: ClassVar[str]
    cut: ClassVar[bool] = False
    """True: the last step truncates an episode. False: it terminates it, for it belongs to the task."""

    def __init__(
        self,
        options: Any,
        num_envs: int,
        observation: gymnasium.Space[Any],
        action: gymnasium.Space[Any],
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.options = options
        batched_spaces(self, observation, action, num_envs)
        self.streams = []
        self.step_count = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._begun = False

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the task's state by name, lane first: the arrays themselves."""
        raise NotImplementedError

    def _draw(self, stream: np.random.Generator, count: int) -> Any:
        """Draw the begin of `count` episodes: an array with that first axis."""
        raise NotImplementedError

    def _begin(self, lanes: NDArray[np.intp], drawn: Any) -> None:
        """Put `lanes` at the beginning of episodes, with their draws."""
        raise NotImplementedError

    def _act(
        self, actions: NDArray[Any], running: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Change the lanes that run; return rewards, and whether an episode ends before its last step, (L,) each."""
        raise NotImplementedError

    def _seen(self) -> NDArray[np.float32]:
        """Return every lane's observation, a new array."""
        raise NotImplementedError

    def _scores(self) -> NDArray[np.float64]:
        """Return the score of each lane's episode if it ends now, (L,) in [0, 1]."""
        raise NotImplementedError

    def _metrics(self) -> dict[str, NDArray[np.float64]]:
        """Return further metrics at an episode's end, (L,) by name."""
        return {}

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        """Return whether arrays of the right shapes are a state, or raise a `StoreError` that says why not."""
        return True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; returns observations (L, n) and an empty dictionary.

        Raises
        ------
        qrlsuite.errors.OptionError
            If `options` are given: there are none.
        """
        if options:
            raise OptionError(f"environment '{self.name}': reset() takes no option, not {sorted(options)}")
        if seed is not None or not self.streams:
            self.seed_from(seed)
        self._restart(np.arange(self.num_envs))
        self._begun = True
        return self._seen(), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Take a step in every lane.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If there was no reset.
        gymnasium.error.InvalidAction
            If an action is none of the space.
        """
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions)
        check_actions(actions, self.num_envs, self.single_action_space)
        running = ~self._ended
        self.step_count += running
        rewards, ends = self._act(actions, running)
        last = (self.step_count >= self.options.steps) & running
        terminated = ends & running if self.cut else (ends & running) | last
        truncated = last & ~terminated
        seen, done = self._seen(), terminated | truncated
        infos: dict[str, Any] = {}
        if done.any():
            infos = endings(done, seen, score=self._scores())
            if metrics := self._metrics():
                infos["final_info"]["metrics"] = {
                    name: np.where(done, values, np.nan) for name, values in metrics.items()
                }
            self._ended |= done
            if self.autoreset:
                self._restart(np.flatnonzero(done))
                seen = self._seen()
        return seen, np.where(running, rewards, 0.0), terminated, truncated, infos

    def state_dict(self) -> State:
        """Return the episodes' state, lane-first.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If there was no reset.
        """
        if not self._begun:
            raise ResetNeeded("call reset() before state_dict()")
        return {name: value.copy() for name, value in self._state().items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue where `state_dict` was taken; states may be sliced and concatenated along the lanes.

        Raises
        ------
        qrlsuite.errors.StoreError
            If an array is missing, has another shape, or holds an impossible value; nothing is changed then.
        """
        known = self._state()
        require_state(self.name, state, {name: value.shape for name, value in known.items()})
        steps = state["step"]
        if steps.min() < 0 or steps.max() > self.options.steps or not self._possible(state):
            raise StoreError(f"{self.name}: the state is none of an episode of {self.options.steps} steps")
        for name, value in known.items():
            value[...] = state[name]
        self._begun = True

    def _state(self) -> dict[str, NDArray[Any]]:
        return {**self._arrays(), "step": self.step_count, "ended": self._ended}

    def _restart(self, lanes: NDArray[np.intp]) -> None:
        """Begin new episodes in `lanes` (ascending), each from its lane's stream."""
        owners, counts = np.unique(lanes // (self.num_envs // len(self.streams)), return_counts=True)
        pairs = zip(owners.tolist(), counts.tolist())
        self._begin(lanes, np.concatenate([self._draw(self.streams[owner], n) for owner, n in pairs]))
        self.step_count[lanes] = 0
        self._ended[lanes] = False


class OneLane(gymnasium.Env[Any, Any]):
    """One lane of a `LaneEnv` as a `gymnasium.Env`, so that an environment is written once, for both forms.

    With a generator for its stream, a lane plays the same episodes.

    Parameters
    ----------
    lanes:
        With one lane. Flat observations have the shape of `unflattened_space` here, where there is one.

    Raises
    ------
    ValueError
        If there are several lanes.
    """

    metadata = {"render_modes": []}

    def __init__(self, lanes: LaneEnv) -> None:
        if lanes.num_envs != 1:
            raise ValueError(f"one lane, not {lanes.num_envs}")
        self.lanes = lanes
        self.lanes.autoreset = False
        flat = lanes.single_observation_space
        self.observation_space = flat if lanes.unflattened_space is None else lanes.unflattened_space
        self.action_space = lanes.single_action_space
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.lanes.seed_lanes([self.np_random])
        observations, _ = self.lanes.reset(options=options)
        self._running = True
        return self._shown(observations), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take a step.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If no episode is running.
        gymnasium.error.InvalidAction
            If the action is none of the space.
        """
        if not self._running:
            raise ResetNeeded("call reset() before step(): no episode is running")
        observations, rewards, terminated, truncated, infos = self.lanes.step(np.asarray(action)[None])
        self._running = not (terminated[0] or truncated[0])
        final = dict(infos.get("final_info", {}))
        metrics = {name: float(values[0]) for name, values in final.pop("metrics", {}).items()}
        info: dict[str, Any] = {n: float(v[0]) for n, v in final.items() if not n.startswith("_")}
        if metrics:
            info["metrics"] = metrics
        return self._shown(observations), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def _shown(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        shown: NDArray[np.float32] = observations[0].reshape(self.observation_space.shape or ())
        return shown


Lanes = TypeVar("Lanes", bound=LaneEnv)


def require_lanes(envs: LaneEnv, lanes: type[Lanes]) -> Lanes:
    """Return `envs` as the lanes that a reference policy looks into.

    Raises
    ------
    TypeError
        If they are other lanes.
    """
    if not isinstance(envs, lanes):
        raise TypeError(f"the policy needs {lanes.__name__}, not {type(envs).__name__}")
    return envs


def arrived(observations: NDArray[Any], infos: Mapping[str, Any]) -> NDArray[Any]:
    """Return each lane's observation after a step, before any reset, from `LaneEnv.step`'s results; (num_envs, ...)."""
    if "final_obs" not in infos:
        return observations
    ended = np.asarray(infos["_final_obs"], dtype=np.bool_)
    final = np.asarray(infos["final_obs"], dtype=observations.dtype)
    return np.where(ended.reshape(-1, *[1] * (observations.ndim - 1)), final, observations)
