"""From a circuit description to a program of few, large steps that sweep over the state.

Every parametrized gate is, up to a global phase, a product of rotations exp(-i angle P / 2), P one of X, Y, Z:

    Rot(a0, a1, a2) = RZ(a2) RY(a1) RZ(a0)
    U3(t, p, d)     = e^{i (p + d) / 2} RZ(p) RY(t) RZ(d)

Rotations of one target under one control are collected into a *block*, whose product is a single matrix of SU(2)
per lane. The phase of a controlled U3 is not global; its block carries it as a rotation "about" `PHASE`:
e^{i angle} on the half of the state where the control is 1.

H, CNOT, X, SWAP, CZ and Z are fixed: neighboring CNOT, X and SWAP are collected into one permutation of the basis,
neighboring CZ and Z into one pattern of signs. S, T and Y equal rotations by constant angles up to a global phase.

A gate joins an earlier step where everything between acts on other qubits. Hadamards that open the circuit cost
nothing: the state begins in their product. Others behind a controlled block, on its control or target, join its sweep,
as sums and differences without their factor 1 / sqrt 2: the multiplications, not the additions, fill the processor's
units there. The initial state carries these factors. Other Hadamards are collected up to three at a time, a sweep with
factor over 8 amplitudes.

Qubits that no gate connects, directly or through others, never share a state. Each connected *component* has a
state and steps of its own, so that 64 separate qubits take 64 times 2 amplitudes. The qubits of a component are
counted in order: of n, the first is bit n - 1 of a basis state's index, the last bit 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Angle, Circuit, Encoding, Operation, Parameter
from qrlsuite.errors import CircuitError

AXIS_X, AXIS_Y, AXIS_Z, PHASE = 0, 1, 2, 3
ROTATE, HADAMARD, PERMUTE, SIGN = 0, 1, 2, 3
NONE = -1
ON_TARGET, ON_CONTROL = 1, 2
"""Which bits of a controlled block have a Hadamard in the same sweep, as a mask."""
JOINED = 64
"""So many Hadamards of a component join blocks: without their factors its numbers grow by 2^32 in each state."""


class Component(NamedTuple):
    """Qubits that gates connect: a row of `Program.components`."""

    qubits: int
    amplitude: int
    """Begin of its 2^qubits amplitudes among the amplitudes of all components."""
    bit: int
    """Begin of its expectation values, bit by bit, among the values of all components."""
    first: int
    """Its steps are `first` up to, but not including, `last`."""
    last: int
    opening: int
    """The bits that begin with a Hadamard, as a mask."""
    joined: int
    """How many Hadamards blocks do without their factor: the initial state is 2^(-joined / 2) of its length."""


@dataclass(frozen=True)
class Program:
    """A compiled circuit; every array is C-contiguous, indices are 64-bit.

    Attributes
    ----------
    qubits, inputs, parameters:
        Numbers n of qubits, I of input features and P of trainable scalars.
    amplitudes:
        Number of amplitudes of all components together.
    components:
        (C, 7) int64: see `Component`.
    steps:
        (M, 6) int64: kind and arguments. ROTATE: control bit or -1, target bit, block, whether the block has a
        phase, Hadamards behind it (`ON_TARGET`, `ON_CONTROL`). HADAMARD: up to three bits, -1 where fewer. PERMUTE:
        first and last position in `cycles`. SIGN: first and last position in `negative`.
    angles:
        (A, 3) int64: input, flat index of scale, flat index of weight; -1 where absent.
    constants:
        (A,) float64: the constant part of every angle.
    rotations:
        (R, 2) int64: axis, angle.
    factors:
        (R,) float64: the rotation is by factor * angle.
    blocks:
        (G + 1,) int64: block g consists of rotations blocks[g] to blocks[g + 1], in order of application.
    cycles:
        (X,) int64: basis states along each cycle of each permutation; the last of a cycle is marked by ~state.
    negative:
        (Y,) int64: basis states whose sign changes.
    products:
        (Q, 2) int64: of every measured product of several Z its component, and the mask of its bits there.
    observables:
        (O,) int64: the measured bits, counted through all components; n + q stands for product q.
    """

    qubits: int
    inputs: int
    parameters: int
    amplitudes: int
    components: NDArray[np.int64]
    steps: NDArray[np.int64]
    angles: NDArray[np.int64]
    constants: NDArray[np.float64]
    rotations: NDArray[np.int64]
    factors: NDArray[np.float64]
    blocks: NDArray[np.int64]
    cycles: NDArray[np.int64]
    negative: NDArray[np.int64]
    products: NDArray[np.int64]
    observables: NDArray[np.int64]

    def source(self, first: int, last: int, qubits: int) -> NDArray[np.int64]:
        """Return a permutation, given by its positions in `cycles`, as new[i] = old[source[i]]."""
        source = np.arange(1 << qubits)
        start = first
        for position in range(first, last):
            state = self.cycles[position]
            if state < 0:  # the end of a cycle
                members = np.append(self.cycles[start:position], ~state)
                source[members] = np.roll(members, -1)
                start = position + 1
        return source


@dataclass
class _Step:
    """A step under construction: its kind, and the bits that it touches."""

    kind: int
    touched: set[int]
    control: int = NONE
    target: int = NONE
    rotations: list[tuple[int, int, float]] = field(default_factory=list)
    hadamards: list[int] = field(default_factory=list)
    gates: list[tuple[str, tuple[int, ...]]] = field(default_factory=list)


class _Steps:
    """The steps of one component, as its gates come in; `spare` Hadamards of it may join blocks."""

    def __init__(self, spare: int) -> None:
        self.steps: list[_Step] = []
        self.spare = spare
        self.joined = 0

    def find(self, touched: set[int], fits: Callable[[_Step], bool]) -> _Step | None:
        """Return the latest step that fits, if nothing after it touches these bits."""
        for step in reversed(self.steps):
            if fits(step):
                return step
            if step.touched & touched:
                return None
        return None

    def rotate(self, control: int, target: int, rotations: list[tuple[int, int, float]]) -> None:
        touched = {target} | ({control} if control != NONE else set())
        step = self.find(
            touched,
            lambda s: (s.kind, s.control, s.target) == (ROTATE, control, target) and not s.hadamards,
        )
        if step is None:
            step = _Step(ROTATE, touched, control, target)
            self.steps.append(step)
        step.rotations += rotations

    def hadamard(self, bit: int) -> None:
        step = self.find({bit}, lambda s: s.control != NONE and bit in s.touched and bit not in s.hadamards)
        if step is not None and self.joined < self.spare:
            self.joined += 1
        else:
            step = self.find(
                {bit}, lambda s: s.kind == HADAMARD and bit not in s.hadamards and len(s.hadamards) < 3
            )
        if step is None:
            step = _Step(HADAMARD, set())
            self.steps.append(step)
        step.hadamards.append(bit)
        step.touched.add(bit)

    def fixed(self, kind: int, gate: str, bits: tuple[int, ...]) -> None:
        step = self.find(set(bits), lambda s: s.kind == kind)
        if step is None:
            step = _Step(kind, set())
            self.steps.append(step)
        step.gates.append((gate, bits))
        step.touched |= set(bits)


class Compiler:
    """The arrays of a program, as they grow component by component."""

    def __init__(self, parameters: Mapping[str, Parameter]) -> None:
        offsets = np.cumsum([0, *(p.size for p in parameters.values())])
        self.offset = {name: int(start) for name, start in zip(parameters, offsets)}
        self.parameters = sum(p.size for p in parameters.values())
        self.components: list[Component] = []
        self.steps: list[tuple[int, int, int, int, int, int]] = []
        self.angles: list[tuple[int, int, int]] = []
        self.constants: list[float] = []
        self.rotations: list[tuple[int, int, float]] = []
        self.blocks = [0]
        self.cycles: list[int] = []
        self.negative: list[int] = []

    def component(self, operations: Sequence[Operation], wires: Sequence[int], fresh: bool = True) -> None:
        """Append a connected component: the gates on these wires, which begin in |0...0> where they are `fresh`."""
        n = len(wires)
        bit = {wire: n - 1 - place for place, wire in enumerate(wires)}
        steps, first = _Steps(JOINED if fresh else 0), len(self.steps)
        opening, touched = 0, set[int]() if fresh else set(bit.values())
        for operation in operations:
            bits = tuple(bit[wire] for wire in operation.wires)
            if operation.gate == "H" and bits[0] not in touched:
                opening |= 1 << bits[0]
            elif operation.gate == "H":
                steps.hadamard(bits[0])
            elif operation.gate in ("CNOT", "X", "SWAP"):
                steps.fixed(PERMUTE, operation.gate, bits)
            elif operation.gate in ("CZ", "Z"):
                steps.fixed(SIGN, operation.gate, bits)
            else:
                control = NONE if operation.control is None else bit[operation.control]
                steps.rotate(control, bits[0], self.as_rotations(operation))
            touched.update(bit[wire] for wire in operation.qubits)
        for step in steps.steps:
            self.step(step, n)
        amplitude = sum(1 << c.qubits for c in self.components)
        place = sum(c.qubits for c in self.components)
        self.components.append(Component(n, amplitude, place, first, len(self.steps), opening, steps.joined))

    def program(
        self, inputs: int, products: Sequence[tuple[int, int]], observables: Sequence[int]
    ) -> Program:
        """Return the grown program, which measures these products and observables."""
        return Program(
            qubits=sum(c.qubits for c in self.components),
            inputs=inputs,
            parameters=self.parameters,
            amplitudes=sum(1 << c.qubits for c in self.components),
            components=np.array(self.components, np.int64),
            steps=np.array(self.steps, np.int64).reshape(-1, 6),
            angles=np.array(self.angles, np.int64).reshape(-1, 3),
            constants=np.array(self.constants, np.float64),
            rotations=np.array([r[:2] for r in self.rotations], np.int64).reshape(-1, 2),
            factors=np.array([r[2] for r in self.rotations], np.float64),
            blocks=np.array(self.blocks, np.int64),
            cycles=np.array(self.cycles, np.int64),
            negative=np.array(self.negative, np.int64),
            products=np.array(products, np.int64).reshape(-1, 2),
            observables=np.array(observables, np.int64),
        )

    def step(self, step: _Step, qubits: int) -> None:
        """Lay a step out in the arrays."""
        if step.kind == ROTATE:
            phase = any(axis == PHASE for axis, _, _ in step.rotations)
            behind = ON_TARGET * (step.target in step.hadamards) + ON_CONTROL * (
                step.control in step.hadamards
            )
            self.steps.append((ROTATE, step.control, step.target, len(self.blocks) - 1, int(phase), behind))
            self.rotations += step.rotations
            self.blocks.append(len(self.rotations))
        elif step.kind == HADAMARD:
            high, middle, low = [*sorted(step.hadamards, reverse=True), NONE, NONE][:3]
            self.steps.append((HADAMARD, high, middle, low, 0, 0))
        elif step.kind == PERMUTE:
            first = len(self.cycles)
            self.cycles += _cycles(_source(step.gates, qubits))
            self.steps.append((PERMUTE, first, len(self.cycles), 0, 0, 0))
        else:
            first = len(self.negative)
            self.negative += _negative(step.gates, qubits)
            self.steps.append((SIGN, first, len(self.negative), 0, 0, 0))

    def angle(self, angle: Angle) -> int:
        """Add an angle to the table; returns its index."""
        if angle.product is not None or isinstance(angle.input, Encoding):
            raise CircuitError("functions of inputs are written as inputs by `create_backend`")
        scale, weight = (
            NONE if element is None else self.offset[element.parameter] + element.index
            for element in (angle.scale, angle.weight)
        )
        self.angles.append((NONE if angle.input is None else angle.input, scale, weight))
        self.constants.append(angle.constant)
        return len(self.angles) - 1

    def as_rotations(self, operation: Operation) -> list[tuple[int, int, float]]:
        """Write a gate on its target as (axis, angle, factor) in order of application."""
        if operation.gate in ("Y", "S", "T"):
            axis, value = {
                "Y": (AXIS_Y, math.pi),
                "S": (AXIS_Z, math.pi / 2),
                "T": (AXIS_Z, math.pi / 4),
            }[operation.gate]
            return [(axis, self.angle(Angle(constant=value)), 1.0)]
        index = [self.angle(angle) for angle in operation.angles]
        if operation.gate == "Rot":
            return [(AXIS_Z, index[0], 1.0), (AXIS_Y, index[1], 1.0), (AXIS_Z, index[2], 1.0)]
        if operation.gate == "U3":
            theta, phi, delta = index
            rotations = [(AXIS_Z, delta, 1.0), (AXIS_Y, theta, 1.0), (AXIS_Z, phi, 1.0)]
            if operation.control is not None:
                rotations += [(PHASE, phi, 0.5), (PHASE, delta, 0.5)]
            return rotations
        return [({"RX": AXIS_X, "RY": AXIS_Y, "RZ": AXIS_Z}[operation.gate], index[0], 1.0)]


def _source(gates: list[tuple[str, tuple[int, ...]]], qubits: int) -> NDArray[np.int64]:
    """Return, for every basis state after the gates, the one whose amplitude it takes."""
    state = np.arange(1 << qubits)
    for gate, bits in reversed(gates):  # each gate is its own inverse
        if gate == "X":
            state = state ^ (1 << bits[0])
        elif gate == "CNOT":
            state = state ^ (((state >> bits[0]) & 1) << bits[1])
        else:
            differ = ((state >> bits[0]) ^ (state >> bits[1])) & 1
            state = state ^ (differ << bits[0]) ^ (differ << bits[1])
    return state


def _negative(gates: list[tuple[str, tuple[int, ...]]], qubits: int) -> list[int]:
    """Return the basis states to which CZ and Z gates give the sign -1."""
    state, odd = np.arange(1 << qubits), np.zeros(1 << qubits, np.int64)
    for _, bits in gates:
        odd ^= np.bitwise_and.reduce([(state >> bit) & 1 for bit in bits])
    return [int(i) for i in np.flatnonzero(odd)]


def _cycles(source: NDArray[np.int64]) -> list[int]:
    """Write new[i] = old[source[i]] as cycles i, source[i], source[source[i]], ...; the last is marked by ~."""
    result: list[int] = []
    seen = source == np.arange(len(source))
    for first in np.flatnonzero(~seen):
        if seen[first]:
            continue
        state = int(first)
        while not seen[state]:
            seen[state] = True
            result.append(state)
            state = int(source[state])
        result[-1] = ~result[-1]
    return result


def compile_circuit(circuit: Circuit) -> Program:
    """Compile a circuit description into a program."""
    compiler = Compiler(circuit.parameters)
    places: dict[int, int] = {}
    components = circuit.components()
    member = {wire: number for number, wires in enumerate(components) for wire in wires}
    operations: list[list[Operation]] = [[] for _ in components]
    for operation in circuit.operations:
        operations[member[operation.wires[0]]].append(operation)
    for wires, gates in zip(components, operations):
        compiler.component(gates, wires)
        for wire in reversed(wires):  # bit by bit
            places[wire] = len(places)
    products: list[tuple[int, int]] = []
    observables: list[int] = []
    for measured in circuit.measured:
        if len(measured) == 1:
            observables.append(places[measured[0]])
            continue
        component = member[measured[0]]  # the same for all: observables connect their qubits
        first = compiler.components[component].bit
        products.append((component, sum(1 << (places[wire] - first) for wire in measured)))
        observables.append(circuit.qubits + len(products) - 1)
    return compiler.program(circuit.inputs, products, observables)


def compile_operations(
    qubits: int, inputs: int, operations: Sequence[Operation], fresh: bool = True
) -> Program:
    """Compile gates into a program on one state of all qubits, whether gates connect them or not; it measures nothing.

    Parameters
    ----------
    operations:
        The gates. Their angles have inputs and constants, and no parameters.
    fresh:
        Whether the state begins in |0...0>; else the program runs on any state.
    """
    compiler = Compiler({})
    compiler.component(operations, range(qubits), fresh)
    return compiler.program(inputs, [], [])
