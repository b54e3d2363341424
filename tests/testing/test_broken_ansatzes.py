"""Ansatzes that break one rule each: edits of a good one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest
import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, create_backend
from qrlsuite.errors import OptionError
from qrlsuite.specs import AnsatzSpec, CircuitBackendSpec
from qrlsuite.testing import effects
from qrlsuite.testing.circuit_backend import sample
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, good, ids, module, own_rules

GOOD = good("ansatz")
CIRCUIT, RETURN = "circuit = Circuit(qubits)", "return circuit"
SCALING = 'scaling = circuit.parameter("scaling", (layers, qubits), low=1.0, high=1.0)'
SHAPE, COUPLING = "(layers, qubits))", 'coupling = circuit.parameter("coupling", (layers, qubits))'
UPLOAD = 'circuit.append("RY", q, scaling[layer, q] * circuit.input(q))'
FREE = 'circuit.append("RY", q, circuit.input(q))'
RING, ROTATION = "circuit.append(options.entangler, pair)", 'circuit.append("RY", q, weights[layer, q])'
REFUSE = "from qrlsuite.errors import OptionError; raise OptionError"
LAST_ROTATION = (
    'Literal["CZ", "CNOT"]', "str", SHAPE, "(layers, qubits, 2))", SCALING, "", UPLOAD, FREE,
    RING, "circuit.append('CNOT', pair)", ROTATION,
    "circuit.append('RY', q, weights[layer, q, 0]); circuit.append('RZ', q, weights[layer, q, 1])",
)  # fmt: skip
CONTROL = ("class Options:", "class Options:\n    entangled: Literal[True, 'mean-field'] = True")
EDITS = [
    edit("builds", r"returned NoneType, .* is `return circuit` there\?", RETURN, "circuit"),
    edit("builds", r"with qubits = 1 the circuit has 4: write Circuit\(qubits\)", CIRCUIT, f"qubits = 4; {CIRCUIT}"),
    edit("builds", r"1 qubit, 1 layer: the circuit has no gate", "in range(layers)", "in range(0)"),
    edit("builds", r"2 qubits, 3 layers: IndexError: .*; .* raises qrlsuite.errors.OptionError",
         "options.entangler", "['CNOT', 'CZ'][layer]"),
    edit("builds", r"1 qubit, 1 layer: CZ needs 2 distinct .* raises qrlsuite.errors.Op",
         "pairs if qubits > 2 else pairs[: qubits - 1]", "pairs"),
    edit("builds", r"refuses every size of 1 to 10 .*: ansatz 'nowhere' has 17 qubits",
         CIRCUIT, f"{REFUSE}(\"ansatz 'nowhere' has 17 qubits\")"),
    edit("parameters used", r"5 qubits, 1 layer: weights\[1, 0\] of shape \(2, 5\) sets no angle",
         CIRCUIT, f"if qubits < 5: {REFUSE}('from 5 qubits on')\n    {CIRCUIT}", SHAPE, "(layers + 1, qubits))"),
    edit("pure", r"built twice, the circuits differ; .* must not draw random numbers",
         CIRCUIT, f"import random; {CIRCUIT}; circuit.append('RY', 0, random.random())"),
    edit("pure", r"circuits differ; .* remember anything.* make the Circuit inside",
         "def build", "BUILT = {}\n\n\ndef build",
         RETURN, "circuit = BUILT.setdefault((qubits, layers), circuit); circuit.append('X', 0); return circuit"),
    edit("inputs used", r"1 qubit, 1 layer: input 1 sets no angle.*; encode it with",
         CIRCUIT, "circuit = Circuit(qubits, inputs=qubits + 1)"),
    edit("parameters used", r"weights\[1, 0\] of shape \(2, 1\) sets no angle \(1 of 2.*smaller",
         SHAPE, "(layers + 1, qubits))"),
    edit("parameters used", r"there is no trainable parameter; declare some", SCALING, "", UPLOAD, FREE,
         'weights = circuit.parameter("weights", (layers, qubits))', "", ROTATION, "pass"),
    edit("layers", r"1 qubit, 2 layers: .* no more gates than with 1; is the loop over layers",
         CIRCUIT, f"layers = 1; {CIRCUIT}"),
    edit("effects", r"input 0 sets an angle, .* cannot see it: it acts on the starting state", SCALING, "",
         UPLOAD, "circuit.append('RZ', q, circuit.input(q)) if layer == 0 else None"),
    edit("effects", r"input 0 .*: neither what comes before nor .*every gate is about Z",
         SCALING, "", UPLOAD, FREE.replace("RY", "RZ"), ROTATION, ROTATION.replace("RY", "RZ")),
    edit("effects", r"2 qubits, 1 layer: input 1 .* qubit that meets no measured one",
         RING, "pass", RETURN, "circuit.measure([0]); return circuit"),
    edit("effects", r"1 layer: no expectation value depends on any element of 'coupling' of shape \(1, 1\), so it is "
         r"trained for nothing: nothing after it makes a difference of it.*; or refuse this size",
         'weights = circuit.parameter("weights", (layers, qubits))',
         'coupling = circuit.parameter("coupling", (layers, len(ring(qubits)) or 1))',
         RING, "[circuit.append(*gate) for gate in "
         "(('CNOT', pair), ('RZ', pair[1], coupling[layer, pair[0]]), ('CNOT', pair))]",
         ROTATION, "circuit.append('RZ', 0, coupling[layer, 0]) if qubits == 1 else None"),
    edit("effects", r"1 qubit, 3 layers: no .* depends on weights\[1, 0, 1\] of shape \(3, 1, 2\), which is used in "
         r"the middle of the circuit; it is trained for nothing: it cancels within the circuit",
         SHAPE, "(layers, qubits, 2))",
         ROTATION, "circuit.append('RY', q, weights[layer, q, 0])\n            "
         "[circuit.append(*gate) for gate in 2 * (('RZ', q, weights[layer, q, 1]), ('X', q))]"),
    edit("effects", r"2 qubits, \d layers: no .* depends on coupling\[\d, 1\] of shape .*, nor on \d more there; .*: "
         r"it cancels", CIRCUIT, f"if qubits < 2: {REFUSE}('2 to 20 qubits')\n    {CIRCUIT}; {COUPLING}", RING, "pass",
         ROTATION, f"{ROTATION}\n        for q in range(qubits):\n            "
         "turn = 'RY', (q + 1) % qubits, coupling[layer, q]\n            circuit.append(*turn, control=q)\n            "
         "[circuit.append(*gate, control=c) for gate, c in ((('Z', 0), None), (turn, q), (('Z', 0), None))"
         "  if q == qubits - 1]"),
    edit("entangler=CNOT", r"every circuit is the one of the default: is the option used",
         RING, "circuit.append('CZ', pair)"),
    edit("entangler=CNOT", r"1 layer: KeyError: 'CNOT'", RING, "circuit.append({'CZ': 'CZ'}[options.entangler], pair)"),
    edit("entangled=mean-field", r"2 qubits, 1 layer: NameError: name 'means' is not defined", *CONTROL, RING,
         f"{RING} if options.entangled is True else means"),
    edit("entangled=mean-field", r"the circuit is entangled: write Circuit\(qubits, mean_field=options.entangled ==",
         *CONTROL, RING, f"{RING} if options.entangled is True else None"),
]  # fmt: skip


def spec(*changes: str) -> AnsatzSpec:
    name = module(edit("", "", *changes).of(GOOD))
    return AnsatzSpec("broken", "Breaks a rule", options=f"{name}:Options", build=f"{name}:build")


@pytest.mark.parametrize("edit", EDITS, ids=ids(EDITS))
def test_one_rule_is_broken(edit: Edit) -> None:
    assert_breaks(spec(*edit.changes), edit.rule, edit.message)


@dataclass(frozen=True)
class NoOptions:
    pass


class Installed:
    """Native's values and gradients; others change them."""

    shots: int | None = None

    def __init__(self, circuit: Circuit, options: Any) -> None:
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
    def __init__(self, circuit: Circuit, options: Any) -> None:
        if any(operation.gate == "CZ" for operation in circuit):
            raise OptionError("this device has no CZ")
        super().__init__(circuit, options)


class Sampling(Damped):
    shots = 100


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Installed]], None]:
    """Register a class of this file as the circuit backend `theirs`, beside the suite's own native one."""

    def put(cls: type[Installed]) -> None:
        known = registry.load().entries[specs.CircuitBackendSpec]
        reference = f"{__name__}:{cls.__name__}"
        backend = CircuitBackendSpec("theirs", "A stranger's", f"{__name__}:NoOptions", reference)
        monkeypatch.setitem(
            registry.load().entries,
            specs.CircuitBackendSpec,
            {"native": known["native"], "theirs": registry.Registered(backend, "stranger")},
        )

    return put


BACKENDS = [
    ("backends", NoEntangler,
     r"'theirs' cannot run it: OptionError: this device has no CZ; write a gate that it lacks as others"),
    ("backends", Damped,
     r"'theirs': values differ by 0\.\d+ from dense .* `qrlsuite check circuit-backend:theirs`"),
    ("backends", HalfGradient,
     r"'theirs': the derivative by inputs is .*, finite differences .*fault is the backend's"),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "cls", "message"), BACKENDS, ids=["lacks-a-gate", "values", "gradients"])
def test_an_installed_backend_that_fails_it_is_named(
    install: Callable[[type[Installed]], None], rule: str, cls: type[Installed], message: str
) -> None:
    install(cls)
    assert_breaks(spec(), rule, message)


@pytest.mark.parametrize("cls", [Installed, Sampling])
def test_a_backend_that_samples_is_not_compared(
    install: Callable[[type[Installed]], None], cls: type[Installed]
) -> None:
    install(cls)
    assert_all_good(spec())


def test_without_a_backend_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.load().entries, specs.CircuitBackendSpec, {})
    assert_breaks(spec(), "effects", "no circuit backend is installed: install qrlsuite")


def test_every_rule_has_an_ansatz_that_breaks_it() -> None:
    rules = {edit.rule for edit in EDITS} | {rule for rule, _, _ in BACKENDS}
    assert assert_all_good(spec()) == rules - {"entangled=mean-field"}


def test_sizes_may_be_refused() -> None:
    assert_all_good(spec(CIRCUIT, f"if not 2 <= qubits <= 10: {REFUSE}('2 to 10')\n    {CIRCUIT}"))


def test_what_the_ends_of_a_pattern_leave_without_effect_is_named_and_breaks_nothing() -> None:
    """Published circuits end every layer with RZ, the last one too."""
    findings = {finding.rule: finding for finding in own_rules(spec(*LAST_ROTATION))}
    assert all(finding.ok for finding in findings.values())
    dead = "dead parameters (4 qubits, 3 layers): 4 of 24: weights[2, 0, 1], weights[2, 1, 1], weights[2, 2, 1], ..."
    assert dead in findings["effects"].message


@pytest.mark.parametrize(("name", "gate"), [("iqp", "xyz"), ("cx", "u3"), ("cz", "xyz")])
def test_the_gates_of_built_in_ansatzes_have_effects(name: str, gate: str) -> None:
    findings = own_rules(registry.get(specs.AnsatzSpec, name), {"gate": gate})
    assert all(finding.ok for finding in findings), findings


def test_effects_are_those_of_finite_differences() -> None:
    name, _, build = spec(*LAST_ROTATION).build.partition(":")
    circuit = getattr(sys.modules[name], build)(2, 2, None)
    inputs, scalars = effects.effective(circuit)
    run = create_backend("native", circuit)
    x, parameters, _ = sample(circuit, effects.POINTS)
    with torch.no_grad():
        values = run(x, parameters)
        moved = {q: run(x + 0.5 * torch.eye(2)[q], parameters) for q in range(2)}
        for index in range(8):
            weights = parameters["weights"].clone()
            weights.view(effects.POINTS, -1)[:, index] += 0.5
            moved["weights", index] = run(x, {"weights": weights})
    changed = {what for what, other in moved.items() if float((other - values).abs().max()) > 1e-6}
    assert changed == inputs | scalars
    assert ("weights", 7) not in changed
