"""Measurements before the end, resets, and gates that depend on outcomes: held to PennyLane, Aer and Qiskit."""

from __future__ import annotations

import numpy as np
import pennylane as qml
import pytest
import torch
from qiskit import ClassicalRegister, QuantumCircuit, QuantumRegister
from qiskit_aer.primitives import SamplerV2 as AerSampler

from qrlsuite.circuit import Circuit, expectations
from qrlsuite.errors import CircuitError
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


def ours(steps: list[Step]) -> tuple[Circuit, list]:
    circuit, outcomes = Circuit(WIRES), []
    angle = circuit.input(0)
    for kind, q, number in steps:
        if kind == "measure":
            outcomes.append(circuit.measure_mid(q))
        elif kind == "reset":
            circuit.reset(q)
        elif kind.startswith("if"):
            gate = kind.split()[1]
            angles = [number * angle] if gate in ("RX", "RY") else []
            circuit.append(gate, q, *angles, control=outcomes[-1])
        elif kind == "CNOT":
            circuit.append(kind, (q, (q + 1) % WIRES))
        else:
            circuit.append(kind, q, number * angle)
    return circuit, outcomes


@qml.qnode(qml.device("default.qubit"))
def pennylanes(steps: list[Step]) -> list:
    outcomes: list = []
    for kind, q, number in steps:
        if kind in ("measure", "reset"):
            outcome = qml.measure(q, reset=kind == "reset")
            outcomes += [outcome] if kind == "measure" else []
        elif kind.startswith("if"):
            gate = kind.split()[1]
            qml.cond(outcomes[-1], getattr(qml, gate))(*([number] if gate in ("RX", "RY") else []), wires=q)
        elif kind == "CNOT":
            qml.CNOT([q, (q + 1) % WIRES])
        else:
            getattr(qml, kind)(number, wires=q)
    ends = [qml.Z(0), qml.X(1), qml.Z(0) @ qml.Y(2)]
    return [*map(qml.expval, ends), *(qml.expval(outcome) for outcome in outcomes)]


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
    circuit, outcomes = ours(steps)
    different = list(dict.fromkeys(outcomes))  # a qubit that is measured twice is found the same
    circuit.measure([0, "X1", "Z0 Y2", *different])
    found = expectations(circuit, torch.ones(1, WIRES, dtype=torch.float64), {})[0].numpy()
    expected = np.array(pennylanes(steps))[[0, 1, 2, *(3 + outcomes.index(each) for each in different)]]
    expected[3:] = 1 - 2 * expected[3:]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(expectation_values(circuit, np.ones(WIRES), {}), expected, atol=1e-12)

    made = qiskits(steps)
    observables = ["IIZ", "IXI", "YIZ"]
    means = EstimatorV2().run([(made, [[each] for each in observables])]).result()[0].data.evs[:, 0]
    np.testing.assert_allclose(means, expected[:3], atol=1e-12)
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
    steps = program(3)
    circuit, outcomes = ours(steps)
    circuit.measure([0, 1, (0, 2), *dict.fromkeys(outcomes)])
    values, gradients = [], []
    for name, chosen in (("native", {}), (backend, options)):
        x = torch.full((1, WIRES), 0.7, dtype=torch.float64, requires_grad=True)
        values.append(expectations(circuit, x, {}, name, seed=2, **chosen))
        gradients.append(torch.autograd.grad(values[-1].sum(), x)[0])
    exact = "shots" not in options
    torch.testing.assert_close(*values, rtol=0, atol=1e-9 if exact else 5 / SHOTS**0.5)
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-9 if exact else 0.5)


def test_a_qubit_more_for_each_reset_and_each_measured_qubit_that_is_used_again() -> None:
    circuit = Circuit(2)
    circuit.reset(0)  # nothing has acted on it
    circuit.append("H", 0)
    outcome = circuit.measure_mid(0)
    assert circuit.measure_mid(0) == outcome
    circuit.append("X", 1, control=outcome)
    assert (circuit.qubits, circuit.deferred) == (2, 0)
    circuit.append("H", 0)
    circuit.append("RY", 0, 0.3, control=outcome)
    assert (circuit.qubits, circuit.deferred) == (3, 1)
    circuit.measure_mid(1)
    circuit.reset(1)
    assert (circuit.qubits, circuit.inputs, circuit.observables) == (4, 2, (0, 3))
    circuit.measure(["X0"])
    circuit.measure_mid(0)  # what is measured has no X any more
    assert circuit.qubits == 5
    assert expectations(circuit, [[0.0, 0.0]], {})[0, 0].abs() < 1e-12


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda c, o: c.measure_mid(0, postselect=1), "postselect = 1: no run may be thrown away"),
        (lambda c, o: c.measure_mid(2), r"measure_mid\(2\): this circuit has qubits 0..1"),
        (lambda c, o: c.reset(o), r"reset\(.*\): this circuit has qubits 0..1"),
        (lambda c, o: c.append("CNOT", (0, 1), control=o), "CNOT takes no extra control"),
        (lambda c, o: c.append("X", o), "this circuit has qubits 0..1"),
        (lambda c, o: c.measure([o, o]), "distinct"),
    ],
)
def test_what_cannot_be_deferred_is_refused(wrong, sentence: str) -> None:
    circuit = Circuit(2)
    with pytest.raises(CircuitError, match=sentence):
        wrong(circuit, circuit.measure_mid(0))


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
