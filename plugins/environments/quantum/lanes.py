"""What the quantum tasks share: lanes that begin, step, end and are saved in one way, and Pauli matrices."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from qrlsuite.actions import check_actions
from qrlsuite.environment import LaneEnv, OneLane, State, batched_spaces, endings, require_state
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.quantum.pictures import pixels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
PAULI: dict[str, ComplexArray] = {
    "I": np.eye(2, dtype=np.complex128),
    "X": np.array([[0, 1], [1, 0]], np.complex128),
    "Y": np.array([[0, -1j], [1j, 0]]),
    "Z": np.array([[1, 0], [0, -1]], np.complex128),
}


def pauli(word: str) -> ComplexArray:
    """Return the Pauli matrix of a word such as "XZ", (2^n, 2^n); its first letter acts on qubit 0, the left factor."""
    result = np.eye(1, dtype=np.complex128)
    for letter in word:
        result = np.kron(result, PAULI[letter]).astype(np.complex128)
    return result


def words(qubits: int) -> list[str]:
    """Return all Pauli words of `qubits` qubits but that of identities, in alphabetical order."""
    return ["".join(each) for each in product("IXYZ", repeat=qubits)][1:]


class QuantumLanes(LaneEnv):
    """Lanes of a quantum task: same-step autoreset, with what differs between tasks in five methods.

    A subclass makes its arrays in `_arrays`, lane first, and says how episodes begin (`_draw`, `_begin`), what an
    action does (`_act`), what is seen (`_seen`) and what an ended episode is worth (`_scores`). A lane whose episode
    ended stays as it is until it is reset.
    """

    name: ClassVar[str]
    cut: ClassVar[bool] = False
    """True: the last step truncates an episode. False: it terminates it, for it belongs to the task."""

    def __init__(
        self,
        options: Any,
        num_envs: int,
        observation: gymnasium.Space[Any],
        action: gymnasium.Space[Any],
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.options = options
        batched_spaces(self, observation, action, num_envs)
        self.streams = []
        self.step_count = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._begun = False

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the task's state by name, lane first: the arrays themselves."""
        raise NotImplementedError

    def _draw(self, stream: np.random.Generator, count: int) -> Any:
        """Draw what `count` episodes begin with: an array with that first axis."""
        raise NotImplementedError

    def _begin(self, lanes: NDArray[np.intp], drawn: Any) -> None:
        """Put `lanes` at the beginning of episodes with what was drawn for them."""
        raise NotImplementedError

    def _act(self, actions: NDArray[Any], running: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Change the lanes that run; return rewards, and whether an episode ends before its last step, (L,) each."""
        raise NotImplementedError

    def _seen(self) -> NDArray[np.float32]:
        """Return what every lane sees, a new array."""
        raise NotImplementedError

    def _scores(self) -> FloatArray:
        """Return what each lane's episode is worth if it ends now, (L,) in [0, 1]."""
        raise NotImplementedError

    def _metrics(self) -> dict[str, FloatArray]:
        """Return what else is measured at an episode's end, (L,) by name."""
        return {}

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        """Return whether arrays of the right shapes are a state."""
        return True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; returns observations (L, n) and an empty dictionary.

        Raises
        ------
        qrlsuite.errors.OptionError
            If `options` are given: there are none.
        """
        if options:
            raise OptionError(f"environment '{self.name}': reset() takes no option, not {sorted(options)}")
        if seed is not None or not self.streams:
            self.seed_from(seed)
        self._restart(np.arange(self.num_envs))
        self._begun = True
        return self._seen(), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], FloatArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Take a step in every lane.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If there was no reset.
        gymnasium.error.InvalidAction
            If an action is none of the space.
        """
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions)
        check_actions(actions, self.num_envs, self.single_action_space)
        running = ~self._ended
        self.step_count += running
        rewards, ends = self._act(actions, running)
        last = (self.step_count >= self.options.steps) & running
        terminated = ends & running if self.cut else (ends & running) | last
        truncated = last & ~terminated
        seen, done = self._seen(), terminated | truncated
        infos: dict[str, Any] = {}
        if done.any():
            infos = endings(done, seen, score=self._scores())
            if metrics := self._metrics():
                infos["final_info"]["metrics"] = {
                    name: np.where(done, values, np.nan) for name, values in metrics.items()
                }
            self._ended |= done
            if self.autoreset:
                self._restart(np.flatnonzero(done))
                seen = self._seen()
        return seen, np.where(running, rewards, 0.0), terminated, truncated, infos

    def state_dict(self) -> State:
        """Return the episodes' state, lane-first.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If there was no reset.
        """
        if not self._begun:
            raise ResetNeeded("call reset() before state_dict()")
        return {name: value.copy() for name, value in self._state().items()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue where `state_dict` was taken; states may be sliced and joined along the lanes.

        Raises
        ------
        qrlsuite.errors.StoreError
            If an array is missing, has another shape, or holds what cannot be; nothing is changed then.
        """
        known = self._state()
        require_state(self.name, state, {name: value.shape for name, value in known.items()})
        steps = state["step"]
        if steps.min() < 0 or steps.max() > self.options.steps or not self._possible(state):
            raise StoreError(f"{self.name}: the state is none of an episode of {self.options.steps} steps")
        for name, value in known.items():
            value[...] = state[name]
        self._begun = True

    def _state(self) -> dict[str, NDArray[Any]]:
        return {**self._arrays(), "step": self.step_count, "ended": self._ended}

    def _restart(self, lanes: NDArray[np.intp]) -> None:
        """Begin new episodes in `lanes` (ascending), each from its lane's stream."""
        owners, counts = np.unique(lanes // (self.num_envs // len(self.streams)), return_counts=True)
        pairs = zip(owners.tolist(), counts.tolist())
        self._begin(lanes, np.concatenate([self._draw(self.streams[owner], n) for owner, n in pairs]))
        self.step_count[lanes] = 0
        self._ended[lanes] = False


class Drawn(OneLane):
    """One lane that remembers what was done in this episode, and draws it with matplotlib."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(self, lanes: QuantumLanes, render_mode: str | None) -> None:
        super().__init__(lanes)
        self.render_mode = render_mode
        self.done: list[Any] = []
        """The episode's actions."""
        self.shown: list[Any] = []
        """What `moment` returned after the reset and after every step."""

    def moment(self) -> Any:
        """Return what the picture needs of this moment."""
        raise NotImplementedError

    def figure(self) -> Figure:
        """Return the picture of this moment."""
        raise NotImplementedError

    def render(self) -> NDArray[np.uint8]:
        """Return the picture of this moment, (height, width, 3) uint8."""
        return pixels(self.figure())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode."""
        result = super().reset(seed=seed, options=options)
        self.done, self.shown = [], [self.moment()]
        return result

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take a step; see `qrlsuite.environment.OneLane.step`."""
        result = super().step(action)
        self.done.append(action)
        self.shown.append(self.moment())
        return result
