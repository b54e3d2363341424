"""What cannot be used is refused, with a message that says what and where."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Evidence,
    Grid,
    IntervalRule,
    LearningCurves,
    Resampling,
    bootstrap_draws,
    bootstrap_interval,
    sample_complexity,
)

GOOD = np.full((4, 3), 0.5)


@pytest.mark.parametrize("function", [sample_complexity, bootstrap_interval, bootstrap_draws])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0.5, np.nan]], [0.1], [0.5], 1), "run 0 is NaN at epoch 1"),
        (([[0.5], [1.01]], [0.1], [0.5], 1), r"run 1 has score 1.01 at epoch 0, outside \[0, 1\]"),
        (([[0.5], [-0.2]], [0.1], [0.5], 1), r"run 1 has score -0.2"),
        (([0.5, 0.6], [0.1], [0.5], 1), r"expected shape \(runs, epochs\), got \(2,\)"),
        (([[0.5], [0.5, 0.6]], [0.1], [0.5], 1), "runs differ in length"),
        ((np.empty((0, 5)), [0.1], [0.5], 1), "no run or no epoch"),
        ((np.empty((5, 0)), [0.1], [0.5], 1), "no run or no epoch"),
        (([["a"]], [0.1], [0.5], 1), "expected numbers"),
        ((GOOD, [], [0.5], 1), "epsilons: the list is empty"),
        ((GOOD, [0.1], [], 1), "deltas: the list is empty"),
        ((GOOD, [1.0], [0.5], 1), r"epsilon = 1.0* is outside \[0, 1\)"),
        ((GOOD, [-0.1], [0.5], 1), r"epsilon = -0.1 is outside"),
        ((GOOD, [np.nan], [0.5], 1), r"epsilons\[0\] = nan is not finite"),
        ((GOOD, ["x"], [0.5], 1), r"epsilons\[0\] = 'x' is not a number"),
        ((GOOD, np.zeros((1, 1)), [0.5], 1), "expected a list of numbers"),
        ((GOOD, [0.1], [0.0], 1), r"delta = 0.0 is outside \(0, 1\]"),
        ((GOOD, [0.1], [1.1], 1), r"delta = 1.1 is outside"),
        ((GOOD, [0.1], [0.5], 0), "steps_per_epoch = 0 is smaller than 1"),
        ((GOOD, [0.1], [0.5], -3), "steps_per_epoch = -3"),
        ((GOOD, [0.1], [0.5], 2000.0), "steps_per_epoch = 2000.0 is not an integer"),
        ((GOOD, [0.1], [0.5], True), "steps_per_epoch = True is not an integer"),
    ],
)
def test_bad_arguments_are_named(
    function: Callable[..., Any], arguments: tuple[Any, ...], message: str
) -> None:
    curves, epsilons, deltas, steps = arguments
    with pytest.raises(OptionError, match=message):
        function(curves, Grid.relative(epsilons, deltas), steps)


def test_the_general_case_refuses_only_what_is_not_a_number() -> None:
    with pytest.raises(OptionError, match="NaN"):
        sample_complexity([[np.nan]], Grid.absolute([1], [0.5]), 1)
    with pytest.raises(OptionError, match=r"thresholds\[1\] = inf is not finite"):
        sample_complexity([[5.0]], Grid.absolute([1, np.inf], [0.5]), 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_resamples": 0}, "n_resamples = 0 is smaller than 1"),
        ({"n_resamples": 1.5}, "n_resamples = 1.5 is not an integer"),
        ({"percentiles": (95, 5)}, "lower < upper"),
        ({"percentiles": (-1, 95)}, "0 <= lower"),
        ({"percentiles": (5, 50, 95)}, "expected a lower and an upper one"),
        ({"seed": -1}, "seed = -1 is smaller than 0"),
        ({"n_runs": 0}, "n_runs = 0 is smaller than 1"),
        ({"n_runs": 5}, "n_runs = 5 exceeds the 4 runs"),
    ],
)
def test_bad_bootstrap_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        bootstrap_interval(GOOD, Grid.relative([0.1], [0.5]), 1, **options)


def test_entries_rules_and_resampling_check_themselves() -> None:
    with pytest.raises(OptionError, match="'net': run 0 is NaN"):
        LearningCurves(np.array([[np.nan]]), 1, "net")
    with pytest.raises(OptionError, match="'net': steps_per_epoch = 0"):
        LearningCurves(GOOD, 0, "net")
    with pytest.raises(OptionError, match="lower < upper"):
        IntervalRule((50, 50))
    with pytest.raises(OptionError, match="n_resamples"):
        Resampling(n_resamples=0)
    with pytest.raises(OptionError, match="'net' has 4 runs, not 5"):
        Evidence(LearningCurves(GOOD, 1, "net"), Grid.relative([0.1], [0.5]), 5)
    with pytest.raises(OptionError, match="'net': run 0 has score 7"):
        Evidence(LearningCurves(np.array([[7.0]]), 1, "net"), Grid.relative([0.1], [0.5]), 1)


def test_a_cut_must_be_whole_and_inside() -> None:
    entry = LearningCurves(GOOD, 10, "net")
    assert entry.cut(20).values.shape == (4, 2)
    assert entry.cut(30) is entry
    with pytest.raises(OptionError, match="25 steps is not a whole number of epochs for 'net'"):
        entry.cut(25)
    with pytest.raises(OptionError, match="'net' ends at 30 steps"):
        entry.cut(40)
