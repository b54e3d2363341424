"""The dynamical Lie algebra of a circuit: all that its gates can reach together if their angles are free.

A circuit is a product of exp(-i angle G) and fixed gates W. Its algebra is spanned by the generators i W^+ G W, with W
the fixed gates before each, and all their nested commutators. Its dimension says whether a deep circuit can do
everything (4^n - 1) or stays in a small part.

Every angle that varies, with an input or with a parameter, counts as a generator of its own, also where several share a
parameter: for such circuits the dimension is an upper bound.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Circuit
from qrlsuite.circuit.matrices import FIXED, ONE, ROTATIONS, Matrix, exponential

SMALL = 1e-9
"""Of the squared length of a commutator with unit generators: shorter ones are rounding."""


def generators(circuit: Circuit) -> Matrix:
    """Return the generators (G, 2^n, 2^n) of a circuit's varying angles, Hermitian and without trace."""
    n = circuit.qubits
    before: Matrix = np.eye(1 << n, dtype=np.complex128)
    found = []
    for operation in circuit:
        if operation.gate in FIXED:
            before = _on(FIXED[operation.gate], operation.wires, n) @ before
            continue
        for place, own in ROTATIONS[operation.gate]:
            whole = _on(own if operation.control is None else np.kron(ONE, own), operation.qubits, n)
            angle = operation.angles[place]
            if not angle.varies:
                before = exponential(whole, angle.constant) @ before
                continue
            whole = before.conj().T @ whole @ before
            found.append(whole - np.eye(1 << n) * (np.trace(whole) / (1 << n)))
    return np.array(found, dtype=np.complex128).reshape(-1, 1 << n, 1 << n)


def dimension(of: Matrix) -> int:
    """Return the dimension of the Lie algebra that generators make, as a real vector space.

    Parameters
    ----------
    of:
        (G, d, d), Hermitian and without trace. Up to d = 16 it takes seconds.
    """
    d = of.shape[-1]
    basis = _independent(_vectors(of), np.zeros((0, d * d)))
    simple = fresh = _matrices(basis, d)  # as many as their span has dimensions: all that brackets need
    while len(fresh) and len(basis) < d * d - 1:
        products = simple[:, None] @ fresh[None]
        brackets = 1j * (products - products.conj().swapaxes(-1, -2)).reshape(-1, d, d)
        new = _independent(_vectors(brackets), basis)
        basis = np.concatenate([basis, new])
        fresh = _matrices(new, d)
    return len(basis)


def _vectors(matrices: Matrix) -> NDArray[np.float64]:
    """Return Hermitian matrices (K, d, d) as vectors (K, d^2) of the same length."""
    above = np.triu_indices(matrices.shape[-1], 1)
    upper = matrices[:, *above] * math.sqrt(2.0)
    return np.concatenate([np.diagonal(matrices, axis1=1, axis2=2).real, upper.real, upper.imag], axis=1)


def _matrices(vectors: NDArray[np.float64], d: int) -> Matrix:
    """Return the matrices of vectors, with the length of a Pauli matrix, so that brackets keep their size."""
    diagonal, real, imaginary = np.split(vectors * math.sqrt(d), [d, d * (d + 1) // 2], axis=1)
    made = np.zeros((len(vectors), d, d), dtype=np.complex128)
    made[:, *np.triu_indices(d, 1)] = (real + 1j * imaginary) / math.sqrt(2.0)
    made += made.conj().swapaxes(-1, -2)
    made[:, range(d), range(d)] = diagonal
    return made


def _independent(vectors: NDArray[np.float64], basis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return orthonormal vectors that extend an orthonormal basis to the span of more vectors."""
    for _ in range(2):  # twice, against rounding
        vectors = vectors - (vectors @ basis.T) @ basis
    values, directions = np.linalg.eigh(vectors.T @ vectors)
    new: Any = directions[:, values > SMALL * max(1.0, len(vectors))].T
    return np.asarray(new, np.float64)


def _on(matrix: NDArray[np.complexfloating], wires: tuple[int, ...], n: int) -> Matrix:
    """Return a gate's matrix on all n qubits; qubit 0 is the highest bit."""
    k = len(wires)
    whole = np.eye(1 << n, dtype=np.complex128).reshape((2,) * n + (1 << n,))
    whole = np.tensordot(matrix.reshape((2,) * (2 * k)), whole, axes=(range(k, 2 * k), wires))
    return np.moveaxis(whole, range(k), wires).reshape(1 << n, 1 << n)
