"""Finds, from its structure alone, the parameters and inputs on which a circuit's outputs can depend.

Observables go back through the gates, and the initial state goes forward, as the Paulis that either may hold on each
qubit. A gate that commutes with all of them changes nothing, whatever the parameters: RZ right before Z is measured,
say, or any gate outside of the light cone of an observable. A parameter that is reported as dead is dead. The converse
may fail: Paulis are kept qubit by qubit, without their correlations.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from qrlsuite.circuit.description import Angle, Circuit, Element
from qrlsuite.circuit.matrices import FIXED, ROTATIONS, Matrix, X, Y, Z, exponential
from qrlsuite.errors import OptionError

PAULIS: dict[str, Matrix] = {"I": np.eye(2, dtype=np.complex128), "X": X, "Y": Y, "Z": Z}
ANY = 0.7345
"""An angle that stands for any: no rotation by it maps a Pauli to another one."""

Letters = frozenset[str]
Step = tuple[str, int, float, bool, tuple[int, ...], Angle | None]
"""A gate or one of its `ROTATIONS`: the gate's name, the number of the rotation, its angle in radians (`ANY` for one
that varies), whether the first qubit controls it, the qubits, and the angle if it varies."""


class Use(NamedTuple):
    """A gate's angle that varies: whether the gate changes the state, and each observable, that reaches it."""

    angle: Angle
    state: bool
    observables: tuple[bool, ...]

    @property
    def alive(self) -> bool:
        """Whether an output may depend on the angle."""
        return self.state and any(self.observables)


def uses(circuit: Circuit) -> list[Use]:
    """Return the angles of a circuit that vary, in order of application; of a `Rot` each of the three."""
    steps = list(_steps(circuit))
    state = _changed(steps, [frozenset("Z")] * circuit.qubits)
    backward = []
    for qubits, axes in zip(circuit.measured, circuit.axes):
        word = dict(zip(qubits, axes))
        measured = [frozenset(word.get(q, "")) for q in range(circuit.qubits)]
        backward.append(_changed(steps[::-1], measured)[::-1])
    each = zip(steps, state, zip(*backward))
    return [Use(angle, before, after) for (*_, angle), before, after in each if angle is not None]


def _seen(circuit: Circuit) -> list[set[int]]:
    """Return, for each observable, the inputs on which it may depend."""
    found: list[set[int]] = [set() for _ in circuit.observables]
    for use in uses(circuit):
        for inputs, reached in zip(found, use.observables):
            inputs |= use.angle.inputs if use.state and reached else set()
    return found


def described(circuit: Circuit, build: Callable[[int], Circuit]) -> dict[str, str]:
    """Describe which inputs and parameters reach a circuit's outputs, in words.

    Parameters
    ----------
    build:
        Returns the same ansatz with a number of layers, or refuses it with `OptionError`. Up to two layers more than
        there are qubits are tried, until every output sees every input.
    """
    least = f"more than {circuit.qubits + 2}"
    for layers in range(1, circuit.qubits + 3):
        with contextlib.suppress(OptionError):
            each, least = build(layers), f"more than {layers}"
            if all(len(inputs) == each.inputs for inputs in _seen(each)):
                least = str(layers)
                break
    alive = {element for use in uses(circuit) if use.alive for element in use.angle.elements}
    names = [
        parameter.written(k)
        for name, parameter in circuit.parameters.items()
        for k in range(parameter.size)
        if Element(name, k) not in alive
    ]
    some = ", ".join([*names[:3], *["..."] * (len(names) > 3)])
    seen = _seen(circuit)
    unseen = sorted(set(range(circuit.inputs)).difference(*seen))
    counts = sorted(set(map(len, seen)))
    return {
        "dead_parameters": f"{len(names)} of {circuit.parameter_count}: {some}" if names else "none",
        "inputs_that_no_output_sees": ", ".join(map(str, unseen)) or "none",
        "inputs_that_an_output_sees": f"{' or '.join(map(str, counts))} of {circuit.inputs}",
        "layers_until_every_output_sees_every_input": least,
    }


def _steps(circuit: Circuit) -> Iterator[Step]:
    """Yield the gates as fixed gates and exponentials of `ROTATIONS`, in order."""
    for operation in circuit:
        controlled = operation.control is not None
        if not operation.angles:
            yield operation.gate, 0, ANY, controlled, operation.qubits, None
        for number, (place, _) in enumerate(ROTATIONS.get(operation.gate, ())):
            angle = operation.angles[place]
            value = ANY if angle.varies else angle.constant
            yield operation.gate, number, value, controlled, operation.qubits, angle if angle.varies else None


def _changed(steps: list[Step], letters: list[Letters]) -> list[bool]:
    """Return which steps change an operator with these Paulis on the qubits, moved through them."""
    letters, changes = list(letters), []
    for *step, qubits, _ in steps:
        after, changed = _image(*step, tuple(letters[q] for q in qubits))
        for qubit, own in zip(qubits, after):
            letters[qubit] = own
        changes.append(changed)
    return changes


@functools.cache
def _image(
    name: str, number: int, angle: float, controlled: bool, letters: tuple[Letters, ...]
) -> tuple[tuple[Letters, ...], bool]:
    """Return the Paulis on a gate's qubits behind it, and whether it changes any product of them.

    They are the same for the inverse of every gate here.
    """
    gate: Any = FIXED[name] if name in FIXED else exponential(ROTATIONS[name][number][1], angle)
    if controlled:
        gate = np.kron(np.diag([1, 0]), PAULIS["I"]) + np.kron(np.diag([0, 1]), gate)
    after: list[set[str]] = [set() for _ in letters]
    changed = False
    for given in itertools.product(*({"I", *own} for own in letters)):
        before = _product(given)
        moved = gate @ before @ gate.conj().T
        changed |= not np.allclose(moved, before, atol=1e-12)
        for word in itertools.product(PAULIS, repeat=len(letters)):
            if abs(np.trace(_product(word) @ moved)) > 1e-9:
                for own, letter in zip(after, word):
                    own.update({letter} - {"I"})
    return tuple(map(frozenset, after)), changed


def _product(word: Sequence[str]) -> Matrix:
    product: Matrix = functools.reduce(np.kron, (PAULIS[letter] for letter in word))  # type: ignore[arg-type]
    return product
