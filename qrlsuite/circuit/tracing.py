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

import functools
import inspect
import linecache
import operator
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite.circuit.description import FUNCTIONS, Angle, Circuit
from qrlsuite.errors import CircuitError, OptionError, QrlSuiteError
from qrlsuite.shortforms import SHAPES, has_one_size, inputs_of, shapes_of, source_of

MOST_INPUTS = 64
"""Numbers of inputs that are tried, from one per qubit on."""

GATES: dict[str, tuple[str, bool]] = {
    **{name: (name, False) for name in ("RX", "RY", "RZ", "Rot", "U3", "S", "T", "CNOT", "CZ", "SWAP")},
    **{f"C{name}": (name, True) for name in ("RX", "RY", "RZ", "Rot", "Y", "H")},
    **{f"C({name})": (name, True) for name in ("U3", "S", "T")},
    **{f"Ising{axis}": (f"R{axis}", False) for axis in ("XX", "YY", "ZZ")},
    **{f"Pauli{axis}": (axis, False) for axis in "XYZ"},
    "Hadamard": ("H", False),
    "PhaseShift": ("RZ", False),
}
"""The gate of each of PennyLane's operators, and whether its first wire controls it; phases of states are dropped."""

PHASES = ("Identity", "GlobalPhase", "Barrier", "Snapshot")
"""Operators that change no expectation value."""

SYMBOLS = (
    "while a circuit is read, inputs and weights are arrays of symbols for one sample: add and multiply them, use "
    f"numpy's {', '.join(FUNCTIONS)} of inputs, and let no gate or shape depend on a value"
)


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
    qubits, layers:
        Size of the circuit, which the shapes in `weight_shapes` may depend on; None for as many as the function has.
    call:
        What is called in its place, with options of its own.

    Raises
    ------
    PluginError
        If `weight_shapes` lacks a weight.
    OptionError
        For a size that the function does not have.
    CircuitError
        For an angle, gate or measurement that a `Circuit` cannot have.
    """
    import pennylane as qml

    source = source_of(function)
    name = source.__name__
    draft = Circuit(1, MOST_INPUTS)
    weights = {
        each: _array(draft, each, _shape(each, shape, qubits, layers))
        for each, shape in shapes_of(function).items()
    }
    if has_one_size(function) and layers != 1:
        raise OptionError(
            f"layers = {layers}: the layers of '{name}' are in the numbers of {SHAPES}: set layers=1, or write there "
            "a function of qubits and layers"
        )
    labels = list(getattr(getattr(function, "device", None), "wires", None) or ())
    called = functools.partial(call or source, **weights)
    tape, results, lines = _run(function, called, draft, qubits or len(labels) or 1)
    words = [_word(each, name) for each in results]
    used = set(tape.wires).union(*words)
    if not labels:
        numbered = all(isinstance(wire, int) for wire in used)
        labels = list(range(max(used, default=0) + 1)) if numbered else sorted(used, key=str)
        if qubits is None and len(labels) > 1:  # the function gets an input for each
            return trace(function, len(labels), layers, call, mean_field)
    if strange := used.difference(labels):
        raise CircuitError(
            f"'{name}' uses the wire {min(strange, key=str)!r}, which its device does not have"
        )
    if qubits not in (None, len(labels)):
        raise OptionError(f"qubits = {qubits}: '{name}' has {len(labels)} wires: set qubits={len(labels)}")
    measured = [each for each in tape.operations if each.name == "MidMeasureMP"]
    if chosen := [lines.get(id(each), "") for each in measured if each.postselect is not None]:
        raise CircuitError(f"postselect: no run may be thrown away, as every input needs a result{chosen[0]}")
    if measured:
        (tape,), _ = qml.defer_measurements(tape)
    deferred = [wire for wire in tape.wires if wire not in used]
    circuit = Circuit(len(labels) + len(deferred), MOST_INPUTS, mean_field)
    circuit.deferred, circuit.parameters = len(deferred), draft.parameters
    place = {wire: k for k, wire in enumerate([*labels, *deferred])}
    for operation in tape.operations:
        try:
            for part in _elementary(operation):
                _append(circuit, part, place)
        except Exception as error:
            advice = "" if isinstance(error, QrlSuiteError) else "; write it with rotations, CNOT and CZ"
            reason = f"{operation.name} cannot be taken: {' '.join(str(error).split())}{advice}"
            raise CircuitError(reason + lines.get(id(operation), "")) from error
    features = {k for operation in circuit for angle in operation.angles for k in angle.inputs}
    circuit.inputs = max(features, default=0) + 1
    circuit.measure([" ".join(f"{axis}{place[wire]}" for wire, axis in word.items()) for word in words])
    return circuit


def _shape(name: str, shape: Any, qubits: int | None, layers: int) -> tuple[int, ...]:
    """Return the shape of a weight.

    Parameters
    ----------
    shape:
        What `weight_shapes` has for it, as for PennyLane's TorchLayer: whole numbers, one number, or () or 1 for a
        scalar; or a function of `qubits` and `layers` that returns one of these.
    """
    try:
        if callable(shape):
            size = {"qubits": qubits, "n_wires": qubits, "layers": layers, "n_layers": layers}
            shape = shape(
                **{word: size[word] for word in inspect.signature(shape).parameters if word in size}
            )
        if isinstance(shape, int):
            return () if shape == 1 else (shape,)
        return tuple(map(operator.index, shape))
    except (TypeError, ValueError) as error:
        raise CircuitError(
            f"{SHAPES}: '{name}': {error}; write whole numbers, such as (2, 4, 3), or a function of qubits and layers"
        ) from error


def _array(draft: Circuit, name: str, shape: tuple[int, ...]) -> Any:
    """Declare a parameter, and return its angles as an array of numpy; a single one for the shape ()."""
    parameter = draft.parameter(name, shape or (1,))
    if not shape:
        return parameter[0]
    angles = np.empty(shape, dtype=object)
    for index in np.ndindex(shape):
        angles[index] = parameter[tuple(index)]
    return angles


def _run(
    function: Any, call: Callable[..., Any], draft: Circuit, count: int
) -> tuple[Any, list[Any], dict[int, str]]:
    """Return the tape of a function, the measurements that it returns, and the line of each operator by its id.

    It is called as `call`. A function of more inputs than `count` gets as many as it asks for.
    """
    import autoray  # type: ignore[import-untyped]
    import pennylane as qml

    autoray.register_backend(Angle, "numpy")
    name, file = inputs_of(function), source_of(function).__code__.co_filename
    lines: dict[int, str] = {}

    class Queue(qml.queuing.AnnotatedQueue):  # type: ignore[misc]  # PennyLane has no types
        def append(self, obj: Any, **kwargs: Any) -> None:
            super().append(obj, **kwargs)
            lines[id(obj)] = _line(file, traceback.walk_stack(None))

    failures: list[Exception] = []
    for inputs in range(count, MOST_INPUTS + 1):
        try:
            with Queue() as queue:
                result = call(**{name: np.array([draft.input(k) for k in range(inputs)], dtype=object)})
        except Exception as error:
            failures.append(error)
            if not _asks_for_more(error):
                break
        else:
            listed = list(result.values()) if isinstance(result, Mapping) else result
            listed = listed if isinstance(listed, list | tuple | np.ndarray) else [listed]
            return qml.tape.QuantumScript.from_queue(queue), list(listed), lines
    # the last one is of too many inputs, maybe
    cause = failures[0 if isinstance(failures[-1], ValueError) or _asks_for_more(failures[-1]) else -1]
    where = _line(file, reversed(list(traceback.walk_tb(cause.__traceback__))))
    if _asks_for_more(cause):
        raise OptionError(f"there is no circuit of this size: {cause}{where}") from cause
    advice = "" if isinstance(cause, QrlSuiteError) else f"; {SYMBOLS}"
    raise CircuitError(f"{cause}{advice}{where}") from cause


def _asks_for_more(error: Exception) -> bool:
    return isinstance(error, IndexError) and "out of bounds" in str(error)


def _line(file: str, frames: Iterable[tuple[Any, int]]) -> str:
    """Return the innermost line of a file among frames, for the end of a message; empty where there is none."""
    number = next((line for frame, line in frames if frame.f_code.co_filename == file), 0)
    text = linecache.getline(file, number).strip()
    return f" ({Path(file).name}, line {number}: {text})" if text else ""


def _elementary(operation: Any) -> list[Any]:
    """Return PennyLane's own decomposition of an operator."""
    import pennylane as qml
    from pennylane.devices.preprocess import decompose

    known = {*GATES, *PHASES, "ControlledPhaseShift", "Adjoint(S)", "Adjoint(T)"}
    script = qml.tape.QuantumScript([operation])
    (parts,), _ = decompose(script, lambda each: each.name in known, skip_initial_state_prep=False)
    return [each for each in parts.operations if each.name not in PHASES]


def _append(circuit: Circuit, operation: Any, place: Mapping[Any, int]) -> None:
    """Append one of PennyLane's elementary operators."""
    on = [place[wire] for wire in operation.wires]
    angles = [each.item() if getattr(each, "ndim", 1) == 0 else each for each in operation.data]
    if any(isinstance(each, np.ndarray) for each in angles):
        raise CircuitError("an array is its angle: give it one number, such as inputs[..., 0]")
    if operation.name == "ControlledPhaseShift":
        circuit.append("U3", on[1], 0.0, *angles, 0.0, control=on[0])
    elif operation.name.startswith("Adjoint"):
        circuit.append("RZ", on, -np.pi / (2 if "S" in operation.name else 4))
    else:
        gate, controlled = GATES[operation.name]
        circuit.append(gate, on[controlled:], *angles, control=on[0] if controlled else None)


def _word(measurement: Any, name: str) -> dict[Any, str]:
    """Return the Paulis of an `expval` by wire."""
    paulis = getattr(getattr(measurement, "obs", None), "pauli_rep", None) or {}
    words = [dict(word) for word, factor in paulis.items() if word and factor == 1.0]
    if type(measurement).__name__ != "ExpectationMP" or len(words) != 1 or len(paulis) != 1:
        raise CircuitError(
            f"'{name}' returns {' '.join(str(measurement).split())}: return expval of Z, X, Y or products, such as "
            "qml.expval(qml.Z(0) @ qml.Z(1)); of a sum return the terms, and the layer behind the circuit weighs them"
        )
    return words[0]
