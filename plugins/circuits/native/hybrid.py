"""Networks of a linear layer, a circuit and a linear layer as one compiled sweep, see `qrlsuite.compiled.perceptron`.

Seed by seed, and in each seed chunk by chunk of samples, one a lane, all three are computed while a chunk is in the
processor's cache. Sums over samples are lane by lane over the chunks of a seed, in rising order, then over the lanes:
a seed's numbers depend neither on its place in the stack nor on its neighbors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qrlsuite.circuit import ExecutionCounter
from qrlsuite.compiled import vectors
from qrlsuite.compiled.cache import inlined, kernel
from qrlsuite.compiled.perceptron import Array, Records, Sweep, unchosen
from qrlsuite.compiled.vectors import fma, load, splat, spread, store, total
from qrlsuite.plugins.circuits.native.cpu import KEEP_BYTES, Simulator
from qrlsuite.plugins.circuits.native.kernels import measure, prepare, run, split, unrun, weigh

NO_GRADIENTS, OF_COTANGENTS, OF_ERRORS = range(3)
"""The results that `passes` differentiates: nothing, the outputs, or the squared errors of chosen outputs."""

FINE, NOT_FINITE, UNCHOSEN = range(3)
"""Findings of `passes`: expectation values may not be finite, and a choice may be no output."""


@inlined
def _product(matrix: Any, first: int, source: Any, inner: int, bias: int, target: Any, rows: int) -> None:
    """Write target[r]: matrix[bias + r] + sum over k of matrix[first + r inner + k] source[k]; vectors of lanes."""
    for r in range(rows):
        a = spread(matrix, bias + r)
        for k in range(inner):
            a = fma(spread(matrix, first + r * inner + k), load(source, k), a)
        store(target, r, a)


@inlined
def _pulled(matrix: Any, first: int, source: Any, outer: int, target: Any, rows: int) -> None:
    """Write target[r]: the sum over k of matrix[first + k rows + r] source[k]; vectors of lanes."""
    for r in range(rows):
        a = splat(source, 0.0)
        for k in range(outer):
            a = fma(spread(matrix, first + k * rows + r), load(source, k), a)
        store(target, r, a)


@inlined
def _add_products(left: Any, outer: int, right: Any, inner: int, sums: Any, at: int) -> None:
    """Add to rows of sums: left[r] right[k] at `at + r inner + k`, and left[r] behind all of these."""
    for r in range(outer):
        g = load(left, r)
        for k in range(inner):
            place = at + r * inner + k
            store(sums, place, fma(g, load(right, k), load(sums, place)))
        place = at + outer * inner + r
        store(sums, place, load(sums, place) + g)


@kernel
def passes(
    t: Any, x: Any, parameters: Any, places: Any, sizes: Any, records: Any, forth: bool, keep: bool, w: Any,
    out: Any, back: int, cotangents: Any, chosen: Any, aims: Any, share: Any, errors: Any, gradients: Any,
    x_gradients: Any, needed: bool,
) -> int:  # fmt: skip
    """Compute out (S, B, O) of x (S, B, I) if `forth`, then gradients by the arguments that `back` names.

    Parameters
    ----------
    parameters, places, sizes:
        All numbers; where in them each tensor (S, ...) begins, and its numbers of a seed: weights and biases of the
        first layer, of the circuit, and of the last layer.
    records:
        (chunks, rows, V), see `HybridSweep`. With `keep` every chunk has its own, else all the first.
    cotangents:
        (S, B, O), for OF_COTANGENTS.
    chosen, aims, share, errors:
        For OF_ERRORS: (S, B) each but `share`; outputs `chosen` minus `aims` are written to `errors`, and gradients
        belong to the sum of `share` times their squares.
    gradients, x_gradients:
        Laid out as parameters and x are; the latter only if `needed`.
    """
    lanes, batch, seeds, tensors = records.shape[2], x.shape[1], x.shape[0], places.shape[0]
    i, o, n, z = x.shape[2], out.shape[2], w.slopes.shape[0], t.observables.shape[0]
    circuit, behind = n * i + n, w.sums.shape[0] - o * z - o  # rows of sums where the circuit's begin and end
    psi, lam = w.pair[0], w.pair[1]
    flat, zero, doubt = w.flat, splat(w.values, 0.0), splat(w.values, 0.0)
    chunk, start = 0, np.int64(0)  # of a literal 0, numba compiles a second version of what it calls
    for s in range(seeds):
        at = 0
        for k in range(2, tensors - 2):
            for j in range(sizes[k]):
                flat[0, at + j] = parameters[places[k] + s * sizes[k] + j]
            at += sizes[k]
        weights, biases = places[0] + s * sizes[0], places[1] + s * sizes[1]
        last, last_biases = places[tensors - 2] + s * o * z, places[tensors - 1] + s * o
        if back:
            for p in range(w.sums.shape[0]):
                store(w.sums, p, zero)
        for first in range(0, batch, lanes):
            samples = min(lanes, batch - first)
            record = records[chunk]
            if keep:
                chunk += 1
            rows = record.shape[0] - i - n - z
            seen, inner, means = (
                record[rows : rows + i],
                record[rows + i : rows + i + n],
                record[rows + i + n :],
            )
            states, trig, gates = split(t, record[:rows])
            if forth:
                for k in range(i):
                    for v in range(samples):
                        seen[k, v] = x[s, first + v, k]
                    seen[k, samples:] = 0.0
                _product(parameters, weights, seen, i, biases, inner, n)
                prepare(t, flat, start, inner, trig, gates)
                run(t, states, gates)
                measure(t, states, w.values, w.results)
                for q in range(z):
                    mean = load(w.results, t.observables[q])
                    doubt = doubt + (mean - mean)  # not 0 of infinity and NaN
                    store(means, q, mean)
                _product(parameters, last, means, z, last_biases, w.outputs, o)
                for v in range(samples):
                    for a in range(o):
                        out[s, first + v, a] = w.outputs[a, v]
            if back:
                for a in range(o):
                    store(w.outputs, a, zero)
                if back == OF_COTANGENTS:
                    for v in range(samples):
                        for a in range(o):
                            w.outputs[a, v] = cotangents[s, first + v, a]
                else:
                    for v in range(samples):
                        a = chosen[s, first + v]
                        if a < 0 or a >= o:
                            return UNCHOSEN
                        error = out[s, first + v, a] - aims[s, first + v]
                        errors[s, first + v] = error
                        w.outputs[a, v] = share * (error + error)
                _add_products(w.outputs, o, means, z, w.sums, behind)
                _pulled(parameters, last, w.outputs, o, w.pulled, z)
                for q in range(w.results.shape[0]):
                    store(w.results, q, zero)
                for q in range(z):
                    store(w.results, t.observables[q], load(w.pulled, q))
                weigh(t, states, psi, lam, w.values, w.results)
                for k in range(n):
                    store(w.slopes, k, zero)
                unrun(
                    t, psi, lam, gates, trig, inner, w.overlap, flat, start, w.sums[circuit:behind], w.slopes
                )
                _add_products(w.slopes, n, seen, i, w.sums, start)
                if needed:
                    _pulled(parameters, weights, w.slopes, n, w.pulled, i)
                    for v in range(samples):
                        for k in range(i):
                            x_gradients[s, first + v, k] = w.pulled[k, v]
        if back:
            at = 0
            for k in range(tensors):
                for j in range(sizes[k]):
                    gradients[places[k] + s * sizes[k] + j] = total(load(w.sums, at + j))
                at += sizes[k]
    return FINE if total(doubt) == 0.0 else NOT_FINITE


class _Work(NamedTuple):
    """Working memory of one chunk, V lanes; `sums` has a row for each number of a seed, `flat` the circuit's."""

    values: NDArray[Any]
    results: NDArray[Any]
    outputs: NDArray[Any]
    pulled: NDArray[Any]
    pair: NDArray[Any]
    overlap: NDArray[Any]
    slopes: NDArray[Any]
    sums: NDArray[Any]
    flat: NDArray[Any]


class _Pass(NamedTuple):
    """A pass: its inputs, and the records of its chunks; None where they are computed again."""

    x: Array
    records: Records | None


class _Differentiated(NamedTuple):
    """The results that `passes` differentiates, and where to: by default nothing."""

    back: int = NO_GRADIENTS
    cotangents: Array = np.empty((1, 1, 1), np.float32)
    chosen: NDArray[np.int64] = np.empty((1, 1), np.int64)
    aims: Array = np.empty((1, 1), np.float32)
    share: np.float32 = np.float32(0.0)
    errors: Array = np.empty((1, 1), np.float32)
    gradients: Array = np.empty(1, np.float32)
    x_gradients: Array = np.empty((1, 1, 1), np.float32)
    needed: bool = False


_NOTHING = _Differentiated()


class HybridSweep(Sweep):
    """Linear layer, circuit and linear layer of S networks.

    A chunk's record has the rows of a circuit's, see `kernels.record_rows`, then inputs of the network, inputs of the
    circuit and expectation values.

    Parameters
    ----------
    tensors:
        Weights (S, I, in) and biases (S, I), the circuit's parameters (S, ...), weights (S, out, O), biases (S, out).
    simulator:
        The circuit's.
    executions:
        Counts passes.
    refuse:
        Raises an error for inputs (S, B, in) whose expectation values are not finite.
    """

    def __init__(
        self,
        tensors: Sequence[Tensor],
        simulator: Simulator,
        executions: ExecutionCounter,
        refuse: Callable[[Tensor], Any],
    ) -> None:
        super().__init__(tensors, tensors[0].shape[2])
        self.simulator, self.executions, self.refuse = simulator, executions, refuse
        self.outputs = tensors[-1].shape[1]
        numbers = np.array([each[0].numel() for each in tensors])
        self.sizes, self.begins = numbers, np.concatenate([[0], np.cumsum(self.seeds * numbers)[:-1]])
        work, program = simulator.workspace(torch.float32), simulator.program
        lanes = work.record.shape[2]
        shown = len(program.observables)
        self.rows = work.record.shape[1] + self.inputs + program.inputs + shown
        rows = (self.outputs, max(self.inputs, shown), int(numbers.sum()))
        outputs, pulled, sums = (vectors.aligned((count, lanes), np.float32) for count in rows)
        self.work = _Work(
            work.scratch.values, work.scratch.results, outputs, pulled, work.pair, work.overlap, work.slopes, sums,
            np.empty((1, program.parameters), np.float32),
        )  # fmt: skip

    def values(self, x: Array, keep: bool) -> tuple[Array, _Pass]:
        """Return outputs and what `pull` needs, see `Sweep`."""
        out = np.empty((*x.shape[:2], self.outputs), np.float32)
        records = self._records(x.shape[1]) if keep else None
        self._pass(x, records, True, out)
        self.executions.count_forward(x.shape[1])
        return out, _Pass(x, records)

    def pull(self, records: _Pass, cotangents: Array, gradients: Array, x_gradient: Array | None) -> None:
        """Write gradients, see `Sweep`."""
        x, kept = records
        wanted = _Differentiated(OF_COTANGENTS, cotangents, gradients=gradients)
        if x_gradient is not None:
            wanted = wanted._replace(x_gradients=x_gradient, needed=True)
        self._pass(x, kept, kept is None, np.empty_like(cotangents), wanted)
        self.executions.count_backward(x.shape[1])

    def chosen_errors(self, x: Array, places: NDArray[np.int64], aims: Array, weight: float = 1.0) -> Array:
        """Return errors and set gradients, see `Sweep`: chunk by chunk there and back, which keeps no records."""
        out, errors = np.empty((*x.shape[:2], self.outputs), np.float32), np.empty(x.shape[:2], np.float32)
        if not places.shape == aims.shape == errors.shape:
            raise unchosen(places, out)
        share = np.float32(weight) / np.float32(x.shape[1])
        own = self.own_gradients()
        wanted = _Differentiated(
            OF_ERRORS, chosen=places, aims=aims, share=share, errors=errors, gradients=own
        )
        self._pass(x, None, True, out, wanted)
        self.executions.count_forward(x.shape[1])
        self.executions.count_backward(x.shape[1])
        self.show_gradients()
        return errors

    def compile(self) -> None:
        """Compile the kernel, or load it, by a pass there and back of one sample that is not counted."""
        x, out = (
            np.zeros((self.seeds, 1, self.inputs), np.float32),
            np.zeros((self.seeds, 1, self.outputs), np.float32),
        )
        self._pass(
            x,
            None,
            True,
            np.empty_like(out),
            _Differentiated(OF_COTANGENTS, out, gradients=np.empty_like(self.parameters)),
        )

    def _records(self, batch: int) -> Records | None:
        """Return memory for the records of all chunks, None if they take too much."""
        lanes = self.work.sums.shape[1]
        chunks = self.seeds * -(-batch // lanes)
        if 4 * chunks * self.rows * lanes > KEEP_BYTES:
            return None
        return Records("circuit", chunks, self.rows, lanes)

    def _pass(
        self,
        x: Array,
        kept: Records | None,
        forth: bool,
        out: Array,
        wanted: _Differentiated = _NOTHING,
    ) -> None:
        if x.ndim != 3 or x.shape[0] != self.seeds or x.shape[2] != self.inputs:
            raise ValueError(
                f"networks of {self.seeds} seeds take x ({self.seeds}, B, {self.inputs}); x is {x.shape}"
            )
        records = kept or Records("circuit", 1, self.rows, self.work.sums.shape[1])
        told = passes(
            self.simulator.tables, x, self.parameters, self.begins, self.sizes, records.array, forth,
            kept is not None, self.work, out, *wanted,
        )  # fmt: skip
        if told == NOT_FINITE:
            self.refuse(torch.from_numpy(x))
        elif told == UNCHOSEN:
            raise unchosen(wanted.chosen, out)
