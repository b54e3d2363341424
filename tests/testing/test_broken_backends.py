"""Circuit backends that break one rule each, all made of the native one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite.circuit import GATES, Circuit, Operation, create_backend
from qrlsuite.specs import CircuitBackendSpec
from qrlsuite.testing.circuits import every_gate, small
from qrlsuite.testing.dense import expectation_values
from tests.testing.broken import Broken, Cases, assert_breaks, ids, own_rules

HERE = __name__

Change = Callable[[Operation], Operation | None]


@dataclass(frozen=True)
class NoOptions:
    pass


@dataclass(frozen=True)
class Options:
    shots: Annotated[int | None, Field(description="repetitions; absent: exact")] = None


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


class Good:
    """Native's values; with shots, noise of their size, drawn for every agent from its own seed."""

    def __init__(self, circuit: Circuit, options: Any) -> None:
        self.shots: int | None = getattr(options, "shots", None)
        self.native = create_backend("native", rewritten(circuit, self.change))

    def change(self, operation: Operation) -> Operation | None:
        return operation

    def exact(self, inputs: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        return self.native(inputs, parameters)

    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        """Return noise (B, O) of standard deviation 1."""
        source = torch.Generator()
        if seed is None:
            source.seed()
        else:
            source.manual_seed(seed)
        return torch.randn(like.shape, generator=source, dtype=like.dtype)

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        values = self.exact(inputs, parameters)
        if self.shots is None:
            return values
        drawn = [self.noise(seed, values[0]) for seed in seeds or [None] * len(values)]
        return (values + torch.stack(drawn) / self.shots**0.5).clamp(-1, 1)


class NoReturn(Good):
    def __new__(cls, circuit: Circuit, options: Any) -> Any:
        return None


class Unfinished(Good):
    """Look gates up in a table that lacks one."""

    def change(self, operation: Operation) -> Operation | None:
        known = [gate for gate in GATES if gate != "T"]
        return dataclasses.replace(operation, gate=known[known.index(operation.gate)])


class NoShots(Good):
    def __init__(self, circuit: Circuit, options: Any) -> None:
        super().__init__(circuit, options)
        del self.shots


class ZeroShots(Good):
    def __init__(self, circuit: Circuit, options: Any) -> None:
        super().__init__(circuit, options)
        self.shots = 0


class Transposed(Good):
    def exact(self, *given: Any) -> Tensor:
        return super().exact(*given).transpose(1, 2)


class Squeezed(Good):
    def exact(self, *given: Any) -> Tensor:
        return super().exact(*given).squeeze()


class AllQubits(Good):
    def __init__(self, circuit: Circuit, options: Any) -> None:
        everywhere = rewritten(circuit, self.change)
        everywhere.measure(range(circuit.qubits))
        super().__init__(everywhere, options)


class Numpy(Good):
    def exact(self, *given: Any) -> Any:
        return super().exact(*given).detach().numpy()


class Double(Good):
    def exact(self, *given: Any) -> Tensor:
        return super().exact(*given).double()


class Unnormalized(Good):
    def exact(self, *given: Any) -> Tensor:
        return 3 * super().exact(*given)


class Positional(Good):
    def exact(self, inputs: Tensor, parameters: Any) -> Tensor:
        return super().exact(inputs, dict(enumerate(parameters)))  # type: ignore[arg-type]


class Reversed(Good):
    def exact(self, *given: Any) -> Tensor:
        return super().exact(*given).flip(2)


class Daggered(Good):
    """Apply T three times instead of once, and control RY by nothing."""

    def change(self, operation: Operation) -> Operation | None:
        if operation.gate == "T":
            return dataclasses.replace(operation, gate="S")
        return dataclasses.replace(operation, control=None) if operation.gate == "RY" else operation


class NoConstants(Good):
    def change(self, operation: Operation) -> Operation | None:
        bare = tuple(dataclasses.replace(angle, constant=0.0) for angle in operation.angles)
        return dataclasses.replace(operation, angles=bare)


class HalfGradient(Good):
    def exact(self, *given: Any) -> Tensor:
        values = super().exact(*given)
        return (values + values.detach()) / 2


class Detached(Good):
    def exact(self, *given: Any) -> Tensor:
        return super().exact(*given).detach()


class DetachedInputs(Good):
    def exact(self, inputs: Tensor, parameters: Any) -> Tensor:
        return super().exact(inputs.detach(), parameters)


class Greedy(Good):
    """Count on inputs that need a gradient."""

    def exact(self, inputs: Tensor, parameters: Any) -> Tensor:
        values = super().exact(inputs, parameters)
        return (
            values if inputs.requires_grad or not torch.is_grad_enabled() else (values + values.detach()) / 2
        )


class Drifting(Good):
    calls = 0

    def exact(self, *given: Any) -> Tensor:
        self.calls += 1
        return super().exact(*given) + 1e-12 * self.calls


class Coupled(Good):
    def exact(self, *given: Any) -> Tensor:
        values = super().exact(*given)
        return values + 1e-12 * values.sum(0)


class Ordered(Good):
    """Let the place in the stack decide."""

    def exact(self, *given: Any) -> Tensor:
        values = super().exact(*given)
        return values + 1e-12 * torch.arange(len(values), dtype=values.dtype)[:, None, None]


class FixedShots(Good):
    def __init__(self, circuit: Circuit, options: Any) -> None:
        super().__init__(circuit, options)
        self.shots = None if self.shots is None else 100


class Unseeded(Good):
    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        return super().noise(None, like)


class Deaf(Good):
    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        return super().noise(0, like)


class Noiseless(Good):
    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        return torch.zeros_like(like)


class AlwaysSeeded(Good):
    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        return super().noise(seed or 0, like)


class Stingy(Good):
    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        return 4 * super().noise(seed, like)


class OneStream(Good):
    def __call__(self, inputs: Tensor, parameters: Any, seeds: Sequence[int] | None = None) -> Tensor:
        return super().__call__(inputs, parameters, seeds and [seeds[0]] * len(seeds))


class ShortSeeds(Good):
    def noise(self, seed: int | None, like: Tensor) -> Tensor:
        source = np.random.RandomState(seed)
        return torch.from_numpy(source.standard_normal(like.shape)).to(like)


class Sampling(Good):
    """Sample always: without an option."""

    def __init__(self, circuit: Circuit, options: Any) -> None:
        super().__init__(circuit, options)
        self.shots = 100


class UnseededSampling(Sampling, Unseeded):
    pass


def spec(cls: type[Good], options: type[Any] = Options, mean_field: bool = False) -> CircuitBackendSpec:
    return CircuitBackendSpec(
        cls.__name__.lower(),
        "Breaks a rule",
        options=f"{HERE}:{options.__name__}",
        factory=f"{HERE}:{cls.__name__}",
        mean_field=mean_field,
    )


class NoMeanField(Good):
    """Say that mean-field circuits are computed, and compute the circuit itself."""

    def __init__(self, circuit: Circuit, options: Any) -> None:
        self.shots = None
        self.native = create_backend("native", rewritten(circuit, self.change, mean_field=False))


CASES: Cases = [
    ("builds", Broken(spec(NoReturn), r"returned NoneType, which cannot be called: write __call__")),
    (
        "builds",
        Broken(spec(Unfinished), r"ValueError: 'T' is not in list; factory takes a Circuit and the options"),
    ),
    ("builds", Broken(spec(NoShots), r"no attribute 'shots': set it to None where values are exact")),
    ("builds", Broken(spec(ZeroShots), r"attribute shots is 0: a positive integer, or None")),
    (
        "shapes",
        Broken(
            spec(Transposed),
            r"shape \(5, 2, 3\), .* \(seeds, batch, observables\) = \(5, 3, 2\): .*transposed",
        ),
    ),
    ("shapes", Broken(spec(Squeezed), r"result has shape \(2,\), .* = \(1, 1, 2\): is an axis squeezed")),
    (
        "shapes",
        Broken(spec(AllQubits), r"shape \(5, 3, 3\), .* every qubit measured instead of circuit.observables"),
    ),
    ("shapes", Broken(spec(Numpy), r"the result is ndarray, not a tensor: compute in torch, or wrap")),
    ("shapes", Broken(spec(Double), r"torch.float32 give a result of torch.float64: end with .to\(inputs\)")),
    (
        "shapes",
        Broken(spec(Unnormalized), r"values lie in \[-.*, and Pauli Z lies in \[-1, 1\]: is the state norm"),
    ),
    (
        "shapes",
        Broken(spec(Positional), r"OptionError: parameter 'scale' .* is missing; it is called with inputs"),
    ),
    (
        "values",
        Broken(
            spec(Reversed), r"they agree in reverse: .* order of circuit.observables", frozenset({"shots"})
        ),
    ),
    (
        "values",
        Broken(
            spec(Daggered), r"3 qubits .* alone between rotations, these are wrong: RY with control, T; see"
        ),
    ),
    ("values", Broken(spec(NoConstants), r"3 qubits .*; the gates are right one by one, so .* at constants")),
    (
        "gradients",
        Broken(spec(HalfGradient), r"derivative by inputs is .*, finite differences give .* four terms"),
    ),
    (
        "gradients",
        Broken(
            spec(Detached),
            r"the result has no gradient: compute in torch, or wrap",
            frozenset({"repeatable", "seed independence", "shots"}),
        ),
    ),
    (
        "gradients",
        Broken(
            spec(DetachedInputs),
            r"no gradient reaches inputs: is it detached, or turned into numpy",
            frozenset({"repeatable", "seed independence", "shots"}),
        ),
    ),
    ("gradients", Broken(spec(Greedy), r"where inputs need no gradient, the gradient by scale differs")),
    (
        "repeatable",
        Broken(
            spec(Drifting),
            r"same call twice gives different values: is there state that a call changes",
            frozenset({"seed independence", "shots"}),
        ),
    ),
    (
        "seed independence",
        Broken(
            spec(Coupled),
            r"seeds \[0\] among themselves get other values .* round differently",
            frozenset({"shots"}),
        ),
    ),
    (
        "seed independence",
        Broken(
            spec(Ordered),
            r"seeds \[3\] among themselves get other values than among all 5",
            frozenset({"shots"}),
        ),
    ),
    (
        "shots",
        Broken(spec(FixedShots), r"shots = 200 was asked for, .* says 100: write self.shots = options.shots"),
    ),
    ("shots", Broken(spec(Unseeded), r"the same seeds give other samples: seed the simulator from `seeds`")),
    ("shots", Broken(spec(Deaf), r"other seeds give the same samples: is `seeds` handed to the simulator")),
    ("shots", Broken(spec(Noiseless), r"other seeds give the same samples: .*, and `shots`")),
    (
        "shots",
        Broken(spec(AlwaysSeeded), r"without seeds two calls give the same .* None stands for fresh entropy"),
    ),
    (
        "shots",
        Broken(
            spec(Stingy), r"with 200 shots values are 0\.2\d* from .* allows 0\.071: are there fewer shots"
        ),
    ),
    ("shots", Broken(spec(OneStream), r"seeds \[1, 2\] among themselves get other values than among all 5")),
    (
        "shots",
        Broken(
            spec(ShortSeeds), r"ValueError: Seed must be .*; .* 2\^63 - 1, which numpy.random.default_rng"
        ),
    ),
    ("shots", Broken(spec(UnseededSampling, NoOptions), r"the same seeds give other samples")),
    (
        "mean field",
        Broken(
            spec(NoMeanField, NoOptions, True),
            r"spec says mean_field=True, and values .* differ from density matrices",
        ),
    ),
]


@pytest.mark.parametrize(("rule", "case"), CASES, ids=ids(CASES))
def test_one_rule_is_broken(rule: str, case: Broken) -> None:
    assert_breaks("circuit_backends", rule, case)


def test_every_rule_has_a_backend_that_breaks_it() -> None:
    findings = own_rules("circuit_backends", spec(Good, mean_field=True))
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in CASES}


def test_an_exact_backend_has_no_rule_about_shots() -> None:
    findings = own_rules("circuit_backends", spec(Good, NoOptions, True))
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in CASES} - {"shots"}


def test_a_backend_of_circuits_alone_has_no_rule_about_mean_fields() -> None:
    findings = own_rules("circuit_backends", spec(Good))
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in CASES} - {"mean field"}


def test_a_backend_that_always_samples_is_held_to_that() -> None:
    findings = own_rules("circuit_backends", spec(Sampling, NoOptions))
    assert all(finding.ok for finding in findings), findings
    assert [finding.rule for finding in findings] == ["builds", "shapes", "shots"]


class Missing(Good):
    """Leave out one gate."""

    gate: str
    controlled: bool

    def change(self, operation: Operation) -> Operation | None:
        missing = operation.gate == self.gate and (operation.control is not None) == self.controlled
        return None if missing else operation


@pytest.mark.parametrize(
    ("gate", "controlled"),
    [(gate, controlled) for gate, kind in GATES.items() for controlled in {False, kind.controllable}],
)
def test_a_wrong_gate_is_named(gate: str, controlled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Missing, "gate", gate, raising=False)
    monkeypatch.setattr(Missing, "controlled", controlled, raising=False)
    [message] = [f.message for f in own_rules("circuit_backends", spec(Missing)) if f.rule == "values"]
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
