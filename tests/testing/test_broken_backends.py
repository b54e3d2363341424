"""Circuit backends that break one rule each: edits of one that is made of the native one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from qrlsuite.circuit import GATES, Circuit, Operation
from qrlsuite.specs import CircuitBackendSpec
from qrlsuite.testing.circuits import every_gate, small
from qrlsuite.testing.dense import expectation_values
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, ids, module, own_rules

Change = Callable[[Operation], Operation | None]


def rewritten(circuit: Circuit, change: Change, mean_field: bool | None = None) -> Circuit:
    """Return the circuit with every operation changed, or left out where the change gives None."""
    made = Circuit(circuit.qubits, circuit.inputs, circuit.mean_field if mean_field is None else mean_field)
    for p in circuit.parameters.values():
        made.parameter(p.name, p.shape, p.low, p.high)
    for operation in map(change, circuit.operations):
        if operation is not None:
            made.append(operation.gate, operation.wires, *operation.angles, control=operation.control)
    made.measure(circuit.observables)
    return made


GOOD = '''
import dataclasses
from typing import Literal

import numpy as np
import torch
from pydantic.dataclasses import dataclass
from qrlsuite.circuit import GATES, create_backend
from tests.testing.test_broken_backends import rewritten


@dataclass(frozen=True)
class Options:
    shots: int | None = None


class Backend:
    """Native's values; with shots, noise of their size, drawn for every agent from its own seed."""

    def __init__(self, circuit, options):
        self.shots = options.shots
        changed = rewritten(circuit, self.change)
        self.native = create_backend("native", changed)

    def change(self, operation):
        return operation

    def exact(self, inputs, parameters):
        return self.native(inputs, parameters)

    def noise(self, seed, like):
        source = torch.Generator()
        source.seed() if seed is None else source.manual_seed(seed)
        return torch.randn(like.shape, generator=source, dtype=like.dtype)

    def __call__(self, inputs, parameters, seeds=None):
        values = self.exact(inputs, parameters)
        if self.shots is None:
            return values
        drawn = [self.noise(seed, values[0]) for seed in seeds or [None] * len(values)]
        return (values + torch.stack(drawn) / self.shots**0.5).clamp(-1, 1)
'''
CHANGE, SHOTS, NOISE = "return operation", "self.shots = options.shots", "source = torch.Generator()"
EXACT, VALUES = "return self.native(inputs, parameters)", "values = self.native(inputs, parameters)"
NO_OPTION = ("shots: int | None = None", "pass", "options.shots", "None")
NOISY = (
    *NO_OPTION,
    "self.shots = None",
    "self.shots = None; self.noisy = True",
    EXACT,
    f"{EXACT} * 0.8 + 0.01 * torch.rand(())",
)
SAMPLING = ("shots: int | None = None", "pass", "options.shots", "100")
EDITS = [
    edit("builds", r"returned NoneType, which cannot be called: write __call__",
         "    def __init__", "    def __new__(cls, circuit, options):\n        return None\n\n    def __init__"),
    edit("builds", r"ValueError: 'T' is not in list; factory takes a Circuit and the options", CHANGE,
         "known = [gate for gate in GATES if gate != 'T']; known.index(operation.gate); return operation"),
    edit("builds", r"no attribute 'shots': set it to None where values are exact", SHOTS, "pass"),
    edit("builds", r"attribute shots is 0: a positive integer, or None", SHOTS, "self.shots = 0"),
    edit("shapes", r"shape \(5, 2, 3\), .* \(seeds, batch, observables\) = \(5, 3, 2\): .*transposed",
         EXACT, f"{EXACT}.transpose(1, 2)"),
    edit("shapes", r"result has shape \(2,\), .* = \(1, 1, 2\): is an axis squeezed", EXACT, f"{EXACT}.squeeze()"),
    edit("shapes", r"shape \(5, 3, 3\), .* every qubit measured instead of circuit.observables",
         "        self.native", "        changed.measure(range(circuit.qubits))\n        self.native"),
    edit("shapes", r"the result is ndarray, not a tensor: compute in torch, or wrap",
         EXACT, f"{EXACT}.detach().numpy()"),
    edit("shapes", r"torch.float32 give a result of torch.float64: end with .to\(inputs\)", EXACT, f"{EXACT}.double()"),
    edit("shapes", r"values lie in \[-.*, and Pauli Z lies in \[-1, 1\]: is the state norm", EXACT, f"{EXACT} * 3"),
    edit("shapes", r"^parameter 'scale' of shape .* is missing",
         EXACT, "return self.native(inputs, dict(enumerate(parameters)))"),
    edit("values", r"they agree in reverse: .* order of circuit.observables",
         EXACT, f"{EXACT}.flip(2)", also=["shots"]),
    edit("values", r"3 qubits .* alone between rotations, these are wrong: RY with control, T; see", CHANGE,
         "operation = dataclasses.replace(operation, gate='S') if operation.gate == 'T' else operation\n        "
         "return dataclasses.replace(operation, control=None) if operation.gate == 'RY' else operation"),
    edit("values", r"3 qubits .*; the gates are right one by one, so .* at constants", CHANGE,
         "bare = tuple(dataclasses.replace(angle, constant=0.0) for angle in operation.angles)\n        "
         "return dataclasses.replace(operation, angles=bare)"),
    edit("gradients", r"derivative by inputs is .*, finite differences give .* four terms",
         EXACT, f"{VALUES}; return (values + values.detach()) / 2"),
    edit("gradients", r"the result has no gradient: compute in torch, or wrap", EXACT, f"{EXACT}.detach()",
         also=["repeatable", "seed independence", "shots"]),
    edit("gradients", r"no gradient reaches inputs: is it detached, or turned into numpy",
         EXACT, "return self.native(inputs.detach(), parameters)", also=["repeatable", "seed independence", "shots"]),
    edit("gradients", r"where inputs need no gradient, the gradient by scale differs", EXACT,
         f"{VALUES}; wanted = inputs.requires_grad or not torch.is_grad_enabled()\n        "
         "return values if wanted else (values + values.detach()) / 2"),
    edit("repeatable", r"same call twice gives different values: is there state that a call changes",
         SHOTS, f"{SHOTS}; self.calls = 0", EXACT, f"self.calls += 1; {EXACT} + 1e-12 * self.calls",
         also=["seed independence", "shots"]),
    edit("seed independence", r"seeds \[0\] among themselves get other values .* round differently",
         EXACT, f"{VALUES}; return values + 1e-12 * values.sum(0)", also=["shots"]),
    edit("seed independence", r"seeds \[3\] among themselves get other values than among all 5", EXACT,
         f"{VALUES}; return values + 1e-12 * torch.arange(len(values), dtype=values.dtype)[:, None, None]",
         also=["shots"]),
    edit("shots", r"shots = 200 was asked for, .* says 100: write self.shots = options.shots",
         SHOTS, "self.shots = None if options.shots is None else 100"),
    edit("shots", r"the same seeds give other samples: seed the simulator from `seeds`",
         NOISE, f"{NOISE}; seed = None"),
    edit("shots", r"the same seeds give other samples", NOISE, f"{NOISE}; seed = None", *SAMPLING),
    edit("shots", r"other seeds give the same samples: is `seeds` handed to the simulator",
         NOISE, f"{NOISE}; seed = 0"),
    edit("shots", r"other seeds give the same samples: .*, and `shots`", "torch.randn(like", "0 * torch.randn(like"),
    edit("shots", r"without seeds two calls give the same .* None stands for fresh entropy",
         NOISE, f"{NOISE}; seed = seed or 0"),
    edit("shots", r"with 200 shots values are 0\.2\d* from .* allows 0\.071: are there fewer shots",
         "torch.randn(like", "4 * torch.randn(like"),
    edit("shots", r"seeds \[4, 1, 3\] among themselves get other values than among all 5",
         "for seed in seeds", "for seed in seeds and [seeds[0]] * len(seeds)"),
    edit("shots", r"ValueError: Seed must be .*; .* 2\^63 - 1, which numpy.random.default_rng",
         NOISE, f"{NOISE}; np.random.RandomState(seed)"),
    edit("values", r"it says that it is noisy, and values are 0\.\d+ from the exact ones .* is more wrong",
         *NOISY, "* 0.8", "* -0.8"),
    edit("method=b", r"values differ from dense matrices by 0\.\d", "shots: int | None = None",
         "shots: int | None = None\n    method: Literal['a', 'b'] = 'a'",
         SHOTS, f"{SHOTS}; self.method = options.method", EXACT, f"{EXACT} * (1 if self.method == 'a' else 0.9)"),
    edit("mean field", r"spec says mean_field=True, and values .* differ from density matrices",
         "self.change)", "self.change, mean_field=False)", *NO_OPTION, mean_field=True),
]  # fmt: skip


def spec(*changes: str, mean_field: bool = False) -> CircuitBackendSpec:
    name = module(edit("", "", *changes).of(GOOD))
    return CircuitBackendSpec("broken", "Breaks a rule", f"{name}:Options", f"{name}:Backend", mean_field)


@pytest.mark.parametrize("edit", EDITS, ids=ids(EDITS))
def test_one_rule_is_broken(edit: Edit) -> None:
    assert_breaks(spec(*edit.changes, **edit.spec), edit.rule, edit.message, edit.also)


RULES = {edit.rule for edit in EDITS if "=" not in edit.rule}


@pytest.mark.parametrize(
    ("good", "rules"),
    [
        (spec(mean_field=True), RULES),
        (spec(*NO_OPTION, mean_field=True), RULES - {"shots"}),
        (spec(), RULES - {"mean field"}),
        (spec(*SAMPLING), {"builds", "shapes", "shots"}),
        (spec(*NOISY), {"builds", "shapes", "values"}),
    ],
    ids=["all", "exact", "circuits alone", "always samples", "noisy"],
)
def test_every_rule_that_applies_has_a_backend_that_breaks_it(
    good: CircuitBackendSpec, rules: set[str]
) -> None:
    assert assert_all_good(good) == rules


@pytest.mark.parametrize(
    ("gate", "controlled"),
    [(gate, controlled) for gate, kind in GATES.items() for controlled in {False, kind.controllable}],
)
def test_a_wrong_gate_is_named(gate: str, controlled: bool) -> None:
    same = f"operation.gate == {gate!r} and (operation.control is not None) == {controlled}"
    left_out = spec(CHANGE, f"return None if {same} else operation")
    [message] = [f.message for f in own_rules(left_out) if f.rule == "values"]
    named = message.partition("these are wrong: ")[2].partition(";")[0].split(", ")
    wanted = f"{gate} with control" if controlled else gate
    assert wanted in named
    # Rotations about X and Y are around every other gate.
    assert named == [wanted] or wanted in ("RX", "RY")


def values(circuit: Circuit) -> Any:
    draw = np.random.default_rng(0)
    weights = {name: draw.uniform(0, 6, p.shape) for name, p in circuit.parameters.items()}
    return expectation_values(circuit, draw.uniform(-1, 1, circuit.inputs), weights)


def test_every_operation_and_every_angle_of_the_circuit_shows_in_its_values() -> None:
    """Else a backend that is wrong there would pass."""
    circuit = every_gate()
    expected = values(circuit)
    for place in range(len(circuit)):
        operations = iter(range(len(circuit)))
        without = rewritten(circuit, lambda o, at=operations, p=place: None if next(at) == p else o)
        assert np.abs(values(without) - expected).max() > 1e-3, circuit.operations[place]
        for k in range(len(circuit.operations[place].angles)):
            operations = iter(range(len(circuit)))
            turned = rewritten(
                circuit, lambda o, at=operations, p=place, k=k: _turned(o, k) if next(at) == p else o
            )
            assert np.abs(values(turned) - expected).max() > 1e-3, (circuit.operations[place], k)


def _turned(operation: Operation, k: int) -> Operation:
    angles = list(operation.angles)
    angles[k] = angles[k] + 0.5
    return dataclasses.replace(operation, angles=tuple(angles))


def test_dense_matrices_on_a_circuit_that_is_computed_by_hand() -> None:
    """cos(x_0 + w_0) on the control; the CNOT multiplies it into the target's cos(x_1 + w_1)."""
    got = expectation_values(small(), np.array([0.2, 0.3]), {"weights": np.array([0.5, 0.9])})
    assert got == pytest.approx([np.cos(0.7), np.cos(0.7) * np.cos(1.2)], abs=1e-12)
