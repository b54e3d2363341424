"""Circuits as text for others: OpenQASM 3, and programs that build them with Qiskit or PennyLane.

Inputs are `x`, parameters keep their names; every angle stays a formula. The order of qubits and the observables are
the description's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from qrlsuite.circuit.description import FUNCTIONS, Angle, Circuit, Element, Encoding, Operation
from qrlsuite.errors import OptionError, nearest

_QISKIT_FIXED = {"CNOT": "cx", "CZ": "cz", "SWAP": "swap"}
_PENNYLANE_FIXED = {"H": "Hadamard", "X": "PauliX", "Y": "PauliY", "Z": "PauliZ"}


def export(circuit: Circuit, format: str) -> str:
    """Write a circuit as text.

    Parameters
    ----------
    format:
        `qasm3`: OpenQASM 3 with every input and parameter as an `input`. `qiskit`: a Python program that makes a
        `QuantumCircuit` and its observables. `pennylane`: a Python program that makes a QNode.

    Raises
    ------
    OptionError
        For another format, or a mean-field approximation, which is no circuit.
    """
    if format not in FORMATS:
        raise OptionError(f"--format {format}: one of {', '.join(FORMATS)}{nearest(format, FORMATS)}")
    if circuit.mean_field:
        raise OptionError(f"--format {format}: the mean-field approximation of a circuit is none")
    return FORMATS[format](circuit)


def _formula(
    angle: Angle, feature: Callable[[int], str], element: Callable[[Element], str], functions: str = ""
) -> str:
    """Write an angle as a Python or QASM expression; functions of inputs have the prefix `functions`."""

    def factor(term: int | Encoding) -> str:
        if not isinstance(term, Encoding):
            return feature(term)
        if functions != "qml.math." and term.function in ("sinh", "cosh", "tanh", "sqrt"):
            raise OptionError(
                f"it has no function {term.function} of inputs: export the circuit as a pennylane program"
            )
        prefix = functions if term.function in FUNCTIONS else ""
        return prefix + term.text(lambda part: _formula(part, feature, element, functions))

    terms = angle.texts(factor, element, times=" * ")
    return " + ".join([*terms, *([repr(angle.constant)] if angle.constant or not terms else [])])


def _rotations(operation: Operation, angles: list[str]) -> Iterable[tuple[str, str]]:
    """Write a rotation as rotations about one axis, in order; with a control, each has it."""
    if operation.gate == "Rot":
        return zip(("rz", "ry", "rz"), angles)
    return [(operation.gate.lower(), angles[0])]


def _qiskit(circuit: Circuit) -> str:
    """Return a program that makes `circuit` and `observables`; parameters are flat, in C order."""
    lines = [
        "from qiskit import QuantumCircuit",
        "from qiskit.circuit import ParameterVector",
        "from qiskit.quantum_info import SparsePauliOp",
        "",
        f'x = ParameterVector("x", {circuit.inputs})',
    ]
    for name, parameter in circuit.parameters.items():
        lines.append(f'{name} = ParameterVector("{name}", {parameter.size})  # {_shape(parameter.shape)}')
    lines += ["", f"circuit = QuantumCircuit({circuit.qubits})"]
    for operation in circuit:
        angles = [_formula(a, lambda i: f"x[{i}]", str, "np.") for a in operation.angles]
        wires = ", ".join(map(str, operation.qubits))
        controlled = "" if operation.control is None else "c"
        if not angles:
            name = _QISKIT_FIXED.get(operation.gate, operation.gate.lower())
            lines.append(f"circuit.{name}({wires})")
        elif operation.gate == "U3":
            phase = ", 0" if controlled else ""
            lines.append(f"circuit.{controlled}u({', '.join(angles)}{phase}, {wires})")
        else:
            lines += [
                f"circuit.{controlled}{name}({a}, {wires})" for name, a in _rotations(operation, angles)
            ]
    lines += ["", "observables = ["]
    for qubits, axes in zip(circuit.measured, circuit.axes):
        term = f'("{axes}", {list(qubits)}, 1.0)'
        lines.append(f"    SparsePauliOp.from_sparse_list([{term}], {circuit.qubits}),")
    head = ["import numpy as np"] if any("np." in line for line in lines) else []
    return "\n".join([*head, *lines, "]"]) + "\n"


def _pennylane(circuit: Circuit) -> str:
    """Return a program that makes the QNode `circuit(x, ...)`; parameters have their shapes, and x may be a batch."""

    def element(e: Element) -> str:
        index = np.unravel_index(e.index, circuit.parameters[e.parameter].shape)
        return f"{e.parameter}[{', '.join(str(int(i)) for i in index)}]"

    shapes = [f"x {_shape((circuit.inputs,))} or (batch, {circuit.inputs})"]
    shapes += [f"{name} {_shape(parameter.shape)}" for name, parameter in circuit.parameters.items()]
    lines = [
        "import pennylane as qml",
        "",
        "",
        f'@qml.qnode(qml.device("default.qubit", wires={circuit.qubits}))',
        f"def circuit({', '.join(['x', *circuit.parameters])}):",
        f'    """Expectation values; {", ".join(shapes)}."""',
    ]
    for operation in circuit:
        angles = [_formula(a, lambda i: f"x[..., {i}]", element, "qml.math.") for a in operation.angles]
        name = _PENNYLANE_FIXED.get(operation.gate, operation.gate)
        wires = list(operation.wires)
        arguments = ", ".join([*angles, f"wires={wires[0] if len(wires) == 1 else wires}"])
        gate = f"qml.{name}"
        if operation.control is not None:
            gate = f"qml.ctrl({gate}, control={operation.control})"
        lines.append(f"    {gate}({arguments})")
    values = [
        " @ ".join(f"qml.{axis}({q})" for axis, q in zip(axes, qubits))
        for axes, qubits in zip(circuit.axes, circuit.measured)
    ]
    lines.append(f"    return [{', '.join(f'qml.expval({value})' for value in values)}]")
    return "\n".join(lines) + "\n"


def _qasm3(circuit: Circuit) -> str:
    """Return OpenQASM 3; input 3 is `x_3`, element (1, 0, 2) of `weights` is `weights_1_0_2`."""

    def element(e: Element) -> str:
        index = np.unravel_index(e.index, circuit.parameters[e.parameter].shape)
        return "_".join([e.parameter, *(str(int(i)) for i in index)])

    names = [f"x_{i}" for i in range(circuit.inputs)]
    for name, parameter in circuit.parameters.items():
        names += [element(Element(name, i)) for i in range(parameter.size)]
    products = [
        "*".join(f"{axis}_{q}" for axis, q in zip(axes, qubits))
        for axes, qubits in zip(circuit.axes, circuit.measured)
    ]
    lines = [
        "OPENQASM 3.0;",
        'include "stdgates.inc";',
        f"// observables: {', '.join(products)}",
        *(f"input float[64] {name};" for name in names),
        f"qubit[{circuit.qubits}] q;",
    ]
    for operation in circuit:
        angles = [_formula(a, lambda i: f"x_{i}", element) for a in operation.angles]
        wires = ", ".join(f"q[{wire}]" for wire in operation.qubits)
        controlled = "" if operation.control is None else "c"
        if not angles:
            lines.append(f"{_QISKIT_FIXED.get(operation.gate, operation.gate.lower())} {wires};")
        elif operation.gate == "U3":
            phase = ", 0" if controlled else ""
            name = "cu" if controlled else "u3"
            lines.append(f"{name}({', '.join(angles)}{phase}) {wires};")
        else:
            lines += [f"{controlled}{name}({a}) {wires};" for name, a in _rotations(operation, angles)]
    return "\n".join(lines) + "\n"


def _shape(shape: tuple[int, ...]) -> str:
    return f"of shape ({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


FORMATS: dict[str, Callable[[Circuit], str]] = {"qasm3": _qasm3, "qiskit": _qiskit, "pennylane": _pennylane}
"""Formats of `export`."""
