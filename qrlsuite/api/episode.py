"""Shows an episode of a trained agent: as an animation in a file, and in a notebook."""

from __future__ import annotations

import base64
import dataclasses
import functools
import html
import io
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray
from PIL import Image
from rich.text import Text

import qrlsuite
from qrlsuite.api.trained import load
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import EnvironmentFailure, OptionError, QrlSuiteError
from qrlsuite.experiment.entry import Entry
from qrlsuite.gymlanes import GymLanes
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.store import write_atomically
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation
from qrlsuite.training.trainer import Policy, build_envs, play_episodes

ENDINGS = (".gif", ".mp4")
MOST_FRAMES = 500
"""Of a longer episode every second frame is drawn, or every third, and so on."""
FPS = 30
"""Frames per second of an environment that does not say how many it wants."""

Frame = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, repr=False)
class Episode(Shown):
    """One episode of one trained agent.

    Attributes
    ----------
    policy:
        The entry's label.
    seed:
        Seed of the agent.
    runs:
        Number of finished runs; this one has the best last validation score.
    task, number:
        The task, and the number of the episode in the evaluation.
    actions, rewards:
        Of its K steps: (K, ...) and (K,).
    score:
        As the task defines it; NaN where it knows no maximum.
    frames:
        Images (height, width, 3) of the beginning and of every `every`-th step.
    fps:
        Frames per second.
    """

    policy: str
    seed: int
    runs: int
    task: str
    number: int
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    score: float
    frames: Sequence[Frame]
    every: int
    fps: float

    def __str__(self) -> str:
        """Return policy, task and score in a line."""
        score = "" if np.isnan(self.score) else f", score {self.score:.3f}"
        return (
            f"{self.policy}, seed {self.seed} (best of {self.runs}): episode {self.number} of {self.task}, "
            f"{len(self.rewards)} steps, sum of rewards {self.rewards.sum():.3f}{score}"
        )

    def __rich__(self) -> Text:
        return Text(str(self))

    def _repr_html_(self) -> str:
        image = base64.b64encode(self.gif()).decode()
        return f'<p>{html.escape(str(self))}</p><img alt="episode" src="data:image/gif;base64,{image}">'

    def gif(self) -> bytes:
        """Return the animation as bytes of a gif, which repeats."""
        # one palette, without dithering: what stands still costs nothing then
        some = np.concatenate([self.frames[len(self.frames) * k // 5] for k in range(5)])
        palette = Image.fromarray(some).quantize(255, method=Image.Quantize.MAXCOVERAGE)
        images = [
            Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
            for frame in self.frames
        ]
        content = io.BytesIO()
        delay = max(20, round(1000 / self.fps / 10) * 10)  # viewers slow down what is faster
        first, *others = images
        first.save(content, "GIF", save_all=True, append_images=others, duration=delay, loop=0)
        return content.getvalue()

    def save(self, path: str | PathLike[str]) -> None:
        """Write the animation to a gif, or to an mp4 where the program `ffmpeg` is installed.

        Raises
        ------
        OptionError
            If the file has another ending, or `ffmpeg` is missing.
        StoreError
            If it cannot be written.
        """
        file = Path(path)
        check_ending(file)
        write_atomically(file, self.gif() if file.suffix == ".gif" else self._mp4())

    def _mp4(self) -> bytes:
        height, width = self.frames[0].shape[:2]
        given = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {self.fps:g} -i -"
        wanted = (
            "-vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -pix_fmt yuv420p -f mp4 -movflags frag_keyframe+empty_moov -"
        )
        words = [_ffmpeg(), "-loglevel", "error", *given.split(), *wanted.split()]
        done = subprocess.run(
            words, input=b"".join(map(bytes, self.frames)), capture_output=True, check=False
        )
        if done.returncode:
            said = " ".join(done.stderr.decode(errors="replace").split())[:200]
            raise OptionError(f"ffmpeg cannot write an mp4: {said}; write a .gif")
        return done.stdout


def check_ending(file: Path) -> None:
    """Refuse a file that no animation can be written to, before anything is played."""
    if file.suffix not in ENDINGS:
        raise OptionError(f"--out {file}: the file's ending must be {' or '.join(ENDINGS)}")
    if file.suffix == ".mp4":
        _ffmpeg()


def _ffmpeg() -> str:
    found = shutil.which("ffmpeg")
    if found is None:
        raise OptionError("an mp4 is written by the program ffmpeg, which is not installed: write a .gif")
    return found


def record(written: Selection, entry: str, number: int = 0, seed: int = 0) -> Episode:
    """Play an episode with an entry's best trained agent, and draw it: see `qrlsuite.api.play`."""
    agent = load(written, entry)
    played = agent.entry
    drawn = _Drawn(played)  # before anything is played
    streams = Streams(played.task.hash, seed)
    envs = build_envs(played, 1, lambda: None)
    envs.inner.autoreset = False
    envs.seed_lanes([streams.numpy("evaluation", number)])
    actions: list[NDArray[Any]] = []

    @functools.wraps(agent.trainer.act)
    def act(*seen: Any) -> NDArray[Any]:
        chosen = agent.trainer.act(*seen)
        actions.append(np.array(chosen[0]))
        return chosen

    policy: Policy = act
    ended = play_episodes(envs, lambda: policy)
    every = -(-len(actions) // MOST_FRAMES)
    frames, rewards = drawn.replay(actions, streams.numpy("evaluation", number), every)
    if not np.isclose(rewards.sum(), ended.returns[0], rtol=1e-5, atol=1e-5):
        raise EnvironmentFailure(
            f"environment '{played.task.environment.name}': its single form earns {rewards.sum():g} in the episode in "
            f"which its lanes earn {ended.returns[0]:g}, so it cannot be drawn: `qrlsuite check` says where they differ"
        )
    return Episode(
        agent.policy,
        agent.seed,
        agent.runs,
        played.task.name,
        number,
        np.stack(actions),
        rewards,
        float(ended.scores[0]) if evaluation.knows_scores(played) else float("nan"),
        frames,
        every,
        drawn.fps / every,
    )


class _Drawn:
    """The environment of a task once more, drawing frames.

    Lanes of Gymnasium's environments draw by the one that they hold. Lanes of their own draw nothing: the single form
    that their spec names plays the same actions beside them, from the same stream.

    Raises
    ------
    OptionError
        If the environment draws no frames.
    """

    def __init__(self, entry: Entry) -> None:
        self.name = entry.task.environment.name
        inner = build_envs(entry, 1, lambda: None).inner
        self.lanes: GymLanes | None = inner if isinstance(inner, GymLanes) else None
        if self.lanes is not None:
            self.env: gymnasium.Env[Any, Any] = self._with_frames(self.lanes.envs[0].spec)
            self.lanes.envs[0] = self.env
            self.lanes.autoreset = False
        else:
            qrlsuite.register_environments()
            options = dataclasses.asdict(entry.task.environment_options)
            if options.get("normalization") == "running":  # is the agent's, not the single environment's
                options["normalization"] = "none"
            self.env = self._with_frames(entry.task.environment.gymnasium_id, **options)
        self.fps = float(self.env.metadata.get("render_fps") or FPS)

    def _with_frames(self, env: Any, **options: Any) -> gymnasium.Env[Any, Any]:
        known = gymnasium.spec(env) if isinstance(env, str) else env
        cls = known.entry_point
        if isinstance(cls, str):
            cls = gymnasium.envs.registration.load_env_creator(cls)
        modes = getattr(cls, "metadata", {}).get("render_modes", [])
        if "rgb_array" not in modes:
            has = f"its render_modes are {', '.join(modes)}" if modes else "it has no render_modes"
            raise OptionError(f"environment '{self.name}' draws no frames: {has}, and 'rgb_array' is needed")
        try:
            made: gymnasium.Env[Any, Any] = gymnasium.make(
                known, render_mode="rgb_array", disable_env_checker=True, **options
            )
        except DependencyNotInstalled as error:
            raise OptionError(f"environment '{self.name}' cannot draw frames: {error}") from None
        except QrlSuiteError:
            raise
        except Exception as error:  # whatever a stranger's environment raises
            raise OptionError(
                f"environment '{self.name}' cannot be made with render_mode='rgb_array': {error}"
            ) from error
        return made

    def replay(
        self, actions: Sequence[NDArray[Any]], stream: np.random.Generator, every: int
    ) -> tuple[list[Frame], NDArray[np.float64]]:
        """Return the frames of an episode with these actions, and its rewards (K,)."""
        rewards = list[float]()
        frames = list[Frame]()
        try:
            for step, reward in enumerate(self._steps(actions, stream)):
                rewards += [reward] if step else []
                if step % every == 0 or step == len(actions):
                    frames.append(self._frame())
        finally:
            self.env.close()
        return frames, np.array(rewards)

    def _steps(self, actions: Sequence[NDArray[Any]], stream: np.random.Generator) -> Iterator[float]:
        """Yield 0 after the reset, and the reward of every step after it."""
        if self.lanes is not None:
            self.lanes.seed_lanes([stream])
            self.lanes.reset()
            yield 0.0
            for action in actions:
                yield float(self.lanes.step(action[None])[1][0])
            return
        self.env.unwrapped.np_random = stream
        self.env.reset()
        yield 0.0
        for action in actions:
            yield float(self.env.step(action[()] if action.ndim == 0 else action)[1])

    def _frame(self) -> Frame:
        try:
            image: Any = self.env.render()
        except DependencyNotInstalled as error:
            raise OptionError(f"environment '{self.name}' cannot draw frames: {error}") from None
        except Exception as error:  # whatever a stranger's environment raises
            raise EnvironmentFailure(
                f"environment '{self.name}', render: {type(error).__name__}: {error}"
            ) from error
        frame = np.asarray(image)
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            raise EnvironmentFailure(
                f"environment '{self.name}': render() gave {frame.dtype} of shape {frame.shape}, not an image (height, "
                "width, 3) uint8"
            )
        return frame.copy()
