import pytest

from qrlsuite.circuit import Circuit, ansatz
from qrlsuite.circuit.drawing import draw_figure, draw_text
from qrlsuite.circuit.resources import resources


def test_resources_of_a_small_circuit_counted_by_hand():
    circuit = Circuit(3)
    w = circuit.parameter("w", (4,))
    for q in range(3):
        circuit.append("H", q)
    circuit.append("RX", 0, circuit.input(0))  # 2 evaluations
    circuit.append("RY", 1, 0.5)  # constant: none
    circuit.append("RZ", 2, w[0], control=1)  # 4
    circuit.append("Rot", 0, w[1], 0.1, w[2])  # 2 + 2
    circuit.append("CZ", (0, 1))
    circuit.append("SWAP", (0, 2))
    found = resources(circuit)
    assert found.gates == {"H": 3, "RX": 1, "RY": 1, "CRZ": 1, "Rot": 1, "CZ": 1, "SWAP": 1}
    assert (found.qubits, found.inputs, found.parameters) == (3, 3, 4)
    assert found.two_qubit_gates == 3
    assert found.two_qubit_depth == 3  # CRZ(1, 2), CZ(0, 1), SWAP(0, 2) follow one another
    assert found.depth == 5  # H, RY, CRZ, CZ, SWAP
    assert found.shift_evaluations == 2 + 4 + 4


def test_gates_on_disjoint_qubits_count_as_one_step():
    circuit = Circuit(4)
    circuit.append("CZ", (0, 1))
    circuit.append("CZ", (2, 3))
    assert resources(circuit).two_qubit_depth == 1
    circuit.append("CZ", (1, 2))
    assert resources(circuit).two_qubit_depth == 2


def test_the_rings_of_the_paper():
    assert resources(ansatz("iqp", 10, 4)).two_qubit_depth == 40
    found = resources(ansatz("cx", 10, 4))
    assert found.two_qubit_gates == 30
    assert found.gates == {"H": 10, "Rot": 40, "CNOT": 30}


def test_text_shows_every_wire_and_the_angles_when_asked():
    circuit = ansatz("skolik", 2, 1)
    short, long = draw_text(circuit), draw_text(circuit, angles=True)
    assert short.count("q_") == 2
    assert "RX" in short
    assert "scaling" not in short
    assert "RX(scaling[1]*x1)" in long
    assert "RZ(weights[3])" in long


@pytest.mark.parametrize("name", ["iqp", "cx", "cz", "skolik"])
def test_controls_are_drawn_on_their_wires(name):
    text = draw_text(ansatz(name, 3, 2))
    assert text.count("■") == {"iqp": 6, "cx": 3, "cz": 6, "skolik": 12}[name]


def test_every_gate_has_a_place_in_the_figure(tmp_path):
    circuit = ansatz("iqp", 3, 1)
    circuit.append("CNOT", (0, 2))
    circuit.append("CZ", (1, 2))
    circuit.append("SWAP", (0, 1))
    figure = draw_figure(circuit)
    assert sorted(t.get_text() for t in figure.axes[0].texts) == ["H"] * 3 + ["Rot"] * 3 + ["q0", "q1", "q2"]
    figure.savefig(tmp_path / "circuit.png")
    assert (tmp_path / "circuit.png").stat().st_size > 1000
