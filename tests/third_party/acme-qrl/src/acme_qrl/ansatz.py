"""Transverse-field circuit: re-uploaded RY, RZZ(c) = exp(-i c Z Z / 2) around a ring, RX."""

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from qrlsuite.circuit import Circuit
from qrlsuite.errors import OptionError


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """None yet."""


def build(qubits, layers, options):
    if qubits < 2:
        raise OptionError("ansatz 'rzz-ring' couples neighbors: it needs 2 to 20 qubits")
    pairs = [(q, (q + 1) % qubits) for q in range(qubits if qubits > 2 else 1)]
    circuit = Circuit(qubits)
    scaling = circuit.parameter("scaling", (layers, qubits), low=1.0, high=1.0)
    coupling = circuit.parameter("coupling", (layers, len(pairs)))
    field = circuit.parameter("field", (layers, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RY", q, scaling[layer, q] * circuit.input(q))
        for k, pair in enumerate(pairs):
            circuit.append("CNOT", pair)
            circuit.append("RZ", pair[1], coupling[layer, k])
            circuit.append("CNOT", pair)
        for q in range(qubits):
            circuit.append("RX", q, field[layer, q])
    return circuit
