"""The matrices of Pauli and of the fixed gates of `qrlsuite.circuit.GATES`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.complex128]

X: Matrix = np.array([[0, 1], [1, 0]], dtype=np.complex128)
Y: Matrix = np.array([[0, -1j], [1j, 0]])
Z: Matrix = np.diag([1, -1]).astype(np.complex128)
FIXED: dict[str, Matrix] = {
    "H": (X + Z) / np.sqrt(2),
    "X": X,
    "Y": Y,
    "Z": Z,
    "S": np.diag([1, 1j]),
    "T": np.diag([1, np.exp(0.25j * np.pi)]),
    "CNOT": np.eye(4, dtype=np.complex128)[[0, 1, 3, 2]],
    "CZ": np.diag([1, 1, 1, -1]).astype(np.complex128),
    "SWAP": np.eye(4, dtype=np.complex128)[[0, 2, 1, 3]],
}


def rotation(pauli: Matrix, angle: float) -> Matrix:
    """Return exp(-i angle pauli / 2)."""
    rotated: Matrix = np.cos(angle / 2) * np.eye(2) - 1j * np.sin(angle / 2) * pauli
    return rotated
