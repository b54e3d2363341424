"""Several tasks at once: entries by their mean steps below threshold as a share of each task's horizon.

One number per run and task, in [0, 1], less is better: `horizon_shares`. The aggregates are from rliable
(Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice"): mean and
interquartile mean with a stratified bootstrap (runs are redrawn within tasks), and the probability of improvement.
Of one pair, `mean_ratio` averages the ratios of the mean steps, so that no task counts for more because it is longer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, whole
from qrlsuite.statistics.permutation import CHUNK, relabelings, relabelings_for
from qrlsuite.statistics.times import check_probability, student_quantile, times_below
from qrlsuite.statistics.times_board import holm, log_ratios

DRAWN = 8
"""Tasks from which a mean over further tasks is stated, as if these were drawn at random."""

Scores = Mapping[str, Sequence[ArrayLike] | NDArray[np.floating]]
"""For each entry K arrays (runs,), one per task, or rliable's array (runs, tasks)."""


def horizon_shares(entry: LearningCurves, grid: Grid) -> FloatArray:
    """Return, shape (N,): each run's mean steps below the grid's thresholds, as a share of the horizon."""
    shares: FloatArray = times_below(entry.values, grid, entry.steps_per_epoch).mean(axis=1) / entry.horizon
    return shares


@dataclass(frozen=True, eq=False, slots=True)
class AcrossTasks:
    """The result of `across_tasks`, for M entries on K tasks; matrices are from the row's side.

    Attributes
    ----------
    mean, interquartile_mean:
        Shape (M,): the mean over tasks of the mean over runs; the mean of the middle half of all runs of all tasks.
    mean_interval, interquartile_interval:
        Shape (M, 2): percentiles of the stratified bootstrap, at level 1 - alpha for each entry by itself.
    improvement:
        Shape (M, M): mean over tasks of the probability that a run of the row's entry needs less than one of the
        column's, ties counting one half.
    p, adjusted:
        Shape (M, M): of the permutation test of each pair; adjusted for all pairs (Holm). NaN on the diagonal.
    better:
        Shape (M, M): +1 where the row's entry needs significantly less over all tasks, -1 where more, else 0.
    """

    names: tuple[str, ...]
    mean: FloatArray
    interquartile_mean: FloatArray
    mean_interval: FloatArray = field(repr=False)
    interquartile_interval: FloatArray = field(repr=False)
    improvement: FloatArray = field(repr=False)
    p: FloatArray = field(repr=False)
    adjusted: FloatArray = field(repr=False)
    better: IntArray = field(repr=False)

    @property
    def order(self) -> tuple[int, ...]:
        """Indices of the entries by mean, least first, equal ones by name."""
        return tuple(sorted(range(len(self.names)), key=lambda index: (self.mean[index], self.names[index])))


def across_tasks(scores: Scores, alpha: float = 0.05, n_resamples: int = 2000, seed: int = 0) -> AcrossTasks:
    """Compare M entries over K tasks.

    The test of a pair: the sum over tasks of the differences of means, divided by the root of the sum of their
    squared standard errors; labels are exchanged within tasks. Entries of equal law on every task are told apart
    with probability alpha at most, over all pairs.

    Parameters
    ----------
    scores:
        Less is better; every entry on the same tasks in the same order, two runs or more on each.
    alpha:
        In (0, 1).
    n_resamples:
        Number of bootstrap resamples.

    Raises
    ------
    OptionError
        If a value is not finite, an entry has fewer than two runs on a task, or tasks differ in number.
    """
    check_probability(alpha, "alpha")
    count = whole(n_resamples, "n_resamples", at_least=2)
    tasks = {name: _by_task(name, values) for name, values in scores.items()}
    numbers = {name: len(values) for name, values in tasks.items()}
    if len(set(numbers.values())) != 1:
        raise OptionError(f"every entry needs the same tasks; their numbers are {numbers}")
    names, size = tuple(tasks), len(tasks)
    means, middles, mean_draws, middle_draws = [], [], [], []
    for index, values in enumerate(tasks.values()):
        drawn = _redrawn(values, count, np.random.default_rng([whole(seed, "seed", at_least=0), index]))
        means.append(_mean(values))
        middles.append(interquartile_mean(np.concatenate(values)))
        mean_draws.append(_mean(drawn))
        middle_draws.append(interquartile_mean(np.concatenate(drawn, axis=-1)))
    ends = [alpha / 2, 1 - alpha / 2]
    p, adjusted = np.full((2, size, size), np.nan)
    improvement, sign = np.full((size, size), 0.5), np.zeros((size, size))
    pairs = [(i, j) for i in range(size) for j in range(i + 1, size)]
    most = relabelings_for(alpha / max(1, len(pairs)))
    for i, j in pairs:
        first, second = tasks[names[i]], tasks[names[j]]
        improvement[i, j] = probability_of_improvement(first, second)
        improvement[j, i] = 1 - improvement[i, j]
        p[i, j], sign[i, j] = _test(first, second, most, seed)
        p[j, i], sign[j, i] = p[i, j], -sign[i, j]
    upper = np.triu_indices(size, 1)
    adjusted[upper] = holm(p[upper])
    adjusted.T[upper] = adjusted[upper]
    return AcrossTasks(
        names=names,
        mean=np.array(means),
        interquartile_mean=np.array(middles),
        mean_interval=np.quantile(mean_draws, ends, axis=1).T,
        interquartile_interval=np.quantile(middle_draws, ends, axis=1).T,
        improvement=improvement,
        p=p,
        adjusted=adjusted,
        better=np.where(adjusted <= alpha, sign, 0).astype(np.int64),
    )


def _by_task(name: str, values: Sequence[ArrayLike] | NDArray[np.floating]) -> list[FloatArray]:
    if isinstance(values, np.ndarray):
        if values.ndim != 2:
            raise OptionError(f"'{name}': expected shape (runs, tasks), got {values.shape}")
        values = list(values.T)
    arrays = [np.asarray(each, dtype=np.float64) for each in values]
    for task, each in enumerate(arrays):
        if each.ndim != 1 or len(each) < 2:
            raise OptionError(f"'{name}', task {task}: expected two runs or more, got shape {each.shape}")
        if not np.isfinite(each).all():
            raise OptionError(f"'{name}', task {task}: a value is not finite")
    if not arrays:
        raise OptionError(f"'{name}' has no task")
    return arrays


def _redrawn(values: Sequence[FloatArray], count: int, generator: np.random.Generator) -> list[FloatArray]:
    """Return K arrays (count, runs): the runs of each task redrawn with replacement."""
    return [each[generator.integers(0, len(each), size=(count, len(each)))] for each in values]


def _mean(values: Sequence[FloatArray]) -> FloatArray:
    """Return the mean over K tasks of the mean over the last axis, the runs."""
    mean: FloatArray = np.mean([each.mean(axis=-1) for each in values], axis=0)
    return mean


def interquartile_mean(values: ArrayLike) -> FloatArray:
    """Return the mean over the last axis without its lowest and highest quarter, each rounded down (as rliable).

    >>> float(interquartile_mean([9.0, 1.0, 2.0, 4.0]))
    3.0
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=-1)
    cut = ordered.shape[-1] // 4
    mean: FloatArray = ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)
    return mean


def probability_of_improvement(
    first: Sequence[ArrayLike] | NDArray[np.floating], second: Sequence[ArrayLike] | NDArray[np.floating]
) -> float:
    """Return the mean over tasks of P(a run of the first < a run of the second), ties counting one half.

    Parameters
    ----------
    first, second:
        K arrays (runs,), one per task; or one array (runs, K), as for rliable.
    """
    shares = []
    by_task = (each.T if isinstance(each, np.ndarray) else each for each in (first, second))
    for ours, theirs in zip(*by_task, strict=True):
        difference = np.asarray(theirs)[:, None] - np.asarray(ours)
        shares.append((difference > 0).mean() + (difference == 0).mean() / 2)
    return float(np.mean(shares))


def _test(
    first: Sequence[FloatArray], second: Sequence[FloatArray], most: int, seed: int
) -> tuple[float, float]:
    """Return p and the sign of a pair: positive where the first needs less."""
    swap = [each.tobytes() for each in first] > [each.tobytes() for each in second]
    ours, theirs = (second, first) if swap else (first, second)
    labels = [np.repeat([1.0, 0.0], [len(a), len(b)])[:, None] for a, b in zip(ours, theirs)]
    observed = float(_ratio(ours, theirs, labels)[0])
    reached = 0
    for chunk in range(most // CHUNK):
        drawn = [
            relabelings(len(a), len(b), chunk, seed, task).astype(np.float64)
            for task, (a, b) in enumerate(zip(ours, theirs))
        ]
        # the same sum in another order is a tie
        reached += int((np.abs(_ratio(ours, theirs, drawn)) >= abs(observed) * (1 - 1e-9)).sum())
    p = (1 + reached) / (1 + most)
    return p, float(-np.sign(observed) if swap else np.sign(observed))


def _ratio(
    first: Sequence[FloatArray], second: Sequence[FloatArray], labels: Sequence[FloatArray]
) -> FloatArray:
    """Return, shape (R,), the studentized sum over tasks of mean(second) - mean(first) for labels (runs, R)."""
    difference, variance = np.zeros(labels[0].shape[1]), np.zeros(labels[0].shape[1])
    for ours, theirs, chosen in zip(first, second, labels, strict=True):
        pooled = np.concatenate([ours, theirs])
        pooled = pooled - pooled.mean()
        sums, squares = pooled @ chosen, pooled**2 @ chosen
        for total, square, count, sign in (
            (sums, squares, len(ours), -1),
            (pooled.sum() - sums, (pooled**2).sum() - squares, len(theirs), 1),
        ):
            difference += sign * total / count
            variance += np.maximum(square - total**2 / count, 0) / (count * (count - 1))
    nothing = np.abs(difference) <= 1e-12 * sum(np.abs(each).max() for each in (*first, *second))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: FloatArray = np.where(nothing, 0.0, difference / np.sqrt(variance))
    return ratio


def rliable_arrays(scores: Scores) -> dict[str, FloatArray]:
    """Return {entry: (runs, tasks)} as rliable takes it; of each task the first n runs, n the fewest of the entry.

    In rliable larger is better: give it 1 minus these values.
    """
    arrays = {}
    for name, values in scores.items():
        tasks = _by_task(name, values)
        n_runs = min(len(each) for each in tasks)
        arrays[name] = np.stack([each[:n_runs] for each in tasks], axis=1)
    return arrays


@dataclass(frozen=True, slots=True)
class MeanRatio:
    """How many more steps the second of two entries needs, on average over K tasks; all differences are ratios minus 1.

    Attributes
    ----------
    differences:
        On each task: the second's mean steps over the first's.
    difference, interval:
        The geometric mean of the ratios over the tasks, and its confidence interval. The tasks are fixed: only the
        seeds are drawn, so nothing follows for other tasks.
    p:
        Two-sided, of no mean difference.
    left_out:
        Least and greatest `difference` when one of the tasks is left out.
    drawn_interval, drawn_p:
        As `interval` and `p`, of the mean over all tasks of which these K were drawn at random: each task's log ratio
        is one observation of Student's t test. NaN below `DRAWN` tasks.
    """

    differences: tuple[float, ...]
    difference: float
    interval: tuple[float, float]
    p: float
    left_out: tuple[float, float]
    drawn_interval: tuple[float, float]
    drawn_p: float


def mean_ratio(pairs: Sequence[tuple[IntArray, IntArray]], level: float = 0.95) -> MeanRatio:
    """Compare two entries on average over tasks, by the log ratios of their mean steps.

    The error of each task's log ratio follows from the delta method; the error of the mean has Welch and
    Satterthwaite's degrees of freedom.

    Parameters
    ----------
    pairs:
        Times of the first and the second entry on each of two or more tasks, (N, E): results of `times_below`.

    Raises
    ------
    OptionError
        If there are fewer than two tasks, fewer than two runs of an entry, or an entry whose times are all 0.

    Examples
    --------
    Twice the steps on one task, half on the other:

    >>> short, long = np.array([[1000], [3000]]), np.array([[2000], [6000]])
    >>> found = mean_ratio([(short, long), (long, short)])
    >>> [round(each, 9) for each in (*found.differences, abs(found.difference), *found.left_out)]
    [1.0, -0.5, 0.0, -0.5, 1.0]
    """
    check_probability(level, "level")
    if len(pairs) < 2:
        raise OptionError("a mean over tasks needs two tasks or more")
    if any(len(each) < 2 for pair in pairs for each in pair):
        raise OptionError("a mean over tasks needs two runs or more of each entry on every task")
    found = [log_ratios(pair) for pair in pairs]
    ratios, errors, freedoms = (np.array([float(each[part][1, 0]) for each in found]) for part in range(3))
    if not np.isfinite(ratios).all():
        raise OptionError("an entry is below no threshold for a single step: there is no ratio of mean steps")
    variance, slack = (errors**2).sum(), (errors**4 / freedoms).sum()
    freedom = variance**2 / slack if slack else math.inf
    mean, error = ratios.mean(), math.sqrt(variance) / len(pairs)
    reach = error * float(student_quantile((1 + level) / 2, freedom))
    others = (ratios.sum() - ratios) / (len(ratios) - 1)
    among = float(ratios.std(ddof=1)) / math.sqrt(len(pairs)) if len(pairs) >= DRAWN else math.nan
    among_reach = among * float(student_quantile((1 + level) / 2, len(pairs) - 1))
    return MeanRatio(
        tuple(np.expm1(ratios).tolist()),
        math.expm1(mean),
        (math.expm1(mean - reach), math.expm1(mean + reach)),
        _two_sided(mean, error, freedom),
        (math.expm1(others.min()), math.expm1(others.max())),
        (math.expm1(mean - among_reach), math.expm1(mean + among_reach)),
        _two_sided(mean, among, len(pairs) - 1),
    )


def _two_sided(mean: float, error: float, freedom: float) -> float:
    """Return Student's two-sided p; without an error, 0 of a difference and 1 of none."""
    from scipy.special import stdtr

    if error == 0:
        return float(mean == 0)
    return float(2 * stdtr(freedom, -abs(mean) / error))
