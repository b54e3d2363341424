"""Ansatzes that break one rule each."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite import registry
from qrlsuite.circuit import Circuit, create_backend
from qrlsuite.errors import OptionError
from qrlsuite.specs import AnsatzSpec, CircuitBackendSpec
from qrlsuite.testing import effects
from qrlsuite.testing.findings import Finding
from tests.testing.broken import Broken, Cases, assert_breaks, ids, own_rules

HERE = __name__


@dataclass(frozen=True)
class Options:
    pass


def chain(circuit: Circuit) -> None:
    for q in range(circuit.qubits - 1):
        circuit.append("CNOT", (q, q + 1))


def reuploading(circuit: Circuit, layers: int) -> Circuit:
    """Append layers of RX(input) and RY(weight) on every qubit, and a chain."""
    weights = circuit.parameter("weights", (layers, circuit.qubits))
    for layer in range(layers):
        for q in range(circuit.qubits):
            circuit.append("RX", q, circuit.input(q))
            circuit.append("RY", q, weights[layer, q])
        chain(circuit)
    return circuit


def good(qubits: int, layers: int, options: Options) -> Circuit:
    return reuploading(Circuit(qubits), layers)


def picky(qubits: int, layers: int, options: Options) -> Circuit:
    if not 2 <= qubits <= 10:
        raise OptionError("ansatz 'picky' has 2 to 10 qubits")
    return good(qubits, layers, options)


def last_rotation(qubits: int, layers: int, options: Options) -> Circuit:
    """Do what published circuits do: end every layer with RZ, the last one too."""
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits, 2))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q))
            circuit.append("RY", q, weights[layer, q, 0])
            circuit.append("RZ", q, weights[layer, q, 1])
        chain(circuit)
    return circuit


def no_return(qubits: int, layers: int, options: Options) -> None:
    good(qubits, layers, options)


def four_qubits(qubits: int, layers: int, options: Options) -> Circuit:
    return good(4, layers, options)


def no_gate(qubits: int, layers: int, options: Options) -> Circuit:
    return Circuit(qubits)


def two_layers(qubits: int, layers: int, options: Options) -> Circuit:
    entanglers = ["CNOT", "CZ"]
    circuit = good(qubits, layers, options)
    for layer in range(layers):
        circuit.append("H" if qubits == 1 else entanglers[layer], range(qubits)[:2])
    return circuit


def closed_ring(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = good(qubits, layers, options)
    for q in range(qubits):
        circuit.append("CZ", (q, (q + 1) % qubits))
    return circuit


def nowhere(qubits: int, layers: int, options: Options) -> Circuit:
    raise OptionError("ansatz 'nowhere' has 7 qubits")


def random_start(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = Circuit(qubits)
    circuit.append("RY", 0, float(np.random.default_rng().uniform()))
    return reuploading(circuit, layers)


@functools.cache
def remembered(qubits: int, layers: int) -> Circuit:
    return good(qubits, layers, Options())


def growing(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = remembered(qubits, layers)
    circuit.append("X", 0)
    return circuit


def one_input_more(qubits: int, layers: int, options: Options) -> Circuit:
    return reuploading(Circuit(qubits, inputs=qubits + 1), layers)


def one_layer_more(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers + 1, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q))
            circuit.append("RY", q, weights[layer, q])
    return circuit


def fixed(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = Circuit(qubits)
    for _ in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q))
    return circuit


def shallow(qubits: int, layers: int, options: Options) -> Circuit:
    return good(qubits, 1, options)


def blind(qubits: int, layers: int, options: Options) -> Circuit:
    """Upload the inputs once, by RZ, to qubits that are still in 0."""
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits))
    for q in range(qubits):
        circuit.append("RZ", q, circuit.input(q))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RY", q, weights[layer, q])
        chain(circuit)
    return circuit


def diagonal(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RZ", q, circuit.input(q) + weights[layer, q])
    return circuit


def short_sighted(qubits: int, layers: int, options: Options) -> Circuit:
    """Measure one qubit, and let no other act on it."""
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q) + weights[layer, q])
    circuit.measure([0])
    return circuit


def last_coupling(qubits: int, layers: int, options: Options) -> Circuit:
    """Couple neighbors by RZZ, with nothing between the last of them and the measurement."""
    circuit = Circuit(qubits)
    scaling = circuit.parameter("scaling", (layers, qubits))
    coupling = circuit.parameter("coupling", (layers, max(1, qubits - 1)))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RY", q, scaling[layer, q] * circuit.input(q))
        for q in range(max(1, qubits - 1)):
            pair = (q, q + 1)[:qubits]
            if qubits > 1:
                circuit.append("CNOT", pair)
            circuit.append("RZ", pair[-1], coupling[layer, q])
            if qubits > 1:
                circuit.append("CNOT", pair)
    return circuit


def canceling(qubits: int, layers: int, options: Options) -> Circuit:
    """Rotate forth and back by the second of two weights."""
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits, 2))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q))
            circuit.append("RY", q, weights[layer, q, 0])
            for _ in range(2):
                circuit.append("RZ", q, weights[layer, q, 1])
                circuit.append("X", q)
        chain(circuit)
    return circuit


def dead_coupling(qubits: int, layers: int, options: Options) -> Circuit:
    """Couple all neighbors but the last two by a controlled rotation, these two by one that only adds a phase."""
    if qubits < 2:
        raise OptionError("ansatz 'dead-coupling' couples neighbors: it has 2 to 20 qubits")
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits))
    coupling = circuit.parameter("coupling", (layers, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q) + weights[layer, q])
        for q in range(qubits):
            circuit.append("RY", (q + 1) % qubits, coupling[layer, q], control=q)
            if q == qubits - 1:
                circuit.append("Z", 0)
                circuit.append("RY", 0, coupling[layer, q], control=q)
                circuit.append("Z", 0)
    return circuit


def spec(build: str) -> AnsatzSpec:
    name = build.replace("_", "-")
    return AnsatzSpec(name, "Breaks a rule", options=f"{HERE}:Options", build=f"{HERE}:{build}")


CASES: Cases = [
    ("builds", Broken(spec("no_return"), r"returned NoneType, .* is `return circuit` there\?")),
    (
        "builds",
        Broken(spec("four_qubits"), r"with qubits = 1 the circuit has 4: write Circuit\(qubits\)"),
    ),
    ("builds", Broken(spec("no_gate"), r"1 qubit, 1 layer: the circuit has no gate")),
    (
        "builds",
        Broken(
            spec("two_layers"), r"2 qubits, 3 layers: IndexError: .*; .* raises qrlsuite.errors.OptionError"
        ),
    ),
    (
        "builds",
        Broken(spec("closed_ring"), r"1 qubit, 1 layer: CZ needs 2 distinct .* raises qrlsuite.errors.Op"),
    ),
    ("builds", Broken(spec("nowhere"), r"refuses every size .*: ansatz 'nowhere' has 7 qubits")),
    (
        "pure",
        Broken(spec("random_start"), r"built twice, the circuits differ; .* must not draw random numbers"),
    ),
    ("pure", Broken(spec("growing"), r"circuits differ; .* remember anything.* make the Circuit inside")),
    (
        "inputs used",
        Broken(spec("one_input_more"), r"1 qubit, 1 layer: input 1 sets no angle.*; encode it with"),
    ),
    (
        "parameters used",
        Broken(spec("one_layer_more"), r"weights\[1, 0\] of shape \(2, 1\) sets no angle \(1 of 2.*smaller"),
    ),
    ("parameters used", Broken(spec("fixed"), r"there is no trainable parameter; declare some")),
    (
        "layers",
        Broken(spec("shallow"), r"1 qubit, 2 layers: .* no more gates than with 1; is the loop over layers"),
    ),
    (
        "effects",
        Broken(spec("blind"), r"input 0 sets an angle, .* cannot see it: it acts on the starting state"),
    ),
    (
        "effects",
        Broken(spec("diagonal"), r"input 0 .*: neither what comes before nor .*every gate is about Z"),
    ),
    (
        "effects",
        Broken(spec("short_sighted"), r"2 qubits, 1 layer: input 1 .* qubit that meets no measured one"),
    ),
    (
        "effects",
        Broken(
            spec("last_coupling"),
            r"1 layer: no expectation value depends on any element of 'coupling' of shape \(1, 1\), so it is trained "
            r"for nothing: nothing after it makes a difference of it.*; or refuse this size",
        ),
    ),
    (
        "effects",
        Broken(
            spec("canceling"),
            r"1 qubit, 3 layers: no .* depends on weights\[1, 0, 1\] of shape \(3, 1, 2\), which is used in the middle "
            r"of the circuit; it is trained for nothing: it cancels within the circuit",
        ),
    ),
    (
        "effects",
        Broken(
            spec("dead_coupling"),
            r"2 qubits, 6 layers: no .* depends on coupling\[2, 1\] of shape \(6, 2\), .*, nor on 1 more there; .*: it "
            r"cancels",
        ),
    ),
]


@pytest.mark.parametrize(("rule", "case"), CASES, ids=ids(CASES))
def test_one_rule_is_broken(rule: str, case: Broken) -> None:
    assert_breaks("ansatzes", rule, case)


class Installed:
    """Native's values and gradients; others change them."""

    shots: int | None = None

    def __init__(self, circuit: Circuit, options: Options) -> None:
        self.native = create_backend("native", circuit)

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        return self.native(inputs, parameters)


class Damped(Installed):
    def __call__(self, *given: Any) -> Tensor:
        return 0.9 * super().__call__(*given)


class HalfGradient(Installed):
    def __call__(self, *given: Any) -> Tensor:
        values = super().__call__(*given)
        return (values + values.detach()) / 2


class NoEntangler(Installed):
    def __init__(self, circuit: Circuit, options: Options) -> None:
        if any(operation.gate == "CNOT" for operation in circuit):
            raise OptionError("this device has no CNOT")
        super().__init__(circuit, options)


class Sampling(Damped):
    shots = 100


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Installed]], None]:
    """Register a class of this file as the circuit backend `theirs`, beside the suite's own native one."""

    def put(cls: type[Installed]) -> None:
        known = registry.load().entries["circuit_backends"]
        backend = CircuitBackendSpec("theirs", "A stranger's", f"{HERE}:Options", f"{HERE}:{cls.__name__}")
        monkeypatch.setitem(
            registry.load().entries,
            "circuit_backends",
            {"native": known["native"], "theirs": registry.Registered(backend, "stranger")},
        )

    return put


BACKENDS: list[tuple[str, type[Installed], str]] = [
    (
        "backends",
        NoEntangler,
        r"backend 'theirs' cannot run it: OptionError: this device has no CNOT; write a gate that it lacks as others",
    ),
    (
        "backends",
        Damped,
        r"values of backend 'theirs' differ by 0\.\d+ from dense .* `qrlsuite check circuit-backend:theirs`",
    ),
    (
        "gradients",
        HalfGradient,
        r"'theirs' gives the derivative by inputs as .*, finite differences .*backend's",
    ),
]


@pytest.mark.parametrize(("rule", "cls", "message"), BACKENDS, ids=["lacks-a-gate", "values", "gradients"])
def test_an_installed_backend_that_fails_it_is_named(
    install: Callable[[type[Installed]], None], rule: str, cls: type[Installed], message: str
) -> None:
    install(cls)
    assert_breaks("ansatzes", rule, Broken(spec("good"), message))


@pytest.mark.parametrize("cls", [Installed, Sampling])
def test_a_backend_that_samples_is_only_run(
    install: Callable[[type[Installed]], None], cls: type[Installed]
) -> None:
    install(cls)
    assert not broken(own_rules("ansatzes", spec("good")))


def test_without_a_backend_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.load().entries, "circuit_backends", {})
    assert_breaks(
        "ansatzes", "effects", Broken(spec("good"), "no circuit backend is installed: install qrlsuite")
    )


def broken(findings: list[Finding]) -> list[Finding]:
    return [finding for finding in findings if not finding.ok]


def test_every_rule_has_an_ansatz_that_breaks_it() -> None:
    findings = own_rules("ansatzes", spec("good"))
    assert not broken(findings)
    assert {f.rule for f in findings} == {rule for rule, _ in CASES} | {rule for rule, _, _ in BACKENDS}


def test_sizes_may_be_refused() -> None:
    assert not broken(own_rules("ansatzes", spec("picky")))


def test_what_the_ends_of_a_pattern_leave_without_effect_is_named_and_breaks_nothing() -> None:
    findings = own_rules("ansatzes", spec("last_rotation"))
    assert not broken(findings)
    [message] = [finding.message for finding in findings if finding.rule == "effects"]
    assert message.endswith(
        "4 of 24 scalars do not (4 qubits, 3 layers: weights[2, 0, 1], weights[2, 1, 1], weights[2, 2, 1], ...)"
    )


@pytest.mark.parametrize("gate", ["xyz", "u3"])
@pytest.mark.parametrize("name", ["iqp", "cx", "cz"])
def test_the_gates_of_built_in_ansatzes_have_effects(name: str, gate: str) -> None:
    found = registry.ansatz(name)
    assert not broken(own_rules("ansatzes", found, {"gate": gate}))


def test_effects_are_those_of_finite_differences() -> None:
    circuit = last_rotation(2, 2, Options())
    inputs, scalars = effects.effective(circuit)
    run = create_backend("native", circuit)
    x, parameters, _ = effects.sample(circuit, effects.POINTS)
    with torch.no_grad():
        values = run(x, parameters)
        moved = {}
        for q in range(2):
            shifted = x.clone()
            shifted[..., q] += 0.5
            moved[q] = run(shifted, parameters)
        for index in range(8):
            weights = parameters["weights"].clone()
            weights.view(effects.POINTS, -1)[:, index] += 0.5
            moved["weights", index] = run(x, {"weights": weights})
    changed = {what for what, other in moved.items() if float((other - values).abs().max()) > 1e-6}
    assert changed == inputs | scalars
    assert ("weights", 7) not in changed
