import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from qrlsuite.circuit import Circuit, ansatz, api, expectations
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.plugins.circuits.native import cpu, program


@pytest.fixture
def circuit():
    return ansatz("cz", 2, 2)


@pytest.fixture
def parameters(circuit):
    return {name: np.full(p.shape, 0.3) for name, p in circuit.parameters.items()}


def test_importing_circuits_imports_numpy_and_nothing_heavier():
    code = (
        "import sys; import qrlsuite.circuit, qrlsuite.plugins.circuits; "
        "print([m for m in ('torch', 'pennylane', 'qiskit', 'pydantic', 'numba', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_arrays_lists_and_tensors_are_the_same_and_float64_unless_they_are_float32(circuit, parameters):
    x = [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]
    by_list = expectations(circuit, x, parameters)
    assert by_list.shape == (3, 2)
    assert by_list.dtype == torch.float64
    assert torch.equal(by_list, expectations(circuit, np.array(x), parameters))
    single = torch.tensor(x, dtype=torch.float32)
    assert expectations(circuit, single, parameters).dtype == torch.float32
    assert expectations(circuit, single, parameters, dtype="float64").dtype == torch.float64
    assert expectations(circuit, x, parameters, dtype=torch.float32).dtype == torch.float32


def test_tensors_keep_their_gradient(circuit, parameters):
    weights = torch.tensor(parameters["weights"], requires_grad=True)
    expectations(circuit, np.ones((1, 2)), {**parameters, "weights": weights}).sum().backward()
    assert weights.grad.abs().sum() > 0


ONES = np.ones((3, 2))


@pytest.mark.parametrize(
    ("inputs", "change", "options", "message"),
    [
        (ONES * np.nan, {}, {}, "inputs: every number must be finite"),
        (ONES, {"weights": np.full((2, 2, 3), np.inf)}, {}, "parameter 'weights': every number must be finite"),
        (np.ones((3, 4)), {}, {}, r"inputs have shape \(3, 4\): this circuit needs \(batch, 2\)"),
        (np.ones(2), {}, {}, r"inputs have shape \(2,\)"),
        (np.ones((0, 2)), {}, {}, r"inputs have shape \(0, 2\)"),
        ("no", {}, {}, "inputs are not an array of numbers"),
        ([[1.0], [1.0, 2.0]], {}, {}, "inputs are not an array of numbers"),
        (ONES, {"weights": None}, {}, r"parameter 'weights' of shape \(2, 2, 3\) is missing"),
        (ONES, {"wieghts": 1.0}, {}, "no parameter 'wieghts'; did you mean 'weights'?"),
        (ONES, {"weights": np.ones(12)}, {}, r"'weights' has shape \(12,\), declared is \(2, 2, 3\)"),
        (ONES, {}, {"dtype": "float16"}, "dtype = float16: circuits are computed in float32 or float64"),
        (ONES, {}, {"backend": "pennylane", "shot": 5}, "'pennylane' has no option 'shot'; did you mean 'shots'?"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_what_is_wrong(circuit, parameters, inputs, change, options, message):
    given = {name: value for name, value in {**parameters, **change}.items() if value is not None}
    with pytest.raises(OptionError, match=message):
        expectations(circuit, inputs, given, **options)


def test_an_unknown_backend_names_the_nearest(circuit, parameters):
    with pytest.raises(UnknownNameError, match="circuit backend 'penylane'; did you mean 'pennylane'"):
        expectations(circuit, ONES, parameters, backend="penylane")


@pytest.mark.parametrize("backend", ["native", "pennylane"])
def test_a_circuit_that_grew_is_computed_anew_and_the_old_content_as_before(backend):
    """RX(0.3), then RX(0.3) RX(0.3): cos 0.3, cos 0.6, whichever circuit was computed and kept before."""

    def one():
        circuit = Circuit(1)
        circuit.append("RX", 0, circuit.input(0))
        return circuit

    grown = one()
    before = expectations(grown, [[0.3]], {}, backend=backend)
    grown.append("RX", 0, grown.input(0))
    after = expectations(grown, [[0.3]], {}, backend=backend)
    fresh = expectations(one(), [[0.3]], {}, backend=backend)
    assert [before.item(), after.item(), fresh.item()] == pytest.approx(np.cos([0.3, 0.6, 0.3]))


def test_what_is_measured_and_the_options_are_part_of_a_circuits_content():
    circuit = Circuit(2)
    circuit.append("X", 1)
    assert expectations(circuit, [[0.0, 0.0]], {}).tolist() == [[1.0, -1.0]]
    circuit.measure([1])
    assert expectations(circuit, [[0.0, 0.0]], {}).tolist() == [[-1.0]]
    circuit.append("H", 0)
    circuit.measure([0])
    sampled = [float(expectations(circuit, [[0.0, 0.0]], {}, "pennylane", seed=3, shots=n)) for n in (1, 100)]
    assert abs(sampled[0]) == 1.0
    assert abs(sampled[1]) < 1.0


def test_a_circuit_is_prepared_once_and_few_are_kept(monkeypatch):
    made = []
    compiled = program.compile_circuit
    monkeypatch.setattr(cpu, "compile_circuit", lambda circuit: made.append(1) or compiled(circuit))
    for number in (*range(20), 19):
        circuit = Circuit(1)
        circuit.append("RX", 0, 0.01 * number + 100)
        expectations(circuit, [[0.0]], {}, backend="native")
    assert len(made) == 20
    assert len(api._prepared.backends) == api.PREPARED


def test_threads_do_not_share_a_prepared_circuit(circuit, parameters):
    x = np.linspace(-1, 1, 400).reshape(200, 2)
    expected = expectations(circuit, x, parameters)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: expectations(circuit, x, parameters), range(40)))
    assert all(torch.equal(result, expected) for result in results)
