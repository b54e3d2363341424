"""The native simulator as Qiskit's primitives, held to Qiskit's own."""

from __future__ import annotations

import numpy as np
import pytest
from qiskit import ClassicalRegister, QuantumCircuit
from qiskit.circuit import Gate, Parameter
from qiskit.circuit.library import real_amplitudes, zz_feature_map
from qiskit.primitives import StatevectorEstimator, StatevectorSampler
from qiskit.quantum_info import SparsePauliOp
from qiskit_machine_learning.gradients import ParamShiftEstimatorGradient
from qiskit_machine_learning.neural_networks import EstimatorQNN

from qrlsuite.plugins.circuits.native.qiskit_primitives import EstimatorV2, SamplerV2

A, B = Parameter("a"), Parameter("b")
VALUES = np.random.default_rng(0).normal(size=(5, 3, 2))
SUM = SparsePauliOp(["XYIZ", "IIIY"], [0.3, -2.0])


def circuit() -> QuantumCircuit:
    """Gates of the kernels, gates by their matrix, gates by their definition, and angles that are expressions."""
    made = QuantumCircuit(4)
    for q in range(4):
        made.h(q)
    made.rx(2 * A + B, 0)
    made.ry(A * B, 3)
    made.u(A, B, 0.1, 1)
    made.ccx(0, 1, 2)
    made.rxx(A, 1, 3)
    made.cp(B, 2, 0)
    made.csx(0, 3)
    made.cu(A, 0.1, 0.2, B, 1, 2)
    made.cx(1, 3, ctrl_state=0)
    made.mcx([3, 1, 0], 2)
    made.append(real_amplitudes(3).assign_parameters(np.arange(12.0)).to_instruction(), [3, 1, 0])
    made.sxdg(2)
    made.tdg(1)
    made.crz(A, 3, 2)
    return made


@pytest.mark.parametrize(
    ("observables", "values"),
    [
        (["ZIII", SUM, "YYII"], VALUES),
        (SUM, VALUES),
        (SUM, VALUES[0, 0]),
        ([["ZIII"], [SUM], ["IIII"], ["IIXX"]], VALUES[0]),
        (["ZIII", "IXYZ", SUM], VALUES[0]),
    ],
)
@pytest.mark.parametrize("precision", [0.0, 0.1])
def test_means_are_those_of_statevector_estimator(observables, values, precision):
    ours, reference = (
        estimator(seed=3).run([(circuit(), observables, values)], precision=precision).result()[0]
        for estimator in (EstimatorV2, StatevectorEstimator)
    )
    np.testing.assert_allclose(ours.data.evs, reference.data.evs, atol=1e-12)
    assert np.array_equal(ours.data.stds, reference.data.stds)
    assert ours.metadata == reference.metadata


def test_bits_are_those_of_statevector_sampler():
    made = circuit()
    x, y = ClassicalRegister(2, "x"), ClassicalRegister(9, "y")
    made.add_register(x, y)
    for qubit, bit in [(3, x[1]), (0, y[8]), (2, y[0])]:
        made.measure(qubit, bit)
    plain = QuantumCircuit(1)
    plain.x(0)
    plain.measure_all()
    ours, reference = (
        sampler(seed=4).run([(made, VALUES), (plain,)], shots=50).result()
        for sampler in (SamplerV2, StatevectorSampler)
    )
    for got, expected in zip(ours, reference, strict=True):
        assert dict(got.data.items()) == dict(expected.data.items())
        assert got.metadata == expected.metadata


def test_a_network_of_qiskit_machine_learning_trains_on_the_estimator():
    features, weights = zz_feature_map(2, reps=1), real_amplitudes(2, reps=1)
    network, reference = (
        EstimatorQNN(
            circuit=features.compose(weights),
            estimator=estimator,
            observables=SparsePauliOp(["ZZ"]),
            input_params=features.parameters,
            weight_params=weights.parameters,
            gradient=ParamShiftEstimatorGradient(estimator),
            default_precision=0.0,
        )
        for estimator in (EstimatorV2(), StatevectorEstimator())
    )
    x = np.random.default_rng(1).uniform(-1, 1, (8, 2))
    at, target = np.full(4, 0.5), network.forward(x, np.array([1.0, -0.4, 0.3, 1.1]))
    np.testing.assert_allclose(network.forward(x, at), reference.forward(x, at), atol=1e-12)
    np.testing.assert_allclose(network.backward(x, at)[1], reference.backward(x, at)[1], atol=1e-12)
    losses = []
    for _ in range(20):
        wrong = network.forward(x, at) - target
        losses.append(float((wrong**2).mean()))
        at = at - 0.5 * np.einsum("bo,bow->w", 2 * wrong, network.backward(x, at)[1]) / len(x)
    assert losses[-1] < 0.5 * losses[0]


def refused(change) -> QuantumCircuit:
    made = QuantumCircuit(2, 2)
    made.h(0)
    change(made)
    return made


def conditional(made: QuantumCircuit) -> None:
    made.measure(0, 0)
    with made.if_test((0, 1)):
        made.reset(1)


def loop(made: QuantumCircuit) -> None:
    with made.for_loop(range(2)):
        made.x(1)


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (QuantumCircuit(25), "25 qubits: .* take 512 MiB, .*; the limit is 20 qubits"),
        (
            refused(lambda c: c.append(Gate("strange", 2, []), [0, 1])),
            "'strange' on 2 qubits has no definition",
        ),
        (refused(conditional), "'reset' depends on measured bits: only gates may"),
        (refused(loop), "'for_loop' cannot be written with controlled gates: write out loops"),
    ],
)
def test_what_cannot_be_computed_is_refused_in_a_sentence(made, sentence):
    with pytest.raises(Exception, match=sentence):
        SamplerV2().run([(made,)])
