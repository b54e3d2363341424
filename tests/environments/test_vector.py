"""The lanes: equal to single environments bit by bit, independent of each other, and resumable anywhere."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.beam6g import ID, BeamManagement6G, BeamOptions, make_vector
from qrlsuite.plugins.environments.beam6g.episodes import EpisodeGenerator, Tables

STEPS = 12


def streams(count, seed=0):
    return [np.random.default_rng((seed, g)) for g in range(count)]


def lanes(count, groups=None, seed=0, **options):
    env = make_vector(BeamOptions(**{"steps": STEPS, **options}), count)
    env.seed_lanes(streams(groups or count, seed))
    return env


def actions_of(count, steps, seed=9):
    return np.random.default_rng(seed).integers(0, 3, (steps, count))


def walk(env, actions):
    """Step through `actions` (T, L): everything that came back, as bytes per lane."""
    seen = []
    for row in actions:
        observations, rewards, terminated, truncated, infos = env.step(row)
        parts = [observations, rewards, terminated, truncated]
        if infos:
            parts += [infos["final_obs"], infos["final_info"]["score"], infos["final_info"]["_score"]]
        seen.append([b"".join(part[lane].tobytes() for part in parts) for lane in range(env.num_envs)])
    return seen


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


def test_a_lane_draws_what_a_single_environment_draws():
    env = lanes(3, degree=4)
    observations, _ = env.reset()
    for lane in range(3):
        single = BeamManagement6G(steps=STEPS, degree=4)
        single.np_random = streams(3)[lane]
        assert single.reset()[0].tobytes() == observations[lane].tobytes()


@pytest.mark.parametrize("degree", [3, 6])
@pytest.mark.parametrize(("size", "offset"), [(1, 0), (1, 83), (2, 5), (17, 31), (100, 13)])
def test_tables_do_not_depend_on_the_batch(degree, size, offset):
    simulator = EpisodeGenerator(BeamOptions(steps=STEPS, degree=degree))
    support = simulator.draw(streams(1), [150])

    def tables(part):
        result = Tables.empty(len(part), 3, STEPS)
        simulator.fill(result, np.arange(len(part)), part)
        return result

    whole, some = tables(support), tables(support[offset : offset + size])
    for name in ("intensity", "beam", "optimal"):
        assert getattr(some, name).tobytes() == getattr(whole, name)[offset : offset + size].tobytes()


@pytest.mark.parametrize("stop", [0, 5, STEPS, STEPS + 7])
@pytest.mark.parametrize("stack", [1, 3])
def test_state_restores_the_same_continuation(stop, stack):
    actions = actions_of(5, 3 * STEPS)
    env = lanes(5, stack=stack, degree=4)
    env.reset()
    walk(env, actions[:stop])
    state = {name: array.copy() for name, array in env.state_dict().items()}
    random = [stream.bit_generator.state for stream in env.streams]
    expected = walk(env, actions[stop:])
    again = lanes(5, stack=stack, degree=4, seed=99)
    again.reset()
    walk(again, actions[:3])  # whatever it did before is forgotten, its tables too
    for stream, saved in zip(again.streams, random):
        stream.bit_generator.state = saved
    again.load_state_dict(state)
    assert walk(again, actions[stop:]) == expected


def test_states_can_be_sliced_and_joined_at_different_steps():
    actions = actions_of(4, 2 * STEPS)
    early, late = lanes(2, seed=1), lanes(3, seed=2)
    early.reset()
    late.reset()
    walk(early, actions[:3, :2])
    walk(late, actions[:8, :3])
    joined = make_vector(BeamOptions(steps=STEPS), 4)
    joined.seed_lanes([*early.streams, *late.streams[1:]])
    states = early.state_dict(), late.state_dict()
    joined.load_state_dict(
        {name: np.concatenate([states[0][name], states[1][name][1:]]) for name in states[0]}
    )
    # Both runs draw from the same generators: put back what the first has used.
    random = [stream.bit_generator.state for stream in joined.streams]
    together = walk(joined, actions)
    for stream, saved in zip(joined.streams, random):
        stream.bit_generator.state = saved
    apart = walk(early, actions[:, :2])
    rest = make_vector(BeamOptions(steps=STEPS), 2)
    rest.seed_lanes(late.streams[1:])
    rest.load_state_dict({name: array[1:] for name, array in states[1].items()})
    apart = [a + b for a, b in zip(apart, walk(rest, actions[:, 2:]))]
    # Where some lane's episode ends, all lanes have a report; compare what every step gives.
    size = 3 * 4 + 8 + 2
    assert [[cell[:size] for cell in row] for row in together] == [
        [cell[:size] for cell in row] for row in apart
    ]


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
