"""One number per run: how well it did at the end, over all of its training, and how far it is from the other runs.

`final_scores` is the mean over the last tenth of the epochs: a single validation is noisy, and a tenth is short enough
that learning has little part in it. `areas` is the area under the learning curve over the horizon: the mean over all
epochs. `deviations` are small where seeds are alike. `compare_scores` compares entries by one of them, with the
aggregates of rliable (Agarwal et al. 2021).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from qrlsuite.errors import OptionError
from qrlsuite.statistics.across import AcrossTasks, across_tasks
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.grid import FloatArray, Grid
from qrlsuite.statistics.times import check_probability, student_quantile, times_below


def last_epochs(n_epochs: int) -> int:
    """Return how many epochs count as the last: a tenth, rounded up.

    >>> last_epochs(11)
    2
    """
    return math.ceil(n_epochs / 10)


def final_scores(entry: LearningCurves) -> FloatArray:
    """Return, shape (N,): each run's mean score over the last tenth of its epochs."""
    scores: FloatArray = entry.values[:, -last_epochs(entry.values.shape[1]) :].mean(axis=1, dtype=np.float64)
    return scores


def areas(entry: LearningCurves) -> FloatArray:
    """Return, shape (N,): the area under each run's curve divided by the horizon, its mean score over all epochs."""
    scores: FloatArray = entry.values.mean(axis=1, dtype=np.float64)
    return scores


def deviations(entry: LearningCurves, grid: Grid) -> FloatArray:
    """Return, shape (N,): how far each run's mean steps below the thresholds are from the median run's.

    Their means are compared by the test of Brown and Forsythe (1974), labels of runs permuted: docs/error-rates.md.
    """
    steps = times_below(entry.values, grid, entry.steps_per_epoch).mean(axis=1)
    apart: FloatArray = np.abs(steps - np.median(steps))
    return apart


@dataclass(frozen=True, eq=False, slots=True)
class ScoreBoard(AcrossTasks):
    """The result of `compare_scores` for M entries: as for several tasks, but that more is better.

    Attributes
    ----------
    difference, difference_interval:
        Shape (M, M) and (M, M, 2): mean of the row's entry minus mean of the column's, in units of the score; Welch's t
        at level 1 - alpha for each pair by itself.
    """

    difference: FloatArray = field(repr=False)
    difference_interval: FloatArray = field(repr=False)

    @property
    def order(self) -> tuple[int, ...]:
        """Indices of the entries by mean, most first, equal ones by name."""
        return tuple(sorted(range(len(self.names)), key=lambda index: (-self.mean[index], self.names[index])))


def compare_scores(
    scores: Mapping[str, ArrayLike], alpha: float = 0.05, n_resamples: int = 2000, seed: int = 0
) -> ScoreBoard:
    """Compare M entries by one score per run, more is better.

    Parameters
    ----------
    scores:
        For each entry an array (runs,) of two runs or more; numbers of runs may differ.
    alpha:
        In (0, 1): probability of any false difference among entries of equal laws.

    Raises
    ------
    OptionError
        If there is no entry, a score is not finite, or an entry has fewer than two runs.
    """
    check_probability(alpha, "alpha")
    if not scores:
        raise OptionError("a comparison of scores needs an entry")
    values = {name: np.asarray(each, dtype=np.float64) for name, each in scores.items()}
    turned = across_tasks({name: [-each] for name, each in values.items()}, alpha, n_resamples, seed)
    difference, interval = _differences(list(values.values()), 1 - alpha)
    return ScoreBoard(
        names=turned.names,
        mean=-turned.mean,
        interquartile_mean=-turned.interquartile_mean,
        mean_interval=-turned.mean_interval[:, ::-1],
        interquartile_interval=-turned.interquartile_interval[:, ::-1],
        difference=difference,
        difference_interval=interval,
        improvement=turned.improvement,
        p=turned.p,
        adjusted=turned.adjusted,
        better=turned.better,
    )


def _differences(values: list[FloatArray], level: float) -> tuple[FloatArray, FloatArray]:
    """Return differences of means (M, M), row minus column, and their intervals (M, M, 2): Welch's t."""
    counts = np.array([len(each) for each in values])
    means = np.array([each.mean() for each in values])
    parts = np.array([each.var(ddof=1) for each in values]) / counts
    both, slack = parts[:, None] + parts, parts**2 / (counts - 1)
    spread = slack[:, None] + slack
    freedom = np.divide(both**2, spread, out=np.full(both.shape, np.inf), where=spread > 0)
    reach = student_quantile((1 + level) / 2, freedom) * np.sqrt(both)
    np.fill_diagonal(reach, 0)
    difference = means[:, None] - means
    return difference, np.stack([difference - reach, difference + reach], axis=2)
