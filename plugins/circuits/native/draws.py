"""Measured outcomes of final states: counts drawn from the multinomial law.

NumPy's own `multinomial` sets its rejection sampler up anew for each binomial draw, which takes longer than all else
that a shifted circuit of few qubits needs. The method here has a cheap setup.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from qrlsuite.compiled.cache import inlined, kernel

SMALL = 10.0
"""Below this mean a binomial draw counts up from 0."""

_STIRLING = np.array(
    [
        math.lgamma(k + 1) - (k + 0.5) * math.log(k + 1) + k + 1 - 0.5 * math.log(2 * math.pi)
        for k in range(10)
    ]
)


@inlined
def _stirling(k: Any) -> Any:
    """Return the error of Stirling's formula for log(k!), around k + 1."""
    if k < 10:
        return _STIRLING[int(k)]
    square = 1.0 / ((k + 1.0) * (k + 1.0))
    return (1.0 / 12 - (1.0 / 360 - square / 1260) * square) / (k + 1.0)


@inlined
def _counted(n: int, p: float, source: Any) -> int:
    """Draw from the binomial law by adding up its probabilities; for a mean n p that is small."""
    odds, left = p / (1.0 - p), source.random()
    term = math.exp(n * math.log1p(-p))
    most = min(n, n * p + 10.0 * math.sqrt(n * p + 1.0))  # where terms add up to 1 but for rounding
    k = 0
    while left > term and k + 1 <= most:
        left -= term
        k += 1
        term *= odds * (n - k + 1) / k
    return k


@inlined
def _rejected(n: int, p: float, source: Any) -> int:
    """Draw from the binomial law by transformed rejection; for n p of `SMALL` or more, and p up to a half.

    Algorithm BTRS of Hoermann 1993, J. Stat. Comput. Simul. 46, 101.
    """
    spread = math.sqrt(n * p * (1.0 - p))
    b = 1.15 + 2.53 * spread
    a = -0.0873 + 0.0248 * b + 0.01 * p
    middle = n * p + 0.5
    inner = 0.92 - 4.2 / b
    while True:
        u, v = source.random() - 0.5, source.random()
        edge = 0.5 - abs(u)
        k = math.floor((2.0 * a / edge + b) * u + middle)
        if edge >= 0.07 and v <= inner:
            return int(k)
        if k < 0.0 or k > n:
            continue
        scale = (2.83 + 5.1 / b) * spread
        odds, mode = p / (1.0 - p), math.floor((n + 1) * p)
        bound = (
            (mode + 0.5) * math.log((mode + 1.0) / (odds * (n - mode + 1.0)))
            + (n + 1.0) * math.log((n - mode + 1.0) / (n - k + 1.0))
            + (k + 0.5) * math.log(odds * (n - k + 1.0) / (k + 1.0))
            + _stirling(mode)
            + _stirling(n - mode)
            - _stirling(k)
            - _stirling(n - k)
        )
        if math.log(v * scale / (a / (edge * edge) + b)) <= bound:
            return int(k)


@inlined
def _binomial(n: int, p: float, source: Any) -> int:
    """Draw the number of successes among n trials of probability p."""
    rare = min(p, 1.0 - p)
    if n == 0 or rare <= 0.0:
        k = 0
    elif n * rare < SMALL:
        k = _counted(n, rare, source)
    else:
        k = _rejected(n, rare, source)
    return k if p <= 0.5 else n - k


@inlined
def _place(sums: Any, value: float) -> int:
    """Return the first place whose sum is above the value.

    Rounding can make the value the last sum itself. It belongs to the first place that reaches this sum: later places
    have probability 0.
    """
    first, last = 0, len(sums) - 1
    while first < last:
        middle = (first + last) // 2
        if sums[middle] > value or sums[middle] == sums[-1]:
            last = middle
        else:
            first = middle + 1
    return first


@inlined
def _multinomial(shots: int, probabilities: Any, sums: Any, source: Any, counts: Any) -> None:
    """Add counts (K,) of K outcomes in so many shots, from probabilities (K,), which are divided by their sum.

    Fewer shots than outcomes are drawn one by one; `sums` (K,) is written for it.
    """
    outcomes, left, total = len(probabilities), shots, 0.0
    for k in range(outcomes):
        total += probabilities[k]
        sums[k] = total
    if shots < outcomes and total > 0.0:
        for _ in range(shots):
            counts[_place(sums, total * source.random())] += 1
        return
    for k in range(outcomes - 1):
        p = probabilities[k]
        drawn = _binomial(left, min(1.0, p / total), source) if left and total > 0.0 else 0
        counts[k] += drawn
        left -= drawn
        total -= p
    counts[outcomes - 1] += left


@kernel
def measure(
    records: Any, first: int, flipped: Any, wrong: float, shots: Any, rows: Any, source: Any, counts: Any
) -> None:
    """Measure a component's final states, and add up how often each outcome is read.

    Parameters
    ----------
    records:
        (C, rows, V): chunks of the states of R runs; `first` is the component's first amplitude in each.
    flipped:
        (R,): a run's outcome is read as outcome ^ flipped. The highest of the n bits is the component's first wire.
    wrong:
        The probability that a bit is then read wrongly.
    shots, rows:
        (R,): how often each run is measured, and which row of `counts` that counts for.
    counts:
        (L, 2^n), to which is added.
    """
    outcomes, width = counts.shape[1], records.shape[2]
    read, sums = np.empty(outcomes), np.empty(outcomes)
    for run in range(len(shots)):
        if shots[run] == 0:
            continue
        chunk, v = run // width, run % width
        for i in range(outcomes):
            re, im = records[chunk, 2 * (first + i), v], records[chunk, 2 * (first + i) + 1, v]
            read[i ^ flipped[run]] = np.float64(re) * re + np.float64(im) * im
        if wrong > 0.0:
            bit = 1
            while bit < outcomes:
                for i in range(outcomes):
                    if i & bit == 0:
                        zero, one = read[i], read[i | bit]
                        read[i] = (1.0 - wrong) * zero + wrong * one
                        read[i | bit] = (1.0 - wrong) * one + wrong * zero
                bit *= 2
        _multinomial(shots[run], read, sums, source, counts[rows[run]])
