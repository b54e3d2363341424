import numpy as np
import pytest
import torch

from qrlsuite.circuit import Circuit
from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.shifts import FOUR_TERM, TWO_TERM, shifted_angles, vector_jacobian


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_two_terms_differentiate_frequency_one(angle):
    assert sum(c * np.sin(angle + s) for s, c in TWO_TERM) == pytest.approx(np.cos(angle))


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_four_terms_differentiate_frequencies_one_and_one_half(angle):
    assert sum(c * np.sin(angle + s) for s, c in FOUR_TERM) == pytest.approx(np.cos(angle))
    assert sum(c * np.sin((angle + s) / 2) for s, c in FOUR_TERM) == pytest.approx(np.cos(angle / 2) / 2)
    assert sum(c * np.sin((angle + s) / 2) for s, c in TWO_TERM) != pytest.approx(np.cos(angle / 2) / 2)


def test_stacked_shifts_give_the_gradient_of_a_known_function():
    angles = torch.tensor([[0.3, 1.1, -0.4], [0.9, 0.2, 2.0]], dtype=torch.float64)  # (A = 2, B = 3)

    def function(a):  # frequency 1 in the first angle, 1/2 and 1 in the second; two outputs
        return torch.stack([torch.sin(a[0]) * torch.cos(a[1] / 2), torch.cos(a[0]) + torch.sin(a[1])], dim=1)

    cotangent = torch.tensor([[1.0, 2.0], [0.5, -1.0], [3.0, 0.0]], dtype=torch.float64)
    stacked, plan = shifted_angles(angles, [False, True])
    assert stacked.shape == (2, (2 + 4) * 3)
    got = vector_jacobian(function(stacked), cotangent, plan)
    exact = angles.clone().requires_grad_()
    function(exact).backward(cotangent)
    torch.testing.assert_close(got, exact.grad, atol=1e-12, rtol=0)


def test_the_angle_table_is_constant_plus_scale_times_input_plus_weight():
    circuit = Circuit(2, inputs=2)
    a = circuit.parameter("a", (2,))
    b = circuit.parameter("b", (1, 2))
    circuit.append("Rot", 0, a[1] * circuit.input(1) + b[0, 1] + 0.5, 0.25, circuit.input(0))
    circuit.append("RX", 1, b[0, 0], control=0)
    table = AngleTable(circuit)
    assert table.rows == [(0, 0.25, 1), (2,)]
    assert table.controlled == [False, False, True]
    inputs = torch.tensor([[[2.0, 3.0]], [[4.0, 5.0]]])
    parameters = {
        "a": torch.tensor([[9.0, 10.0], [9.0, 20.0]]),
        "b": torch.tensor([[[0.1, 0.2]], [[0.3, 0.4]]]),
    }
    expected = [[[30.0 + 0.2 + 0.5], [100.0 + 0.4 + 0.5]], [[2.0], [4.0]], [[0.1], [0.3]]]
    torch.testing.assert_close(table(inputs, parameters), torch.tensor(expected))
