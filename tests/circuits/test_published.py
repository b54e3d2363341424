"""The circuits of other papers: the values of their published PennyLane or Python code, written again here."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pennylane as qml
import pytest

from qrlsuite.circuit import Circuit, ansatz, expectations
from qrlsuite.circuit.resources import resources
from qrlsuite.errors import OptionError
from qrlsuite.testing.dense import expectation_values

Given = dict[str, Any]


def jerbi(x: Any, p: Given, n: int, layers: int) -> None:
    """TensorFlow Quantum's tutorial: `generate_circuit`."""
    for layer in range(layers + 1):
        for q in range(n):
            for k, gate in enumerate((qml.RX, qml.RY, qml.RZ)):
                gate(p["weights"][layer, q, k], q)
        if layer < layers:
            for a, b in zip(range(n - 1), range(1, n)):
                qml.CZ([a, b])
            if n != 2:
                qml.CZ([0, n - 1])
            for q in range(n):
                qml.RX(p["scaling"][layer, q] * x[q], q)


def hsiao(x: Any, p: Given, n: int, layers: int, single: bool = False, ring: bool = False) -> None:
    """SimplyQRL: `build_hsiao_qlayer`."""
    for q in range(n):
        qml.Hadamard(q)
    for layer in range(layers):
        for k, axis in enumerate("ZY" if single else "ZYZ"):
            qml.AngleEmbedding(x if single else [x[k]] * n, range(n), rotation=axis)
        qml.AngleEmbedding(p["weights"][layer], range(n), rotation="X")
        for q in range(n if ring else 0):
            qml.CNOT([q, (q + 1) % n])


def perez_salinas(x: Any, p: Given, n: int, layers: int, pairs: Any = ()) -> None:
    """`universal_qlassifier`: U3 is RZ(-phi) RY(theta) RZ(-lambda); two gates, of two features each, for four."""
    for layer in range(layers):
        for q in range(n):
            angles = p["weights"][layer, q].flatten()
            places = [0, 1, 3, 4] if len(x) == 4 else range(len(x))
            for k, place in enumerate(places):
                angles[place] += p["scaling"][layer, q, k] * x[k]
            for theta, phi, lam in angles.reshape(-1, 3):
                qml.RZ(-lam, q)
                qml.RY(theta, q)
                qml.RZ(-phi, q)
        if layer < layers - 1:
            for pair in pairs[layer % 2] if pairs else ():
                qml.CZ(pair)


def wang(
    x: Any, p: Given, n: int, layers: int, state: Callable[[], None] | None = None, ring: str = ""
) -> None:
    """`QRL-Pong`: the functions of `VQCBackbones.py`, measured in X, and with a state those of `VQCBackbones2.py`."""
    if state:
        state()
    for layer in range(layers):
        for q in range(n):
            qml.U3(*(p["scaling"][layer, q] * x[q] + p["weights"][layer, q]), wires=q)
        for q in range(n):
            if ring == "cz":
                qml.CZ([q, (q + 1) % n])
            elif ring == "zz":
                qml.IsingZZ(p["zz"][layer, q], [q, (q + 1) % n])
    if ring:
        for q in range(n):
            qml.Hadamard(q)
    if state:
        qml.adjoint(state)()


def ghz() -> None:
    qml.Hadamard(0)
    for q in range(1, 4):
        qml.CNOT([0, q])


def graph(*edges: tuple[int, int]) -> Callable[[], None]:
    def prepared() -> None:
        for q in range(4):
            qml.Hadamard(q)
        for edge in edges:
            qml.CZ(edge)

    return prepared


def basic(x: Any, p: Given, n: int, layers: int, bits: bool = False) -> None:
    """SimplyQRL: `build_basic_qlayer`."""
    (qml.BasisEmbedding if bits else qml.AngleEmbedding)(x, range(n))
    qml.BasicEntanglerLayers(p["weights"], range(n))


BRICKS = [[(0, 1), (2, 3)], [(1, 2), (0, 3)]]
CASES: list[tuple[str, Given, int, Callable[..., None], Given]] = [
    ("jerbi", {}, 4, jerbi, {}),
    ("jerbi", {}, 2, jerbi, {}),
    ("hsiao", {}, 2, hsiao, {}),
    ("hsiao", {"encoding": "single", "entangled": True}, 3, hsiao, {"single": True, "ring": True}),
    ("perez-salinas", {}, 1, perez_salinas, {}),
    ("perez-salinas", {"inputs": 2}, 2, perez_salinas, {"pairs": [[(0, 1)]] * 2}),
    ("perez-salinas", {"inputs": 4}, 4, perez_salinas, {"pairs": BRICKS}),
    ("perez-salinas", {"entangled": "separable"}, 4, perez_salinas, {}),
    ("wang", {}, 4, wang, {"ring": "cz"}),
    ("wang", {"coupling": "zz"}, 4, wang, {"ring": "zz"}),
    ("wang", {"entangled": "separable"}, 4, wang, {"ring": "none"}),
    ("wang", {"coupling": "ghz"}, 4, wang, {"state": ghz}),
    ("wang", {"coupling": "graph"}, 4, wang, {"state": graph((0, 1), (1, 2), (2, 3), (3, 0))}),
    ("wang", {"coupling": "graph", "edges": "3-0 1-3"}, 4, wang, {"state": graph((3, 0), (1, 3))}),
    ("wang", {"coupling": "ghz", "entangled": "separable"}, 4, wang, {}),
    ("basic", {}, 4, basic, {}),
    ("basic", {}, 2, basic, {}),
    ("basic", {"encoding": "basis"}, 3, basic, {"bits": True}),
]


def given(circuit: Circuit, seed: int = 0) -> tuple[Any, Given]:
    random = np.random.default_rng(seed)
    parameters = {name: random.uniform(0, 6, p.shape) for name, p in circuit.parameters.items()}
    return random.uniform(-2, 2, circuit.inputs), parameters


@pytest.mark.parametrize(("name", "options", "qubits", "published", "arguments"), CASES)
def test_values_are_those_of_the_published_circuit(
    name: str, options: Given, qubits: int, published: Callable[..., None], arguments: Given
) -> None:
    circuit = ansatz(name, qubits, 3, **options)
    x, parameters = given(circuit)
    if arguments.get("bits"):
        x = np.array([1, 0, 1])

    @qml.qnode(qml.device("default.qubit", wires=qubits))
    def node() -> Any:
        published(x, parameters, qubits, 3, **arguments)
        return [qml.expval(qml.Z(q)) for q in range(qubits)]

    expected = node()
    for values in (
        expectations(circuit, x[None].astype(float), parameters)[0],
        expectation_values(circuit, x, parameters),
    ):
        np.testing.assert_allclose(values, expected, atol=1e-12)


@pytest.mark.parametrize("name", ["jerbi", "hsiao", "perez-salinas", "wang", "basic"])
def test_controls_take_the_coupling_out(name: str) -> None:
    separable, mean_field = (ansatz(name, 3, 2, entangled=e) for e in ("separable", "mean-field"))
    circuit = ansatz(name, 3, 2, entangled=True)
    assert resources(circuit).two_qubit_gates > resources(separable).two_qubit_gates == 0
    assert mean_field.mean_field
    assert mean_field.operations == circuit.operations
    assert separable.parameters == circuit.parameters


def test_features_are_divided_evenly_among_gates() -> None:
    """Each of five features sets one angle of a layer: the first three those of one gate, the others of the next."""
    circuit = ansatz("perez-salinas", 1, 2, inputs=5)
    layer = [[angle.input for angle in op.angles] for op in circuit]
    assert layer == [[0, 1, 2], [3, 4, None]] * 2


@pytest.mark.parametrize(
    ("name", "layers", "options", "message"),
    [
        ("perez-salinas", 1, {}, "1 layer and 3 inputs: .* needs 2 layers or more"),
        ("wang", 1, {"edges": "0-1"}, "only a graph state has them; set coupling=graph"),
        ("wang", 1, {"edges": "0-1", "entangled": "separable"}, "only a graph state has them"),
        ("wang", 1, {"coupling": "graph", "edges": "junk", "entangled": "separable"}, "write ring"),
        (
            "wang",
            1,
            {"coupling": "graph", "edges": "0-1 1-0"},
            "distinct pairs of qubits 0..3 such as '0-1 1-2'",
        ),
        ("wang", 1, {"coupling": "graph", "edges": "0-4"}, "edges = '0-4': write ring, or distinct pairs"),
        ("wang", 1, {"coupling": "graph", "edges": "0-1 line"}, "write ring"),
        ("basic", 1, {"encoding": "amplitude"}, "encoding = 'amplitude': .*'angle' or 'basis'"),
    ],
)
def test_what_cannot_be_built_says_so(name: str, layers: int, options: Given, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        ansatz(name, 4, layers, **options)


@pytest.mark.parametrize(
    ("name", "options", "parameters", "gates"),
    [
        ("jerbi", {}, 4 * (4 * 3 + 3), 12),
        ("hsiao", {}, 12, 0),
        ("hsiao", {"entangled": True}, 12, 12),
        ("perez-salinas", {"inputs": 4}, 12 * (4 + 3 * 2), 4),
        ("wang", {}, 6 * 12, 12),
        ("wang", {"coupling": "zz"}, 7 * 12, 24),
        ("wang", {"coupling": "ghz"}, 6 * 12, 6),
        ("wang", {"coupling": "graph"}, 6 * 12, 8),
        ("basic", {}, 12, 12),
    ],
)
def test_the_table_in_docs_circuits(name: str, options: Given, parameters: int, gates: int) -> None:
    circuit = ansatz(name, 4, 3, **options)
    assert (circuit.parameter_count, resources(circuit).two_qubit_gates) == (parameters, gates)


def test_jerbi_starts_where_the_authors_do() -> None:
    start = {name: (p.shape, p.low, p.high) for name, p in ansatz("jerbi", 4, 5).parameters.items()}
    assert start == {"scaling": ((5, 4), 1.0, 1.0), "weights": ((6, 4, 3), 0.0, math.pi)}
