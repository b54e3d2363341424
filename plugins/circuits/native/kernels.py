"""The compiled loops: seed by seed, and in each seed chunk by chunk of lanes, through the whole program.

A chunk's state stays in the processor's cache from the first gate to the last. Every seed starts a chunk of its
own, so that its numbers depend neither on its place in the stack nor on its neighbors. Lanes of a last, partly
filled chunk compute on inputs of zero and are dropped.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrlsuite.plugins.circuits.native.cache import inlined, kernel
from qrlsuite.plugins.circuits.native.program import AXIS_X, AXIS_Y, HADAMARD, PERMUTE, PHASE, ROTATE, Program
from qrlsuite.plugins.circuits.native.sweeps import (
    flip,
    hadamard,
    permute,
    rotate,
    unpermute,
    unrotate,
)
from qrlsuite.plugins.circuits.native.trigonometry import sine_cosine
from qrlsuite.plugins.circuits.native.vectors import load, splat, store, total

Tables = namedtuple(
    "Tables",
    "qubits steps angles constants rotations factors blocks cycles signs start observables",
)
"""A program's arrays, see `Program` for each, in the form that kernels take."""


class Scratch(NamedTuple):
    """Working memory of one chunk, V lanes: see `scratch`."""

    inputs: NDArray[Any]
    trig: NDArray[Any]
    gates: NDArray[Any]
    values: NDArray[Any]
    results: NDArray[Any]


def tables(program: Program) -> Tables:
    """Return a program's arrays for the kernels."""
    return Tables(*(getattr(program, name) for name in Tables._fields))


def scratch(program: Program, lanes: int, dtype: Any) -> Scratch:
    """Allocate working memory: inputs (I, V), trig (R, 2, V), gates (G, 6, V), values (2^n, V), results (n, V)."""
    blocks, rotations = len(program.blocks) - 1, len(program.rotations)
    return Scratch(
        np.empty((max(1, program.inputs), lanes), dtype),
        np.empty((max(1, rotations), 2, lanes), dtype),
        np.empty((max(1, blocks), 6, lanes), dtype),
        np.empty((1 << program.qubits, lanes), dtype),
        np.empty((program.qubits, lanes), dtype),
    )


@inlined
def _fill_inputs(inputs: Any, seed: int, first: int, lanes: Any) -> None:
    """Transpose the samples of a chunk into rows of lanes; zeros where there is no sample."""
    for i in range(inputs.shape[2]):
        for v in range(lanes.shape[1]):
            lanes[i, v] = inputs[seed, first + v, i] if first + v < inputs.shape[1] else 0.0


@inlined
def _angle(t: Any, index: int, flat: Any, seed: int, lanes: Any) -> Any:
    """Return constant + scale * input + weight of an angle."""
    value = splat(lanes, t.constants[index])
    which, scale, weight = t.angles[index, 0], t.angles[index, 1], t.angles[index, 2]
    if which >= 0:
        x = load(lanes, which)
        value = value + (splat(lanes, flat[seed, scale]) * x if scale >= 0 else x)
    if weight >= 0:
        value = value + splat(lanes, flat[seed, weight])
    return value


@inlined
def _prepare(t: Any, flat: Any, seed: int, w: Any) -> None:
    """Fill in sine and cosine of every rotation's half angle, and (a, b) and the phase of every block."""
    one, zero = splat(w.gates, 1.0), splat(w.gates, 0.0)
    for g in range(t.blocks.shape[0] - 1):
        ar, ai, br, bi, cr, ci = one, zero, zero, zero, one, zero
        for r in range(t.blocks[g], t.blocks[g + 1]):
            axis = t.rotations[r, 0]
            angle = _angle(t, t.rotations[r, 1], flat, seed, w.inputs)
            half = 1.0 if axis == PHASE else 0.5
            s, c = sine_cosine(angle * splat(w.gates, half * t.factors[r]))
            store(w.trig, 2 * r, s)
            store(w.trig, 2 * r + 1, c)
            if axis == AXIS_X:  # multiply from the left by [[c, -i s], [-i s, c]]
                ar, ai, br, bi = c * ar + s * bi, c * ai - s * br, c * br + s * ai, c * bi - s * ar
            elif axis == AXIS_Y:  # [[c, -s], [s, c]]
                ar, ai, br, bi = c * ar - s * br, c * ai - s * bi, s * ar + c * br, s * ai + c * bi
            elif axis == PHASE:
                cr, ci = c * cr - s * ci, c * ci + s * cr
            else:  # diag(c - i s, c + i s)
                ar, ai, br, bi = c * ar + s * ai, c * ai - s * ar, c * br - s * bi, c * bi + s * br
        store(w.gates, 6 * g, ar)
        store(w.gates, 6 * g + 1, ai)
        store(w.gates, 6 * g + 2, br)
        store(w.gates, 6 * g + 3, bi)
        store(w.gates, 6 * g + 4, cr)
        store(w.gates, 6 * g + 5, ci)


@inlined
def _begin(t: Any, state: Any) -> None:
    """Put the state into |0...0> with the opening Hadamards applied."""
    zero = splat(state, 0.0)
    open_bits = 0
    for q in range(t.start.shape[0]):
        open_bits |= 1 << t.start[q]
    amplitude = splat(state, 2.0 ** (-0.5 * t.start.shape[0]))
    for i in range(1 << t.qubits):
        store(state, 2 * i, zero if i & ~open_bits else amplitude)
        store(state, 2 * i + 1, zero)


@inlined
def _run(t: Any, state: Any, w: Any) -> None:
    """Apply every step."""
    for m in range(t.steps.shape[0]):
        kind, a, b, c, d = t.steps[m, 0], t.steps[m, 1], t.steps[m, 2], t.steps[m, 3], t.steps[m, 4]
        if kind == ROTATE:
            rotate(state, t.qubits, a, b, w.gates, c, d)
        elif kind == HADAMARD:
            hadamard(state, t.qubits, a, b, c)
        elif kind == PERMUTE:
            permute(state, t.cycles, a, b)
        else:
            flip(state, t.signs, a)


@inlined
def _measure(t: Any, state: Any, w: Any) -> None:
    """Write <Z> of every bit to `results`: fold the probabilities, highest bit first."""
    size = 1 << t.qubits
    for i in range(size):
        re, im = load(state, 2 * i), load(state, 2 * i + 1)
        store(w.values, i, re * re + im * im)
    for bit in range(t.qubits - 1, -1, -1):
        size >>= 1
        difference = splat(w.values, 0.0)
        for i in range(size):
            x, y = load(w.values, i), load(w.values, i + size)
            difference += x - y
            store(w.values, i, x + y)
        store(w.results, bit, difference)


@kernel
def forward(t: Any, inputs: Any, flat: Any, states: Any, keep: int, w: Any, out: Any) -> None:
    """Compute expectation values out (S, B, O) from inputs (S, B, I) and parameters (S, P).

    `states` (K, 2^n, 2, V) receives the final state of every chunk where `keep` is 1; else K = 1 serves all.
    """
    lanes = w.gates.shape[2]
    chunks = (inputs.shape[1] + lanes - 1) // lanes
    for seed in range(inputs.shape[0]):
        for chunk in range(chunks):
            first = chunk * lanes
            state = states[seed * chunks + chunk if keep else 0]
            _fill_inputs(inputs, seed, first, w.inputs)
            _prepare(t, flat, seed, w)
            _begin(t, state)
            _run(t, state, w)
            _measure(t, state, w)
            for v in range(min(lanes, inputs.shape[1] - first)):
                for o in range(t.observables.shape[0]):
                    out[seed, first + v, o] = w.results[t.observables[o], v]


@inlined
def _weigh(t: Any, cotangent: Any, seed: int, first: int, psi: Any, lam: Any, w: Any) -> None:
    """Write lambda = (sum_o g_o Z_o) psi; the diagonal is built by doubling, highest bit first."""
    for q in range(t.qubits):
        store(w.results, q, splat(w.values, 0.0))
    for o in range(t.observables.shape[0]):
        for v in range(w.results.shape[1]):
            inside = first + v < cotangent.shape[1]
            w.results[t.observables[o], v] = cotangent[seed, first + v, o] if inside else 0.0
    store(w.values, 0, splat(w.values, 0.0))
    for bit in range(t.qubits - 1, -1, -1):
        g = load(w.results, bit)
        for i in range((1 << (t.qubits - 1 - bit)) - 1, -1, -1):
            f = load(w.values, i)
            store(w.values, 2 * i, f + g)
            store(w.values, 2 * i + 1, f - g)
    for i in range(1 << t.qubits):
        f = load(w.values, i)
        store(lam, 2 * i, f * load(psi, 2 * i))
        store(lam, 2 * i + 1, f * load(psi, 2 * i + 1))


@inlined
def _chain(t: Any, block: int, overlap: Any, flat: Any, seed: int, w: Any, sums: Any, slopes: Any) -> None:
    """Turn a block's overlaps into gradients: of parameters (`sums`) and of inputs (`slopes`).

    From the last rotation to the first: the gradient by its angle is the component of (T_X, T_Y, T_Z) along its
    axis; then the vector is turned back by the angle, into the frame of the rotation before.
    """
    x, y, z, phase = load(overlap, 0), load(overlap, 1), load(overlap, 2), load(overlap, 3)
    two = splat(w.gates, 2.0)
    for r in range(t.blocks[block + 1] - 1, t.blocks[block] - 1, -1):
        axis, angle = t.rotations[r, 0], t.rotations[r, 1]
        half_s, half_c = load(w.trig, 2 * r), load(w.trig, 2 * r + 1)
        s, c = two * half_s * half_c, half_c * half_c - half_s * half_s
        if axis == AXIS_X:
            gradient = x
            y, z = c * y + s * z, c * z - s * y
        elif axis == AXIS_Y:
            gradient = y
            z, x = c * z + s * x, c * x - s * z
        elif axis == PHASE:
            gradient = splat(w.gates, -2.0) * phase
        else:
            gradient = z
            x, y = c * x + s * y, c * y - s * x
        gradient = gradient * splat(w.gates, t.factors[r])
        which, scale, weight = t.angles[angle, 0], t.angles[angle, 1], t.angles[angle, 2]
        if weight >= 0:
            store(sums, weight, load(sums, weight) + gradient)
        if which >= 0:
            if scale >= 0:
                store(sums, scale, load(sums, scale) + gradient * load(w.inputs, which))
                gradient = gradient * splat(w.gates, flat[seed, scale])
            store(slopes, which, load(slopes, which) + gradient)


@inlined
def _unrun(
    t: Any, psi: Any, lam: Any, w: Any, overlap: Any, flat: Any, seed: int, sums: Any, slopes: Any
) -> None:
    """Undo every step on both states, last step first, collecting gradients on the way."""
    for m in range(t.steps.shape[0] - 1, -1, -1):
        kind, a, b, c, d = t.steps[m, 0], t.steps[m, 1], t.steps[m, 2], t.steps[m, 3], t.steps[m, 4]
        if kind == ROTATE:
            unrotate(psi, lam, t.qubits, a, b, w.gates, c, d, overlap)
            _chain(t, c, overlap, flat, seed, w, sums, slopes)
        elif kind == HADAMARD:
            hadamard(psi, t.qubits, a, b, c)
            hadamard(lam, t.qubits, a, b, c)
        elif kind == PERMUTE:
            unpermute(psi, t.cycles, a, b)
            unpermute(lam, t.cycles, a, b)
        else:
            flip(psi, t.signs, a)
            flip(lam, t.signs, a)


@kernel
def backward(
    t: Any,
    inputs: Any,
    flat: Any,
    cotangent: Any,
    states: Any,
    kept: int,
    pair: Any,
    w: Any,
    overlap: Any,
    sums: Any,
    slopes: Any,
    grad_inputs: Any,
    grad_flat: Any,
) -> None:
    """Compute gradients of sum(cotangent * expectation values): grad_inputs (S, B, I), grad_flat (S, P).

    `states` are the final states that `forward` kept; where `kept` is 0 they are computed again. `pair`
    (2, 2^n, 2, V) holds psi and lambda of one chunk, `sums` (P, V) and `slopes` (I, V) its gradients.
    """
    lanes = w.gates.shape[2]
    chunks = (inputs.shape[1] + lanes - 1) // lanes
    psi, lam = pair[0], pair[1]
    zero = splat(w.gates, 0.0)
    for seed in range(inputs.shape[0]):
        for p in range(flat.shape[1]):
            store(sums, p, zero)
        for chunk in range(chunks):
            first = chunk * lanes
            _fill_inputs(inputs, seed, first, w.inputs)
            _prepare(t, flat, seed, w)
            if kept:
                final = states[seed * chunks + chunk]
                for i in range(2 << t.qubits):
                    store(psi, i, load(final, i))
            else:
                _begin(t, psi)
                _run(t, psi, w)
            _weigh(t, cotangent, seed, first, psi, lam, w)
            for i in range(slopes.shape[0]):
                store(slopes, i, zero)
            _unrun(t, psi, lam, w, overlap, flat, seed, sums, slopes)
            for v in range(min(lanes, inputs.shape[1] - first)):
                for i in range(slopes.shape[0]):
                    grad_inputs[seed, first + v, i] = slopes[i, v]
        for p in range(flat.shape[1]):
            grad_flat[seed, p] = total(load(sums, p))
