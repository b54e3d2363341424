"""Common parts of the quantum tasks: Pauli matrices, and one lane that is drawn."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.plugins.environments.quantum.pictures import pixels
from qrlsuite.plugins.environments.single import Single

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
    """Return all Pauli words of `qubits` qubits except the identity, in alphabetical order."""
    return ["".join(each) for each in product("IXYZ", repeat=qubits)][1:]


class Drawn(Single):
    """One lane that remembers the actions of this episode, and draws them with matplotlib."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}

    done: list[Any]
    """The episode's actions."""
    shown: list[Any]
    """Results of `moment` after the reset and after every step."""

    def moment(self) -> Any:
        """Return data of this moment for the picture."""
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
