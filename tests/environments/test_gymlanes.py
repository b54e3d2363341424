"""Any Gymnasium environment in lanes: as the single environments, lane by lane, and resumed exactly."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction

from qrlsuite import actions as action_spaces
from qrlsuite.errors import EnvironmentFailure, OptionError, StoreError
from qrlsuite.gymlanes import SEEDS, UNLIMITED, GymLanes
from qrlsuite.options import build
from qrlsuite.plugins.environments import gym
from tests.environments.strangers import HERE

WALK = f"{HERE}:Walk-v0"


def lanes(env_id: str, count: int, streams: int | None = None, first: int = 0, **arguments: Any) -> GymLanes:
    env = GymLanes(env_id, count, arguments)
    env.seed_lanes([np.random.default_rng(first + g) for g in range(streams or count)])
    return env


def flat(env: gymnasium.Env[Any, Any], observation: Any) -> np.ndarray[Any, Any]:
    return np.asarray(gymnasium.spaces.flatten(env.observation_space, observation), np.float32)


@pytest.mark.parametrize(
    "env_id", ["CartPole-v1", "Acrobot-v1", "MountainCar-v0", "FrozenLake-v1", WALK, f"{HERE}:Cut-v0"]
)
def test_every_lane_is_the_single_environment(env_id: str) -> None:
    count, stream = 4, [np.random.default_rng(g) for g in range(4)]
    env = lanes(env_id, count)
    singles = [gymnasium.make(env_id) for _ in range(count)]
    observations, _ = env.reset()
    for lane, one in enumerate(singles):
        expected, _ = one.reset(seed=int(stream[lane].integers(SEEDS)))
        np.testing.assert_array_equal(observations[lane], flat(one, expected))
    ends = np.zeros(count, dtype=int)
    for actions in np.random.default_rng(9).integers(0, env.single_action_space.n, (230, count)):  # type: ignore[attr-defined]
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert observations in env.observation_space
        for lane, one in enumerate(singles):
            expected, reward, fallen, cut, _ = one.step(actions[lane])
            assert (rewards[lane], terminated[lane], truncated[lane]) == (reward, fallen, cut)
            assert (fallen or cut) == bool(infos and infos["_final_obs"][lane])
            if fallen or cut:
                ends[lane] += 1
                np.testing.assert_array_equal(infos["final_obs"][lane], flat(one, expected))
                expected, _ = one.reset(seed=int(stream[lane].integers(SEEDS)))
            np.testing.assert_array_equal(observations[lane], flat(one, expected))
    assert env_id == "Acrobot-v1" or ends.min() > 0
    env.close()


@pytest.mark.parametrize(
    ("kind", "size", "first"),
    [
        ("discrete", 5, [1, 0, 0, 0, 0]),
        ("binary", 3, [0, 0, 0]),
        ("multi", 5, [1, 0, 1, 0, 0]),
        ("image", 4, [0, 0, 0, 0]),
        ("box", 4, None),
        ("dict", 6, [0, 1, 0, 0, 0, 0]),
        ("tuple", 3, [1, 0, 1]),
    ],
)
def test_observations_are_flattened(kind: str, size: int, first: list[int] | None) -> None:
    env = lanes(WALK, 2, kind=kind)
    observations, _ = env.reset()
    assert observations.dtype == np.float32
    assert observations.shape == (2, size)
    assert env.single_observation_space.shape == (size,)
    assert env.unflattened_space == gymnasium.make(WALK, kind=kind).observation_space
    assert observations in env.observation_space
    if first is not None:
        np.testing.assert_array_equal(observations[0], first)
    observations = env.step(np.zeros(2, dtype=np.int64))[0]
    if kind == "discrete":
        np.testing.assert_array_equal(observations[0], [0, 1, 0, 0, 0])


def test_actions_count_from_zero_also_where_the_environments_do_not() -> None:
    plain, shifted = lanes(WALK, 1), lanes(WALK, 1, start=5)
    assert shifted.single_action_space == gymnasium.spaces.Discrete(3)
    for env in (plain, shifted):
        env.reset()
    difference = shifted.step(np.array([2]))[1] - plain.step(np.array([2]))[1]
    assert difference[0] == pytest.approx(5)


ACTS = ("multi-discrete", "multi-binary", "box", "doubles")


@pytest.mark.parametrize("acts", ACTS)
def test_an_action_has_the_shape_and_type_of_its_space(acts: str) -> None:
    """The environment gets each lane's action, counted from where its own space begins."""
    env, one = lanes(WALK, 2, acts=acts, start=4), gymnasium.make(WALK, acts=acts, start=4)
    stream = np.random.default_rng(1)
    stream.integers(SEEDS, size=0)
    env.reset()
    one.reset(seed=int(stream.integers(SEEDS)))
    offset = np.array([4, 0]) if acts == "multi-discrete" else 0
    space = env.single_action_space
    for given in action_spaces.draw(space, np.random.default_rng(3), 2, 2):
        assert given.shape == (2, *(space.shape or ()))
        assert given.dtype == space.dtype
        rewards = env.step(given)[1]
        assert rewards[1] == one.step(np.asarray(given[1] + offset, space.dtype))[1]


@pytest.mark.parametrize(
    ("acts", "given", "message"),
    [
        ("multi-discrete", np.zeros(2, np.int64), r"must be 2 integers of shape \(2,\) each, not int64 of .*\(2,\)"),
        ("multi-discrete", np.array([[0, 2], [0, 0]]), r"must lie in 0..1, not 0..2"),
        ("multi-binary", np.array([[0, 2, 0]] * 2), r"must lie in 0..1, not 0..2"),
        ("box", np.zeros((2, 1, 2), np.int64), r"must be 2 numbers of shape \(1, 2\) each, not int64"),
        ("box", np.full((2, 1, 2), 1.5), r"must lie in -1..1, not 1.5: qrlsuite.actions.from_units maps"),
        ("box", np.full((2, 1, 2), np.nan), r"must lie in -1..1, not nan"),
    ],
)  # fmt: skip
def test_actions_that_are_none_of_the_space(acts: str, given: Any, message: str) -> None:
    env = lanes(WALK, 2, acts=acts)
    env.reset()
    before = env.state_dict()
    with pytest.raises(InvalidAction, match=message):
        env.step(given)
    np.testing.assert_array_equal(env.state_dict()["actions"], before["actions"])


def test_numbers_between_minus_one_and_one_become_actions_of_a_box() -> None:
    space = gymnasium.spaces.Box(np.array([[-1, 0]], np.float32), np.array([[1, 4]], np.float32))
    units = np.array([[-1, -1], [1, 1], [0, 0.5], [9, -9], [np.nan, np.nan]], np.float32)
    actions = action_spaces.from_units(units, space)
    assert actions.tolist() == [[[-1, 0]], [[1, 4]], [[0, 3]], [[1, 0]], [[0, 2]]]
    assert actions.dtype == np.float32


def test_masks_are_those_of_the_observations_that_are_returned() -> None:
    env = lanes(WALK, 3, masked="some")
    _, infos = env.reset()
    steps = np.zeros(3, np.int64)
    for _ in range(30):
        np.testing.assert_array_equal(infos["action_mask"][:, 0], steps % 2)
        assert infos["action_mask"].shape == (3, 3)
        _, _, terminated, _, infos = env.step(np.ones(3, np.int64))
        before, steps = steps + 1, np.where(terminated, 0, steps + 1)
        if terminated.any():
            ends = infos["final_info"]["action_mask"][terminated, 0]
            np.testing.assert_array_equal(ends, before[terminated] % 2)


def test_a_state_is_as_wide_as_the_time_limit() -> None:
    env = lanes(WALK, 2)
    env.reset()
    assert env.state_dict()["actions"].shape == (2, 20)
    assert GymLanes("CartPole-v1", 1, {"max_episode_steps": 7}).capacity == 7
    assert lanes(f"{HERE}:Endless-v0", 1).capacity == UNLIMITED


def test_an_episode_without_end_is_an_error() -> None:
    env = lanes(f"{HERE}:Endless-v0", 1)
    env.reset()
    for _ in range(UNLIMITED):
        env.step(np.zeros(1, dtype=np.int64))
    with pytest.raises(EnvironmentFailure, match=f"not end within {UNLIMITED} steps; give it a time limit"):
        env.step(np.zeros(1, dtype=np.int64))


def test_an_environment_that_does_something_else_the_second_time_is_not_resumed() -> None:
    env = lanes(f"{HERE}:Forgetful-v0", 2)
    env.reset()
    env.step(np.zeros(2, dtype=np.int64))
    with pytest.raises(StoreError, match=r"some of its randomness does not come from reset\(seed"):
        GymLanes(f"{HERE}:Forgetful-v0", 2).load_state_dict(env.state_dict())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros((2, 3), np.int32)}, r"'actions' has the shape \(2, 3\), not \(2, 20\)"),
        ({"actions": np.full((2, 20), 7, np.int32)}, "cannot be resumed: AssertionError: 7"),
    ],
)
def test_states_that_do_not_fit(change: dict[str, Any], message: str) -> None:
    env = lanes(WALK, 2)
    env.reset()
    given = {name: values for name, values in (env.state_dict() | change).items() if values is not None}
    with pytest.raises(StoreError, match=message):
        env.load_state_dict(given)


@pytest.mark.parametrize(
    ("env_id", "arguments", "message"),
    [
        ("Acrobat-v1", {}, "Gymnasium knows no environment 'Acrobat-v1'; did you mean 'Acrobot-v1'"),
        ("Zzz", {}, r"no environment 'Zzz'; gymnasium.pprint_registry\(\) lists"),
        ("nowhere.at.all:X-v0", {}, "module 'nowhere.at.all' cannot be imported: ModuleNotFoundError"),
        (WALK, {"acts": "unbounded"}, r"the action space Box\(-inf, 1.0, .* has no bounds: state finite ones"),
        (WALK, {"acts": "whole"}, r"action space Box\(0, 9, .* is not supported: use Discrete, MultiDiscrete, "),
        (WALK, {"acts": "several"}, r"action space Tuple\(Discrete\(2\), .* is not supported"),
        (WALK, {"kind": "sequence"}, r"observation space Sequence\(.*, which has no fixed number of values: wrap it"),
        (f"{HERE}:Unmade-v0", {}, "needs a package that is not installed: pip install no_such_package"),
        (WALK, {"colour": "red"}, r"cannot be made with {'colour': 'red'}: TypeError: .*'colour'"),
    ],
)  # fmt: skip
def test_environments_that_cannot_be_used(env_id: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        GymLanes(env_id, 1, arguments)


@pytest.mark.parametrize(
    ("env_id", "package", "command"),
    [("LunarLander-v3", "Box2D", r"gymnasium\[box2d\]"), ("Ant-v5", "mujoco", r"gymnasium\[mujoco\]")],
)
def test_a_missing_package_is_named_with_the_command_that_installs_it(
    env_id: str, package: str, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(OptionError, match=f"'{env_id}'.*pip install.*{command}"):
        GymLanes(env_id, 1)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"normalization": "bounds"}, r"needs finite bounds, and low\[1\] is -inf: give low as a list of 4 numbers"),
        ({"normalization": "bounds", "low": [-1, -1, -1]}, "low has 3 values, an observation has 4"),
        (
            {"normalization": "bounds", "low": [-1, 2, -1, -1], "high": [1, 1, 1, 1]},
            r"low\[1\] = 2 is not below high\[1\] = 1",
        ),
        ({"low": [-1, -1, -1, -1]}, "low and high are for normalization = 'bounds', not 'none'"),
    ],
)  # fmt: skip
def test_normalizations_that_cannot_be(given: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        GymLanes("CartPole-v1", 1, **given)


def test_some_values_alone_are_shown() -> None:
    """CartPole's position and angle, in reverse order; states and normalization are of the shown values."""
    whole, some = lanes("CartPole-v1", 3), GymLanes("CartPole-v1", 3, observe=[2, 0])
    bounded = GymLanes("CartPole-v1", 3, None, "bounds", [-0.5, -5], [0.5, 5], [2, 0])
    for env in (whole, some, bounded):
        env.seed_from(0)
    seen, shown, scaled = (env.reset()[0] for env in (whole, some, bounded))
    for _ in range(30):
        np.testing.assert_array_equal(shown, seen[:, [2, 0]])
        np.testing.assert_allclose(scaled, shown / [0.5, 5], rtol=1e-6)
        seen, shown, scaled = (env.step(np.ones(3, np.int64))[0] for env in (whole, some, bounded))
    assert shown in some.observation_space
    assert some.unflattened_space is None
    again = GymLanes("CartPole-v1", 3, observe=[2, 0])
    again.load_state_dict(some.state_dict())
    for wrong in ([], [0, 0], [4], [-1]):
        with pytest.raises(OptionError, match=r"places among the 4 values of an observation, 0 to 3, each"):
            GymLanes("CartPole-v1", 1, observe=wrong)


@pytest.mark.parametrize("kind", ["arctan", "running"])
def test_normalization_is_for_boxes(kind: Any) -> None:
    with pytest.raises(OptionError, match=rf"'{kind}' is for boxes, and its observations are Discrete\(16\)"):
        GymLanes("FrozenLake-v1", 1, normalization=kind)


def test_normalizations() -> None:
    raw = lanes("MountainCar-v0", 3)
    scaled, angles = (GymLanes("MountainCar-v0", 3, normalization=kind) for kind in ("bounds", "arctan"))
    given = GymLanes("MountainCar-v0", 3, None, "bounds", [-2, -0.1], [0, 0.1])
    for env in (scaled, angles, given):
        env.seed_lanes([np.random.default_rng(g) for g in range(3)])
    seen, *others = (env.reset()[0] for env in (raw, scaled, angles, given))
    for actions in np.random.default_rng(0).integers(0, 3, (20, 3)):
        low, high = np.array([-1.2, -0.07]), np.array([0.6, 0.07])
        np.testing.assert_allclose(others[0], (seen - low) / (high - low) * 2 - 1, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(others[1], np.arctan(seen), rtol=1e-6)
        np.testing.assert_allclose(others[2], [1, 0] + seen * [1, 10], rtol=1e-5, atol=1e-6)
        seen, *others = (env.step(actions)[0] for env in (raw, scaled, angles, given))
    assert scaled.single_observation_space == gymnasium.spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"id": "FrozenLke-v1"}, "id = 'FrozenLke-v1': .*did you mean 'FrozenLake-v1'"),
        ({"arguments": {"max_episode_steps": 5}}, "'max_episode_steps' cannot be given here; use the option"),
        ({"arguments": {"render_mode": "human"}}, "'render_mode' cannot be given here; use nothing"),
    ],
)
def test_options_that_cannot_be(values: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        build(gym.GymOptions, values, "environment 'gym'")


def test_the_factory_takes_every_option() -> None:
    given = {
        "id": "MountainCar-v0", "arguments": {"goal_velocity": 0.01}, "max_episode_steps": 9, "normalization": "bounds",
        "low": [-3, -3], "high": [3, 3],
    }  # fmt: skip
    env = gym.make_vector(build(gym.GymOptions, given, "gym"), 2)
    assert isinstance(env, GymLanes)
    assert env.capacity == 9
    assert env.envs[1].unwrapped.goal_velocity == 0.01  # type: ignore[attr-defined]
    assert env.single_observation_space.low[0] == pytest.approx(-1.2 / 3)  # type: ignore[attr-defined]


def test_running_statistics_are_asked_for_and_observations_left() -> None:
    raw, asked = lanes(WALK, 2), GymLanes(WALK, 2, normalization="running")
    asked.seed_lanes([np.random.default_rng(g) for g in range(2)])
    assert (raw.running_statistics, asked.running_statistics) == (False, True)
    np.testing.assert_array_equal(raw.reset()[0], asked.reset()[0])


def test_closing_closes_every_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    env = lanes(WALK, 3)
    closed = []
    for one in env.envs:
        monkeypatch.setattr(one.unwrapped, "close", lambda: closed.append(1))
    env.close()
    assert closed == [1, 1, 1]
