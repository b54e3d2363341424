"""CartPole in lanes is Gymnasium's CartPole-v1 to the last bit, in every lane and whatever the number of lanes."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.utils.env_checker import check_env

from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.cartpole import (
    FORCE,
    GRAVITY,
    LENGTH,
    POLE_MASS,
    TAU,
    TOTAL_MASS,
    CartPoleLanes,
    parse,
)


def lanes(count: int, streams: int | None = None, **options: Any) -> CartPoleLanes:
    env = CartPoleLanes(parse(options), count)
    env.seed_lanes([np.random.default_rng(g) for g in range(streams or count)])
    return env


def single(stream: int) -> CartPoleEnv:
    env = CartPoleEnv()
    env.np_random = np.random.default_rng(stream)
    return env


def pushed_right(*state: float) -> list[float]:
    env = lanes(1)
    env.reset(options={"state": np.array([state])})
    env.step(np.array([1]))
    after: list[float] = env.state[:, 0].tolist()
    return after


def test_one_step_by_hand() -> None:
    """Pushed to the right at rest and upright: 10 N on both masses, and the pole's angle lags behind."""
    after = pushed_right(0.0, 0.0, 0.0, 0.0)
    push = FORCE / TOTAL_MASS
    falling = -push / (LENGTH * (4 / 3 - POLE_MASS / TOTAL_MASS))
    assert after[0] == 0
    assert after[2] == 0
    assert after[1] == pytest.approx(TAU * (push - POLE_MASS * LENGTH * falling / TOTAL_MASS))
    assert after[3] == pytest.approx(TAU * falling)
    tilted = pushed_right(0.0, 0.0, 0.1, 0.0)[3]
    assert tilted > after[3]
    assert GRAVITY == 9.8


def test_gymnasium_step_for_step_from_given_states() -> None:
    """500 random actions in 7 lanes that a controller keeps upright a while: everything agrees to the last bit."""
    count = 7
    generator = np.random.default_rng(3)
    start = generator.uniform(-0.05, 0.05, (count, 4))
    env, singles = lanes(count), [single(lane) for lane in range(count)]
    observations, _ = env.reset(options={"state": start})
    for lane, one in enumerate(singles):
        one.reset()
        one.state = start[lane].copy()
    env.seed_lanes([one.np_random for one in singles])  # a lane and its single environment share a stream
    episodes = 0
    for _ in range(500):
        actions = np.where(generator.random(count) < 0.2, generator.integers(0, 2, count), env.state[2] > 0)
        before = [one.np_random.bit_generator.state for one in singles]
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert observations.dtype == np.float32
        assert rewards.dtype == np.float64
        for lane, one in enumerate(singles):
            expected, reward, fallen, _, _ = one.step(int(actions[lane]))
            assert (rewards[lane], terminated[lane]) == (reward, fallen)
            assert fallen == bool(infos and infos["_final_obs"][lane])
            if fallen:
                episodes += 1
                np.testing.assert_array_equal(infos["final_obs"][lane], expected)
                one.np_random.bit_generator.state = before[lane]
                expected, _ = one.reset()
            elif truncated[lane]:
                one.np_random.bit_generator.state = before[lane]
                expected, _ = one.reset()
            np.testing.assert_array_equal(env.state[:, lane], one.state)
            np.testing.assert_array_equal(observations[lane], expected)
    assert episodes > 3


def balance(state: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A linear controller that keeps the pole up for good."""
    return (state[0] * 0.1 + state[1] * 0.3 + state[2] * 3 + state[3] > 0).astype(np.int64)


def test_500_steps_are_truncation_and_not_termination() -> None:
    env = lanes(3)
    env.reset()
    env.step(balance(env.state))
    env.state[2, 1] = 0.5  # lane 1 falls now, so its next episode is two steps behind
    for step in range(2, 503):
        _, _, terminated, truncated, infos = env.step(balance(env.state))
        assert terminated.tolist() == [False, step == 2, False]
        assert truncated.tolist() == [step == 500, step == 502, step == 500]
    assert infos["_final_obs"].tolist() == [False, True, False]


def test_a_fall_in_the_last_step_is_both() -> None:
    env = lanes(2, steps=1)
    env.reset(options={"state": [[0, 0, 0, 0], [0, 0, 0.3, 0]]})
    _, rewards, terminated, truncated, _ = env.step(np.zeros(2, dtype=np.int64))
    assert rewards.tolist() == [1, 1]
    assert terminated.tolist() == [False, True]
    assert truncated.tolist() == [True, True]


@pytest.mark.parametrize(("variable", "limit"), [(0, 2.4), (2, 12 * 2 * np.pi / 360)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_limits(variable: int, limit: float, sign: int) -> None:
    state = np.zeros((2, 4))
    state[0, variable] = sign * limit
    state[1, variable] = sign * np.nextafter(limit, 9)
    env = lanes(2)
    env.reset(options={"state": state})
    assert env.step(np.zeros(2, dtype=np.int64))[2].tolist() == [False, True]


def test_normalizations() -> None:
    start = [[2.4, -2.5, 0.21, 0.0], [-1.2, 1.25, 0.0, 5.0]]
    raw = np.array(start, dtype=np.float32)
    kinds = "none", "bounds", "arctan", "running"
    got = {kind: lanes(2, normalization=kind).reset(options={"state": start})[0] for kind in kinds}
    np.testing.assert_array_equal(got["none"], raw)
    np.testing.assert_array_equal(got["running"], raw)
    np.testing.assert_allclose(got["bounds"], [[1, -1, 1, 0], [-0.5, 0.5, 0, 2]], rtol=1e-6)
    np.testing.assert_allclose(got["arctan"], np.arctan(raw.astype(np.float64)), rtol=1e-6)
    assert all(values.dtype == np.float32 for values in got.values())
    space = lanes(2, normalization="arctan").single_observation_space
    assert space.high[1] == pytest.approx(np.pi / 2)  # type: ignore[attr-defined]
    bounded = lanes(1, normalization="bounds", bounds=[1, 2, 3, 4])
    shown = bounded.reset(options={"state": [[1, 1, 1, 1]]})[0]
    np.testing.assert_allclose(shown, [[1, 1 / 2, 1 / 3, 1 / 4]], rtol=1e-6)


@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*infinity:UserWarning")  # as Gymnasium's own
@pytest.mark.parametrize("normalization", ["none", "bounds", "arctan"])
def test_the_single_environment_passes_gymnasiums_check_and_agrees(normalization: Any) -> None:
    env = gymnasium.make("qrlsuite/CartPole-v1", normalization=normalization, steps=15)
    check_env(env.unwrapped, skip_render_check=True)
    vector = lanes(1, normalization=normalization, steps=15)
    expected, _ = env.reset(seed=3)
    inner = env.unwrapped
    observations, _ = vector.reset(options={"state": inner.state[None]})  # type: ignore[attr-defined]
    np.testing.assert_array_equal(observations[0], expected)
    for step in range(1, 16):
        action = balance(vector.state)
        expected, reward, terminated, truncated, _ = env.step(action[0])
        observations, rewards, fallen, cut, infos = vector.step(action)
        assert (rewards[0], fallen[0], cut[0]) == (reward, terminated, truncated)
        assert truncated == (step == 15)
        np.testing.assert_array_equal(infos["final_obs"][0] if infos else observations[0], expected)


def test_running_statistics_are_asked_for_in_lanes_and_refused_alone() -> None:
    assert lanes(1, normalization="running").running_statistics
    assert not lanes(1, normalization="arctan").running_statistics
    with pytest.raises(OptionError, match=r"belong to an agent.*gymnasium.wrappers.NormalizeObservation"):
        gymnasium.make("qrlsuite/CartPole-v1", normalization="running")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "environment 'cartpole': steps = 0: .*greater than or equal to 1"),
        ({"bounds": [1, 2, 3]}, "bounds"),
        ({"bounds": [1, 2, 3, 0]}, "every bound must be a positive, finite number"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        parse(options)


def test_misuse() -> None:
    env = lanes(2)
    with pytest.raises(OptionError, match=r"takes the option 'state', not \['low'\]"):
        env.reset(options={"low": 0.0})
    with pytest.raises(OptionError, match=r"'state' has the shape \(4,\), not \(2, 4\)"):
        env.reset(options={"state": np.zeros(4)})
    env.reset()
    with pytest.raises(StoreError, match=r"'step' must lie in 0..500"):
        env.load_state_dict({**env.state_dict(), "step": np.array([0, 501])})
