"""Measurements before the end, resets, and gates that depend on outcomes: held to PennyLane, Aer and Qiskit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch
from qiskit import ClassicalRegister, QuantumCircuit, QuantumRegister
from qiskit_aer.primitives import SamplerV2 as AerSampler

from qrlsuite.circuit import expectations
from qrlsuite.circuit.tracing import trace
from qrlsuite.plugins.circuits.native.qiskit_primitives import EstimatorV2, SamplerV2
from qrlsuite.testing.dense import expectation_values

Step = tuple[str, int, float]
WIRES, BITS, SHOTS = 3, 4, 20_000
CONDITIONAL = ("X", "Y", "Z", "H", "S", "T", "RX", "RY")


def program(seed: int) -> list[Step]:
    """Return rotations, gates, measurements, resets, and gates where the last outcome is 1, on three qubits."""
    source = np.random.default_rng(seed)
    steps: list[Step] = [("RY", q, float(source.uniform(0.5, 2.5))) for q in range(WIRES)]
    steps += [("measure", 0, 0.0), (f"if {CONDITIONAL[seed]}", 1, 1.1), ("RX", 1, 0.7)]
    left = BITS - 1
    for kind in source.choice(["RX", "CNOT", "measure", "reset", "if"], 14):
        if kind == "measure":
            if left == 0:
                continue
            left -= 1
        name = f"{kind} {source.choice(CONDITIONAL)}" if kind == "if" else str(kind)
        steps.append((name, int(source.integers(WIRES)), float(source.uniform(0.5, 2.5))))
    return steps


weight_shapes: dict[str, Any] = {}
ENDS = [qml.Z(0), qml.X(1), qml.Z(0) @ qml.Y(2)]


def of(steps: list[Step]) -> Any:
    """Return PennyLane's quantum function of a program."""

    def function(inputs: Any) -> list[Any]:
        outcomes: list[Any] = []
        for kind, q, number in steps:
            if kind in ("measure", "reset"):
                outcome = qml.measure(q, reset=kind == "reset")
                outcomes += [outcome] if kind == "measure" else []
            elif kind.startswith("if"):
                gate = kind.split()[1]
                angles = [number * inputs[0]] if gate in ("RX", "RY") else []
                qml.cond(outcomes[-1], getattr(qml, gate))(*angles, wires=q)
            elif kind == "CNOT":
                qml.CNOT([q, (q + 1) % WIRES])
            else:
                getattr(qml, kind)(number * inputs[0], wires=q)
        return [qml.expval(end) for end in ENDS]

    return function


def qiskits(steps: list[Step]) -> QuantumCircuit:
    made = QuantumCircuit(
        QuantumRegister(WIRES), ClassicalRegister(BITS, "c"), ClassicalRegister(WIRES, "end")
    )
    found = 0
    for kind, q, number in steps:
        if kind == "measure":
            made.measure(q, found)
            found += 1
        elif kind.startswith("if"):
            name = kind.split()[1].lower()
            with made.if_test((made.clbits[found - 1], 1)):
                getattr(made, name)(*([number] if name in ("rx", "ry") else []), q)
        elif kind == "CNOT":
            made.cx(q, (q + 1) % WIRES)
        elif kind == "reset":
            made.reset(q)
        else:
            getattr(made, kind.lower())(number, q)
    return made


@pytest.mark.parametrize("seed", range(8))
def test_values_are_those_of_pennylane_and_aer(seed: int) -> None:
    steps = program(seed)
    circuit = trace(of(steps), WIRES)
    assert circuit.qubits - circuit.deferred == WIRES
    assert circuit.observables == (0, "X1", "Z0 Y2")
    expected = qml.QNode(of(steps), qml.device("default.qubit"))([1.0])
    found = expectations(circuit, torch.ones(1, 1, dtype=torch.float64), {})[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(expectation_values(circuit, np.ones(1), {}), expected, atol=1e-12)

    made = qiskits(steps)
    observables = ["IIZ", "IXI", "YIZ"]
    means = EstimatorV2().run([(made, [[each] for each in observables])]).result()[0].data.evs[:, 0]
    np.testing.assert_allclose(means, expected, atol=1e-12)
    made.measure(range(WIRES), made.cregs[1])
    samplers = SamplerV2(seed=1), AerSampler(seed=1)
    joint = []
    for sampler in samplers:
        data = sampler.run([made], shots=SHOTS).result()[0].data
        bits = np.concatenate([data.c.to_bool_array(), data.end.to_bool_array()], axis=1)
        joint.append(np.bincount(bits @ (1 << np.arange(BITS + WIRES)), minlength=1 << (BITS + WIRES)))
    spread = np.sqrt(joint[0] + joint[1] + 1)
    assert np.all(np.abs(joint[0] - joint[1]) < 5 * spread)


@pytest.mark.parametrize(
    ("backend", "options"),
    [
        ("pennylane", {}),
        ("qiskit", {}),
        ("native", {"shots": SHOTS}),
        ("pennylane", {"device": "qrlsuite.native"}),
    ],
)
def test_every_backend_runs_them_with_gradients(backend: str, options: dict) -> None:
    circuit = trace(of(program(3)), WIRES)
    circuit.measure([0, 1, (0, 2)])
    values, gradients = [], []
    for name, chosen in (("native", {}), (backend, options)):
        x = torch.full((1, 1), 0.7, dtype=torch.float64, requires_grad=True)
        values.append(expectations(circuit, x, {}, name, seed=2, **chosen))
        gradients.append(torch.autograd.grad(values[-1].sum(), x)[0])
    exact = "shots" not in options
    torch.testing.assert_close(*values, rtol=0, atol=1e-9 if exact else 5 / SHOTS**0.5)
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-9 if exact else 0.5)


def test_a_register_is_compared_with_a_number() -> None:
    made = QuantumCircuit(3, 3)
    for q in range(2):
        made.ry(0.4 + q, q)
        made.measure(q, q)
    with made.if_test((made.cregs[0], 2)) as otherwise:
        made.ry(0.9, 2)
    with otherwise:
        made.rx(0.3, 2)
    with made.if_test((made.clbits[2], 1)):  # not measured yet, so 0
        made.x(2)
    made.measure(2, 2)
    ones = []
    for sampler in (SamplerV2(seed=1), AerSampler(seed=1)):
        counts = sampler.run([made], shots=SHOTS).result()[0].data.c.get_counts()
        ones.append(np.array([counts.get(f"{k:03b}", 0) for k in range(8)]))
    assert np.all(np.abs(ones[0] - ones[1]) < 5 * np.sqrt(ones[0] + ones[1] + 1))
