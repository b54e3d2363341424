"""Random Pauli errors between gates, without gates for the errors.

A depolarizing channel of rate p replaces its qubits by random ones with probability p, which is the same as applying
one of the 4^k Pauli operators, the identity among them, each with probability p / 4^k. A *trajectory* is one draw of
all errors of a circuit; the mean over trajectories is an unbiased estimate of the noisy expectation value (Dalibard,
Castin & Molmer 1992, Phys. Rev. Lett. 68, 580; for Pauli channels every trajectory is a unitary circuit). Errors follow
each elementary gate (`qrlsuite.circuit.elementary`), so that rates mean the same as on the Qiskit backend.

Errors are carried to the end of the circuit (Knill 2005, Nature 434, 39). A rotation exp(-i a P / 2) lets a Pauli error
pass that commutes with P, and turns the other way, a to -a, for one that does not. Other gates turn errors into
errors: a CNOT copies an X from control to target, and a Z from target to control. An error that arrives at the end as
an X flips the measured bit. So a trajectory is the circuit itself, with some angles negated and some bits flipped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Circuit, Observable
from qrlsuite.circuit.elementary import Elementary

Bits = NDArray[np.uint8]


Drawn = tuple[NDArray[np.int64], Bits]
"""Errors behind one gate: trajectories that have one, and for each a Pauli operator. Of wire k of the gate, bit 2 k
says whether it has an X, bit 2 k + 1 whether it has a Z."""


class Errors(NamedTuple):
    """The effect of errors on the circuit in the H trajectories with an effect."""

    hit: NDArray[np.int64]
    """(H,): these trajectories, in order. An error may also be the identity, or meet nothing that it changes."""
    negated: Bits
    """(R, H): 1 where a rotation turns the other way."""
    flipped: Bits
    """(n, H): 1 where a qubit's measured bit is flipped."""


class PauliNoise:
    """The depolarizing noise of a circuit in elementary gates.

    Parameters
    ----------
    elementary:
        The circuit's elementary gates.
    rate:
        Rate of two-qubit gates; the rate of one-qubit gates is a tenth of it.

    Attributes
    ----------
    constants:
        Angles in radians of the rotations that have no angle in the circuit: a T is an RZ by pi / 4. They follow the
        elementary rotations, and R counts them all.
    """

    def __init__(self, elementary: Elementary, qubits: int, rate: float) -> None:
        self.qubits, self.rate = qubits, rate
        self.constants: list[float] = []
        self._gates = []
        for gate in elementary.gates:
            if gate.name == "T":
                gate = gate._replace(name="RZ", rotation=elementary.rotations + len(self.constants))
                self.constants.append(math.pi / 4)
            self._gates.append(gate)
        self.rotations = elementary.rotations + len(self.constants)

    def circuit(self, observables: Sequence[Observable]) -> Circuit:
        """Return the circuit that every trajectory runs: an input for each rotation's angle."""
        executed = Circuit(self.qubits, inputs=max(1, self.rotations))
        for name, wires, rotation in self._gates:
            executed.append(name, wires, *([] if rotation is None else [executed.input(rotation)]))
        executed.measure(observables)
        return executed

    def draw(self, trajectories: int, source: np.random.Generator) -> list[Drawn]:
        """Draw the errors behind every gate: which of the trajectories have one there, and which."""
        drawn = []
        for _, wires, _ in self._gates:
            count = source.binomial(trajectories, self.rate if len(wires) == 2 else self.rate / 10)
            place = source.choice(trajectories, count, replace=False, shuffle=False)
            drawn.append((place, source.integers(0, 4 ** len(wires), count, np.uint8)))
        return drawn

    def carry(self, drawn: Sequence[Drawn]) -> Errors:
        """Carry errors to the end of the circuit."""
        hit = np.unique(np.concatenate([np.empty(0, np.int64), *(place for place, _ in drawn)]))
        x, z = np.zeros((2, self.qubits, len(hit)), np.uint8)
        negated = np.zeros((self.rotations, len(hit)), np.uint8)
        for (name, wires, rotation), (place, code) in zip(self._gates, drawn):
            if rotation is not None:
                negated[rotation] = _anticommute(name, x[wires[0]], z[wires[0]])
            else:
                _pass(name, wires, x, z)
            those = np.searchsorted(hit, place)
            for number, wire in enumerate(wires):
                x[wire, those] ^= (code >> 2 * number) & 1
                z[wire, those] ^= (code >> 2 * number + 1) & 1
        felt = negated.any(0) | x.any(0)
        return Errors(hit[felt], negated[:, felt], x[:, felt])


def _anticommute(rotation: str, x: Bits, z: Bits) -> Bits:
    return {"RX": z, "RY": x ^ z, "RZ": x}[rotation]


def _pass(gate: str, wires: tuple[int, ...], x: Bits, z: Bits) -> None:
    """Move errors (n, H) in place behind a fixed gate."""
    first, last = wires[0], wires[-1]
    if gate == "H":
        x[first], z[first] = z[first].copy(), x[first].copy()
    elif gate == "S":
        z[first] ^= x[first]
    elif gate == "CNOT":
        x[last] ^= x[first]
        z[first] ^= z[last]
    elif gate == "CZ":
        z[first] ^= x[last]
        z[last] ^= x[first]
    elif gate == "SWAP":
        for bits in (x, z):
            bits[first], bits[last] = bits[last].copy(), bits[first].copy()
    # X, Y and Z commute with every error up to a sign, which no measurement sees
