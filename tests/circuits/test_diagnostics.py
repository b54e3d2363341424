"""Diagnostics of circuits against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import unitary_group

from qrlsuite.actions import information_of_choices
from qrlsuite.circuit import Circuit, ansatz
from qrlsuite.circuit.jacobian import jacobians
from qrlsuite.diagnostics import circuits, fisher, fourier, gradients, states
from qrlsuite.errors import OptionError

Array = NDArray[np.float64]


def test_variance_between_haar_random_blocks() -> None:
    """V exp(-i a Z / 2) W between Haar's W and V: d^2 / (2 (d^2 - 1) (d + 1)), whatever is measured."""
    from qiskit.circuit.library import CXGate
    from qiskit.synthesis import TwoQubitBasisDecomposer

    synthesis = TwoQubitBasisDecomposer(CXGate(), euler_basis="U3")

    def block(seed: int) -> list[tuple[str, list[int], list[float]]]:
        made = synthesis(unitary_group.rvs(4, random_state=seed))
        return [
            (g.operation.name, [made.find_bit(q).index for q in g.qubits], list(g.operation.params))
            for g in made
        ]

    draws = 1000
    blocks = [block(seed) for seed in range(2 * draws)]
    circuit = Circuit(2)
    angle = circuit.parameter("angle", (1,))
    kinds = [(name, wires) for name, wires, _ in blocks[0]]
    blocks = [each for each in blocks if [(n, w) for n, w, _ in each] == kinds]
    assert len(blocks) > 1.9 * draws  # nearly all have the same gates, and their angles alone differ
    values = np.array([[a for _, _, angles in each for a in angles] for each in blocks])
    half = len(values) // 2
    sides = [circuit.parameter(name, (values.shape[1],)) for name in ("before", "after")]
    for side in sides:
        place = 0
        for name, wires in kinds:
            if name == "cx":
                circuit.append("CNOT", wires)
            else:
                circuit.append("U3", wires, *(side[place + k] for k in range(3)))
                place += 3
        if side is sides[0]:
            circuit.append("RZ", 1, angle[0])
    circuit.measure([0, (0, 1)])
    points = {"angle": np.zeros((half, 1)), "before": values[:half], "after": values[half : 2 * half]}
    found = jacobians(circuit, np.zeros((half, 2)), points)
    for readout in (0, 1):
        got = gradients.variance(found[:, readout, :1])
        assert got.low < got.value < got.high
        assert got.value == pytest.approx(16 / (2 * 15 * 5), rel=0.1)
        assert got.high - got.low < 0.2 * got.value


def test_variance_by_hand_and_its_law() -> None:
    signs = np.array([[1.0, 0.0], [-1.0, 0.0]])
    assert gradients.variance(signs).value == pytest.approx(2.0)  # the second has no effect
    assert gradients.variance(np.zeros((5, 3))) == (0.0, 0.0, 0.0)
    source = np.random.default_rng(0)
    drawn = {n: source.standard_normal((400, 3)) * 2.0 ** (-n / 2) for n in (2, 4, 5)}
    law = gradients.factor_per_qubit(list(drawn), list(drawn.values()))
    assert law is not None
    assert law.low < 0.5 < law.high
    assert law.high - law.low < 0.1
    assert gradients.factor_per_qubit([2], [signs]) is None


def test_fisher_information_of_one_qubit() -> None:
    """<Z> = cos a for RY(a): J^T J = sin^2 a; an RZ behind it has no effect; as probabilities the information is 1."""
    circuit = Circuit(1)
    w = circuit.parameter("w", (2,))
    circuit.append("RY", 0, w[0])
    circuit.append("RZ", 0, w[1])
    angles = np.array([0.3, 1.1, 2.5])
    J = jacobians(circuit, np.zeros((3, 1)), {"w": np.stack([angles, angles], axis=1)})
    for place, a in enumerate(angles):
        found = fisher.information(np.repeat(J[place : place + 1], 4, axis=0))
        np.testing.assert_allclose(found.eigenvalues, [np.sin(a) ** 2, 0.0], atol=1e-12)
        np.testing.assert_allclose(found.gauge, [0.0, 1.0], atol=1e-12)
        assert fisher.shares(found.gauge, {"a": 1, "b": 1}) == pytest.approx({"a": 0.0, "b": 1.0})
        assert fisher.without_effect(found.gauge, {"w": (2,)}) == ["w[1]"]
    p = (1 + np.cos(angles)) / 2
    of_probabilities = np.stack([np.diag(1 / np.array([each, 1 - each])) for each in p])
    both = np.concatenate([J, -J], axis=1) / 2
    np.testing.assert_allclose(fisher.information(both, of_probabilities).eigenvalues[0], 1.0)


def test_fisher_information_of_a_softmax_is_the_mean_of_the_scores_outer_products() -> None:
    source = np.random.default_rng(0)
    logits, J = source.standard_normal((5, 3)), source.standard_normal((5, 3, 4))
    p = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    scores = J - (p[..., None] * J).sum(1, keepdims=True)
    expected = np.einsum("sa,sap,saq->pq", p, scores, scores) / 5
    found = fisher.information(J, information_of_choices(logits, [3]))
    np.testing.assert_allclose(found.eigenvalues, np.linalg.eigvalsh(expected)[::-1], rtol=1e-10)
    shifted = np.concatenate(
        [J, np.ones((5, 3, 1))], axis=2
    )  # a number added to all logits changes no policy
    np.testing.assert_allclose(
        fisher.information(shifted, information_of_choices(logits, [3])).gauge, [0, 0, 0, 0, 1], atol=1e-10
    )
    assert np.isnan(fisher.information(J[:2]).gauge).all()  # too few states to tell


def test_effective_dimension() -> None:
    k = 0.5 * 1000 / (2 * math.pi * math.log(1000))
    for parameters, rank in ((4, 4), (6, 2)):
        of_equal = np.zeros((3, parameters))
        of_equal[:, :rank] = 0.7
        expected = rank * math.log(1 + k * parameters / rank) / math.log(k)
        assert fisher.effective_dimension(of_equal, 1000, 0.5) == pytest.approx(expected)
        assert fisher.effective_dimension(of_equal[:, :rank], 1000, 0.5, parameters) == pytest.approx(
            expected
        )
    assert fisher.effective_dimension(np.zeros((2, 3))) == 0.0
    large = fisher.effective_dimension(np.array([[5.0, 1e-2, 0.0]]), samples=10**300)
    assert large == pytest.approx(2.0, abs=0.02)  # grows to the rank
    for samples, gamma in ((1, 1.0), (10, 1.0), (1000, 2.0)):
        with pytest.raises(ValueError, match="must be above 1"):
            fisher.effective_dimension(np.ones((1, 2)), samples, gamma)


def encoded(*factors: float, trained: bool = False) -> Circuit:
    """RX(factor * x) one after the other, and a weight; with trained factors where asked for."""
    circuit = Circuit(1)
    w = circuit.parameter("w", (1 + len(factors),), 0.7, 0.7)
    for k, factor in enumerate(factors):
        circuit.append("RX", 0, w[1 + k] * circuit.input(0) if trained else factor * circuit.input(0))
    circuit.append("RX", 0, w[0])
    return circuit


def test_spectrum() -> None:
    """<Z> = cos(x + w) has the power 1/2 at frequency 1, and cos(3 x + w) at 3."""
    for circuit, frequency in ((encoded(1.0), 1.0), (encoded(1.0, 2.0), 3.0)):
        frequencies, power = circuits.spectrum(circuit, circuits.draw(circuit, 2))
        assert frequencies[power > 1e-12].tolist() == [frequency]
        assert power.sum() == pytest.approx(0.5)
    circuit = encoded(0.0, trained=True)  # cos(0.7 x + 0.7): no whole frequency
    frequencies, power = circuits.spectrum(circuit, circuits.draw(circuit, 2))
    assert fourier.mean_frequency(power[1:], frequencies[1]) == pytest.approx(0.7, abs=0.02)
    assert power[1:].sum() == pytest.approx(0.5, rel=0.05)
    assert math.isnan(fourier.mean_frequency(np.zeros(3)))
    controlled = Circuit(2, inputs=1)
    controlled.append("RY", 1, controlled.input(0), control=0)  # not reached: qubit 0 stays 0
    controlled.append("RX", 0, controlled.parameter("w", (1,))[0])
    _, power = circuits.spectrum(controlled, circuits.draw(controlled, 2))
    assert power[1:].sum() == pytest.approx(0.0, abs=1e-20)
    squared = Circuit(1)
    squared.append("RX", 0, squared.input(0) * squared.input(0) + squared.parameter("w", (1,))[0])
    with pytest.raises(OptionError, match="too high to be sampled"):
        circuits.spectrum(squared, circuits.draw(squared, 1))


def one_qubit(*gates: str) -> Circuit:
    circuit = Circuit(1)
    w = circuit.parameter("w", (max(1, len(gates)),))
    for k, gate in enumerate(gates):
        circuit.append(gate, 0, *([] if gate == "H" else [w[k]]))
    return circuit


ARCSINE = np.diff(2 / math.pi * np.arcsin(np.sqrt(np.linspace(0, 1, 76))))
"""The law of the fidelities of states on a circle, in 75 bins."""


@pytest.mark.parametrize(
    ("circuit", "expected", "within"),
    [
        (one_qubit(), math.log(75), 1e-6),  # always the same state
        (one_qubit("H", "RZ"), float((ARCSINE * np.log(75 * ARCSINE)).sum()), 0.02),
        (ansatz("cx", 2, 6), 0.0, 0.02),
    ],
)
def test_expressibility_reaches_its_known_limits(circuit: Circuit, expected: float, within: float) -> None:
    divergence, entangled = circuits.expressibility(circuit)
    assert divergence == pytest.approx(expected, abs=within)
    assert entangled == pytest.approx(
        0.0 if circuit.qubits == 1 else 0.4, abs=0.03
    )  # Haar: (d - 2) / (d + 1)


def test_expressibility_of_haar_states_and_where_it_says_nothing() -> None:
    source = np.random.default_rng(0)
    for qubits in (1, 3, 8):
        d = 1 << qubits
        fidelities = 1 - source.random(20_000) ** (1 / (d - 1))
        assert 0 <= states.expressibility(fidelities, qubits) < 0.005
        assert states.expressibility(np.ones(10), qubits) == pytest.approx((d - 1) * math.log(75))
    assert states.most_expressible() == 8
    divergence, entangled = circuits.expressibility(ansatz("cz", 9, 2), pairs=4)
    assert math.isnan(divergence)
    assert 0 < entangled < 1


def state(qubits: int, *members: int) -> states.States:
    """Equal parts of some basis states."""
    made = np.zeros(1 << qubits, dtype=np.complex128)
    made[list(members)] = 1 / math.sqrt(len(members))
    return made


@pytest.mark.parametrize(
    ("of", "global_", "entropy"),
    [
        (state(3, 5), 0.0, 0.0),
        (state(3, 0, 7), 1.0, 1.0),  # GHZ
        (state(3, 1, 2, 4), 8 / 9, math.log2(3) - 2 / 3),  # W: the first qubit is 1 with probability 1/3
        (state(2, 0, 1), 0.0, 0.0),
        (state(4, 0b0000, 0b0101, 0b1010, 0b1111), 1.0, 2.0),  # two pairs across the cut
        (state(4, 0b0000, 0b0011, 0b1100, 0b1111), 1.0, 0.0),  # two pairs beside it
        (state(1, 0, 1), 0.0, 0.0),
    ],
)
def test_measures_by_hand(of: states.States, global_: float, entropy: float) -> None:
    together = np.stack([of, state(of.shape[0].bit_length() - 1, 0)])[None]
    np.testing.assert_allclose(states.meyer_wallach(together)[0], [global_, 0.0], atol=1e-12)
    np.testing.assert_allclose(states.half_cut_entropy(together)[0], [entropy, 0.0], atol=1e-12)


def ising(qubits: int) -> Circuit:
    """The transverse-field Ising chain, open: free fermions."""
    circuit = Circuit(qubits)
    w = circuit.parameter("w", (2, qubits))
    for q in range(qubits):
        circuit.append("RX", q, w[0, q])
        if q:
            circuit.append("RZZ", (q - 1, q), w[1, q])
    return circuit


@pytest.mark.parametrize(
    ("circuit", "expected"),
    [
        (one_qubit("RZ"), 1),
        (one_qubit("RX", "RZ"), 3),
        (ising(2), 6),  # so(2 n): n (2 n - 1)
        (ising(3), 15),
        (ising(4), 28),
        (ansatz("cx", 3, 2, entangled="separable"), 9),  # su(2) on each
        (ansatz("iqp", 2, 3), 15),  # su(4): all
        (ansatz("cz", 3, 3), 36),  # sp(8): all products of an odd number of Paulis
    ],
)
def test_lie_algebra_of_known_generators(circuit: Circuit, expected: int) -> None:
    assert circuits.algebra_dimension(circuit) == expected


def test_lie_algebra_of_constant_and_controlled_gates() -> None:
    turned = Circuit(1)
    w = turned.parameter("w", (2,))
    turned.append("RZ", 0, w[0])
    turned.append("RX", 0, math.pi / 2)  # a fixed gate: the next RZ turns about another axis
    turned.append("RZ", 0, w[1])
    assert circuits.algebra_dimension(turned) == 3
    controlled = Circuit(2)
    w = controlled.parameter("w", (3,))
    controlled.append("U3", 1, w[0], w[1], w[2], control=0)
    # |1><1| times Y, and times the phases |1><1|, which make Z and the identity beside it: su(2) and one more
    assert circuits.algebra_dimension(controlled) == 4


def test_what_has_no_parameters_is_refused() -> None:
    for call in (circuits.gradients, circuits.fisher, circuits.expressibility):
        with pytest.raises(OptionError, match="the circuit has no parameters"):
            call(Circuit(2))


def test_gradients_of_both_readouts() -> None:
    circuit = ansatz("cz", 3, 1, entangled="separable")
    found = circuits.gradients(circuit, draws=7)
    assert {name: each.shape for name, each in found.items()} == {"local": (7, 18), "global": (7, 18)}
    others = [k for k in range(18) if (k % 9) // 3 != 0]  # of other qubits than the first
    assert np.abs(found["local"][:, others]).max() < 1e-15
    assert np.abs(found["global"][:, others]).max() > 0.0
    assert list(circuits.gradients(ansatz("cz", 3, 1, entangled="mean-field"), draws=2)) == ["local"]


def test_states_are_those_before_the_measurement() -> None:
    circuit = Circuit(2, inputs=1)
    circuit.append("RX", 0, circuit.parameter("w", (1,), 0.3, 0.3)[0])
    circuit.append("RX", 1, circuit.input(0) * circuit.input(0))
    circuit.measure(["X0", "Y1"])
    found = circuits.final_states(circuit, circuits.Points(np.array([[2.0]]), {"w": np.array([[0.3]])}))
    expected = np.kron([np.cos(0.15) ** 2, np.sin(0.15) ** 2], [np.cos(2.0) ** 2, np.sin(2.0) ** 2])
    np.testing.assert_allclose(np.abs(found[0]) ** 2, expected, atol=1e-6)
