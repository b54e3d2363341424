"""Rules of circuit backends: correct values and gradients; seeds do not influence each other."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qrlsuite import specs
from qrlsuite.circuit import GATES, Circuit
from qrlsuite.testing.circuits import every_gate, one_gate, small
from qrlsuite.testing.common import Subject, check_cases
from qrlsuite.testing.dense import expectation_values
from qrlsuite.testing.findings import SIZES, Checklist, Finding, one_thread, require

S, B, SHOTS = 5, 2, 200
NOISE = 0.3
"""Distance of a noisy backend's values from the exact ones, at most."""

SEEDS = (1, 2**31 + 1, 2**40 + 7, 2**62 + 1, 2**63 - 1)
"""One per agent: runs draw them from all of 0 to 2^63 - 1."""


def check(subject: Subject) -> list[Finding]:
    """Check a backend on circuits of two and three qubits that contain every gate."""
    spec = subject.spec
    assert isinstance(spec, specs.CircuitBackendSpec)
    factory, options = specs.resolve(spec.factory), subject.options()
    circuit = every_gate()
    rules = Checklist()
    backends: list[Any] = []
    cause = "factory takes a Circuit and the options; one that it cannot run is refused by qrlsuite.errors.OptionError"
    builds = "from a circuit with every gate, and options"
    if not rules.run("builds", builds, lambda: backends.append(_build(factory, circuit, options)), cause):
        return rules.findings
    run = backends[0]
    with one_thread():
        cause = (
            "it is called with inputs (S, B, in), a dict of parameters (S, ...), and seeds: None, or S integers "
            "from 0 to 2^63 - 1, which numpy.random.default_rng and torch.Generator take"
        )
        shapes = "(S, B, observables) in float32 and float64, for one agent, input or observable too"
        if not rules.run("shapes", shapes, lambda: _shapes(factory, run, circuit, options), cause):
            return rules.findings
        if noisy(run):
            rules.run(
                "values",
                "near the exact ones; it says that it is noisy, so nothing exact is tried",
                lambda: _near(factory(small(), options)),
            )
        elif run.shots is None:
            rules.run("values", "equal to dense matrices within 1e-6", lambda: _values(factory, options))
            rules.run("gradients", "equal to finite differences", lambda: require_gradients(run, circuit))
            rules.run("repeatable", "called twice, the same bits", lambda: _repeatable(run, circuit))
            rules.run(
                "seed independence",
                "alone, in pairs, shuffled: the same bits in values and gradients",
                lambda: _independence(run, circuit, None),
            )
        if spec.mean_field and exact(run):
            rules.run(
                "mean field",
                "values, gradients and seeds of mean-field circuits too",
                lambda: _mean_field(factory, options),
            )
        samples = run.shots is not None or "shots" in specs.resolve(spec.options).__dataclass_fields__
        if samples and not noisy(run):
            rules.run(
                "shots",
                "near the exact values, and the sampling of a seed depends on that seed alone",
                lambda: _shots(subject, factory, run.shots),
                cause,
            )
        check_cases(rules, subject.choices(), lambda chosen: _works(factory, chosen.options()))
    return rules.findings


def noisy(run: Any) -> bool:
    """Return whether a backend says that its values differ from the exact ones by noise."""
    return bool(getattr(run, "noisy", False))


def exact(run: Any) -> bool:
    """Return whether a backend says that its values are exact."""
    return run.shots is None and not noisy(run)


def _works(factory: Any, options: Any) -> None:
    """Check values and shapes of gradients with options; exact values where the backend says so."""
    circuit = small()
    run = _build(factory, circuit, options)
    evaluate(run, *sample(circuit), SEEDS)
    if exact(run):
        difference = distance(run, circuit)
        require(difference < 1e-6, f"values differ from dense matrices by {difference:.2g}")


def sample(
    circuit: Circuit, seeds: int = S, batch: int = B, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Return inputs (S, B, in) in [-1, 1], parameters (S, ...) and a cotangent (S, B, out)."""
    source = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(seeds, batch, circuit.inputs, generator=source, dtype=torch.float64) - 1
    weights = {
        name: (2 * math.pi * torch.rand(seeds, *p.shape, generator=source, dtype=torch.float64)).to(dtype)
        for name, p in circuit.parameters.items()
    }
    cotangent = torch.randn(seeds, batch, len(circuit.observables), generator=source, dtype=torch.float64)
    return x.to(dtype), weights, cotangent.to(dtype)


def evaluate(
    run: Any,
    x: Tensor,
    weights: dict[str, Tensor],
    cotangent: Tensor,
    seeds: Sequence[int] | None = None,
    fixed_inputs: bool = False,
) -> dict[str, Tensor]:
    """Return values, and the gradients by inputs (unless they are fixed) and by every parameter."""
    x = x.clone().requires_grad_(not fixed_inputs)
    weights = {name: value.clone().requires_grad_() for name, value in weights.items()}
    values = run(x, weights, seeds)
    require(
        bool(values.requires_grad),
        "the result has no gradient: compute in torch, or wrap the simulator in a torch.autograd.Function",
    )
    values.backward(cotangent)
    result = {"values": values.detach()}
    for name, leaf in {**({} if fixed_inputs else {"inputs": x}), **weights}.items():
        require(
            leaf.grad is not None,
            f"no gradient reaches {name}: is it detached, or turned into numpy, on the way?",
        )
        assert leaf.grad is not None
        result[f"gradient by {name}"] = leaf.grad
    return result


def _build(factory: Any, circuit: Circuit, options: Any) -> Any:
    run = factory(circuit, options)
    require(
        callable(run),
        f"factory returned {type(run).__name__}, which cannot be called: write __call__(self, inputs, parameters, "
        "seeds=None), and is `return` there?",
    )
    require(
        hasattr(run, "shots"), "the backend has no attribute 'shots': set it to None where values are exact"
    )
    shots = run.shots
    require(
        shots is None or (isinstance(shots, int) and shots > 0),
        f"the backend's attribute shots is {shots!r}: a positive integer, or None where values are exact",
    )
    return run


def _shapes(factory: Any, run: Any, circuit: Circuit, options: Any) -> None:
    single = small()
    single.measure([1])
    alone = factory(single, options)
    for dtype in (torch.float32, torch.float64):
        _shape(run, circuit, S, 3, dtype)
    for agents, batch in ((1, 1), (S, 1), (1, 3)):
        _shape(run, circuit, agents, batch, torch.float32)
        _shape(alone, single, agents, batch, torch.float32)


def _shape(run: Any, circuit: Circuit, agents: int, batch: int, dtype: torch.dtype) -> None:
    x, weights, _ = sample(circuit, agents, batch, dtype)
    values = run(x, weights, SEEDS[:agents])
    require(
        isinstance(values, Tensor),
        f"the result is {type(values).__name__}, not a tensor: compute in torch, or wrap the simulator in a "
        "torch.autograd.Function",
    )
    expected = (agents, batch, len(circuit.observables))
    require(
        tuple(values.shape) == expected,
        f"the result has shape {tuple(values.shape)}, and it must be (seeds, batch, observables) = {expected}: is an "
        "axis squeezed or transposed, or is every qubit measured instead of circuit.observables?",
    )
    require(
        values.dtype == dtype,
        f"inputs of {dtype} give a result of {values.dtype}: end with .to(inputs), a learner's loss must stay in one "
        "type",
    )
    low, high = float(values.detach().min()), float(values.detach().max())
    require(
        max(-low, high) <= 1.0 + 1e-5,
        f"values lie in [{low:.3g}, {high:.3g}], and Pauli Z lies in [-1, 1]: is the state normalized?",
    )


def _dense(circuit: Circuit, x: Tensor, weights: dict[str, Tensor]) -> Tensor:
    """Return the expectation values (S, B, out) by dense matrices."""
    rows = []
    for s, inputs in enumerate(x.numpy()):
        mine = {name: value[s].numpy() for name, value in weights.items()}
        rows.append([expectation_values(circuit, row, mine) for row in inputs])
    return torch.from_numpy(np.array(rows))


def distance(run: Any, circuit: Circuit, seeds: int = S, reverse: bool = False) -> float:
    """Return the largest distance of a backend's values from dense matrices' values."""
    x, weights, _ = sample(circuit, seeds, batch=3)
    expected = _dense(circuit, x, weights)
    got = run(x, weights).detach()
    return float((got - (expected.flip(2) if reverse else expected)).abs().max())


def _error(run: Any, circuit: Circuit) -> float:
    """Return the root mean square of the distances of a backend's values from dense matrices' values."""
    x, weights, _ = sample(circuit)
    return float((run(x, weights, SEEDS).detach() - _dense(circuit, x, weights)).square().mean().sqrt())


def _near(run: Any) -> None:
    """Require that noise leaves most of the values."""
    error = _error(run, small())
    require(
        error < NOISE,
        f"it says that it is noisy, and values are {error:.2g} from the exact ones (root mean square): is more wrong?",
    )


def _values(factory: Any, options: Any) -> None:
    for circuit in (small(), every_gate()):
        run = factory(circuit, options)
        difference = distance(run, circuit)
        if difference < 1e-6:
            continue
        cause = (
            "the gates are right one by one, so look at their order, at constants, at elements that set several "
            "angles, and at scale * input + weight"
        )
        wrong = _wrong_gates(factory, options)
        if distance(run, circuit, reverse=True) < 1e-6:
            cause = "they agree in reverse: results come in the order of circuit.observables"
        elif wrong:
            cause = (
                f"alone between rotations, these are wrong: {', '.join(wrong)}; see GATES in qrlsuite.circuit"
            )
        require(
            False,
            f"values of {circuit.qubits} qubits differ from dense matrices by {difference:.2g}; {cause}",
        )


def _mean_field(factory: Any, options: Any) -> None:
    circuit = every_gate(mean_field=True)
    run = factory(circuit, options)
    difference = distance(run, circuit)
    require(
        difference < 1e-6,
        f"the spec says mean_field=True, and values of a mean-field circuit differ from density matrices by "
        f"{difference:.2g}: after every gate on two qubits only the reduced state of each may be kept",
    )
    require_gradients(run, circuit)
    _independence(run, circuit, None)


def _wrong_gates(factory: Any, options: Any) -> list[str]:
    """Return the gates, each tried by itself between rotations about X and Y, whose values are wrong."""
    tried = [
        (gate, control) for gate, kind in GATES.items() for control in (False, True)[: 1 + kind.controllable]
    ]
    return [
        f"{gate} with control" if controlled else gate
        for gate, controlled in tried
        if not distance(factory(circuit := one_gate(gate, controlled), options), circuit) < 1e-6
    ]


def require_gradients(run: Any, circuit: Circuit) -> None:
    """Require that gradients are finite differences of the values."""
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
            "rule of controlled rotations has four terms, a factor of scaled inputs belongs to the chain rule, and an "
            "element that sets several angles gets the sum",
        )
    fixed = evaluate(run, x, weights, cotangent, fixed_inputs=True) if weights else {}
    for name, value in fixed.items():
        require(
            torch.allclose(value, got[name], rtol=1e-6, atol=1e-6),
            f"where inputs need no gradient, the {name} differs: a backward pass must count on no input to need one",
        )


def _repeatable(run: Any, circuit: Circuit) -> None:
    settings = sample(circuit, seeds=1)
    first, second = evaluate(run, *settings), evaluate(run, *settings)
    for name, value in first.items():
        require(
            torch.equal(value, second[name]),
            f"the same call twice gives different {name}: is there state that a call changes?",
        )


def _independence(run: Any, circuit: Circuit, seeds: Sequence[int] | None) -> None:
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


def _shots(subject: Subject, factory: Any, shots: int | None) -> None:
    """Check sampling with the backend's own number of shots, or with SHOTS where it is exact by default."""
    circuit, n_shots = small(), shots or SHOTS
    options = subject.options() if shots else dataclasses.replace(subject.options(), shots=n_shots)
    run = factory(circuit, options)
    require(
        run.shots == n_shots,
        f"shots = {n_shots} was asked for, and the backend's attribute says {run.shots}: write "
        "self.shots = options.shots",
    )
    x, weights, _ = sample(circuit)
    first, second = (run(x, weights, SEEDS).detach() for _ in range(2))
    require(torch.equal(first, second), "the same seeds give other samples: seed the simulator from `seeds`")
    other = run(x, weights, [seed - 1 for seed in SEEDS]).detach()
    require(
        not torch.equal(first, other),
        "other seeds give the same samples: is `seeds` handed to the simulator, and `shots`?",
    )
    first_fresh, second_fresh = (run(x, weights).detach() for _ in range(2))
    require(
        not torch.equal(first_fresh, second_fresh),
        "without seeds two calls give the same samples: None stands for fresh entropy",
    )
    error = _error(run, circuit)
    require(
        error <= 2 / math.sqrt(n_shots),
        f"with {n_shots} shots values are {error:.2g} from the exact ones (root mean square), and sampling allows "
        f"{1 / math.sqrt(n_shots):.2g}: are there fewer shots than asked for, or is there a bias?",
    )
    _independence(run, circuit, SEEDS)
