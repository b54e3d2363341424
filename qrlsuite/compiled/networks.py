"""The compiled loops of networks: seed by seed, and in each seed chunk by chunk of samples, through all layers.

A chunk has two vectors of samples, one sample a lane: row f of its record holds feature f of all of them. The weights
and a chunk's rows stay in the processor's cache from the first layer to the last. Four rows of a product are computed
at once, so that eight sums are under way. Every sum is over inputs (outputs in `backward`, samples for weights) in
rising order, and every seed starts a chunk of its own: a seed's numbers depend neither on its place in the stack nor
on its neighbors. Lanes of a last, partly filled chunk compute on zeros and are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from qrlsuite.compiled.cache import inlined, kernel, rounded
from qrlsuite.compiled.trigonometry import sine_cosine
from qrlsuite.compiled.vectors import (
    fma,
    load,
    positive,
    splat,
    spread,
    store,
    total,
    transpose,
    where_positive,
)

NOTHING, RELU, SINE, WHERE_POSITIVE, TIMES = range(5)
"""Operations after a product, see `_finish`."""


def record_rows(sizes: Sequence[int], activation: int, lanes: int) -> int:
    """Return the rows of a chunk's record: inputs and layers of these sizes, derivatives, and room for `transpose`."""
    return sum(sizes) + (sum(sizes[1:-1]) if activation == SINE else 0) + lanes


@kernel
def _multiply(
    matrix: Any, first: int, row: int, column: int, rows: int, inner: int, source: Any, begin: int,
    target: Any, to: int, bias: Any, at: int, how: int, kept: Any, other: int, both: bool,
) -> None:  # fmt: skip
    """Write rows `to + r` of target: bias[at + r] + sum over k of matrix[first + r row + k column] source[begin + k].

    There is no bias if `at` is below 0. The operation after it, see `_finish`, may use row `other + r` of `kept`. Rows
    have two vectors, the second is computed if `both`.
    """
    full = rows - rows % 4
    for r in range(0, full, 4):
        p0 = first + r * row
        p1, p2, p3 = p0 + row, p0 + 2 * row, p0 + 3 * row
        a0 = splat(source, 0.0)
        a1, a2, a3 = a0, a0, a0
        if at >= 0:
            a0, a1 = spread(bias, at + r), spread(bias, at + r + 1)
            a2, a3 = spread(bias, at + r + 2), spread(bias, at + r + 3)
        b0, b1, b2, b3 = a0, a1, a2, a3
        if both:
            for k in range(inner):
                x, y = load(source, 2 * (begin + k)), load(source, 2 * (begin + k) + 1)
                w = spread(matrix, p0 + k * column)
                a0, b0 = fma(w, x, a0), fma(w, y, b0)
                w = spread(matrix, p1 + k * column)
                a1, b1 = fma(w, x, a1), fma(w, y, b1)
                w = spread(matrix, p2 + k * column)
                a2, b2 = fma(w, x, a2), fma(w, y, b2)
                w = spread(matrix, p3 + k * column)
                a3, b3 = fma(w, x, a3), fma(w, y, b3)
        else:
            for k in range(inner):
                x = load(source, 2 * (begin + k))
                a0 = fma(spread(matrix, p0 + k * column), x, a0)
                a1 = fma(spread(matrix, p1 + k * column), x, a1)
                a2 = fma(spread(matrix, p2 + k * column), x, a2)
                a3 = fma(spread(matrix, p3 + k * column), x, a3)
        _finish(target, to + r, a0, b0, how, kept, other + r)
        _finish(target, to + r + 1, a1, b1, how, kept, other + r + 1)
        _finish(target, to + r + 2, a2, b2, how, kept, other + r + 2)
        _finish(target, to + r + 3, a3, b3, how, kept, other + r + 3)
    for r in range(full, rows):
        a0 = splat(source, 0.0)
        if at >= 0:
            a0 = spread(bias, at + r)
        b0 = a0
        for k in range(inner):
            w = spread(matrix, first + r * row + k * column)
            a0, b0 = fma(w, load(source, 2 * (begin + k)), a0), fma(w, load(source, 2 * (begin + k) + 1), b0)
        _finish(target, to + r, a0, b0, how, kept, other + r)


@inlined
def _finish(target: Any, to: int, a: Any, b: Any, how: int, kept: Any, other: int) -> None:
    """Write one row of two vectors after the operation `how`, with row `other` of `kept`.

    In `forward` RELU or SINE, whose derivative goes to that row; in `backward` WHERE_POSITIVE or TIMES that row.
    """
    if how == RELU:
        a, b = positive(a), positive(b)
    elif how == SINE:
        a, c = sine_cosine(a)
        b, d = sine_cosine(b)
        store(kept, 2 * other, c)
        store(kept, 2 * other + 1, d)
    elif how == WHERE_POSITIVE:
        a, b = where_positive(load(kept, 2 * other), a), where_positive(load(kept, 2 * other + 1), b)
    elif how == TIMES:
        a, b = a * load(kept, 2 * other), b * load(kept, 2 * other + 1)
    store(target, 2 * to, a)
    store(target, 2 * to + 1, b)


@kernel
def _add_products(
    left: Any, begin: int, rows: int, right: Any, columns: int, samples: int, sums: Any, at: int
) -> None:
    """Add to sums[at + r, c] the sum over samples b of left[begin + r, b] right[b, c]; c counts vectors."""
    full, wide = rows - rows % 4, left.shape[1]
    for r in range(0, full, 4):
        p0 = (begin + r) * wide
        p1, p2, p3 = p0 + wide, p0 + 2 * wide, p0 + 3 * wide
        for c in range(0, columns - columns % 2, 2):
            q0 = at + r * columns + c
            q1, q2, q3 = q0 + columns, q0 + 2 * columns, q0 + 3 * columns
            a0, b0, a1, b1 = load(sums, q0), load(sums, q0 + 1), load(sums, q1), load(sums, q1 + 1)
            a2, b2, a3, b3 = load(sums, q2), load(sums, q2 + 1), load(sums, q3), load(sums, q3 + 1)
            for b in range(samples):
                x, y = load(right, b * columns + c), load(right, b * columns + c + 1)
                w = spread(left, p0 + b)
                a0, b0 = fma(w, x, a0), fma(w, y, b0)
                w = spread(left, p1 + b)
                a1, b1 = fma(w, x, a1), fma(w, y, b1)
                w = spread(left, p2 + b)
                a2, b2 = fma(w, x, a2), fma(w, y, b2)
                w = spread(left, p3 + b)
                a3, b3 = fma(w, x, a3), fma(w, y, b3)
            store(sums, q0, a0)
            store(sums, q0 + 1, b0)
            store(sums, q1, a1)
            store(sums, q1 + 1, b1)
            store(sums, q2, a2)
            store(sums, q2 + 1, b2)
            store(sums, q3, a3)
            store(sums, q3 + 1, b3)
        if columns % 2:
            q0 = at + r * columns + columns - 1
            q1, q2, q3 = q0 + columns, q0 + 2 * columns, q0 + 3 * columns
            a0, a1, a2, a3 = load(sums, q0), load(sums, q1), load(sums, q2), load(sums, q3)
            for b in range(samples):
                x = load(right, b * columns + columns - 1)
                a0, a1 = fma(spread(left, p0 + b), x, a0), fma(spread(left, p1 + b), x, a1)
                a2, a3 = fma(spread(left, p2 + b), x, a2), fma(spread(left, p3 + b), x, a3)
            store(sums, q0, a0)
            store(sums, q1, a1)
            store(sums, q2, a2)
            store(sums, q3, a3)
    for r in range(full, rows):
        for c in range(columns):
            a0 = load(sums, at + r * columns + c)
            for b in range(samples):
                a0 = fma(spread(left, (begin + r) * wide + b), load(right, b * columns + c), a0)
            store(sums, at + r * columns + c, a0)


@kernel
def _turn(source: Any, begin: int, rows: int, columns: int, samples: int, target: Any) -> None:
    """Write rows `begin ...` of a record, samples side by side, as one row of `columns` vectors a sample."""
    wide = source.shape[1]
    vector = wide // 2
    for r in range(0, rows, vector):
        for b in range(0, samples, vector):
            first = (begin + r) * wide + b
            transpose(source, first, wide, target, b * columns * vector + r, columns * vector)


@inlined
def _fill(values: Any, seed: int, start: int, samples: int, rows: Any) -> None:
    """Transpose a chunk of values (S, B, F) into rows; zeros where there is no sample."""
    own = values[seed, start : start + samples]
    for f in range(values.shape[2]):
        row = rows[f]
        for v in range(samples):
            row[v] = own[v, f]
        row[samples:] = 0.0


@kernel
def forward(x: Any, parameters: Any, sizes: Any, activation: int, records: Any, keep: bool, out: Any) -> None:
    """Compute out (S, B, O) of x (S, B, I).

    Parameters
    ----------
    parameters:
        One behind the other, of each layer the weights (S, out, in) and the biases (S, out).
    sizes:
        Inputs, and outputs of each layer.
    activation:
        NOTHING, RELU or SINE, after every layer but the last.
    records:
        (chunks, rows, 2 V), see `record_rows`; with `keep` every chunk writes its own, else all write the first.
    """
    wide, chunk, last, seeds = records.shape[2], 0, len(sizes) - 2, x.shape[0]
    slopes = 0  # the row where the first layer's derivatives begin, without its inputs
    for layer in range(1, len(sizes)):
        slopes += sizes[layer]
    for s in range(seeds):
        for start in range(0, x.shape[1], wide):
            rows = records[chunk]
            if keep:
                chunk += 1
            samples = min(wide, x.shape[1] - start)
            _fill(x, s, start, samples, rows)
            begin, place = np.int64(0), 0  # of a literal 0, numba compiles a second version of what it calls
            for layer in range(last + 1):
                o, i = sizes[layer + 1], sizes[layer]
                _multiply(
                    parameters, place + s * o * i, i, 1, o, i, rows, begin, rows, begin + i,
                    parameters, place + seeds * o * i + s * o,
                    activation if layer < last else NOTHING, rows, slopes + begin + i, 2 * samples > wide,
                )  # fmt: skip
                begin, place = begin + i, place + seeds * o * (i + 1)
            own = out[s, start : start + samples]
            for j in range(out.shape[2]):
                row = rows[begin + j]
                for v in range(samples):
                    own[v, j] = row[v]


@kernel
def backward(
    cotangents: Any, parameters: Any, sizes: Any, activation: int, records: Any, pair: Any, turned: Any, sums: Any,
    gradients: Any, trained: bool, x_gradients: Any, needed: bool,
) -> None:  # fmt: skip
    """Compute the gradients of a pass that kept its records: of parameters if `trained`, and of x if `needed`.

    Parameters
    ----------
    cotangents:
        (S, B, O).
    pair, turned, sums:
        Working memory: two chunks of rows, one chunk turned, and the sums of all weights in whole vectors.
    gradients:
        Laid out as the parameters are.
    """
    wide, chunk, last, zero = records.shape[2], 0, len(sizes) - 2, np.int64(0)  # see `forward`
    vector, batch, seeds, height = wide // 2, cotangents.shape[1], cotangents.shape[0], 0
    for layer in range(len(sizes)):
        height += sizes[layer]
    for s in range(seeds):
        sums[:] = 0.0
        place = 0
        for layer in range(last + 1):
            o, i = sizes[layer + 1], sizes[layer]
            for j in range(o if trained else 0):
                gradients[place + seeds * o * i + s * o + j] = 0.0
            place += seeds * o * (i + 1)
        end = place
        for start in range(0, batch, wide):
            rows = records[chunk]
            chunk += 1
            samples, side, at = min(wide, batch - start), 0, zero
            _fill(cotangents, s, start, samples, pair[0])
            begin, place = height - cotangents.shape[2], end
            for back in range(last + 1):
                layer = last - back
                own = pair[side]
                o, i = sizes[layer + 1], sizes[layer]
                begin, place = begin - i, place - seeds * o * (i + 1)
                bias = place + seeds * o * i + s * o
                for j in range(o if trained else 0):
                    gradients[bias + j] += total(load(own, 2 * j) + load(own, 2 * j + 1))
                if not trained:
                    pass
                elif i >= o:
                    columns = -(-i // vector)
                    _turn(rows, begin, i, columns, samples, turned)
                    _add_products(own, zero, o, turned, columns, samples, sums, at)
                    at += o * columns
                else:
                    columns = -(-o // vector)
                    _turn(own, zero, o, columns, samples, turned)
                    _add_products(rows, begin, i, turned, columns, samples, sums, at)
                    at += i * columns
                side = 1 - side
                if layer > 0 or needed:
                    how, other = NOTHING, begin
                    if layer > 0 and activation == RELU:
                        how = WHERE_POSITIVE
                    elif layer > 0 and activation == SINE:
                        how, other = TIMES, height + begin - sizes[0]
                    _multiply(
                        parameters, place + s * o * i, 1, i, i, o, own, 0, pair[side], 0, parameters, -1, how, rows,
                        other, 2 * samples > wide,
                    )  # fmt: skip
            if needed:
                for i in range(x_gradients.shape[2]):
                    for v in range(samples):
                        x_gradients[s, start + v, i] = pair[side, i, v]
        at, place = zero, end
        for back in range(last + 1):
            o, i = sizes[last - back + 1], sizes[last - back]
            place -= seeds * o * (i + 1)
            columns = -(-max(i, o) // vector) * vector
            for j in range(o if trained else 0):
                gradient = gradients[place + (s * o + j) * i : place + (s * o + j + 1) * i]
                if i >= o:
                    own = sums[at + j * columns : at + (j + 1) * columns]  # of slices, see `adam`
                    for k in range(i):  # of `gradient[:] = ...` numba would compile a check of shapes, too
                        gradient[k] = own[k]
                else:
                    own = sums[at + j : at + i * columns]
                    for k in range(i):
                        gradient[k] = own[k * columns]
            at += min(i, o) * columns


@kernel
def largest(values: Any, places: Any) -> None:
    """Write where values (S, B, A) are the largest (S, B): the first of equal ones, and of NaN, which is above all."""
    for s in range(values.shape[0]):
        for b in range(values.shape[1]):
            place, found = 0, values[s, b, 0]
            for a in range(1, values.shape[2]):
                here = values[s, b, a]
                better = (here > found) | (
                    (here != here) & (found == found)
                )  # no branch, which would be guessed
                place, found = (a if better else place), (here if better else found)
            places[s, b] = place


@kernel
def chosen(values: Any, places: Any, out: Any) -> bool:
    """Write values[s, b, places[s, b]] (S, B); return whether all places are some."""
    for s in range(values.shape[0]):
        for b in range(values.shape[1]):
            place = places[s, b]
            if place < 0 or place >= values.shape[2]:
                return False
            out[s, b] = values[s, b, place]
    return True


@kernel
def chosen_errors(values: Any, places: Any, aims: Any, share: Any, errors: Any, cotangents: Any) -> bool:
    """Write errors (S, B) of chosen outputs, and the derivatives of the sum of `share` times their squares.

    Return whether all places are some.
    """
    for s in range(values.shape[0]):
        for b in range(values.shape[1]):
            place = places[s, b]
            if place < 0 or place >= values.shape[2]:
                return False
            error = values[s, b, place] - aims[s, b]
            errors[s, b] = error
            for a in range(values.shape[2]):
                cotangents[s, b, a] = 0.0
            cotangents[s, b, place] = share * (error + error)
    return True


@kernel
def pick(rows: Any, places: Any, borders: Any, out: Any) -> None:
    """Write rows (S, capacity, N) at `places` (S, B), quantity by quantity: columns borders[k] to borders[k + 1].

    Columns are copied one by one: a loop over a batch waits for all its rows at once.
    """
    seeds, batch = places.shape
    for s in range(seeds):
        own, chosen = rows[s], places[s]
        for k in range(len(borders) - 1):
            first, width = borders[k], borders[k + 1] - borders[k]
            for c in range(width):
                column, to = first + c, first * seeds * batch + s * batch * width + c
                for b in range(batch):
                    out[to + b * width] = own[chosen[b], column]


@rounded
def adam(
    parameters: Any, gradients: Any, means: Any, squares: Any, sizes: Any, rates: Any, root: Any, active: Any,
    share1: Any, keep2: Any, share2: Any, eps: Any,
) -> None:  # fmt: skip
    """Move the numbers of every active agent along their gradients, in place; every operation is rounded.

    Parameters
    ----------
    parameters, gradients, means, squares:
        Blocks (S, n) one behind the other.
    sizes:
        n of each block.
    rates, root:
        Corrected for the moments' bias: of each block (S,), and (S,).
    share1, keep2, share2:
        1 - beta1, beta2 and 1 - beta2, in the dtype of the parameters.
    """
    place = 0
    for block in range(len(sizes)):
        for s in range(rates.shape[1]):
            first, end = place, place + sizes[block]
            place = end
            if active[s]:
                rate, r = rates[block, s], root[s]
                own, slope = (
                    parameters[first:end],
                    gradients[first:end],
                )  # of slices, loops have no index below 0
                mean, square = means[first:end], squares[first:end]
                for i in range(end - first):
                    g = slope[i]
                    m = mean[i] + share1 * (g - mean[i])
                    v = keep2 * square[i] + share2 * g * g
                    mean[i], square[i] = m, v
                    own[i] -= rate * m / (r * np.sqrt(v) + eps)
