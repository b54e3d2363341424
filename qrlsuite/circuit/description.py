"""Circuits written once, run on every backend.

A `Circuit` is a list of operations on qubits 0..n-1. Every rotation angle is affine in one input feature:

    angle = constant + scale * input + weight

where `scale` and `weight` are elements of named trainable parameters (either may be absent; an absent scale with an
input present counts as 1), and `input` may be any function of the inputs that numpy's functions, sums and products
write, such as `np.arctan(circuit.input(0))`, or a number. Reading order is application order. Qubit 0 is the most
significant bit of a basis state's index, as in PennyLane. The measured observables are Pauli Z on chosen qubits
(default: every), or products of Pauli X, Y and Z.

With `mean_field` the same description stands for a classical approximation, see `Circuit`.

An ansatz is a function that writes such a circuit:

    def ry_ring(qubits, layers, options):
        circuit = Circuit(qubits)
        weights = circuit.parameter("weights", (layers, qubits))
        for layer in range(layers):
            for q in range(qubits):
                circuit.append("RX", q, circuit.input(q))
                circuit.append("RY", q, weights[layer, q])
            for q in range(qubits):
                circuit.append("CZ", (q, (q + 1) % qubits))
        return circuit

Only numpy is imported here.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from qrlsuite.errors import CircuitError, OptionError, nearest


class GateSignature(NamedTuple):
    """How many wires and angles a gate takes, and whether it may be controlled by one more qubit."""

    wires: int
    angles: int
    controllable: bool


GATES: dict[str, GateSignature] = {
    "RX": GateSignature(1, 1, True),  # exp(-i a X / 2)
    "RY": GateSignature(1, 1, True),  # exp(-i a Y / 2)
    "RZ": GateSignature(1, 1, True),  # exp(-i a Z / 2)
    "Rot": GateSignature(1, 3, True),  # RZ(a2) RY(a1) RZ(a0)
    "U3": GateSignature(1, 3, True),  # PennyLane's U3(theta, phi, delta)
    "H": GateSignature(1, 0, False),
    "X": GateSignature(1, 0, False),
    "Y": GateSignature(1, 0, False),
    "Z": GateSignature(1, 0, False),
    "S": GateSignature(1, 0, False),
    "T": GateSignature(1, 0, False),
    "CNOT": GateSignature(2, 0, False),  # wires: control, target
    "CZ": GateSignature(2, 0, False),
    "SWAP": GateSignature(2, 0, False),
}
"""Every gate a circuit may contain, with
`U3(t, p, d) = [[cos t/2, -e^{id} sin t/2], [e^{ip} sin t/2, e^{i(p+d)} cos t/2]]`.
"""

ISING: dict[str, tuple[tuple[str, tuple[float, ...]], ...]] = {
    "RXX": (("H", ()), ("H", ())),
    "RYY": (("RX", (math.pi / 2,)), ("RX", (-math.pi / 2,))),
    "RZZ": (),
}
"""Rotations exp(-i a PP / 2) of two qubits, which `Circuit.append` writes as CNOT, RZ, CNOT (as one controlled rotation
in a mean-field approximation): the gates that turn both qubits before, and back after."""

CONTROLLED: dict[str, tuple[float, float, float]] = {
    "Y": (math.pi, math.pi / 2, math.pi / 2),
    "H": (math.pi / 2, 0.0, math.pi),
    "S": (0.0, 0.0, math.pi / 2),
    "T": (0.0, 0.0, math.pi / 4),
}
"""Gates without angles as U3, phase included: so they are written where they have a control."""

COMPOSED = {
    "CX": "CNOT",
    **{f"CR{axis}": f"R{axis} with control=q" for axis in "XYZ"},
    **{f"ISING{axis}{axis}": f"R{axis}{axis}" for axis in "XYZ"},
}
"""Gates that others have, and how to append them here."""


@dataclass(frozen=True, slots=True)
class Element:
    """One scalar of a named parameter: its name and its index in the flattened (C order) array."""

    parameter: str
    index: int

    def __str__(self) -> str:
        return f"{self.parameter}[{self.index}]"


_NUMBER = int, float, np.integer, np.floating

Observable = int | tuple[int, ...] | str
"""A qubit for its Pauli Z, qubits for the product of theirs, or a product of other Paulis: `X0 Y2`."""


Word = tuple[tuple[str, int], ...]
"""The Paulis of an observable, and their qubits."""

_FACTOR = re.compile(r"\s*([XYZ])(\d+)\s*")

FUNCTIONS = ("arctan", "arcsin", "arccos", "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")
"""The functions of inputs that an angle may have, by their names in numpy and torch."""

Product = tuple["int | Encoding | None", "int | Encoding | None", float]
"""A product of inputs: the first (None for 1), the second (None for 1), and a number."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """A function of inputs that stands in the place of an input: one of `FUNCTIONS`, `sum` or `product`.

    Attributes
    ----------
    of:
        The arguments: angles without parameters.
    """

    function: str
    of: tuple[Angle, ...]

    def text(self, write: Callable[[Angle], str]) -> str:
        """Write the function as an expression, with a function that writes an angle."""
        if self.function in FUNCTIONS:
            return f"{self.function}({write(self.of[0])})"
        sign = " + " if self.function == "sum" else " * "
        return f"({sign.join(f'({write(each)})' for each in self.of)})"

    @property
    def inputs(self) -> set[int]:
        """The input features that it depends on."""
        return set().union(*(each.inputs for each in self.of))


@dataclass(frozen=True, slots=True)
class Angle:
    """`constant + scale * input + weight`, in radians. Built with `+` and `*` from inputs, parameters and numbers.

    Attributes
    ----------
    input, factor:
        An input, or a function of inputs; and a second one, by which the first is multiplied.
    times:
        A number by which the input term is multiplied. A scale without an input is multiplied by this number alone.
    """

    constant: float = 0.0
    input: int | Encoding | None = None
    scale: Element | None = None
    weight: Element | None = None
    factor: int | Encoding | None = None
    times: float = 1.0

    def __mul__(self, other: Angle | float) -> Angle:
        """Multiply inputs, a trainable scale and numbers (in any order); nothing else may be multiplied."""
        if isinstance(other, _NUMBER):
            return self._multiple(float(other))
        if isinstance(other, np.ndarray):  # numpy multiplies every element
            return NotImplemented
        if isinstance(other, Angle) and not (self.elements and other.elements):
            a, b = (other, self) if other.elements else (self, other)  # b has no parameter
            if parameter := a._parameter:
                whole = b if b.is_bare_input else Angle(input=Encoding("sum", (b,)))
                return replace(whole, scale=parameter, times=a.times * whole.times)
            if a.weight is None and (a.scale is None or (a.input is not None and a.constant == 0.0)):
                inputs = replace(a, scale=None)
                if inputs.is_bare_input and b.is_bare_input and a.factor is b.factor is None:
                    return Angle(input=a.input, scale=a.scale, factor=b.input, times=a.times * b.times)
                return Angle(input=Encoding("product", (inputs, b)), scale=a.scale)
        what = (
            "products of parameters"
            if isinstance(other, Angle)
            else f"an angle cannot be multiplied by {other!r}"
        )
        raise CircuitError(
            f"{what}: an angle is constant + scale * (function of inputs) + weight, with one parameter each for scale "
            "and weight; give the gate a parameter of its own"
        )

    __rmul__ = __mul__

    def _multiple(self, number: float) -> Angle:
        """Return the angle times a number: of a sum of an input and a weight, no multiple can be written."""
        if self.weight is None:
            times = self.times * number if self._has_term else 1.0
            return replace(self, constant=self.constant * number + 0.0, times=times)  # no -0.0
        if self.input is None and self.scale is None:
            return Angle(constant=self.constant * number + 0.0, scale=self.weight, times=number)
        raise CircuitError(
            f"a sum of an input and a parameter cannot be multiplied by {number:g}: multiply the input, and give the "
            "parameter another range (low, high)"
        )

    def __truediv__(self, number: float) -> Angle:
        return self * (1.0 / number)

    def __pow__(self, number: int) -> Angle:
        if isinstance(number, _NUMBER) and number in range(1, 9):
            return functools.reduce(operator.mul, [self] * int(number))
        raise CircuitError(f"an angle to the power of {number!r}: write a whole number from 1 to 8")

    def __getattr__(self, name: str) -> Callable[[], Angle]:
        """Return one of `FUNCTIONS`, as numpy looks for them: `np.arctan(angle)` calls `angle.arctan()`."""
        if name in FUNCTIONS:
            return functools.partial(self._function, name)
        raise AttributeError(name)

    def _function(self, name: str) -> Angle:
        if self.elements:
            raise CircuitError(
                f"{name} of a parameter: functions take inputs alone; multiply the result by the parameter"
            )
        return Angle(input=Encoding(name, (self,)))

    def __float__(self) -> float:
        raise CircuitError(
            "the angle depends on an input or a parameter, and is no number yet: write it with numpy, such as "
            f"np.arctan(x), not math.atan(x); of functions there are {', '.join(FUNCTIONS)}"
        )

    def __neg__(self) -> Angle:
        return self._multiple(-1.0)

    def __add__(self, other: Angle | float) -> Angle:
        """Add two angles: at most one input term and one weight may remain."""
        if isinstance(other, _NUMBER):
            return replace(self, constant=self.constant + float(other))
        if not isinstance(other, Angle):
            return NotImplemented
        if (self._has_term and other._has_term and (self.scale or other.scale)) or (
            self.weight and other.weight
        ):
            raise CircuitError(
                "an angle holds at most one scale and one weight, without numbers before it: scale * input + weight; "
                "RX(a + b) is RX(a), RX(b)"
            )
        if self._has_term and other._has_term:
            parts = (replace(each, constant=0.0, weight=None) for each in (self, other))
            term = Angle(input=Encoding("sum", tuple(parts)), constant=self.constant)
        else:
            term = self if self._has_term else other
            other = other if term is self else self
        return replace(term, constant=self.constant + other.constant, weight=self.weight or other.weight)

    __radd__ = __add__

    def __sub__(self, other: Angle | float) -> Angle:
        return self + -other

    def __rsub__(self, other: float) -> Angle:
        return -self + other

    @property
    def _has_term(self) -> bool:
        """Whether there is an input, or a multiple of a parameter, which stands in its place."""
        return self.input is not None or self.scale is not None

    @property
    def is_bare_input(self) -> bool:
        """Whether this is an input, or a product of two, and nothing else."""
        return self.input is not None and self.scale is None and self.weight is None and self.constant == 0.0

    @property
    def _parameter(self) -> Element | None:
        """The parameter if this is a multiple of one parameter alone."""
        alone = self.input is None and self.constant == 0.0 and (self.scale is None) != (self.weight is None)
        return (self.scale or self.weight) if alone else None

    @property
    def elements(self) -> tuple[Element, ...]:
        """The trainable scalars in it."""
        return tuple(each for each in (self.scale, self.weight) if each is not None)

    @property
    def varies(self) -> bool:
        """Whether it depends on an input or a parameter."""
        return self._has_term or self.weight is not None

    @property
    def inputs(self) -> set[int]:
        """The input features that it depends on."""
        terms = (each for each in (self.input, self.factor) if each is not None)
        return set().union(*(each.inputs if isinstance(each, Encoding) else {each} for each in terms))

    def on(self, place: Mapping[int | Encoding | None, int]) -> Angle:
        """Return the angle with inputs in the places of its functions of inputs."""
        if not (isinstance(self.input, Encoding) or isinstance(self.factor, Encoding)):
            return self
        return replace(
            self, input=place.get(self.input, self.input), factor=place.get(self.factor, self.factor)
        )

    def texts(
        self,
        term: Callable[[int | Encoding], str],
        element: Callable[[Element], str] = str,
        number: Callable[[float], str] = repr,
        times: str = "*",
    ) -> list[str]:
        """Write the input term and the weight, where there are such, with functions that write their parts."""
        factors = [number(float(self.times))] if self._has_term and self.times != 1.0 else []
        factors += [element(self.scale)] if self.scale else []
        factors += [term(each) for each in (self.input, self.factor) if each is not None]
        return [times.join(factors)] * bool(factors) + ([element(self.weight)] if self.weight else [])

    @property
    def product(self) -> Product | None:
        """The product or function that the input term stands for; None where that is an input, or there is none."""
        written = self.input is None or isinstance(self.input, Encoding)
        plain = not written and self.factor is None and self.times == 1.0
        return None if plain or not self._has_term else (self.input, self.factor, self.times)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A named trainable array; indexing it gives an `Angle`. Initial values are uniform in [low, high)."""

    name: str
    shape: tuple[int, ...]
    low: float = 0.0
    high: float = 2.0 * math.pi

    @property
    def size(self) -> int:
        """Number of scalars."""
        return math.prod(self.shape)

    def written(self, index: int) -> str:
        """Return a scalar, by its index in the flattened array, as its author writes it: `weights[1, 2]`."""
        return f"{self.name}{[int(i) for i in np.unravel_index(index, self.shape)]}"

    def __getitem__(self, index: int | tuple[int, ...]) -> Angle:
        """Return the scalar at a full multi-index as an angle."""
        position = (index,) if isinstance(index, int) else index
        if len(position) != len(self.shape) or not all(0 <= i < n for i, n in zip(position, self.shape)):
            raise CircuitError(f"parameter '{self.name}' of shape {self.shape} has no element {position}")
        flat = 0
        for i, n in zip(position, self.shape):
            flat = flat * n + int(i)
        return Angle(weight=Element(self.name, flat))


@dataclass(frozen=True, slots=True)
class Operation:
    """One gate: `wires` are its targets (for CNOT: control, target), `control` an extra control qubit."""

    gate: str
    wires: tuple[int, ...]
    angles: tuple[Angle, ...] = ()
    control: int | None = None

    @property
    def qubits(self) -> tuple[int, ...]:
        """Every qubit touched, an extra control first."""
        return self.wires if self.control is None else (self.control, *self.wires)


class Circuit:
    """A parametrised circuit on `qubits` qubits with `inputs` input features (default: one per qubit).

    Parameters
    ----------
    qubits:
        Number of qubits.
    inputs:
        Number of input features; by default one per qubit.
    mean_field:
        Drop all correlations after every gate on two qubits: only the reduced state of each qubit (its Bloch
        vector) is kept. The result is no circuit, but a classical function of the same gates and parameters, whose
        cost is linear in the number of gates. Only some backends compute it (`CircuitBackendSpec.mean_field`).

    Attributes
    ----------
    qubits:
        Number of qubits, with those that stand for earlier measurements and resets.
    deferred:
        How many of them do, the last ones (deferred measurement: Nielsen & Chuang 2010, section 4.4).

    Raises
    ------
    OptionError
        If the number of qubits or inputs is not positive.
    """

    def __init__(self, qubits: int, inputs: int | None = None, mean_field: bool = False) -> None:
        if not isinstance(qubits, int) or qubits < 1:
            raise OptionError(f"qubits = {qubits!r}: a circuit has 1 qubit or more")
        self.qubits = qubits
        self.deferred = 0
        self.inputs = qubits if inputs is None else inputs
        if not isinstance(self.inputs, int) or self.inputs < 1:
            raise OptionError(f"inputs = {inputs!r}: a circuit has at least one input")
        self.mean_field = mean_field
        self.parameters: dict[str, Parameter] = {}
        self._operations: list[Operation] = []
        self._words: tuple[Word, ...] = tuple((("Z", q),) for q in range(qubits))

    @property
    def operations(self) -> tuple[Operation, ...]:
        """The gates in order of application."""
        return tuple(self._operations)

    @property
    def observables(self) -> tuple[Observable, ...]:
        """The observables in output order, as arguments of `measure`."""
        return tuple(map(_observable, self._words))

    @property
    def measured(self) -> tuple[tuple[int, ...], ...]:
        """The qubits of every observable, in output order: it is the product of their Paulis, see `axes`."""
        return tuple(tuple(wire for _, wire in word) for word in self._words)

    @property
    def axes(self) -> tuple[str, ...]:
        """The Paulis of every observable, in the order of its qubits in `measured`: `Z`, or `XY`."""
        return tuple("".join(axis for axis, _ in word) for word in self._words)

    @property
    def measures_products(self) -> bool:
        """Whether some observable is a product."""
        return any(len(qubits) > 1 for qubits in self.measured)

    @property
    def measures_z(self) -> bool:
        """Whether every observable is a Pauli Z, or a product of Pauli Z, as backends need it."""
        return all(set(axes) == {"Z"} for axes in self.axes)

    def _has(self, qubit: Any) -> bool:
        return isinstance(qubit, int | np.integer) and 0 <= int(qubit) < self.qubits

    def measure(self, observables: Sequence[int | Sequence[int] | str]) -> None:
        """Measure these observables, in this order, instead of Pauli Z on every qubit.

        Parameters
        ----------
        observables:
            A qubit stands for its Pauli Z, several for the product of their Pauli Z, and a text for any product of
            Paulis: `measure([0, (1, 2), "X0 Y2"])` measures Z_0, Z_1 Z_2 and X_0 Y_2. Observables without a common
            basis are executed apart, see `in_bases`.

        Raises
        ------
        CircuitError
            If these are no qubits, groups of them or products, or one is there twice.
        """
        given: Any = observables  # whatever a program hands over
        try:
            listed = [] if isinstance(given, str) else [_factors(each) for each in given]
        except TypeError:
            listed = []
        if (
            not listed
            or len(set(map(frozenset, listed))) != len(listed)
            or any(
                not word or len({q for _, q in word}) != len(word) or not all(self._has(q) for _, q in word)
                for word in listed
            )
        ):
            raise CircuitError(
                f"observables {observables!r}: distinct qubits 0..{self.qubits - 1}, distinct groups of them, or "
                'products like "X0 Y1" are needed'
            )
        self._words = tuple(listed)

    def input(self, index: int) -> Angle:
        """Return input feature `index` as an angle (radians)."""
        if not 0 <= index < self.inputs:
            raise CircuitError(f"input {index}: this circuit has inputs 0..{self.inputs - 1}")
        return Angle(input=index)

    def parameter(
        self, name: str, shape: tuple[int, ...], low: float = 0.0, high: float = 2 * math.pi
    ) -> Parameter:
        """Declare a trainable array, initially uniform in [low, high)."""
        if not name.isidentifier():
            raise CircuitError(f"parameter name {name!r} is not an identifier")
        if name in self.parameters:
            raise CircuitError(f"parameter '{name}' is declared twice")
        if not shape or any(not isinstance(n, int) or n < 1 for n in shape):
            raise CircuitError(f"parameter '{name}': shape {shape!r} needs positive integers")
        self.parameters[name] = Parameter(name, tuple(shape), low, high)
        return self.parameters[name]

    def append(
        self,
        gate: str,
        wires: int | Sequence[int],
        *angles: Angle | float,
        control: int | None = None,
    ) -> None:
        """Add a gate.

        Parameters
        ----------
        gate:
            A key of `GATES`; or RXX, RYY, RZZ, which are appended as the gates that they are made of.
        wires:
            The qubit, or (control, target) for CNOT, or the pair for CZ, SWAP, RXX, RYY and RZZ.
        angles:
            As many as the gate takes, in radians.
        control:
            Apply the gate, which is on one qubit, only if this qubit is 1.
        """
        if gate in ISING:
            self._append_ising(gate, wires, angles, control)
            return
        if gate not in GATES:
            hint = COMPOSED.get(gate.upper()) or {name.upper(): name for name in GATES}.get(gate.upper())
            known = f"; write it as {hint}" if hint else nearest(gate, [*GATES, *ISING])
            raise CircuitError(f"unknown gate '{gate}'{known}")
        signature = GATES[gate]
        targets = (wires,) if isinstance(wires, int) else tuple(wires)
        if control is not None and not signature.controllable and signature.wires > 1:
            raise CircuitError(
                f"{gate} takes no extra control; use CNOT or CZ, or a controlled gate on one qubit"
            )
        touched = targets if control is None else (control, *targets)
        if len(targets) != signature.wires or len(set(touched)) != len(touched):
            raise CircuitError(
                f"{gate} needs {signature.wires} distinct qubit{'s' * (signature.wires > 1)}, got {touched}"
            )
        if not all(map(self._has, touched)):
            raise CircuitError(f"{gate} on qubits {touched}: this circuit has qubits 0..{self.qubits - 1}")
        if len(angles) != signature.angles:
            raise CircuitError(f"{gate} takes {signature.angles} angle(s), got {len(angles)}")
        exact = tuple(a if isinstance(a, Angle) else Angle(constant=float(a)) for a in angles)
        for angle in exact:
            self._check(angle)
        if control is not None and gate in ("X", "Z"):
            gate, targets, control = "CNOT" if gate == "X" else "CZ", (control, *targets), None
        elif control is not None and gate in CONTROLLED:
            gate, exact = "U3", tuple(Angle(constant=number) for number in CONTROLLED[gate])
        self._operations.append(Operation(gate, targets, exact, control))

    def _append_ising(
        self,
        gate: str,
        wires: int | Sequence[int],
        angles: Sequence[Angle | float],
        control: int | None,
    ) -> None:
        pair = (wires,) if isinstance(wires, int) else tuple(wires)
        if len(pair) != 2 or len(angles) != 1 or control is not None:
            raise CircuitError(f"{gate} takes 2 wires, 1 angle and no control")
        turns = ISING[gate]
        for name, values in turns[:1]:
            for wire in pair:
                self.append(name, wire, *values)
        if self.mean_field:  # one gate on both qubits, after which correlations are dropped
            self.append("RZ", pair[1], *angles)
            self.append("RZ", pair[1], self._twice_back(gate, angles[0]), control=pair[0])
        else:
            self.append("CNOT", pair)
            self.append("RZ", pair[1], *angles)
            self.append("CNOT", pair)
        for name, values in turns[1:]:
            for wire in pair:
                self.append(name, wire, *values)

    def _twice_back(self, gate: str, angle: Angle | float) -> Angle | float:
        """Return -2 times an angle, as exp(-i a ZZ / 2) is RZ(a), and RZ(-2 a) where the first qubit is 1."""
        try:
            return -2.0 * angle
        except CircuitError:
            raise CircuitError(
                f"{gate} in a mean-field approximation: its angle is a sum of an input and a parameter; give it one of "
                f"them alone, or write the gate with one controlled rotation"
            ) from None

    def _check(self, angle: Angle) -> None:
        if not (math.isfinite(angle.constant) and math.isfinite(angle.times)):
            raise CircuitError("an angle's numbers must be finite")
        for feature in angle.inputs:
            if not 0 <= feature < self.inputs:
                raise CircuitError(f"input {feature}: this circuit has inputs 0..{self.inputs - 1}")
        if angle.factor is not None and angle.input is None:
            raise CircuitError("a second input needs a first one to multiply")
        for element in angle.elements:
            parameter = self.parameters.get(element.parameter)
            if parameter is None or not 0 <= element.index < parameter.size:
                raise CircuitError(f"the angle uses {element}, which this circuit does not declare")

    def components(self) -> list[list[int]]:
        """Return the qubits in groups that gates or observables connect, directly or through others: each in order.

        Without an entangling gate every qubit is a group of its own.
        """
        group = {q: {q} for q in range(self.qubits)}
        for connected in [*(operation.qubits for operation in self._operations), *self.measured]:
            first, *others = connected
            for other in others:
                if group[other] is not group[first]:
                    group[first] |= group[other]
                    for q in group[other]:
                        group[q] = group[first]
        return [sorted(qubits) for q, qubits in group.items() if q == min(qubits)]

    def __iter__(self) -> Iterator[Operation]:
        return iter(self._operations)

    def __len__(self) -> int:
        return len(self._operations)

    @property
    def parameter_count(self) -> int:
        """Number of trainable scalars."""
        return sum(p.size for p in self.parameters.values())

    def __repr__(self) -> str:
        kind = ", mean_field=True" if self.mean_field else ""
        return f"Circuit(qubits={self.qubits}, gates={len(self)}, parameters={self.parameter_count}{kind})"


def _factors(observable: Any) -> Word:
    """Return the Paulis of an observable with their qubits; empty if it is no observable."""
    if isinstance(observable, str):
        found = [_FACTOR.fullmatch(part) for part in re.split(r"[*@]|(?<=\d)\s+(?=[XYZ])", observable)]
        return tuple((each[1], int(each[2])) for each in found if each) if all(found) else ()
    qubits = tuple(observable) if isinstance(observable, Iterable) else (observable,)
    return (
        tuple(("Z", int(q)) for q in qubits) if all(isinstance(q, int | np.integer) for q in qubits) else ()
    )


def _observable(word: tuple[tuple[str, int], ...]) -> Observable:
    """Return an observable as `Circuit.observables` has it."""
    if any(axis != "Z" for axis, _ in word):
        return " ".join(f"{axis}{qubit}" for axis, qubit in word)
    return word[0][1] if len(word) == 1 else tuple(qubit for _, qubit in word)


_TURNS: dict[str, tuple[tuple[str, tuple[float, ...]], ...]] = {
    "X": (("H", ()),),
    "Y": (("RX", (math.pi / 2,)),),
    "Z": (),
}
"""The gates that turn a Pauli into Pauli Z."""


def in_bases(circuit: Circuit) -> list[tuple[Circuit, tuple[int, ...]]]:
    """Divide a circuit by measurement basis: every part measures products of Pauli Z alone, behind the gates it needs.

    Each observable joins the first part that measures the same Pauli on every qubit that both have.

    Returns
    -------
    list
        Circuits, and the places of their observables among the circuit's. One that measures Pauli Z alone is the only
        part of itself.
    """
    if circuit.measures_z:
        return [(circuit, tuple(range(len(circuit.observables))))]
    parts: list[tuple[dict[int, str], list[int]]] = []
    for place, (qubits, axes) in enumerate(zip(circuit.measured, circuit.axes)):
        word = dict(zip(qubits, axes))
        fitting = (part for part in parts if all(part[0].get(q, axis) == axis for q, axis in word.items()))
        basis, places = next(fitting, ({}, []))
        if not places:
            parts.append((basis, places))
        basis.update(word)
        places.append(place)
    divided = []
    for basis, places in parts:
        part = Circuit(circuit.qubits, circuit.inputs, circuit.mean_field)
        part.parameters, part._operations = dict(circuit.parameters), list(circuit.operations)
        for qubit in sorted(basis):
            for gate, angles in _TURNS[basis[qubit]]:
                part.append(gate, qubit, *angles)
        part.measure([circuit.measured[place] for place in places])
        divided.append((part, tuple(places)))
    return divided


def apart(circuit: Circuit) -> list[tuple[Circuit, tuple[int, ...]]]:
    """Divide a circuit into the circuits of its components, see `Circuit.components`.

    Returns
    -------
    list
        Circuits with all inputs and parameters, and the places of their observables among the circuit's. One without
        observables is left out.
    """
    divided = []
    for component in circuit.components():
        wire = {qubit: number for number, qubit in enumerate(component)}
        places = tuple(k for k, qubits in enumerate(circuit.measured) if qubits[0] in wire)
        if not places:
            continue
        part = Circuit(len(wire), circuit.inputs)
        part.parameters = dict(circuit.parameters)
        for operation in circuit:
            if operation.wires[0] in wire:
                control = None if operation.control is None else wire[operation.control]
                wires = [wire[qubit] for qubit in operation.wires]
                part.append(operation.gate, wires, *operation.angles, control=control)
        part.measure([[wire[qubit] for qubit in circuit.measured[place]] for place in places])
        divided.append((part, places))
    return divided


def without_products(circuit: Circuit) -> tuple[Circuit, tuple[Encoding | Product, ...]]:
    """Write functions of inputs, products, multiples, and numbers before a parameter, as inputs behind the others.

    Returns
    -------
    tuple
        A circuit of plain inputs (the same one where it has no other), and each further input: the functions first,
        then the products, whose factors may be any inputs before them.
    """
    angles = [angle for operation in circuit for angle in operation.angles]
    encodings = dict.fromkeys(
        each for angle in angles for each in (angle.input, angle.factor) if isinstance(each, Encoding)
    )
    place: dict[int | Encoding | None, int] = {each: circuit.inputs + k for k, each in enumerate(encodings)}
    products = tuple(dict.fromkeys(p for angle in angles if (p := angle.on(place).product) is not None))
    further: tuple[Encoding | Product, ...] = (*encodings, *products)
    if not further:
        return circuit, ()
    plain = Circuit(circuit.qubits, circuit.inputs + len(further), circuit.mean_field)
    plain.parameters = dict(circuit.parameters)
    for operation in circuit:
        written = [
            angle
            if (product := angle.product) is None
            else replace(angle, input=circuit.inputs + further.index(product), factor=None, times=1.0)
            for angle in (each.on(place) for each in operation.angles)
        ]
        plain.append(operation.gate, operation.wires, *written, control=operation.control)
    plain.measure(circuit.observables)
    return plain, further


def canonical(circuit: Circuit) -> str:
    """Return a circuit as text, exactly: equal for two circuits that are the same gates, however they were written."""
    kind = " mean-field" if circuit.mean_field else ""
    lines = [f"circuit {circuit.qubits} qubits {circuit.inputs} inputs{kind}"]
    for parameter in circuit.parameters.values():
        shape = "x".join(map(str, parameter.shape))
        lines.append(f"parameter {parameter.name} {shape} {float(parameter.low)!r} {float(parameter.high)!r}")
    for operation in circuit:
        control = "" if operation.control is None else f" control {operation.control}"
        angles = "".join(f" {_written(angle)}" for angle in operation.angles)
        lines.append(f"{operation.gate} {' '.join(map(str, operation.wires))}{control}{angles}")
    measured = " ".join(
        "*".join(f"{'' if axis == 'Z' else axis}{qubit}" for axis, qubit in zip(axes, qubits))
        for axes, qubits in zip(circuit.axes, circuit.measured)
    )
    return "\n".join([*lines, f"measure {measured}", ""])


def _written(angle: Angle) -> str:
    """Write an angle: its constant, and after a plus sign each, its inputs with their scale, and its weight."""
    terms = angle.texts(lambda term: term.text(_written) if isinstance(term, Encoding) else f"x{term}")
    return "+".join([repr(float(angle.constant)), *terms])
