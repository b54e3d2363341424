"""The single environment: the released code's episodes, Gymnasium's rules, and its pictures."""

from __future__ import annotations

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled, InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from qrlsuite.errors import OptionError
from qrlsuite.plugins.environments.beam6g import ID, BeamManagement6G, BeamOptions, physics, render
from tests.conftest import golden
from tests.environments.test_physics import antennas

EPISODES = golden("beam6g")
SMALL = {"steps": 5, "degree": 3}


@pytest.mark.parametrize("episode", EPISODES, ids=range(len(EPISODES)))
def test_released_episode(episode):
    env = gymnasium.make(ID, antennas=antennas(episode), degree=episode["degree"], steps=episode["steps"])
    observation, _ = env.reset(options={"support_points": episode["support_points"]})
    observations, rewards, ends = [observation], [], []
    for action in episode["actions"]:
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        ends.append(terminated)
        assert not truncated
    assert observations[0].dtype == np.float32
    released = np.array(episode["observations"])
    same_beam = np.array(observations)[:, 2] == np.float32(released[:, 2])
    assert same_beam.mean() > 0.99  # two beams may tie to 2e-6
    np.testing.assert_allclose(np.array(observations)[:, :2], released[:, :2], atol=2e-6)
    np.testing.assert_allclose(rewards, episode["rewards"], rtol=0, atol=2e-6)
    assert ends == episode["terminated"]
    steps = episode["steps"] + 1
    np.testing.assert_allclose(info["received"], episode["sum_selected"], rtol=0, atol=2e-6 * steps)
    np.testing.assert_allclose(info["optimal"], episode["sum_optimal"], rtol=0, atol=2e-6 * steps)
    np.testing.assert_allclose(info["score"], episode["ratio"], rtol=0, atol=1e-4)


@pytest.mark.parametrize("pygame", ["there", "missing"])
def test_gymnasium_checker_renders_in_every_declared_mode(pygame):
    if pygame == "there":
        pytest.importorskip("pygame")
    code = (
        "import sys, gymnasium, qrlsuite; from gymnasium.utils.env_checker import check_env;"
        f"there = {pygame == 'there'};"
        "there or sys.modules.update(pygame=None);"
        f"env = gymnasium.make('{ID}', steps=5).unwrapped;"
        "assert ('human' in env.metadata['render_modes']) is there;"
        "check_env(env)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "SDL_VIDEODRIVER": "dummy"})


@pytest.mark.parametrize("mode", ["rgb_array", "ansi"])
def test_gymnasium_checker_with_render_mode(mode):
    check_env(gymnasium.make(ID, render_mode=mode, **SMALL).unwrapped, skip_render_check=True)


def test_first_observation_is_of_the_best_antenna_there():
    # Straight below antenna 0, on its peak: R^2 = 2, the spike 1/R^2.
    env = BeamManagement6G(antennas=[((5.0, 5.0), (1, 0)), ((0.0, 1.0), (1, 0))], degree=2)
    observation, _ = env.reset(options={"support_points": [[0.0, 0.0], [6.0, 0.0]]})
    np.testing.assert_allclose(observation, [1.0, 0.5, 0.5])


def test_stack_holds_the_last_observations_oldest_first():
    plain, stacked = BeamManagement6G(**SMALL), BeamManagement6G(stack=3, **SMALL)
    singles = [plain.reset(seed=2)[0]]
    stack, _ = stacked.reset(seed=2)
    assert stack.tolist() == np.tile(singles[0], 3).tolist()
    for action in (0, 2, 1, 1):
        singles.append(plain.step(action)[0])
        stack = stacked.step(action)[0]
    assert stack.tolist() == np.concatenate(singles[-3:]).tolist()


def test_an_unseeded_reset_continues_the_stream():
    env = BeamManagement6G()
    firsts = [env.reset(seed=1)[0].tolist(), env.reset()[0].tolist()]
    again = BeamManagement6G()
    assert firsts == [again.reset(seed=1)[0].tolist(), again.reset()[0].tolist()]
    assert firsts[0] != firsts[1]


@pytest.mark.parametrize("action", [3, -1, 0.5])
def test_bad_action(action):
    env = BeamManagement6G(**SMALL)
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"the action must be an integer in 0\.\.2, not"):
        env.step(action)


def test_step_without_an_episode():
    env = BeamManagement6G(**SMALL)
    with pytest.raises(ResetNeeded, match="no episode is running"):
        env.step(0)
    env.reset(seed=0)
    for _ in range(5):
        env.step(0)
    with pytest.raises(ResetNeeded, match="no episode is running"):
        env.step(0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"support": []}, "unknown reset option 'support'; known: support_points"),
        ({"support_points": [[0, 0], [6, 6]]}, r"must have the shape \(3, 2\), not \(2, 2\)"),
        ({"support_points": [[0, 0], [3, 7], [6, 6]]}, "must lie in the field"),
        ({"support_points": [[0, 0], [3, np.nan], [6, 6]]}, "must lie in the field"),
        ({"support_points": [[1, 1]] * 3}, "must not all be the same point"),
    ],
)
def test_bad_reset_options(options, message):
    with pytest.raises(OptionError, match=message):
        BeamManagement6G().reset(options=options)


def test_gymnasium_finds_it_by_module_without_importing_torch():
    code = (
        "import sys, gymnasium;"
        f"gymnasium.make('qrlsuite.plugins.environments.beam6g:{ID}').reset(seed=0);"
        "assert not {'torch', 'matplotlib', 'pennylane'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_ansi_shows_user_path_and_antennas():
    env = BeamManagement6G(render_mode="ansi", steps=10, degree=2)
    env.reset(options={"support_points": [[0.0, 0.0], [6.0, 0.0]]})
    for _ in range(5):
        env.step(1)
    lines = env.render().splitlines()
    assert lines[0].startswith("step 5/10  antenna 1")
    assert lines[-2].index("@") == 25  # half of 49 columns, after the edge
    assert lines[-2].count("*") == 5
    assert lines[-2].count(".") == 5
    assert all(digit in env.render() for digit in "012")


def test_pictures_change_where_something_moved_and_need_a_mode_and_a_reset():
    env = BeamManagement6G(render_mode="rgb_array", **SMALL)
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset(seed=0)
    first = env.render()
    env.step(0)
    second = env.render()
    assert first.dtype == np.uint8
    assert first.shape == (*second.shape[:2], 3)
    assert 0.0005 < (first != second).any(axis=2).mean() < 0.5
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert BeamManagement6G().render() is None


def test_human_without_pygame_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyNotInstalled, match="pip install pygame"):
        BeamManagement6G(render_mode="human", **SMALL).reset(seed=0)


def test_human_shows_a_window(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = BeamManagement6G(render_mode="human", **SMALL)
    env.reset(seed=0)
    env.step(0)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
    env.render_mode = "rgb_array"
    assert (shown == env.render()).all()
    env.close()
    assert not pygame.display.get_init()


def test_ground_truth_is_the_best_antenna_at_each_place():
    # Two antennas in a mirror at x = 3: the map is its own mirror image with the antennas exchanged.
    options = BeamOptions(antennas=(((1.0, 3.0), (0.0, 1.0)), ((5.0, 3.0), (0.0, 1.0))))
    antenna, beam, intensity = render.ground_truth(options, 40)
    assert (antenna == 1 - antenna[:, ::-1]).mean() > 0.95  # where both are equal, the first is taken
    np.testing.assert_allclose(intensity, intensity[:, ::-1], rtol=1e-6)
    assert antenna[20, 3] == 0
    # By brute force: no antenna and no beam gives more, anywhere.
    model = physics.physics("released")
    x, y = np.meshgrid((np.arange(40) + 0.5) * 6 / 40, (np.arange(40) + 0.5) * 6 / 40)
    every = np.stack([physics.all_intensities(model, x, y, one) for one in options.antennas])
    np.testing.assert_allclose(intensity, every.max((0, 1)), rtol=1e-9)
    rows, columns = np.indices(antenna.shape)
    np.testing.assert_allclose(every[antenna, beam, rows, columns], intensity, rtol=1e-9)


def test_the_map_of_the_best_antenna_names_its_regions_and_draws_every_antenna():
    # The field falls apart at x = 3: left the first antenna, right the second, each around its own place.
    options = BeamOptions(antennas=(((1.0, 3.0), (0.0, 1.0)), ((5.0, 3.0), (0.0, 1.0))))
    figure = render.ground_truth_figure(options, 60)
    field, scale = figure.axes
    assert field.get_title(loc="left").startswith("Best antenna")
    truth = render.ground_truth(options, 60)
    words = [(text.get_text(), *text.get_position()) for text in field.texts]
    assert ("0", 1.0, 3.0) in words  # the antennas themselves
    assert ("1", 5.0, 3.0) in words
    regions = [(text, x, y) for text, x, y in words if (x, y) not in {(1.0, 3.0), (5.0, 3.0)}]
    assert {text for text, _, _ in regions} == {"0", "1"}
    for text, x, y in regions:
        assert truth.antenna[int(y * 10), int(x * 10)] == int(text)
    assert [tick.get_text() for tick in scale.get_xticklabels()][-1] == "1"


def test_the_colors_of_antennas_differ_for_the_color_blind():
    """Simulated as Machado, Oliveira & Fernandes (2009) do, full strength; distances in OKLab, black to white 100."""
    simulations = {
        "normal": np.eye(3),
        "protanopia": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
        "deuteranopia": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
        "tritanopia": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
    }
    cones = [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]
    opponent = [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]
    colors = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in render.COLORS[:6]])
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    for kind, matrix in simulations.items():
        seen = np.clip(linear @ np.transpose(matrix), 0, 1)
        places = 100 * np.cbrt(seen @ np.transpose(cones)) @ np.transpose(opponent)
        distances = np.linalg.norm(places[:, None] - places[None], axis=2)
        assert distances[~np.eye(6, dtype=bool)].min() > 7, kind
