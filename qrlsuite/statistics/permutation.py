"""Permutation tests of one pair: labels of whole runs exchanged, one critical value for all comparisons.

If two entries follow the same law, any assignment of the labels "first" and "second" to their runs is as likely
as the observed one. The observed statistic is therefore compared with the statistics of R random relabelings,

    p = (1 + number of relabelings whose statistic is at least as large) / (R + 1),

which is exact for independent runs of equal laws, whatever R. The maximum of |t| over all comparisons of the
pair is the statistic, under the same relabeling for all of them (single-step max-T; Westfall and Young 1993,
"Resampling-based multiple testing"): so p holds for the whole pair, and a comparison by itself is significant
where the maxima rarely reach its own |t|. The t are studentized: with equal means but unequal laws the test
is still valid for many runs (Janssen 1997, Statistics & Probability Letters 36; Chung and Romano 2013, Annals of
Statistics 41).

Two rules are built on it. `StepsRule` relabels the log ratio of two means of one number per run; all labelings are
enumerated where there are few. `TimesRule` takes the largest t over the thresholds.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.bootstrap import small_product
from qrlsuite.statistics.grid import BoolArray, FloatArray, IntArray
from qrlsuite.statistics.significance import Evidence, Signs
from qrlsuite.statistics.times import check_probability, times_below

CHUNK = 10_000
"""Relabelings that are made at a time, and the least that decide."""
_EXACT = 2**24  # float32 counts so far without error
_ROWS, _COLUMNS = 64, 1000  # of runs and labelings that are multiplied at the same time: what a cache holds
_TOGETHER = 64  # pairs whose relabelings are in memory at the same time

Blocks = tuple[tuple[int, int], ...]
"""Runs of the first and the second entry in each block within which labels are exchanged."""


MOST = 10_000_000
"""Relabelings that take minutes for a board: a level that needs more is refused."""
ENUMERATED = 100_000
"""Labelings up to which a test of ratios takes all of them."""


def relabelings_for(level: float) -> int:
    """Return how many relabelings decide at a level: 20 / level, 10,000 or more, in whole ten thousands.

    Raises
    ------
    OptionError
        If the level is outside (0, 1), or needs more than `MOST`.
    """
    needed = 20 / check_probability(level, "level")
    if needed > MOST:
        raise OptionError(
            f"a level of {level:.2g} for each test takes {needed:.2g} permutations, more than {MOST:,}: "
            "choose a larger alpha, or fewer entries"
        )
    return CHUNK * max(1, math.ceil(needed / CHUNK))


@functools.lru_cache(maxsize=48)  # pairs of equal sizes and looks of studies share them; 100 MB at 200 runs
def relabelings(n_first: int, n_second: int, chunk: int = 0, seed: int = 0, block: int = 0) -> BoolArray:
    """Return, shape (n_first + n_second, 10,000): whether a run is labeled "first", n_first times per column.

    Parameters
    ----------
    n_first, n_second:
        Runs of both entries.
    chunk, seed, block:
        Others of them give other relabelings, the same on every machine.
    """
    generator = np.random.default_rng([seed, block, chunk])
    keys = generator.integers(0, 2**32, size=(CHUNK, n_first + n_second), dtype=np.uint32)
    labels: BoolArray = np.ascontiguousarray(smallest(keys, n_first).T)
    labels.flags.writeable = False
    return labels


@functools.lru_cache(maxsize=8)
def all_labelings(n_first: int, n_second: int) -> BoolArray:
    """Return every labeling of two entries' runs, (n_first + n_second, labelings), as `relabelings` does."""
    chosen = np.array(list(combinations(range(n_first + n_second), n_first)))
    labels = np.zeros((n_first + n_second, len(chosen)), dtype=bool)
    labels[chosen.T, np.arange(len(chosen))] = True
    labels.flags.writeable = False
    return labels


def few_labelings(n_first: int, n_second: int) -> int | None:
    """Return the number of all labelings where a test of ratios takes all of them, else None."""
    count = math.comb(n_first + n_second, n_first)
    return count if count <= ENUMERATED else None


@functools.lru_cache(maxsize=16)
def weights(n_first: int, n_second: int, seed: int, block: int, chunk: int = 0) -> FloatArray:
    """Return `relabelings` as numbers that are multiplied fast."""
    return relabelings(n_first, n_second, chunk, seed, block).astype(np.float64)


def smallest(keys: NDArray[np.uint32], count: int) -> BoolArray:
    """Return, shape (R, n), which are the `count` smallest keys of each row; among equal ones the first."""
    chosen: BoolArray = keys <= np.sort(keys, axis=1)[:, count - 1 : count]
    for row in np.flatnonzero(np.count_nonzero(chosen, axis=1) != count).tolist():
        chosen[row] = False
        chosen[row, np.argsort(keys[row], kind="stable")[:count]] = True
    return chosen


class MaxT:
    """Max-T permutation tests of P pairs over E comparisons: the difference or ratio of means, studentized.

    Parameters
    ----------
    pairs:
        P pairs of whole-number arrays (N_A, E) and (N_B, E), one row per run: for instance the steps below
        threshold in steps. Row i of a pair's two arrays need not belong together.
    blocks:
        Runs of both entries per block, in the order of the rows, the same for all pairs: labels are exchanged
        within a block only. None means a single block. Relabelings of a block do not depend on later blocks.
    ratio:
        Whether t tests the log ratio of two means of positive numbers, see `ratio_t`, and not of their difference.

    Attributes
    ----------
    t:
        Shape (P, E): Welch's t or the t of the log ratio, positive where the first has the smaller mean; infinite where
        neither entry varies and they differ, 0 where nothing differs.
    reached:
        Shape (P, E): relabelings whose max |t| is at least |t| here.
    n_relabelings:
        Shape (P,): relabelings so far.

    Raises
    ------
    OptionError
        If an entry has fewer than two runs, or the blocks do not add up to the runs.
    """

    def __init__(
        self,
        pairs: Sequence[tuple[IntArray, IntArray]],
        blocks: Blocks | None = None,
        seed: int = 0,
        ratio: bool = False,
    ) -> None:
        self.seed, self.ratio = seed, ratio
        self._kind = _RatioStatistics if ratio else _Statistics
        self._swapped = [in_order(*pair) for pair in pairs]
        ordered = [pair[::-1] if swap else pair for pair, swap in zip(pairs, self._swapped, strict=True)]
        self._pairs: list[tuple[IntArray, IntArray]] = [(first, second) for first, second in ordered]
        self._blocks = [_checked_blocks(pair, blocks, swap) for pair, swap in zip(self._pairs, self._swapped)]
        shape = (len(pairs), pairs[0][0].shape[1] if pairs else 0)
        t = ratio_t if ratio else welch_t
        self.t = np.array([t(*pair) for pair in pairs]).reshape(shape)
        self.reached = np.zeros(shape, dtype=np.int64)
        self.n_relabelings = np.zeros(len(pairs), dtype=np.int64)

    @property
    def p_each(self) -> FloatArray:
        """Shape (P, E): p of every comparison, adjusted for all comparisons of its pair.

        Of a ratio the share of relabelings, since their number depends on the data (Gandy 2009, Journal of the American
        Statistical Association 104); where none reaches |t|, less than a single one.
        """
        if self.ratio:
            none = 1 / (1 + self.n_relabelings)[:, None]
            shares: FloatArray = self.reached / np.maximum(1, self.n_relabelings)[:, None]
            return np.where(self.reached, shares, none)
        p: FloatArray = (1 + self.reached) / (1 + self.n_relabelings)[:, None]
        return p

    def resume(self, row: int, p: float, count: int) -> None:
        """Take over the p that `count` relabelings of a pair gave before, unless the relabelings here contradict it."""
        if count > self.n_relabelings[row] and self.turns(np.full(len(self.t), p), 1e-6)[row]:
            self.reached[row] = 0 if p < 1 / count else round(p * count)
            self.n_relabelings[row] = count

    def critical(self, level: float) -> FloatArray:
        """Return, shape (P,), the |t| that a comparison of a ratio must exceed for an adjusted p of at most `level`.

        By the first ten thousand relabelings, or by all labelings.
        """
        bounds = []
        for pair, blocks in zip(self._pairs, self._blocks):
            if len(blocks) == 1 and few_labelings(*blocks[0]) is not None:
                labels = [all_labelings(*blocks[0])]
            else:
                labels = [relabelings(*sizes, 0, self.seed, block) for block, sizes in enumerate(blocks)]
            largest = np.sort(self._kind([pair], blocks).largest(labels)[0])[::-1]
            bounds.append(float(largest[min(int(level * len(largest)), len(largest) - 1)]))
        return np.array(bounds)

    def turns(self, levels: FloatArray, risk: float) -> BoolArray:
        """Return, shape (P,), whether a pair's p may still cross its level.

        Robbins' confidence sequence (1970, Annals of Mathematical Statistics 41): it holds p at all numbers of
        relabelings at once, but for a probability of `risk`.
        """
        from scipy.special import gammaln, xlog1py, xlogy

        reached, count = self.reached.min(axis=1), self.n_relabelings
        likely = gammaln(count + 2) - gammaln(reached + 1) - gammaln(count - reached + 1)
        likely += xlogy(reached, levels) + xlog1py(count - reached, -levels)
        exact = [few_labelings(*map(len, pair)) == n for pair, n in zip(self._pairs, count.tolist())]
        return np.asarray((likely > math.log(risk)) & ~np.array(exact, dtype=bool))

    @property
    def p(self) -> FloatArray:
        """Shape (P,): p of every pair, the p of its largest |t|."""
        smallest: FloatArray = self.p_each.min(axis=1, initial=1)
        return smallest

    def extend(self, n_relabelings: int, which: IntArray | None = None) -> None:
        """Continue to `n_relabelings` (a multiple of 10,000), for all pairs or the pairs in `which`."""
        chosen = range(len(self._pairs)) if which is None else which.tolist()
        groups: dict[tuple[Blocks, int], list[int]] = {}
        for index in chosen:
            groups.setdefault((self._blocks[index], int(self.n_relabelings[index])), []).append(index)
        for (blocks, done), members in groups.items():
            for begin in range(0, len(members), _TOGETHER):
                group = members[begin : begin + _TOGETHER]
                statistics = self._kind([self._pairs[index] for index in group], blocks)
                count = few_labelings(*blocks[0]) if self.ratio and len(blocks) == 1 else None
                if count is not None:
                    self.reached[group] = statistics.counted([all_labelings(*blocks[0])])
                    self.n_relabelings[group] = count
                    continue
                chunks = range(done // CHUNK, n_relabelings // CHUNK)
                self.reached[group] += statistics.count(chunks, self.seed)
                self.n_relabelings[group] += CHUNK * len(chunks)


def in_order(first: IntArray, second: IntArray) -> bool:
    """Return whether a pair is to be swapped: by its content, so that the answer hangs on no order of names."""
    if len(first) != len(second):
        return len(first) > len(second)
    return np.ascontiguousarray(first).tobytes() > np.ascontiguousarray(second).tobytes()


def _checked_blocks(pair: tuple[IntArray, IntArray], blocks: Blocks | None, swapped: bool) -> Blocks:
    sizes = len(pair[0]), len(pair[1])
    if min(sizes) < 2:
        raise OptionError("a permutation test needs two runs or more of each entry: one has no spread")
    if blocks is None:
        return (sizes,)
    if swapped:
        blocks = tuple((second, first) for first, second in blocks)
    if tuple(np.sum(blocks, axis=0).tolist()) != sizes:
        raise OptionError(f"blocks {blocks} do not add up to {sizes[0]} and {sizes[1]} runs")
    return blocks


def welch_t(first: IntArray, second: IntArray) -> FloatArray:
    """Return Welch's t, shape (E,), of two arrays (N_A, E) and (N_B, E): positive where the first is smaller."""
    difference = second.mean(axis=0) - first.mean(axis=0)
    spread = np.sqrt(first.var(axis=0, ddof=1) / len(first) + second.var(axis=0, ddof=1) / len(second))
    with np.errstate(divide="ignore", invalid="ignore"):
        t: FloatArray = np.where(difference == 0, 0.0, difference / spread)
    return t


def ratio_t(first: IntArray, second: IntArray) -> FloatArray:
    """Return the log ratio of two means over its standard error (delta method), shape (E,), see `welch_t`."""
    sides = (each.astype(np.float64) for each in (first, second))  # squares of whole sums may overflow
    ratio, variance = log_ratio(*((len(each), each.sum(axis=0), (each**2).sum(axis=0)) for each in sides))
    return studentized(ratio, variance)


Sums = tuple[int, NDArray[Any], NDArray[Any]]
"""Number of runs, their sum and the sum of their squares; the latter elementwise."""


def log_ratio(first: Sums, second: Sums) -> tuple[FloatArray, FloatArray]:
    """Return the log of the second's mean over the first's, and its variance by the delta method, elementwise."""
    variance: FloatArray | float = 0.0
    for count, total, square in (first, second):
        relative = square * (count / total**2)
        relative -= 1
        relative *= relative >= 1e-12  # what rounding leaves of zero
        relative /= count - 1
        variance = variance + relative
    ratio = np.log(second[1] / second[0]) - np.log(
        first[1] / first[0]
    )  # swapped, the negative to the last bit
    ratio *= np.abs(ratio) >= 1e-12
    return ratio, np.asarray(variance)


def studentized(ratio: FloatArray, variance: FloatArray) -> FloatArray:
    """Return a ratio over the root of its variance: 0 where it is 0, infinite where it alone does not vary."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ratio / np.sqrt(variance)
    t[ratio == 0] = 0
    return t


class _Statistics:
    """The statistic of relabelings: a strictly increasing function of |t|, for P pairs of equal sizes.

    For equal numbers of runs, with sum of squares and total of both entries together, t is an increasing
    function of the difference alone: (sum_A - sum_B)^2 / (n x squares - total^2), which lies in [0, 1]. For
    unequal numbers it is t^2. Sums are whole numbers and exact, so that ties are ties on every machine.
    """

    in_float32 = True  # where sums are exact

    def __init__(self, pairs: Sequence[tuple[IntArray, IntArray]], blocks: Blocks) -> None:
        self.blocks = blocks
        self.sizes = tuple(np.sum(blocks, axis=0).tolist())
        self.n_pairs, self.n_comparisons = len(pairs), pairs[0][0].shape[1]
        pooled = np.stack([_interleaved(pair, blocks) for pair in pairs])  # (P, n, E)
        unit = max(1, int(np.gcd.reduce(pooled, axis=None)))
        rows = np.ascontiguousarray(np.moveaxis(pooled // unit, 2, 0)).reshape(
            -1, pooled.shape[1]
        )  # (E P, n)
        self._shift(rows)
        labels = np.concatenate([np.repeat([1, 0], block) for block in blocks])
        self.totals, self.squares = rows.sum(axis=1), (rows**2).sum(axis=1)
        self.equal = self.sizes[0] == self.sizes[1]
        summed = self._powers(rows)
        self.all_runs = [each.sum(axis=1) for each in summed]
        largest = max(2 * int(np.abs(each).sum(axis=1).max()) for each in summed)
        self.kind: Any = np.float32 if largest < _EXACT and self.in_float32 else np.float64
        self.matrices = [each.astype(self.kind) for each in summed]
        observed = [(each @ labels)[:, None].astype(self.kind) for each in summed]
        self.observed = self._of(observed).reshape(self.n_comparisons, self.n_pairs)

    def _shift(self, rows: IntArray) -> None:
        """Move every row to small numbers, which lose least in differences."""
        rows -= np.rint(rows.mean(axis=1)).astype(np.int64)[:, None]

    def _powers(self, rows: IntArray) -> list[NDArray[Any]]:
        """Return the powers of the runs whose sums are needed."""
        return [rows] if self.equal else [rows, rows**2]

    def count(self, chunks: range, seed: int) -> IntArray:
        """Return, shape (P, E), how many relabelings of these chunks have a maximum of at least the observed."""
        reached = np.zeros((self.n_pairs, self.n_comparisons), dtype=np.int64)
        for chunk in chunks:
            reached += self.counted(
                [relabelings(*sizes, chunk, seed, block) for block, sizes in enumerate(self.blocks)]
            )
        return reached

    def counted(self, labels: Sequence[NDArray[Any]]) -> IntArray:
        """Return, shape (P, E), how many of these labelings, by block, have a maximum of at least the observed."""
        largest = self.largest(labels)
        return np.stack(
            [np.count_nonzero(largest >= each[:, None], axis=1) for each in self.observed], axis=1
        )

    def largest(self, labels: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return, shape (P, labelings), the largest statistic of each labeling."""
        sums = [self._sum(matrix, labels) for matrix in self.matrices]
        found: NDArray[Any] = self._of(sums).reshape(self.n_comparisons, self.n_pairs, -1).max(axis=0)
        return found

    def _sum(self, matrix: NDArray[Any], labels: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return, shape (E P, relabelings), the sum over the runs labeled "first"."""
        ends = np.cumsum([len(each) for each in labels]).tolist()
        total: NDArray[Any] | None = None
        for end, each in zip(ends, labels):
            columns, weights = matrix[:, end - len(each) : end], each.astype(self.kind, copy=False)
            part = small_product(columns, weights) if self.kind is np.float32 else columns @ weights
            total = part if total is None else np.add(total, part, out=total)
        assert total is not None
        return total

    def _of(self, sums: Sequence[NDArray[Any]]) -> NDArray[Any]:
        n_first, n_second = self.sizes
        if self.equal:
            spread = (n_first + n_second) * self.squares - self.totals**2
            scale = np.divide(1.0, spread, out=np.zeros(len(spread)), where=spread > 0)
            result: NDArray[Any] = sums[0] * self.kind(2)
            result -= self.totals.astype(self.kind)[:, None]
            result *= result
            result *= scale.astype(self.kind)[:, None]
            return result
        # t^2 = difference^2 / variance, both polynomials of the first's sums: few passes over large arrays
        first, squares = (each.astype(np.float64) for each in sums)
        totals, all_squares = self.totals[:, None], self.squares[:, None]
        one, other = (1 / (n * (n - 1)) for n in (n_first, n_second))
        variance = first * -(one / n_first + other / n_second)
        variance += totals * (2 * other / n_second)
        variance *= first
        squares *= one - other
        variance += squares
        variance += all_squares * other - totals**2 * (other / n_second)
        first *= 1 / n_first + 1 / n_second
        first -= totals / n_second
        first *= first
        # what rounding leaves of a variance of zero is zero
        nothing = 1e-12 * all_squares * (one + other)
        with np.errstate(divide="ignore", invalid="ignore"):
            np.divide(first, np.where(variance > nothing, variance, 0), out=first)
        first[np.isnan(first)] = 0
        return first


class _RatioStatistics(_Statistics):
    """|t| of the log ratio of means, see `ratio_t`: of sums and sums of squares, and rounding is allowed for."""

    in_float32 = False

    def _shift(self, rows: IntArray) -> None:
        pass

    def count(self, chunks: range, seed: int) -> IntArray:
        """As for any statistic; but every chunk has the labelings of the first, of runs in another random order.

        So each labeling is as likely as any other, and is made in a tenth of the time.
        """
        labels = [weights(*sizes, seed, block) for block, sizes in enumerate(self.blocks)]
        reached = np.zeros((self.n_pairs, self.n_comparisons), dtype=np.int64)
        given, together = self.matrices, max(1, _ROWS // len(self.totals))
        for begin in range(chunks.start, chunks.stop, together):
            orders = [self._order(chunk, seed) for chunk in chunks[begin - chunks.start :][:together]]
            self.matrices = [np.concatenate([matrix[:, each] for each in orders]) for matrix in given]
            reached += self.counted(labels)
        self.matrices = given
        return reached

    def _order(self, chunk: int, seed: int) -> IntArray:
        """Return the order of the runs in a chunk: shuffled within blocks, but for the first."""
        generator, sizes = np.random.default_rng([seed, chunk]), [sum(block) for block in self.blocks]
        shuffled = generator.permutation if chunk else np.arange
        return np.concatenate([begin + shuffled(n) for begin, n in zip(np.cumsum([0, *sizes]), sizes)])

    def _powers(self, rows: IntArray) -> list[NDArray[Any]]:
        return [rows, rows.astype(np.float64) ** 2]

    def counted(self, labels: Sequence[NDArray[Any]]) -> IntArray:
        """Return, shape (P, E), how many of these labelings, by block, have a maximum of at least the observed."""
        reached, least = (
            np.zeros((self.n_pairs, self.n_comparisons), dtype=np.int64),
            self.observed * (1 - 1e-9),
        )
        for begin in range(0, labels[0].shape[1], _COLUMNS):
            largest = self.largest([each[:, begin : begin + _COLUMNS] for each in labels])
            reached += np.stack(
                [np.count_nonzero(largest >= each[:, None], axis=1) for each in least], axis=1
            )
        return reached

    def largest(self, labels: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return, shape (P, labelings), the largest statistic of each labeling; both powers are summed at once."""
        sums = np.split(self._sum(np.concatenate(self.matrices), labels), 2)
        t = self._of(sums).reshape(-1, self.n_comparisons, self.n_pairs, sums[0].shape[1]).max(axis=1)
        found: NDArray[Any] = np.moveaxis(t, 0, 1).reshape(self.n_pairs, -1)
        return found

    def _of(self, sums: Sequence[NDArray[Any]]) -> NDArray[Any]:
        copies = len(sums[0]) // len(self.totals)
        ours = [each.astype(np.float64, copy=False) for each in sums]
        theirs = [np.tile(total, copies)[:, None] - each for total, each in zip(self.all_runs, ours)]
        sides = ((count, *each) for count, each in zip(self.sizes, (ours, theirs)))
        ratio, variance = log_ratio(*sides)
        return np.abs(studentized(ratio, variance))


def _interleaved(pair: tuple[IntArray, IntArray], blocks: Blocks) -> IntArray:
    """Return the runs of both, (n, E), block by block: first, second, first, second."""
    ends = np.cumsum(np.array(blocks), axis=0)
    return np.concatenate(
        [
            side[end - size : end]
            for row, block in zip(ends, blocks)
            for side, end, size in zip(pair, row, block)
        ]
    )


@dataclass(frozen=True, slots=True)
class TimesRule:
    """Significant where the mean steps below a threshold differ; all deltas of a threshold get its sign.

    The statistic is Welch's t of the times T(eps) (see `qrlsuite.statistics.times`), with one critical value for
    all E thresholds from relabelings of whole runs (see `MaxT`). It is computed from all runs of both entries,
    which may differ in number. Sources: Westfall and Young 1993; Janssen 1997; Chung and Romano 2013.

    Attributes
    ----------
    alpha:
        Probability, for two entries of equal law, that any threshold is declared different.
    """

    alpha: float = 0.05

    def __post_init__(self) -> None:
        check_probability(self.alpha, "alpha")

    @property
    def name(self) -> str:
        """The rule's name."""
        return "times"

    @property
    def promise(self) -> str:
        """The error probability that the rule controls."""
        return (
            f"all tolerances of one pair: two entries of equal law differ significantly at any with probability "
            f"{self.alpha:g} at most; for equal means but unequal laws about so, if both have many runs; not the "
            "direction, and not the whole board of many pairs"
        )

    def __call__(self, first: Evidence, second: Evidence) -> Signs:
        """Return the sign of every cell, shape (E, D)."""
        signs: Signs = self.against(first, [second])[0]
        return signs

    def against(self, first: Evidence, others: Sequence[Evidence]) -> Signs:
        """Return the signs of one entry against M others, shape (M, E, D)."""
        own = times_of(first)
        pairs = [(own, times_of(other)) for other in others]
        test = MaxT(pairs, seed=first.resampling.seed)
        test.extend(relabelings_for(self.alpha))
        signs = np.where(test.p_each <= self.alpha, np.sign(test.t), 0).astype(np.int8)
        return np.repeat(signs[:, :, None], first.grid.shape[1], axis=2)


@dataclass(frozen=True, slots=True)
class StepsRule(TimesRule):
    """Significant where the mean steps below all thresholds differ: every cell gets the sign of the pair.

    The statistic is the log ratio of the two means, with half an epoch added, over its standard error (`ratio_t`),
    among relabelings of whole runs.
    """

    @property
    def name(self) -> str:
        """The rule's name."""
        return "steps"

    @property
    def promise(self) -> str:
        """The error probability that the rule controls."""
        return (
            f"mean steps of one pair: two entries of equal law differ significantly with probability {self.alpha:g} at "
            "most; for equal means but unequal laws about so, if both have many runs; not the direction, and not the "
            "whole board of many pairs"
        )

    def against(self, first: Evidence, others: Sequence[Evidence]) -> Signs:
        """Return the signs of one entry against M others, shape (M, E, D)."""
        epoch = max(each.steps_per_epoch for each in (first, *others))
        own, *rest = (
            with_half_epoch(times_of(each), epoch).sum(axis=1, keepdims=True) for each in (first, *others)
        )
        test = MaxT([(own, each) for each in rest], seed=first.resampling.seed, ratio=True)
        test.extend(relabelings_for(self.alpha))
        signs = np.where(test.p_each <= self.alpha, np.sign(test.t), 0).astype(np.int8)
        return np.broadcast_to(signs[:, :, None], (len(others), *first.grid.shape)).copy()


def with_half_epoch(times: IntArray, epoch: int) -> IntArray:
    """Return twice the steps below threshold, with half an epoch's steps added: never 0, and whole."""
    return 2 * times + epoch


def times_of(evidence: Evidence) -> IntArray:
    """Return the steps below threshold of all runs of an entry, shape (N, E)."""
    return times_below(evidence.entry.values, evidence.grid, evidence.steps_per_epoch)
