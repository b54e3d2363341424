"""The paper's nine circuits: values and gradients printed by its released stack."""

import pytest
import torch

from qrlsuite.circuit import ansatz, expectations
from tests.conftest import golden

CASES = {f"{c['structure']}-{c['gate']}-{c['qubits']}": c for c in golden("vqc")}
SMALL = {name: case for name, case in CASES.items() if case["qubits"] == 2}


def largest_error(case, dtype, **backend):
    circuit = ansatz(case["structure"], case["qubits"], case["layers"], gate=case["gate"])
    names = ("inputs", "scaling", "weights")
    given = {name: torch.tensor(case[name], dtype=dtype, requires_grad=True) for name in names}
    values = expectations(circuit, given["inputs"], {name: given[name] for name in names[1:]}, **backend)
    assert values.dtype == dtype
    values.backward(torch.tensor(case["cotangent"], dtype=dtype))
    computed = {"expval_z": values.detach(), **{f"grad_{name}": given[name].grad for name in names}}
    return max(
        float((got.double() - torch.tensor(case[name], dtype=torch.float64)).abs().max())
        for name, got in computed.items()
    )


def test_there_are_eighteen_cases():
    assert len(CASES) == 18
    assert len(SMALL) == 9


@pytest.mark.parametrize("name", CASES)
def test_pennylane_in_float64(name):
    assert largest_error(CASES[name], torch.float64, backend="pennylane") < 1e-10


@pytest.mark.parametrize("name", CASES)
def test_pennylane_in_float32(name):
    assert largest_error(CASES[name], torch.float32, backend="pennylane") < 1e-5


@pytest.mark.parametrize("name", CASES)
def test_pennylane_by_parameter_shift(name):
    assert (
        largest_error(CASES[name], torch.float64, backend="pennylane", diff_method="parameter-shift") < 1e-10
    )


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("device", ["lightning.qubit", "default.mixed"])
def test_other_devices_in_float64(name, device):
    assert largest_error(SMALL[name], torch.float64, backend="pennylane", device=device) < 1e-10


@pytest.mark.parametrize("name", sorted(set(CASES) - set(SMALL))[::4])
def test_qiskit_on_four_qubits(name):
    """All values, and the gradients by one input's features: a whole batch's take a minute in Qiskit.

    Each structure with another gate; all of them are compared on fewer qubits.
    """
    case = CASES[name]
    circuit = ansatz(case["structure"], case["qubits"], case["layers"], gate=case["gate"])
    given = {key: torch.tensor(case[key], dtype=torch.float64) for key in ("inputs", "scaling", "weights")}
    inputs = given.pop("inputs").requires_grad_()
    with torch.no_grad():
        values = expectations(circuit, inputs, given, backend="qiskit")
    expected = torch.tensor(case["expval_z"], dtype=torch.float64)
    assert float((values - expected).abs().max()) < 1e-10
    expectations(circuit, inputs[:1], given, backend="qiskit").backward(
        torch.tensor(case["cotangent"][:1], dtype=torch.float64)
    )
    expected = torch.tensor(case["grad_inputs"][0], dtype=torch.float64)
    assert float((inputs.grad[0] - expected).abs().max()) < 1e-10
    assert float(inputs.grad[1:].abs().max()) == 0


@pytest.mark.parametrize("name", SMALL)
def test_qiskit(name):
    assert largest_error(SMALL[name], torch.float64, backend="qiskit") < 1e-10
    assert largest_error(SMALL[name], torch.float32, backend="qiskit") < 1e-5
