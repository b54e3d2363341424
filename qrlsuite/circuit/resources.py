"""Resources of circuits: gates, depths, and executions for gradients on hardware."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from qrlsuite.circuit.description import Circuit, Operation, in_bases


@dataclass(frozen=True)
class Resources:
    """The resources of a circuit, in the gates of its definition.

    Attributes
    ----------
    qubits, inputs, parameters:
        Numbers of qubits, input features and trainable scalars.
    gates:
        Number of gates by name; a controlled one has a `C` in front (`CRot`).
    two_qubit_depth:
        Two-qubit gates on the longest path through the circuit: gates on disjoint qubits count as one step.
    depth:
        Gates on the longest path through the circuit.
    shift_evaluations:
        Circuit executions that the parameter-shift rule takes for the gradient at one input: two for every
        variable angle of an uncontrolled rotation, four for one of a controlled rotation, in each measurement basis.
    """

    qubits: int
    inputs: int
    parameters: int
    gates: dict[str, int]
    two_qubit_gates: int
    two_qubit_depth: int
    depth: int
    shift_evaluations: int


def resources(circuit: Circuit) -> Resources:
    """Count a circuit's resources."""
    operations = circuit.operations
    return Resources(
        qubits=circuit.qubits,
        inputs=circuit.inputs,
        parameters=circuit.parameter_count,
        gates=dict(Counter(gate_name(operation) for operation in operations)),
        two_qubit_gates=sum(len(operation.qubits) == 2 for operation in operations),
        two_qubit_depth=_depth(circuit, weight=lambda operation: len(operation.qubits) == 2),
        depth=_depth(circuit, weight=lambda operation: True),
        shift_evaluations=shift_evaluations(circuit),
    )


def shift_evaluations(circuit: Circuit) -> int:
    """Return how many circuit executions the parameter-shift rule takes for the gradient at one input.

    Two per variable angle of an uncontrolled rotation, four of a controlled one (Wierichs et al. 2022, Quantum 6,
    677), none for constants; each in every measurement basis.
    """
    return len(in_bases(circuit)) * sum(
        4 if operation.control is not None else 2
        for operation in circuit
        for angle in operation.angles
        if angle.varies
    )


LARGEST_RANK = 12
"""Qubits that gates connect up to which `jacobian_rank` is quick: seconds."""


def jacobian_rank(circuit: Circuit, seed: int = 0) -> int | None:
    """Return how many directions of its parameters change a circuit's function, to first order.

    It is the rank of the Jacobian of all expectation values by all parameters, at random parameters as they are drawn
    initially and at more than enough random inputs of a standard normal distribution. The rest of the parameters are
    scalars without effect, such as a last RZ, and scalars that others can replace.

    Parameters
    ----------
    seed:
        Seed of the random parameters and inputs.

    Returns
    -------
    int or None
        None where gates connect more than `LARGEST_RANK` qubits, which takes too long.
    """
    if not circuit.mean_field and max(map(len, circuit.components())) > LARGEST_RANK:
        return None
    if circuit.parameter_count == 0:
        return 0
    import torch

    from qrlsuite.circuit.jacobian import jacobians

    points = -(-2 * circuit.parameter_count // len(circuit.observables)) + 8
    source = torch.Generator().manual_seed(seed)
    x = torch.randn(points, 1, circuit.inputs, generator=source, dtype=torch.float64)
    parameters = {}
    for name, parameter in circuit.parameters.items():
        drawn = torch.rand(parameter.shape, generator=source, dtype=torch.float64)
        drawn = parameter.low + (parameter.high - parameter.low) * drawn
        parameters[name] = drawn.expand(points, *parameter.shape).numpy()
    rows = torch.from_numpy(jacobians(circuit, x[:, 0].numpy(), parameters)).flatten(0, 1)
    return int(torch.linalg.matrix_rank(rows, rtol=RANK_TOLERANCE))


RANK_TOLERANCE = 1e-10
"""Singular values below this part of the largest one are rounding."""


def gate_name(operation: Operation) -> str:
    """Return the name of a gate, with a `C` in front where it has an extra control."""
    return operation.gate if operation.control is None else f"C{operation.gate}"


def _depth(circuit: Circuit, weight: Callable[[Operation], bool]) -> int:
    """Return the largest sum of weights along a path through the circuit."""
    reached = [0] * circuit.qubits
    for operation in circuit:
        level = max(reached[q] for q in operation.qubits) + int(weight(operation))
        for q in operation.qubits:
            reached[q] = level
    return max(reached)
