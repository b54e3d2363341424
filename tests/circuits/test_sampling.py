"""Shots and noise of the native simulator, against the laws they follow and two density-matrix simulators."""

import math

import numpy as np
import pennylane as qml
import pytest
import torch
from scipy import stats

from qrlsuite.circuit import Circuit, ansatz, create_backend
from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.elementary import Elementary
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.plugins.circuits.native import draws
from qrlsuite.plugins.circuits.native.noise import PauliNoise
from qrlsuite.testing.circuits import every_gate
from tests.circuits.test_backends import assert_close, draw, evaluate

NOISE = {"noise_model": "depolarizing", "noise_rate": 0.1, "readout_error": 0.03}


def test_counts_of_one_qubit_follow_the_binomial_law():
    circuit = Circuit(1)
    circuit.append("RY", 0, circuit.input(0))
    x = torch.full((1, 4000, 1), 1.1, dtype=torch.float64)
    values = create_backend("native", circuit, shots=5)(x, {}, [1]).numpy().ravel()
    counts = np.bincount(np.rint(5 * (1 + values) / 2).astype(int), minlength=6)
    expected = 4000 * stats.binom.pmf(np.arange(6), 5, np.cos(0.55) ** 2)
    assert stats.chisquare(counts, expected).pvalue > 0.001


@pytest.mark.parametrize("options", [{}, {"shots": 4000}])
def test_flipped_bits_belong_to_their_qubits_in_products_too(options):
    circuit = Circuit(3)
    for _ in range(10):
        circuit.append("X", 2)
    circuit.measure([0, 1, 2, (0, 1), (1, 2), (0, 1, 2)])
    noise = {"noise_model": "depolarizing", "noise_rate": 1.0, "trajectories": 4000}
    backend = create_backend("native", circuit, **noise, **options)
    values = backend(torch.zeros(1, 1, 3, dtype=torch.float64), {}, [1])[0, 0]
    left = 0.9**10  # a one-qubit gate has a tenth of the rate
    assert_close([values], [torch.tensor([1, 1, left, 1, left, left])], 4 / math.sqrt(4000))


def counted(shots, probabilities, seed=5, **options):
    """Return counts (R, K) of states with probabilities (R, K), each measured in shots (R,)."""
    rows = len(probabilities)
    records = np.zeros((rows, 2 * probabilities.shape[1], 1))
    records[:, ::2, 0] = np.sqrt(probabilities)
    counts = np.zeros(probabilities.shape, np.int64)
    settings = {"flipped": np.zeros(rows, np.int64), "wrong": 0.0, **options}
    source = np.random.default_rng(seed)
    draws.measure(records, 0, *settings.values(), np.array(shots), np.arange(rows), source, counts)
    return counts


@pytest.mark.parametrize(
    ("shots", "p"),
    [(1, 0.3), (3, 0.4), (4, 0.3), (19, 0.5), (50, 0.21), (1000, 0.93), (1000, 0.009), (10**4, 0.3), (10**7, 1e-6)],
)  # fmt: skip
def test_counts_follow_the_binomial_law_whichever_way_they_are_drawn(shots, p):
    rows, first = 40_000, np.array([[1 - p - 0.001, p, 0.001, 0]])  # p is drawn after another outcome was
    counts = counted(np.full(rows, shots), np.repeat(first, rows, axis=0))
    assert counts.min() >= 0
    assert set(counts.sum(axis=1)) == {shots}
    law = stats.binom(shots, p)
    cuts = np.unique(law.ppf(np.linspace(0.02, 0.98, 25)))
    cuts = cuts[cuts < shots]  # below each: what is at most as large
    observed = np.bincount(np.searchsorted(cuts, counts[:, 1]), minlength=len(cuts) + 1)
    expected = rows * np.diff(law.cdf(cuts), prepend=0, append=1)
    assert stats.chisquare(observed, expected).pvalue > 0.001


def test_counts_of_outcomes_that_are_certain_or_impossible():
    probabilities = np.array([[0, 1, 0, 0], [2, 0, 2, 0], [0, 0, 0.5, 0], [0, 0, 3, 0]])  # sums need not be 1
    counts = counted([7, 1000, 0, 3], probabilities)
    assert counts[0].tolist() == [0, 7, 0, 0]
    assert counts[1, [1, 3]].tolist() == [0, 0]
    assert 400 < counts[1, 0] < 600
    assert counts[2].tolist() == [0, 0, 0, 0]
    assert counts[3].tolist() == [0, 0, 3, 0]


@pytest.mark.parametrize("shots", [2, 5])  # one by one, and outcome by outcome
def test_bits_are_flipped_and_then_read_wrongly(shots):
    probabilities = np.tile([0.0, 1.0, 0.0, 0.0], (20_000, 1))  # the bits 01, which are flipped to 10
    counts = counted(np.full(20_000, shots), probabilities, flipped=np.full(20_000, 3), wrong=0.1)
    expected = 20_000 * shots * np.array([0.09, 0.01, 0.81, 0.09])
    assert stats.chisquare(counts.sum(0), expected).pvalue > 0.001


@pytest.mark.parametrize(
    ("backend", "options"), [("native", {}), ("pennylane", {}), ("qiskit", {"estimator": "aer"})]
)
def test_all_values_of_an_input_come_from_the_same_bit_strings(backend, options):
    circuit = Circuit(3)
    circuit.append("H", 0)
    circuit.append("CNOT", (0, 1))
    circuit.append("RX", 2, circuit.input(2))  # shares no gate with the others
    x = torch.full((1, 9, 3), 0.4, dtype=torch.float64)
    values = create_backend(backend, circuit, shots=7, **options)(x, {}, [1])[0]
    assert torch.equal(values[:, 0], values[:, 1])
    assert len(set(values[:, 0].tolist())) > 1
    assert float(values[:, 2].mean()) == pytest.approx(math.cos(0.4), abs=4 * math.sin(0.4) / math.sqrt(63))


def mixed(circuit, inputs, parameters):
    """Expectation values (B, O) of one seed by PennyLane's density matrices, noise after every elementary gate."""
    table = AngleTable(circuit)
    elementary = Elementary(circuit, table)
    rotations = elementary(table(inputs, parameters)[:, 0]).T.numpy()
    rate, wrong = NOISE["noise_rate"], NOISE["readout_error"]
    paulis = [np.eye(2), qml.X.compute_matrix(), qml.Y.compute_matrix(), qml.Z.compute_matrix()]

    def channel(rate, wires):
        words = paulis if len(wires) == 1 else [np.kron(a, b) for a in paulis for b in paulis]
        shares = np.full(len(words), rate / len(words))
        shares[0] += 1 - rate
        qml.QubitChannel([math.sqrt(p) * word for p, word in zip(shares, words)], wires=wires)

    @qml.qnode(qml.device("default.mixed", wires=circuit.qubits))
    def run(angles):
        names = {"H": "Hadamard"}
        for name, wires, rotation in elementary.gates:
            gate = getattr(qml, names.get(name, name))
            gate(*([] if rotation is None else [angles[rotation]]), wires=wires)
            channel(rate if len(wires) == 2 else rate / 10, wires)
        return [qml.expval(qml.PauliZ(q)) for q in circuit.observables]

    return torch.tensor(np.array([run(row) for row in rotations])) * (1 - 2 * wrong)


@pytest.mark.parametrize("qubits", [3, 4])
def test_noise_agrees_with_density_matrices(qubits):
    circuit = ansatz("iqp", qubits, 1)
    inputs, parameters, _ = draw(circuit, 1, 2)
    expected = mixed(circuit, inputs, parameters)
    noisy = {"estimator": "aer", **NOISE}
    assert_close([create_backend("qiskit", circuit, **noisy)(inputs, parameters)[0]], [expected], 1e-10)
    exact = create_backend("native", circuit)(inputs, parameters)[0]
    assert float((exact - expected).abs().max()) > 0.1
    backend = create_backend("native", circuit, trajectories=3000, **NOISE)
    assert_close([backend(inputs, parameters, [1])[0]], [expected], 4 / math.sqrt(3000))
    # as on a device: as many draws of errors as shots
    sampler = create_backend("native", circuit, trajectories=3000, shots=3000, **NOISE)
    assert_close([sampler(inputs, parameters, [1])[0]], [expected], 4 / math.sqrt(3000))


@pytest.mark.parametrize("options", [{}, {"shots": 20000}])
def test_gradients_under_noise_agree_with_density_matrices(options):
    circuit = ansatz("cz", 2, 1)
    given = draw(circuit, 1, 2)
    expected = evaluate(create_backend("qiskit", circuit, estimator="aer", **NOISE), *given)
    backend = create_backend("native", circuit, trajectories=2000, **NOISE, **options)
    assert_close(evaluate(backend, *given, seeds=[2]), expected, 0.1)


def test_errors_at_the_end_are_what_they_are_where_they_happen():
    circuit = every_gate()
    circuit.measure([0, 1, 2, (0, 1), (0, 1, 2)])
    elementary = Elementary(circuit, AngleTable(circuit))
    noise = PauliNoise(elementary, 3, 0.1)
    drawn = noise.draw(200, np.random.default_rng(3))
    errors = noise.carry(drawn)
    assert 100 < len(errors.hit) < 200
    rotations = np.linspace(-2, 2, elementary.rotations)
    angles = np.append(rotations, noise.constants)

    def values(run, angles):
        return create_backend("native", run)(torch.from_numpy(angles)[None, None], {})[0, 0].numpy()

    inserted = [
        Circuit(3, inputs=elementary.rotations) for _ in range(200)
    ]  # errors as gates where they happen
    for (name, wires, rotation), (places, codes) in zip(elementary.gates, drawn):
        for run in inserted:
            run.append(name, wires, *([] if rotation is None else [run.input(rotation)]))
        for place, code in zip(places, codes):
            for number, wire in enumerate(wires):
                for gate, bit in (("X", 2 * number), ("Z", 2 * number + 1)):
                    if code >> bit & 1:
                        inserted[place].append(gate, wire)
    for place, negated, flipped in zip(errors.hit, errors.negated.T, errors.flipped.T):
        inserted[place].measure(circuit.observables)
        signs = [(-1.0) ** flipped[list(qubits)].sum() for qubits in circuit.measured]
        found = signs * values(noise.circuit(circuit.observables), angles * (1.0 - 2.0 * negated))
        assert np.allclose(found, values(inserted[place], rotations), atol=1e-12)


def test_noise_of_rate_zero_is_none():
    circuit = ansatz("iqp", 2, 1, gate="u3")
    given = draw(circuit, 2, 3)
    none = {"noise_model": "depolarizing", "noise_rate": 0.0, "trajectories": 2}
    expected = evaluate(create_backend("native", circuit), *given)
    assert_close(evaluate(create_backend("native", circuit, **none), *given), expected, 1e-10)


def test_readout_errors_act_on_shots_as_on_mean_values():
    circuit = Circuit(2)
    circuit.append("X", 1)
    read = {"noise_model": "depolarizing", "noise_rate": 0.0, "readout_error": 0.1}
    x = torch.zeros(1, 400, 2, dtype=torch.float64)
    exact = create_backend("native", circuit, **read)(x, {}, [1])[0]
    assert_close([exact[0]], [torch.tensor([0.8, -0.8], dtype=torch.float64)], 1e-12)
    sampled = create_backend("native", circuit, shots=50, **read)(x, {}, [1])[0]
    spread = math.sqrt(1 - 0.8**2)
    assert_close([sampled.mean(0)], [exact[0]], 4 * spread / math.sqrt(20000))
    assert float(sampled.std(0).mean()) == pytest.approx(spread / math.sqrt(50), rel=0.15)


@pytest.mark.parametrize(
    "options", [{**NOISE, "noise_rate": 0.9}, {**NOISE, "shots": 20}, {"gradient": "spsa"}]
)
def test_noise_of_a_seed_depends_on_its_own_seed_alone(options):
    circuit = ansatz("cz", 2, 1)
    inputs, parameters, cotangent = draw(circuit, 3, 2)
    backend = create_backend("native", circuit, **options)
    together = evaluate(backend, inputs, parameters, cotangent, seeds=[11, 12, 2**62])
    one = {name: value[2:] for name, value in parameters.items()}
    alone = evaluate(backend, inputs[2:], one, cotangent[2:], seeds=[2**62])
    assert all(torch.equal(a[0], b[2]) for a, b in zip(alone, together))
    other = evaluate(backend, inputs, parameters, cotangent, seeds=[11, 13, 2**62])
    assert torch.equal(other[2][[0, 2]], together[2][[0, 2]])
    assert not torch.equal(other[2][1], together[2][1])


def test_states_that_do_not_fit_in_memory_are_sampled_in_parts(monkeypatch):
    circuit = ansatz("cz", 2, 1)
    inputs, parameters, _ = draw(circuit, 1, 40)
    sampler = create_backend("native", circuit, shots=400)
    exact = create_backend("native", circuit)(inputs, parameters)
    monkeypatch.setattr("qrlsuite.plugins.circuits.native.sampling.PART_BYTES", 1)
    error = (sampler(inputs, parameters, [1]) - exact) * math.sqrt(400)
    assert 0.7 < float((error / torch.sqrt(1 - exact**2)).std()) < 1.3


def test_an_spsa_gradient_is_right_on_average():
    circuit = ansatz("cz", 2, 1)
    inputs, parameters, cotangent = draw(circuit, 1, 1)
    exact = evaluate(create_backend("native", circuit), inputs, parameters, cotangent)
    many = 800
    wide = {name: value.expand(many, *value.shape[1:]) for name, value in parameters.items()}
    backend = create_backend("native", circuit, gradient="spsa")
    x, cotangents = (value.expand(many, -1, -1) for value in (inputs, cotangent))
    guesses = evaluate(backend, x, wide, cotangents, seeds=list(range(many)))
    for guess, value in zip(guesses[1:], exact[1:]):
        spread = float(guess.std(0).max()) / math.sqrt(many)
        assert_close([guess.mean(0)], [value[0]], 5 * spread + 0.02)


def test_executions_are_counted_as_they_are_executed():
    circuit = ansatz("iqp", 2, 1)  # 2 controlled Rot: 6 angles with four terms; 10 elementary rotations
    for options, circuits in (
        ({"shots": 10}, 24),
        ({"shots": 10, "gradient": "spsa"}, 2),
        ({"shots": 10, "noise_model": "depolarizing"}, 20),
    ):
        assert create_backend("native", circuit, **options).gradient_circuits == circuits


def test_shots_and_noise_make_another_entry_and_defaults_the_same():
    def name(*words):
        return resolve("beam6g", "vqc-native", settings=[parse_setting(word) for word in words]).name

    assert name() == name("trajectories=100", "gradient=auto")
    assert len({name(), name("shots=100"), name("noise_model=depolarizing")}) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise_rate": 0.02}, "noise_rate = 0.02 needs noise_model = 'depolarizing'"),
        ({"readout_error": 0.02}, "readout_error = 0.02 needs noise_model = 'depolarizing'"),
        ({"trajectories": 10}, "trajectories = 10 needs noise_model = 'depolarizing'"),
        ({"noise_model": "depolarizing", "trajectories": 0}, "trajectories = 0"),
    ],
)
def test_options_that_cannot_be_used_say_what_to_type(options, message):
    with pytest.raises(OptionError, match=message):
        create_backend("native", ansatz("cz", 2, 1), **options)


def test_a_mean_field_approximation_has_no_shots():
    with pytest.raises(OptionError, match="has no shots, noise or gradient rule"):
        create_backend("native", ansatz("cz", 2, 1, entangled="mean-field"), shots=10)


def test_numbers_that_are_not_finite_are_refused():
    circuit = ansatz("cz", 2, 1)
    inputs, parameters, _ = draw(circuit, 1, 1)
    with pytest.raises(OptionError, match="not finite"):
        create_backend("native", circuit, shots=10)(inputs * math.nan, parameters)
