"""A circuit that keeps the rules of ansatzes, which the tests beside this folder break one by one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.circuit import Circuit


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    entangler: Annotated[Literal["CZ", "CNOT"], Field(description="gate between neighbors of the ring")] = (
        "CZ"
    )


def build(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = Circuit(qubits)
    scaling = circuit.parameter("scaling", (layers, qubits), low=1.0, high=1.0)
    weights = circuit.parameter("weights", (layers, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RY", q, scaling[layer, q] * circuit.input(q))
        for pair in ring(qubits):
            circuit.append(options.entangler, pair)
        for q in range(qubits):
            circuit.append("RY", q, weights[layer, q])
    return circuit


def ring(qubits: int) -> list[tuple[int, int]]:
    pairs = [(q, (q + 1) % qubits) for q in range(qubits)]
    return pairs if qubits > 2 else pairs[: qubits - 1]
