"""Cluster bootstrap of the sample complexity: resample whole runs, keep each run's curve together.

A resample of runs is a vector of weights, one per run. How many of the drawn runs have reached a threshold
at an epoch is then the product (thresholds x epochs, runs) @ (runs, resamples) of a 0/1 matrix with the
weights: all resamples at once, in float32, which holds such counts exactly up to 2^24, so the result does
not depend on the BLAS or its threads. Counts of up to 255 runs fit a byte: three of them are multiplied as one
float32, and a comparison with the required counts handles 32 or 64 at a time.

Source: paper, section "Sample Complexity" of the experiments (cluster resampling, Cameron et al. 2008).
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.curves import Curve, checked, reached
from qrlsuite.statistics.estimator import epochs_below
from qrlsuite.statistics.grid import BoolArray, FloatArray, Grid, IntArray, exact, whole

Weights = NDArray[np.float32]
EpochDraws = NDArray[np.int32]

RESAMPLES = 1000
"""How often runs are redrawn, unless a caller says otherwise."""
PERCENTILES = (5.0, 95.0)
"""Ends of an interval of S_hat, both in pictures and in verdicts."""
BLOCK = 2048  # resamples at a time: a block of counts stays in the cache
BYTE = 255  # the most that a byte can count
_TILE = 2**18  # rows x columns x depth up to which OpenBLAS multiplies float32 matrices on one thread
_HEIGHT = 32  # rows of a tile
_ROWS = 1536  # rows (thresholds x epochs) at a time


def bootstrap_interval(
    curves: ArrayLike,
    grid: Grid,
    steps_per_epoch: int,
    n_resamples: int = RESAMPLES,
    percentiles: tuple[float, float] = PERCENTILES,
    seed: int = 0,
    n_runs: int | None = None,
) -> FloatArray:
    """Return percentile intervals of S_hat in environment steps, shape (E, D, 2): lower, upper.

    Parameters
    ----------
    curves, grid, steps_per_epoch:
        As in `qrlsuite.statistics.sample_complexity`.
    n_resamples:
        How often the runs are redrawn.
    percentiles:
        Lower and upper percentile, in [0, 100]; between two draws they are interpolated linearly.
    seed:
        The same seed gives the same interval, on every machine.
    n_runs:
        Runs per resample; None means all N. With fewer than N it is the interval of an entry of `n_runs` runs,
        for a comparison at equal numbers: it is centered on the median of its draws, and not widened
        to the S_hat of all N runs, because S_hat at another number of runs is another quantity.

    Returns
    -------
    numpy.ndarray
        With all N runs: the percentiles, widened to contain S_hat.

    Raises
    ------
    OptionError
        If an argument is out of its range, or `n_runs` exceeds N.
    """
    values = checked(curves, relative=grid.is_relative)
    steps = whole(steps_per_epoch, "steps_per_epoch", at_least=1)
    drawn = draw_epochs(values, grid, n_resamples, seed, n_runs)
    center = central_epochs(values, grid, drawn, n_runs)
    return widened_percentiles(drawn, center, percentiles, steps)


def bootstrap_draws(
    curves: ArrayLike,
    grid: Grid,
    steps_per_epoch: int,
    n_resamples: int = RESAMPLES,
    seed: int = 0,
    n_runs: int | None = None,
) -> IntArray:
    """Return S_hat of every resample in environment steps, shape (R, E, D), for rules of one's own.

    Arguments and errors as in `bootstrap_interval`. Two entries with equal N, drawn with the same seed, are
    resampled by the same weights: draw r of both then uses the same runs.
    """
    values = checked(curves, relative=grid.is_relative)
    steps = whole(steps_per_epoch, "steps_per_epoch", at_least=1)
    drawn = draw_epochs(values, grid, n_resamples, seed, n_runs)
    in_steps: IntArray = np.ascontiguousarray(np.moveaxis(drawn, 2, 0), dtype=np.int64) * steps
    return in_steps


def central_epochs(curves: Curve, grid: Grid, drawn: EpochDraws, n_runs: int | None) -> FloatArray:
    """Return, shape (E, D), the point estimate in epochs that belongs to an interval.

    S_hat itself where every resample has as many runs as the entry, else the median of the draws.
    """
    if n_runs is None or n_runs == curves.shape[0]:
        return epochs_below(curves, grid).astype(np.float64)
    median: FloatArray = np.median(drawn, axis=2)
    return median


def widened_percentiles(
    drawn: EpochDraws, center: FloatArray, percentiles: tuple[float, float], steps_per_epoch: int
) -> FloatArray:
    """Return, shape (E, D, 2), percentiles in steps of draws (E, D, R), widened to contain a center (E, D).

    Draws and center are in epochs. The result is rounded to a millionth of a step, so that two intervals that
    touch do so in floating point too, whatever their steps per epoch.
    """
    lower, upper = check_percentiles(percentiles)
    low, high = np.percentile(drawn, [lower, upper], axis=2)
    interval = np.stack([np.minimum(low, center), np.maximum(high, center)], axis=2)
    rounded: FloatArray = np.round(interval * steps_per_epoch, 6)
    return rounded


def check_percentiles(percentiles: tuple[float, float]) -> tuple[float, float]:
    """Return a lower and an upper percentile, or raise OptionError unless 0 <= lower < upper <= 100."""
    if len(percentiles) != 2:
        raise OptionError(f"percentiles = {percentiles!r}: expected a lower and an upper one")
    lower, upper = (float(exact(value, "percentiles")) for value in percentiles)
    if not 0 <= lower < upper <= 100:
        raise OptionError(f"percentiles = {percentiles!r}: expected 0 <= lower < upper <= 100")
    return lower, upper


def draw_epochs(
    curves: Curve, grid: Grid, n_resamples: int = RESAMPLES, seed: int = 0, n_runs: int | None = None
) -> EpochDraws:
    """Return, shape (E, D, R), the epochs below delta of every resample of checked curves (N, T).

    Raises
    ------
    OptionError
        If `n_resamples` or `n_runs` is not a positive integer, or `n_runs` exceeds N.
    """
    available = curves.shape[0]
    runs = available if n_runs is None else whole(n_runs, "n_runs", at_least=1)
    if runs > available:
        raise OptionError(f"n_runs = {runs} exceeds the {available} runs of the entry")
    resamples = whole(n_resamples, "n_resamples", at_least=1)
    weights = _weights(available, runs, resamples, whole(seed, "seed", at_least=0))
    return weighted_epochs(curves, grid, weights, runs)


@functools.lru_cache(maxsize=4)  # a board asks for the same weights for each of its entries
def _weights(available: int, runs: int, resamples: int, seed: int) -> Weights:
    """Return, shape (N, R), how often each of N runs occurs in each of R resamples with replacement."""
    generator = np.random.default_rng(seed)
    chosen = generator.integers(0, available, size=(resamples, runs))
    chosen += available * np.arange(resamples)[:, None]
    counts = np.bincount(chosen.ravel(), minlength=resamples * available)
    weights = np.ascontiguousarray(counts.reshape(resamples, available).T, dtype=np.float32)
    weights.flags.writeable = False
    return weights


def weighted_epochs(curves: Curve, grid: Grid, weights: Weights, n_runs: int) -> EpochDraws:
    """Return, shape (E, D, R), the epochs with a weighted count below the required one.

    Parameters
    ----------
    curves:
        Checked curves, shape (N, T).
    weights:
        Shape (N, R), whole numbers; every column sums to `n_runs`.
    n_runs:
        Runs per resample: a delta means the smallest c with c / n_runs >= delta.
    """
    counted = Indicators(reached(curves, grid))
    required = grid.required_counts(n_runs)
    result = np.empty((*grid.shape, weights.shape[1]), dtype=np.int32)
    for start in range(0, weights.shape[1], BLOCK):
        block = slice(start, start + BLOCK)
        result[..., block] = counted.epochs_below(required, weights[:, block], n_runs)
    return result


class Indicators:
    """Which of N runs have reached E thresholds at T epochs, ready to be counted under many weights.

    Parameters
    ----------
    indicators:
        Shape (E, T, N). The order of the epochs does not matter here.
    """

    def __init__(self, indicators: BoolArray) -> None:
        self.n_thresholds, _, n_runs = indicators.shape
        totals = np.count_nonzero(indicators, axis=2)
        self.never = np.count_nonzero(totals == 0, axis=1)
        # where no run or every run is there, so it is under all weights
        mixed = [np.flatnonzero((row > 0) & (row < n_runs)) for row in totals]
        # by their totals: a count is then near a level in few neighboring rows
        mixed = [rows[np.argsort(each[rows], kind="stable")] for rows, each in zip(mixed, totals)]
        self._rows: NDArray[np.float32] = np.concatenate(
            [each[rows] for each, rows in zip(indicators, mixed)]
        ).astype(np.float32)
        self._ends = np.cumsum([len(rows) for rows in mixed]).tolist()

    def epochs_below(self, levels: IntArray, weights: Weights, most: int) -> NDArray[np.int32]:
        """Return the number of epochs with fewer weighted runs than each level, shape (E, L, R).

        Parameters
        ----------
        levels:
            L whole numbers >= 1.
        weights:
            Shape (N, R), whole numbers.
        most:
            No column of the weights sums to more.
        """
        result = np.empty((self.n_thresholds, len(levels), weights.shape[1]), dtype=np.int32)
        result[:] = self.never[:, None, None]
        for top in range(0, len(self._rows), _ROWS):
            part = slice(top, top + _ROWS)
            counts = whole_product(self._rows[part], weights, most)
            begin = 0
            for total, end in zip(result, self._ends):
                _add_below(counts[max(begin - top, 0) : max(end - top, 0)], levels, total)
                begin = end
        return result


def _add_below(counts: NDArray[Any], levels: IntArray, total: NDArray[np.int32]) -> None:
    """Add to `total` (L, R) how many of the rows of counts (T, R), in about rising order, are below each level."""
    # in the rows before `first` every column is below the level, in those from `last` on none is
    largest, smallest = counts.max(axis=1), counts.min(axis=1)
    first = np.searchsorted(np.maximum.accumulate(largest), levels)
    last = np.searchsorted(np.minimum.accumulate(smallest[::-1])[::-1], levels)
    for level, begin, end, row in zip(levels.tolist(), first.tolist(), last.tolist(), total):
        row += begin
        for start in range(begin, end, BYTE):
            marks = counts[start : min(start + BYTE, end)] < counts.dtype.type(level)
            row += np.add.reduce(marks.view(np.uint8), axis=0, dtype=np.uint8)


def whole_product(indicators: NDArray[np.float32], weights: Weights, most: int) -> NDArray[Any]:
    """Return `indicators @ weights`, (rows, R), of zeros and ones with whole numbers, in the smallest type.

    Parameters
    ----------
    indicators:
        Shape (rows, N), zeros and ones.
    weights:
        Shape (N, R), whole numbers >= 0.
    most:
        No column of the weights sums to more. Up to 255, three rows are multiplied as one: float32 is exact up
        to 2^24, so that it holds three counts of eight bits.
    """
    if most > BYTE:
        return small_product(indicators, weights).astype(np.uint32)
    rows, thirds = len(indicators), -(-len(indicators) // 3)
    three = np.zeros((3, thirds, indicators.shape[1]), dtype=np.float32)
    three.reshape(3 * thirds, -1)[:rows] = indicators
    together = small_product(three[0] + np.float32(2**8) * three[1] + np.float32(2**16) * three[2], weights)
    bits = together.astype(np.int32)
    counts = np.empty((3, *bits.shape), dtype=np.uint8)
    for place in range(3):
        np.right_shift(bits, 8 * place, out=counts[place], casting="unsafe")
    return counts.reshape(3 * thirds, -1)[:rows]


def small_product(matrix: NDArray[np.float32], weights: Weights) -> NDArray[np.float32]:
    """Return `matrix @ weights` in tiles too small for OpenBLAS to start a second thread.

    Threads would halve the time on an idle machine, and stall for tens of milliseconds on a busy one, such as
    one with a worker process per core.
    """
    (rows, depth), columns = matrix.shape, weights.shape[1]
    height = min(max(rows, 1), _HEIGHT)
    width = min(max(8, _TILE // (depth * height)), columns)
    full = columns // width * width
    tiles = weights[:, :full].reshape(depth, -1, width).transpose(1, 0, 2)
    if rows > _HEIGHT:
        tiles = np.ascontiguousarray(tiles)  # each tile in one piece of memory: half the time for many rows
    product = np.empty((rows, columns), dtype=np.float32)
    for top in range(0, rows, height):
        part = matrix[top : top + height]
        out = product[top : top + height, :full].reshape(len(part), -1, width).transpose(1, 0, 2)
        np.matmul(part, tiles, out=out)
        if full < columns:
            np.matmul(part, weights[:, full:], out=product[top : top + height, full:])
    return product
