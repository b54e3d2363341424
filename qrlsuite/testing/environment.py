"""What an environment keeps to: a right Gymnasium environment, and lanes that live for themselves."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import qrlsuite
from qrlsuite import specs
from qrlsuite.environment import LaneEnv
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import SIZES, BrokenRuleError, Checklist, Finding, require

S, E = 5, 2
LONGEST = 10_000
"""Steps within which an episode must end."""
_STREAMS = (
    "draw from self.np_random in a gymnasium.Env, from self.streams in lanes, and from nothing global; set all state "
    "in reset()"
)


class Lanes:
    """Builds lanes of the environment that is checked, as a run does."""

    def __init__(self, subject: Subject) -> None:
        spec = subject.spec
        assert isinstance(spec, specs.EnvironmentSpec)
        self.spec, self.options = spec, subject.options()

    def make(self, seeds: Sequence[int], autoreset: bool = True) -> LaneEnv:
        """Return two lanes for each seed, with streams of their own."""
        lanes = len(seeds) * E
        if self.spec.vector is not None:
            envs: LaneEnv = specs.resolve(self.spec.vector)(self.options, lanes)
        else:
            from qrlsuite.gymlanes import GymLanes

            register(self.spec)
            envs = GymLanes(self.spec.gymnasium_id, lanes, dataclasses.asdict(self.options))
        envs.autoreset = autoreset
        envs.seed_lanes(
            [np.random.Generator(np.random.Philox(key=1000 * s + e)) for s in seeds for e in range(E)]
        )
        return envs


def register(spec: specs.EnvironmentSpec) -> None:
    """Make the environment known to Gymnasium, as the suite does with registered ones."""
    qrlsuite.register_environments()
    if spec.entry_point is not None and spec.gymnasium_id not in gymnasium.registry:
        gymnasium.register(spec.gymnasium_id, entry_point=spec.entry_point)


def actions(seeds: Sequence[int], choices: int, steps: int) -> NDArray[np.int64]:
    """Return every lane's actions (steps, 2 len(seeds)); those of a seed do not depend on the others."""
    columns = [
        np.random.Generator(np.random.Philox(key=77 + s)).integers(choices, size=(steps, E)) for s in seeds
    ]
    return np.concatenate(columns, axis=1).astype(np.int64)


def play(envs: LaneEnv, given: NDArray[np.int64], reset: bool = True) -> dict[str, NDArray[Any]]:
    """Return everything that lanes show under actions (T, L), lane-first."""
    seen: dict[str, list[NDArray[Any]]] = {
        "observations": [],
        "rewards": [],
        "terminated": [],
        "truncated": [],
    }
    if reset:
        seen["observations"].append(np.array(envs.reset()[0]))
    for row in given:
        observations, rewards, terminated, truncated, _ = envs.step(row)
        for values, value in zip(seen.values(), (observations, rewards, terminated, truncated)):
            values.append(np.array(value))
    return {name: np.stack(values, axis=1) for name, values in seen.items()}


def check(subject: Subject, deterministic: bool = False) -> list[Finding]:
    """Check an environment.

    Parameters
    ----------
    deterministic:
        Whether all episodes are meant to be alike, whatever the seed.
    """
    lanes = Lanes(subject)
    rules = Checklist()
    rules.run("gymnasium", "passes gymnasium.utils.env_checker.check_env", lambda: _gymnasium(lanes))
    cause = "options are handed to the environment as keyword arguments"
    if not rules.run(
        "spaces", "discrete actions, and boxes or numbers to observe", lambda: _spaces(lanes), cause
    ):
        return rules.findings
    if not rules.run(
        "shapes", "lanes first, of the right types, finite, in their space", lambda: _shapes(lanes)
    ):
        return rules.findings
    length: list[int] = []
    if not rules.run(
        "episodes end", f"within {LONGEST} steps, and begin anew", lambda: length.append(_end(lanes))
    ):
        return rules.findings
    steps = min(length[0] + 5, 300)
    rules.run("score", "in [0, 1] where info has one", lambda: _score(lanes, length[0]))
    rules.run("same seed", "the same streams and actions give the same bits", lambda: _same(lanes, steps))
    if not deterministic:
        rules.run("different seed", "other streams give other episodes", lambda: _different(lanes, steps))
    rules.run(
        "seed independence", "alone, in pairs, shuffled: the same bits", lambda: _independence(lanes, steps)
    )
    rules.run("state", "saved, sliced and restored exactly", lambda: _state(lanes, steps))
    rules.run(
        "validation",
        "without autoreset, lanes that ended can be stepped on",
        lambda: _validation(lanes, steps),
    )
    return rules.findings


def _gymnasium(lanes: Lanes) -> None:
    from gymnasium.utils.env_checker import check_env

    register(lanes.spec)
    keywords = (
        {} if lanes.spec.entry_point is None and lanes.spec.vector else dataclasses.asdict(lanes.options)
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            env = gymnasium.make(lanes.spec.gymnasium_id, disable_env_checker=True, **keywords)
        except Exception as error:
            raise BrokenRuleError(
                f"gymnasium.make('{lanes.spec.gymnasium_id}') fails: {type(error).__name__}: {error}; the options are "
                "its keyword arguments"
            ) from error
        try:
            check_env(env.unwrapped, skip_render_check=True)
        except Exception as error:
            raise BrokenRuleError(f"check_env: {type(error).__name__}: {error}") from error
        finally:
            env.close()
    ours = [str(w.message) for w in caught if "check_env" in str(w.message) or "WARN" in str(w.message)]
    serious = [
        text for text in ours if "should" in text and "not within" not in text and "recommend" not in text
    ]
    require(
        not serious or lanes.spec.entry_point is None, f"check_env warns: {serious[0] if serious else ''}"
    )


def _spaces(lanes: Lanes) -> None:
    envs = lanes.make([0])
    require(
        isinstance(envs.single_action_space, gymnasium.spaces.Discrete),
        f"actions are {envs.single_action_space}; the algorithms choose among discrete ones",
    )
    require(
        isinstance(envs.single_observation_space, gymnasium.spaces.Box),
        f"observations are {envs.single_observation_space}; networks need a Box",
    )


def _choices(envs: LaneEnv) -> int:
    return int(envs.single_action_space.n)  # type: ignore[attr-defined]


def _shapes(lanes: Lanes) -> None:
    envs = lanes.make(range(S))
    n = envs.num_envs
    require(n == S * E, f"asked for {S * E} lanes, num_envs is {n}")
    shape = (n, *(envs.single_observation_space.shape or ()))
    first, _ = envs.reset()
    row = actions(range(S), _choices(envs), 1)[0]
    after, rewards, terminated, truncated, infos = envs.step(row)
    for name, value, expected, dtype in (
        ("reset's observations", first, shape, np.float32),
        ("observations", after, shape, np.float32),
        ("rewards", rewards, (n,), np.float64),
        ("terminated", terminated, (n,), np.bool_),
        ("truncated", truncated, (n,), np.bool_),
    ):
        got = np.asarray(value)
        require(
            got.shape == expected and got.dtype == dtype,
            f"{name} are {got.dtype} of shape {got.shape}, and must be {np.dtype(dtype)} of shape {expected}",
        )
        require(bool(np.isfinite(got).all()), f"{name} are not finite")
    require(isinstance(infos, dict), f"infos are {type(infos).__name__}, and must be a dict")
    outside = [o for o in np.asarray(after) if not envs.single_observation_space.contains(o)]
    require(not outside, f"observation {outside[:1]} is outside {envs.single_observation_space}")
    kept = np.array(after)
    envs.step(row)
    require(
        np.array_equal(kept, after),
        "a step changes the observations that the step before returned: return a copy, for learners keep them",
    )


def _end(lanes: Lanes) -> int:
    """Return the length of the first episode that ends."""
    envs = lanes.make([0])
    envs.reset()
    rows = actions([0], _choices(envs), LONGEST)
    for step, row in enumerate(rows, start=1):
        after, _, terminated, truncated, infos = envs.step(row)
        done = terminated | truncated
        if not done.any():
            continue
        for key in ("final_obs", "_final_obs"):
            require(
                key in infos,
                f"an episode ended after {step} steps and infos have no '{key}': the last observation, before the "
                "reset in the same step, is what learners bootstrap from",
            )
        require(
            np.array_equal(np.asarray(infos["_final_obs"], dtype=bool), done),
            "the mask infos['_final_obs'] is not where episodes ended",
        )
        final = np.asarray(infos["final_obs"])
        require(final.shape == np.asarray(after).shape, f"infos['final_obs'] has shape {final.shape}")
        return step
    raise BrokenRuleError(
        f"no episode ended within {LONGEST} steps of random actions: give it a time limit (gymnasium.register("
        "max_episode_steps=...) or a step count of its own)"
    )


def _score(lanes: Lanes, length: int) -> None:
    envs = lanes.make([0])
    envs.reset()
    for row in actions([0], _choices(envs), length):
        _, _, terminated, truncated, infos = envs.step(row)
        done = terminated | truncated
        scores = infos.get("final_info", {}).get("score") if done.any() else None
        if scores is not None:
            mine = np.asarray(scores, dtype=np.float64)[done]
            require(
                bool(np.isfinite(mine).all() and (mine >= 0).all() and (mine <= 1 + 1e-9).all()),
                f"info['score'] at an episode's end is {mine[0]:.6g}, and must lie in [0, 1]: divide by the best "
                "possible, or leave it out and state max_return in the task file",
            )


def _differs(a: dict[str, NDArray[Any]], b: dict[str, NDArray[Any]]) -> str | None:
    return next((name for name, value in a.items() if not np.array_equal(value, b[name])), None)


def _same(lanes: Lanes, steps: int) -> None:
    first, second = (lanes.make([0, 1]) for _ in range(2))
    given = actions([0, 1], _choices(first), steps)
    name = _differs(play(first, given), play(second, given))
    require(name is None, f"the same streams and actions give other {name}: {_STREAMS}")
    first.seed_lanes([np.random.Generator(np.random.Philox(key=k)) for k in range(2 * E)])
    again = lanes.make([0, 1])
    again.seed_lanes([np.random.Generator(np.random.Philox(key=k)) for k in range(2 * E)])
    name = _differs(play(first, given), play(again, given))
    require(name is None, f"a used environment, reset, shows other {name} than a new one: {_STREAMS}")


def _different(lanes: Lanes, steps: int) -> None:
    envs, others = lanes.make([0]), lanes.make([5])
    given = actions([0], _choices(envs), steps)
    require(
        _differs(play(envs, given), play(others, given)) is not None,
        f"other streams give the same {steps} steps: {_STREAMS}; if all episodes are meant to be alike, check with "
        "deterministic=True",
    )


def _independence(lanes: Lanes, steps: int) -> None:
    envs = lanes.make(range(S))
    choices = _choices(envs)
    whole = play(envs, actions(range(S), choices, steps))
    for members in SIZES:
        part = play(lanes.make(members), actions(members, choices, steps))
        rows = [s * E + e for s in members for e in range(E)]
        name = _differs(part, {key: value[rows] for key, value in whole.items()})
        require(
            name is None,
            f"seeds {list(members)} among themselves see other {name} than among all {S}: a lane may depend on its own "
            f"stream and actions alone; {_STREAMS}",
        )


def _state(lanes: Lanes, steps: int) -> None:
    envs = lanes.make(range(S))
    given = actions(range(S), _choices(envs), 2 * steps)
    play(envs, given[: max(1, steps // 2)])
    state = {name: np.array(value) for name, value in envs.state_dict().items()}
    for name, value in state.items():
        require(
            value.ndim > 0 and value.shape[0] == S * E,
            f"state '{name}' of shape {value.shape} has no leading axis of {S * E} lanes: checkpoints are sliced",
        )
    from qrlsuite.seeding import pack, unpack

    streams = pack(envs.streams)
    expected = play(envs, given[steps:], reset=False)
    for members in (tuple(range(S)), (3,), (4, 1)):
        rows = [s * E + e for s in members for e in range(E)]
        other = lanes.make(members)
        other.reset()
        other.seed_lanes(unpack(streams[rows]))
        other.load_state_dict({name: value[rows].copy() for name, value in state.items()})
        got = play(other, given[steps:][:, rows], reset=False)
        lost = _differs(got, {key: value[rows] for key, value in expected.items()})
        require(
            lost is None,
            f"restored from state_dict() in the middle of an episode, seeds {list(members)} see other {lost}: "
            "something that the rest of the episode depends on is not in the state, or is shared between lanes",
        )


def _validation(lanes: Lanes, steps: int) -> None:
    envs = lanes.make([0], autoreset=False)
    envs.reset()
    over = np.zeros(envs.num_envs, dtype=bool)
    for row in actions([0], _choices(envs), LONGEST):
        _, _, terminated, truncated, _ = envs.step(row)
        over |= terminated | truncated
        if over.all():
            for _ in range(3):
                envs.step(row)
            return
