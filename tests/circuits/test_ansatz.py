import math

import pytest

from qrlsuite.circuit import ansatz
from qrlsuite.circuit.drawing import angle_text
from qrlsuite.errors import OptionError, UnknownNameError


def gates(circuit):
    return [(op.gate, op.qubits) for op in circuit]


def test_iqp_on_two_qubits_is_what_a_person_writes_down():
    circuit = ansatz("iqp", 2, 2)
    layer = [("Rot", (0, 1)), ("Rot", (1, 0))]
    plus = [("H", (0,)), ("H", (1,))]
    assert gates(circuit) == [*plus, *layer, *plus, *layer]
    assert all(op.control is not None for op in circuit if op.gate == "Rot")
    # Layer 1, qubit 1, angles 0..2: flat index (1 * 2 + 1) * 3 + k.
    assert [angle_text(a) for a in circuit.operations[-1].angles] == [
        f"scaling[{i}]*x1 + weights[{i}]" for i in (9, 10, 11)
    ]


@pytest.mark.parametrize(("name", "static"), [("cx", "CNOT"), ("cz", "CZ")])
def test_static_rings_follow_every_layer_but_the_last(name, static):
    circuit = ansatz(name, 3, 2, gate="u3")
    layer = [("U3", (q,)) for q in range(3)]
    ring = [(static, (0, 1)), (static, (1, 2)), (static, (2, 0))]
    assert gates(circuit) == [*[("H", (q,)) for q in range(3)], *layer, *ring, *layer]


def test_a_ring_of_two_qubits_has_both_directions():
    assert gates(ansatz("cx", 2, 2))[4:6] == [("CNOT", (0, 1)), ("CNOT", (1, 0))]


def test_xyz_applies_three_rotations_in_order_controlled_in_iqp():
    assert gates(ansatz("iqp", 3, 1, gate="xyz"))[3:6] == [(name, (0, 1)) for name in ("RX", "RY", "RZ")]
    assert gates(ansatz("cz", 3, 1, gate="xyz"))[3:6] == [(name, (0,)) for name in ("RX", "RY", "RZ")]


@pytest.mark.parametrize("name", ["iqp", "cx", "cz"])
@pytest.mark.parametrize("gate", ["rot", "xyz", "u3"])
def test_parameters_are_scaling_and_weights_per_layer_qubit_and_angle(name, gate):
    circuit = ansatz(name, 4, 3, gate=gate)
    assert {p.name: (p.shape, p.low, p.high) for p in circuit.parameters.values()} == {
        "scaling": ((3, 4, 3), 0.0, 2 * math.pi),
        "weights": ((3, 4, 3), 0.0, 2 * math.pi),
    }
    used = [e for op in circuit for a in op.angles for e in (a.scale, a.weight)]
    assert len(used) == len(set(used)) == 2 * 3 * 4 * 3
    for op in circuit:
        assert {a.input for a in op.angles} <= {op.wires[0] if op.control is None else op.control}
    assert circuit.observables == (0, 1, 2, 3)


def test_skolik_on_three_and_two_qubits():
    layer = [(g, (q,)) for q in range(3) for g in ("RX", "RY", "RZ")]
    ring = [("CZ", (0, 1)), ("CZ", (1, 2)), ("CZ", (2, 0))]
    assert gates(ansatz("skolik", 3, 2)) == [*layer, *ring] * 2
    assert gates(ansatz("skolik", 2, 1))[-1] == ("CZ", (0, 1))  # a second one would undo it
    assert len(ansatz("skolik", 2, 1)) == 7
    scaling = ansatz("skolik", 2, 1).parameters["scaling"]
    assert (scaling.low, scaling.high) == (1.0, 1.0)
    assert gates(ansatz("skolik", 3, 2, entangled="separable")) == layer * 2
    assert ansatz("skolik", 3, 2, entangled="mean-field").mean_field


def test_one_qubit_has_no_ring():
    alone = [("H", (0,)), ("Rot", (0,)), ("Rot", (0,))]
    assert gates(ansatz("cx", 1, 2)) == gates(ansatz("cz", 1, 2)) == alone
    assert gates(ansatz("skolik", 1, 1)) == [("RX", (0,)), ("RY", (0,)), ("RZ", (0,))]
    with pytest.raises(OptionError, match=r"'iqp' with 1 qubit.* controlled .*needs 2 to 20"):
        ansatz("iqp", 1, 2)


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        (("iqp", 0, 1), {}, OptionError, "qubits = 0: a circuit has 1 qubit or more"),
        (("iqp", True, 1), {}, OptionError, "qubits = True"),
        (("iqp", 2.0, 1), {}, OptionError, "qubits = 2.0"),
        (("iqp", 2, 0), {}, OptionError, "layers = 0: a circuit has 1 layer or more"),
        (("ipq", 2, 1), {}, UnknownNameError, "unknown ansatz 'ipq'; did you mean 'iqp'?"),
        (("iqp", 2, 1), {"gate": "rott"}, OptionError, "gate = 'rott': .*'rot', 'xyz' or 'u3'"),
        (("iqp", 2, 1), {"gates": "rot"}, OptionError, "no option 'gates'; did you mean 'gate'?"),
        (("skolik", 2, 1), {"gate": "rot"}, OptionError, "'skolik' has no option 'gate'"),
    ],
)
def test_what_cannot_be_built_says_so(arguments, options, error, message):
    with pytest.raises(error, match=message):
        ansatz(*arguments, **options)
