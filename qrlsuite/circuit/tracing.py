"""Quantum functions and QNodes of PennyLane as circuits: run once, with angles in the place of numbers.

    >>> weight_shapes = {"weights": qml.StronglyEntanglingLayers.shape}
    >>> def swirl(inputs, weights):
    ...     qml.AngleEmbedding(np.arctan(inputs), wires=range(len(inputs)))
    ...     qml.StronglyEntanglingLayers(weights, wires=range(len(inputs)))
    ...     return [qml.expval(qml.Z(wire)) for wire in range(len(inputs))]
    >>> trace(swirl, qubits=4, layers=2)

PennyLane decomposes the gates that a `Circuit` does not have.
"""

from __future__ import annotations

import inspect
import linecache
import math
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite.circuit.description import FUNCTIONS, Angle, Circuit, Parameter
from qrlsuite.errors import CircuitError, OptionError, QrlSuiteError
from qrlsuite.shortforms import SHAPES, has_one_size, shapes_of, source_of

MOST_INPUTS = 64
MORE_INPUTS = 9
"""How many numbers of inputs are tried, from one per qubit on."""

GATES: dict[str, tuple[str, bool]] = {
    **{name: (name, False) for name in ("RX", "RY", "RZ", "Rot", "U3", "S", "T", "CNOT", "CZ", "SWAP")},
    **{f"C{name}": (name, True) for name in ("RX", "RY", "RZ", "Rot", "(U3)", "(S)", "(T)", "Y", "H")},
    **{f"Ising{axis}": (f"R{axis}", False) for axis in ("XX", "YY", "ZZ")},
    **{f"Pauli{axis}": (axis, False) for axis in "XYZ"},
    "Hadamard": ("H", False),
    "PhaseShift": ("RZ", False),
}
"""The gate of each of PennyLane's operators, and whether its first wire controls it; phases of states are dropped."""

PHASES = ("Identity", "GlobalPhase", "Barrier", "Snapshot")
"""Operators that change no expectation value."""


def trace(
    function: Any,
    qubits: int | None = None,
    layers: int = 1,
    call: Callable[..., Any] | None = None,
    mean_field: bool = False,
) -> Circuit:
    """Return the circuit of a quantum function `(inputs, weights...)`.

    Parameters
    ----------
    function:
        The QNode, or the function.
    qubits, layers:
        Size of the circuit, which the shapes in `weight_shapes` may depend on; None for as many as the function has.
    call:
        What is called in its place, with options of its own.
    mean_field:
        Return the mean-field approximation.

    Raises
    ------
    OptionError
        For a size that the function does not have.
    CircuitError
        For an angle, gate or measurement that a `Circuit` cannot have.
    """
    name = source_of(function).__name__
    shapes = shapes_of(function)
    if has_one_size(function) and layers != 1:
        raise OptionError(
            f"layers = {layers}: the layers of '{name}' are in the numbers of {SHAPES}: set layers=1, or write there "
            "a function of qubits and layers"
        )
    wires = list(getattr(getattr(function, "device", None), "wires", None) or ())
    size = {"qubits": qubits, "n_wires": qubits, "layers": layers, "n_layers": layers}
    draft = Circuit(1, MOST_INPUTS)
    weights: dict[str, Any] = {}
    for each, shape in shapes.items():
        numbers = (
            shape(**{k: size[k] for k in inspect.signature(shape).parameters if k in size})
            if callable(shape)
            else shape
        )
        whole = tuple(numbers) if isinstance(numbers, Iterable) else () if numbers == 1 else (numbers,)
        weights[each] = _array(draft.parameter(each, tuple(map(int, whole)) or (1,)), whole)
    count = qubits or len(wires) or 1
    operations, results = _run(call or source_of(function), source_of(function), draft, count, weights)
    words = [_word(each, name) for each in results]
    used = {wire for operation, _ in operations for wire in operation.wires}.union(*words)
    labels = wires or (
        list(range(max(used) + 1)) if all(isinstance(wire, int) for wire in used) else sorted(used)
    )
    if strange := used.difference(labels):
        raise CircuitError(
            f"'{name}' uses the wire {min(strange, key=str)!r}, which its device does not have"
        )
    if qubits not in (None, len(labels)):
        raise OptionError(f"qubits = {qubits}: '{name}' has {len(labels)} wires: set qubits={len(labels)}")
    circuit = Circuit(len(labels), MOST_INPUTS, mean_field)
    circuit.parameters = draft.parameters
    place = {label: k for k, label in enumerate(labels)}
    for operation, line in operations:
        try:
            _append(circuit, operation, place)
        except QrlSuiteError as error:
            raise CircuitError(f"{error}{line}") from None
    circuit.inputs = 1 + max(
        (k for operation in circuit for a in operation.angles for k in a.inputs), default=0
    )
    circuit.measure([" ".join(f"{axis}{place[wire]}" for wire, axis in word.items()) for word in words])
    return circuit


def _array(parameter: Parameter, shape: tuple[int, ...]) -> Any:
    """Return a parameter's angles as an array of numpy; a single one for the shape ()."""
    if not shape:
        return parameter[0]
    angles = np.empty(shape, dtype=object)
    for index in np.ndindex(shape):
        angles[index] = parameter[tuple(index)]
    return angles


def _line(file: str, frames: Iterable[tuple[Any, int]]) -> str:
    """Return the innermost line of a file among frames, for the end of a message; empty where there is none."""
    number = next((line for frame, line in frames if frame.f_code.co_filename == file), None)
    text = "" if number is None else linecache.getline(file, number).strip()
    return f" ({Path(file).name}, line {number}: {text})" if text else ""


def _run(
    call: Callable[..., Any], source: Any, draft: Circuit, count: int, weights: Mapping[str, Any]
) -> tuple[list[tuple[Any, str]], list[Any]]:
    """Return PennyLane's elementary operators with the line of each, and the measurements that a function returns.

    A function of more inputs than `count` gets as many as it asks for.
    """
    import autoray  # type: ignore[import-untyped]
    import pennylane as qml
    from pennylane.devices.preprocess import decompose

    autoray.register_backend(Angle, "numpy")
    file = source.__code__.co_filename
    lines: dict[int, str] = {}

    class Queue(qml.queuing.AnnotatedQueue):  # type: ignore[misc]  # PennyLane has no types
        def append(self, obj: Any, **kwargs: Any) -> None:
            super().append(obj, **kwargs)
            lines[id(obj)] = _line(file, traceback.walk_stack(None))

    failure: Exception | None = None
    for inputs in range(count, count + MORE_INPUTS):
        try:
            with Queue() as queue:
                result = call(np.array([draft.input(k) for k in range(inputs)], dtype=object), **weights)
            break
        except Exception as error:
            failure = failure or error
            if not (isinstance(error, IndexError) and "out of bounds" in str(error)):
                cause = failure if isinstance(error, ValueError) else error  # of too many inputs, maybe
                raise _refusal(cause, file) from cause
    else:
        assert failure is not None
        raise _refusal(failure, file) from failure
    operations: list[tuple[Any, str]] = []
    for operation in qml.tape.QuantumScript.from_queue(queue).operations:
        line = lines.get(id(operation), "")
        name = operation.name
        if name.startswith(("MidMeasure", "Conditional")):
            raise CircuitError(
                f"{name}: a measurement within the circuit; write this circuit gate by gate, with `measure_mid` of "
                f"qrlsuite.circuit.Circuit{line}"
            )
        script = qml.tape.QuantumScript([operation])
        try:
            (parts,), _ = decompose(
                script, lambda each: each.name in _KNOWN, skip_initial_state_prep=False, name="a circuit"
            )
        except Exception as error:
            reason = " ".join(str(error).split())
            advice = "" if isinstance(error, QrlSuiteError) else "; write it with rotations, CNOT and CZ"
            raise CircuitError(
                f"{name} cannot be written with elementary gates: {reason}{advice}{line}"
            ) from error
        operations += [(each, line) for each in parts.operations if each.name not in PHASES]
    results = list(result.values()) if isinstance(result, Mapping) else result
    return operations, list(np.ravel(results)) if isinstance(results, np.ndarray) else list(
        results if isinstance(results, list | tuple) else [results]
    )


_SYMBOLS = (
    "while a circuit is read, inputs and weights are arrays of symbols for one sample: add and multiply them, use "
    f"numpy's {', '.join(FUNCTIONS)} of inputs, and let no gate or shape depend on a value"
)


def _refusal(error: Exception, file: str) -> OptionError:
    """Return the error of a quantum function in words, with its line."""
    where = _line(file, reversed(list(traceback.walk_tb(error.__traceback__))))
    if isinstance(error, QrlSuiteError):
        return CircuitError(f"{error}{where}")
    if isinstance(error, IndexError) and "out of bounds" in str(error):
        return OptionError(f"there is no circuit of this size: {error}{where}")
    return CircuitError(f"{error}; {_SYMBOLS}{where}")


_FIXED = {"Adjoint(S)": ("RZ", (-math.pi / 2,)), "Adjoint(T)": ("RZ", (-math.pi / 4,))}
_KNOWN = {*GATES, *PHASES, *_FIXED, "ControlledPhaseShift"}


def _append(circuit: Circuit, operation: Any, place: Mapping[Any, int]) -> None:
    """Append one of PennyLane's elementary operators."""
    on = [place[wire] for wire in operation.wires]
    angles = [
        each.item() if isinstance(each, np.ndarray) and each.ndim == 0 else each for each in operation.data
    ]
    if any(isinstance(each, np.ndarray) for each in angles):
        raise CircuitError(
            f"{operation.name} has an array as its angle: give it one number, such as inputs[..., 0]"
        )
    if operation.name == "ControlledPhaseShift":
        circuit.append("U3", on[1], 0.0, *angles, 0.0, control=on[0])
    elif operation.name in _FIXED:
        gate, constants = _FIXED[operation.name]
        circuit.append(gate, on, *constants)
    else:
        gate, controlled = GATES[operation.name]
        circuit.append(gate.strip("()"), on[controlled:], *angles, control=on[0] if controlled else None)


def _word(measurement: Any, name: str) -> dict[Any, str]:
    """Return the Paulis of an `expval` by wire."""
    paulis = getattr(getattr(measurement, "obs", None), "pauli_rep", None) or {}
    words = [dict(word) for word, factor in paulis.items() if word and factor == 1.0]
    if type(measurement).__name__ != "ExpectationMP" or len(words) != 1 or len(paulis) != 1:
        raise CircuitError(
            f"'{name}' returns {measurement}: return expval of Z, X, Y or products of them, such as "
            "qml.expval(qml.Z(0) @ qml.Z(1)); of a sum return the terms, and the layer behind the circuit weighs them"
        )
    return words[0]
