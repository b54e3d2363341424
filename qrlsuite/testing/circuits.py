"""Circuits on which backends are compared."""

from __future__ import annotations

from qrlsuite.circuit import GATES, Circuit


def every_gate(mean_field: bool = False) -> Circuit:
    """Return a circuit of three qubits with every gate, controlled ones too, and angles of every form."""
    circuit = Circuit(3, inputs=2, mean_field=mean_field)
    scale = circuit.parameter("scale", (2, 3))
    weight = circuit.parameter("weight", (12,))
    circuit.append("RX", 0, scale[0, 0] * circuit.input(0) + weight[0])
    circuit.append("RY", 1, circuit.input(1) + 0.3)
    circuit.append("H", 2)
    circuit.append("RZ", 2, weight[1])
    circuit.append("CNOT", (0, 1))
    angles = [scale[0, k] * circuit.input(1) + weight[2 + k] for k in (1, 2)]
    circuit.append("Rot", 1, weight[9], *angles)
    circuit.append("U3", 2, scale[1, 0] * circuit.input(0) + weight[5], weight[6], 0.7)
    circuit.append("CZ", (1, 2))
    circuit.append("RX", 1, 0.8)
    circuit.append("SWAP", (0, 2))
    circuit.append("RY", 0, 0.5)
    for gate in ("S", "X", "T", "Y"):
        circuit.append(gate, 1)
    circuit.append("RX", 1, weight[7], control=0)
    circuit.append("Z", 1)
    circuit.append("RY", 2, scale[1, 1] * circuit.input(0), control=1)
    circuit.append("RZ", 0, scale[1, 2] * circuit.input(1) + weight[8], control=2)
    circuit.append("Rot", 0, weight[10], 0.4, weight[11], control=1)
    circuit.append("U3", 1, 0.2, weight[3], weight[4], control=2)
    for q in range(3):
        circuit.append("RX", q, 0.9 + 0.2 * q)
    circuit.append("CNOT", (1, 2))
    circuit.append("RY", 0, 0.6, control=1)
    assert {operation.gate for operation in circuit.operations} == set(GATES)
    circuit.measure((2, 0))
    return circuit


def small() -> Circuit:
    """Return a circuit of two qubits, for slow checks."""
    circuit = Circuit(2)
    weights = circuit.parameter("weights", (2,))
    for q in range(2):
        circuit.append("RY", q, circuit.input(q) + weights[q])
    circuit.append("CNOT", (0, 1))
    return circuit


def one_gate(gate: str, controlled: bool) -> Circuit:
    """Return a circuit of two qubits with one gate, from qubit 1 to qubit 0, between rotations about X and Y."""
    circuit = Circuit(2)
    weights = circuit.parameter("weights", (11,))
    for q in range(2):
        circuit.append("RX", q, weights[q])
        circuit.append("RY", q, circuit.input(q) + weights[2 + q])
    kind = GATES[gate]
    angles = [weights[4 + k] for k in range(kind.angles)]
    circuit.append(gate, (1, 0)[: kind.wires], *angles, control=0 if controlled else None)
    for q in range(2):
        circuit.append("RY", q, weights[7 + q])
        circuit.append("RX", q, weights[9 + q])
    return circuit
