"""Shots and noise on the CPU kernels: bit strings drawn from final states, and random Pauli errors between gates.

*Shots.* All <Z_q> of an input come from the same bit strings, as on hardware: counts of the 2^n outcomes are drawn
from their multinomial law. Qubits that no gate connects are drawn apart.

*Noise.* A depolarizing channel of rate p replaces its qubits by random ones with probability p, which is the same as
applying one of the 4^k Pauli operators, the identity among them, each with probability p / 4^k. A *trajectory* is one
draw of all errors of a circuit; the mean over trajectories is an unbiased estimate of the noisy expectation value
(Dalibard, Castin & Molmer 1992, Phys. Rev. Lett. 68, 580; for Pauli channels every trajectory is a unitary circuit).
Errors follow each elementary gate (`qrlsuite.circuit.elementary`), so that rates mean what they mean on the Qiskit
backend. An error is a rotation by 0 or pi about X and about Z: trajectories are lanes of one compiled circuit, and the
kernels need not know of noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.description import Angle, Circuit
from qrlsuite.circuit.elementary import Elementary
from qrlsuite.circuit.resources import shift_evaluations
from qrlsuite.circuit.shifts import Rule, measured, random_signs, shift_rule, spsa_rule, stream
from qrlsuite.plugins.circuits.native import dense, draws
from qrlsuite.plugins.circuits.native.cpu import NUMPY, Simulator
from qrlsuite.plugins.circuits.native.program import Program
from qrlsuite.plugins.circuits.options import NativeOptions

PART_BYTES = 64 << 20
"""Memory that the states of one call of the kernels may take."""


class ShotSampler:
    """A circuit with shots, noise or both.

    Attributes
    ----------
    gradient_circuits:
        Circuits executed per input for a gradient.
    """

    def __init__(self, circuit: Circuit, options: NativeOptions) -> None:
        self.options = options
        self.table = AngleTable(circuit)
        self.noisy = options.noise_model is not None
        self.elementary = Elementary(circuit, self.table) if self.noisy else None
        self._slots: list[tuple[int, ...]] = []
        if self.elementary is None:
            self.angles, self.controlled = self.table.count, self.table.controlled
            executed = _with_free_angles(circuit, self.table)
            shifts = shift_evaluations(circuit)
        else:
            self.angles, self.controlled = self.elementary.rotations, [False] * self.elementary.rotations
            self._slots = [gate.wires for gate in self.elementary.gates]
            executed = _with_errors(circuit, self.elementary)
            shifts = 2 * self.angles
        self.gradient_circuits = 2 if options.gradient == "spsa" else shifts
        self.simulator = Simulator(executed)
        program = cast(Program, self.simulator.program)  # of a circuit, not of a mean-field approximation
        self._components = [tuple(row) for row in program.components.tolist()]
        self._weights = np.array([len(qubits) for qubits in circuit.measured])
        diagonals = dense.diagonals(program, torch.zeros((), dtype=torch.float64))
        self._signs = [diagonal.numpy() for diagonal in diagonals]

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None
    ) -> Tensor:
        """Return estimates (S, B, O) of inputs (S, B, I) and parameters (S, *shape), each seed's from its stream."""
        S, B = inputs.shape[:2]
        angles = self.table(inputs, parameters)
        if self.elementary is not None:
            angles = self.elementary(angles.reshape(-1, S * B)).reshape(-1, S, B)
        entropy: Sequence[int | None] = [None] * S if seeds is None else seeds
        return torch.stack([self._one_seed(angles[:, s], seed) for s, seed in enumerate(entropy)])

    def _one_seed(self, angles: Tensor, seed: int | None) -> Tensor:
        """Return one seed's estimates (B, O) from its angles (A, B)."""
        own = np.random.SeedSequence(seed).entropy

        def execute(some: Tensor, call: int) -> Tensor:
            return self._execute(some, np.random.default_rng(stream(own, call)))

        if self.options.shots is None and self.options.gradient == "auto":
            return execute(angles, 0)  # every trajectory is differentiated by the adjoint method
        rule: Rule = shift_rule(self.controlled)
        if self.options.gradient == "spsa":
            rule = spsa_rule(random_signs(stream(own, 0, 0)))
        return measured(angles, execute, rule)

    def _execute(self, angles: Tensor, source: np.random.Generator) -> Tensor:
        """Run the circuit once per lane: angles (A, L) to estimates (L, O)."""
        trajectories = self.options.trajectories if self.noisy else 1
        if self.options.shots is not None:
            trajectories = min(trajectories, self.options.shots)
        rows = self.simulator.workspace(angles.dtype).record.nbytes // self.simulator.lanes[angles.dtype]
        size = max(1, PART_BYTES // (rows * (trajectories + self.noisy)))  # noisy: and one without an error
        parts = [self._part(some, trajectories, source) for some in torch.split(angles, size, dim=1)]
        return torch.cat(parts)

    def _part(self, angles: Tensor, trajectories: int, source: np.random.Generator) -> Tensor:
        """Return estimates (L, O) of so few lanes that their states fit into memory."""
        lanes = angles.shape[1]
        place = np.arange(lanes).repeat(trajectories)  # of every trajectory, the run that gives its result
        x = angles.T
        if self.noisy:
            # At small rates most trajectories have no error: those of a lane are one run of the circuit.
            hit, errors = self._errors(lanes * trajectories, source)
            x = torch.cat([x, x[torch.from_numpy(place[hit])]])
            place[hit] = lanes + np.arange(len(hit))
            angles_of_errors = x.new_zeros((len(x), errors.shape[1]))
            angles_of_errors[lanes:] = math.pi * torch.from_numpy(errors)
            x = torch.cat([x, angles_of_errors], dim=1)
        x = x[None]
        if x.shape[2] == 0:  # a circuit has at least one input
            x = x.new_zeros((*x.shape[:2], 1))
        if self.options.shots is None:
            values = self.simulator(x, x.new_zeros((1, 0)))[0][torch.from_numpy(place)]
            values = values.reshape(lanes, trajectories, -1).mean(1)
            return values * torch.from_numpy((1.0 - 2.0 * self.options.readout_error) ** self._weights).to(
                values
            )
        means = np.zeros((lanes, len(self._weights)))
        for states, signs in zip(self._probabilities(x), self._signs):
            means += self._draw(states, place.reshape(lanes, trajectories), source) @ signs
        return torch.from_numpy(means).to(angles)

    def _errors(self, runs: int, source: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Draw errors for a number of runs: which H have any (H,), and theirs (H, 2 per gate and wire): X, Z or not."""
        drawn = []
        for wires in self._slots:
            rate = self.options.noise_rate / (1 if len(wires) == 2 else 10)
            happens = np.flatnonzero(source.random(runs) < rate)
            codes = np.zeros(runs, np.uint8)
            codes[happens] = source.integers(0, 4 ** len(wires), len(happens), np.uint8)
            drawn.append(codes)
        hit = np.flatnonzero(np.logical_or.reduce(drawn)) if drawn else np.empty(0, np.int64)
        columns = [
            (codes[hit] >> bit) & 1
            for codes, wires in zip(drawn, self._slots)
            for bit in range(2 * len(wires))
        ]
        return hit, np.array(columns, np.uint8).reshape(len(columns), len(hit)).T

    def _probabilities(self, x: Tensor) -> list[NDArray[np.float64]]:
        """Return the probabilities of each component's outcomes, (lanes, 2^qubits), of angles (1, lanes, A).

        Their sums are 1 up to rounding.
        """
        simulator, kind = self.simulator, NUMPY[x.dtype]
        width, lanes = simulator.lanes[x.dtype], x.shape[1]
        work = simulator.workspace(x.dtype)
        records = simulator.kernels.aligned((-(-lanes // width), *work.record.shape[1:]), kind)
        values = np.empty((1, lanes, len(simulator.program.observables)), kind)
        given = np.ascontiguousarray(x.detach().numpy())
        flat = np.zeros((1, 0), kind)
        simulator.kernels.forward(simulator.tables, given, flat, records, 1, work.scratch, values)
        result = []
        for qubits, first, *_ in self._components:
            found = np.empty((lanes, 1 << qubits))
            draws.probabilities(records, first, found)
            result.append(self._read(found, qubits))
        return result

    def _read(self, probabilities: NDArray[np.float64], qubits: int) -> NDArray[np.float64]:
        """Return the probabilities of what is read, where each bit is read wrongly with the same probability."""
        wrong = self.options.readout_error
        if wrong > 0:
            for bit in range(qubits):
                pairs = probabilities.reshape(len(probabilities), -1, 2, 1 << bit)
                probabilities = (1 - wrong) * pairs + wrong * pairs[:, :, ::-1]
            probabilities = probabilities.reshape(len(probabilities), -1)
        return probabilities

    def _draw(
        self, probabilities: NDArray[np.float64], place: NDArray[np.int64], source: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return frequencies (L, 2^n) of outcomes drawn from each run's probabilities (R, 2^n).

        The shots of a lane are shared out evenly among its trajectories, whose runs `place` names (L, T): the first L
        runs are the lanes' own, and each of the others is one trajectory.
        """
        shots, (lanes, trajectories) = self.options.shots, place.shape
        assert shots is not None
        share = np.full(trajectories, shots // trajectories)
        share[: shots % trajectories] += 1
        of_run = np.bincount(place.ravel(), np.tile(share, lanes), len(probabilities)).astype(np.int64)
        counts = np.empty(probabilities.shape, np.int64)
        draws.multinomial(of_run, probabilities, source, counts)
        totals = counts[:lanes]
        if len(counts) > lanes:
            lane, trajectory = np.nonzero(place >= lanes)
            np.add.at(totals, lane, counts[place[lane, trajectory]])
        return totals / shots


def _with_free_angles(circuit: Circuit, table: AngleTable) -> Circuit:
    """Return the circuit with an input of its own for every variable angle."""
    free = Circuit(circuit.qubits, inputs=max(1, table.count))
    for operation, rows in zip(circuit, table.rows):
        angles = [free.input(row) if isinstance(row, int) else Angle(row) for row in rows]
        free.append(operation.gate, operation.wires, *angles, control=operation.control)
    free.measure(circuit.observables)
    return free


def _with_errors(circuit: Circuit, elementary: Elementary) -> Circuit:
    """Return elementary gates, each followed by an RX and an RZ on its wires; inputs are rotations, then errors."""
    wires = [gate.wires for gate in elementary.gates]
    noisy = Circuit(circuit.qubits, inputs=max(1, elementary.rotations + 2 * sum(map(len, wires))))
    error = elementary.rotations
    for gate in elementary.gates:
        angles = [] if gate.rotation is None else [noisy.input(gate.rotation)]
        noisy.append(gate.name, gate.wires, *angles)
        for wire in gate.wires:
            noisy.append("RX", wire, noisy.input(error))
            noisy.append("RZ", wire, noisy.input(error + 1))
            error += 2
    noisy.measure(circuit.observables)
    return noisy
