"""Cluster bootstrap of the sample complexity: resample whole runs, keep each run's curve together.

A resample of runs is a vector of weights, one per run. How many of the drawn runs have reached a threshold
at an epoch is then the product (thresholds x epochs, runs) @ (runs, resamples) of a 0/1 matrix with the
weights: all resamples at once, in float32, which holds such counts exactly up to 2^24, so the result does
not depend on the BLAS or its threads. Counts of up to 255 runs then fit a byte, where a comparison with the
required counts handles 32 or 64 at a time.

Source: paper, section "Sample Complexity" of the experiments (cluster resampling, Cameron et al. 2008).
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.curves import Curve, checked, reached
from qrlsuite.statistics.estimator import epochs_below
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, exact, whole

Weights = NDArray[np.float32]
EpochDraws = NDArray[np.int32]

BLOCK = 2048  # resamples at a time: a block of counts stays in the cache
BYTE = 255  # the most that a byte can count
_TILE = 2**18  # rows x columns x depth up to which OpenBLAS multiplies float32 matrices on one thread


def bootstrap_interval(
    curves: ArrayLike,
    grid: Grid,
    steps_per_epoch: int,
    n_resamples: int = 1000,
    percentiles: tuple[float, float] = (5, 95),
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
        Runs per resample; None means all N. With fewer than N the interval is that of an entry of `n_runs`
        runs, for a comparison at equal numbers: it is centered on the median of its draws, and not widened
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
    n_resamples: int = 1000,
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
    curves: Curve, grid: Grid, n_resamples: int = 1000, seed: int = 0, n_runs: int | None = None
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
    grid:
        The cells.
    weights:
        Shape (N, R), whole numbers; every column sums to `n_runs`.
    n_runs:
        Runs per resample: a delta means the smallest c with c / n_runs >= delta.
    """
    n_thresholds, n_deltas = grid.shape
    resamples = weights.shape[1]
    required = grid.required_counts(n_runs)
    counts_type = np.uint8 if n_runs <= BYTE else np.uint32
    indicators = reached(curves, grid)
    totals = np.count_nonzero(indicators, axis=2)
    result = np.empty((n_thresholds, n_deltas, resamples), dtype=np.int32)
    for row in range(n_thresholds):
        # where no run or every run is there, so it is in every resample
        result[row] = np.count_nonzero(totals[row] == 0)
        mixed = (totals[row] > 0) & (totals[row] < curves.shape[0])
        if not mixed.any():
            continue
        matrix = indicators[row][mixed].astype(np.float32)
        for start in range(0, resamples, BLOCK):
            block = slice(start, start + BLOCK)
            counts = small_product(matrix, weights[:, block]).astype(counts_type)
            for column, needed in enumerate(required.astype(counts_type)):
                add_epochs(counts < needed, result[row, column, block])
    return result


def small_product(matrix: NDArray[np.float32], weights: Weights) -> NDArray[np.float32]:
    """Return `matrix @ weights` in tiles too small for OpenBLAS to start a second thread.

    The whole product takes two tenths of a millisecond. Threads would halve that on an idle machine, and
    stall for tens of milliseconds on a busy one, such as one with a worker process per core.
    """
    rows, columns, depth = matrix.shape[0], weights.shape[1], matrix.shape[1]
    height = max(8, math.isqrt(_TILE // depth))
    width = max(8, _TILE // (depth * min(rows, height)))
    product = np.empty((rows, columns), dtype=np.float32)
    for left in range(0, columns, width):
        for top in range(0, rows, height):
            tile = product[top : top + height, left : left + width]
            np.matmul(matrix[top : top + height], weights[:, left : left + width], out=tile)
    return product


def add_epochs(below: NDArray[np.bool_], total: EpochDraws) -> None:
    """Add the number of true epochs of a (T, R) block to `total` (R,), in bytes for speed."""
    marks = below.view(np.uint8)
    for start in range(0, marks.shape[0], BYTE):
        total += np.add.reduce(marks[start : start + BYTE], axis=0, dtype=np.uint8)
