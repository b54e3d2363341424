"""Time below threshold: one number per run, whose mean is the area of the surface's column."""

from __future__ import annotations

import dataclasses
import doctest
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.statistics import Grid, LearningCurves, mean_time, times, times_below
from qrlsuite.statistics.estimator import complexity
from qrlsuite.statistics.times import times_lost
from tests.statistics.conftest import SURFACE, entry

CELL = Grid.relative([0.1, 0.5], [0.5])


def test_by_hand() -> None:
    curves = [[0.0, 0.5, 0.9], [0.9, 0.4, 1.0], [0.0, 0.0, 0.0]]
    assert times_below(curves, CELL, 100).tolist() == [[200, 100], [100, 100], [300, 300]]
    absolute = Grid.absolute([0.9, 0.5], [0.5])
    assert (times_below(curves, absolute, 100) == times_below(curves, CELL, 100)).all()
    assert times.epochs_of_runs(np.array(curves, np.float32), CELL).tolist() == [[2, 1], [1, 1], [3, 3]]
    assert doctest.testmod(times).attempted


def test_what_is_lost_after_a_threshold_was_first_reached() -> None:
    two = Grid.relative([0.5, 0.1], [0.5])
    curves = [[0.0, 0.6, 0.4, 0.9, 0.6], [0.6, 0.9, 0.9, 0.9, 0.9], [0.0, 0.0, 0.0, 0.0, 0.0]]
    assert times_lost(curves, two, 10).tolist() == [[10, 10], [0, 0], [0, 0]]
    assert (times_lost(curves, two, 10) <= times_below(curves, two, 10)).all()


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("n_runs", [1, 7, 30])
def test_the_mean_is_the_area_of_the_surface_exactly(index: int, n_runs: int) -> None:
    curves = entry(index).values[:n_runs]
    every = dataclasses.replace(SURFACE, deltas=tuple(Fraction(k, n_runs) for k in range(1, n_runs + 1)))
    area = complexity(curves, every, 2000).sum(axis=1)
    assert (area == times_below(curves, every, 2000).sum(axis=0)).all()


def test_mean_time_by_hand() -> None:
    # T = 100, 300 and 100, 300: M_i = 100, 300; mean 200, standard error 100, t(.975, 1 run) = 12.7
    curves = np.array([[0.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    found = mean_time(LearningCurves(curves, 100), CELL)
    assert found.mean == 200
    assert list(found.interval) == [0, 400], "kept within the horizon"
    assert found.at_cap.tolist() == [0, 0]
    assert found.half == 150, "two epochs: 100 and 200"
    many = mean_time(LearningCurves(np.repeat(curves, 50, axis=0), 100), CELL)
    reach = 1.9842169 * 100 / 99**0.5  # t(.975, 99); the standard deviation of 100 runs is 100 sqrt(100/99)
    assert many.interval == pytest.approx((200 - reach, 200 + reach))


def test_degenerate_entries_have_a_mean_time() -> None:
    never = mean_time(LearningCurves(np.zeros((5, 3)), 10), CELL)
    assert (never.mean, never.interval, never.half) == (30, (30, 30), 10)
    assert never.at_cap.tolist() == [1, 1]
    single = mean_time(LearningCurves(np.zeros((1, 1)), 10), CELL)
    assert (single.mean, single.interval, single.half) == (10, (0, 10), 0)


@pytest.mark.parametrize(
    ("curves", "message"), [([[1.5]], "outside"), ([[np.nan]], "NaN"), ([0.5], "expected shape")]
)
def test_bad_curves_are_named(curves: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        times_below(curves, CELL, 1)


def test_a_level_is_a_probability() -> None:
    with pytest.raises(OptionError, match=r"level = 1 is outside \(0, 1\)"):
        mean_time(entry(0), CELL, 1)
