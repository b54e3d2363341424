"""Ansaetze: functions (qubits, layers, options) -> `Circuit`.

`iqp`, `cx` and `cz` are the paper's structures. After H on every qubit, layer l applies for every qubit q, in
order, a variational gate with angles `scaling[l, q, k] * input[q] + weights[l, q, k]`, k = 0, 1, 2 (the gate and
the inputs are re-uploaded in every layer), and then, after every layer but the last, a static part.

Rings are closed: qubit q is followed by (q + 1) mod n. On two qubits the ring of `iqp`, `cx` and `cz` therefore
consists of both (0, 1) and (1, 0), as the definition says; on one qubit there is no neighbor: `cx` and `cz` then
have no entangling gate, and `iqp`, all of whose gates are controlled, is refused.

Their option `entangled` takes the coupling of the qubits out, to see what it contributes: `separable` has no gate on
two qubits (the gate of qubit q acts on q, and H on every qubit between layers, the same for all three structures:
without the H, neighboring RZ of `rot` would merge); `mean-field` has the same gates, and drops all correlations after
every gate on two qubits (`Circuit.mean_field`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.circuit.description import Circuit, Parameter
from qrlsuite.errors import OptionError
from qrlsuite.options import Since

GateName = Literal["rot", "xyz", "u3"]
Entangled = Literal[True, "separable", "mean-field"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class GateOptions:
    """Options of `iqp`, `cx` and `cz`."""

    gate: Annotated[
        GateName,
        Field(
            description="variational gate: rot = RZ RY RZ, xyz = RX then RY then RZ, u3 = U3(theta, phi, delta)"
        ),
    ] = "rot"
    entangled: Annotated[
        Entangled,
        Field(
            description="true: as defined; separable: no gate on two qubits; mean-field: the same gates, correlations "
            "dropped after each (not a circuit: native backend alone)"
        ),
        Since("0.2.0"),
    ] = True


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NoOptions:
    """An ansatz without options."""


def iqp(qubits: int, layers: int, options: GateOptions) -> Circuit:
    """Build the ring of controlled gates: control q, target (q + 1) mod n; static part: H on every qubit.

    Raises
    ------
    OptionError
        For fewer than two qubits.
    """
    if qubits == 1 and options.entangled != "separable":
        raise OptionError(
            "ansatz 'iqp' with 1 qubit: its gates are controlled by another qubit, so it needs 2 to 20; "
            "'cx' and 'cz' exist for 1 qubit"
        )

    return _reuploading(qubits, layers, options, _hadamards, controlled=True)


def cx(qubits: int, layers: int, options: GateOptions) -> Circuit:
    """Build gates on every qubit; static part: the ring CNOT(q, (q + 1) mod n) for q in order."""
    return _reuploading(qubits, layers, options, lambda circuit: _ring(circuit, "CNOT"), controlled=False)


def cz(qubits: int, layers: int, options: GateOptions) -> Circuit:
    """Build gates on every qubit; static part: the ring CZ(q, (q + 1) mod n) for q in order."""
    return _reuploading(qubits, layers, options, lambda circuit: _ring(circuit, "CZ"), controlled=False)


def skolik(qubits: int, layers: int, options: NoOptions) -> Circuit:
    """Build the data re-uploading circuit for Q-learning of Skolik, Jerbi & Dunjko (Quantum 6, 720, 2022).

    Every layer: RX(scaling[l, q] * input[q]), then RY(weights[l, q, 0]) and RZ(weights[l, q, 1]) on every qubit,
    then a closed ring of CZs (on two qubits, where both CZs would cancel, a single one). The scalings start
    at 1, the weights uniform in [0, 2 pi). The paper's last layer of rotations after the last encoding is
    this layer's own.
    """
    circuit = Circuit(qubits)
    scaling = circuit.parameter("scaling", (layers, qubits), low=1.0, high=1.0)
    weights = circuit.parameter("weights", (layers, qubits, 2))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, scaling[layer, q] * circuit.input(q))
            circuit.append("RY", q, weights[layer, q, 0])
            circuit.append("RZ", q, weights[layer, q, 1])
        if qubits == 2:
            circuit.append("CZ", (0, 1))
        else:
            _ring(circuit, "CZ")
    return circuit


def _reuploading(
    qubits: int, layers: int, options: GateOptions, static: Callable[[Circuit], None], controlled: bool
) -> Circuit:
    """Build H on every qubit, then `layers` times the gates, with the static part between layers."""
    if options.entangled == "separable":
        static, controlled = _hadamards, False
    circuit = Circuit(qubits, mean_field=options.entangled == "mean-field")
    scaling = circuit.parameter("scaling", (layers, qubits, 3))
    weights = circuit.parameter("weights", (layers, qubits, 3))
    _hadamards(circuit)
    for layer in range(layers):
        for q in range(qubits):
            _variational(circuit, options.gate, layer, q, scaling, weights, controlled)
        if layer < layers - 1:
            static(circuit)
    return circuit


def _variational(
    circuit: Circuit,
    gate: GateName,
    layer: int,
    q: int,
    scaling: Parameter,
    weights: Parameter,
    controlled: bool,
) -> None:
    """Append the gate of qubit q: on q itself, or controlled by q on its neighbor."""
    angles = [scaling[layer, q, k] * circuit.input(q) + weights[layer, q, k] for k in range(3)]
    target, control = ((q + 1) % circuit.qubits, q) if controlled else (q, None)
    if gate == "xyz":
        for name, angle in zip(("RX", "RY", "RZ"), angles):
            circuit.append(name, target, angle, control=control)
    else:
        circuit.append({"rot": "Rot", "u3": "U3"}[gate], target, *angles, control=control)


def _hadamards(circuit: Circuit) -> None:
    """Append H on every qubit."""
    for q in range(circuit.qubits):
        circuit.append("H", q)


def _ring(circuit: Circuit, gate: str) -> None:
    """Append a two-qubit gate on every (q, (q + 1) mod n), in order; nothing on a single qubit."""
    if circuit.qubits > 1:
        for q in range(circuit.qubits):
            circuit.append(gate, (q, (q + 1) % circuit.qubits))
