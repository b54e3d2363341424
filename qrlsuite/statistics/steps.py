"""Rule `steps` at work: relabelings until no decision can turn, intervals that belong to p, and the limits of few runs.

One number per run decides: its steps below threshold, averaged over the thresholds, with half an epoch added, so that a
ratio exists where a mean is 0. docs/error-rates.md has how this test was chosen, and where it errs.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable

import numpy as np

from qrlsuite.statistics.grid import BoolArray, FloatArray, IntArray
from qrlsuite.statistics.permutation import (
    CHUNK,
    MOST,
    MaxT,
    all_labelings,
    few_labelings,
    in_order,
    log_ratio,
    studentized,
    weights,
)

LEAST_RUNS = 4
"""Below this number of runs of either entry there is no verdict."""
RISK = 1e-3
"""Probability that more relabelings would turn any decision."""
_CHUNKS, _IN_TAIL = 10, 5  # of relabelings, for an interval: at most; and relabelings beyond its end
# until an end is found, so closely; and beyond which there is none
_STEPS, _CLOSE, _ENDLESS = 100, 1e-4, 20.0


def settle(test: MaxT, alpha: float, seconds: float = math.inf) -> BoolArray:
    """Relabel until no decision of Holm's procedure over all pairs can turn; return, shape (P,), which still may.

    Parameters
    ----------
    alpha:
        In (0, 1).
    seconds:
        After which it stops; at the latest it stops at 10 million relabelings.
    """
    n_pairs = len(test.t)

    def turning() -> BoolArray:
        order = np.argsort(test.p, kind="stable")
        levels = np.empty(n_pairs)
        levels[order] = alpha / np.arange(n_pairs, 0, -1)
        turns = test.turns(levels, RISK / n_pairs)
        kept = ~turns & (test.p > levels)
        if kept.any():  # Holm's procedure ends at the first of them: the others can turn at its level alone
            first = int(np.argmax(kept[order]))
            at_end = test.turns(np.full(n_pairs, levels[order[first]]), RISK / n_pairs)
            turns[order[first:]] = at_end[order[first:]]
        return turns

    return relabel(test, turning, seconds)


def relabel(test: MaxT, turning: Callable[[], BoolArray], seconds: float = math.inf) -> BoolArray:
    """Relabel the pairs that still may turn, shape (P,), until none may, the time is over or it is 10 million times."""
    begun, count = time.monotonic(), CHUNK
    turns = np.ones(len(test.t), dtype=bool)
    while len(which := np.flatnonzero(turns & (test.n_relabelings < MOST))):
        test.extend(count, which)
        turns = turning()
        if time.monotonic() - begun > seconds:
            break
        count = min(2 * count, MOST)
    return turns


def holm_levels(p: FloatArray, alpha: float) -> FloatArray:
    """Return the level at which Holm's procedure tested each p, shape (m,): alpha / hypotheses open at its step."""
    order, levels = np.argsort(p, kind="stable"), np.empty(len(p))
    steps = alpha / np.arange(len(p), 0, -1)
    rejected = np.logical_and.accumulate(p[order] <= steps)
    levels[order] = (
        np.where(rejected, steps, steps[min(int(rejected.sum()), len(p) - 1)]) if len(p) else steps
    )
    return levels


def ratio_interval(
    first: IntArray, second: IntArray, level: float, differs: bool, seed: int = 0
) -> FloatArray:
    """Return, shape (3,): mean of the first over mean of the second, minus 1, and the interval that belongs to its p.

    The interval holds the ratios that are not rejected at `level` when the second's runs are multiplied by them
    (relabelings of whole runs), found by iteration from the estimate.

    Parameters
    ----------
    first, second:
        Positive whole numbers, one per run: (N_A,) and (N_B,).
    differs:
        Whether the test at this level rejected a ratio of 1: exactly then the interval leaves it out.
    """
    swapped = in_order(first, second)
    test = _Rescaled(*((second, first) if swapped else (first, second)), level, seed)
    ends = np.array([test.ratio, *(test.end(side, differs) for side in (-1, 1))])
    return np.asarray(np.expm1(-ends[[0, 2, 1]] if swapped else ends))


@functools.lru_cache(maxsize=64)  # a board asks for those of an entry in each of its pairs
def _sums(
    runs: tuple[int, ...], n_first: int, n_second: int, place: int, seed: int, chunks: int
) -> FloatArray:
    """Return, (2, labelings), sums of runs over their mean, and of their squares, over those labeled "first".

    The runs belong to a pair's first (0) or second (1) entry. The labelings are all, or so many chunks.
    """
    side = np.array(runs) / np.mean(runs)
    powers, part = np.stack([side, side**2]), slice(n_first, None) if place else slice(n_first)
    if not chunks:
        return np.asarray(powers @ all_labelings(n_first, n_second)[part])
    made = (weights(n_first, n_second, seed, 0, chunk) for chunk in range(chunks))
    return np.concatenate([powers @ each[part] for each in made], axis=1)


class _Rescaled:
    """The relabeling test of a pair whose second entry is multiplied by a ratio.

    Attributes
    ----------
    ratio, error:
        Log ratio of the first's mean over the second's, and its standard error.
    """

    def __init__(self, first: IntArray, second: IntArray, level: float, seed: int) -> None:
        self.level, self.sizes = level, (len(first), len(second))
        few = few_labelings(*self.sizes) is not None
        # labelings that are the data's own, or its reverse
        self.own = 1 + (len(first) == len(second)) if few else 0
        chunks = 0 if few else min(_CHUNKS, math.ceil(_IN_TAIL / level / CHUNK))
        runs = (tuple(each.tolist()) for each in (first, second))
        self.sums = [_sums(each, *self.sizes, place, seed, chunks) for place, each in enumerate(runs)]
        sides = [np.stack([side, side**2]) for side in (first / first.mean(), second / second.mean())]
        self.totals = [side.sum(axis=1, keepdims=True) for side in sides]
        self.ratio = math.log(first.mean() / second.mean())
        self.error = math.sqrt(float(self._test(self.totals[0], np.ones((2, 1)))[1][0]))
        self.at_estimate = self.critical(0.0)

    def _test(self, ours: FloatArray, factors: FloatArray) -> tuple[FloatArray, FloatArray]:
        theirs = self.totals[0] + factors * self.totals[1] - ours
        return log_ratio((self.sizes[0], *ours), (self.sizes[1], *theirs))

    def critical(self, shift: float) -> float:
        """Return the |t| beyond which a log ratio is rejected that differs by a shift from the estimate."""
        factors = np.exp([[shift], [2 * shift]])
        t = np.abs(studentized(*self._test(self.sums[0] + factors * self.sums[1], factors)))
        # the first is the data's own, the last its reverse
        others = t[1 : t.size - (self.own == 2)] if self.own else t
        allowed = int(self.level * t.size) - self.own
        if allowed < 0:
            return math.inf
        return float(np.partition(others, others.size - 1 - allowed)[others.size - 1 - allowed])

    def end(self, side: int, differs: bool) -> float:
        """Return the lower (-1) or upper (1) end of the log ratios that are not rejected."""
        reach = self.at_estimate * self.error if self.error else 0.0
        for _ in range(_STEPS):
            if not reach or reach > _ENDLESS:
                break
            before, reach = reach, self.critical(side * reach) * self.error
            if abs(reach - before) < _CLOSE * reach:
                break
        end = self.ratio + side * reach if reach < _ENDLESS else side * math.inf
        if side * self.ratio < 0:  # a ratio of 1 lies on this side
            end = side * (min(side * end, -0.0) if differs else max(side * end, 0.0))
        return end


def least_p(n_first: int, n_second: int) -> float:
    """Return the least p that labelings of so many runs can have: .029 for 4 and 4."""
    return (1 + (n_first == n_second)) / math.comb(n_first + n_second, n_first)


def runs_that_decide(level: float) -> int:
    """Return the least equal number of runs of which a test at a level can decide anything.

    >>> runs_that_decide(0.05), runs_that_decide(0.01)
    (4, 5)
    """
    return next(n for n in range(LEAST_RUNS, 100) if least_p(n, n) <= level)


def most_failures(n_runs: int) -> float:
    """Return the largest share of failing runs that n runs without a failure leave possible (exact, one-sided 95%).

    >>> round(most_failures(8), 2), round(most_failures(20), 2)
    (0.31, 0.14)
    """
    return float(1 - 0.05 ** (1 / n_runs))
