"""What all lanes of the suite keep to: seeds, states, and what is refused before anything changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded

from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.gymlanes import GymLanes
from qrlsuite.plugins.environments import beam6g, cartpole
from tests.environments.strangers import HERE

MADE: dict[str, Callable[[int], LaneEnv]] = {
    "beam6g": lambda count: beam6g.make_vector(beam6g.BeamOptions(steps=12), count),
    "cartpole": lambda count: cartpole.CartPoleLanes(cartpole.CartPoleOptions(), count),
    "gym": lambda count: GymLanes(f"{HERE}:Walk-v0", count),
}
HIGHEST = {"beam6g": 2, "cartpole": 1, "gym": 2}
all_lanes = pytest.mark.parametrize("name", MADE)


def lanes(name: str, count: int = 2) -> LaneEnv:
    env = MADE[name](count)
    env.seed_lanes([np.random.default_rng(g) for g in range(count)])
    return env


@all_lanes
def test_observations_and_states_are_copies(name: str) -> None:
    env = lanes(name)
    given: dict[str, np.ndarray[Any, Any]] = {"first": env.reset()[0], **env.state_dict()}
    before = {key: values.copy() for key, values in given.items()}
    env.step(np.ones(2, dtype=np.int64))
    for key, values in given.items():
        np.testing.assert_array_equal(values, before[key])


@all_lanes
def test_without_autoreset_an_ended_lane_stays_put_also_when_it_is_resumed(name: str) -> None:
    env, other, last, resumed = lanes(name, 3), lanes(name, 3), dict[int, Any](), False
    env.autoreset = other.autoreset = False
    env.reset()
    for row in np.random.default_rng(1).integers(0, HIGHEST[name] + 1, (80, 3)):
        again = other.step(row) if resumed else ()
        step = observations, rewards, terminated, truncated, infos = env.step(row)
        for lane, ended in enumerate(terminated | truncated):
            if lane in last:
                np.testing.assert_array_equal(observations[lane], last[lane])
                assert (rewards[lane], ended) == (0, False)
            elif ended:
                last[lane] = observations[lane]
                np.testing.assert_array_equal(infos["final_obs"][lane], observations[lane])
        for found, expected in zip(again[:4], step):
            np.testing.assert_array_equal(found, expected)
        if len(last) in (1, 2) and not resumed:
            other.load_state_dict(env.state_dict())
            resumed = True
    assert sorted(last) == [0, 1, 2]
    env.reset()
    assert not (env.step(np.zeros(3, np.int64))[0] == np.stack([last[lane] for lane in range(3)])).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.popitem(), "a state has .*, not "),
        (lambda s: s.update({k: v[:1] for k, v in s.items()}), r"has the shape \(1,.*\), not \(2,.*\)"),
    ],
)
@all_lanes
def test_states_that_do_not_fit_change_nothing(name: str, change: Callable[[Any], Any], message: str) -> None:
    env = lanes(name)
    env.reset()
    before, given = env.state_dict(), env.state_dict()
    change(given)
    with pytest.raises(StoreError, match=message):
        env.load_state_dict(given)
    for key, values in env.state_dict().items():
        np.testing.assert_array_equal(values, before[key])


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([0, "more"], r"actions must lie in 0\.\.{most}, not 0\.\.{more}"),
        ([-1, 0], r"actions must lie in 0\.\.{most}, not -1\.\.0"),
        ([0, 1, 0], r"actions must be 2 integers, not int64 of shape \(3,\)"),
        ([0.0, 1.0], r"actions must be 2 integers, not float64"),
    ],
)
@all_lanes
def test_actions_that_cannot_be(name: str, actions: list[Any], message: str) -> None:
    env, most = lanes(name), HIGHEST[name]
    env.reset()
    with pytest.raises(InvalidAction, match=message.format(most=most, more=most + 1)):
        env.step(np.array([most + 1 if action == "more" else action for action in actions]))


@all_lanes
def test_misuse(name: str) -> None:
    env = lanes(name)
    for step in (lambda: env.step(np.zeros(2, dtype=np.int64)), env.state_dict):
        with pytest.raises(ResetNeeded, match=r"reset\(\) before (step|state_dict)"):
            step()
    with pytest.raises(ValueError, match="num_envs must be at least 1, not 0"):
        MADE[name](0)
    with pytest.raises(ValueError, match="3 streams cannot serve 2 lanes"):
        env.seed_lanes([np.random.default_rng(g) for g in range(3)])
    with pytest.raises(OptionError, match="option"):
        env.reset(options={"low": 0})
