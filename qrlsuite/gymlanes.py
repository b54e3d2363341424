"""Runs any Gymnasium environment in lanes, for environments that have no vector form.

The state of an arbitrary environment cannot be copied. But an episode is fixed by the seed of its reset and by
its actions, so a checkpoint holds these, and resuming plays them again.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from qrlsuite import actions as action_spaces
from qrlsuite import registry, specs
from qrlsuite.actions import check_actions
from qrlsuite.environment import LaneEnv, State, batched_spaces, require_state
from qrlsuite.errors import EnvironmentFailure, OptionError, StoreError
from qrlsuite.normalization import Kind, Normalization

UNLIMITED = 10_000
"""The longest episode, in steps, of an environment that states no time limit: longer ones are an error."""
SEEDS = 2**31
"""Reset seeds are drawn uniformly from 0 .. SEEDS - 1."""
QUICK_STEPS = 1000
"""The time limit of `--task gym:ID` where Gymnasium knows none."""


class GymLanes(LaneEnv):
    """Single environments side by side, with same-step autoreset and one random stream per group of lanes.

    At every reset, a lane draws one integer from its stream and seeds its environment with it: whatever is
    random in the episode comes from there. Observations are flattened as `gymnasium.spaces.flatten` does it,
    so discrete ones are one-hot, and the parts of a Dict or Tuple follow each other in its order. Actions have the
    shape and type of their space, see `qrlsuite.actions`. At an episode's end `infos["final_info"]` holds `score` (L,)
    where the environment's `info` does, and `metrics`, (L,) by name, where that is a dict of numbers. Where `info`
    holds an `action_mask` (choices,), 1 for allowed choices, `infos["action_mask"]` has the masks of the returned
    observations (L, choices), and at an episode's end `infos["final_info"]` the mask of the last one.

    Without autoreset, a lane whose episode has ended stays where it is: its steps return the last observation,
    reward 0, and neither termination nor truncation.

    Parameters
    ----------
    env_id:
        An id for `gymnasium.make`, `"module:Name-v0"` included.
    num_envs:
        Number of lanes L, at least 1.
    arguments:
        Keyword arguments of `gymnasium.make`.
    normalization, low, high:
        See `qrlsuite.normalization.Normalization`; for boxes, and a Dict or Tuple, only.
    observe:
        Places of the flattened values that are shown, in this order; None shows all.

    Raises
    ------
    qrlsuite.errors.OptionError
        If there is no such environment, a package that it needs is missing, it refuses its arguments, or its
        actions or observations are not supported.
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        arguments: Mapping[str, Any] | None = None,
        normalization: Kind = "none",
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        observe: Sequence[int] | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.env_id = env_id
        keywords = dict(arguments or {})
        first = make(env_id, keywords)
        self._action_space, self._raw_space, flat = _supported(env_id, first)
        self._shown = None if observe is None else _places(env_id, observe, flat)
        if self._shown is not None:
            flat = spaces.Box(flat.low[self._shown], flat.high[self._shown], dtype=np.float32)
        if normalization != "none" and not isinstance(
            self._raw_space, spaces.Box | spaces.Dict | spaces.Tuple
        ):
            raise OptionError(
                f"environment '{env_id}': normalization = '{normalization}' is for boxes, "
                f"and its observations are {self._raw_space}"
            )
        self._normalize = Normalization(normalization, flat, low, high, f"environment '{env_id}'")
        self.running_statistics = normalization == "running"
        self.envs = [first, *(make(env_id, keywords) for _ in range(num_envs - 1))]
        batched_spaces(self, self._normalize.space, action_spaces.from_zero(self._action_space), num_envs)
        self.unflattened_space = self._raw_space if observe is None else None
        if normalization != "none" and observe is None and isinstance(self._raw_space, spaces.Box):
            ends = self._normalize.space.low, self._normalize.space.high
            bottom, top = (end.reshape(self._raw_space.shape) for end in ends)
            self.unflattened_space = spaces.Box(bottom, top, dtype=np.float32)
        limit = first.spec.max_episode_steps if first.spec is not None else None
        self.capacity = int(limit or UNLIMITED)
        self.streams = []
        self._seeds = np.zeros(num_envs, dtype=np.int64)
        self._actions = _no_actions(self.single_action_space, num_envs, self.capacity)
        self._masks: dict[int, NDArray[Any]] = {}
        self._step = np.zeros(num_envs, dtype=np.int64)
        self._raw = np.zeros((num_envs, *flat.shape), dtype=np.float32)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; returns observations (L, n), and infos with masks, if there are any.

        Raises
        ------
        qrlsuite.errors.OptionError
            If `options` are given: they would be lost in a checkpoint.
        """
        if options:
            raise OptionError(
                f"environment '{self.env_id}' in lanes takes no options of reset(), not {options}: "
                "give arguments of gymnasium.make instead"
            )
        if seed is not None or not self.streams:
            self.seed_from(seed)
        self._begun = True
        for lane in range(self.num_envs):
            self._begin(lane)
        return self._observations(), self._mask_info()

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Take `actions` (L, ...) in all lanes.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If there was no reset.
        gymnasium.error.InvalidAction
            If an action is not one of the space.
        qrlsuite.errors.EnvironmentFailure
            If an episode without a time limit gets too long to be checkpointed.
        """
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions)
        check_actions(actions, self.num_envs, self.single_action_space)
        rewards = np.zeros(self.num_envs)
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        last: dict[int, dict[str, Any]] = {}
        running = np.flatnonzero(~self._ended)
        self._record(running, actions[running])
        for lane, action in zip(running.tolist(), actions[running]):
            rewards[lane], terminated[lane], truncated[lane], info = self._play(lane, action)
            if terminated[lane] or truncated[lane]:
                last[lane] = info
        infos = self._finish(last, terminated | truncated) if last else {}
        infos |= self._mask_info()
        return self._observations(), rewards, terminated, truncated, infos

    def state_dict(self) -> State:
        """Return the episodes so far, lane-first.

        `seed` (L,) of the last reset, `actions` (L, capacity, ...) since then, -1 (of a box NaN) where there is none
        yet, and `observation` (L, n) as it came from the environment.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If there was no reset.
        """
        if not self._begun:
            raise ResetNeeded("call reset() before state_dict()")
        return {
            "seed": self._seeds.copy(),
            "actions": self._actions.copy(),
            "observation": self._raw.copy(),
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Play the episodes of `state_dict` again; states may be sliced and joined along the lanes.

        Raises
        ------
        qrlsuite.errors.StoreError
            If an array is missing or has another shape, or an environment does not repeat its steps.
        """
        shapes = {"seed": (self.num_envs,), "actions": self._actions.shape, "observation": self._raw.shape}
        require_state(f"environment '{self.env_id}'", state, shapes)
        for lane in range(self.num_envs):
            try:
                self._replay(lane, int(state["seed"][lane]), state["actions"][lane])
            except Exception as error:  # whatever a stranger's environment raises is the user's to read
                raise StoreError(
                    f"environment '{self.env_id}' cannot be resumed: {type(error).__name__}: {error}"
                ) from error
            if not np.array_equal(self._raw[lane], state["observation"][lane], equal_nan=True):
                raise StoreError(
                    f"environment '{self.env_id}' cannot be resumed: the same reset seed and actions give "
                    "other results, so some of its randomness does not come from reset(seed=...)"
                )
        self._begun = True

    def _replay(self, lane: int, seed: int, actions: NDArray[Any]) -> None:
        """Play one lane's episode again, from its reset seed and its actions (capacity, ...)."""
        self._begin(lane, seed)
        first = actions.reshape(self.capacity, -1)[:, 0]
        for action in actions[
            : np.count_nonzero(first >= 0 if first.dtype.kind == "i" else ~np.isnan(first))
        ]:
            self._record(np.array([lane]), np.array([action]))
            _, terminated, truncated, _ = self._play(lane, action)
            self._ended[lane] = terminated or truncated

    def close_extras(self, **kwargs: Any) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()

    def _begin(self, lane: int, seed: int | None = None) -> None:
        """Reset one lane with a seed from its stream, unless one is given."""
        if seed is None:
            stream = self.streams[lane // (self.num_envs // len(self.streams))]
            seed = int(stream.integers(SEEDS))
        observation, info = self.envs[lane].reset(seed=seed)
        self._see_mask(lane, info)
        self._seeds[lane] = seed
        self._actions[lane] = -1 if self._actions.dtype.kind == "i" else np.nan
        self._step[lane] = 0
        self._ended[lane] = False
        self._raw[lane] = self._flat(observation)

    def _record(self, lanes: NDArray[np.intp], actions: NDArray[Any]) -> None:
        """Note the actions (n, ...) that the lanes (n,) are about to take."""
        steps = self._step[lanes]
        if steps.size and steps.max() == self.capacity:
            raise EnvironmentFailure(
                f"environment '{self.env_id}': an episode did not end within {self.capacity} steps; "
                "give it a time limit (max_episode_steps)"
            )
        self._actions[lanes, steps] = actions
        self._step[lanes] += 1

    def _play(self, lane: int, action: Any) -> tuple[float, bool, bool, dict[str, Any]]:
        """Take one step in one lane; returns reward, termination, truncation and info."""
        space = self._action_space
        if isinstance(space, spaces.Discrete):
            env_action: Any = np.int64(int(action) + int(space.start))
        elif isinstance(space, spaces.MultiDiscrete):
            env_action = (action.astype(np.int64) + space.start).astype(space.dtype)
        else:
            env_action = np.array(action, dtype=space.dtype)  # a copy, which the environment may change
        observation, reward, terminated, truncated, info = self.envs[lane].step(env_action)
        self._raw[lane] = self._flat(observation)
        self._see_mask(lane, info)
        return float(reward), bool(terminated), bool(truncated), info

    def _see_mask(self, lane: int, info: Mapping[str, Any]) -> None:
        """Keep the mask of a lane's observation, if it has one."""
        if "action_mask" in info:
            self._masks[lane] = np.array(info["action_mask"])

    def _mask_info(self) -> dict[str, Any]:
        """Return the masks of all lanes (L, choices) for infos; nothing where the environment has none."""
        if not self._masks:
            return {}
        masks = np.stack([self._masks[lane] for lane in range(self.num_envs)])
        masks[self._ended] = 1  # what is chosen there means nothing
        return {"action_mask": masks}

    def _finish(self, last: Mapping[int, dict[str, Any]], done: NDArray[np.bool_]) -> dict[str, Any]:
        """Report the episodes that have ended (`last`: their infos by lane), and begin the next ones."""
        infos: dict[str, Any] = {
            "final_obs": np.where(done[:, None], self._observations(), np.float32(0.0)),
            "_final_obs": done.copy(),
            "final_info": {},
            "_final_info": done.copy(),
        }
        measured = {name for info in last.values() for name in info.get("metrics", {})}
        if measured:
            infos["final_info"]["metrics"] = {
                name: np.full(self.num_envs, np.nan) for name in sorted(measured)
            }
            for lane, info in last.items():
                for name, value in info.get("metrics", {}).items():
                    infos["final_info"]["metrics"][name][lane] = value
        if self._masks:
            infos["final_info"] |= self._mask_info()
        scored = {lane: info["score"] for lane, info in last.items() if "score" in info}
        if scored:
            score = np.full(self.num_envs, np.nan)
            score[list(scored)] = list(scored.values())
            present = np.zeros(self.num_envs, dtype=np.bool_)
            present[list(scored)] = True
            infos["final_info"] |= {"score": score, "_score": present}
        self._ended |= done
        if self.autoreset:
            for lane in last:
                self._begin(lane)
        return infos

    def _flat(self, observation: Any) -> NDArray[Any]:
        """Return one observation as (n,)."""
        if isinstance(self._raw_space, spaces.Box):  # nearly always, and six times faster
            flat = np.asarray(observation, dtype=np.float32).reshape(-1)
        else:
            flat = np.asarray(spaces.flatten(self._raw_space, observation))
        return flat if self._shown is None else flat[self._shown]

    def _observations(self) -> NDArray[np.float32]:
        """Return the normalized observations (L, n), a new array."""
        return self._normalize(self._raw.copy())


def _places(env_id: str, observe: Sequence[int], flat: spaces.Box) -> NDArray[np.int64]:
    places = np.array(observe, dtype=np.int64)
    size = int(np.prod(flat.shape))
    if not places.size or len(set(observe)) < len(observe) or places.min() < 0 or places.max() >= size:
        raise OptionError(
            f"environment '{env_id}': observe = {[*observe]} must name places among the {size} values of an "
            f"observation, 0 to {size - 1}, each once"
        )
    return places


def _no_actions(space: spaces.Space[Any], lanes: int, capacity: int) -> NDArray[Any]:
    """Return an array (lanes, capacity, ...) for actions, of the smallest type, in which there is none yet."""
    _, high = action_spaces.limits(space)
    shape = (lanes, capacity, *(space.shape or ()))
    if high.dtype.kind == "f":
        return np.full(shape, np.nan, dtype=high.dtype)
    return np.full(shape, -1, dtype=np.min_scalar_type(-int(np.max(high)) - 1))  # a signed type: -1 is none


def specification(env_id: str) -> gymnasium.envs.registration.EnvSpec:
    """Return Gymnasium's spec of an id; for `"module:Name-v0"` the module is imported first.

    Raises
    ------
    qrlsuite.errors.OptionError
        If the module cannot be imported, or the id is unknown: with the nearest known one.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except Exception as error:  # whatever a stranger's module raises is the user's to read
            raise OptionError(
                f"environment '{env_id}': module '{module}' cannot be imported: {type(error).__name__}: {error}"
            ) from error
    known = gymnasium.registry.get(name)
    if known is None:
        close = difflib.get_close_matches(name, gymnasium.registry, n=1, cutoff=0.5)
        hint = f"did you mean '{close[0]}'?" if close else "gymnasium.pprint_registry() lists what it knows"
        raise OptionError(
            f"Gymnasium knows no environment '{name}'; {hint} (one of another package: MODULE:{name or 'ID'})"
        )
    return known


def make(env_id: str, arguments: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Make one environment; Gymnasium's checks of every step are left out, for they cost more than the step.

    Raises
    ------
    qrlsuite.errors.OptionError
        If there is no such environment, a package that it needs is missing, or it refuses its arguments.
    """
    specification(env_id)
    try:
        return gymnasium.make(env_id, disable_env_checker=True, **arguments)
    except DependencyNotInstalled as error:
        box2d = "box2d" in str(error).lower()
        advice = "pip install 'gymnasium[box2d]'" if box2d else str(error)
        lacks = " needs Box2D, which is not installed" if box2d else ""
        raise OptionError(f"environment '{env_id}'{lacks}: {advice}") from error
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        raise OptionError(
            f"environment '{env_id}' needs a package that is not installed: pip install {package}"
        ) from error
    except Exception as error:
        with_arguments = f" with {dict(arguments)}" if arguments else ""
        raise OptionError(
            f"environment '{env_id}' cannot be made{with_arguments}: {type(error).__name__}: {error}"
        ) from error


def _supported(
    env_id: str, env: gymnasium.Env[Any, Any]
) -> tuple[spaces.Space[Any], spaces.Space[Any], spaces.Box]:
    """Return an environment's action space, observation space, and the latter's flat box."""
    action, observation = env.action_space, env.observation_space
    try:
        action_spaces.kind(action)
    except OptionError as error:
        raise OptionError(f"environment '{env_id}': {error}") from None
    if not observation.is_np_flattenable:
        raise OptionError(
            f"environment '{env_id}' has the observation space {observation}, which has no fixed number of values: "
            "wrap it with gymnasium.wrappers.TransformObservation"
        )
    flat: Any = spaces.flatten_space(observation)
    limits = np.stack([flat.low, flat.high]).astype(np.float32)
    return action, observation, spaces.Box(limits[0], limits[1], dtype=np.float32)


def quick_task(env_id: str, name: str | None = None) -> dict[str, Any]:
    """Return a task file's content for a quick look at a Gymnasium environment, `--task gym:ID`.

    20 seeds, 100 epochs of 1000 steps in 10 environments, 20 validation episodes. Thresholds on the return are
    derived from the `reward_threshold` T at which Gymnasium counts the environment as solved: T - |T|,
    T - |T|/2, T - |T|/4 and T, the last one shown first. Where Gymnasium knows none, the one threshold is 0:
    a task file is needed to define a good return. A threshold that random actions reach in each of 10 episodes
    tells nothing apart, and is left out; where none is left, the highest of these returns is the threshold. The
    summary says so. Without a time limit, episodes are cut at 1000 steps. Algorithms have their `starting_values`.

    Parameters
    ----------
    name:
        Name of a registered environment with that id, if the task is to use it with all its options and be named after
        it; its own time limit then holds.

    Raises
    ------
    qrlsuite.errors.OptionError
        If the environment cannot be made, the algorithms cannot act or observe in it, or every episode of random
        actions has the same return and reaches all thresholds.
    """
    known = specification(env_id)
    options: dict[str, Any] = {"id": env_id}
    if known.max_episode_steps is None and name is None:
        options["max_episode_steps"] = QUICK_STEPS
    envs = GymLanes(env_id, 1)
    envs.close()
    kind = action_spaces.kind(envs.single_action_space)
    solved = known.reward_threshold
    derived = [0.0]
    if solved is not None:
        derived = sorted({float(solved - abs(solved) * part) for part in (1, 0.5, 0.25, 0)})
    lowest, highest = random_returns(env_id, options.get("max_episode_steps"))
    thresholds = [level for level in derived if level > lowest]
    what = f"{env_id} of Gymnasium" if name is None else f"environment '{name}'"
    summary = f"{what}, for a quick look"
    if not thresholds:
        if highest == lowest:
            raise OptionError(
                f"{name or f'gym:{env_id}'}: random actions always have the return {lowest:g}, which reaches every "
                "known threshold (0, or Gymnasium's own): write a task file with thresholds on the return"
            )
        thresholds = [highest]
        summary += (
            f"; no known scores, so the only threshold is the best of 10 random episodes ({highest:g}): for a real "
            "comparison, write a task file"
        )
    elif len(thresholds) < len(derived):
        reached = ", ".join(f"{level:g}" for level in derived if level <= lowest)
        summary += f"; without threshold {reached}, because random actions always reach it"
    return {
        "format_version": 1,
        "name": name or quick_name(env_id),
        "summary": summary,
        **({} if kind == "discrete" else {"default_algorithm": _algorithm(kind)}),
        "environment": {"name": "gym", "options": options} if name is None else {"name": name},
        "protocol": {
            "seeds": 20,
            "epochs": 100,
            "environments": 10,
            "interactions": 1000,
            "validation_episodes": 20,
        },
        "score": {"source": "return"},
        "ranking": {
            "thresholds": thresholds,
            "deltas": [0.5, 0.75],
            "reference": {"threshold": thresholds[-1], "delta": 0.5},
            "horizons": [100_000],
        },
        **({"presets": {"default": presets}} if (presets := _starting_values(kind)) else {}),
    }


def _starting_values(kind: str) -> dict[str, Any]:
    """Return the starting values of the algorithms that take actions of a kind, as a preset."""
    algorithms = (each.spec for each in registry.load().of(specs.AlgorithmSpec).values())
    fitting = (each for each in algorithms if kind in each.actions and each.starting_values)
    return {each.name: {"all": dict(each.starting_values)} for each in fitting}


def _algorithm(kind: str) -> str:
    """Return the first registered algorithm that takes actions of a kind; any where none does, and training says so."""
    registered = registry.load()
    names = registered.names(specs.AlgorithmSpec)
    return next((name for name in names if kind in registry.get(specs.AlgorithmSpec, name).actions), names[0])


@functools.cache
def random_returns(env_id: str, limit: int | None) -> tuple[float, float]:
    """Return the lowest and the highest return of 10 episodes of random actions, always the same ones.

    Minus infinity if an episode fails or does not end within 1000 steps.
    """
    lanes = 10
    envs = GymLanes(env_id, lanes, {} if limit is None else {"max_episode_steps": limit})
    envs.autoreset = False
    envs.seed_from(0)
    stream = np.random.Generator(np.random.Philox(0))
    running, returns = np.ones(lanes, np.bool_), np.zeros(lanes)
    try:
        envs.reset()
        for _ in range(QUICK_STEPS):
            actions = action_spaces.draw(envs.single_action_space, stream, lanes)
            _, rewards, terminated, truncated, _ = envs.step(actions)
            returns[running] += rewards[running]
            running &= ~(terminated | truncated)
            if not running.any():
                return float(returns.min()), float(returns.max())
    except Exception:  # a stranger's environment, which training will name
        return -np.inf, -np.inf
    finally:
        envs.close()
    return -np.inf, -np.inf


def quick_name(env_id: str) -> str:
    """Return the task name of `--task gym:ID`: usable as a folder, `gym-acrobot-v1`."""
    parts = re.findall(r"[a-z0-9]+", env_id.lower())
    return "-".join(["gym", *parts])[:64].rstrip("-")
