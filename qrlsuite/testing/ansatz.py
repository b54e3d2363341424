"""What an ansatz keeps to: a pure function of its arguments whose every input and parameter matters.

A scalar that sets an angle need not matter: RZ on a qubit in 0, or right before the measurement of Z, changes no
expectation value. In the first and last layers of a circuit that repeats one pattern this is usual (the last RZ of
Skolik, Jerbi & Dunjko 2022, for one), and it breaks no rule; a passing check names these scalars. The rule `effects`
is broken where it cannot be the price of a pattern:

- no expectation value depends on an input feature, at any size: the agent cannot see it;
- none depends on any scalar of a parameter, at any size: the whole parameter is trained for nothing;
- none depends on a scalar that is used in the middle third of a circuit with three layers per qubit. A third of
  that circuit, as many layers as there are qubits, lies on either side: enough for a chain of gates between
  neighbors to carry an effect from any qubit to any other.

Effects are found by gradients at random points, and their likely cause by another gradient: of the same circuit begun
in a random entangled state, or measured in a random basis.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, Parameter, create_backend
from qrlsuite.errors import OptionError
from qrlsuite.testing.common import Subject
from qrlsuite.testing.dense import expectation_values
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, one_thread, require

QUBITS, LAYERS = (1, 2, 3, 4), (1, 2, 3)
LARGEST = 20
POINTS = 4
"""Random points at which a gradient is taken."""
ZERO = 1e-9
"""Gradients of float64 below this are zero: rounding leaves some 1e-15, effects at these sizes are above 1e-4."""

Circuits = dict[tuple[int, int], Circuit]

_START = (
    "it acts on the starting state without effect, as gates about Z do on a qubit in 0, gates about X after H, and gates "
    "controlled by a qubit in 0; put RY before it"
)
_END = (
    "nothing after it makes a difference of it: gates about Z (RZ, CZ, RZZ) right before Z is measured change nothing, "
    "nor do gates on a qubit that meets no measured one afterwards; put RX or RY after it, or leave it out there"
)
_BOTH = f"neither what comes before nor what comes after lets it matter: {_START}, and RX or RY after it"
_CANCELS = "it cancels within the circuit, as RZ(w), X, RZ(w), X does; leave it out"


def check(subject: Subject) -> list[Finding]:
    """Check an ansatz at 1 to 4 qubits, with 1 to 3 layers and with three per qubit."""
    spec = subject.spec
    assert isinstance(spec, specs.AnsatzSpec)
    build, given = specs.resolve(spec.build), subject.options()
    circuits: Circuits = {}
    rules = Checklist()
    if not rules.run("builds", "1 to 4 qubits, 1 to 12 layers", lambda: _builds(build, given, circuits)):
        return rules.findings
    rules.run("pure", "built twice, it is the same circuit", lambda: _pure(build, given, circuits))
    rules.run("inputs used", "every input feature sets an angle", lambda: _inputs(circuits))
    rules.run("parameters used", "every trainable scalar sets an angle", lambda: _parameters(circuits))
    longer = rules.run("layers", "more layers make a longer circuit", lambda: _layers(circuits))
    with one_thread():
        found = "every input and every parameter changes an expectation value"
        if rules.run("effects", found, lambda: _effects(circuits, longer)):
            rules.findings[-1] = Finding("effects", True, f"{found}{_idle(circuits)}")
        same = "every installed backend gives the values of dense matrices"
        if rules.run("backends", same, lambda: _backends(circuits)):
            rules.run(
                "gradients",
                "of every installed backend match finite differences",
                lambda: _gradients(circuits),
            )
    return rules.findings


def _builds(build: Any, given: Any, circuits: Circuits) -> None:
    refused = ""
    sizes = {(qubits, layers) for qubits in QUBITS for layers in (*LAYERS, 3 * qubits)} | {(LARGEST, 1)}
    for qubits, layers in sorted(sizes):
        where = _size(qubits, layers)
        try:
            circuit = build(qubits, layers, given)
        except OptionError as error:  # an ansatz may refuse a size, in words
            refused = str(error)
            continue
        except Exception as error:
            raise BrokenRuleError(
                f"{where}: {type(error).__name__}: {error}; an ansatz that cannot have this size raises "
                "qrlsuite.errors.OptionError and says which sizes it can have"
            ) from error
        require(
            isinstance(circuit, Circuit),
            f"build returned {type(circuit).__name__}, not a qrlsuite.circuit.Circuit: is `return circuit` there?",
        )
        require(
            circuit.qubits == qubits,
            f"asked for {qubits} qubits, the circuit has {circuit.qubits}: write Circuit(qubits)",
        )
        require(bool(circuit.operations), f"{where}: the circuit has no gate; append some before `return`")
        if qubits != LARGEST:
            circuits[qubits, layers] = circuit
    require(
        any(layers in LAYERS for _, layers in circuits),
        f"it refuses every size of 1 to 4 qubits and 1 to 3 layers: {refused}; models with few qubits are what "
        "people try first",
    )


def _size(qubits: int, layers: int) -> str:
    return f"{qubits} qubit{'s' * (qubits > 1)}, {layers} layer{'s' * (layers > 1)}"


def _pure(build: Any, given: Any, circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        before = _content(circuit)  # kept apart: an ansatz that remembers may go on with the same object
        require(
            before == _content(build(qubits, layers, given)) == _content(circuit),
            f"{_size(qubits, layers)}: built twice, the circuits differ; an ansatz must not draw random numbers or "
            "remember anything, for each agent builds its own: make the Circuit inside the function",
        )


def _content(circuit: Circuit) -> tuple[Any, ...]:
    return circuit.inputs, circuit.operations, tuple(circuit.parameters.values()), circuit.observables


def _inputs(circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        unused = sorted(set(range(circuit.inputs)) - _used_inputs(circuit))
        require(
            not unused,
            f"{_size(qubits, layers)}: input {unused[0] if unused else ''} sets no angle, so the agent "
            "cannot see it; encode it with circuit.append('RX', q, circuit.input(q))",
        )


def _used_inputs(circuit: Circuit) -> set[int]:
    return {angle.input for op in circuit.operations for angle in op.angles if angle.input is not None}


def _uses(circuit: Circuit) -> dict[tuple[str, int], list[int]]:
    """Return at which operations each trainable scalar (name, index) sets an angle."""
    places: dict[tuple[str, int], list[int]] = {}
    for place, op in enumerate(circuit.operations):
        for angle in op.angles:
            for element in (angle.scale, angle.weight):
                if element is not None:
                    places.setdefault((element.parameter, element.index), []).append(place)
    return places


def _element(parameter: Parameter, index: int) -> str:
    """Return a scalar as one writes it: `weights[1, 2]`."""
    return f"{parameter.name}{[int(i) for i in np.unravel_index(index, parameter.shape)]}"


def _parameters(circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        where, used = _size(qubits, layers), _uses(circuit)
        require(
            bool(circuit.parameters),
            f"{where}: there is no trainable parameter; declare some with circuit.parameter('weights', (layers, qubits))",
        )
        for name, parameter in circuit.parameters.items():
            unused = [i for i in range(parameter.size) if (name, i) not in used]
            require(
                not unused,
                f"{where}: {_element(parameter, unused[0] if unused else 0)} of shape {parameter.shape} sets no angle "
                f"({len(unused)} of {parameter.size} do not); declare a smaller parameter or use all of it",
            )


def _layers(circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        longer = circuits.get((qubits, layers + 1))
        require(
            longer is None or len(longer.operations) > len(circuit.operations),
            f"{_size(qubits, layers + 1)}: the circuit has no more gates than with {layers}; is the loop over layers "
            "there?",
        )


def _sample(circuit: Circuit, seeds: int = 1) -> tuple[Any, dict[str, Any], Any]:
    """Return inputs (seeds, 2, in) and parameters (seeds, ...), leaves of float64, and a cotangent (seeds, 2, out)."""
    import torch

    source = torch.Generator().manual_seed(0)
    x = torch.rand(seeds, 2, circuit.inputs, generator=source, dtype=torch.float64) * 2 - 1
    weights = {
        name: 2 * math.pi * torch.rand(seeds, *p.shape, generator=source, dtype=torch.float64)
        for name, p in circuit.parameters.items()
    }
    cotangent = torch.rand(seeds, 2, len(circuit.observables), generator=source, dtype=torch.float64) + 0.5
    return (
        x.requires_grad_(),
        {name: value.requires_grad_() for name, value in weights.items()},
        cotangent,
    )


def _effective(circuit: Circuit) -> tuple[set[int], set[tuple[str, int]]]:
    """Return the inputs, and the trainable scalars (name, index), that change an expectation value."""
    names = registry.load().names("circuit_backends")
    require(
        bool(names), "no circuit backend is installed: reinstall qrlsuite, whose own are among its plugins"
    )
    x, parameters, cotangent = _sample(circuit, POINTS)
    create_backend("native" if "native" in names else names[0], circuit)(x, parameters).backward(cotangent)

    def felt(leaf: Any) -> list[int]:
        if leaf.grad is None:
            return []
        lanes = leaf.grad.flatten(0, 1) if leaf is x else leaf.grad
        return [int(i) for i in (lanes.abs() > ZERO).any(0).flatten().nonzero()]

    return set(felt(x)), {(name, i) for name, leaf in parameters.items() for i in felt(leaf)}


def _effects(circuits: Circuits, deep: bool) -> None:
    for (qubits, layers), circuit in circuits.items():
        where, used = _size(qubits, layers), _uses(circuit)
        inputs, scalars = _effective(circuit)
        for feature in sorted(_used_inputs(circuit) - inputs):
            raise BrokenRuleError(
                f"{where}: input {feature} sets angles, and no expectation value depends on it, so the agent cannot "
                f"see it: {_cause(circuit, feature)}"
            )
        for name, parameter in circuit.parameters.items():
            mine = [scalar for scalar in used if scalar[0] == name]
            require(
                not mine or not scalars.isdisjoint(mine),
                f"{where}: no expectation value depends on '{name}' of shape {parameter.shape}, whatever its values, so "
                f"it is trained for nothing: {_cause(circuit, *mine[:1])}; or refuse this size with OptionError",
            )
        if not deep or layers != 3 * qubits:
            continue
        third = len(circuit) // 3
        dead = [
            (name, index)
            for (name, index), places in used.items()
            if (name, index) not in scalars and any(third <= p < len(circuit) - third for p in places)
        ]
        for name, index in dead[:1]:
            raise BrokenRuleError(
                f"{where}: no expectation value depends on {_element(circuit.parameters[name], index)} of shape "
                f"{circuit.parameters[name].shape}, though it is used in the middle of the circuit ({len(dead)} scalars "
                f"there are trained for nothing): {_cause(circuit, (name, index))}"
            )


def _cause(circuit: Circuit, *what: int | tuple[str, int]) -> str:
    """Say why an input or a trainable scalar has no effect."""
    for before, after, cause in ((True, False, _START), (False, True, _END), (True, True, _BOTH)):
        inputs, scalars = _effective(_between(circuit, before, after))
        if {*inputs, *scalars}.intersection(what):
            return cause
    return _CANCELS


def _between(circuit: Circuit, before: bool, after: bool) -> Circuit:
    """Return the circuit begun in a random entangled state, or measured in a random basis, or both."""
    made = Circuit(circuit.qubits, circuit.inputs)
    for p in circuit.parameters.values():
        made.parameter(p.name, p.shape, p.low, p.high)
    angles = iter(np.random.default_rng(0).uniform(0.5, 2.5, 16 * circuit.qubits))

    def scramble() -> None:
        for _ in range(2):
            for q in range(circuit.qubits):
                made.append("U3", q, next(angles), next(angles), next(angles))
            for q in range(circuit.qubits - 1):
                made.append("CNOT", (q, q + 1))

    if before:
        scramble()
    for op in circuit.operations:
        made.append(op.gate, op.wires, *op.angles, control=op.control)
    if after:
        scramble()
    else:
        made.measure(circuit.observables)
    return made


def _idle(circuits: Circuits) -> str:
    """Name what the ends of a circuit leave without effect, in the largest one of up to three layers."""
    qubits, layers = max(size for size in circuits if size[1] in LAYERS)
    circuit = circuits[qubits, layers]
    _, scalars = _effective(circuit)
    idle = [scalar for scalar in sorted(_uses(circuit)) if scalar not in scalars]
    if not idle:
        return ""
    named = ", ".join(_element(circuit.parameters[name], index) for name, index in idle[:3])
    return (
        f"; only at the ends of the circuit some scalars do not ({_size(qubits, layers)}: {len(idle)} of "
        f"{circuit.parameter_count}: {named}{', ...' * (len(idle) > 3)})"
    )


def _smallest(circuits: Circuits) -> Circuit:
    """Return the two-qubit circuit with two layers, or the nearest to it that exists."""
    return circuits[min(circuits, key=lambda size: (abs(size[0] - 2), abs(size[1] - 2)))]


def _exact_backends(circuit: Circuit) -> Iterator[tuple[str, Any]]:
    """Go through the installed backends, prepared for a circuit; those that sample are only run."""
    x, parameters, _ = _sample(circuit)
    for name in registry.load().names("circuit_backends"):
        try:
            run = create_backend(name, circuit)
            if run.shots is None:
                yield name, run
            else:
                run(x, parameters)
        except BrokenRuleError:
            raise
        except Exception as error:
            raise BrokenRuleError(
                f"backend '{name}' cannot run it: {type(error).__name__}: {error}; write the gate that it lacks as "
                f"others that it has, and see whether `qrlsuite check circuit-backend:{name}` passes"
            ) from error


def _dense(circuit: Circuit, x: Any, parameters: dict[str, Any]) -> Any:
    """Return the expectation values (1, 2, out) by dense matrices."""
    mine = {name: value[0].detach().numpy() for name, value in parameters.items()}
    return np.array([[expectation_values(circuit, row, mine) for row in x[0].detach().numpy()]])


def _backends(circuits: Circuits) -> None:
    circuit = _smallest(circuits)
    x, parameters, _ = _sample(circuit)
    expected = _dense(circuit, x, parameters)
    for name, run in _exact_backends(circuit):
        difference = float(np.abs(run(x, parameters).detach().numpy() - expected).max())
        require(
            difference < 1e-6,
            f"the values of backend '{name}' differ by {difference:.2g} from dense matrices: the fault is the "
            f"backend's; see `qrlsuite check circuit-backend:{name}`, and report it",
        )


def _gradients(circuits: Circuits) -> None:
    circuit = _smallest(circuits)
    for backend, run in _exact_backends(circuit):
        x, parameters, cotangent = _sample(circuit)
        run(x, parameters).backward(cotangent)
        for name, leaf in {"inputs": x, **parameters}.items():
            direction = np.random.default_rng(1).standard_normal(tuple(leaf.shape))
            sides = []
            for sign in (1.0, -1.0):
                moved = leaf.detach() + sign * 1e-5 * leaf.new_tensor(direction)
                others = {k: moved if k == name else v for k, v in parameters.items()}
                values = _dense(circuit, moved if name == "inputs" else x, others)
                sides.append(float((values * cotangent.numpy()).sum()))
            numeric = (sides[0] - sides[1]) / 2e-5
            exact = 0.0 if leaf.grad is None else float((leaf.grad.numpy() * direction).sum())
            require(
                abs(numeric - exact) <= 1e-6 * max(1.0, abs(exact)),
                f"backend '{backend}' gives the derivative by {name} as {exact:.6g}, finite differences of dense "
                f"matrices give {numeric:.6g}: the fault is the backend's; see `qrlsuite check "
                f"circuit-backend:{backend}`, and report it",
            )
