"""A circuit in elementary gates: rotations about one axis, and fixed gates on one or two qubits.

Devices execute these gates, and noise acts on them. Every simulator with noise runs this list, so that noise rates have
one meaning everywhere. Controlled rotations become rotations and CNOTs (Nielsen & Chuang 2010,
corollary 4.2); each elementary angle is a sum of at most a few angles of the circuit, times a factor.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.description import Circuit


class Gate(NamedTuple):
    """One elementary gate: its name in `qrlsuite.circuit.GATES`, its wires, and the rotation whose angle it takes."""

    name: str
    wires: tuple[int, ...]
    rotation: int | None = None


class Elementary:
    """A circuit's elementary gates, and the linear map from its angles to theirs.

    Attributes
    ----------
    gates:
        The gates in order: RX, RY, RZ, H, X, Y, Z, S, T, CNOT, CZ, SWAP.
    """

    def __init__(self, circuit: Circuit, table: AngleTable) -> None:
        self.gates: list[Gate] = []
        self._terms: list[list[tuple[float, int | float]]] = []
        for operation, rows in zip(circuit, table.rows):
            self._append(operation.gate, operation.wires, rows, operation.control)
        self.rotations = len(self._terms)
        variable = [[(f, s) for f, s in terms if isinstance(s, int)] for terms in self._terms]
        depth = max(map(len, variable), default=0)
        padded = [[*terms, *[(0.0, 0)] * (depth - len(terms))] for terms in variable]
        # (depth, R): the k-th term of every rotation
        self._factors = torch.tensor([[f for f, _ in column] for column in zip(*padded)], dtype=torch.float64)
        self._sources = torch.tensor([[s for _, s in column] for column in zip(*padded)], dtype=torch.int64)
        self._constants = torch.tensor(
            [sum(f * s for f, s in terms if not isinstance(s, int)) for terms in self._terms],
            dtype=torch.float64,
        )

    def __call__(self, angles: Tensor) -> Tensor:
        """Return rotation angles (R, lanes) from the circuit's angles (A, lanes), radians."""
        # A sum in fixed order: a matrix product's bits could depend on the number of lanes.
        total = self._constants.to(angles)[:, None].expand(-1, angles.shape[1])
        for factors, sources in zip(self._factors.to(angles), self._sources):
            total = total + factors[:, None] * angles.index_select(0, sources)
        return total

    def _append(
        self, gate: str, wires: tuple[int, ...], rows: tuple[int | float, ...], control: int | None
    ) -> None:
        target = wires[0]
        if not rows:
            self.gates.append(Gate(gate, wires))
        elif gate == "U3":
            theta, phi, delta = rows
            if control is not None:  # U3 is a phase (phi + delta) / 2 times Rot(delta, theta, phi)
                self._rotate("RZ", control, (0.5, phi), (0.5, delta))
            self._append("Rot", wires, (delta, theta, phi), control)
        elif gate == "Rot":
            first, middle, last = rows
            if control is None:
                self._rotate("RZ", target, (1.0, first))
                self._rotate("RY", target, (1.0, middle))
                self._rotate("RZ", target, (1.0, last))
                return
            self._rotate("RZ", target, (0.5, first), (-0.5, last))
            self.gates.append(Gate("CNOT", (control, target)))
            self._rotate("RZ", target, (-0.5, first), (-0.5, last))
            self._rotate("RY", target, (-0.5, middle))
            self.gates.append(Gate("CNOT", (control, target)))
            self._rotate("RY", target, (0.5, middle))
            self._rotate("RZ", target, (1.0, last))
        elif control is None:
            self._rotate(gate, target, (1.0, rows[0]))
        else:
            if gate == "RX":
                self.gates.append(Gate("H", (target,)))
            axis = "RY" if gate == "RY" else "RZ"
            for factor in (0.5, -0.5):
                self._rotate(axis, target, (factor, rows[0]))
                self.gates.append(Gate("CNOT", (control, target)))
            if gate == "RX":
                self.gates.append(Gate("H", (target,)))

    def _rotate(self, name: str, qubit: int, *terms: tuple[float, int | float]) -> None:
        """Append a rotation by a linear combination of angles (rows of the table, or constants)."""
        self.gates.append(Gate(name, (qubit,), len(self._terms)))
        self._terms.append(list(terms))
