"""Rule `steps`: intervals that belong to p, and what few runs can decide."""

from __future__ import annotations

import doctest

import numpy as np
import pytest

from qrlsuite.statistics import Direction, Grid, LearningCurves, MaxT, steps, times_pair
from qrlsuite.statistics.steps import least_p, ratio_interval, runs_that_decide

CELL = Grid.relative([0.1, 0.5], [0.5])


def rejected(first: np.ndarray, second: np.ndarray, ratio: float, level: float) -> bool:
    """Whether relabelings reject that the first's mean is so many times the second's."""
    scaled = np.rint(1000 * second * ratio).astype(np.int64)
    test = MaxT([(1000 * first[:, None], scaled[:, None])], ratio=True)
    test.extend(10_000)
    return bool(test.p[0] <= level)


@pytest.mark.parametrize(
    ("sizes", "scale"), [((4, 4), 1), ((5, 5), 3), ((4, 7), 2), ((8, 8), 4), ((20, 20), 1.3)]
)
def test_an_interval_holds_the_ratios_that_are_not_rejected(sizes: tuple[int, int], scale: float) -> None:
    generator = np.random.default_rng(0)
    first, second = (
        5 + np.rint(1000 * factor * generator.lognormal(0, 0.5, n)).astype(np.int64)
        for factor, n in zip((1, scale), sizes, strict=True)
    )
    differs = rejected(first, second, 1, 0.05)
    value, low, high = 1 + ratio_interval(first, second, 0.05, differs)
    assert value == pytest.approx(first.mean() / second.mean())
    assert (low > 1 or high < 1) == differs
    for end, outwards in ((low, -0.02), (high, 0.02)):
        assert rejected(first, second, end * (1 + outwards), 0.05)
        assert not rejected(first, second, end * (1 - outwards), 0.05)
    other = 1 + ratio_interval(second, first, 0.05, differs)
    assert 1 / other[[0, 2, 1]] == pytest.approx([value, low, high])


def test_an_interval_without_an_end_and_without_width() -> None:
    some, same = np.array([3, 5, 8, 9]), np.full(4, 7)
    assert ratio_interval(some, some, 0.01, False).tolist() == [0, -1, np.inf], "no labeling has a p of .01"
    assert ratio_interval(same, 2 * same, 0.05, True) == pytest.approx([-0.5] * 3)


def test_what_few_runs_can_decide() -> None:
    assert doctest.testmod(steps).attempted
    assert [round(least_p(n, n), 4) for n in (4, 5, 6)] == [0.0286, 0.0079, 0.0022]
    assert least_p(4, 5) == 1 / 126
    assert runs_that_decide(0.002) == 7


@pytest.mark.parametrize(
    ("n_runs", "alpha", "expected"),
    [(3, 0.05, "undecided"), (4, 0.05, "needs fewer"), (4, 0.02, "undecided"), (5, 0.02, "needs fewer")],
)
def test_a_verdict_from_four_runs_on(n_runs: int, alpha: float, expected: str) -> None:
    def entry(name: str, first_good: int) -> LearningCurves:
        starts = first_good + np.arange(n_runs)
        return LearningCurves((np.arange(40) >= starts[:, None]).astype(float), 100, name)

    pair = times_pair(entry("a", 2), entry("b", 20), CELL, alpha)
    assert pair.direction == Direction(expected)
    assert np.isnan(pair.p) == np.isnan(pair.difference[1]) == (expected == "undecided")
    if expected != "undecided":
        assert pair.p == least_p(n_runs, n_runs)
        assert pair.p_error == 0


def test_the_verdict_is_that_of_the_mean_where_thresholds_cross() -> None:
    """One is half good early and fully late; the other is both in between."""
    noise = np.random.default_rng(0).integers(0, 2, 40)
    half, sure = np.zeros((40, 30)), np.zeros((40, 30))
    for row, late in enumerate(noise):
        half[row, 2 + late :], half[row, 25:] = 0.6, 1
        sure[row, 10 + late :] = 1
    pair = times_pair(LearningCurves(half, 1, "half"), LearningCurves(sure, 1, "sure"), CELL)
    assert pair.signs.tolist() == [-1, 1]
    assert pair.direction is Direction.MORE, "25 and 2.5 epochs are more than twice 10.5"
    assert (pair.differences[:, 1] * pair.differences[:, 2] > 0).all(), "each is significant"
