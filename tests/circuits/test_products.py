"""Rotations of two qubits, products of inputs, and products of Pauli Z: the same on all backends."""

import math

import numpy as np
import pytest
import torch

from qrlsuite import registry, specs
from qrlsuite.circuit import Angle, Circuit, create_backend, expectations
from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.description import canonical, in_bases, without_products
from qrlsuite.circuit.drawing import angle_text, draw_text
from qrlsuite.circuit.resources import shift_evaluations
from qrlsuite.errors import CircuitError, OptionError
from qrlsuite.plugins.circuits.native import NativeBackend, dense
from qrlsuite.testing.dense import expectation_values
from tests.circuits.test_backends import assert_close, draw, evaluate

BACKENDS = registry.load().names(specs.CircuitBackendSpec)
PAULI = {"X": np.array([[0, 1], [1, 0]]), "Y": np.array([[0, -1j], [1j, 0]]), "Z": np.diag([1, -1])}


def rich():
    """Return a circuit with all of it: qubits 0-2 are connected by gates, 2 and 3 by an observable alone."""
    circuit = Circuit(4, inputs=3)
    w = circuit.parameter("w", (9,))
    for q in range(4):
        circuit.append("RY", q, circuit.input(q % 3) + w[q])
    circuit.append("RXX", (0, 1), circuit.input(0) * circuit.input(1))
    circuit.append("RYY", (2, 1), w[4] * circuit.input(1) * circuit.input(2) + w[5])
    circuit.append("RZZ", (0, 2), w[6] * (circuit.input(0) * circuit.input(0)) + 0.3)
    circuit.append("RX", 3, circuit.input(0) * circuit.input(1) + w[7], control=None)
    circuit.append("RY", 0, w[8], control=2)
    circuit.measure([3, (0, 1), 1, (3, 2), 0, (0, 1, 2)])
    return circuit


def multiples():
    """Return a circuit with numbers before inputs, products of these, and parameters."""
    circuit = Circuit(3, inputs=2)
    w, (x, y) = circuit.parameter("w", (4,)), map(circuit.input, range(2))
    circuit.append("RY", 0, 2 * x + w[0])
    circuit.append("RX", 1, -0.5 * w[1])
    circuit.append("RY", 1, 0.3 - w[1] * (x * 3))
    circuit.append("RZZ", (0, 1), (np.pi - x) * 0.5)
    circuit.append("RY", 2, 1.5 * (x * y) + w[3])
    circuit.append("RX", 2, (2 * w[2] + 1) * 0.25, control=0)
    circuit.measure([0, (0, 1), 2])
    return circuit


def words():
    """Return the first circuit with products of other Paulis: four bases, and an order that is none of theirs."""
    circuit = rich()
    circuit.measure(["X1", (0, 1), "Y0 X2", 3, "X0 Y3 Z2", "Y2", "X1 X3"])
    return circuit


def functions():
    """Return a circuit with functions, sums and products of inputs."""
    circuit = Circuit(3, inputs=2)
    w, (x, y) = circuit.parameter("w", (4,)), map(circuit.input, range(2))
    circuit.append("RY", 0, np.arctan(x) + w[0])
    circuit.append("RX", 1, w[1] * np.arctan(2 * x - 0.3) * y + 0.2)
    circuit.append("RZZ", (0, 1), 2 * (np.pi - x) * (np.pi - y))
    circuit.append("RY", 2, 0.5 * w[2] * (np.sin(x / 2) ** 2 + np.exp(y) - x + 1) + w[3])
    circuit.append("RX", 2, x * y * x, control=0)
    circuit.measure([0, (0, 1), 2])
    return circuit


@pytest.mark.parametrize("make", [rich, multiples, words, functions])
@pytest.mark.parametrize("backend", BACKENDS)
def test_values_and_gradients_on_every_backend(backend, make):
    circuit = make()
    inputs, parameters, cotangent = draw(circuit, 2, 2)
    got = evaluate(create_backend(backend, circuit), inputs, parameters, cotangent)
    x, w, c = inputs.numpy(), parameters["w"].numpy(), cotangent.numpy()

    def values(x, w):
        return np.array([[expectation_values(circuit, row, {"w": w[s]}) for row in x[s]] for s in range(2)])

    np.testing.assert_allclose(got[0], values(x, w), atol=1e-10)
    for which, gradient in ((x, got[1].numpy()), (w, got[2].numpy())):
        for index in np.ndindex(which.shape):
            kept, sides = which[index], []
            for step in (1e-5, -1e-5):
                which[index] = kept + step
                sides.append((values(x, w) * c).sum())
            which[index] = kept
            assert gradient[index] == pytest.approx((sides[0] - sides[1]) / 2e-5, abs=1e-6)


def test_torch_operations_and_kernels_agree():
    circuit = rich()
    inputs, parameters, cotangent = draw(circuit, 2, 3)
    backend = NativeBackend(without_products(circuit)[0])
    ours = create_backend("native", circuit)

    def by_torch(x, parameters):
        return backend.by_torch(torch.cat([x, x[..., [0, 1, 0]] * x[..., [1, 2, 0]]], -1), parameters["w"])

    got = evaluate(by_torch, inputs, parameters, cotangent)
    assert_close(got, evaluate(ours, inputs, parameters, cotangent), 1e-12)
    states = dense.states(circuit, inputs, parameters["w"])[0, 0].numpy()
    z = np.kron([1, 1, -1, -1], [1, 1, 1, 1])  # qubit 0 is the highest of four bits
    assert float(got[0][0, 0, 4]) == pytest.approx((z * np.abs(states) ** 2).sum())


@pytest.mark.parametrize(
    ("backend", "options"),
    [
        ("native", {}),
        ("native", {"noise_model": "depolarizing"}),
        ("pennylane", {}),
        ("qiskit", {"estimator": "aer"}),
    ],
)
def test_a_product_is_that_of_the_same_bits(backend, options):
    circuit = Circuit(3)
    for q in range(3):
        circuit.append("RY", q, circuit.input(q))
    circuit.measure([0, 1, 2, (0, 1), (2, 0), (0, 1, 2)])
    x = torch.full((1, 12, 3), 1.2, dtype=torch.float64)
    bits = create_backend(backend, circuit, shots=1, **options)(x, {}, [1])[0]
    a, b, c = bits[:, :3].T
    assert torch.equal(bits[:, 3:], torch.stack([a * b, a * c, a * b * c], dim=1))
    assert len(torch.unique(bits, dim=0)) > 2


@pytest.mark.parametrize("backend", [("native", {}), ("qiskit", {"estimator": "aer"})])
def test_a_readout_error_counts_for_every_bit_of_a_product(backend):
    circuit = Circuit(2)
    circuit.measure([0, (0, 1)])
    noise = {"noise_model": "depolarizing", "noise_rate": 0.0, "readout_error": 0.1}
    x = torch.zeros(1, 1, 2, dtype=torch.float64)
    values = create_backend(backend[0], circuit, **noise, **backend[1])(x, {}, [1])
    assert_close([values], [torch.tensor([[[0.8, 0.64]]], dtype=torch.float64)], 1e-10)


def test_an_observable_connects_its_qubits():
    circuit = Circuit(3)
    circuit.append("CNOT", (0, 1))
    assert circuit.components() == [[0, 1], [2]]
    circuit.measure([(1, 2)])
    assert circuit.components() == [[0, 1, 2]]
    assert circuit.observables == ((1, 2),)
    assert circuit.measured == ((1, 2),)


def test_products_are_drawn():
    circuit = rich()
    angles = [angle_text(a) for op in circuit for a in op.angles]
    assert "w[4]*x1*x2 + w[5]" in angles
    assert "x0*x1" in draw_text(circuit, angles=True)
    angles = [angle_text(a) for op in multiples() for a in op.angles]
    assert angles[:4] == ["2*x0 + w[0]", "-0.5*w[1]", "-3*w[1]*x0 + 0.3", "-0.5*x0 + 1.571"]
    assert "\nRX 1 0.0+-0.5*w[1]\n" in canonical(multiples())
    angles = [angle_text(a) for op in functions() for a in op.angles]
    assert angles[:2] == ["arctan(x0) + w[0]", "w[1]*arctan(2*x0 + -0.3)*x1 + 0.2"]
    assert "\nRY 0 0.0+arctan(0.0+x0)+w[0]\n" in canonical(functions())


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda c: (w := c.parameter("w", (2,)))[0] * w[1], "products of parameters: an angle is constant"),
        (
            lambda c: (w := c.parameter("w", (2,)))[0] + w[1],
            r"at most one scale and one weight.* RX\(a\), RX\(b\)",
        ),
        (lambda c: np.tanh(c.parameter("w", (2,))[0]), "tanh of a parameter: functions take inputs alone"),
        (lambda c: math.atan(c.input(0)), r"such as np.arctan\(x\), not math.atan"),
        (lambda c: np.arctan(c.input(0)) ** 0.5, "to the power of 0.5"),
        (lambda c: c.append("RX", 0, np.arctan(Angle(input=2))), "this circuit has inputs 0..1"),
        (lambda c: c.input(0) * "2", "an angle cannot be multiplied by '2'"),
        (
            lambda c: 2 * (c.input(0) + c.parameter("w", (1,))[0]),
            "a sum of an input and a parameter cannot be",
        ),
        (lambda c: c.append("RX", 0, c.input(0) * float("inf")), "numbers must be finite"),
        (lambda c: c.append("RZZ", 0, 0.1), "RZZ takes 2 wires, 1 angle and no control"),
        (lambda c: c.append("RXY", (0, 1), 0.1), "unknown gate 'RXY'; did you mean"),
        (lambda c: c.append("Ry", 0, 0.1), "unknown gate 'Ry'; write it as RY"),
        (lambda c: c.append("cx", (0, 1)), "unknown gate 'cx'; write it as CNOT"),
        (lambda c: c.measure([(0, 1), (1, 0)]), "distinct groups of them, or products"),
        (lambda c: c.measure([(0, 0)]), "are needed"),
        (lambda c: c.measure(["X0", "X9"]), r"observables \['X0', 'X9'\]: distinct qubits 0\.\."),
        (lambda c: c.measure(["A0"]), "are needed"),
        (lambda c: c.measure(["X0 Y0"]), "are needed"),
        (lambda c: c.measure(["X0 Z1", "Z1 X0"]), "are needed"),
        (lambda c: c.measure([0, "Z0"]), "are needed"),
        (lambda c: c.measure([-1]), "are needed"),
        (lambda c: c.measure("01"), "observables '01': distinct qubits"),
        (lambda c: c.measure([0, None]), r"observables \[0, None\]: distinct qubits"),
        (lambda c: c.measure([()]), "are needed"),
        (lambda c: c.measure([(0, 2)]), r"distinct qubits 0\.\.1"),
    ],
)
def test_what_cannot_be_written_is_refused(write, message):
    with pytest.raises(CircuitError, match=message):
        write(Circuit(2))


def test_who_cannot_measure_products_is_asked_for_none(monkeypatch):
    circuit = Circuit(2)
    circuit.measure([(0, 1)])
    spec = registry.get(specs.CircuitBackendSpec, "pennylane")
    import dataclasses

    single = dataclasses.replace(spec, products=False)
    monkeypatch.setattr(registry, "get", lambda kind, name: single)
    with pytest.raises(OptionError, match="'pennylane' measures Paulis of single qubits"):
        create_backend("pennylane", circuit)
    monkeypatch.undo()
    classical = Circuit(2, mean_field=True)
    classical.measure([(0, 1)])
    with pytest.raises(OptionError, match="a mean-field approximation has no correlations"):
        create_backend("native", classical)
    product = Circuit(1)
    product.append("RX", 0, product.input(0) * product.input(0))
    for read in (AngleTable, NativeBackend(product).simulator):
        with pytest.raises(CircuitError, match="written as inputs by `create_backend`"):
            read(product) if read is AngleTable else read()
    for read in (AngleTable, NativeBackend):
        with pytest.raises(CircuitError, match="measured as Pauli Z by `create_backend`"):
            read(words())


def test_paulis_are_those_of_matrices():
    circuit = words()
    inputs, parameters, _ = draw(circuit, 1, 1)
    state = dense.states(circuit, inputs, parameters["w"])[0, 0].numpy()
    values = expectations(circuit, inputs[0], {"w": parameters["w"][0]})[0]
    for qubits, axes, value in zip(circuit.measured, circuit.axes, values):
        factors = dict(zip(qubits, axes))
        matrix = np.eye(1)
        for q in range(4):
            matrix = np.kron(matrix, PAULI[factors[q]] if q in factors else np.eye(2))
        assert float(value) == pytest.approx(np.vdot(state, matrix @ state).real, abs=1e-12)
    assert canonical(circuit).endswith("measure X1 0*1 Y0*X2 3 X0*Y3*2 Y2 X1*X3\n")


def test_every_basis_is_executed_and_sampled_by_itself():
    circuit = words()
    parts = in_bases(circuit)
    assert [places for _, places in parts] == [(0, 2, 3), (1, 5), (4,), (6,)]
    assert all(part.measures_z for part, _ in parts)
    assert in_bases(rich())[0][0].observables == rich().observables
    assert shift_evaluations(circuit) == 4 * shift_evaluations(rich())
    inputs, parameters, _ = draw(circuit, 1, 1)
    backend = create_backend("native", circuit, shots=1)
    assert backend.gradient_circuits == 4 * create_backend("native", rich(), shots=1).gradient_circuits
    drawn = torch.cat([backend(inputs, parameters, [seed]) for seed in range(400)])
    exact = create_backend("native", circuit)(inputs, parameters)
    assert torch.allclose(drawn.mean(0), exact[0], atol=0.2)
    assert torch.equal(drawn[7:8], backend(inputs, parameters, [7]))
    flat = Circuit(2)  # X0 and Z0 are coins: draws of one seed in two bases are not the same
    flat.append("RY", 0, np.pi / 4)
    flat.measure([0, "X0"])
    bits = create_backend("native", flat, shots=1)(torch.zeros(1, 200, 2, dtype=torch.float64), {}, [1])[0]
    assert 0.2 < float((bits[:, 0] == bits[:, 1]).double().mean()) < 0.95


def test_a_mean_field_approximation_measures_any_pauli_of_one_qubit():
    circuit = Circuit(2, mean_field=True)
    circuit.append("RY", 0, circuit.input(0))
    circuit.append("RX", 1, circuit.input(1))
    circuit.measure(["X0", "Y1", 0])
    got = expectations(circuit, [[0.3, 0.4]], {})[0].numpy()
    np.testing.assert_allclose(got, [np.sin(0.3), -np.sin(0.4), np.cos(0.3)], atol=1e-12)


@pytest.mark.parametrize("gate", ["RXX", "RYY", "RZZ"])
@pytest.mark.parametrize("angle", [0.0, 0.8])
def test_a_rotation_of_two_qubits_is_one_gate_of_a_mean_field_approximation(gate, angle):
    """Its correlations are dropped behind it alone: angle 0 changes nothing."""
    classical, exact = Circuit(2, inputs=1, mean_field=True), Circuit(2, inputs=1)
    for circuit in (classical, exact):
        for q, (a, b) in enumerate([(0.4, 0.9), (1.3, -0.5)]):
            circuit.append("RY", q, a)
            circuit.append("RX", q, b)
        circuit.append(gate, (0, 1), circuit.input(0))
    got = expectations(
        classical, [[angle]], {}
    )  # all that is measured of one qubit each is exact behind one gate
    np.testing.assert_allclose(got, expectations(exact, [[angle]], {}), atol=1e-12)
    w = classical.parameter("w", (1,))
    with pytest.raises(CircuitError, match=f"{gate} in a mean-field approximation: its angle is a sum"):
        classical.append(gate, (0, 1), classical.input(0) + w[0])


@pytest.mark.parametrize("number", [2, 2.0, np.float32(2), np.int64(2)])
def test_numbers_of_numpy_are_numbers(number):
    x = Circuit(1).input(0)
    assert number * x == x * 2.0
    assert x + number == x + 2.0
    assert x - number == x + -2.0
