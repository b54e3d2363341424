import subprocess
import sys

import numpy as np
import pytest
import torch

from qrlsuite import registry
from qrlsuite.circuit import ansatz, expectations
from qrlsuite.errors import OptionError, UnknownNameError


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


def test_a_seed_makes_samples_repeatable(circuit, parameters):
    def run(seed):
        options = {"backend": "pennylane", "shots": 50, "seed": seed}
        return expectations(circuit, np.ones((4, 2)), parameters, **options)

    assert torch.equal(run(1), run(1))
    assert not torch.equal(run(1), run(2))


def test_the_default_backend_is_registered():
    assert "pennylane" in registry.load().names("circuit_backends")


ONES = np.ones((3, 2))


@pytest.mark.parametrize(
    ("inputs", "change", "options", "message"),
    [
        (ONES * np.nan, {}, {}, "inputs: every number must be finite"),
        (
            ONES,
            {"weights": np.full((2, 2, 3), np.inf)},
            {},
            "parameter 'weights': every number must be finite",
        ),
        (np.ones((3, 4)), {}, {}, r"inputs have shape \(3, 4\): this circuit needs \(batch, 2\)"),
        (np.ones(2), {}, {}, r"inputs have shape \(2,\)"),
        (np.ones((0, 2)), {}, {}, r"inputs have shape \(0, 2\)"),
        ("no", {}, {}, "inputs are not an array of numbers"),
        ([[1.0], [1.0, 2.0]], {}, {}, "inputs are not an array of numbers"),
        (ONES, {"weights": None}, {}, r"parameter 'weights' of shape \(2, 2, 3\) is missing"),
        (ONES, {"wieghts": 1.0}, {}, "no parameter 'wieghts'; did you mean 'weights'?"),
        (ONES, {"weights": np.ones(12)}, {}, r"'weights' has shape \(12,\), declared is \(2, 2, 3\)"),
        (ONES, {}, {"dtype": "float16"}, "dtype = float16: circuits are computed in float32 or float64"),
        (
            ONES,
            {},
            {"backend": "pennylane", "shot": 5},
            "'pennylane' has no option 'shot'; did you mean 'shots'?",
        ),
    ],
)
def test_bad_input_is_refused_with_what_is_wrong(circuit, parameters, inputs, change, options, message):
    given = {name: value for name, value in {**parameters, **change}.items() if value is not None}
    with pytest.raises(OptionError, match=message):
        expectations(circuit, inputs, given, **options)


def test_an_unknown_backend_names_the_nearest(circuit, parameters):
    with pytest.raises(
        UnknownNameError, match=r"unknown circuit backend 'penylane'; did you mean 'pennylane'\?"
    ):
        expectations(circuit, ONES, parameters, backend="penylane")
