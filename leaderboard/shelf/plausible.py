"""Checks of published curves by training seeds again: the number of seeds needed, and tests against forgeries.

If bits are comparable, one seed that differs is proof. Otherwise floating point differs in the last bits, and training
amplifies that: most seeds keep their bits for some epochs, then part. Two tests need no tolerance. A seed's first
epochs are its own: hardly any other seed's published curve is nearer. And the number that ranks, the steps that a run
spends below the thresholds, has one law in both trainings: pairs of one seed are compared, and all retrained seeds with
all others. `benchmarks/forgeries.py` computes the power of these tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from qrlsuite.statistics import Grid
from qrlsuite.statistics.times import times_below

POWER = 0.95
"""Probability of finding a forgery, for which the number of seeds is chosen."""
REPLACED = 0.1
"""Share of forged seeds that is to be found with that probability."""
FASTER = 1.1
"""Factor by which all curves of the other forgery are faster."""
FALSE_ALARM = 0.01
"""Probability, at most, that honest curves are called implausible; divided among the two tests."""
FIRST = 2
"""Epochs by which a seed is recognized."""
NEARER = 0.05
"""A seed is its own while at most this share of the others' curves is nearer. A stranger's is so by chance as often."""
LOST = 0.2
"""Share of honest seeds of a GPU that may part from the processor's before `FIRST` epochs, beyond recognition."""

_FLIPS, _DRAWS = 4095, 200

Floats = NDArray[np.float64]


def found_by(again: int, forged: int, seeds: int) -> float:
    """Return the probability that at least one of `forged` seeds is among the `again` seeds that are trained again.

    >>> round(found_by(25, 10, 100), 3)
    0.952
    """
    return 1 - math.comb(seeds - forged, again) / math.comb(seeds, again)


def forged_of(seeds: int) -> int:
    """Return how many forged seeds are to be found: a tenth, and one at least."""
    return max(1, round(REPLACED * seeds))


def needed(seeds: int) -> int:
    """Return how many seeds have to be trained again to find a tenth of them forged with probability .95.

    >>> needed(100), needed(20)
    (25, 16)
    """
    forged = forged_of(seeds)
    return next(again for again in range(1, seeds + 1) if found_by(again, forged, seeds) >= POWER)


def strangers(again: Floats, curves: Floats, places: list[int]) -> list[int]:
    """Return which of the seeds trained again begin unlike the published seeds of their numbers.

    Parameters
    ----------
    again:
        (k, T) curves trained again.
    curves:
        (N, T) published.
    places:
        The k rows of `curves` that were trained again.

    Returns
    -------
    list
        Indices in `places`.
    """
    begun, stated = again[:, :FIRST], curves[:, :FIRST]
    away = np.abs(begun[:, None] - stated[None]).mean(axis=2)
    own = away[np.arange(len(places)), places]
    nearer = (away < own[:, None]).sum(axis=1)
    return [int(i) for i in np.flatnonzero(nearer > NEARER * (len(curves) - 1))]


def tolerated(again: int, on_gpu: bool) -> int:
    """Return how many strangers among `again` seeds are no forgery: none on processors.

    A GPU's values are 3e-5 from a processor's, and seeds part sooner. More than this are found of honest seeds in one
    of 200 checks.

    >>> tolerated(26, on_gpu=False), tolerated(26, on_gpu=True)
    (0, 11)
    """
    from scipy.stats import binom

    return int(binom.ppf(1 - FALSE_ALARM / 2, again, LOST)) if on_gpu else 0


def per_run(curves: Floats, grid: Grid, steps_per_epoch: int) -> Floats:
    """Return M of each run, (N,): environment steps below the thresholds, mean over them."""
    times: Floats = times_below(curves, grid, steps_per_epoch).mean(axis=1)
    return times


def paired_p(differences: Floats) -> float:
    """Return the two-sided p of differences of pairs, (k,), by flips of their signs; 1 where all are 0."""
    return float(_paired(differences[None])[0])


def _paired(differences: Floats) -> Floats:
    """Return the same for each row of (draws, k)."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (differences.shape[1], _FLIPS))
    sums, slack = np.abs(differences.sum(axis=1)), 1e-9 * (1 + np.abs(differences).sum(axis=1))
    beyond = (np.abs(differences @ signs) >= (sums - slack)[:, None]).sum(axis=1)
    p: Floats = (1 + beyond) / (_FLIPS + 1)
    return p


def rank_p(again: Floats, others: Floats) -> float:
    """Return the two-sided p of the Mann-Whitney test; 1 without others, and where all values are equal."""
    from scipy.stats import mannwhitneyu  # a second, which checking files does without

    if not len(others):
        return 1.0
    p = float(mannwhitneyu(again, others, alternative="two-sided").pvalue)
    return 1.0 if math.isnan(p) else p


def faster(curves: Floats, factor: float = FASTER) -> Floats:
    """Return curves that get as far in less time: after epoch t they are where they were after `factor` times t."""
    epochs = np.arange(1, curves.shape[1] + 1)
    return np.array([np.interp(epochs * factor, epochs, curve) for curve in curves])


def power(curves: Floats, again: Floats, places: list[int], run_times: Callable[[Floats], Floats]) -> float:
    """Return how often the test of times would reject curves that are 10 percent faster than these.

    Pairs of the retrained seeds are drawn anew, so that the result holds for this entry and the correlation of its
    two trainings. A faster curve keeps its first epochs: a forger knows that check.

    Parameters
    ----------
    curves, again, places:
        As for `strangers`.
    run_times:
        Returns M of each curve, as `per_run`.
    """
    quick = faster(curves)
    quick[:, :FIRST] = curves[:, :FIRST]
    stated, here = run_times(quick), run_times(again)
    others = np.delete(stated, places)
    generator = np.random.default_rng(0)
    draws = generator.integers(0, len(places), (_DRAWS, len(places)))
    paired = _paired(stated[places][draws] - here[draws]) <= FALSE_ALARM / 2
    ranked = [rank_p(here[draw], others) <= FALSE_ALARM / 2 for draw in draws]
    return float(np.mean(paired | np.array(ranked)))
