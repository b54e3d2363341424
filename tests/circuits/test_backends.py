"""What every circuit backend must do, run on every registered ansatz and backend."""

import importlib
import importlib.util
import pkgutil
import sys
import types

import numpy as np
import pytest
import torch
from qiskit.providers.fake_provider import GenericBackendV2

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, ansatz, create_backend, expectations
from qrlsuite.circuit.shifts import measured, shift_rule
from qrlsuite.errors import OptionError
from qrlsuite.options import field_names
from qrlsuite.plugins.circuits.qiskit import QiskitBackend
from tests.testing.broken import assert_all_good

BACKENDS = registry.load().names(specs.CircuitBackendSpec)
VARIANTS = [
    (name, gate)
    for name in registry.load().names(specs.AnsatzSpec)
    for gate in (
        ("rot", "xyz", "u3")
        if "gate" in field_names(specs.resolve(registry.get(specs.AnsatzSpec, name).options))
        else (None,)
    )
]


def draw(circuit, seeds, batch, seed=0):
    """Inputs (S, B, in), parameters (S, ...) and a cotangent (S, B, out), float64."""
    generator = torch.Generator().manual_seed(seed)
    options = {"generator": generator, "dtype": torch.float64}
    inputs = torch.randn(seeds, batch, circuit.inputs, **options)
    parameters = {name: 6 * torch.rand(seeds, *p.shape, **options) for name, p in circuit.parameters.items()}
    return inputs, parameters, torch.randn(seeds, batch, len(circuit.observables), **options)


def evaluate(backend, inputs, parameters, cotangent, **options):
    """Values and all gradients."""
    inputs = inputs.clone().requires_grad_()
    parameters = {name: value.clone().requires_grad_() for name, value in parameters.items()}
    values = backend(inputs, parameters, **options)
    values.backward(cotangent)
    return [values.detach(), inputs.grad, *[value.grad for value in parameters.values()]]


def assert_close(got, expected, tolerance):
    for a, b in zip(got, expected, strict=True):
        assert a.shape == b.shape
        assert float((a - b).abs().max()) < tolerance


@pytest.mark.parametrize(("name", "gate"), VARIANTS)
def test_every_ansatz_on_every_backend_agrees_with_pennylane(name, gate):
    circuit = ansatz(name, 3, 2, **({} if gate is None else {"gate": gate}))
    given = draw(circuit, 2, 1)
    expected = evaluate(create_backend("pennylane", circuit), *given)
    for backend in BACKENDS:
        assert_close(evaluate(create_backend(backend, circuit), *given), expected, 1e-10)


@pytest.mark.parametrize(
    ("backend", "options"),
    [
        ("pennylane", {"device": "lightning.qubit"}),
        ("qiskit", {"estimator": "aer"}),
    ],
)
def test_devices_pass_the_checks_of_backends(backend, options):
    assert "shots" in assert_all_good(registry.get(specs.CircuitBackendSpec, backend), options)


def test_seeds_that_do_not_fit_in_memory_are_recomputed_with_the_same_bits(monkeypatch):
    circuit = ansatz("iqp", 3, 2)
    backend = create_backend("pennylane", circuit)
    given = draw(circuit, 5, 20)
    whole = evaluate(backend, *given)
    executed = []
    execute = backend.execute
    monkeypatch.setattr(backend, "execute", lambda *given: executed.append(given) or execute(*given))
    evaluate(backend, *given)
    assert len(executed) == 1
    memory = 4 * (len(circuit) // 2) * 20 * 16 * 8 * 2
    monkeypatch.setattr("qrlsuite.plugins.circuits.pennylane.MEMORY", memory)
    in_parts = evaluate(backend, *given)
    assert len(executed) == 1 + 2 * 3  # two seeds at a time, forward and backward
    assert all(torch.equal(a, b) for a, b in zip(whole, in_parts))


def test_shifts_that_do_not_fit_in_memory_are_executed_in_parts(monkeypatch):
    circuit = ansatz("iqp", 2, 2)
    given = draw(circuit, 2, 3)
    backend = create_backend("pennylane", circuit, diff_method="parameter-shift")
    whole = evaluate(backend, *given)
    monkeypatch.setattr("qrlsuite.plugins.circuits.pennylane.MEMORY", 4 * 16 * 4 * 10)  # ten lanes
    assert backend.lanes_per_pass() == 10
    assert_close(evaluate(backend, *given), whole, 1e-12)


# Finite shots.

LIGHTNING, AER = {"device": "lightning.qubit"}, {"estimator": "aer"}
SAMPLING = [("native", {}), ("pennylane", {}), ("pennylane", LIGHTNING), ("qiskit", {}), ("qiskit", AER)]


@pytest.mark.parametrize(("backend", "options"), SAMPLING)
def test_sampled_gradients_scatter_about_the_exact_gradient(backend, options):
    circuit = ansatz("iqp", 2, 1)
    inputs, parameters, cotangent = draw(circuit, 1, 2)
    exact = evaluate(create_backend("pennylane", circuit), inputs, parameters, cotangent)
    sampler = create_backend(backend, circuit, shots=20000, **options)
    sampled = evaluate(sampler, inputs, parameters, cotangent, seeds=[3])
    for a, b in zip(sampled, exact):
        assert 0 < float((a - b).abs().max()) < 0.1


@pytest.mark.parametrize(
    ("backend", "where", "argument"),
    [
        ("pennylane", "qrlsuite.plugins.circuits.pennylane._device", 2),
        ("qiskit", "qrlsuite.plugins.circuits.qiskit.QiskitBackend._call", 2),
    ],
)
def test_forward_and_backward_pass_do_not_share_their_samples(monkeypatch, backend, where, argument):
    circuit = ansatz("cz", 2, 1)
    sampler = create_backend(backend, circuit, shots=20)
    module, _, name = where.rpartition(".")
    original = getattr(pkgutil.resolve_name(module), name)
    seeds = []

    def spy(*arguments):
        seed = arguments[argument]
        seeds.append(int(seed.generate_state(1)[0]) if isinstance(seed, np.random.SeedSequence) else seed)
        return original(*arguments)

    monkeypatch.setattr(where, spy)
    evaluate(sampler, *draw(circuit, 2, 2), seeds=[5, 6])
    assert len(seeds) == len(set(seeds)) == 4  # two agents, two passes


def test_sampling_leaves_global_random_numbers_alone():
    circuit = ansatz("cz", 2, 1)
    inputs, parameters, cotangent = draw(circuit, 1, 2)

    def state():
        return np.random.get_state()[1].copy(), torch.get_rng_state().numpy()  # noqa: NPY002

    for backend, options in SAMPLING:
        before = state()
        sampler = create_backend(backend, circuit, shots=20, **options)
        evaluate(sampler, inputs, parameters, cotangent, seeds=[1])
        assert all(np.array_equal(a, b) for a, b in zip(before, state()))


@pytest.mark.parametrize(
    ("backend", "options", "chosen"),
    [
        ("pennylane", {}, "backprop"),
        ("pennylane", {"shots": 10}, "parameter-shift"),
        ("pennylane", {"device": "lightning.qubit"}, "adjoint"),
        ("pennylane", {"device": "lightning.qubit", "shots": 10}, "parameter-shift"),
        ("pennylane", {"device": "qrlsuite.native"}, "adjoint"),
        ("pennylane", {"device": "default.mixed"}, "parameter-shift"),
        ("pennylane", {"diff_method": "parameter-shift"}, "parameter-shift"),
        ("qiskit", {}, "adjoint"),
        ("qiskit", {"estimator": "aer"}, "adjoint"),
        ("qiskit", {"shots": 10}, "parameter-shift"),
        ("qiskit", {"estimator": "aer", "noise_model": "depolarizing"}, "parameter-shift"),
    ],
)
def test_gradients_are_by_the_fastest_way_that_the_device_has(backend, options, chosen):
    made = create_backend(backend, ansatz("cz", 2, 1), **options)
    assert getattr(made, "diff_method" if backend == "pennylane" else "gradient") == chosen


# What cannot be done.


@pytest.mark.parametrize(
    ("backend", "options", "message"),
    [
        ("pennylane", {"device": "default.qubits"}, "did you mean 'default.qubit'?"),
        ("pennylane", {"device": "lightning.gpu"}, "pip install pennylane-lightning-gpu"),
        ("pennylane", {"device": "cirq.simulator"}, "pip install pennylane-cirq"),
        ("pennylane", {"device": "default.gaussian"}, "'default.gaussian'.* cannot run this circuit.*RZ"),
        ("pennylane", {"diff_method": "backprob"}, "diff_method = 'backprob': .*'backprop'"),
        ("pennylane", {"device": "lightning.qubit", "diff_method": "backprop"}, "use 'adjoint'"),
        ("pennylane", {"device": "default.mixed", "diff_method": "adjoint"}, "does not support adjoint"),
        ("pennylane", {"shots": 10, "diff_method": "adjoint"}, "with shots = 10 use 'parameter-shift'"),
        ("pennylane", {"shots": 0}, "shots = 0: .*greater than or equal to 1"),
        ("qiskit", {"gradient": "lin-comb", "shots": 10}, "'lin-comb' needs exact states"),
        ("qiskit", {"gradient": "reverse"}, "'reverse' .* no longer there: 'adjoint' gives the same"),
        ("qiskit", {"gradient": "adjoint", "shots": 10}, "'adjoint' needs exact states, without shots"),
        ("qiskit", {"readout_error": 0.1}, "readout_error = 0.1 needs noise_model = 'depolarizing'"),
        ("qiskit", {"noise_model": "depolarizing"}, "needs estimator = 'aer'"),
        ("qiskit", {"noise_rate": 1.5}, "noise_rate = 1.5"),
    ],
)
def test_options_that_cannot_be_used_say_what_to_type(backend, options, message):
    with pytest.raises(OptionError, match=message) as caught:
        create_backend(backend, ansatz("cz", 2, 1), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore:Operator")  # PennyLane's, of gates that it cannot decompose
@pytest.mark.parametrize("device", ["default.gaussian", "default.qutrit"])
def test_a_device_that_refuses_a_circuit_when_it_runs_says_so(device):
    circuit = Circuit(1)
    circuit.append("Rot", 0, 0.1, 0.2, 0.3)
    with pytest.raises(OptionError, match=f"'{device}'.* cannot run this circuit"):
        expectations(circuit, [[0.0]], {}, backend="pennylane", device=device)


def test_a_missing_package_is_named_with_its_command(monkeypatch):
    import_module = importlib.import_module

    def without(name, package=None):
        if name.startswith("qiskit_ibm_runtime"):
            raise ModuleNotFoundError(f"No module named '{name}'", name="qiskit_ibm_runtime")
        return import_module(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(OptionError, match="'qiskit_ibm_runtime' is missing; pip install qiskit-ibm-runtime"):
        create_backend("qiskit", ansatz("cz", 2, 1), device="ibm_fez", shots=9)


@pytest.mark.parametrize("gradient", ["parameter-shift", "lin-comb"])
def test_qiskits_other_gradients(gradient):
    circuit = ansatz("iqp", 2, 1, gate="u3")
    given = draw(circuit, 1, 1)
    got = evaluate(create_backend("qiskit", circuit, gradient=gradient), *given)
    assert_close(got, evaluate(create_backend("pennylane", circuit), *given), 1e-10)


def test_estimator_qnn_and_torch_connector_give_the_same_numbers():
    from qiskit_machine_learning.connectors import TorchConnector

    circuit = ansatz("iqp", 2, 1)
    backend = create_backend("qiskit", circuit)
    inputs, parameters, cotangent = draw(circuit, 1, 2)
    angles = backend.table(inputs, parameters)[:, 0]
    rotations = backend.elementary(angles).T.float().requires_grad_()
    values = TorchConnector(backend.network(), initial_weights=np.zeros(0))(rotations)
    values.backward(cotangent[0].float())

    again = rotations.detach().double().requires_grad_()
    ours = create_backend("qiskit", circuit, gradient="parameter-shift")
    got = measured(again.T, lambda some, call: ours._execute(some), shift_rule([False] * again.shape[1]))
    got.backward(cotangent[0])
    assert_close([values.detach(), rotations.grad], [got.detach(), again.grad], 1e-6)
    assert_close([values.detach()], [backend(inputs, parameters)[0]], 1e-6)


def test_qiskit_runs_all_lanes_and_all_shifts_of_them_in_one_call(monkeypatch):
    circuit = ansatz("cz", 2, 1)
    lanes = []
    call = QiskitBackend._call
    monkeypatch.setattr(QiskitBackend, "_call", lambda self, r, s: lanes.append(len(r)) or call(self, r, s))
    given = draw(circuit, 3, 4)
    evaluate(create_backend("qiskit", circuit), *given)
    assert lanes == [12]  # the gradient is the native simulator's
    lanes.clear()
    evaluate(create_backend("qiskit", circuit, gradient="parameter-shift"), *given)
    assert lanes == [12, 12 * 2 * 6]  # 6 rotations


def test_exact_values_differentiated_by_spsa_are_the_same_with_the_same_seeds():
    circuit = ansatz("cz", 2, 1)
    given = draw(circuit, 2, 3)
    backend = create_backend("qiskit", circuit, gradient="spsa")
    assert backend.draws
    first, again, other = (evaluate(backend, *given, seeds=seeds) for seeds in ([1, 2], [1, 2], [1, 3]))
    assert all(torch.equal(a, b) for a, b in zip(first, again))
    assert torch.equal(first[2][0], other[2][0])
    assert not torch.equal(first[2][1], other[2][1])


def test_qiskits_spsa_is_an_unbiased_guess():
    circuit = Circuit(1)
    circuit.append("RX", 0, circuit.input(0))
    x = torch.full((1, 1, 1), 0.7, dtype=torch.float64, requires_grad=True)
    create_backend("qiskit", circuit, gradient="spsa")(x, {}, [1]).sum().backward()
    assert float(x.grad) == pytest.approx(-np.sin(0.7), abs=1e-4)  # one angle: SPSA is a central difference


@pytest.mark.parametrize("shots", [None, 1000])
def test_a_circuit_is_transpiled_for_a_device_and_takes_its_noise(shots):
    circuit = ansatz("iqp", 3, 1)  # a ring; the device is a chain
    inputs, parameters, _ = draw(circuit, 1, 4)
    exact = create_backend("qiskit", circuit)(inputs, parameters)
    device = {"estimator": "aer", "noise_model": "GenericBackendV2", "shots": shots}
    values = create_backend("qiskit", circuit, **device)(inputs, parameters, [1])
    error = float((values - exact).abs().max())
    assert 1e-4 < error < (0.1 if shots is None else 0.25)


def test_a_snapshot_of_a_device_needs_its_package():
    if importlib.util.find_spec("qiskit_ibm_runtime") is not None:
        pytest.skip("qiskit-ibm-runtime is installed")
    device = {"estimator": "aer", "noise_model": "FakeManilaV2"}
    with pytest.raises(OptionError, match=r"'FakeManilaV2' .*is missing; pip install qiskit-ibm-runtime"):
        create_backend("qiskit", ansatz("cz", 2, 1), **device)


def test_a_device_that_is_too_small_is_refused(monkeypatch):
    devices = types.ModuleType("qiskit_ibm_runtime.fake_provider")  # in its place, a device of Qiskit's own
    devices.FakeSmallV2 = lambda: GenericBackendV2(5, seed=0)
    monkeypatch.setitem(sys.modules, "qiskit_ibm_runtime", types.ModuleType("qiskit_ibm_runtime"))
    monkeypatch.setitem(sys.modules, devices.__name__, devices)
    device = {"estimator": "aer", "noise_model": "FakeSmallV2"}
    with pytest.raises(OptionError, match="'FakeSmallV2' has 5 qubits, the circuit 6"):
        create_backend("qiskit", ansatz("cz", 6, 1), **device)
    with pytest.raises(OptionError, match="'FakeSmalV2' is unknown; did you mean 'FakeSmallV2'"):
        create_backend("qiskit", ansatz("cz", 5, 1), **{**device, "noise_model": "FakeSmalV2"})
