"""Ansaetze: functions (qubits, layers, options) -> `Circuit`.

`iqp`, `cx` and `cz` are the paper's structures. After H on every qubit, layer l applies for every qubit q, in
order, a variational gate with angles `scaling[l, q, k] * input[q] + weights[l, q, k]`, k = 0, 1, 2 (the gate and
the inputs are re-uploaded in every layer), and then, after every layer but the last, a static part.

Rings are closed: qubit q is followed by (q + 1) mod n. On two qubits the ring of `iqp`, `cx` and `cz` therefore
consists of both (0, 1) and (1, 0), as the definition says; on one qubit there is no neighbor: `cx` and `cz` then
have no entangling gate, and `iqp`, all of whose gates are controlled, is refused.

The option `entangled` takes the coupling of the qubits out, to see its contribution: `separable` has no gate on two
qubits; `mean-field` has the same gates, and drops all correlations after every gate on two qubits
(`Circuit.mean_field`). Separable circuits of the paper have the gate of qubit q on q, and H on every qubit between
layers, the same for all three structures: without the H, neighboring RZ of `rot` would merge.

The other ansatzes are from other papers. If a paper leaves the scale of its inputs to a function before the circuit,
the scale is the model's here, too: its linear layer, or the task.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.circuit.description import Circuit, Parameter
from qrlsuite.errors import OptionError
from qrlsuite.options import Since

GateName = Literal["rot", "xyz", "u3"]
Entangled = Annotated[
    Literal[True, "separable", "mean-field"],
    Field(
        description="true: as defined; separable: no gate on two qubits; mean-field: the same gates, correlations "
        "dropped after each (not a circuit: native backend alone)"
    ),
]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class GateOptions:
    """Options of `iqp`, `cx` and `cz`."""

    gate: Annotated[
        GateName,
        Field(
            description="variational gate: rot = RZ RY RZ, xyz = RX then RY then RZ, u3 = U3(theta, phi, delta)"
        ),
    ] = "rot"
    entangled: Annotated[Entangled, Since("0.2.0")] = True


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NoOptions:
    """An ansatz without options."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class EntangledOptions:
    """Options of `jerbi`."""

    entangled: Entangled = True


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SkolikOptions:
    """Options of `skolik`."""

    entangled: Annotated[Entangled, Since("0.2.0")] = True


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class HsiaoOptions:
    """Options of `hsiao`."""

    encoding: Annotated[
        Literal["multi", "single"],
        Field(description="multi: three features, all on every qubit; single: one feature a qubit"),
    ] = "multi"
    entangled: Annotated[
        Literal[True, "separable", "mean-field"],
        Field(
            description="separable: as defined; true: a ring of CNOTs behind every layer; mean-field: with it, "
            "correlations dropped after each CNOT (not a circuit: native backend alone)"
        ),
    ] = "separable"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PerezSalinasOptions:
    """Options of `perez-salinas`."""

    inputs: Annotated[
        int,
        Field(ge=1, le=96, description="features, all on every qubit; a layer has a gate for every three"),
    ] = 3
    entangled: Entangled = True


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class WangOptions:
    """Options of `wang`."""

    coupling: Annotated[
        Literal["cz", "zz", "ghz", "graph"],
        Field(
            description="cz, zz: a ring of CZs, or of ZZ rotations with trained angles, behind every layer; "
            "ghz, graph: an entangled state before the layers, undone behind them"
        ),
    ] = "cz"
    edges: Annotated[
        str, Field(description="of the graph state: ring, or pairs of qubits such as '0-1 1-2'")
    ] = "ring"
    entangled: Entangled = True


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BasicOptions:
    """Options of `basic`."""

    encoding: Annotated[
        Literal["angle", "basis"],
        Field(
            description="angle: each input is an angle; basis: inputs are bits, and prepare a basis state. "
            "(Amplitude encoding has angles that are not affine in the inputs.)"
        ),
    ] = "angle"
    entangled: Entangled = True


def iqp(qubits: int, layers: int, options: GateOptions) -> Circuit:
    """Build the ring of controlled gates: control q, target (q + 1) mod n; static part: H on every qubit."""
    if qubits == 1 and options.entangled != "separable":
        raise OptionError(
            "ansatz 'iqp' with 1 qubit: its gates are controlled by another qubit, so it needs 2 to 20; "
            "'cx' and 'cz' exist for 1 qubit"
        )

    return _reuploading(qubits, layers, options, _hadamards, controlled=True)


def cx(qubits: int, layers: int, options: GateOptions) -> Circuit:
    """Build gates on every qubit; static part: the ring CNOT(q, (q + 1) mod n) for q in order."""
    return _reuploading(qubits, layers, options, lambda circuit: _ring(circuit, "CNOT"), controlled=False)


def cz(qubits: int, layers: int, options: GateOptions) -> Circuit:
    """Build gates on every qubit; static part: the ring CZ(q, (q + 1) mod n) for q in order."""
    return _reuploading(qubits, layers, options, lambda circuit: _ring(circuit, "CZ"), controlled=False)


def skolik(qubits: int, layers: int, options: SkolikOptions) -> Circuit:
    """Build the data re-uploading circuit for Q-learning of Skolik, Jerbi & Dunjko (Quantum 6, 720, 2022).

    Every layer: RX(scaling[l, q] * input[q]), then RY(weights[l, q, 0]) and RZ(weights[l, q, 1]) on every qubit,
    then a closed ring of CZs (on two qubits, where both CZs would cancel, a single one). The scalings start
    at 1, the weights uniform in [0, 2 pi). The paper's last layer of rotations after the last encoding is
    this layer's own.
    """
    circuit = _begun(qubits, options.entangled)
    scaling = circuit.parameter("scaling", (layers, qubits), low=1.0, high=1.0)
    weights = circuit.parameter("weights", (layers, qubits, 2))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, scaling[layer, q] * circuit.input(q))
            circuit.append("RY", q, weights[layer, q, 0])
            circuit.append("RZ", q, weights[layer, q, 1])
        if options.entangled != "separable":
            _ring_once(circuit, "CZ")
    return circuit


def jerbi(qubits: int, layers: int, options: EntangledOptions) -> Circuit:
    """Build the policy circuit of Jerbi, Gyurik, Marshall, Briegel & Dunjko (2021, arXiv:2103.05577).

    After the tutorial "Parametrized Quantum Circuits for Reinforcement Learning" of TensorFlow Quantum, which holds it.
    Every layer: RX, RY and RZ of `weights` on every qubit, a closed ring of CZs (on two qubits a single one), then
    RX(scaling[l, q] * input[q]). Behind the last layer come RX, RY and RZ once more. The scalings start at 1, the
    weights uniform in [0, pi). The authors measure the product of all Z, and multiply it by a trained weight for each
    action: `readout=product` of a hybrid model.
    """
    circuit = _begun(qubits, options.entangled)
    scaling = circuit.parameter("scaling", (layers, qubits), low=1.0, high=1.0)
    weights = circuit.parameter("weights", (layers + 1, qubits, 3), high=math.pi)
    for layer in range(layers + 1):
        for q in range(qubits):
            if layer > 0:
                circuit.append("RX", q, scaling[layer - 1, q] * circuit.input(q))
            for k, gate in enumerate(("RX", "RY", "RZ")):
                circuit.append(gate, q, weights[layer, q, k])
        if layer < layers and options.entangled != "separable":
            _ring_once(circuit, "CZ")
    return circuit


def hsiao(qubits: int, layers: int, options: HsiaoOptions) -> Circuit:
    """Build the circuit without entanglement of Hsiao, Du, Chiang, Hsieh & Goan (2022, arXiv:2203.14348).

    After SimplyQRL (`build_hsiao_qlayer`), which holds it; of the paper the abstract was read. H on every qubit, then
    in every layer the encoding and RX(weights[l, q]). The encoding is RZ(input[0]), RY(input[1]), RZ(input[2]) on every
    qubit, or with `encoding = "single"` RZ(input[q]) and RY(input[q]). The ring of CNOTs behind every layer, with
    `entangled = true`, is SimplyQRL's.
    """
    multi = options.encoding == "multi"
    circuit = _begun(qubits, options.entangled, inputs=3 if multi else None)
    weights = circuit.parameter("weights", (layers, qubits))
    _hadamards(circuit)
    for layer in range(layers):
        for q in range(qubits):
            features = (0, 1, 2) if multi else (q, q)
            for gate, feature in zip(("RZ", "RY", "RZ"), features):
                circuit.append(gate, q, circuit.input(feature))
            circuit.append("RX", q, weights[layer, q])
        if options.entangled != "separable":
            _ring(circuit, "CNOT")
    return circuit


def perez_salinas(qubits: int, layers: int, options: PerezSalinasOptions) -> Circuit:
    """Build the re-uploading circuit of Perez-Salinas, Cervera-Lierta, Gil-Fuster & Latorre (Quantum 4, 226, 2020).

    After the authors' code (`universal_qlassifier`). In every layer each qubit has U3 gates with the angles
    `scaling * input + weights`, of at most three features each: the features are divided evenly among as few gates as
    possible. Between layers CZs join the qubits (0, 1), (2, 3), ... and (1, 2), (3, 4), ... by turns, the last and the
    first among the latter where their number is even: the authors' circuits of 1, 2 and 4 qubits. All parameters start
    uniform in [0, 1).

    The authors' gate turns about z the other way round: the state is the complex conjugate, with the same <Z>. They
    read the fidelities of label states from it.
    """
    inputs = options.inputs
    if layers == 1 and inputs > 1:
        raise OptionError(
            f"ansatz 'perez-salinas' with 1 layer and {inputs} inputs: the expectation values do not depend on all of "
            "them; it needs 2 layers or more"
        )
    gates = -(-inputs // 3)
    circuit = _begun(qubits, options.entangled, inputs)
    scaling = circuit.parameter("scaling", (layers, qubits, inputs), high=1.0)
    weights = circuit.parameter("weights", (layers, qubits, gates, 3), high=1.0)
    for layer in range(layers):
        for q in range(qubits):
            feature = 0
            for g in range(gates):
                angles = [weights[layer, q, g, k] for k in range(3)]
                for k in range(inputs // gates + (g < inputs % gates)):
                    angles[k] = scaling[layer, q, feature] * circuit.input(feature) + angles[k]
                    feature += 1
                circuit.append("U3", q, *angles)
        if layer < layers - 1 and options.entangled != "separable":
            closed = qubits if layer % 2 and qubits % 2 == 0 else qubits - 1
            for q in range(layer % 2, closed, 2):
                circuit.append("CZ", (q, (q + 1) % qubits))
    return circuit


def wang(qubits: int, layers: int, options: WangOptions) -> Circuit:
    """Build the circuits of Wang, Hymas & Quach (2026, arXiv:2603.10289) for Pong, after their code (`QRL-Pong`).

    Every layer has U3 on every qubit with angles `scaling * input[q] + weights`, then a closed ring of CZs, or with
    `coupling = "zz"` of ZZ rotations with trained angles (on two qubits a single gate). X of every qubit is measured:
    an H stands before each measurement of Z. `coupling = "ghz"` and "graph" are the circuits of an earlier version
    (`VQCBackbones2.py`), without the rings and the H: a GHZ state (H on qubit 0, and CNOTs from it to every other) or a
    graph state (H on every qubit, a CZ for every edge) is prepared, and undone behind the layers. Separable is the
    circuit without the rings or the state, as in the authors' code. All parameters start uniform in [0, 1).

    Only the paper's abstract was read, and an earlier version of its code: that X is measured follows from the names of
    its runs (`XObs`), and the first angles of ZZ are a guess. Their inputs are multiplied by 2 pi:
    `init_scale=6.283185307`. Their GHZ state begins at qubit 1 of 8, and they measured three qubits then.
    """
    circuit = _begun(qubits, options.entangled)
    scaling = circuit.parameter("scaling", (layers, qubits, 3), high=1.0)
    weights = circuit.parameter("weights", (layers, qubits, 3), high=1.0)
    edges = _edges(qubits, options)
    if options.entangled == "separable":
        edges = []
    rings = options.coupling in ("cz", "zz")
    ring, state = (edges, []) if rings else ([], edges)
    gate, first = ("CNOT", 1) if options.coupling == "ghz" else ("CZ", qubits)
    trained = options.coupling == "zz" and len(ring) > 0
    zz = circuit.parameter("zz", (layers, len(ring)), high=1.0) if trained else None
    if state:
        _hadamards(circuit, first)
    for edge in state:
        circuit.append(gate, edge)
    for layer in range(layers):
        for q in range(qubits):
            angles = [scaling[layer, q, k] * circuit.input(q) + weights[layer, q, k] for k in range(3)]
            circuit.append("U3", q, *angles)
        for k, edge in enumerate(ring):
            if zz is None:
                circuit.append("CZ", edge)
            else:
                circuit.append("RZZ", edge, zz[layer, k])
    for edge in reversed(state):
        circuit.append(gate, edge)
    if state or rings:
        _hadamards(circuit, first)
    return circuit


def basic(qubits: int, layers: int, options: BasicOptions) -> Circuit:
    """Build the circuit of SimplyQRL that encodes its inputs once (Lazaro, Vazquez & Bringas 2025, arXiv:2511.17112).

    After its function `build_basic_qlayer`. RX(input[q]) on every qubit, or with `encoding = "basis"` RX(pi input[q]),
    which makes 1 of a bit 1; then in every layer RX(weights[l, q]) and a closed ring of CNOTs (on two qubits a single
    one). With `linear = false` of a hybrid model the bits are the observation. All rotations are about X, also behind
    CNOTs: they commute.
    """
    circuit = _begun(qubits, options.entangled)
    weights = circuit.parameter("weights", (layers, qubits))
    factor = math.pi if options.encoding == "basis" else 1.0
    for q in range(qubits):
        circuit.append("RX", q, factor * circuit.input(q))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, weights[layer, q])
        if options.entangled != "separable":
            _ring_once(circuit, "CNOT")
    return circuit


def _begun(qubits: int, entangled: str | bool, inputs: int | None = None) -> Circuit:
    """Return an empty circuit, or one whose correlations are dropped."""
    return Circuit(qubits, inputs, mean_field=entangled == "mean-field")


def _edges(qubits: int, options: WangOptions) -> list[tuple[int, int]]:
    """Return the pairs of qubits that the gates of `wang` join."""
    if options.coupling != "graph" and options.edges != "ring":
        raise OptionError(f"edges = '{options.edges}': only a graph state has them; set coupling=graph")
    if options.coupling == "ghz":
        return [(0, q) for q in range(1, qubits)]
    if options.edges == "ring":
        return _ring_edges(qubits)
    words = options.edges.replace(",", " ").split()
    found = [re.fullmatch(r"(\d{1,4})-(\d{1,4})", word) for word in words]
    pairs = [(int(each[1]), int(each[2])) for each in found if each]
    if (
        not words
        or len(pairs) < len(words)
        or any(a == b or max(a, b) >= qubits for a, b in pairs)
        or len({frozenset(pair) for pair in pairs}) < len(pairs)
    ):
        raise OptionError(
            f"edges = '{options.edges}': write ring, or distinct pairs of qubits 0..{qubits - 1} such as '0-1 1-2'"
        )
    return pairs


def _reuploading(
    qubits: int, layers: int, options: GateOptions, static: Callable[[Circuit], None], controlled: bool
) -> Circuit:
    """Build H on every qubit, then `layers` times the gates, with the static part between layers."""
    if options.entangled == "separable":
        static, controlled = _hadamards, False
    circuit = _begun(qubits, options.entangled)
    scaling = circuit.parameter("scaling", (layers, qubits, 3))
    weights = circuit.parameter("weights", (layers, qubits, 3))
    _hadamards(circuit)
    for layer in range(layers):
        for q in range(qubits):
            _variational(circuit, options.gate, layer, q, scaling, weights, controlled)
        if layer < layers - 1:
            static(circuit)
    return circuit


def _variational(
    circuit: Circuit,
    gate: GateName,
    layer: int,
    q: int,
    scaling: Parameter,
    weights: Parameter,
    controlled: bool,
) -> None:
    """Append the gate of qubit q: on q itself, or controlled by q on its neighbor."""
    angles = [scaling[layer, q, k] * circuit.input(q) + weights[layer, q, k] for k in range(3)]
    target, control = ((q + 1) % circuit.qubits, q) if controlled else (q, None)
    if gate == "xyz":
        for name, angle in zip(("RX", "RY", "RZ"), angles):
            circuit.append(name, target, angle, control=control)
    else:
        circuit.append({"rot": "Rot", "u3": "U3"}[gate], target, *angles, control=control)


def _hadamards(circuit: Circuit, count: int | None = None) -> None:
    """Append H on every qubit, or on the first `count`."""
    for q in range(circuit.qubits if count is None else count):
        circuit.append("H", q)


def _ring(circuit: Circuit, gate: str) -> None:
    """Append a two-qubit gate on every (q, (q + 1) mod n), in order; nothing on a single qubit."""
    if circuit.qubits > 1:
        for q in range(circuit.qubits):
            circuit.append(gate, (q, (q + 1) % circuit.qubits))


def _ring_once(circuit: Circuit, gate: str) -> None:
    """Append a ring that on two qubits is a single gate."""
    for pair in _ring_edges(circuit.qubits):
        circuit.append(gate, pair)


def _ring_edges(qubits: int) -> list[tuple[int, int]]:
    """Return the pairs of a closed ring, each once."""
    return [(0, 1)] if qubits == 2 else [(q, (q + 1) % qubits) for q in range(qubits) if qubits > 1]
