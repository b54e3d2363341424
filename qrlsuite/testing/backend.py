"""What a circuit backend keeps to: right values, right gradients, and seeds that do not influence each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qrlsuite import specs
from qrlsuite.circuit import GATES, Circuit
from qrlsuite.testing.common import Subject
from qrlsuite.testing.dense import expectation_values
from qrlsuite.testing.findings import SIZES, Checklist, Finding, one_thread, require

S, B, SHOTS = 5, 2, 200


def check(subject: Subject) -> list[Finding]:
    """Check a backend on circuits of two and three qubits that contain every gate."""
    spec = subject.spec
    assert isinstance(spec, specs.CircuitBackendSpec)
    factory, given = specs.resolve(spec.factory), subject.options()
    circuit = every_gate()
    rules = Checklist()
    made: list[Any] = []
    if not rules.run(
        "builds", "factory(circuit, options)", lambda: made.append(_build(factory, circuit, given))
    ):
        return rules.findings
    run = made[0]
    with one_thread():
        if not rules.run(
            "shapes", "(S, B, observables) in float32 and float64", lambda: _shapes(run, circuit)
        ):
            return rules.findings
        if run.shots is None:
            rules.run("values", "equal to dense matrices within 1e-6", lambda: _values(factory, given))
            rules.run("gradients", "equal to finite differences", lambda: _gradients(run, circuit))
            rules.run("repeatable", "called twice, the same bits", lambda: _repeatable(run, circuit))
            rules.run(
                "seed independence",
                "alone, in pairs, shuffled: the same bits in values and gradients",
                lambda: _independence(run, circuit, None),
            )
        cls = specs.resolve(spec.options)
        if "shots" in cls.__dataclass_fields__:
            sampled = factory(small(), cls(**{**subject.settings, "shots": SHOTS}))
            rules.run(
                "shots", "sampling of a seed depends on that seed alone", lambda: _shots(sampled, small())
            )
    return rules.findings


def every_gate() -> Circuit:
    """Return a circuit of three qubits with every gate, controlled ones too, and angles of every form."""
    circuit = Circuit(3, inputs=2)
    scale = circuit.parameter("scale", (2, 3))
    weight = circuit.parameter("weight", (12,))
    for q in range(3):
        circuit.append("H", q)
    circuit.append("RX", 0, scale[0, 0] * circuit.input(0) + weight[0])
    circuit.append("RY", 1, circuit.input(1) + 0.3)
    circuit.append("RZ", 2, weight[1])
    circuit.append("CNOT", (0, 1))
    angles = [scale[0, k] * circuit.input(1) + weight[2 + k] for k in (1, 2)]
    circuit.append("Rot", 1, weight[9], *angles)
    circuit.append("U3", 2, scale[1, 0] * circuit.input(0) + weight[5], weight[6], 0.7)
    circuit.append("CZ", (1, 2))
    circuit.append("SWAP", (0, 2))
    for gate in ("S", "T", "X", "Y", "Z"):
        circuit.append(gate, 1)
    circuit.append("RX", 1, weight[7], control=0)
    circuit.append("RY", 2, scale[1, 1] * circuit.input(0), control=1)
    circuit.append("RZ", 0, scale[1, 2] * circuit.input(1) + weight[8], control=2)
    circuit.append("Rot", 0, weight[10], 0.4, weight[11], control=1)
    circuit.append("U3", 1, 0.2, weight[3], weight[4], control=2)
    circuit.append("RX", 0, 0.9)
    assert {operation.gate for operation in circuit.operations} == set(GATES)
    circuit.measure((2, 0))
    return circuit


def small() -> Circuit:
    """Return a circuit of two qubits, for what takes long."""
    circuit = Circuit(2)
    weights = circuit.parameter("weights", (2,))
    for q in range(2):
        circuit.append("RY", q, circuit.input(q) + weights[q])
    circuit.append("CNOT", (0, 1))
    return circuit


def sample(
    circuit: Circuit, seeds: int = S, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Return inputs (S, B, in), parameters (S, ...) and a cotangent (S, B, out)."""
    source = torch.Generator().manual_seed(0)
    x = torch.randn(seeds, B, circuit.inputs, generator=source, dtype=torch.float64)
    weights = {
        name: (2 * math.pi * torch.rand(seeds, *p.shape, generator=source, dtype=torch.float64)).to(dtype)
        for name, p in circuit.parameters.items()
    }
    cotangent = torch.randn(seeds, B, len(circuit.observables), generator=source, dtype=torch.float64)
    return x.to(dtype), weights, cotangent.to(dtype)


def evaluate(
    run: Any, x: Tensor, weights: dict[str, Tensor], cotangent: Tensor, seeds: Sequence[int] | None = None
) -> dict[str, Tensor]:
    """Return values, and the gradients by inputs and by every parameter."""
    x = x.clone().requires_grad_()
    weights = {name: value.clone().requires_grad_() for name, value in weights.items()}
    values = run(x, weights, seeds)
    require(
        bool(values.requires_grad),
        "the result has no gradient: compute in torch, or wrap the simulator in a torch.autograd.Function",
    )
    values.backward(cotangent)
    result = {"values": values.detach()}
    for name, leaf in {"inputs": x, **weights}.items():
        require(
            leaf.grad is not None,
            f"no gradient reaches {name}: is it detached, or turned into numpy, on the way?",
        )
        assert leaf.grad is not None
        result[f"gradient by {name}"] = leaf.grad
    return result


def _build(factory: Any, circuit: Circuit, given: Any) -> Any:
    run = factory(circuit, given)
    require(callable(run), f"factory returned {type(run).__name__}, which cannot be called")
    require(
        hasattr(run, "shots"), "the backend has no attribute 'shots': set it to None where values are exact"
    )
    return run


def _shapes(run: Any, circuit: Circuit) -> None:
    for dtype in (torch.float32, torch.float64):
        x, weights, _ = sample(circuit, dtype=dtype)
        values = run(x, weights, list(range(S)))
        expected = (S, B, len(circuit.observables))
        require(
            tuple(values.shape) == expected,
            f"the result has shape {tuple(values.shape)}, and it must be (seeds, batch, observables) = {expected}",
        )
        require(
            values.dtype == dtype,
            f"inputs of {dtype} give a result of {values.dtype}: convert it, a learner's loss must stay in one type",
        )
        low, high = float(values.detach().min()), float(values.detach().max())
        require(
            max(-low, high) <= 1.0 + 1e-5,
            f"values lie in [{low:.3g}, {high:.3g}], and Pauli Z lies in [-1, 1]: is the state normalized?",
        )


def _values(factory: Any, given: Any) -> None:
    for circuit in (small(), every_gate()):
        x, weights, _ = sample(circuit)
        got = factory(circuit, given)(x, weights).detach().numpy()
        for s in range(S):
            mine = {name: value[s].numpy() for name, value in weights.items()}
            expected = np.array([expectation_values(circuit, x[s, b].numpy(), mine) for b in range(B)])
            difference = float(np.abs(got[s] - expected).max())
            if difference < 1e-6:
                continue
            cause = "compare gate by gate with the definitions in qrlsuite.circuit.description"
            if np.abs(got[s] - expected[:, ::-1]).max() < 1e-6:
                cause = "they agree in reverse: observables must come in the order of circuit.observables"
            require(
                False,
                f"values of {circuit.qubits} qubits differ from dense matrices by {difference:.2g}; {cause}",
            )


def _gradients(run: Any, circuit: Circuit) -> None:
    x, weights, cotangent = sample(circuit, seeds=1)
    got = evaluate(run, x, weights, cotangent)
    for name, leaf in {"inputs": x, **weights}.items():
        direction = torch.randn(leaf.shape, generator=torch.Generator().manual_seed(1), dtype=leaf.dtype)
        sides = []
        for sign in (1.0, -1.0):
            moved = leaf + sign * 1e-4 * direction
            others = {k: moved if k == name else v for k, v in weights.items()}
            sides.append((run(moved if name == "inputs" else x, others).detach() * cotangent).sum())
        numeric = float(sides[0] - sides[1]) / 2e-4
        exact = float((got[f"gradient by {name}"] * direction).sum())
        require(
            abs(numeric - exact) <= 1e-4 * max(1.0, abs(exact)),
            f"the derivative by {name} is {exact:.6g}, finite differences give {numeric:.6g}: the parameter-shift "
            "rule of controlled rotations has four terms, and a factor of scaled inputs belongs to the chain rule",
        )


def _repeatable(run: Any, circuit: Circuit) -> None:
    given = sample(circuit)
    first, second = evaluate(run, *given), evaluate(run, *given)
    for name, value in first.items():
        require(
            torch.equal(value, second[name]),
            f"the same call twice gives different {name}: is there state that a call changes?",
        )


def _independence(run: Any, circuit: Circuit, seeds: list[int] | None) -> None:
    x, weights, cotangent = sample(circuit)
    whole = evaluate(run, x, weights, cotangent, seeds)
    for members in SIZES:
        chosen = list(members)
        part = evaluate(
            run,
            x[chosen],
            {name: value[chosen] for name, value in weights.items()},
            cotangent[chosen],
            None if seeds is None else [seeds[s] for s in chosen],
        )
        for name, value in part.items():
            require(
                torch.equal(value, whole[name][chosen]),
                f"seeds {chosen} among themselves get other {name} than among all {S}: slice s may depend on slice s "
                "alone, to the last bit; sums and matrix products over the whole batch round differently by size",
            )


def _shots(run: Any, circuit: Circuit) -> None:
    require(
        run.shots == SHOTS, f"shots = {SHOTS} was asked for, and the backend's attribute says {run.shots}"
    )
    x, weights, _ = sample(circuit)
    seeds = [11, 12, 13, 14, 15]
    first, second = (run(x, weights, seeds).detach() for _ in range(2))
    require(torch.equal(first, second), "the same seeds give other samples: seed the simulator from `seeds`")
    other = run(x, weights, [seed + 100 for seed in seeds]).detach()
    require(
        not torch.equal(first, other),
        "other seeds give the same samples: is `seeds` handed to the simulator?",
    )
    _independence(run, circuit, seeds)
