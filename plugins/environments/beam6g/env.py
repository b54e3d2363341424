"""BeamManagement6G as a single `gymnasium.Env`."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from numpy.typing import NDArray

from qrlsuite.errors import OptionError
from qrlsuite.plugins.environments.beam6g import trajectory
from qrlsuite.plugins.environments.beam6g.episodes import EpisodeGenerator, Tables, reset_options
from qrlsuite.plugins.environments.beam6g.options import MAIN, parse
from qrlsuite.plugins.environments.beam6g.physics import Antenna, Name
from qrlsuite.plugins.environments.beam6g.render import FrameRenderer, Moment, Window, as_text
from qrlsuite.plugins.environments.beam6g.trajectory import Rejection
from qrlsuite.plugins.environments.beam6g.vector import spaces

ID = "qrlsuite/BeamManagement6G-v1"
RENDER_MODES = ("human", "rgb_array", "ansi")


class BeamManagement6G(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Serve a moving user by the best of several antennas, knowing only how the last choice went.

    ## Description

    A user walks on a random path through the square field [0, 6] x [0, 6] (lengths in units of the model),
    in which antennas with directed beams stand. At every step the agent chooses the antenna that serves the
    user; the antenna then takes the best of its 9 beams by itself. The agent sees neither the field nor the
    user's position: only which antenna served last, with which beam, and at what intensity. The nearest
    antenna is often not the best, because the beams of an array interfere.

    Source: "Benchmarking Quantum Reinforcement Learning", appendix "6G Beam forming and RL environment". By
    default the environment behaves as the paper's released code does, which differs from its text.

    ## Action Space

    `Discrete(A)`: the index of the antenna that serves the user at the next step.

    ## Observation Space

    `Box(0, 1, (3 * stack,), float32)`, the last antenna, intensity and beam; the oldest of `stack` observations
    comes first.

    | Num | Observation                                   | Min | Max | Unit                          |
    |-----|-----------------------------------------------|-----|-----|-------------------------------|
    | 0   | index of the antenna, divided by A - 1        | 0   | 1   | -                             |
    | 1   | received intensity                            | 0   | 1   | that on a beam's peak at R = 1|
    | 2   | index of the beam in the codebook, over 8     | 0   | 1   | -                             |

    ## Rewards

    The intensity that the chosen antenna's best beam gives at the user's new position, in [0, 1].

    ## Starting State

    The user stands at the beginning of a random path, served by the antenna that is best there; this
    intensity counts in the score although no action chose it. With `stack` > 1 the first observation is
    repeated. `reset(options={"support_points": points})`, points (degree, 2) in the field, fixes the path.

    ## Episode End

    After `steps` actions the user is at the end of the path and the episode is *terminated*: nothing comes
    after it. `info` then holds `received` and `optimal`, the sums of the received and of the best intensity
    over the steps 0 to `steps`, and `score`, the first over the second, in [0, 1].

    ## Arguments

    ```python
    import gymnasium
    import qrlsuite.plugins.environments.beam6g

    env = gymnasium.make(
        "qrlsuite/BeamManagement6G-v1",
        antennas=[((1.5, 1), (1, 0)), ((1.5, 5), (-1, 0)), ((4.5, 3), (0, 1))],
        degree=3,
        steps=200,
        physics="released",
        stack=1,
    )
    ```

    Arguments are the fields of `BeamOptions`; render modes are "rgb_array", "ansi" and "human", which needs pygame.

    ## Version History

    * v1: first release with qrlsuite; differs from the paper's `BeamManagement6G` in ending episodes as
      terminated only, and in keeping paths that a rounding error would reject.
    """

    # Gymnasium's checker tries every declared mode, so a window is declared where one can be shown.
    metadata = {
        "render_modes": [mode for mode in RENDER_MODES if mode != "human" or find_spec("pygame")],
        "render_fps": 20,
    }

    def __init__(
        self,
        antennas: tuple[Antenna, ...] | list[Antenna] = MAIN,
        degree: int = 3,
        steps: int = 200,
        physics: Name = "released",
        rejection: Rejection = "tolerant",
        stack: int = 1,
        render_mode: str | None = None,
    ) -> None:
        self.options = parse(
            {
                "antennas": antennas,
                "degree": degree,
                "steps": steps,
                "physics": physics,
                "rejection": rejection,
                "stack": stack,
            }
        )
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise OptionError(
                f"environment 'beam6g': render_mode = {render_mode!r}: Input should be "
                f"{' or '.join(map(repr, RENDER_MODES))}"
            )
        self.render_mode = render_mode
        self.observation_space, self.action_space = spaces(self.options)
        self._simulator = EpisodeGenerator(self.options)
        self._tables = Tables.empty(1, len(self.options.antennas), self.options.steps)
        self._support: NDArray[np.float64] | None = None
        self._step = 0
        self._served = 0
        self._received = 0.0
        self._frames: list[NDArray[np.float32]] = []
        self._window: Window | None = None
        self._picture: FrameRenderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; `options={"support_points": (degree, 2)}` fixes its path."""
        super().reset(seed=seed)
        settings = reset_options(options)
        support = (
            self._simulator.draw([self.np_random], [1])
            if settings is None
            else self._simulator.support(settings)[None]
        )
        self._simulator.fill(self._tables, np.arange(1), support)
        self._support = support
        antenna, intensity, beam = self._simulator.start(support)
        self._step = 0
        self._served = int(antenna[0])
        self._received = float(intensity[0])
        self._frames = [self._simulator.observation(antenna, intensity, beam)[0]] * self.options.stack
        self._picture = None
        if self.render_mode == "human":
            self.render()
        return np.concatenate(self._frames), {}

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Let antenna `action` serve the user at the next position."""
        if self._support is None or self._step == self.options.steps:
            raise ResetNeeded("call reset() before step(): no episode is running")
        if not self.action_space.contains(action):
            raise InvalidAction(
                f"the action must be an integer in 0..{len(self.options.antennas) - 1}, not {action!r}"
            )
        self._step += 1
        self._served = int(action)
        chosen = self._tables.intensity[:, self._served, self._step]
        beam = self._tables.beam[:, self._served, self._step]
        reward = float(chosen[0])
        self._received += reward
        newest = self._simulator.observation(np.array([self._served]), chosen, beam)[0]
        self._frames = [*self._frames[1:], newest]
        terminated = self._step == self.options.steps
        info: dict[str, Any] = {}
        if terminated:
            optimal = float(self._tables.optimal[0])
            info = {"score": self._received / optimal, "received": self._received, "optimal": optimal}
        if self.render_mode == "human":
            self.render()
        return np.concatenate(self._frames), reward, terminated, False, info

    def render(self) -> Any:
        """Show the field, the antennas, the beam that serves, the path and the user.

        Returns an image (height, width, 3) uint8 for "rgb_array", text for "ansi", None for "human", which
        shows a window.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() needs gymnasium.make(..., render_mode='rgb_array', 'ansi' or 'human')"
            )
            return None
        if self._support is None:
            raise ResetNeeded("call reset() before render()")
        moment = self._moment()
        if self.render_mode == "ansi":
            return as_text(self.options, moment)
        if self._picture is None:
            self._picture = FrameRenderer(self.options)
        image = self._picture.draw(moment)
        if self.render_mode == "rgb_array":
            return image
        if self._window is None:
            self._window = Window(self.metadata["render_fps"])
        self._window.show(image)
        return None

    def _moment(self) -> Moment:
        assert self._support is not None  # render() checked
        x, y = trajectory.positions(self._support, self.options.steps)
        return Moment(
            path=np.stack([x[0], y[0]], axis=1),
            step=self._step,
            antenna=self._served,
            beam=int(self._tables.beam[0, self._served, self._step]),
            intensity=float(self._tables.intensity[0, self._served, self._step]),
            best=int(self._tables.intensity[0, :, self._step].argmax()),
            received=self._received,
        )

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None


def register() -> None:
    """Register `qrlsuite/BeamManagement6G-v1` with Gymnasium; a second call does nothing."""
    known = gymnasium.registry.get(ID)
    if known is None or known.vector_entry_point is None:
        gymnasium.registry.pop(ID, None)  # `import qrlsuite` registers the single form alone
        package = "qrlsuite.plugins.environments.beam6g"
        gymnasium.register(
            ID,
            entry_point=f"{package}.env:BeamManagement6G",
            vector_entry_point=f"{package}.vector:make_vec",
        )
