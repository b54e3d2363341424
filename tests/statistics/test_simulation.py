"""Rates of false winners, at fixed seeds: the numbers are the same on every machine."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.simulated import board_false_winners, judge, power, simulated_pairs, split_halves
from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Evidence,
    Grid,
    IntervalRule,
    LearningCurves,
    Resampling,
    SmoothedRuns,
    TimesRule,
)
from tests.statistics.conftest import SURFACE, entry

FAST = Resampling(300)


@pytest.mark.parametrize(("index", "n_first", "n_second"), [(0, 10, 40), (1, 50, 25)])
def test_unequal_numbers_of_one_network_rarely_make_a_winner(index: int, n_first: int, n_second: int) -> None:
    model = SmoothedRuns(entry(index))
    rates = power(model, model, n_first, n_second, SURFACE, n_pairs=100, resampling=FAST)
    assert rates.winner <= 0.12
    assert rates.per_cell.max() <= 0.05


def test_equal_numbers_of_one_network_rarely_make_a_winner_in_a_cell() -> None:
    rates = power(
        SmoothedRuns(entry(1)), SmoothedRuns(entry(1)), 30, 30, SURFACE, n_pairs=100, resampling=FAST
    )
    assert rates.per_cell.max() <= 0.06
    assert rates.any_cell >= rates.per_cell.max() > 0
    assert rates.any_cell >= rates.winner
    assert rates.n_runs == (30, 30)


def test_a_real_difference_is_found() -> None:
    wide, narrow = SmoothedRuns(entry(0)), SmoothedRuns(entry(1))
    for rule in (IntervalRule(), TimesRule()):
        rates = power(wide, narrow, 30, 30, SURFACE, rule, n_pairs=20, resampling=FAST)
        assert rates.first_wins > 0.9
        assert rates.fewer.max() > 0.9
        assert rates.second_wins == 0
        assert not rates.more.any()


def test_rules_judge_the_same_pairs() -> None:
    model, rules = SmoothedRuns(entry(1)), [IntervalRule(), TimesRule()]
    together = judge(simulated_pairs(model, model, 20, 20, 12), SURFACE, rules, FAST)
    for rule, rates in zip(rules, together):
        alone = power(model, model, 20, 20, SURFACE, rule, n_pairs=12, resampling=FAST)
        assert (rates.fewer == alone.fewer).all()
        assert (rates.rule, rates.winner) == (rule.name, alone.winner)


def test_halves_of_one_entry() -> None:
    for index in (0, 1):
        rates = split_halves(entry(index), SURFACE, n_splits=60, resampling=FAST)
        assert rates.n_runs == (15, 15)
        assert rates.winner < 0.3
        assert rates.per_cell.max() < 0.15


def test_halves_share_no_run() -> None:
    # runs 0..3 are good from epoch 0..3 on; with delta = 1 a half's S_hat is its latest run
    curves = np.triu(np.ones((4, 4)))
    seen = set()

    class Watch:
        name, promise = "watch", "none"

        def __call__(self, first: Evidence, second: Evidence) -> np.ndarray:
            halves = [{int(v) for v in e.entry.values.argmax(axis=1)} for e in (first, second)]
            assert halves[0] | halves[1] == {0, 1, 2, 3}
            seen.add(frozenset(halves[0]))
            return np.zeros((1, 1))

    split_halves(LearningCurves(curves, 1), Grid.relative([0.5], [1]), Watch(), n_splits=100)
    assert len(seen) == 6


def test_a_board_of_equals_errs_at_least_as_often_as_a_pair() -> None:
    model = SmoothedRuns(entry(1))
    pair = board_false_winners(model, [25] * 2, SURFACE, n_boards=30, resampling=FAST)
    board = board_false_winners(model, [25] * 8, SURFACE, n_boards=30, resampling=FAST)
    assert pair < board
    assert board_false_winners(model, [19] * 4, SURFACE, n_boards=3, resampling=FAST) == 0


def test_smoothed_runs_keep_mean_and_covariance_where_nothing_is_clipped() -> None:
    source = entry(0)
    draws = SmoothedRuns(source, jitter=0.5, bounds=None).draw(20_000, np.random.default_rng(0)).values
    assert np.abs(draws.mean(axis=0) - source.values.mean(axis=0)).max() < 0.01
    difference = np.cov(draws.T) - np.cov(source.values.T, bias=True)
    assert np.abs(difference).max() < 0.1 * np.cov(source.values.T).max()
    assert len(np.unique(draws[:, 50])) == 20_000


def test_without_jitter_runs_are_repeated_and_with_bounds_clipped() -> None:
    source = entry(0)
    plain = SmoothedRuns(source, jitter=0).draw(50, np.random.default_rng(0)).values
    distance = np.abs(plain[:, None] - source.values[None]).max(axis=2).min(axis=1)
    assert distance.max() < 1e-12
    jittered = SmoothedRuns(source, jitter=1).draw(500, np.random.default_rng(0)).values
    assert jittered.min() >= 0
    assert jittered.max() == 1


def test_seeds_decide() -> None:
    model = SmoothedRuns(entry(1))
    draws = [model.draw(5, np.random.default_rng(seed)).values for seed in (1, 1, 2)]
    assert (draws[0] == draws[1]).all()
    assert (draws[0] != draws[2]).any()
    cells = Grid.relative([0.2, 0.4], [0.3, 0.5])
    rates = [power(model, model, 8, 8, cells, n_pairs=40, seed=seed, resampling=FAST) for seed in (1, 1, 2)]
    assert (rates[0].per_cell == rates[1].per_cell).all()
    assert (rates[0].per_cell != rates[2].per_cell).any()
    halves = [split_halves(entry(1), cells, n_splits=40, seed=seed, resampling=FAST) for seed in (1, 1, 2)]
    assert (halves[0].per_cell == halves[1].per_cell).all()
    assert (halves[0].per_cell != halves[2].per_cell).any()


def test_what_cannot_be_simulated_is_refused() -> None:
    single = LearningCurves(np.ones((1, 3)), 1, "single")
    with pytest.raises(OptionError, match="'single' has a single run"):
        SmoothedRuns(single)
    with pytest.raises(OptionError, match="'single' has a single run"):
        split_halves(single, SURFACE)
    with pytest.raises(OptionError, match="'x' has infinite values"):
        SmoothedRuns(LearningCurves(np.array([[np.inf], [0.0]]), 1, "x"))
    with pytest.raises(OptionError, match="jitter = -1"):
        SmoothedRuns(entry(0), jitter=-1)
    with pytest.raises(OptionError, match="bounds"):
        SmoothedRuns(entry(0), bounds=(1, 0))
    short = LearningCurves(entry(1).values[:, :50], 2000, "short")
    with pytest.raises(OptionError, match="'width64' ends at 200000 steps, 'short' at 100000"):
        power(SmoothedRuns(entry(0)), SmoothedRuns(short), 20, 20, SURFACE)
    with pytest.raises(OptionError, match="n_pairs"):
        power(SmoothedRuns(entry(0)), SmoothedRuns(entry(0)), 20, 20, SURFACE, n_pairs=0)
