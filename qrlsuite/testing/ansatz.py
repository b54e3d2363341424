"""What an ansatz keeps to: a pure function of its arguments whose every input and parameter matters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, create_backend
from qrlsuite.errors import OptionError
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, one_thread, require

QUBITS, LAYERS = (1, 2, 3, 4), (1, 2, 3)
LARGEST = 20


def check(subject: Subject) -> list[Finding]:
    """Check an ansatz at 1 to 4 qubits and 1 to 3 layers."""
    spec = subject.spec
    assert isinstance(spec, specs.AnsatzSpec)
    build, given = specs.resolve(spec.build), subject.options()
    circuits: dict[tuple[int, int], Circuit] = {}
    rules = Checklist()
    if not rules.run("builds", "1 to 4 qubits, 1 to 3 layers", lambda: _builds(build, given, circuits)):
        return rules.findings
    rules.run("pure", "built twice, it is the same circuit", lambda: _pure(build, given, circuits))
    rules.run("inputs used", "every input feature sets an angle", lambda: _inputs(circuits))
    rules.run("parameters used", "every trainable scalar sets an angle", lambda: _parameters(circuits))
    rules.run("layers", "more layers make a longer circuit", lambda: _layers(circuits))
    with one_thread():
        rules.run(
            "gradients",
            "flow to inputs and parameters, and match finite differences",
            lambda: _flow(circuits),
        )
        rules.run("backends", "every installed backend gives the same values", lambda: _backends(circuits))
    return rules.findings


def _builds(build: Any, given: Any, circuits: dict[tuple[int, int], Circuit]) -> None:
    refused = ""
    for qubits in QUBITS:
        for layers in LAYERS:
            try:
                circuit = build(qubits, layers, given)
            except OptionError as error:  # an ansatz may refuse a size, in words
                refused = str(error)
                continue
            except Exception as error:
                raise BrokenRuleError(
                    f"{qubits} qubits, {layers} layers: {type(error).__name__}: {error}; an ansatz that cannot have "
                    "this size raises qrlsuite.errors.OptionError and says which sizes it can have"
                ) from error
            require(
                isinstance(circuit, Circuit),
                f"build returned {type(circuit).__name__}, not a qrlsuite.circuit.Circuit: is `return circuit` there?",
            )
            require(
                circuit.qubits == qubits,
                f"asked for {qubits} qubits, the circuit has {circuit.qubits}: write Circuit(qubits)",
            )
            require(bool(circuit.operations), f"{qubits} qubits, {layers} layers: the circuit has no gate")
            circuits[qubits, layers] = circuit
    require(bool(circuits), f"refuses every size of 1 to 4 qubits and 1 to 3 layers: {refused}")
    if (4, 1) in circuits:
        build(LARGEST, 1, given)


def _pure(build: Any, given: Any, circuits: dict[tuple[int, int], Circuit]) -> None:
    for (qubits, layers), circuit in circuits.items():
        again = build(qubits, layers, given)
        require(
            again.operations == circuit.operations
            and again.parameters == circuit.parameters
            and again.observables == circuit.observables,
            f"{qubits} qubits, {layers} layers: built twice, the circuits differ; an ansatz must not draw random "
            "numbers or remember anything, for each agent builds its own",
        )


def _inputs(circuits: dict[tuple[int, int], Circuit]) -> None:
    for (qubits, layers), circuit in circuits.items():
        used = {angle.input for op in circuit.operations for angle in op.angles if angle.input is not None}
        unused = sorted(set(range(circuit.inputs)) - used)
        require(
            not unused,
            f"{qubits} qubits, {layers} layers: input {unused[0] if unused else ''} sets no angle, so the agent "
            "cannot see it; encode it with circuit.append('RX', q, circuit.input(q))",
        )


def _parameters(circuits: dict[tuple[int, int], Circuit]) -> None:
    for (qubits, layers), circuit in circuits.items():
        elements = {
            (element.parameter, element.index)
            for op in circuit.operations
            for angle in op.angles
            for element in (angle.scale, angle.weight)
            if element is not None
        }
        for name, parameter in circuit.parameters.items():
            unused = [i for i in range(parameter.size) if (name, i) not in elements]
            if unused:
                index = tuple(int(i) for i in np.unravel_index(unused[0], parameter.shape))
                raise BrokenRuleError(
                    f"{qubits} qubits, {layers} layers: {name}{list(index)} of shape {parameter.shape} sets no angle "
                    f"({len(unused)} of {parameter.size} do not); declare a smaller parameter or use all of it"
                )
        require(
            bool(circuit.parameters), f"{qubits} qubits, {layers} layers: there is no trainable parameter"
        )


def _layers(circuits: dict[tuple[int, int], Circuit]) -> None:
    for (qubits, layers), circuit in circuits.items():
        longer = circuits.get((qubits, layers + 1))
        require(
            longer is None or len(longer.operations) > len(circuit.operations),
            f"{qubits} qubits: {layers + 1} layers have no more gates than {layers}; is the loop over layers there?",
        )


def _sample(circuit: Circuit, seed: int = 0) -> tuple[Any, dict[str, Any]]:
    """Return inputs (1, 3, in) and parameters (1, ...) in float64, as leaves."""
    import torch

    source = torch.Generator().manual_seed(seed)
    x = torch.rand(1, 3, circuit.inputs, generator=source, dtype=torch.float64) * 2 - 1
    weights = {
        name: 2 * math.pi * torch.rand(1, *p.shape, generator=source, dtype=torch.float64)
        for name, p in circuit.parameters.items()
    }
    return x.requires_grad_(), {name: value.requires_grad_() for name, value in weights.items()}


def _usual_backend() -> str:
    names = registry.load().names("circuit_backends")
    require(bool(names), "no circuit backend is installed")
    return "native" if "native" in names else names[0]


def _smallest(circuits: dict[tuple[int, int], Circuit]) -> Circuit:
    """Return the two-qubit circuit with two layers, or the nearest to it that exists."""
    return circuits[min(circuits, key=lambda size: (abs(size[0] - 2), abs(size[1] - 2)))]


def _flow(circuits: dict[tuple[int, int], Circuit]) -> None:
    import torch

    for (qubits, layers), circuit in circuits.items():
        if layers != 2:
            continue
        run = create_backend(_usual_backend(), circuit)
        x, parameters = _sample(circuit)
        values = run(x, parameters)
        values.square().sum().backward()  # type: ignore[no-untyped-call]
        where = f"{qubits} qubits, {layers} layers"
        gradients = {"inputs": x.grad, **{name: p.grad for name, p in parameters.items()}}
        for name, gradient in gradients.items():
            require(
                gradient is not None and bool((gradient.abs() > 1e-12).any()),
                f"{where}: no expectation value depends on {name}; rotations about Z of a qubit in state 0, and about "
                "any axis after which nothing is measured, change nothing",
            )
        with torch.no_grad():
            for name, leaf in {"inputs": x, **parameters}.items():
                direction = torch.ones_like(leaf)
                sides = []
                for sign in (1, -1):
                    moved = {k: v + sign * 1e-5 if k == name else v for k, v in parameters.items()}
                    sides.append(run(x + sign * 1e-5 if name == "inputs" else x, moved).square().sum())
                numeric = float(sides[0] - sides[1]) / 2e-5
                exact = float(((leaf.grad if leaf.grad is not None else direction) * direction).sum())
                require(
                    abs(numeric - exact) <= 1e-6 * max(1.0, abs(exact)),
                    f"{where}: the derivative by {name} is {exact:.6g}, finite differences give {numeric:.6g}",
                )


def _backends(circuits: dict[tuple[int, int], Circuit]) -> None:
    circuit = _smallest(circuits)
    x, parameters = _sample(circuit)
    usual = _usual_backend()
    expected = create_backend(usual, circuit)(x, parameters).detach()
    for name in registry.load().names("circuit_backends"):
        if name == usual:
            continue
        try:
            values = create_backend(name, circuit)(x, parameters).detach()
        except Exception as error:
            raise BrokenRuleError(
                f"backend '{name}' cannot run it: {type(error).__name__}: {error}"
            ) from error
        difference = float((values - expected).abs().max())
        require(
            difference < 1e-6,
            f"backends '{usual}' and '{name}' differ by {difference:.2g}; report it: it is a bug",
        )
