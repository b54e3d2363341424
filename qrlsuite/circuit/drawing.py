"""Drawings of circuits: text (laid out by Qiskit) and a figure (by PennyLane's matplotlib drawer).

Angles are written as in the circuit's definition: `scaling[5]*x0 + weights[5]`, with the index into the flattened
parameter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qrlsuite.circuit.description import Angle, Circuit, Encoding, Operation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The drawer writes into the options that it is given, hence a copy for each call.
INK = {"color": "black"}
BOX = {"facecolor": "white", "edgecolor": "black"}


def angle_text(angle: Angle) -> str:
    """Write an angle as `constant + scale*input + weight`."""
    terms = angle.texts(
        lambda term: term.text(angle_text) if isinstance(term, Encoding) else f"x{term}",
        number="{:.4g}".format,
    )
    return " + ".join([*terms, *([f"{angle.constant:.4g}"] if angle.constant or not terms else [])])


def draw_text(circuit: Circuit, angles: bool = False) -> str:
    """Return a drawing in characters, one line per qubit and a few between them.

    Parameters
    ----------
    angles:
        Write every angle into its gate; otherwise gates carry their name alone.
    """
    return str(_qiskit(circuit, angles).draw("text", fold=-1, vertical_compression="high"))


def draw_figure(circuit: Circuit) -> Figure:
    """Return a matplotlib figure, drawn without pyplot; `figure.savefig(path)` writes it.

    Angles are left out, they do not fit into boxes; `draw_text(circuit, angles=True)` writes them.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from pennylane.drawer import MPLDrawer

    columns = _columns(circuit)
    figure = Figure()
    FigureCanvasAgg(figure)  # the drawer measures its texts with the canvas's renderer
    drawer = MPLDrawer(
        max(columns, default=0) + 1, {q: q for q in range(circuit.qubits)}, fig=figure, wire_options=dict(INK)
    )
    drawer.label([f"q{q}" for q in range(circuit.qubits)])
    for column, operation in zip(columns, circuit):
        if operation.gate == "CNOT":
            drawer.CNOT(column, operation.wires, options=dict(INK))
        elif operation.gate == "CZ":
            drawer.ctrl(column, list(operation.wires), options=dict(INK))
        elif operation.gate == "SWAP":
            drawer.SWAP(column, operation.wires, options=dict(INK))
        else:
            if operation.control is not None:
                drawer.ctrl(
                    column, [operation.control], wires_target=list(operation.wires), options=dict(INK)
                )
            drawer.box_gate(column, list(operation.wires), text=operation.gate, box_options=dict(BOX))
    return figure


def _columns(circuit: Circuit) -> list[int]:
    """Return the column of every gate: the first that is free on all wires that its drawing crosses."""
    free = [0] * circuit.qubits
    columns = []
    for operation in circuit:
        crossed = range(min(operation.qubits), max(operation.qubits) + 1)
        column = max(free[q] for q in crossed)
        columns.append(column)
        for q in crossed:
            free[q] = column + 1
    return columns


def _label(operation: Operation, angles: bool) -> str:
    """Return the text in a gate's box."""
    if not angles or not operation.angles:
        return operation.gate
    return f"{operation.gate}({', '.join(angle_text(angle) for angle in operation.angles)})"


def _qiskit(circuit: Circuit, angles: bool) -> Any:
    """Return a circuit of opaque gates, for drawing alone."""
    from qiskit.circuit import ControlledGate, Gate, QuantumCircuit

    drawn = QuantumCircuit(circuit.qubits)
    for operation in circuit:
        if not operation.angles:
            getattr(drawn, {"CNOT": "cx"}.get(operation.gate, operation.gate.lower()))(*operation.wires)
            continue
        label = _label(operation, angles)
        gate = Gate(label, 1, [], label=label)
        if operation.control is not None:
            gate = ControlledGate(f"c{label}", 2, [], num_ctrl_qubits=1, base_gate=gate, definition=None)
        drawn.append(gate, operation.qubits)
    return drawn
