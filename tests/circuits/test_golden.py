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


@pytest.mark.parametrize(
    ("names", "dtype", "tolerance", "options"),
    [
        (CASES, torch.float64, 1e-10, {"backend": "pennylane"}),
        (CASES, torch.float32, 1e-5, {"backend": "pennylane"}),
        (SMALL, torch.float64, 1e-10, {"backend": "pennylane", "diff_method": "parameter-shift"}),
        (SMALL, torch.float64, 1e-10, {"backend": "pennylane", "device": "lightning.qubit"}),
        (SMALL, torch.float64, 1e-10, {"backend": "pennylane", "device": "default.mixed"}),
        (SMALL, torch.float64, 1e-10, {"backend": "qiskit"}),
    ],
)
def test_every_device_gives_the_released_numbers(names, dtype, tolerance, options):
    assert (len(CASES), len(SMALL)) == (18, 9)
    errors = {name: largest_error(CASES[name], dtype, **options) for name in names}
    assert max(errors.values()) < tolerance, errors


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
