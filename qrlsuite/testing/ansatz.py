"""Rules of ansatzes: a pure function of its arguments; every input and parameter has an effect."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, create_backend, lightcone
from qrlsuite.errors import CircuitError, OptionError
from qrlsuite.testing import effects
from qrlsuite.testing.common import Subject
from qrlsuite.testing.dense import expectation_values
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, one_thread, require

QUBITS, LAYERS = (1, 2, 3, 4), (1, 2, 3)
LARGEST = 20

Circuits = dict[tuple[int, int], Circuit]
"""Circuits by numbers of qubits and layers."""


def check(subject: Subject) -> list[Finding]:
    """Check an ansatz at 1 to 4 qubits, with 1 to 3 layers and with three per qubit."""
    spec = subject.spec
    assert isinstance(spec, specs.AnsatzSpec)
    build, options = specs.resolve(spec.build), subject.options()
    circuits: Circuits = {}
    rules = Checklist()
    several = {(qubits, layers) for qubits in QUBITS for layers in (*LAYERS, 3 * qubits)} | {(LARGEST, 1)}
    sizes = {(spec.qubits, 1)} if spec.qubits else several
    built = effects.size(spec.qubits, 1) if spec.qubits else "1 to 4 qubits, 1 to 12 layers"
    if not rules.run("builds", built, lambda: _builds(build, options, circuits, sizes)):
        return rules.findings
    rules.run("pure", "built twice, it is the same circuit", lambda: _pure(build, options, circuits))
    rules.run("inputs used", "every input feature sets an angle", lambda: _inputs(circuits))
    rules.run("parameters used", "every trainable scalar sets an angle", lambda: _parameters(circuits))
    grows = rules.run("layers", "more layers make a longer circuit", lambda: _layers(circuits))
    with one_thread():

        def effective() -> str:
            _effects(circuits, grows)
            return _light_cone(build, options, circuits)

        rules.run("effects", "every input and every parameter changes an expectation value", effective)
        same = "every installed backend gives the values of dense matrices"
        if rules.run("backends", same, lambda: _backends(circuits)):
            rules.run(
                "gradients",
                "of every installed backend match finite differences",
                lambda: _gradients(circuits),
            )
    return rules.findings


def _builds(build: Any, options: Any, circuits: Circuits, sizes: set[tuple[int, int]]) -> None:
    refused = ""
    for qubits, layers in sorted(sizes):
        size = effects.size(qubits, layers)
        try:
            circuit = build(qubits, layers, options)
        except CircuitError as error:
            raise BrokenRuleError(
                f"{size}: {error}; an ansatz that cannot have this size raises qrlsuite.errors.OptionError and says "
                "which sizes it can have"
            ) from error
        except OptionError as error:  # an ansatz may refuse a size, in words
            refused = str(error)
            continue
        except Exception as error:
            raise BrokenRuleError(
                f"{size}: {type(error).__name__}: {error}; an ansatz that cannot have this size raises "
                "qrlsuite.errors.OptionError and says which sizes it can have"
            ) from error
        require(
            isinstance(circuit, Circuit),
            f"build returned {type(circuit).__name__}, not a qrlsuite.circuit.Circuit: is `return circuit` there?",
        )
        require(
            circuit.qubits - circuit.deferred == qubits,
            f"with qubits = {qubits} the circuit has {circuit.qubits - circuit.deferred}: write Circuit(qubits)",
        )
        require(bool(circuit.operations), f"{size}: the circuit has no gate; append some before `return`")
        if qubits != LARGEST:
            circuits[qubits, layers] = circuit
    require(
        any(layers in LAYERS for _, layers in circuits),
        f"it refuses every size of 1 to 4 qubits and 1 to 3 layers: {refused}; models with few qubits are what "
        "people try first",
    )


def _pure(build: Any, options: Any, circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        before = _content(circuit)  # kept apart: an ansatz that remembers may go on with the same object
        require(
            before == _content(build(qubits, layers, options)) == _content(circuit),
            f"{effects.size(qubits, layers)}: built twice, the circuits differ; an ansatz must not draw random "
            "numbers or remember anything, for each agent builds its own: make the Circuit inside the function",
        )


def _content(circuit: Circuit) -> tuple[Any, ...]:
    return circuit.inputs, circuit.operations, tuple(circuit.parameters.values()), circuit.observables


def _inputs(circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        unused = sorted(set(range(circuit.inputs)) - effects.used_inputs(circuit))
        require(
            not unused,
            f"{effects.size(qubits, layers)}: input {unused[0] if unused else ''} sets no angle, so the agent "
            "cannot see it; encode it with circuit.append('RX', q, circuit.input(q))",
        )


def _parameters(circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        size, used = effects.size(qubits, layers), effects.uses(circuit)
        require(
            bool(circuit.parameters),
            f"{size}: there is no trainable parameter; declare some: circuit.parameter('weights', (layers, qubits))",
        )
        for name, parameter in circuit.parameters.items():
            unused = [i for i in range(parameter.size) if (name, i) not in used]
            require(
                not unused,
                f"{size}: {parameter.written(unused[0] if unused else 0)} of shape {parameter.shape} sets "
                f"no angle ({len(unused)} of {parameter.size} do not); declare a smaller parameter or use all of it",
            )


def _layers(circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        longer = circuits.get((qubits, layers + 1))
        require(
            longer is None or len(longer) > len(circuit),
            f"{effects.size(qubits, layers + 1)}: the circuit has no more gates than with {layers}; is the loop over "
            "layers there?",
        )


def _effects(circuits: Circuits, grows: bool) -> None:
    for (qubits, layers), circuit in circuits.items():
        size = effects.size(qubits, layers)
        effects.require_inputs_and_parameters(circuit, size)
        if grows and layers == 3 * qubits:
            effects.require_middle(circuit, size)


def _light_cone(build: Any, options: Any, circuits: Circuits) -> str:
    """Say what the structure of the largest circuit of up to three layers leaves without effect."""
    largest = max(size for size in circuits if size[1] in LAYERS)
    cone = lightcone.described(circuits[largest], lambda k: cast(Circuit, build(largest[0], k, options)))
    sees = "layers_until_every_output_sees_every_input"
    return (
        f"dead parameters ({effects.size(*largest)}): {cone['dead_parameters']}; "
        f"{sees.replace('_', ' ')}: {cone[sees]}"
    )


def _smallest(circuits: Circuits) -> Circuit:
    """Return the two-qubit circuit with two layers, or the nearest to it that exists."""
    return circuits[min(circuits, key=lambda size: (abs(size[0] - 2), abs(size[1] - 2)))]


def _able(circuit: Circuit) -> list[str]:
    """Return the installed backends that compute this kind of circuit."""
    names = registry.load().names(specs.CircuitBackendSpec)
    return [
        name
        for name in names
        if registry.get(specs.CircuitBackendSpec, name).mean_field or not circuit.mean_field
    ]


def _run(backend: str, circuit: Circuit, x: Any, parameters: dict[str, Any]) -> Any:
    """Return a backend's values (1, 2, out), or None where it samples."""
    try:
        run = create_backend(backend, circuit)
        values = run(x, parameters)
    except Exception as error:
        raise BrokenRuleError(
            f"backend '{backend}' cannot run it: {type(error).__name__}: {error}; write a gate that it lacks as others "
            f"that it has, and see whether `qrlsuite check circuit-backend:{backend}` passes"
        ) from error
    return None if run.shots is not None else values


def _dense(circuit: Circuit, x: Any, parameters: dict[str, Any]) -> Any:
    """Return the expectation values (1, 2, out) by dense matrices."""
    mine = {name: value[0].detach().numpy() for name, value in parameters.items()}
    return np.array([[expectation_values(circuit, row, mine) for row in x[0].detach().numpy()]])


def _backends(circuits: Circuits) -> None:
    circuit = _smallest(circuits)
    x, parameters, _ = effects.sample(circuit)
    expected = _dense(circuit, x, parameters)
    for backend in _able(circuit):
        values = _run(backend, circuit, x, parameters)
        difference = 0.0 if values is None else float(np.abs(values.detach().numpy() - expected).max())
        require(
            difference < 1e-6,
            f"the values of backend '{backend}' differ by {difference:.2g} from dense matrices; the fault is the "
            f"backend's: see `qrlsuite check circuit-backend:{backend}`, and report it",
        )


def _gradients(circuits: Circuits) -> None:
    circuit = _smallest(circuits)
    for backend in _able(circuit):
        x, parameters, cotangent = effects.sample(circuit)
        values = _run(backend, circuit, x, parameters)
        if values is None:
            continue
        values.backward(cotangent)
        for name, leaf in {"inputs": x, **parameters}.items():
            direction = np.random.default_rng(1).standard_normal(tuple(leaf.shape))
            sides = []
            for sign in (1.0, -1.0):
                moved = leaf.detach() + sign * 1e-5 * leaf.new_tensor(direction)
                others = {k: moved if k == name else v for k, v in parameters.items()}
                shifted = _dense(circuit, moved if name == "inputs" else x, others)
                sides.append(float((shifted * cotangent.numpy()).sum()))
            numeric = (sides[0] - sides[1]) / 2e-5
            exact = 0.0 if leaf.grad is None else float((leaf.grad.numpy() * direction).sum())
            require(
                abs(numeric - exact) <= 1e-6 * max(1.0, abs(exact)),
                f"backend '{backend}' gives the derivative by {name} as {exact:.6g}, finite differences of dense "
                f"matrices give {numeric:.6g}; the fault is the backend's: see `qrlsuite check "
                f"circuit-backend:{backend}`, and report it",
            )
