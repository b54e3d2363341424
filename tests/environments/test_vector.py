"""The lanes: equal to single environments bit by bit, and independent of each other."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.beam6g import ID, BeamManagement6G, BeamOptions, make_vector
from qrlsuite.plugins.environments.beam6g.episodes import EpisodeGenerator

STEPS = 12


def streams(count, seed=0):
    return [np.random.default_rng((seed, g)) for g in range(count)]


def lanes(count, groups=None, seed=0, **options):
    env = make_vector(BeamOptions(**{"steps": STEPS, **options}), count)
    env.seed_lanes(streams(groups or count, seed))
    return env


def actions_of(count, steps, seed=9):
    return np.random.default_rng(seed).integers(0, 3, (steps, count))


@pytest.mark.parametrize("options", [{}, {"degree": 6, "stack": 3}, {"physics": "text", "degree": 2}])
def test_lanes_equal_single_environments_bit_by_bit(options):
    count = 7
    options = {"steps": STEPS, **options}
    points = EpisodeGenerator(BeamOptions(**options)).draw(streams(count), [1] * count)
    env = lanes(count, **options)
    observations, _ = env.reset(options={"support_points": points})
    singles = [BeamManagement6G(**options) for _ in range(count)]
    for lane, single in enumerate(singles):
        first, _ = single.reset(options={"support_points": points[lane]})
        assert first.tobytes() == observations[lane].tobytes()
    for k, row in enumerate(actions_of(count, STEPS)):
        observations, rewards, terminated, truncated, infos = env.step(row)
        assert terminated.all() == (k == STEPS - 1)
        assert not truncated.any()
        for lane, single in enumerate(singles):
            expected = single.step(row[lane])
            last = infos["final_obs"] if infos else observations
            assert last[lane].tobytes() == expected[0].tobytes()
            assert rewards[lane] == expected[1]
            for name, value in expected[4].items():
                assert infos["final_info"][name][lane] == value


def test_only_the_streams_of_lanes_that_end_are_drawn_from():
    env = lanes(4, groups=2)
    env.reset()
    state = env.state_dict()
    state["step"][2:] = STEPS - 1
    env.load_state_dict(state)
    before = [stream.bit_generator.state for stream in env.streams]
    observations, _, terminated, _, infos = env.step(np.zeros(4, dtype=np.int64))
    assert terminated.tolist() == infos["_final_obs"].tolist() == [False, False, True, True]
    assert [stream.bit_generator.state == old for stream, old in zip(env.streams, before)] == [True, False]
    assert (infos["final_obs"][:2] == 0).all()
    assert env.state_dict()["step"].tolist() == [1, 1, 0, 0]
    assert (env.state_dict()["observations"] == observations).all()


def test_bad_states_and_points():
    env = lanes(2)
    with pytest.raises(OptionError, match=r"must have the shape \(2, 3, 2\), not \(3, 2\)"):
        env.reset(options={"support_points": np.ones((3, 2))})
    env.reset()
    state = env.state_dict()
    with pytest.raises(StoreError, match=r"'step' must lie in 0\.\.11"):
        env.load_state_dict({**state, "step": state["step"] + STEPS})


def test_gymnasium_make_vec():
    env = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="vector_entry_point", steps=4)
    assert env.reset(seed=0)[0].shape == (3, 3)
