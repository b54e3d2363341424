"""The Pauli matrices, and the matrices of the gates in `qrlsuite.circuit.GATES`."""

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

ONE: Matrix = np.diag([0, 1]).astype(np.complex128)
ROTATIONS: dict[str, tuple[tuple[int, Matrix], ...]] = {
    "RX": ((0, X / 2),),
    "RY": ((0, Y / 2),),
    "RZ": ((0, Z / 2),),
    "Rot": ((0, Z / 2), (1, Y / 2), (2, Z / 2)),
    "U3": ((2, -ONE), (0, Y / 2), (1, -ONE)),
}
"""Gates with angles, as exp(-i angle G) in order of application: the place of the angle, and G."""


def exponential(generator: Matrix, angle: float) -> Matrix:
    """Return exp(-i angle G) of a Hermitian matrix G."""
    values, vectors = np.linalg.eigh(generator)
    turned: Matrix = (vectors * np.exp(-1j * angle * values)) @ vectors.conj().T
    return turned
