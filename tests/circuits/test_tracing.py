"""PennyLane's quantum functions as circuits: the same values and gradients, and words for what cannot be taken."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch

import qrlsuite
from qrlsuite import own
from qrlsuite.circuit import ansatz, expectations
from qrlsuite.circuit.tracing import trace
from qrlsuite.errors import CircuitError, OptionError, PluginError, UnknownNameError
from qrlsuite.experiment.entry import resolve

weight_shapes: dict[str, Any] = {}


@pytest.fixture(autouse=True)
def unloaded() -> Iterator[None]:
    yield
    for each in own.loaded():
        own.unload(each)


def z(count: int = 4) -> list[Any]:
    return [qml.expval(qml.Z(wire)) for wire in range(count)]


def strongly(inputs: Any, weights: Any) -> Any:
    qml.AngleEmbedding(inputs, wires=range(4))
    qml.StronglyEntanglingLayers(weights, wires=range(4))
    return z()


def basic(inputs: Any, weights: Any) -> Any:
    qml.IQPEmbedding(inputs, wires=range(4), n_repeats=2)
    qml.BasicEntanglerLayers(weights, wires=range(4), rotation=qml.RY)
    return [qml.expval(qml.X(0) @ qml.Y(2)), qml.expval(qml.Z(1))]


def random(inputs: Any, weights: Any) -> Any:
    qml.AngleEmbedding(inputs, wires=range(4), rotation="Y")
    qml.RandomLayers(weights, wires=range(4), seed=3)
    return z()


def qaoa(inputs: Any, weights: Any) -> Any:
    qml.QAOAEmbedding(inputs, weights, wires=range(4))
    return qml.expval(qml.Z(0)), qml.expval(qml.Z(3))


def design(inputs: Any, initial: Any, weights: Any) -> Any:
    qml.AngleEmbedding(np.arctan(inputs), wires=range(4))
    qml.SimplifiedTwoDesign(initial, weights, wires=range(4))
    return z()


def arbitrary(inputs: Any, weights: Any) -> Any:
    qml.AngleEmbedding(inputs, wires=range(4))
    qml.ArbitraryUnitary(weights, wires=[0, 1])
    qml.CNOT(wires=[1, 3])
    return z()


def fabric(inputs: Any, weights: Any) -> Any:
    qml.AngleEmbedding(inputs, wires=range(4))
    qml.GateFabric(weights, wires=range(4), init_state=np.array([0, 0, 1, 1]))
    return z()


def tree(inputs: Any, weights: Any) -> Any:
    def block(weights: Any, wires: Any) -> None:
        qml.CNOT(wires=wires)
        qml.CRX(weights[0], wires=wires)
        qml.RY(weights[1], wires=wires[1])

    qml.AngleEmbedding(inputs, wires=range(4))
    qml.TTN(range(4), 2, block, 2, weights)
    return qml.expval(qml.Z(3))


def conserving(inputs: Any, weights: Any) -> Any:
    qml.AngleEmbedding(inputs, wires=range(4))
    qml.ParticleConservingU1(weights, wires=range(4), init_state=np.array([0, 0, 1, 1]))
    return z()


def gates(inputs: Any, weights: Any, scale: Any) -> Any:
    """Every gate that is translated, and some that are decomposed."""
    for wire in range(4):
        qml.RX(scale * inputs[wire] + weights[0], wires=wire)
    qml.RY((np.pi - inputs[0]) * (np.pi - inputs[5]), wires=0)
    qml.RZ(np.sin(inputs[1] / 2) ** 2 * scale + weights[1] + 1, wires=0)
    qml.U3(weights[0], inputs[3], weights[2], wires=1)
    qml.ctrl(qml.U3, control=2)(*weights, wires=0)
    qml.CRot(*weights, wires=[3, 1])
    for axis in (
        qml.IsingXX,
        qml.IsingYY,
        qml.IsingZZ,
        qml.IsingXY,
        qml.SingleExcitation,
        qml.CPhase,
        qml.CRZ,
    ):
        axis(weights[1], wires=[1, 2])
    qml.IsingZZ(inputs[0] * inputs[4], wires=[0, 1])
    for fixed in (qml.S, qml.T, qml.X, qml.Y, qml.Z, qml.SX, qml.Hadamard):
        fixed(wires=2)
        qml.adjoint(fixed)(wires=3)
        qml.ctrl(fixed, control=0)(wires=1)
    qml.PhaseShift(-weights[2] / 3, wires=1)
    qml.U2(weights[0], inputs[0], wires=0)
    qml.DoubleExcitation(weights[1], wires=range(4))
    qml.PauliRot(weights[0], "XYZ", wires=[0, 2, 3])
    qml.Toffoli(wires=[0, 1, 3])
    qml.QFT(wires=[1, 2])
    qml.Barrier(wires=range(4))
    return z()


FIXED: list[tuple[Any, dict[str, Any]]] = [
    (strongly, {"weights": qml.StronglyEntanglingLayers.shape}),
    (basic, {"weights": qml.BasicEntanglerLayers.shape}),
    (random, {"weights": (2, 5)}),
    (qaoa, {"weights": qml.QAOAEmbedding.shape}),
    (
        design,
        {"initial": lambda qubits: (qubits,), "weights": lambda qubits, layers: (layers, qubits - 1, 2)},
    ),
    (arbitrary, {"weights": qml.ArbitraryUnitary.shape(2)}),
    (fabric, {"weights": (2, 1, 2)}),
    (tree, {"weights": (3, 2)}),
    (conserving, {"weights": (2, 3, 2)}),
    (gates, {"weights": (3,), "scale": 1}),
]


@pytest.mark.parametrize(("function", "shapes"), FIXED, ids=lambda each: getattr(each, "__name__", ""))
def test_values_and_gradients_are_those_of_pennylane(
    function: Any, shapes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "weight_shapes", shapes)
    circuit = trace(function, 4, 2 if any(map(callable, shapes.values())) else 1)
    source = torch.Generator().manual_seed(0)
    x = (2 * torch.rand(circuit.inputs, generator=source, dtype=torch.float64) - 1).requires_grad_()
    weights = {
        name: (6 * torch.rand(p.shape, generator=source, dtype=torch.float64)).requires_grad_()
        for name, p in circuit.parameters.items()
    }
    ours = expectations(circuit, x[None], weights)[0]
    shown = {name: value[0] if shapes[name] == 1 else value for name, value in weights.items()}
    with monkeypatch.context() as patched:
        patched.setattr(np, "arctan", torch.arctan)  # the embedding of torch's numbers
        patched.setattr(np, "sin", torch.sin)
        theirs = qml.QNode(function, qml.device("default.qubit", wires=4))(x, **shown)
    theirs = torch.stack(theirs) if isinstance(theirs, list | tuple) else theirs[None]
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-10)
    weighted = torch.linspace(0.5, 1.5, len(ours), dtype=torch.float64)
    leaves = [x, *weights.values()]
    gradients = [torch.autograd.grad((each * weighted).sum(), leaves) for each in (ours, theirs)]
    for mine, other in zip(*gradients):
        torch.testing.assert_close(mine, other, rtol=0, atol=1e-10)
    assert any(float(each.abs().max()) > 0.01 for each in gradients[0])
    layer = qrlsuite.layer(function, 4, 2 if any(map(callable, shapes.values())) else 1)
    assert layer.description.operations == circuit.operations


def test_the_function_on_the_page_is_an_ansatz_of_every_size(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "your-circuit.md").read_text()
    file = tmp_path / "mine.py"
    file.write_text("# swirl.py" + page.partition("# swirl.py")[2].partition("```")[0])
    own.load(file)
    for qubits, layers in ((1, 1), (2, 1), (4, 3)):
        circuit = ansatz("swirl", qubits, layers)
        assert circuit.inputs == qubits
        assert circuit.parameters["weights"].shape == (layers, qubits, 3)


HEAD = """import dataclasses
import math
import numpy as np
import pennylane as qml

weight_shapes = {{"{name}": (3,)}}


@qml.qnode(qml.device("default.qubit", wires=2))
def swirl(x, weights, turns: int = 1):
    for _ in range(turns):
        qml.RX(np.arctan(x[0]), wires=0)
        qml.RY(weights[0] * x[2], wires=1)
    {line}
    return {returned}
"""


def plugin(
    folder: Path, line: str = "", returned: str = "qml.expval(qml.Z(0) @ qml.Z(1))", name: str = "weights"
) -> Path:
    file = folder / "mine.py"
    file.write_text(HEAD.format(name=name, line=line, returned=returned))
    return file


def test_a_qnode_in_a_file_is_an_ansatz_of_its_own_size(tmp_path: Path) -> None:
    own.load(plugin(tmp_path, line="qml.IsingZZ(x[0] * weights[1], wires=[0, 1])"))
    circuit = ansatz("swirl", 2, 1, turns=2)
    assert (circuit.qubits, circuit.inputs, circuit.parameter_count, len(circuit)) == (2, 3, 3, 7)
    assert circuit.observables == ((0, 1),)
    assert ansatz("swirl", 2, 1, entangled="mean-field").mean_field
    entry = resolve("beam6g", "vqc-native ansatz=swirl turns=2")
    assert entry.label == "ddqn vqc-native qubits=2 layers=1 ansatz=swirl turns=2"
    assert resolve("beam6g", entry.label).hash == entry.hash
    with pytest.raises(OptionError, match="qubits = 3: 'swirl' has 2 wires: set qubits=2"):
        ansatz("swirl", 3, 1)
    with pytest.raises(
        OptionError, match="layers = 2: the layers of 'swirl' are in the numbers of weight_shapes"
    ):
        ansatz("swirl", 2, 2)


FORMS = """
@dataclasses.dataclass
class Options:
    turns: int = 1


def chosen(inputs, weights, options: Options = Options()):
    for _ in range(options.turns):
        embed(inputs, range(3))
    return qml.expval(qml.Z(0))


def embed(inputs, wires):
    qml.AngleEmbedding(inputs, wires=wires)


def block(inputs):
    embed(inputs, ["a", "b", "c"])


@qml.qnode(qml.device("default.qubit"))
def behind(weights, inputs, **others):
    embed(inputs, range(3))
    return qml.expval(qml.Z(0))


def bare(inputs, weights):
    embed(inputs, range(3))
    return qml.expval(qml.Z(0))


def named(x, weights):
    block(x)
    return qml.expval(qml.Z("c"))


wired = qml.QNode(named, qml.device("default.qubit", wires=["c", "b", "a"]))


def make(count):
    @qml.qnode(qml.device("default.qubit", wires=3))
    def reads(inputs, weights):
        for k in range(count):
            qml.RX(inputs[k], wires=k % 3)
        return qml.expval(qml.Z(0))

    return reads


reads = make(30)
"""


def test_each_way_to_write_a_quantum_function_and_its_helpers(tmp_path: Path) -> None:
    file = plugin(tmp_path)
    file.write_text(file.read_text() + FORMS)
    own.load(file)
    circuits = {name: ansatz(name, 3, 1) for name in ("behind", "bare", "reads")}
    assert [(each.qubits, each.inputs) for each in circuits.values()] == [(3, 3), (3, 3), (3, 30)]
    assert len(ansatz("chosen", 3, 1, turns=2)) == 6
    assert ansatz("named", 3, 1).inputs == 3
    assert ansatz("named", 3, 1).observables == (0,)
    for helper in ("embed", "block", "wired"):
        with pytest.raises(UnknownNameError):
            ansatz(helper, 3, 1)


@pytest.mark.parametrize("given", [42, len, [1]])
def test_a_layer_of_no_circuit(given: Any) -> None:
    with pytest.raises(OptionError, match="give the name of an ansatz, a Circuit, or a QNode"):
        qrlsuite.layer(given)


@pytest.mark.parametrize("shape", ["(2, 3)", (0.5,), lambda a, b: (a, b)])
def test_a_shape_that_is_none_says_how_one_is_written(shape: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "weight_shapes", {"weights": shape})
    with pytest.raises(CircuitError, match=r"weight_shapes: 'weights': .*; write whole numbers, such as"):
        trace(basic, 4, 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"line": "qml.RX(weights[0] * weights[1], wires=0)"},
            "products of parameters: .*own .*line 14: qml.RX",
        ),
        (
            {"line": "qml.RX(np.tanh(weights[0]), wires=0)"},
            "tanh of a parameter: functions take inputs alone",
        ),
        ({"line": "qml.RX(math.atan(x[0]), wires=0)"}, r"np.arctan\(x\), not math.atan.* \(mine.py, line 14"),
        (
            {"line": "qml.measure(0, postselect=1)"},
            "[Pp]ostselect.*no run may be thrown away",
        ),
        ({"line": "qml.RX(x[:, 0], wires=0)"}, "too many indices .*symbols for one sample"),
        ({"line": "qml.RX(x, wires=0)"}, "RX cannot be taken: an array is its angle.*line 14"),
        ({"line": "x[0] > 0 and qml.X(0)"}, "'>' not supported .*let no gate or shape depend on a value"),
        (
            {"line": "qml.DepolarizingChannel(0.1, wires=0)"},
            "DepolarizingChannel cannot be taken: .*line 14",
        ),
        ({"line": "qml.X(2)"}, "'swirl' uses the wire 2, which its device does not have"),
        (
            {"line": "qml.RX(x[0] - weights[1], wires=0)"},
            r"without numbers before it.* RX\(a\), RX\(b\).*line 14",
        ),
        (
            {"line": "qml.IsingXY(x[0] + weights[0], wires=[0, 1])"},
            "a sum of an input and a parameter cannot.*line 14",
        ),
        (
            {"line": "qml.RX(weights[5], wires=0)"},
            "no circuit of this size: index 2 is out of bounds for axis 0 with size 2 .*line 13",
        ),
        ({"returned": "qml.probs(wires=0)"}, "return expval of Z, X, Y or products"),
        ({"returned": "qml.expval(qml.Z(0) + qml.Z(1))"}, "of a sum return the terms"),
        ({"name": "other"}, "the shape of 'weights' is not known; write .* weight_shapes = "),
    ],
)
def test_what_cannot_be_taken_is_named_with_the_line(
    tmp_path: Path, changes: dict[str, str], message: str
) -> None:
    with pytest.raises(PluginError, match=message):
        own.load(plugin(tmp_path, **changes))
