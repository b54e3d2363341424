"""Rules of ansatzes: a pure function of its arguments; every input and parameter has an effect."""

from __future__ import annotations

from typing import Any, cast

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, create_backend, lightcone
from qrlsuite.errors import CircuitError, OptionError
from qrlsuite.testing import circuit_backend, effects
from qrlsuite.testing.common import Subject, check_cases
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, one_thread, require

LAYERS, MOST = (1, 2, 3), 10
"""Numbers of layers that are tried, and the largest smallest number of qubits."""
LARGEST = 20

Circuits = dict[tuple[int, int], Circuit]
"""Circuits by numbers of qubits and layers."""


def check(subject: Subject) -> list[Finding]:
    """Check an ansatz from the smallest number of qubits that it takes, with 1 to 3 layers and with three per qubit."""
    spec = subject.spec
    assert isinstance(spec, specs.AnsatzSpec)
    build, options = specs.resolve(spec.build), subject.options()
    circuits: Circuits = {}
    rules = Checklist()

    def builds() -> str:
        least = spec.qubits or _least(build, options)
        several = {
            (qubits, layers) for qubits in range(least, max(4, least) + 1) for layers in (*LAYERS, 3 * qubits)
        }
        circuits.update(_built(build, options, {(least, 1)} if spec.qubits else several | {(LARGEST, 1)}))
        return " to ".join(effects.size(*size) for size in (min(circuits), max(circuits)))

    if not rules.run("builds", "from its smallest size on", builds):
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
        same = "every installed backend gives the values and gradients of dense matrices"
        rules.run("backends", same, lambda: _backends(circuits))
        check_cases(rules, subject.choices(), lambda chosen: _works(build, chosen.options(), circuits))
    return rules.findings


def _works(build: Any, options: Any, usual: Circuits) -> None:
    """Check the circuits with other options at the sizes with few layers."""
    circuits = _built(build, options, {size for size in usual if size[1] in LAYERS})
    require(
        any(_content(circuit) != _content(usual[size]) for size, circuit in circuits.items()),
        "every circuit is the one of the default: is the option used?",
    )
    if getattr(options, "entangled", None) == "mean-field":
        require(
            all(circuit.mean_field for circuit in circuits.values()),
            "the circuit is entangled: write Circuit(qubits, mean_field=options.entangled == 'mean-field')",
        )
    _pure(build, options, circuits)
    _inputs(circuits)
    _parameters(circuits)
    _effects(circuits, grows=False)
    _backends(circuits)


def _least(build: Any, options: Any) -> int:
    """Return the smallest number of qubits that the ansatz does not refuse."""
    for qubits in range(1, MOST + 1):
        try:
            _built(build, options, {(qubits, layers) for layers in LAYERS})
        except OptionError as error:
            refused = error
        else:
            return qubits
    raise BrokenRuleError(
        f"it refuses every size of 1 to {MOST} qubits and 1 to 3 layers: {refused}; models with few qubits are what "
        "people try first"
    )


def _built(build: Any, options: Any, sizes: set[tuple[int, int]]) -> Circuits:
    """Return the circuits of the sizes that the ansatz takes; it must take one with few layers."""
    circuits: Circuits = {}
    for size in sorted(sizes):
        try:
            circuits[size] = _made(build, *size, options)
        except OptionError as error:
            refused = error
    circuits.pop((LARGEST, 1), None)
    if not any(layers in LAYERS for _, layers in circuits):
        raise refused
    return circuits


def _made(build: Any, qubits: int, layers: int, options: Any) -> Circuit:
    """Return the circuit of a size; raises `OptionError` where the ansatz refuses it in words."""
    size = effects.size(qubits, layers)
    try:
        circuit = build(qubits, layers, options)
    except Exception as error:
        if isinstance(error, OptionError) and not isinstance(error, CircuitError):
            raise
        name = "" if isinstance(error, CircuitError) else f"{type(error).__name__}: "
        raise BrokenRuleError(
            f"{size}: {name}{error}; an ansatz that cannot have this size raises qrlsuite.errors.OptionError and "
            "says which sizes it can have"
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
    return cast(Circuit, circuit)


def _pure(build: Any, options: Any, circuits: Circuits) -> None:
    for (qubits, layers), circuit in circuits.items():
        before = _content(circuit)  # kept apart: an ansatz that remembers may go on with the same object
        require(
            before == _content(build(qubits, layers, options)) == _content(circuit),
            f"{effects.size(qubits, layers)}: built twice, the circuits differ; an ansatz must not draw random "
            "numbers or remember anything, for each agent builds its own: make the Circuit inside the function",
        )


def _content(circuit: Circuit) -> tuple[Any, ...]:
    parameters = tuple(circuit.parameters.values())
    return circuit.inputs, circuit.operations, parameters, circuit.observables, circuit.mean_field


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
    """Name the parameters and inputs without effect, by the structure of the largest circuit of up to three layers."""
    largest = max(size for size in circuits if size[1] in LAYERS)
    cone = lightcone.described(circuits[largest], lambda k: cast(Circuit, build(largest[0], k, options)))
    sees = "layers_until_every_output_sees_every_input"
    return (
        f"dead parameters ({effects.size(*largest)}): {cone['dead_parameters']}; "
        f"{sees.replace('_', ' ')}: {cone[sees]}"
    )


def _backends(circuits: Circuits) -> None:
    """Require that installed backends agree on a circuit of two qubits and layers or so, as far as they are exact."""
    circuit = circuits[min(circuits, key=lambda size: (abs(size[0] - 2), abs(size[1] - 2)))]
    for name, each in registry.load().of(specs.CircuitBackendSpec).items():
        if circuit.mean_field and not each.spec.mean_field:
            continue
        see = f"see `qrlsuite check circuit-backend:{name}`"
        try:
            run = create_backend(name, circuit)
            difference = circuit_backend.distance(run, circuit, 1) if circuit_backend.exact(run) else 0.0
        except Exception as error:
            raise BrokenRuleError(
                f"backend '{name}' cannot run it: {type(error).__name__}: {error}; write a gate that it lacks as "
                f"others that it has, and {see}"
            ) from error
        try:
            require(difference < 1e-6, f"values differ by {difference:.2g} from dense matrices")
            if circuit_backend.exact(run):
                circuit_backend.require_gradients(run, circuit)
        except BrokenRuleError as error:
            raise BrokenRuleError(f"backend '{name}': {error}; the fault is the backend's: {see}") from error
