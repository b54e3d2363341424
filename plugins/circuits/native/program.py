"""From a circuit description to a program of few, large steps that sweep over the state.

Every parametrized gate is, up to a global phase, a product of rotations exp(-i angle P / 2), P one of X, Y, Z:

    Rot(a0, a1, a2) = RZ(a2) RY(a1) RZ(a0)
    U3(t, p, d)     = e^{i (p + d) / 2} RZ(p) RY(t) RZ(d)

Rotations of one target under one control are collected into a *block*, whose product is a single matrix of SU(2)
per lane. The phase of a controlled U3 is not global; its block carries it as a rotation "about" `PHASE`:
e^{i angle} on the half of the state where the control is 1.

H, CNOT, X, SWAP, CZ and Z are fixed: Hadamards are collected up to three at a time (a butterfly over 8
amplitudes), neighboring CNOT, X and SWAP into one permutation of the basis, neighboring CZ and Z into one pattern
of signs. S, T and Y equal rotations by constant angles up to a global phase.

A gate joins an earlier step where everything between acts on other qubits. Hadamards that open the circuit
cost nothing: the state begins in their product.

Qubit q of n is bit n - 1 - q of a basis state's index.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Angle, Circuit, Operation

AXIS_X, AXIS_Y, AXIS_Z, PHASE = 0, 1, 2, 3
ROTATE, HADAMARD, PERMUTE, SIGN = 0, 1, 2, 3
NONE = -1


@dataclass(frozen=True)
class Program:
    """A compiled circuit; every array is C-contiguous, indices are 64-bit.

    Attributes
    ----------
    qubits, inputs:
        Numbers n and I.
    parameters:
        Names of the parameters in the order in which they are laid out flat, with their sizes.
    steps:
        (M, 5) int64: kind and arguments. ROTATE: control bit or -1, target bit, block, whether the block has a
        phase. HADAMARD: up to three bits, -1 where fewer. PERMUTE: first and last position in `cycles`. SIGN:
        row of `signs`.
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
        (C,) int64: basis states along each cycle of each permutation; the last of a cycle is marked by ~state.
    signs:
        (K, 2^n) int8: +1 or -1.
    start:
        Bits on which the circuit opens with a Hadamard.
    observables:
        (O,) int64: measured bits.
    """

    qubits: int
    inputs: int
    parameters: tuple[tuple[str, int], ...]
    steps: NDArray[np.int64]
    angles: NDArray[np.int64]
    constants: NDArray[np.float64]
    rotations: NDArray[np.int64]
    factors: NDArray[np.float64]
    blocks: NDArray[np.int64]
    cycles: NDArray[np.int64]
    signs: NDArray[np.int8]
    start: NDArray[np.int64]
    observables: NDArray[np.int64]

    @property
    def parameter_count(self) -> int:
        """Number of trainable scalars P."""
        return sum(size for _, size in self.parameters)

    def source(self, first: int, last: int) -> NDArray[np.int64]:
        """Return a permutation, given by its positions in `cycles`, as new[i] = old[source[i]]."""
        source = np.arange(1 << self.qubits)
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
    """A step under construction: what it is, and which bits it touches."""

    kind: int
    touched: set[int]
    control: int = NONE
    target: int = NONE
    rotations: list[tuple[int, int, float]] = field(default_factory=list)
    bits: list[int] = field(default_factory=list)
    gates: list[tuple[str, tuple[int, ...]]] = field(default_factory=list)


class _Compiler:
    def __init__(self, circuit: Circuit) -> None:
        self.circuit = circuit
        self.n = circuit.qubits
        offsets = np.cumsum([0, *(p.size for p in circuit.parameters.values())])
        self.offset = {name: int(start) for name, start in zip(circuit.parameters, offsets)}
        self.angles: list[tuple[int, int, int]] = []
        self.constants: list[float] = []
        self.steps: list[_Step] = []
        self.start: list[int] = []

    def bit(self, wire: int) -> int:
        return self.n - 1 - wire

    def angle(self, angle: Angle) -> int:
        """Add an angle to the table; returns its index."""
        scale, weight = (
            NONE if element is None else self.offset[element.parameter] + element.index
            for element in (angle.scale, angle.weight)
        )
        self.angles.append((NONE if angle.input is None else angle.input, scale, weight))
        self.constants.append(angle.constant)
        return len(self.angles) - 1

    def add(self, operation: Operation) -> None:
        """Append an operation to the steps, or join it to an earlier one."""
        bits = tuple(self.bit(wire) for wire in operation.wires)
        control = NONE if operation.control is None else self.bit(operation.control)
        if operation.gate == "H":
            self.hadamard(bits[0])
        elif operation.gate in ("CNOT", "X", "SWAP"):
            self.fixed(PERMUTE, operation.gate, bits)
        elif operation.gate in ("CZ", "Z"):
            self.fixed(SIGN, operation.gate, bits)
        else:
            self.rotate(control, bits[0], self.as_rotations(operation))

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

    def find(self, touched: set[int], fits: object) -> _Step | None:
        """Return the latest step that fits, if nothing after it touches these bits."""
        for step in reversed(self.steps):
            if callable(fits) and fits(step):
                return step
            if step.touched & touched:
                return None
        return None

    def rotate(self, control: int, target: int, rotations: list[tuple[int, int, float]]) -> None:
        touched = {target} | ({control} if control != NONE else set())
        step = self.find(touched, lambda s: (s.kind, s.control, s.target) == (ROTATE, control, target))
        if step is None:
            step = _Step(ROTATE, touched, control, target)
            self.steps.append(step)
        step.rotations += rotations

    def hadamard(self, bit: int) -> None:
        if bit not in self.start and not any(bit in step.touched for step in self.steps):
            self.start.append(bit)
            return
        step = self.find({bit}, lambda s: s.kind == HADAMARD and bit not in s.bits and len(s.bits) < 3)
        if step is None:
            step = _Step(HADAMARD, set())
            self.steps.append(step)
        step.bits.append(bit)
        step.touched.add(bit)

    def fixed(self, kind: int, gate: str, bits: tuple[int, ...]) -> None:
        step = self.find(set(bits), lambda s: s.kind == kind)
        if step is None:
            step = _Step(kind, set())
            self.steps.append(step)
        step.gates.append((gate, bits))
        step.touched |= set(bits)

    def program(self) -> Program:
        """Lay everything out in arrays."""
        rows: list[tuple[int, int, int, int, int]] = []
        rotations: list[tuple[int, int, float]] = []
        blocks, cycles = [0], [np.empty(0, np.int64)]
        signs: list[NDArray[np.int8]] = []
        for step in self.steps:
            if step.kind == ROTATE:
                phase = any(axis == PHASE for axis, _, _ in step.rotations)
                rows.append((ROTATE, step.control, step.target, len(blocks) - 1, int(phase)))
                rotations += step.rotations
                blocks.append(len(rotations))
            elif step.kind == HADAMARD:
                high, middle, low = [*sorted(step.bits, reverse=True), NONE, NONE][:3]
                rows.append((HADAMARD, high, middle, low, 0))
            elif step.kind == PERMUTE:
                first = sum(map(len, cycles))
                cycles.append(_cycles(self.source(step.gates)))
                rows.append((PERMUTE, first, first + len(cycles[-1]), 0, 0))
            else:
                rows.append((SIGN, len(signs), 0, 0, 0))
                signs.append(self.sign(step.gates))
        return Program(
            qubits=self.n,
            inputs=self.circuit.inputs,
            parameters=tuple((name, p.size) for name, p in self.circuit.parameters.items()),
            steps=np.array(rows, np.int64).reshape(-1, 5),
            angles=np.array(self.angles, np.int64).reshape(-1, 3),
            constants=np.array(self.constants, np.float64),
            rotations=np.array([r[:2] for r in rotations], np.int64).reshape(-1, 2),
            factors=np.array([r[2] for r in rotations], np.float64),
            blocks=np.array(blocks, np.int64),
            cycles=np.concatenate(cycles),
            signs=np.array(signs, np.int8).reshape(-1, 1 << self.n),
            start=np.array(self.start, np.int64),
            observables=np.array([self.bit(wire) for wire in self.circuit.observables], np.int64),
        )

    def source(self, gates: list[tuple[str, tuple[int, ...]]]) -> NDArray[np.int64]:
        """Return, for every basis state after the gates, the one whose amplitude it takes."""
        state = np.arange(1 << self.n)
        for gate, bits in reversed(gates):  # each gate is its own inverse
            if gate == "X":
                state = state ^ (1 << bits[0])
            elif gate == "CNOT":
                state = state ^ (((state >> bits[0]) & 1) << bits[1])
            else:
                differ = ((state >> bits[0]) ^ (state >> bits[1])) & 1
                state = state ^ (differ << bits[0]) ^ (differ << bits[1])
        return state

    def sign(self, gates: list[tuple[str, tuple[int, ...]]]) -> NDArray[np.int8]:
        """Return the product of the gates' diagonals."""
        state, odd = np.arange(1 << self.n), np.zeros(1 << self.n, np.int64)
        for _, bits in gates:
            odd ^= np.bitwise_and.reduce([(state >> bit) & 1 for bit in bits])
        return (1 - 2 * odd).astype(np.int8)


def _cycles(source: NDArray[np.int64]) -> NDArray[np.int64]:
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
    return np.array(result, np.int64)


def compile_circuit(circuit: Circuit) -> Program:
    """Compile a circuit description into a program."""
    compiler = _Compiler(circuit)
    for operation in circuit.operations:
        compiler.add(operation)
    return compiler.program()
