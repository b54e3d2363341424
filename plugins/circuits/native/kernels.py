"""The compiled loops: seed by seed, and in each seed chunk by chunk of lanes, through the whole program.

A chunk's state stays in the processor's cache from the first gate to the last. Every seed starts a chunk of its
own, so that its numbers depend neither on its place in the stack nor on its neighbors. Lanes of a last, partly
filled chunk compute on inputs of zero and are dropped.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

from numpy.typing import NDArray

from qrlsuite.compiled.cache import inlined, kernel
from qrlsuite.compiled.trigonometry import sine_cosine
from qrlsuite.compiled.vectors import aligned, load, splat, store, total
from qrlsuite.plugins.circuits.native.program import (
    AXIS_X,
    AXIS_Y,
    HADAMARD,
    ON_CONTROL,
    ON_TARGET,
    PERMUTE,
    PHASE,
    ROTATE,
    Program,
)
from qrlsuite.plugins.circuits.native.sweeps import (
    HALF_ROOT,
    flip,
    grow,
    hadamard,
    permute,
    rotate,
    unpermute,
    unrotate,
)

Tables = namedtuple(
    "Tables",
    "components steps angles constants rotations factors blocks cycles negative products observables",
)
"""A program's arrays, see `Program` for each, in the form that kernels take."""


class Scratch(NamedTuple):
    """Working memory of one chunk, V lanes: see `scratch`."""

    inputs: NDArray[Any]
    values: NDArray[Any]
    results: NDArray[Any]


def tables(program: Program) -> Tables:
    """Return a program's arrays for the kernels."""
    return Tables(*(getattr(program, name) for name in Tables._fields))


def scratch(program: Program, lanes: int, dtype: Any) -> Scratch:
    """Allocate working memory: inputs (I, V), values (2^n of the largest component, V), results (n + Q, V)."""
    results = program.qubits + len(program.products)
    rows = (program.inputs, 1 << int(program.components[:, 0].max()), results)
    return Scratch(*(aligned((count, lanes), dtype) for count in rows))


def record_rows(program: Program) -> tuple[int, int, int]:
    """Return how many rows of lanes a chunk's record has: amplitudes, sines and cosines, blocks."""
    return 2 * program.amplitudes, 2 * len(program.rotations), 6 * (len(program.blocks) - 1)


@inlined
def fill_inputs(inputs: Any, seed: int, first: int, lanes: Any) -> None:
    """Transpose the samples of a chunk into rows of lanes; zeros where there is no sample."""
    for i in range(inputs.shape[2]):
        for v in range(lanes.shape[1]):
            lanes[i, v] = inputs[seed, first + v, i] if first + v < inputs.shape[1] else 0.0


@inlined
def split(t: Any, record: Any) -> Any:
    """Return a chunk's state, sines and cosines, and blocks: views of its record."""
    first = record.shape[0] - 6 * (t.blocks.shape[0] - 1)
    second = first - 2 * t.rotations.shape[0]
    return record[:second], record[second:first], record[first:]


@inlined
def prepare(t: Any, flat: Any, seed: int, inputs: Any, trig: Any, gates: Any) -> None:
    """Fill in sine and cosine of every rotation's half angle, and (a, b) and the phase of every block.

    An angle is constant + scale * input + weight. Its lines stand in the loop, and are no function of `t`: at each call
    numba counts its arrays' references, which takes longer than a sine.
    """
    one, zero = splat(inputs, 1.0), splat(inputs, 0.0)
    for g in range(t.blocks.shape[0] - 1):
        ar, ai, br, bi, cr, ci = one, zero, zero, zero, one, zero
        for r in range(t.blocks[g], t.blocks[g + 1]):
            axis, index = t.rotations[r, 0], t.rotations[r, 1]
            which, scale, weight = t.angles[index, 0], t.angles[index, 1], t.angles[index, 2]
            angle = splat(inputs, t.constants[index])
            if which >= 0:
                x = load(inputs, which)
                angle = angle + (splat(inputs, flat[seed, scale]) * x if scale >= 0 else x)
            if weight >= 0:
                angle = angle + splat(inputs, flat[seed, weight])
            half = 1.0 if axis == PHASE else 0.5
            s, c = sine_cosine(angle * splat(inputs, half * t.factors[r]))
            store(trig, 2 * r, s)
            store(trig, 2 * r + 1, c)
            if axis == AXIS_X:  # multiply from the left by [[c, -i s], [-i s, c]]
                ar, ai, br, bi = c * ar + s * bi, c * ai - s * br, c * br + s * ai, c * bi - s * ar
            elif axis == AXIS_Y:  # [[c, -s], [s, c]]
                ar, ai, br, bi = c * ar - s * br, c * ai - s * bi, s * ar + c * br, s * ai + c * bi
            elif axis == PHASE:
                cr, ci = c * cr - s * ci, c * ci + s * cr
            else:  # diag(c - i s, c + i s)
                ar, ai, br, bi = c * ar + s * ai, c * ai - s * ar, c * br - s * bi, c * bi + s * br
        store(gates, 6 * g, ar)
        store(gates, 6 * g + 1, ai)
        store(gates, 6 * g + 2, br)
        store(gates, 6 * g + 3, bi)
        store(gates, 6 * g + 4, cr)
        store(gates, 6 * g + 5, ci)


@inlined
def _component(t: Any, c: int, states: Any) -> Any:
    """Return a component's number of qubits, and its state as a view of the state of all components."""
    qubits, first = t.components[c, 0], t.components[c, 1]
    return qubits, states[2 * first : 2 * (first + (1 << qubits))]


@inlined
def _begin(t: Any, c: int, state: Any) -> None:
    """Write the first amplitude of |0...0> with the opening Hadamards applied, and the factors of joined ones."""
    opening, weight = t.components[c, 5], 1.0
    for q in range(t.components[c, 0]):
        if opening & (1 << q):
            weight *= HALF_ROOT
    for _ in range(t.components[c, 6]):
        weight *= HALF_ROOT
    store(state, 0, splat(state, weight))
    store(state, 1, splat(state, 0.0))


@inlined
def _take(t: Any, component: int, n: int, state: Any, gates: Any, low: int) -> None:
    """Take every step of a component, whose state has grown to the bits from `low` on: all if it is 0, else none."""
    opening = t.components[component, 5]
    for m in range(t.components[component, 3], t.components[component, 4]):
        kind, a, b, c, d = t.steps[m, 0], t.steps[m, 1], t.steps[m, 2], t.steps[m, 3], t.steps[m, 4]
        bit = 0 if kind != ROTATE else b if a < 0 else min(a, b)
        grow(state, n, low, bit, opening)
        low = min(low, bit)
        if kind == ROTATE:
            rotate(state, n, a, b, gates, c, d, t.steps[m, 5], low)
        elif kind == HADAMARD:
            hadamard(state, n, a, b, c)
        elif kind == PERMUTE:
            permute(state, t.cycles, a, b)
        else:
            flip(state, t.negative, a, b)
    grow(state, n, low, 0, opening)


@inlined
def run(t: Any, states: Any, gates: Any) -> None:
    """Bring every component into its final state."""
    for component in range(t.components.shape[0]):
        n, state = _component(t, component, states)
        _begin(t, component, state)
        _take(t, component, n, state, gates, n)


@inlined
def _odd(state: int) -> int:
    """Return whether an odd number of bits is set."""
    odd = 0
    while state:
        odd ^= 1
        state &= state - 1
    return odd


@inlined
def measure(t: Any, states: Any, values: Any, results: Any) -> None:
    """Write <Z> of every bit to `results`: fold the probabilities, highest bit first. Products come before, in sums."""
    products = results.shape[0] - t.products.shape[0]
    for c in range(t.components.shape[0]):
        qubits, state = _component(t, c, states)
        size = 1 << qubits
        for i in range(size):
            re, im = load(state, 2 * i), load(state, 2 * i + 1)
            store(values, i, re * re + im * im)
        for p in range(t.products.shape[0]):
            if t.products[p, 0] == c:
                mean = splat(values, 0.0)
                for i in range(size):
                    x = load(values, i)
                    mean = mean - x if _odd(i & t.products[p, 1]) else mean + x
                store(results, products + p, mean)
        for bit in range(qubits - 1, -1, -1):
            size >>= 1
            difference = splat(values, 0.0)
            for i in range(size):
                x, y = load(values, i), load(values, i + size)
                difference += x - y
                store(values, i, x + y)
            store(results, t.components[c, 2] + bit, difference)


@kernel
def forward(t: Any, inputs: Any, flat: Any, records: Any, keep: int, w: Any, out: Any) -> None:
    """Compute expectation values out (S, B, O) from inputs (S, B, I) and parameters (S, P).

    `records` (K, R, V), see `record_rows`, receive the final state and the gates of every chunk where `keep` is 1;
    else K = 1 serves all.
    """
    lanes = w.inputs.shape[1]
    chunks = (inputs.shape[1] + lanes - 1) // lanes
    for seed in range(inputs.shape[0]):
        for chunk in range(chunks):
            first = chunk * lanes
            states, trig, gates = split(t, records[seed * chunks + chunk if keep else 0])
            fill_inputs(inputs, seed, first, w.inputs)
            prepare(t, flat, seed, w.inputs, trig, gates)
            run(t, states, gates)
            measure(t, states, w.values, w.results)
            for v in range(min(lanes, inputs.shape[1] - first)):
                for o in range(t.observables.shape[0]):
                    out[seed, first + v, o] = w.results[t.observables[o], v]


@inlined
def weigh(t: Any, final: Any, psi: Any, lam: Any, values: Any, results: Any) -> None:
    """Copy the final state to psi and write lambda = (sum_o g_o Z_o) psi; `results` hold g of every bit and product.

    The diagonal of a component is built by doubling, highest bit first.
    """
    zero = splat(values, 0.0)
    for c in range(t.components.shape[0]):
        qubits, start = t.components[c, 0], t.components[c, 1]
        store(values, 0, zero)
        for bit in range(qubits - 1, -1, -1):
            g = load(results, t.components[c, 2] + bit)
            for i in range((1 << (qubits - 1 - bit)) - 1, -1, -1):
                f = load(values, i)
                store(values, 2 * i, f + g)
                store(values, 2 * i + 1, f - g)
        for p in range(t.products.shape[0]):
            if t.products[p, 0] == c:
                g = load(results, results.shape[0] - t.products.shape[0] + p)
                for i in range(1 << qubits):
                    f = load(values, i)
                    store(values, i, f - g if _odd(i & t.products[p, 1]) else f + g)
        for i in range(1 << qubits):
            f = load(values, i)
            j = 2 * (start + i)
            re, im = load(final, j), load(final, j + 1)
            store(psi, j, re)
            store(psi, j + 1, im)
            store(lam, j, f * re)
            store(lam, j + 1, f * im)


@inlined
def chain(
    t: Any,
    block: int,
    overlap: Any,
    flat: Any,
    seed: int,
    inputs: Any,
    trig: Any,
    sums: Any,
    slopes: Any,
) -> None:
    """Turn a block's overlaps into gradients: of parameters (`sums`) and of inputs (`slopes`).

    From the last rotation to the first: the gradient by its angle is the component of (T_X, T_Y, T_Z) along its
    axis; then the vector is turned back by the angle, into the frame of the rotation before.
    """
    x, y, z, phase = load(overlap, 0), load(overlap, 1), load(overlap, 2), load(overlap, 3)
    two = splat(inputs, 2.0)
    for r in range(t.blocks[block + 1] - 1, t.blocks[block] - 1, -1):
        axis, angle = t.rotations[r, 0], t.rotations[r, 1]
        half_s, half_c = load(trig, 2 * r), load(trig, 2 * r + 1)
        s, c = two * half_s * half_c, half_c * half_c - half_s * half_s
        if axis == AXIS_X:
            gradient = x
            y, z = c * y + s * z, c * z - s * y
        elif axis == AXIS_Y:
            gradient = y
            z, x = c * z + s * x, c * x - s * z
        elif axis == PHASE:
            gradient = splat(inputs, -2.0) * phase
        else:
            gradient = z
            x, y = c * x + s * y, c * y - s * x
        gradient = gradient * splat(inputs, t.factors[r])
        which, scale, weight = t.angles[angle, 0], t.angles[angle, 1], t.angles[angle, 2]
        if weight >= 0:
            store(sums, weight, load(sums, weight) + gradient)
        if which >= 0:
            if scale >= 0:
                store(sums, scale, load(sums, scale) + gradient * load(inputs, which))
                gradient = gradient * splat(inputs, flat[seed, scale])
            store(slopes, which, load(slopes, which) + gradient)


@inlined
def unrun(
    t: Any,
    psis: Any,
    lams: Any,
    gates: Any,
    trig: Any,
    inputs: Any,
    overlap: Any,
    flat: Any,
    seed: int,
    sums: Any,
    slopes: Any,
) -> None:
    """Undo every step on both states, last step first, collecting gradients on the way."""
    for component in range(t.components.shape[0]):
        n, psi = _component(t, component, psis)
        n, lam = _component(t, component, lams)
        weight = 1.0  # half for every Hadamard undone without its factor
        for m in range(t.components[component, 4] - 1, t.components[component, 3] - 1, -1):
            kind, a, b, c, d = t.steps[m, 0], t.steps[m, 1], t.steps[m, 2], t.steps[m, 3], t.steps[m, 4]
            if kind == ROTATE:
                behind = t.steps[m, 5]
                weight *= (0.5 if behind & ON_TARGET else 1.0) * (0.5 if behind & ON_CONTROL else 1.0)
                unrotate(psi, lam, n, a, b, gates, c, d, behind, weight, overlap)
                chain(t, c, overlap, flat, seed, inputs, trig, sums, slopes)
            elif kind == HADAMARD:
                hadamard(psi, n, a, b, c)
                hadamard(lam, n, a, b, c)
            elif kind == PERMUTE:
                unpermute(psi, t.cycles, a, b)
                unpermute(lam, t.cycles, a, b)
            else:
                flip(psi, t.negative, a, b)
                flip(lam, t.negative, a, b)


@kernel
def backward(
    t: Any,
    inputs: Any,
    flat: Any,
    cotangent: Any,
    records: Any,
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

    `records` are the records of `forward`; if `kept` is 0 they are computed again. `pair` (2, 2^(n + 1), V) holds psi
    and lambda of one chunk, `overlap` (4, V), `sums` (P, V) and `slopes` (I, V) its gradients.
    """
    lanes = w.inputs.shape[1]
    chunks = (inputs.shape[1] + lanes - 1) // lanes
    psi, lam = pair[0], pair[1]
    zero = splat(w.inputs, 0.0)
    for seed in range(inputs.shape[0]):
        for p in range(flat.shape[1]):
            store(sums, p, zero)
        for chunk in range(chunks):
            first = chunk * lanes
            states, trig, gates = split(t, records[seed * chunks + chunk if kept else 0])
            fill_inputs(inputs, seed, first, w.inputs)
            if not kept:
                prepare(t, flat, seed, w.inputs, trig, gates)
                run(t, states, gates)
            for q in range(w.results.shape[0]):
                store(w.results, q, zero)
            for o in range(t.observables.shape[0]):
                for v in range(min(lanes, inputs.shape[1] - first)):
                    w.results[t.observables[o], v] = cotangent[seed, first + v, o]
            weigh(t, states, psi, lam, w.values, w.results)
            for i in range(slopes.shape[0]):
                store(slopes, i, zero)
            unrun(t, psi, lam, gates, trig, w.inputs, overlap, flat, seed, sums, slopes)
            for v in range(min(lanes, inputs.shape[1] - first)):
                for i in range(slopes.shape[0]):
                    grad_inputs[seed, first + v, i] = slopes[i, v]
        for p in range(flat.shape[1]):
            grad_flat[seed, p] = total(load(sums, p))


@inlined
def _place(t: Any, record: Any, first: int) -> Any:
    """Return the sines and cosines, and the blocks, of a program whose rows in a record begin at `first`."""
    second = first + 2 * t.rotations.shape[0]
    return record[first:second], record[second : second + 6 * (t.blocks.shape[0] - 1)]


@kernel
def advance(t: Any, angles: Any, records: Any, first: int, fresh: int, inputs: Any) -> None:
    """Bring the states of all chunks through a program of one component, see `states`.

    `angles` (1, B, A) are the program's inputs. `records` (K, R, V) hold the states in their first rows, and receive
    data for `retreat` from row `first` on. If `fresh` is 1, states begin in |0...0>. `inputs` (A, V) is scratch.
    """
    for chunk in range(records.shape[0]):
        trig, gates = _place(t, records[chunk], first)
        fill_inputs(angles, 0, chunk * inputs.shape[1], inputs)
        prepare(t, angles[0], 0, inputs, trig, gates)
        n, state = _component(t, 0, records[chunk])
        if fresh:
            _begin(t, 0, state)
        _take(t, 0, n, state, gates, n if fresh else 0)


@kernel
def retreat(
    t: Any,
    angles: Any,
    records: Any,
    first: int,
    psis: Any,
    lams: Any,
    inputs: Any,
    overlap: Any,
    slopes: Any,
    gradient: Any,
) -> None:
    """Undo a program on psi and lambda of all chunks, (K, 2^(n + 1), V) each, and add to `gradient` (B, A).

    `records` are the records of `advance`; `inputs` and `slopes` (A, V) and `overlap` (4, V) are scratch.
    """
    lanes = inputs.shape[1]
    zero = splat(inputs, 0.0)
    for chunk in range(records.shape[0]):
        trig, gates = _place(t, records[chunk], first)
        fill_inputs(angles, 0, chunk * lanes, inputs)
        for a in range(slopes.shape[0]):
            store(slopes, a, zero)
        unrun(t, psis[chunk], lams[chunk], gates, trig, inputs, overlap, angles[0], 0, slopes[:0], slopes)
        for v in range(min(lanes, gradient.shape[0] - chunk * lanes)):
            for a in range(slopes.shape[0]):
                gradient[chunk * lanes + v, a] += slopes[a, v]


@kernel
def words(terms: Any, weights: Any, owners: Any, qubits: int, records: Any, lane: Any, out: Any) -> None:
    """Add the mean of every Pauli word to the value out (B, O) of the observable that owns it.

    `terms` (W, 3): the bits that a word flips (X, Y), the bits that give a sign (Y, Z), and its number of Y. `weights`
    (W,) are their coefficients, `owners` (W,) the observables. `lane` (1, V) is scratch.
    """
    lanes = lane.shape[1]
    for chunk in range(records.shape[0]):
        state = records[chunk]
        for w in range(terms.shape[0]):
            flips, signs, turns = terms[w, 0], terms[w, 1], terms[w, 2] & 3
            mean = splat(lane, 0.0)
            for i in range(1 << qubits):
                re, im = load(state, 2 * i), load(state, 2 * i + 1)
                if flips == 0:
                    x = re * re + im * im
                else:
                    j = 2 * (i ^ flips)
                    if turns & 1:  # -Im
                        x = load(state, j + 1) * re - load(state, j) * im
                    else:
                        x = load(state, j) * re + load(state, j + 1) * im
                mean = mean - x if _odd(i & signs) else mean + x
            store(lane, 0, mean)
            weight = -weights[w] if turns & 2 else weights[w]
            for v in range(min(lanes, out.shape[0] - chunk * lanes)):
                out[chunk * lanes + v, owners[w]] += weight * lane[0, v]


@kernel
def weigh_words(
    terms: Any, weights: Any, owners: Any, qubits: int, records: Any, lane: Any, cotangent: Any, lams: Any
) -> None:
    """Add (sum_w weight_w cotangent_w P_w) psi to lambda of all chunks, (K, 2^(n + 1), V); see `words`."""
    lanes = lane.shape[1]
    zero = splat(lane, 0.0)
    for chunk in range(records.shape[0]):
        state, lam = records[chunk], lams[chunk]
        for w in range(terms.shape[0]):
            flips, signs, turns = terms[w, 0], terms[w, 1], terms[w, 2] & 3
            weight = -weights[w] if turns & 2 else weights[w]
            store(lane, 0, zero)
            for v in range(min(lanes, cotangent.shape[0] - chunk * lanes)):
                lane[0, v] = weight * cotangent[chunk * lanes + v, owners[w]]
            factor = load(lane, 0)
            for i in range(1 << qubits):
                j = 2 * (i ^ flips)
                g = zero - factor if _odd(i & signs) else factor
                re, im = g * load(state, 2 * i), g * load(state, 2 * i + 1)
                if turns & 1:  # times i
                    re, im = zero - im, re
                store(lam, j, load(lam, j) + re)
                store(lam, j + 1, load(lam, j + 1) + im)
