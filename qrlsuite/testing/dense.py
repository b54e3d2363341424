"""A circuit's expectation values by dense matrices: slow, a few lines, and independent of every backend."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit import Angle, Circuit, Operation
from qrlsuite.circuit.description import FUNCTIONS, Encoding
from qrlsuite.circuit.matrices import FIXED, Matrix, Y, Z


def expectation_values(
    circuit: Circuit, inputs: NDArray[np.float64], parameters: Mapping[str, NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return the expectation values (len(circuit.observables),) of one input (circuit.inputs,)."""
    if circuit.mean_field:
        return _mean_field_values(circuit, inputs, parameters)
    n = circuit.qubits
    state = np.zeros((2,) * n, dtype=np.complex128)
    state[(0,) * n] = 1.0
    for operation in circuit.operations:
        matrix = _matrix(operation, [_angle(a, inputs, parameters) for a in operation.angles])
        wires = list(operation.qubits)
        k = len(wires)
        state = np.tensordot(matrix.reshape((2,) * (2 * k)), state, axes=(range(k, 2 * k), wires))
        state = np.moveaxis(state, range(k), wires)
    values = []
    for qubits, axes in zip(circuit.measured, circuit.axes):
        turned = state
        for q, axis in zip(qubits, axes):
            turned = np.moveaxis(np.tensordot(FIXED[axis], turned, axes=(1, q)), 0, q)
        values.append(float(np.vdot(state, turned).real))
    return np.array(values)


def _mean_field_values(
    circuit: Circuit, inputs: NDArray[np.float64], parameters: Mapping[str, NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Keep a density matrix per qubit; two that meet in a gate are traced out of their common state after it."""
    states = [np.diag([1, 0]).astype(np.complex128) for _ in range(circuit.qubits)]
    for operation in circuit.operations:
        matrix = _matrix(operation, [_angle(a, inputs, parameters) for a in operation.angles])
        if len(operation.qubits) == 1:
            (q,) = operation.qubits
            states[q] = matrix @ states[q] @ matrix.conj().T
            continue
        a, b = operation.qubits
        together = (matrix @ np.kron(states[a], states[b]) @ matrix.conj().T).reshape(2, 2, 2, 2)
        together /= np.einsum("ijij", together)  # else the rounding of the trace grows with every gate
        states[a], states[b] = np.einsum("ikjk->ij", together), np.einsum("kikj->ij", together)
    single = zip(circuit.measured, circuit.axes)
    return np.array([float(np.trace(FIXED[axis] @ states[q]).real) for (q,), axis in single])


def _angle(angle: Angle, inputs: NDArray[np.float64], parameters: Mapping[str, NDArray[np.float64]]) -> float:
    value = angle.constant
    if angle.input is not None or angle.scale is not None:
        scale = 1.0 if angle.scale is None else parameters[angle.scale.parameter].flat[angle.scale.index]
        first, second = (_feature(each, inputs) for each in (angle.input, angle.factor))
        value += float(scale * first * second * angle.times)
    if angle.weight is not None:
        value += float(parameters[angle.weight.parameter].flat[angle.weight.index])
    return value


def _feature(term: int | Encoding | None, inputs: NDArray[np.float64]) -> float:
    if not isinstance(term, Encoding):
        return 1.0 if term is None else float(inputs[term])
    values = [_angle(each, inputs, {}) for each in term.of]
    if term.function in FUNCTIONS:
        return float(getattr(np, term.function)(values[0]))
    return sum(values) if term.function == "sum" else math.prod(values)


def _rotation(pauli: Matrix, angle: float) -> Matrix:
    """Return exp(-i angle pauli / 2)."""
    rotated: Matrix = np.cos(angle / 2) * np.eye(2) - 1j * np.sin(angle / 2) * pauli
    return rotated


def _matrix(operation: Operation, angles: list[float]) -> Matrix:
    """Return the matrix of an operation on (control, wires): 2 x 2 or 4 x 4."""
    gate = operation.gate
    if gate in ("RX", "RY", "RZ"):
        matrix = _rotation(FIXED[gate[1]], angles[0])
    elif gate == "Rot":
        matrix = _rotation(Z, angles[2]) @ _rotation(Y, angles[1]) @ _rotation(Z, angles[0])
    elif gate == "U3":
        t, p, d = angles
        matrix = np.array(
            [
                [np.cos(t / 2), -np.exp(1j * d) * np.sin(t / 2)],
                [np.exp(1j * p) * np.sin(t / 2), np.exp(1j * (p + d)) * np.cos(t / 2)],
            ]
        )
    else:
        matrix = FIXED[gate]
    if operation.control is None:
        return matrix
    controlled = np.eye(4, dtype=np.complex128)
    controlled[2:, 2:] = matrix
    return controlled
