"""`qrlsuite play`: an episode of a trained agent, drawn."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image

from qrlsuite import api
from qrlsuite.api import episode as episodes
from qrlsuite.errors import EnvironmentFailure, OptionError, QrlSuiteError
from qrlsuite.plugins.environments.beam6g.env import BeamManagement6G
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation
from tests.commands import say
from tests.conftest import Train, trainer

COUNTER = """
format_version = 1
name = "counter"
summary = "Count to seven"
default_algorithm = "reinforce"

[environment]
name = "gym"
[environment.options]
id = "tests.cli.test_play:Counter-v0"
arguments = { kind = "KIND" }

[protocol]
seeds = 2
epochs = 1
environments = 2
interactions = 40
validation_episodes = 2

[score]
source = "return"

[ranking]
thresholds = [3.0]
deltas = [0.5]
reference = { threshold = 3.0, delta = 0.5 }
horizons = [40]
"""


class Counter(gymnasium.Env[Any, Any]):
    """Seven steps; a frame shows the step, the action, which counts from 5, and a number drawn at the reset."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, kind: str = "image", render_mode: str | None = None) -> None:
        self.kind, self.render_mode = kind, render_mode
        self.observation_space = spaces.Box(0, 1, (1,), np.float32)
        self.action_space = spaces.Discrete(2, start=5)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.count, self.last, self.drawn = 0, 0, int(self.np_random.integers(200))
        return np.array([self.drawn / 200], np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count, self.last = self.count + 1, int(action)
        seen = np.array([self.drawn / 200], np.float32)
        return seen, float(action) + self.drawn, self.count == 7, False, {}

    def render(self) -> Any:
        image = np.zeros((8, 9, 3), np.uint8)
        image[..., 0], image[..., 1], image[..., 2] = 30 * self.count, 20 * self.last, self.drawn
        if self.kind == "raise":
            raise ZeroDivisionError("no light")
        return image / 255 if self.kind == "floats" else image


gymnasium.register("Counter-v0", entry_point=Counter)


def counting(tmp_path: Path, kind: str = "image") -> Path:
    (tmp_path / "counter.toml").write_text(COUNTER.replace("KIND", kind))
    return trainer(str(tmp_path / "counter.toml"), tmp_path)("runs", [0, 1], 1, "mlp", ("width=4",))


def test_the_episode_is_the_one_that_evaluate_plays(kept: Train, tmp_path: Path) -> None:
    store = EntryStore(kept("runs", [0, 1, 2], 2))
    shown = api.play(str(store.path), episode=3, runs=tmp_path / "runs")
    played = evaluation.trained(store, 1, 5)
    assert (shown.seed, shown.runs) == (played.seeds[0], 3)
    assert shown.rewards.sum() == pytest.approx(played.returns[0, 3], rel=1e-5)
    assert played.scores is not None
    assert shown.score == played.scores[0, 3]
    assert (len(shown.frames), len(shown.rewards), shown.actions.shape, shown.fps) == (21, 20, (20,), 20)
    assert "episode 3 of tiny, 20 steps" in repr(shown)
    image = Image.open(io.BytesIO(shown.gif()))
    assert (image.n_frames, image.size, image.info["duration"]) == (21, shown.frames[0].shape[1::-1], 50)  # type: ignore[attr-defined]
    for number in (0, 11, 20):
        image.seek(number)
        apart = np.abs(np.asarray(image.convert("RGB"), int) - shown.frames[number])
        assert apart.mean() < 8, "256 colors for all frames"
        assert np.abs(shown.frames[number].astype(int) - shown.frames[number - 1]).max() > 50
    assert 'src="data:image/gif;base64,R0lGOD' in shown._repr_html_()


def test_an_agent_acts_in_a_loop_of_ones_own(kept: Train, tmp_path: Path) -> None:
    store = EntryStore(kept("runs", [0, 1, 2], 2))
    shown = api.play(str(store.path), episode=3, runs=tmp_path / "runs")
    agent = api.agent(str(store.path), runs=tmp_path / "runs")
    assert (agent.seed, agent.runs, agent.task) == (shown.seed, 3, "tiny")
    lanes = agent.environments()
    lanes.autoreset = False
    lanes.seed_lanes([Streams(agent.entry.task.hash, 0).numpy("evaluation", 3)])
    observations, _ = lanes.reset()
    for action, reward in zip(shown.actions, shown.rewards):
        chosen = agent.act(observations)
        assert np.array_equal(chosen, action[None])
        observations, rewards, *_ = lanes.step(chosen)
        assert rewards == pytest.approx(reward, rel=1e-5)
    other = api.agent(str(store.path), seed=1, runs=tmp_path / "runs")
    assert (other.seed, other.runs) == (1, 1)
    assert other.environments(3).reset(seed=0)[0].shape == (3, observations.shape[1])
    with pytest.raises(
        OptionError, match=r"observations of shape \(2, 5\): task 'tiny' has 3 .* one alone is \(1, 3\)"
    ):
        agent.act(np.zeros((2, 5)))
    for seen, message in (
        (np.full((1, 3), np.nan), "observations must be finite"),
        (np.full((1, 3), 1e300), "observations must be finite"),
        ({"seen": 1}, "of type dict are no array of real numbers"),
        (["a"], "of type list are no array of real numbers"),
        ([[1, 2, 3], [1]], "of type list are no array of real numbers"),
        (np.zeros((2, 3), complex), "are no array of real numbers"),
        (np.zeros((0, 3)), "observations of shape"),
        (np.zeros(3), "observations of shape"),
        (np.zeros((1, 3, 1)), "observations of shape"),
    ):
        with pytest.raises(OptionError, match=message):
            agent.act(seen)  # type: ignore[arg-type]
    for bad, message in ((7, "has no seed 7"), (True, "seed = True: give a whole number")):
        with pytest.raises(QrlSuiteError, match=message):
            api.agent(str(store.path), seed=bad, runs=tmp_path / "runs")


def test_an_agent_that_remembers_is_told_where_episodes_begin(kept: Train, tmp_path: Path) -> None:
    store = EntryStore(kept("runs", [0], 1, "ppo gru", ("width=2",)))
    agent = api.agent(str(store.path), runs=tmp_path / "runs")
    observations, infos = agent.environments(2).reset(seed=0)
    with pytest.raises(OptionError, match=r"'ppo' remembers episodes: give act\(\) where they begin"):
        agent.act(observations)
    assert agent.act(observations, np.ones(2, bool), infos).shape == (2,)
    other = api.agent(str(store.path), runs=tmp_path / "runs")
    for _ in range(3):
        chosen = agent.act(observations, np.array([True, False]))
        assert np.array_equal(other.act(observations, np.array([1, 0], np.uint8)), chosen), "0 and 1 will do"
    for bad in (np.ones(3, bool), [0.5, 1], True, ["yes", "no"], np.array([2, 0])):
        with pytest.raises(OptionError, match="begins: give 2 truth values"):
            agent.act(observations, bad)  # type: ignore[arg-type]


def test_an_agent_of_a_task_with_masks_is_told_what_can_be_chosen(tmp_path: Path) -> None:
    store = EntryStore(trainer("taxi", tmp_path)("runs", [0], 1, "ddqn mlp", ("width=2",)))
    agent = api.agent(str(store.path), runs=tmp_path / "runs")
    observations, infos = agent.environments(20).reset(seed=0)
    chosen = agent.act(observations, infos=infos)
    mask = infos["action_mask"]
    assert mask[np.arange(20), chosen].all()
    for missing in (
        None,
        {},
        {"action_mask": mask[:3]},
        {"action_mask": mask[0]},
        {"action_mask": mask[:, :1]},
    ):
        with pytest.raises(OptionError, match=r"task 'taxi' has action masks: give act\(\) the infos"):
            agent.act(observations, infos=missing)


def test_a_published_agent_plays_another_task() -> None:
    entry = "beam6g/ddqn-vqc-native-220c0736"
    agent = api.agent(entry, task="beam6g-degree5", seed=7, published=True, runs="none")
    assert (agent.seed, agent.task, agent.entry.task.name) == (7, "beam6g-degree5", "beam6g-degree5")
    assert agent.act(agent.environments(3).reset(seed=0)[0]).shape == (3,)


def test_any_environment_that_draws_frames(tmp_path: Path) -> None:
    folder = counting(tmp_path)
    said = say("play", str(folder), "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "c.gif")).stdout
    assert "7 steps" in said
    assert "(8 frames, 0.0 MB)" in said
    shown = api.play(str(folder), runs=tmp_path / "runs")
    assert [frame[0, 0, 0] // 30 for frame in shown.frames] == list(range(8))
    assert [frame[0, 0, 1] // 20 for frame in shown.frames[1:]] == (5 + shown.actions).tolist()
    drawn = {int(frame[0, 0, 2]) for frame in shown.frames}
    assert len(drawn) == 1
    assert np.array_equal(shown.rewards, 5 + shown.actions + drawn.pop())
    assert np.isnan(shown.score)
    other = api.play(str(folder), episode=1, runs=tmp_path / "runs")
    assert other.frames[0][0, 0, 2] != shown.frames[0][0, 0, 2], "another episode"


def test_of_a_long_episode_some_frames_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "MOST_FRAMES", 3)
    shown = api.play(str(counting(tmp_path)), runs=tmp_path / "runs")
    assert [frame[0, 0, 0] // 30 for frame in shown.frames] == [0, 3, 6, 7]
    assert (shown.every, shown.fps) == (3, pytest.approx(10 / 3))


@pytest.mark.parametrize(
    ("kind", "message"),
    [("floats", "float64 of shape .* not an image"), ("raise", "render: ZeroDivisionError: no light")],
)
def test_what_is_no_frame_is_refused(kind: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(EnvironmentFailure, match=message):
        api.play(str(counting(tmp_path, kind)), runs=tmp_path / "runs")


def test_environments_that_draw_nothing_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    for task, message in (("planted", "it has no render_modes"), ("cartpole", "pygame is not installed")):
        folder = trainer(task, tmp_path)("runs", [0], 1, "mlp", ("width=4",))
        with pytest.raises(
            OptionError, match=f"environment '{task}' .*draw.* frames: .*{message}"
        ) as refused:
            api.play(str(folder), runs=tmp_path / "runs")
        assert "\n" not in str(refused.value)


def test_a_single_form_that_plays_something_else_is_not_shown(
    kept: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = BeamManagement6G.step

    def more(self: BeamManagement6G, action: Any) -> Any:
        observation, reward, *rest = step(self, action)
        return observation, reward + 0.01, *rest

    monkeypatch.setattr(BeamManagement6G, "step", more)
    with pytest.raises(EnvironmentFailure, match="its single form earns"):
        api.play(str(kept("runs", [0], 1)), runs=tmp_path / "runs")


def test_wrong_input(kept: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = kept("runs", [0], 1)
    monkeypatch.setenv("PATH", str(tmp_path))
    for words, message in (
        (["mlp", "--out", "x.txt"], r"the file's ending must be \.gif or \.mp4"),
        (["mlp", "--out", "x.mp4"], r"ffmpeg, which is not installed: write a \.gif"),
        (["mpl"], "no entry 'mpl'"),
        (["tiny/mlp", "--task", "cartpole"], "agents play only where both are equal"),
    ):
        with pytest.raises(QrlSuiteError, match=message):
            say("play", *words, "--runs", str(tmp_path / "runs"))
    with pytest.raises(OptionError, match="episode = -1"):
        api.play(str(folder), episode=-1, runs=tmp_path / "runs")


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_an_mp4_is_written(tmp_path: Path) -> None:
    api.play(str(counting(tmp_path)), runs=tmp_path / "runs").save(tmp_path / "c.mp4")
    assert b"ftyp" in (tmp_path / "c.mp4").read_bytes()[:16]
