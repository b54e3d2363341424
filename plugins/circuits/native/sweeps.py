"""Passes over the state of one chunk of lanes: forward, and backward with the overlaps that gradients need.

A state is an array (2^(n + 1), lanes): real and imaginary part of every amplitude, one lane per sample. Row 2 i is
the real part of amplitude i. A block's matrix in SU(2) is given by two numbers per lane,

    U = [[a, -conj(b)], [b, conj(a)]],

so that an amplitude pair (p0, p1), whose indices differ in the target bit, becomes
(a p0 - conj(b) p1, b p0 + conj(a) p1). A controlled block touches only pairs whose control bit is 1. Hadamards behind
it, on its control or target, are done in the same sweep, which then visits the pairs whose control bit is 0 as well.
They are sums and differences, without the factor 1 / sqrt 2, forward and backward: psi and lambda each grow by sqrt 2
where one is undone, and the overlaps below by 2, exactly.

Backward, psi is the state after a step, and lambda is O psi carried back to the same place. Where the last factor of
that step is exp(-i t P / 2), the derivative of <psi|O|psi> by t is Im <lambda| P |psi>: so every block collects

    T_P = Im <lambda| P |psi>  for P = X, Y, Z,  and  T_1 = Im <lambda|psi> where it has a phase,

over the pairs that it touches, before U is undone on both states (Jones & Gacon 2020, "Efficient calculation of
gradients in classical simulations of variational quantum algorithms").
"""

from __future__ import annotations

from typing import Any

from qrlsuite.compiled.cache import inlined
from qrlsuite.compiled.vectors import load, splat, store
from qrlsuite.plugins.circuits.native.program import ON_CONTROL, ON_TARGET

HALF_ROOT = 0.7071067811865476


@inlined
def spread(k: int, bit: int) -> int:
    """Insert a zero at a bit position: enumerates the basis states whose bit is 0."""
    low = k & ((1 << bit) - 1)
    return ((k ^ low) << 1) | low


@inlined
def masks(control: int, target: int, low: int) -> tuple[int, int, int]:
    """Return how `following` visits the pairs of a block: the first row, its fixed bits, and rows between a pair.

    Of a state that has not grown to bits below `low` yet, these are fixed at 0, see `grow`.
    """
    step, rest = 2 << target, (2 << low) - 1
    if control < 0:
        return 0, step | rest, step
    return 2 << control, step | (2 << control) | rest, step


@inlined
def following(i: int, first: int, fixed: int) -> int:
    """Return the row of the next pair: the next number on the bits that are not fixed."""
    return (((i | fixed) + 1) & ~fixed) | first


@inlined
def pairs(qubits: int, control: int) -> int:
    """Return how many amplitude pairs a block touches."""
    return 1 << (qubits - 1 if control < 0 else qubits - 2)


@inlined
def read_block(gates: Any, block: int) -> Any:
    """Return (a, b) of a block as four vectors."""
    return (
        load(gates, 6 * block),
        load(gates, 6 * block + 1),
        load(gates, 6 * block + 2),
        load(gates, 6 * block + 3),
    )


@inlined
def rotated(p0r: Any, p0i: Any, p1r: Any, p1i: Any, ar: Any, ai: Any, br: Any, bi: Any) -> Any:
    """Return U (p0, p1)."""
    return (
        ar * p0r - ai * p0i - br * p1r - bi * p1i,
        ar * p0i + ai * p0r - br * p1i + bi * p1r,
        br * p0r - bi * p0i + ar * p1r + ai * p1i,
        br * p0i + bi * p0r + ar * p1i - ai * p1r,
    )


@inlined
def multiplied(pr: Any, pi: Any, cr: Any, ci: Any) -> Any:
    """Return the complex product of a number with e^{i gamma} = cr + i ci."""
    return cr * pr - ci * pi, cr * pi + ci * pr


@inlined
def butterfly(p0r: Any, p0i: Any, p1r: Any, p1i: Any) -> Any:
    """Return (p0 + p1, p0 - p1): sqrt 2 times a Hadamard."""
    return p0r + p1r, p0i + p1i, p0r - p1r, p0i - p1i


@inlined
def read_pair(state: Any, i: int, j: int) -> Any:
    """Return two amplitudes as four vectors, by their rows."""
    return load(state, i), load(state, i + 1), load(state, j), load(state, j + 1)


@inlined
def write_pair(state: Any, i: int, j: int, p0r: Any, p0i: Any, p1r: Any, p1i: Any) -> None:
    """Write two amplitudes to their rows."""
    store(state, i, p0r)
    store(state, i + 1, p0i)
    store(state, j, p1r)
    store(state, j + 1, p1i)


@inlined
def grow(state: Any, qubits: int, low: int, bit: int, opening: int) -> None:
    """Let a state that has no amplitudes yet where bits below `low` are 1 grow to those from `bit` on.

    As long as no gate touches such a bit, amplitudes are the same where it is 1, if it begins with a Hadamard
    (`opening`), else 0.
    """
    while low > bit:
        low -= 1
        away, opened = 2 << low, (opening >> low) & 1
        for i in range(0, 2 << qubits, 2 * away):
            re, im = load(state, i), load(state, i + 1)
            store(state, i + away, re if opened else splat(state, 0.0))
            store(state, i + away + 1, im if opened else splat(state, 0.0))


@inlined
def rotate(
    state: Any,
    qubits: int,
    control: int,
    target: int,
    gates: Any,
    block: int,
    phase: int,
    behind: int,
    low: int,
) -> None:
    """Apply a block, and the Hadamards behind it, to a state that has grown to the bits from `low` on."""
    # Constants in the place of variables: each case becomes a loop of its own, without branches.
    if phase:
        _rotate(state, qubits, control, target, gates, block, 1, behind, low)
    elif behind == 0:
        _rotate(state, qubits, control, target, gates, block, 0, 0, low)
    elif behind == ON_CONTROL:
        _rotate(state, qubits, control, target, gates, block, 0, ON_CONTROL, low)
    else:
        _rotate(state, qubits, control, target, gates, block, 0, behind, low)


@inlined
def _rotate(
    state: Any,
    qubits: int,
    control: int,
    target: int,
    gates: Any,
    block: int,
    phase: int,
    behind: int,
    low: int,
) -> None:
    ar, ai, br, bi = read_block(gates, block)
    cr, ci = load(gates, 6 * block + 4), load(gates, 6 * block + 5)
    first, fixed, step = masks(control, target, low)
    i = first
    for _ in range(pairs(qubits - low, control)):
        j = i + step
        p0r, p0i, p1r, p1i = read_pair(state, i, j)
        p0r, p0i, p1r, p1i = rotated(p0r, p0i, p1r, p1i, ar, ai, br, bi)
        if phase:
            p0r, p0i = multiplied(p0r, p0i, cr, ci)
            p1r, p1i = multiplied(p1r, p1i, cr, ci)
        if behind:
            away = 2 << control
            q0r, q0i, q1r, q1i = read_pair(state, i - away, j - away)
            if behind & ON_TARGET:
                p0r, p0i, p1r, p1i = butterfly(p0r, p0i, p1r, p1i)
                q0r, q0i, q1r, q1i = butterfly(q0r, q0i, q1r, q1i)
            if behind & ON_CONTROL:
                q0r, q0i, p0r, p0i = butterfly(q0r, q0i, p0r, p0i)
                q1r, q1i, p1r, p1i = butterfly(q1r, q1i, p1r, p1i)
            write_pair(state, i - away, j - away, q0r, q0i, q1r, q1i)
        write_pair(state, i, j, p0r, p0i, p1r, p1i)
        i = following(i, first, fixed)


@inlined
def unrotate(
    psi: Any,
    lam: Any,
    qubits: int,
    control: int,
    target: int,
    gates: Any,
    block: int,
    phase: int,
    behind: int,
    weight: float,
    overlap: Any,
) -> None:
    """Undo a block and the Hadamards behind it on both states; `overlap` receives weight * (T_X, T_Y, T_Z, T_1)."""
    if phase:
        _unrotate(psi, lam, qubits, control, target, gates, block, 1, behind, weight, overlap)
    elif behind == 0:
        _unrotate(psi, lam, qubits, control, target, gates, block, 0, 0, weight, overlap)
    elif behind == ON_CONTROL:
        _unrotate(psi, lam, qubits, control, target, gates, block, 0, ON_CONTROL, weight, overlap)
    else:
        _unrotate(psi, lam, qubits, control, target, gates, block, 0, behind, weight, overlap)


@inlined
def _unrotate(
    psi: Any,
    lam: Any,
    qubits: int,
    control: int,
    target: int,
    gates: Any,
    block: int,
    phase: int,
    behind: int,
    weight: float,
    overlap: Any,
) -> None:
    ar, ai, br, bi = read_block(gates, block)
    ai, br, bi = splat(gates, 0.0) - ai, splat(gates, 0.0) - br, splat(gates, 0.0) - bi  # U^-1: conj(a), -b
    cr, ci = load(gates, 6 * block + 4), splat(gates, 0.0) - load(gates, 6 * block + 5)
    tx = splat(gates, 0.0)
    ty, tz, t1 = tx, tx, tx
    first, fixed, step = masks(control, target, 0)
    i = first
    for _ in range(pairs(qubits, control)):
        j = i + step
        p0r, p0i, p1r, p1i = read_pair(psi, i, j)
        l0r, l0i, l1r, l1i = read_pair(lam, i, j)
        if behind:
            away = 2 << control
            q0r, q0i, q1r, q1i = read_pair(psi, i - away, j - away)
            m0r, m0i, m1r, m1i = read_pair(lam, i - away, j - away)
            if behind & ON_CONTROL:
                q0r, q0i, p0r, p0i = butterfly(q0r, q0i, p0r, p0i)
                q1r, q1i, p1r, p1i = butterfly(q1r, q1i, p1r, p1i)
                m0r, m0i, l0r, l0i = butterfly(m0r, m0i, l0r, l0i)
                m1r, m1i, l1r, l1i = butterfly(m1r, m1i, l1r, l1i)
            if behind & ON_TARGET:
                q0r, q0i, q1r, q1i = butterfly(q0r, q0i, q1r, q1i)
                p0r, p0i, p1r, p1i = butterfly(p0r, p0i, p1r, p1i)
                m0r, m0i, m1r, m1i = butterfly(m0r, m0i, m1r, m1i)
                l0r, l0i, l1r, l1i = butterfly(l0r, l0i, l1r, l1i)
            write_pair(psi, i - away, j - away, q0r, q0i, q1r, q1i)
            write_pair(lam, i - away, j - away, m0r, m0i, m1r, m1i)
        tx += l0r * p1i - l0i * p1r + l1r * p0i - l1i * p0r
        ty += l1r * p0r + l1i * p0i - l0r * p1r - l0i * p1i
        tz += l0r * p0i - l0i * p0r - l1r * p1i + l1i * p1r
        if phase:
            t1 += l0r * p0i - l0i * p0r + l1r * p1i - l1i * p1r
            p0r, p0i = multiplied(p0r, p0i, cr, ci)
            p1r, p1i = multiplied(p1r, p1i, cr, ci)
            l0r, l0i = multiplied(l0r, l0i, cr, ci)
            l1r, l1i = multiplied(l1r, l1i, cr, ci)
        p0r, p0i, p1r, p1i = rotated(p0r, p0i, p1r, p1i, ar, ai, br, bi)
        l0r, l0i, l1r, l1i = rotated(l0r, l0i, l1r, l1i, ar, ai, br, bi)
        write_pair(psi, i, j, p0r, p0i, p1r, p1i)
        write_pair(lam, i, j, l0r, l0i, l1r, l1i)
        i = following(i, first, fixed)
    store(overlap, 0, splat(gates, weight) * tx)
    store(overlap, 1, splat(gates, weight) * ty)
    store(overlap, 2, splat(gates, weight) * tz)
    store(overlap, 3, splat(gates, weight) * t1)


@inlined
def hadamard(state: Any, qubits: int, high: int, middle: int, low: int) -> None:
    """Apply Hadamards on one, two or three bits, given in falling order, -1 where there are fewer."""
    if middle < 0:
        _hadamard1(state, qubits, high)
    elif low < 0:
        _hadamard2(state, qubits, high, middle)
    else:
        _hadamard3(state, qubits, high, middle, low)


@inlined
def _hadamard1(state: Any, qubits: int, bit: int) -> None:
    scale = splat(state, HALF_ROOT)
    step = 2 << bit
    for k in range(1 << (qubits - 1)):
        i = 2 * spread(k, bit)
        for part in range(2):
            x, y = load(state, i + part) * scale, load(state, i + step + part) * scale
            store(state, i + part, x + y)
            store(state, i + step + part, x - y)


@inlined
def _hadamard2(state: Any, qubits: int, high: int, low: int) -> None:
    scale = splat(state, 0.5)
    s, t = 2 << low, 2 << high
    for k in range(1 << (qubits - 2)):
        i = 2 * spread(spread(k, low), high)
        for part in range(2):
            r = i + part
            a, b = load(state, r) * scale, load(state, r + s) * scale
            c, d = load(state, r + t) * scale, load(state, r + s + t) * scale
            a, b = a + b, a - b
            c, d = c + d, c - d
            store(state, r, a + c)
            store(state, r + s, b + d)
            store(state, r + t, a - c)
            store(state, r + s + t, b - d)


@inlined
def _hadamard3(state: Any, qubits: int, high: int, middle: int, low: int) -> None:
    scale = splat(state, 0.5 * HALF_ROOT)
    s, t, u = 2 << low, 2 << middle, 2 << high
    for k in range(1 << (qubits - 3)):
        i = 2 * spread(spread(spread(k, low), middle), high)
        for part in range(2):
            r = i + part
            a, b = load(state, r) * scale, load(state, r + s) * scale
            c, d = load(state, r + t) * scale, load(state, r + s + t) * scale
            e, f = load(state, r + u) * scale, load(state, r + u + s) * scale
            g, h = load(state, r + u + t) * scale, load(state, r + u + s + t) * scale
            a, b = a + b, a - b
            c, d = c + d, c - d
            e, f = e + f, e - f
            g, h = g + h, g - h
            a, c = a + c, a - c
            b, d = b + d, b - d
            e, g = e + g, e - g
            f, h = f + h, f - h
            store(state, r, a + e)
            store(state, r + s, b + f)
            store(state, r + t, c + g)
            store(state, r + s + t, d + h)
            store(state, r + u, a - e)
            store(state, r + u + s, b - f)
            store(state, r + u + t, c - g)
            store(state, r + u + s + t, d - h)


@inlined
def permute(state: Any, cycles: Any, first: int, last: int) -> None:
    """Apply new[i] = old[source[i]], cycle by cycle in place."""
    position = first
    while position < last:
        i = cycles[position]
        real, imaginary = load(state, 2 * i), load(state, 2 * i + 1)
        while cycles[position + 1] >= 0:
            j = cycles[position + 1]
            store(state, 2 * i, load(state, 2 * j))
            store(state, 2 * i + 1, load(state, 2 * j + 1))
            i = j
            position += 1
        j = ~cycles[position + 1]
        store(state, 2 * i, load(state, 2 * j))
        store(state, 2 * i + 1, load(state, 2 * j + 1))
        store(state, 2 * j, real)
        store(state, 2 * j + 1, imaginary)
        position += 2


@inlined
def unpermute(state: Any, cycles: Any, first: int, last: int) -> None:
    """Undo `permute`: walk every cycle from its end."""
    position = last - 1
    while position >= first:
        i = ~cycles[position]
        real, imaginary = load(state, 2 * i), load(state, 2 * i + 1)
        while position - 1 >= first and cycles[position - 1] >= 0:
            j = cycles[position - 1]
            store(state, 2 * i, load(state, 2 * j))
            store(state, 2 * i + 1, load(state, 2 * j + 1))
            i = j
            position -= 1
        store(state, 2 * i, real)
        store(state, 2 * i + 1, imaginary)
        position -= 1


@inlined
def flip(state: Any, negative: Any, first: int, last: int) -> None:
    """Change the sign of the amplitudes of some basis states."""
    zero = splat(state, 0.0)
    for position in range(first, last):
        i = 2 * negative[position]
        store(state, i, zero - load(state, i))
        store(state, i + 1, zero - load(state, i + 1))
