"""The native simulator as a PennyLane device, held to `default.qubit` and to PennyLane's own suite of tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pennylane as qml
import pytest
import torch
from pennylane.devices import tests as pennylane_tests

from tests.conftest import HANGS

NAME = "qrlsuite.native"
WIRES = 4
GATES = [
    (qml.RX, 1), (qml.RY, 1), (qml.RZ, 1), (qml.Rot, 1), (qml.PhaseShift, 1), (qml.U3, 1), (qml.Hadamard, 1),
    (qml.PauliX, 1), (qml.PauliY, 1), (qml.PauliZ, 1), (qml.S, 1), (qml.T, 1), (qml.SX, 1), (qml.CNOT, 2),
    (qml.CZ, 2), (qml.CY, 2), (qml.SWAP, 2), (qml.ISWAP, 2), (qml.CRX, 2), (qml.CRot, 2), (qml.IsingXX, 2),
    (qml.ControlledPhaseShift, 2), (qml.SingleExcitation, 2), (qml.Toffoli, 3), (qml.CSWAP, 3), (qml.MultiRZ, 3),
    (qml.DoubleExcitation, 4),
]  # fmt: skip
"""Gates of the kernels, gates that run by their matrix, and gates that PennyLane decomposes."""


def results(device, seed, measure, batch=5):
    """Return values and gradients of a random circuit: half of its angles are broadcast."""
    rng = np.random.default_rng(seed)
    drawn = [GATES[i] for i in rng.permutation(len(GATES))] * 2
    angles: list[torch.Tensor] = []

    @qml.qnode(qml.device(device, wires=WIRES), diff_method="best")
    def circuit():
        for wire in range(WIRES):
            qml.Hadamard(wire)
        at = iter(angles)
        for gate, _ in drawn:
            wires = order[gate.__name__]
            gate(*(next(at) for _ in range(gate.num_params)), wires=wires)
        return measure()

    order = {gate.__name__: rng.permutation(WIRES)[:size].tolist() for gate, size in GATES}
    for number in range(sum(gate.num_params for gate, _ in drawn)):
        shape = (batch,) if number % 2 and batch else ()
        angles.append(torch.tensor(rng.normal(size=shape), requires_grad=True))
    values = circuit()
    together = torch.cat([v.reshape(-1) for v in (values if isinstance(values, tuple) else (values,))])
    real = torch.view_as_real(together).reshape(-1) if together.is_complex() else together
    weights = torch.tensor(rng.normal(size=len(real)))
    return [real.detach(), *torch.autograd.grad(real @ weights, angles, allow_unused=True)]


def means():
    matrix = np.array([[0.3, 1 - 2j, 0, 1], [1 + 2j, -1, 0.2j, 0], [0, -0.2j, 0.5, 0], [1, 0, 0, 2]])
    return (
        qml.expval(qml.X(1) @ qml.Y(3) @ qml.Y(0)),
        qml.expval(0.3 * qml.Z(2) - 1.2 * qml.Y(1) @ qml.Z(0) + 0.5 * qml.I(0)),
        qml.expval(qml.Hermitian(matrix, [3, 1])),
    )


@pytest.mark.parametrize("measure", [means, qml.state, lambda: qml.probs(wires=[2, 0])])
@pytest.mark.parametrize("batch", [None, 20])
def test_values_and_gradients_are_those_of_default_qubit(measure, batch):
    ours, reference = (results(device, 7, measure, batch) for device in (NAME, "default.qubit"))
    for got, expected in zip(ours, reference, strict=True):
        torch.testing.assert_close(got, expected, atol=1e-10, rtol=0)


def test_gradients_by_coefficients_of_observables():
    @qml.qnode(qml.device(NAME, wires=2))
    def circuit(x, measure):
        qml.RX(x, 0)
        qml.CRY(x, [0, 1])
        return measure()

    def together(x, w):
        first = w[0] * (w[1] * qml.Z(0) @ qml.Y(1) + qml.X(1))
        second = qml.Hamiltonian(w[1:], [qml.Z(1), qml.Y(0)])
        return circuit(x, lambda: (qml.expval(first), qml.expval(second)))

    def apart(x, w):
        words = qml.Z(0) @ qml.Y(1), qml.X(1), qml.Z(1), qml.Y(0)
        zy, x1, z1, y0 = circuit(x, lambda: tuple(map(qml.expval, words)))
        return w[0] * (w[1] * zy + x1), w[1] * z1 + w[2] * y0

    gradients = []
    for values in (together, apart):
        w = torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64, requires_grad=True)
        x = torch.linspace(0, 2, 11, dtype=torch.float64, requires_grad=True)
        torch.stack(values(x, w)).pow(2).sum().backward()
        gradients.append((x.grad, w.grad))
    torch.testing.assert_close(*gradients, atol=1e-10, rtol=0)


def test_circuits_of_one_execution_that_differ_in_their_angles_get_their_own_results():
    device, reference = (qml.device(name, wires=2) for name in (NAME, "default.qubit"))
    tapes = [
        qml.tape.QuantumScript([qml.RY(angle, 0), qml.CNOT([0, 1]), *extra], [qml.expval(qml.Z(1))], shots=shots)
        for angle, extra, shots in [(0.1, [], None), (0.2, [qml.X(1)], None), (0.3, [], None), (0.0, [], 10)]
    ]  # fmt: skip
    np.testing.assert_allclose(device.execute(tapes), reference.execute(tapes), atol=1e-12)


def test_shots_and_deferred_measurements_have_the_laws_of_their_circuit():
    @qml.set_shots(20_000)
    @qml.qnode(qml.device(NAME, wires=3, seed=1))
    def circuit(angle):
        qml.RY(angle, 0)
        first = qml.measure(0, reset=True)
        qml.cond(first, qml.X)(1)
        return qml.expval(qml.Z(0)), qml.expval(qml.Z(1))

    zero, one = circuit(1.0)
    assert zero == 1.0
    assert abs(one - np.cos(1.0)) < 5 / np.sqrt(20_000)


def run(gates, measured=None, wires=2, **settings):
    @qml.qnode(qml.device(NAME, wires=wires), **settings)
    def circuit():
        gates()
        return measured() if measured else qml.expval(qml.Z(0))

    return circuit()


class Strange(qml.operation.Operation):
    """A gate without matrix and decomposition."""

    num_wires = 1


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"gates": lambda: Strange(0)}, "Strange.* not supported with qrlsuite.native and does not provide a decomp"),
        ({"gates": lambda: None, "wires": 25}, "25 qubits: .* take 512 MiB, .*; the limit is 20 qubits, 16 MiB"),
        (
            {"gates": lambda: None, "measured": lambda: qml.expval(1j * qml.X(0))},
            "the coefficient 0.1j of X.0. is complex, .* make its coefficients real",
        ),
        (
            {"gates": lambda: None, "measured": lambda: qml.expval(qml.Hermitian(np.array([[0, 1], [0, 0]]), 0))},
            "its matrix is not Hermitian",
        ),
        ({"gates": lambda: qml.measure(0), "mcm_method": "one-shot"}, "defers mid-circuit measurements to the end"),
        ({"gates": lambda: qml.measure(0, postselect=1)}, "[Pp]ostselect"),
        ({"gates": lambda: None, "diff_method": "backprop"}, "does not support backprop"),
    ],
)  # fmt: skip
def test_what_cannot_be_computed_is_refused_in_a_sentence(settings, sentence):
    with pytest.raises(Exception, match=sentence):
        run(**settings)


def suite(*arguments: str) -> None:
    """Run PennyLane's tests of devices on this one; nothing may fail."""
    # pennylane is imported before pytest puts its folder first on the path, where another qrlsuite may lie
    command = [sys.executable, "-m", "pytest", "-q", "-p", "pennylane", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, *arguments, f"--device={NAME}"], capture_output=True, text=True, timeout=20 * HANGS, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout


HERE = Path(pennylane_tests.__file__).parent


@pytest.mark.skipif("not config.pluginmanager.hasplugin('pytest_mock')", reason="needs pytest-mock and flaky")
class TestPennyLanesOwn:
    def test_wires(self):
        suite(str(HERE / "test_wires.py"), str(HERE / "test_return_system.py"), "--shots=None")

    @pytest.mark.long
    @pytest.mark.parametrize("shots", ["None", "1000000"])
    def test_everything(self, shots):
        suite(str(HERE), f"--shots={shots}")
