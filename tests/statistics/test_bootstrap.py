"""The cluster bootstrap against resamples made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qrlsuite.statistics import Grid, LearningCurves, bootstrap_draws, bootstrap_interval, sample_complexity
from qrlsuite.statistics.bootstrap import weighted_epochs, whole_product
from qrlsuite.statistics.estimator import epochs_below
from tests.statistics.conftest import DELTAS, EPSILONS


def smooth_curves(n_runs: int, n_epochs: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    rise = 1 - np.exp(-np.arange(n_epochs) / generator.uniform(0.1, 0.6, (n_runs, 1)) / n_epochs)
    return np.clip(rise + 0.1 * generator.standard_normal((n_runs, n_epochs)), 0, 1)


# beyond 255 runs a count, and beyond 255 epochs a sum, no longer fits a byte
@pytest.mark.parametrize(
    ("n_runs", "n_epochs"), [(1, 1), (7, 20), (100, 30), (255, 10), (300, 40), (20, 600)]
)
def test_a_draw_is_the_estimate_of_the_runs_drawn(n_runs: int, n_epochs: int) -> None:
    curves = smooth_curves(n_runs, n_epochs)
    grid = Grid.relative([0.1, 0.3, 0.6, 0.95], [0.05, 0.5, 0.7, 1.0])
    generator = np.random.default_rng(1)
    for drawn in sorted({n_runs, 1 + n_runs // 3}):
        weights = generator.multinomial(drawn, np.full(n_runs, 1 / n_runs), size=9).T
        found = weighted_epochs(curves, grid, weights.astype(np.float32), drawn)
        for resample in range(9):
            runs = np.repeat(curves, weights[:, resample], axis=0)
            assert (found[:, :, resample] == epochs_below(runs, grid)).all()


@pytest.mark.parametrize("most", [255, 256])
def test_three_rows_in_one_number_do_not_spill_over(most: int) -> None:
    """Five rows, every count the largest that there can be: 255 fills a byte."""
    weights = np.full((most, 2), 1, dtype=np.float32)
    weights[0, 1], weights[1, 1] = 2, 0
    indicators = np.ones((5, most), dtype=np.float32)
    indicators[1], indicators[3, 0] = 0, 0
    found = whole_product(indicators, weights, most)
    assert found.tolist() == [[most] * 2, [0, 0], [most] * 2, [most - 1, most - 2], [most] * 2]


def test_blocks_of_resamples_are_joined_in_order() -> None:
    curves = smooth_curves(6, 12)
    grid = Grid.relative([0.3], [0.5])
    weights = np.random.default_rng(2).multinomial(6, np.full(6, 1 / 6), size=5000).T.astype(np.float32)
    whole = weighted_epochs(curves, grid, weights, 6)
    parts = [weighted_epochs(curves, grid, weights[:, i : i + 1000], 6) for i in range(0, 5000, 1000)]
    assert (whole == np.concatenate(parts, axis=2)).all()


def test_one_run_and_runs_that_are_all_alike_have_no_spread() -> None:
    for curves, value in (([[0.1, 0.9, 0.5, 0.95]], 20), (np.zeros((5, 4)), 40), (np.ones((5, 4)), 0)):
        interval = bootstrap_interval(curves, Grid.relative([0.1], [0.5]), 10, n_resamples=50)
        assert interval.tolist() == [[[value, value]]]


def test_two_runs_of_which_one_learns_is_a_coin() -> None:
    # delta = 1: S_hat is 0 only where both draws are the good run, a quarter of the resamples
    draws = bootstrap_draws([[1.0], [0.0]], Grid.relative([0.5], [1.0, 0.5]), 1, n_resamples=40_000)
    assert draws.shape == (40_000, 1, 2)
    assert draws[:, 0, 0].mean() == pytest.approx(0.75, abs=0.01)
    assert draws[:, 0, 1].mean() == pytest.approx(0.25, abs=0.01)


def test_fewer_runs_per_resample_are_fewer_runs() -> None:
    # one of four runs learns; a single drawn run is good with probability 1/4, and delta .5 means that run
    draws = bootstrap_draws(np.eye(4)[:, :1], Grid.relative([0.5], [0.5]), 1, n_resamples=40_000, n_runs=1)
    assert draws.mean() == pytest.approx(0.75, abs=0.01)


def test_whole_runs_are_drawn() -> None:
    # two kinds of runs, good at alternating epochs: any resample of one run has exactly half of its epochs
    curves = np.tile([[1.0, 0.0], [0.0, 1.0]], (5, 8))
    draws = bootstrap_draws(curves, Grid.relative([0.5], [1.0]), 1, n_runs=1)
    assert (draws == 8).all()


def test_the_interval_is_widened_to_the_estimate(wide: LearningCurves) -> None:
    arguments = (wide.values, Grid.relative(EPSILONS, DELTAS), wide.steps_per_epoch)
    estimate = sample_complexity(*arguments)
    narrow = bootstrap_interval(*arguments, percentiles=(49.9, 50.1))
    draws = np.percentile(bootstrap_draws(*arguments), [49.9, 50.1], axis=0)
    assert ((draws[0] > estimate) | (draws[1] < estimate)).any(), "the case must need widening"
    assert (narrow[..., 0] == np.minimum(np.round(draws[0], 6), estimate)).all()
    assert (narrow[..., 1] == np.maximum(np.round(draws[1], 6), estimate)).all()


def test_at_fewer_runs_the_interval_is_not_widened_to_the_full_estimate(narrow: LearningCurves) -> None:
    arguments = (narrow.values, Grid.relative(EPSILONS, DELTAS), narrow.steps_per_epoch)
    interval = bootstrap_interval(*arguments, percentiles=(30, 70), n_runs=3)
    draws = bootstrap_draws(*arguments, n_runs=3)
    low, median, high = np.percentile(draws, [30, 50, 70], axis=0)
    assert np.allclose(interval, np.stack([low, high], axis=2), atol=1e-5)
    assert ((interval[..., 0] <= median) & (median <= interval[..., 1])).all()
    estimate = sample_complexity(*arguments)
    assert ((estimate < interval[..., 0]) | (estimate > interval[..., 1])).any()


def test_seeds_decide(wide: LearningCurves) -> None:
    arguments = (wide.values, Grid.relative(EPSILONS, DELTAS), wide.steps_per_epoch)
    first, again, other = (bootstrap_draws(*arguments, n_resamples=100, seed=seed) for seed in (3, 3, 4))
    assert (first == again).all()
    assert (first != other).any()
    intervals = [bootstrap_interval(*arguments, seed=seed) for seed in (3, 3, 4)]
    assert (intervals[0] == intervals[1]).all()
    assert (intervals[0] != intervals[2]).any()


def test_thresholds_give_what_epsilons_give(wide: LearningCurves) -> None:
    thresholds = [round(1 - epsilon, 2) for epsilon in EPSILONS]
    relative = (wide.values, Grid.relative(EPSILONS, DELTAS), 2000)
    absolute = (wide.values, Grid.absolute(thresholds, DELTAS), 2000)
    assert (bootstrap_interval(*relative) == bootstrap_interval(*absolute)).all()
    assert (bootstrap_draws(*relative) == bootstrap_draws(*absolute)).all()
    scaled = (wide.values * 8 - 4, Grid.absolute([8 * value - 4 for value in thresholds], DELTAS), 2000)
    assert (bootstrap_draws(*relative) == bootstrap_draws(*scaled)).all()


@settings(deadline=None, max_examples=50)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 1000), st.integers(1, 60), st.floats(0.1, 50))
def test_intervals_are_ordered_contain_the_estimate_and_stay_in_range(
    n_runs: int, n_epochs: int, seed: int, n_resamples: int, lower: float
) -> None:
    curves = smooth_curves(n_runs, n_epochs, seed)
    arguments = (curves, Grid.relative([0.1, 0.5, 0.9], [0.1, 0.5, 0.9]), 7)
    interval = bootstrap_interval(*arguments, n_resamples, (lower, 100 - lower / 2), seed)
    estimate = sample_complexity(*arguments)
    assert (interval[..., 0] <= estimate).all()
    assert (estimate <= interval[..., 1]).all()
    assert interval.min() >= 0
    assert interval.max() <= 7 * n_epochs
