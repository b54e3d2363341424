"""Planted: name the class that a fixed circuit gives to a point; the positive control of "is it the quantum part?".

The circuit is `cx` with 2 qubits and 5 layers, gates `rot`; its parameters are constants below. So a `vqc-native` agent
of that size can be perfect, and `docs/controls.md` says how far the matched controls come.
Source of the idea: Jerbi et al., "Parametrized quantum policies for reinforcement learning" (2021), section 4.2.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite import options as option_words
from qrlsuite.circuit import ansatz, create_backend

if TYPE_CHECKING:
    import torch

QUBITS, LAYERS = 2, 5
MARGIN = 0.1
"""Points are drawn again where an expectation value lies nearer to its threshold: their class is not clear."""

SCALING = (
    ((0.06, 0.22, 0.78), (1.04, 0.66, 0.34)),
    ((0.9, 0.39, 0.49), (0.28, 0.43, 0.05)),
    ((0.9, 0.87, 0.75), (0.94, 0.89, 0.66)),
    ((0.69, 0.68, 0.96), (1.05, 1.08, 0.99)),
    ((0.48, 0.6, 0.5), (0.99, 0.7, 1.21)),
)
WEIGHTS = (
    ((0.61, 2.28, 3.36), (1.55, 0.79, 4.06)),
    ((3.6, 2.16, 4.0), (6.05, 3.31, 0.99)),
    ((6.05, 5.4, 2.84), (1.72, 1.82, 5.88)),
    ((4.78, 1.53, 3.27), (3.79, 3.97, 2.96)),
    ((1.5, 3.04, 2.27), (2.09, 1.58, 1.62)),
)
THRESHOLDS = (0.08, 0.18)
"""The medians of the expectation values over the square, so that classes are of about equal size."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PlantedOptions:
    """Options of Planted."""

    steps: Annotated[int, Field(ge=1, le=10_000, description="steps of an episode")] = 20


_own = threading.local()
"""The hidden circuit of each thread: a simulator is not to be shared between threads."""


def teacher() -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the hidden circuit: a function of points (N, 2) that returns <Z> of both qubits, (N, 2)."""
    import torch

    if not hasattr(_own, "teacher"):
        run = create_backend("native", ansatz("cx", QUBITS, LAYERS))
        state = {
            "scaling": torch.tensor([SCALING], dtype=torch.float64),
            "weights": torch.tensor([WEIGHTS], dtype=torch.float64),
        }
        _own.teacher = lambda points: run(points[None], state, None)[0]
    made: Callable[[torch.Tensor], torch.Tensor] = _own.teacher
    return made


def classify(points: NDArray[np.floating[Any]]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the class 0..3 of points (N, 2), and whether it is clear, both (N,).

    Bit k of the class is 1 where qubit k's <Z> exceeds its threshold.
    """
    import torch

    values = teacher()(torch.from_numpy(points.astype(np.float64)))
    above = values.numpy() - np.array(THRESHOLDS)
    return (above > 0) @ np.array([1, 2]), (np.abs(above) > MARGIN).all(axis=1)


class Planted(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Name the class of a new point at every step, as a hidden circuit classifies it.

    ## Description

    A contextual bandit: actions do not change later observations. The optimal policy is a circuit's by construction.

    ## Action Space

    `Discrete(4)`: the class.

    ## Observation Space

    `Box(-pi, pi, (2,), float32)`: the point, uniform over the square where the class is clear.

    ## Rewards

    1 for the right class, else 0: the best possible return is `steps`.

    ## Episode End

    The episode is *terminated* after `steps` steps; `info["score"]` is then the share of right answers.

    Arguments are the fields of `PlantedOptions`.
    """

    points: NDArray[np.float32]
    """(steps, 2): the observations of this episode."""
    classes: NDArray[np.int64]
    """(steps,): the right answers."""
    metadata = {"render_modes": []}

    def __init__(self, steps: int = 20) -> None:
        self.options: PlantedOptions = option_words.build(
            PlantedOptions, {"steps": steps}, "environment 'planted'"
        )
        self.observation_space = Box(-np.pi, np.pi, (2,), np.float32)
        self.action_space = Discrete(4)
        self.points = np.zeros((0, 2), np.float32)
        self.classes = np.zeros(0, np.int64)
        self._taken = self._right = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode with new points."""
        super().reset(seed=seed)
        needed = self.options.steps
        self.points, self.classes = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
        while len(self.points) < needed:
            drawn = self.np_random.uniform(-np.pi, np.pi, (2 * needed, 2)).astype(np.float32)
            classes, clear = classify(drawn)
            self.points = np.concatenate([self.points, drawn[clear]])[:needed]
            self.classes = np.concatenate([self.classes, classes[clear]])[:needed]
        self._taken = self._right = 0
        return self.points[0].copy(), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Name the class of the point that was shown.

        The observation after the last step is the last point again.
        """
        if not len(self.points) or self._taken == self.options.steps:
            raise ResetNeeded("call reset() before step()")
        if not self.action_space.contains(action):
            raise InvalidAction(f"the action must be one of 0, 1, 2, 3, not {action!r}")
        right = bool(action == self.classes[self._taken])
        self._taken += 1
        self._right += right
        ended = self._taken == self.options.steps
        info = {"score": self._right / self._taken} if ended else {}
        return self.points[self._taken - ended].copy(), float(right), ended, False, info
