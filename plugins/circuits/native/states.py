"""Final states of circuits whose angles are given sample by sample, and gradients of their observables.

Other libraries' circuits run here (see `pennylane_device` and `qiskit_primitives`): gates that the kernels know, in
one compiled program for each unbroken row of them, and between these any matrix on a few qubits. Observables are sums
of Pauli words, or matrices. Numbers are float64, memory is constant in depth: 2^n amplitudes of 16 bytes per sample,
three times that for gradients (Jones & Gacon 2020, see `sweeps`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Angle, Operation
from qrlsuite.compiled.cache import announce
from qrlsuite.plugins.circuits import MAX_QUBITS
from qrlsuite.plugins.circuits.native.program import compile_operations

PASS_BYTES = 64 << 20
"""States of one pass take up to this size; more samples take several passes."""

SPARE_BYTES = 8 << 20
"""Memory up to this size stays from one pass to the next, one array per program: fresh pages cost time."""

MATRIX_WIRES = 4
"""Gates without angles on up to so many wires run by their matrix."""

Complex = NDArray[np.complex128]
Floats = NDArray[np.float64]


class Matrix(NamedTuple):
    """A gate given by its matrix: the qubits, the first of which is the highest bit of its index."""

    wires: tuple[int, ...]


class Rule(NamedTuple):
    """How the kernels know a gate.

    Attributes
    ----------
    gate:
        Their name of it; empty for a gate that is a phase, or nothing.
    angles:
        Its angles: the gate's parameter with that index, or a number.
    controlled:
        Whether the first wire is a control.
    phase:
        It takes e^(i phase), or of a gate with parameters e^(i phase parameter), to be the same gate.
    """

    gate: str
    angles: tuple[int | float, ...] = ()
    controlled: bool = False
    phase: float = 0.0


class Word(NamedTuple):
    """A product of Pauli matrices by qubit, such as {0: "X", 2: "Z"}, its coefficient, and the observable it is of."""

    paulis: dict[int, str]
    coefficient: float
    observable: int


class MatrixObservable(NamedTuple):
    """An observable given by its Hermitian matrix on some qubits."""

    matrix: Complex
    wires: tuple[int, ...]
    observable: int


@dataclass
class Observables:
    """`count` observables: each the sum of its Pauli words and matrices."""

    count: int
    words: Sequence[Word]
    matrices: Sequence[MatrixObservable] = ()

    def tables(self, qubits: int) -> tuple[Any, ...]:
        """Return bit masks (W, 3), coefficients (W,) and observables (W,) of the words for the kernels."""
        terms = np.zeros((len(self.words), 3), np.int64)
        for row, word in zip(terms, self.words):
            for wire, pauli in word.paulis.items():
                bit = 1 << (qubits - 1 - wire)
                row[0] |= bit if pauli in "XY" else 0
                row[1] |= bit if pauli in "YZ" else 0
                row[2] += pauli == "Y"
        weights = np.array([word.coefficient for word in self.words], np.float64)
        return terms, weights, np.array([word.observable for word in self.words], np.int64)


@dataclass
class Samples:
    """Data that differ from sample to sample.

    Attributes
    ----------
    angles:
        (B, A) radians.
    matrices:
        Matrix of every `Matrix`, in order: (d, d) for all samples, or (B, d, d).
    initial:
        The state before the first gate, (2^n,) or (B, 2^n); None stands for |0...0>.
    """

    angles: Floats
    matrices: Sequence[Complex] = ()
    initial: Complex | None = None

    def part(self, first: int, last: int) -> Samples:
        """Return some of the samples."""
        matrices = [m if m.ndim == 2 else m[first:last] for m in self.matrices]
        initial = self.initial
        if initial is not None and initial.ndim == 2:
            initial = initial[first:last]
        return Samples(self.angles[first:last], matrices, initial)


class StateProgram:
    """Gates on n qubits, compiled once, run for any angles; calls from several threads wait for each other.

    Parameters
    ----------
    qubits:
        Their number n; qubit 0 is the highest bit of a basis state's index.
    angles:
        How many angles A a sample has.
    gates:
        `Operation`s, whose angles are inputs and constants, and `Matrix`es.
    prepared:
        Whether the samples bring initial states.
    """

    def __init__(
        self, qubits: int, angles: int, gates: Sequence[Operation | Matrix], prepared: bool = False
    ) -> None:
        refuse_width(qubits)
        announce(Path(__file__).parent, "the circuit simulator")
        from qrlsuite.compiled import vectors
        from qrlsuite.plugins.circuits.native import kernels

        self.kernels, self.aligned = kernels, vectors.aligned
        self.lanes = vectors.lanes(np.float64)
        self.qubits, self.inputs = qubits, angles
        self.rows = 2 << qubits
        self.prepared = prepared
        self.segments: list[tuple[Any, int] | Matrix] = []
        self._room: Floats | None = None
        self._lock = Lock()
        row: list[Operation] = []
        for gate in [*gates, None]:
            if isinstance(gate, Operation):
                row.append(gate)
                continue
            if row:
                fresh = not self.segments and not prepared
                self._add(row, fresh)
                row = []
            if gate is not None:
                self.segments.append(gate)
        self.begins = bool(self.segments) and not isinstance(self.segments[0], Matrix) and not prepared
        self.scratch = vectors.aligned((2 * angles + 5, self.lanes), np.float64)

    def _add(self, row: list[Operation], fresh: bool) -> None:
        program = compile_operations(self.qubits, self.inputs, row, fresh)
        self.segments.append((self.kernels.tables(program), self.rows))
        self.rows += 2 * len(program.rotations) + 6 * (len(program.blocks) - 1)

    def states(self, samples: Samples) -> Complex:
        """Return final states (B, 2^n), up to a global phase."""
        with self._lock:
            return self._amplitudes(self._run(samples), len(samples.angles))

    def expectations(self, samples: Samples, observables: Observables) -> Floats:
        """Return means (B, O)."""
        values = np.zeros((len(samples.angles), observables.count))
        tables = observables.tables(self.qubits)
        with self._lock:
            for first, some in self._passes(samples):
                records = self._run(some)
                out = values[first : first + len(some.angles)]
                self.kernels.words(*tables, self.qubits, records, self.scratch[:1], out)
                for each in observables.matrices:
                    psi = self._view(records)
                    applied = _applied(each.matrix, each.wires, psi)
                    mean = (psi[:, :, 0] * applied.real + psi[:, :, 1] * applied.imag).sum(1)
                    out[:, each.observable] += mean.reshape(-1)[: len(out)]
        return values

    def gradients(self, samples: Samples, observables: Observables, cotangents: Floats) -> Floats:
        """Return the gradient (B, A) of sum(cotangents * means) by the angles, for cotangents (B, O)."""
        result = np.zeros((len(samples.angles), self.inputs))
        tables = observables.tables(self.qubits)
        with self._lock:
            for first, some in self._passes(samples):
                records = self._run(some)
                given = np.ascontiguousarray(cotangents[first : first + len(some.angles)], np.float64)
                lams = self._weighed(records, tables, observables.matrices, given)
                self._retreat(some, records, lams, result[first : first + len(some.angles)])
        return result

    def state_gradients(self, samples: Samples, cotangents: Complex) -> Complex:
        """Return sum_i cotangents_i dpsi_i / dangle, complex (B, A), for cotangents (B, 2^n) of the final states."""
        parts = []
        with self._lock:
            records = self._run(samples)
            for factor in (
                0.5,
                0.5j,
            ):  # Im <lambda| P |psi> is the real part, and of i lambda the imaginary one
                lams = self._empty(len(records))
                _put(self._view(lams), factor * cotangents.conj())
                result = np.zeros((len(samples.angles), self.inputs))
                self._retreat(samples, records, lams, result)
                parts.append(result)
        return parts[0] + 1j * parts[1]

    def _weighed(
        self, records: Floats, tables: Any, matrices: Sequence[MatrixObservable], cotangents: Floats
    ) -> Floats:
        """Return lambda = (sum_o cotangents_o O_o) psi."""
        lams = self._empty(len(records))
        lams[:] = 0.0
        self.kernels.weigh_words(*tables, self.qubits, records, self.scratch[:1], cotangents, lams)
        lam = self._view(lams)
        for each in matrices:
            applied = _applied(each.matrix, each.wires, self._view(records))
            weights = np.zeros(len(records) * self.lanes)
            weights[: len(cotangents)] = cotangents[:, each.observable]
            weighed = applied * weights.reshape(-1, 1, self.lanes)
            lam[:, :, 0] += weighed.real
            lam[:, :, 1] += weighed.imag
        return lams

    def _passes(self, samples: Samples) -> Iterator[tuple[int, Samples]]:
        """Cut the samples so that the states of each part fit into `PASS_BYTES`."""
        count = len(samples.angles)
        step = max(1, PASS_BYTES // (8 * self.rows * self.lanes)) * self.lanes
        for first in range(0, count, step):
            yield first, samples if count <= step else samples.part(first, first + step)

    def _run(self, samples: Samples) -> Floats:
        """Return records (K, R, V) that begin with the final states."""
        chunks = -(-len(samples.angles) // self.lanes)
        if self._room is None or len(self._room) < chunks:
            self._room = self.aligned((chunks, self.rows, self.lanes), np.float64)
        records = self._room[:chunks]
        if records.nbytes > SPARE_BYTES:
            self._room = None
        if not self.begins:
            psi = self._view(records)
            psi[:] = 0.0
            if samples.initial is None:
                psi[:, 0, 0] = 1.0
            else:
                _put(psi, np.broadcast_to(samples.initial, (len(samples.angles), 1 << self.qubits)))
        matrices = iter(samples.matrices)
        for segment in self.segments:
            if isinstance(segment, Matrix):
                psi = self._view(records)
                applied = _applied(next(matrices), segment.wires, psi)
                psi[:, :, 0], psi[:, :, 1] = applied.real, applied.imag
            else:
                tables, place = segment
                fresh = int(self.begins and segment is self.segments[0])
                inputs = self.scratch[: self.inputs]
                self.kernels.advance(tables, samples.angles[None], records, place, fresh, inputs)
        return records

    def _retreat(self, samples: Samples, records: Floats, lams: Floats, result: Floats) -> None:
        """Undo all gates on copies of the final states and on `lams`, adding gradients to `result` (B, A)."""
        psis = self._empty(len(records))
        psis[:] = records[:, : 2 << self.qubits]
        matrices = list(samples.matrices)
        inputs, slopes = self.scratch[: self.inputs], self.scratch[self.inputs : 2 * self.inputs]
        for segment in reversed(self.segments):
            if isinstance(segment, Matrix):
                inverse = matrices.pop().conj().swapaxes(-1, -2)
                for each in map(self._view, (psis, lams)):
                    applied = _applied(inverse, segment.wires, each)
                    each[:, :, 0], each[:, :, 1] = applied.real, applied.imag
            else:
                tables, place = segment
                self.kernels.retreat(
                    tables, samples.angles[None], records, place, psis, lams, inputs, self.scratch[-4:], slopes, result
                )  # fmt: skip

    def _empty(self, chunks: int) -> Floats:
        return self.aligned((chunks, 2 << self.qubits, self.lanes), np.float64)

    def _view(self, records: Floats) -> Floats:
        """Return the states as (K, 2^n, 2, V): amplitudes, real and imaginary part, lanes."""
        return records[:, : 2 << self.qubits].reshape(len(records), 1 << self.qubits, 2, self.lanes)

    def _amplitudes(self, records: Floats, count: int) -> Complex:
        psi = self._view(records)
        state = np.empty((len(psi), self.lanes, 1 << self.qubits), np.complex128)
        state.real, state.imag = psi[:, :, 0].swapaxes(1, 2), psi[:, :, 1].swapaxes(1, 2)
        return state.reshape(-1, 1 << self.qubits)[:count]


@lru_cache(maxsize=64)
def compiled(
    qubits: int, prepared: bool, gates: tuple[tuple[Rule | None, tuple[int, ...]], ...]
) -> StateProgram:
    """Return the program of these gates on their wires, cached; None stands for a matrix."""
    given: list[Operation | Matrix] = []
    count = 0
    for rule, wires in gates:
        if rule is None:
            given.append(Matrix(wires))
            continue
        angles = [Angle(input=count + a) if isinstance(a, int) else Angle(constant=a) for a in rule.angles]
        count += len({a for a in rule.angles if isinstance(a, int)})
        if rule.gate:
            control, targets = (wires[0], wires[1:]) if rule.controlled else (None, wires)
            given.append(Operation(rule.gate, targets, tuple(angles), control))
    return StateProgram(qubits, count, given, prepared)


def refuse_width(qubits: int) -> None:
    """Refuse states that would be too large."""
    if qubits > MAX_QUBITS:
        raise ValueError(
            f"{qubits} qubits: the state of one sample would take {_size(16 << qubits)}, and up to 8 samples are "
            f"computed together; the limit is {MAX_QUBITS} qubits, {_size(16 << MAX_QUBITS)}"
        )


def _size(count: int) -> str:
    return f"{count / 2**30:.4g} GiB" if count >= 2**30 else f"{count / 2**20:.4g} MiB"


def _put(psi: Floats, states: Complex) -> None:
    """Write states (B, 2^n) into lanes (K, 2^n, 2, V), zeros where there is no sample."""
    chunks, size, _, lanes = psi.shape
    padded = np.zeros((chunks * lanes, size), np.complex128)
    padded[: len(states)] = states
    shaped = padded.reshape(chunks, lanes, size).swapaxes(1, 2)
    psi[:, :, 0], psi[:, :, 1] = shaped.real, shaped.imag


def _applied(matrix: Complex, wires: Iterable[int], psi: Floats) -> Complex:
    """Return a matrix, (d, d) or (B, d, d), on some qubits of states (K, 2^n, 2, V), as complex (K, 2^n, V)."""
    chunks, size, _, lanes = psi.shape
    qubits = size.bit_length() - 1
    axes = [1 + wire for wire in wires]
    front = range(1, 1 + len(axes))
    state = (psi[:, :, 0] + 1j * psi[:, :, 1]).reshape(chunks, *[2] * qubits, lanes)
    moved = np.moveaxis(state, axes, front)
    columns = moved.reshape(chunks, 1 << len(axes), -1, lanes)
    if matrix.ndim == 2:
        new = np.matmul(matrix, columns.reshape(chunks, 1 << len(axes), -1))
    else:
        each = np.zeros((chunks * lanes, *matrix.shape[1:]), np.complex128)
        each[: len(matrix)] = matrix
        new = np.einsum("kvij,kjrv->kirv", each.reshape(chunks, lanes, *matrix.shape[1:]), columns)
    return np.moveaxis(new.reshape(moved.shape), front, axes).reshape(chunks, size, lanes)
