"""Shots and noise on the CPU kernels: bit strings drawn from the final states of noisy trajectories.

All <Z_q> of an input come from the same bit strings, as on hardware: counts of the 2^n outcomes are drawn from their
multinomial law. Qubits that no gate connects are drawn apart. Errors between gates are in `noise`: trajectories are
lanes of one compiled circuit, and the kernels need not know of errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

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
from qrlsuite.plugins.circuits.native.noise import Bits, PauliNoise
from qrlsuite.plugins.circuits.native.program import Program
from qrlsuite.plugins.circuits.options import NativeOptions

PART_BYTES = 64 << 20
"""Memory that the states of one call of the kernels may take; all trajectories of an input are in one call, though."""


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
        self.elementary: Elementary | None = None
        self.noise: PauliNoise | None = None
        if options.noise_model is None:
            self.controlled = self.table.controlled
            executed = _with_free_angles(circuit, self.table)
            shifts = shift_evaluations(circuit)
        else:
            self.elementary = Elementary(circuit, self.table)
            self.noise = PauliNoise(self.elementary, circuit.qubits, options.noise_rate)
            self.controlled = [False] * self.elementary.rotations
            executed = self.noise.circuit(circuit.observables)
            shifts = 2 * self.elementary.rotations
        self.gradient_circuits = 2 if options.gradient == "spsa" else shifts
        self.simulator = Simulator(executed)
        program = cast(Program, self.simulator.program)  # of a circuit, not of a mean-field approximation
        self._components = list(zip(executed.components(), program.components[:, 1].tolist()))
        self._measured = [list(qubits) for qubits in circuit.measured]
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
        trajectories = 1 if self.noise is None else self.options.trajectories
        if self.options.shots is not None:
            trajectories = min(trajectories, self.options.shots)
        rows = self.simulator.workspace(angles.dtype).record.nbytes // self.simulator.lanes[angles.dtype]
        own = trajectories + (self.noise is not None)  # with noise there is one without an error, too
        size = max(1, PART_BYTES // (rows * own))
        parts = [self._part(some, trajectories, source) for some in torch.split(angles, size, dim=1)]
        return torch.cat(parts)

    def _part(self, angles: Tensor, trajectories: int, source: np.random.Generator) -> Tensor:
        """Return estimates (L, O) of so few lanes that their states fit into memory."""
        lanes = angles.shape[1]
        place = np.arange(lanes).repeat(trajectories)  # of every trajectory, the run that gives its result
        x, flipped = angles.T, None
        if self.noise is not None:
            # At small rates most trajectories have no error: those of a lane are one run of the circuit.
            hit, negated, flipped_there = self.noise.carry(self.noise.draw(len(place), source))
            x = torch.cat([x, x.new_tensor(self.noise.constants).expand(lanes, -1)], dim=1)
            x = torch.cat(
                [x, x[torch.from_numpy(place[hit])] * torch.from_numpy(1.0 - 2.0 * negated.T).to(x)]
            )
            place[hit] = lanes + np.arange(len(hit))
            flipped = np.pad(flipped_there, ((0, 0), (lanes, 0)))
        x = x[None]
        if x.shape[2] == 0:  # a circuit has at least one input
            x = x.new_zeros((*x.shape[:2], 1))
        if self.options.shots is None:
            values = self.simulator(x, x.new_zeros((1, 0)))[0] * torch.from_numpy(self._seen(flipped)).to(x)
            return values[torch.from_numpy(place)].reshape(lanes, trajectories, -1).mean(1)
        return self._sampled(x, place.reshape(lanes, trajectories), flipped, source).to(angles)

    def _sampled(
        self, x: Tensor, place: NDArray[np.int64], flipped: Bits | None, source: np.random.Generator
    ) -> Tensor:
        """Return means (L, O) over bit strings of runs with angles (1, R, A) and flipped bits (n, R).

        The shots of a lane are shared out evenly among its trajectories, whose runs `place` names (L, T): the first L
        runs are the lanes' own, and each of the others is one trajectory.
        """
        total, (lanes, trajectories), runs = self.options.shots, place.shape, x.shape[1]
        assert total is not None
        share = np.full(trajectories, total // trajectories)
        share[: total % trajectories] += 1
        shots = np.bincount(place.ravel(), np.tile(share, lanes), runs).astype(np.int64)
        lane = np.arange(runs)
        lane[place.ravel()] = np.arange(lanes).repeat(trajectories)
        records, means = self._states(x), np.zeros((lanes, len(self._measured)))
        for (wires, first), signs in zip(self._components, self._signs):
            mask = np.zeros(runs, np.int64)
            if flipped is not None:
                for wire in wires:
                    mask = 2 * mask + flipped[wire]
            counts = np.zeros((lanes, 1 << len(wires)), np.int64)
            draws.measure(records, first, mask, self.options.readout_error, shots, lane, source, counts)
            means += counts / total @ signs
        return torch.from_numpy(means)

    def _seen(self, flipped: Bits | None) -> NDArray[np.float64]:
        """Return the factors (R, O), or (1, O), of readout errors and flipped bits (n, R) on exact values."""
        weights = np.array([len(qubits) for qubits in self._measured])
        factors = (1.0 - 2.0 * self.options.readout_error) ** weights[None]
        if flipped is None:
            return factors
        odd = [np.bitwise_xor.reduce(flipped[qubits]) for qubits in self._measured]
        return factors * (1.0 - 2.0 * np.array(odd).T)

    def _states(self, x: Tensor) -> NDArray[Any]:
        """Return the final states of angles (1, R, A), as the kernels lay them out: chunks (C, rows, V)."""
        simulator, kind = self.simulator, NUMPY[x.dtype]
        width, runs = simulator.lanes[x.dtype], x.shape[1]
        work = simulator.workspace(x.dtype)
        records: NDArray[Any] = simulator.vectors.aligned((-(-runs // width), *work.record.shape[1:]), kind)
        values = np.empty((1, runs, len(simulator.program.observables)), kind)
        given = np.ascontiguousarray(x.detach().numpy())
        flat = np.zeros((1, 0), kind)
        simulator.kernels.forward(simulator.tables, given, flat, records, 1, work.scratch, values)
        return records


def _with_free_angles(circuit: Circuit, table: AngleTable) -> Circuit:
    """Return the circuit with an input of its own for every variable angle."""
    free = Circuit(circuit.qubits, inputs=max(1, table.count))
    for operation, rows in zip(circuit, table.rows):
        angles = [free.input(row) if isinstance(row, int) else Angle(row) for row in rows]
        free.append(operation.gate, operation.wires, *angles, control=operation.control)
    free.measure(circuit.observables)
    return free
