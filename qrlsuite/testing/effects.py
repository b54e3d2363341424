"""Finds inputs and parameters of a circuit that change no expectation value, and the likely cause.

A scalar need not have an effect: RZ on a qubit in 0, or right before the measurement of Z, changes no expectation
value. In the first and last layers of a circuit that repeats one pattern this is usual (the last RZ of Skolik, Jerbi
& Dunjko, Quantum 6, 720, 2022, for one), and it breaks no rule. These do break one:

- no expectation value depends on an input feature, at some size: the agent cannot see it;
- none depends on any scalar of a parameter, at some size: the whole parameter is trained for nothing;
- none depends on a scalar that is used in the middle third of a circuit with three layers per qubit. As many layers
  as there are qubits lie on either side of that third: enough for a chain of gates between neighbors to carry an
  effect from any qubit to any other.

Effects are found by gradients at random points, and their likely cause by the circuit's light cone.
"""

from __future__ import annotations

from typing import Any

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, create_backend, lightcone
from qrlsuite.testing.circuit_backend import sample
from qrlsuite.testing.findings import BrokenRuleError, require

POINTS = 4
"""Random points at which a gradient is taken."""

ZERO = 1e-9
"""Gradients below this are zero: rounding in float64 leaves some 1e-15, effects are above 1e-4 at these sizes."""

Scalar = tuple[str, int]
"""A trainable scalar: its parameter's name, and its index in the flattened (C order) array."""

_START = (
    "it acts on the starting state without effect, as gates about Z do on a qubit in 0, gates about X after H, and "
    "gates controlled by a qubit in 0; put RY before it"
)
_END = (
    "nothing after it makes a difference of it: gates about Z (RZ, CZ, RZZ) right before Z is measured change nothing, "
    "nor do gates on a qubit that meets no measured one afterwards; put RX or RY after it, or leave it out there"
)
_BOTH = (
    "neither what comes before nor what comes after lets it matter, as where every gate is about Z; put RY before "
    "it and after it"
)
_CANCELS = "it cancels within the circuit, as RZ(w), X, RZ(w) does; leave it out"


def size(qubits: int, layers: int) -> str:
    """Say how large a circuit is: `1 qubit, 2 layers`."""
    return f"{qubits} qubit{'s' * (qubits > 1)}, {layers} layer{'s' * (layers > 1)}"


def used_inputs(circuit: Circuit) -> set[int]:
    """Return the input features that set an angle."""
    return {feature for op in circuit.operations for angle in op.angles for feature in angle.inputs}


def uses(circuit: Circuit) -> dict[Scalar, list[int]]:
    """Return at which operations each trainable scalar sets an angle."""
    places: dict[Scalar, list[int]] = {}
    for index, op in enumerate(circuit.operations):
        for angle in op.angles:
            for element in angle.elements:
                places.setdefault((element.parameter, element.index), []).append(index)
    return places


def effective(circuit: Circuit) -> tuple[set[int], set[Scalar]]:
    """Return the input features, and the trainable scalars, that change an expectation value."""
    names = registry.load().names(specs.CircuitBackendSpec)
    require(
        bool(names), "no circuit backend is installed: install qrlsuite again, some are among its plugins"
    )
    x, parameters, cotangent = sample(circuit, POINTS)
    for leaf in (x, *parameters.values()):
        leaf.requires_grad_()
    values = create_backend("native" if "native" in names else names[0], circuit)(x, parameters)
    if values.requires_grad:
        values.backward(cotangent)  # type: ignore[no-untyped-call]

    def felt(leaf: Any) -> list[int]:
        if leaf.grad is None:
            return []
        rows = leaf.grad.flatten(0, 1) if leaf is x else leaf.grad
        return [int(i) for i in (rows.abs() > ZERO).any(0).flatten().nonzero()]

    return set(felt(x)), {(name, i) for name, leaf in parameters.items() for i in felt(leaf)}


def require_inputs_and_parameters(circuit: Circuit, size: str) -> None:
    """Require that every used input feature, and some scalar of every used parameter, has an effect."""
    used = uses(circuit)
    inputs, scalars = effective(circuit)
    for feature in sorted(used_inputs(circuit) - inputs):
        raise BrokenRuleError(
            f"{size}: input {feature} sets an angle, and no expectation value depends on it, so the agent cannot "
            f"see it: {cause(circuit, feature)}"
        )
    for name, parameter in circuit.parameters.items():
        mine = [scalar for scalar in used if scalar[0] == name]
        if mine and scalars.isdisjoint(mine):
            raise BrokenRuleError(
                f"{size}: no expectation value depends on any element of '{name}' of shape {parameter.shape}, so it "
                f"is trained for nothing: {cause(circuit, mine[0])}; or refuse this size with OptionError"
            )


def require_middle(circuit: Circuit, size: str) -> None:
    """Require that every trainable scalar that is used in the middle third of the gates has an effect."""
    _, scalars = effective(circuit)
    third = len(circuit) // 3
    idle = [
        scalar
        for scalar, places in uses(circuit).items()
        if scalar not in scalars and any(third <= position < len(circuit) - third for position in places)
    ]
    for name, index in idle[:1]:
        parameter = circuit.parameters[name]
        others = f", nor on {len(idle) - 1} more there" if len(idle) > 1 else ""
        raise BrokenRuleError(
            f"{size}: no expectation value depends on {parameter.written(index)} of shape {parameter.shape}, which "
            f"is used in the middle of the circuit{others}; it is trained for nothing: {cause(circuit, (name, index))}"
        )


def cause(circuit: Circuit, source: int | Scalar) -> str:
    """Say why an input feature or a trainable scalar has no effect."""
    mine = [
        use
        for use in lightcone.uses(circuit)
        if source in use.angle.inputs
        or source in {(each.parameter, each.index) for each in use.angle.elements}
    ]
    if any(use.alive for use in mine):
        return _CANCELS
    if any(any(use.observables) for use in mine):
        return _START
    return _END if any(use.state for use in mine) else _BOTH
