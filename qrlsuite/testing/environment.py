"""Rules of environments: Gymnasium's interface, and lanes that do not influence each other."""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from qrlsuite.actions import from_zero, kind
from qrlsuite.environment import LaneEnv
from qrlsuite.testing import reproducible
from qrlsuite.testing.common import Subject, check_cases
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, require
from qrlsuite.testing.lanes import LONGEST, Lanes, S, actions, register

HARMLESS = ("infinity", "recommend", "values are equal")
"""Words of warnings of `check_env` that concern taste, or learners other than the suite's."""
_SEEDING = ": is super().reset(seed=seed) called in reset, and every number drawn from self.np_random?"


def check(subject: Subject) -> list[Finding]:
    """Check an environment."""
    lanes = Lanes(subject)
    rules = Checklist()
    rules.run("gymnasium", "passes gymnasium.utils.env_checker.check_env", lambda: _gymnasium(lanes))
    cause = "in __init__, call qrlsuite.environment.batched_spaces(self, observation_space, action_space, num_envs)"
    if not rules.run(
        "spaces", "actions of a kind that is taken, and boxes to observe", lambda: _spaces(lanes), cause
    ):
        return rules.findings
    cause = "step takes (L, ...) actions and returns observations, rewards, terminated, truncated and infos"
    if not rules.run(
        "shapes", "lanes first, of the right types, finite, in their space", lambda: _shapes(lanes), cause
    ):
        return rules.findings
    length: list[int] = []
    if not rules.run(
        "episodes end", f"within {LONGEST} steps, and start over", lambda: length.append(_end(lanes))
    ):
        return rules.findings
    steps = min(length[0] + 5, 300)
    cause = "infos['final_info'] is a dict that may hold 'score' (L,) with its mask '_score'"
    rules.run("score", "in [0, 1] where info has one", lambda: _score(lanes, length[0]), cause)
    rules.run(
        "same seed",
        "the same streams and actions give the same bits",
        lambda: reproducible.same_seed(lanes, steps),
    )
    if not lanes.spec.repeats:
        rules.run(
            "different seed", "every lane meets its own episodes", lambda: reproducible.different_seed(lanes)
        )
    rules.run(
        "seed independence",
        "alone, in pairs, shuffled: the same bits",
        lambda: reproducible.seed_independence(lanes, steps),
    )
    cause = (
        "state_dict() gives arrays with the lane first; load_state_dict() takes them, or slices of them, in new lanes "
        "that were never reset"
    )
    rules.run("state", "saved, sliced and restored exactly", lambda: reproducible.state(lanes, steps), cause)
    cause = (
        "in validation a stream serves several lanes, lane l by self.streams[l * len(self.streams) // self.num_envs], "
        "and lanes whose episode ended are stepped on"
    )
    rules.run(
        "validation",
        "the same episodes, and ended lanes are stepped on",
        lambda: reproducible.validation(lanes),
        cause,
    )
    check_cases(rules, subject.choices(), lambda chosen: _works(Lanes(chosen)))
    return rules.findings


def _works(lanes: Lanes) -> None:
    lanes.make([0])  # a value may be refused in words
    _shapes(lanes)


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
            hint = _SEEDING if "deterministic" in str(error) else ""
            raise BrokenRuleError(
                f"check_env: {type(error).__name__}: {str(error).rstrip('.')}{hint}"
            ) from error
        finally:
            env.close()
    if lanes.spec.entry_point is None:  # Gymnasium's own, or another package's: not the plugin's to mend
        return
    texts = [re.sub(r"\x1b\[\d+m", "", str(warning.message)) for warning in caught]
    for text in texts:
        require(
            not text.startswith("WARN: ") or any(word in text for word in HARMLESS),
            f"check_env warns: {text.removeprefix('WARN: ')}",
        )


def _spaces(lanes: Lanes) -> None:
    envs = lanes.make([0])
    action, observation = envs.single_action_space, envs.single_observation_space
    kind(action)
    require(
        action == from_zero(action),
        f"actions are {action}; in lanes they count from 0: use {from_zero(action)}, and add start in step",
    )
    require(
        isinstance(observation, gymnasium.spaces.Box),
        f"observations are {observation}; networks need a gymnasium.spaces.Box",
    )


def _shapes(lanes: Lanes) -> None:
    envs = lanes.make(range(S))
    n = envs.num_envs
    shape = (n, *(envs.single_observation_space.shape or ()))
    before = envs.reset()[0]
    _array("reset's observations", before, shape, np.float32)
    for observation in before:
        _within(envs, observation, "reset")
    for step, row in enumerate(actions(range(S), envs.single_action_space, 50), start=1):
        kept = np.array(before)
        after, rewards, terminated, truncated, infos = envs.step(row)
        require(
            np.array_equal(kept, before),
            "a step changes the observations that were returned before it: return a copy, for learners keep them",
        )
        for name, value, expected, dtype in (
            ("observations", after, shape, np.float32),
            ("rewards", rewards, (n,), np.float64),
            ("terminated", terminated, (n,), np.bool_),
            ("truncated", truncated, (n,), np.bool_),
        ):
            _array(name, value, expected, dtype)
        require(
            isinstance(infos, dict),
            f"infos are {type(infos).__name__}, and must be a dict, empty where there is nothing to say",
        )
        for observation in after:
            _within(envs, observation, f"step {step}")
        before = after


def _array(name: str, value: Any, shape: tuple[int, ...], dtype: type) -> None:
    require(isinstance(value, np.ndarray), f"{name} are {type(value).__name__}, and must be a numpy array")
    require(
        value.shape == shape,
        f"{name} have shape {value.shape}, and must have {shape}: lanes come first, then what the space says",
    )
    expected = np.dtype(dtype)
    require(
        value.dtype == expected,
        f"{name} are {value.dtype}, and must be {expected}: convert with .astype(np.{expected})",
    )
    require(
        bool(np.isfinite(value).all()),
        f"{name} are not finite: is there a division by zero, or a logarithm of zero?",
    )


def _within(envs: LaneEnv, observation: NDArray[Any], when: str) -> None:
    space = envs.single_observation_space
    require(
        space.contains(observation),
        f"the observation {observation} of {when} is outside {space}: widen the space, or clip the observation",
    )


def _end(lanes: Lanes) -> int:
    """Return the length of the first episode that ends."""
    envs, unreset = lanes.make([0]), lanes.make([0], autoreset=False)
    alike = np.array_equal(envs.reset()[0], unreset.reset()[0])
    rows = iter(actions([0], envs.single_action_space, LONGEST + 5))
    for step in range(1, LONGEST + 1):
        row = next(rows)
        after, _, terminated, truncated, infos = envs.step(row)
        last = unreset.step(row)[0]
        done = terminated | truncated
        if not done.any():
            alike = alike and np.array_equal(after, last)
            continue
        _final(infos, done, after, last if alike else after, step)
        for _ in range(5):
            _, _, terminated, truncated, _ = envs.step(next(rows))
            done = done & (terminated | truncated)
        require(
            step == 1 or not done.any(),
            f"an episode ended after {step} steps, and again at each of the 5 steps after it: reset the lanes whose "
            "episode ends, in the same step",
        )
        return step
    raise BrokenRuleError(
        f"no episode ended within {LONGEST} steps of random actions: give it a time limit (gymnasium.register("
        "max_episode_steps=...) or a step count of its own)"
    )


def _final(
    infos: Mapping[str, Any], done: NDArray[np.bool_], after: NDArray[Any], last: NDArray[Any], step: int
) -> None:
    """Require that infos hold the last observation; `after` is the step's result, `last` the result in lanes without
    autoreset.
    """
    for key in ("final_obs", "_final_obs"):
        require(
            key in infos,
            f"an episode ended after {step} steps and infos have no '{key}': the last observation, before the "
            "reset in the same step, is what learners bootstrap from",
        )
    require(
        np.array_equal(infos["_final_obs"], done),
        f"infos['_final_obs'] is {infos['_final_obs']} where episodes ended as {done}: it is the mask "
        "terminated | truncated",
    )
    final = np.asarray(infos["final_obs"])
    require(
        final.shape == after.shape,
        f"infos['final_obs'] has shape {final.shape}, and must have that of observations, {after.shape}",
    )
    was_reset = np.array_equal(last[done], after[done])  # without autoreset, it need not be left out
    require(
        was_reset or np.array_equal(final[done], last[done]),
        f"an episode's last observation is {last[done][0]} without autoreset, and infos['final_obs'] holds "
        f"{final[done][0]}: copy the observations before the reset in the same step",
    )


def _score(lanes: Lanes, length: int) -> None:
    envs = lanes.make(range(S))
    envs.reset()
    scored: list[bool] = []
    for row in actions(range(S), envs.single_action_space, min(4 * length, LONGEST)):
        _, _, terminated, truncated, infos = envs.step(row)
        done = terminated | truncated
        if not done.any():
            continue
        scores = infos.get("final_info", {}).get("score")
        scored.append(scores is not None)
        require(
            len(set(scored)) == 1,
            "some episodes end with info['score'] and some without: set it at every end, truncated ones too, or never",
        )
        if scores is None:
            continue
        require(
            np.shape(scores) == done.shape,
            f"infos['final_info']['score'] has shape {np.shape(scores)}, and must have one number per lane, "
            f"{done.shape}",
        )
        for score in np.asarray(scores, dtype=np.float64)[done]:
            require(
                bool(0 <= score <= 1 + 1e-9),
                f"info['score'] at an episode's end is {score:.6g}, and must lie in [0, 1]: divide by the best "
                "possible, or leave it out and state max_return in the task file",
            )
