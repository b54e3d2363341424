"""Several tasks at once: aggregates known by hand, and decided pairs."""

from __future__ import annotations

import doctest
from typing import Any

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean, ttest_1samp
from scipy.stats import t as student

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Grid,
    LearningCurves,
    across,
    across_tasks,
    horizon_shares,
    mean_ratio,
    probability_of_improvement,
    rliable_arrays,
)


def drawn(seed: int, shift: float = 0, runs: int = 30, tasks: int = 3) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.random((runs, tasks)) * [0.1, 0.5, 0.2][:tasks] + shift


def test_shares_of_the_horizon_by_hand() -> None:
    curves = [[0.0, 1.0, 1.0, 1.0], [0.0, 0.6, 0.6, 1.0]]
    # below .9 for 1 and 3 of 4 epochs, below .5 for 1 and 1
    grid = Grid.relative([0.1, 0.5], [0.5])
    assert horizon_shares(LearningCurves(np.array(curves), 100), grid).tolist() == [0.25, 0.5]


def test_probability_of_improvement_by_hand() -> None:
    # 1 < 2, 1 < 3, 2 = 2, 2 < 3: three and a half of four; and one half where all tie
    assert probability_of_improvement([[1, 2]], [[2, 3]]) == 3.5 / 4
    assert probability_of_improvement([[1, 2], [5, 5]], [[2, 3], [5, 5]]) == (3.5 / 4 + 0.5) / 2
    first, second = drawn(0).T, drawn(1).T
    expected = np.mean([mannwhitneyu(b, a).statistic / (len(a) * len(b)) for a, b in zip(first, second)])
    assert probability_of_improvement(list(first), list(second)) == pytest.approx(expected)
    assert probability_of_improvement(first.T, second.T) == pytest.approx(expected)  # as rliable has them


def test_aggregates_are_those_of_rliable() -> None:
    assert doctest.testmod(across).attempted
    scores = {"a": drawn(0), "b": drawn(1, runs=21)}
    found = across_tasks(scores)
    for index, values in enumerate(scores.values()):
        assert found.mean[index] == pytest.approx(values.mean())
        assert found.interquartile_mean[index] == pytest.approx(trim_mean(values, 0.25, axis=None))
        for point, (low, high) in (
            (found.mean[index], found.mean_interval[index]),
            (found.interquartile_mean[index], found.interquartile_interval[index]),
        ):
            assert low < point < high


def test_the_interval_of_the_mean_is_that_of_its_standard_error() -> None:
    values = drawn(3, runs=200)
    low, high = across_tasks({"a": values, "b": values}, n_resamples=4000).mean_interval[0]
    error = np.sqrt((values.var(axis=0) / 200).sum()) / 3
    assert (high - low) / 2 == pytest.approx(1.96 * error, rel=0.06)


def test_pairs_are_decided_over_all_tasks() -> None:
    scores = {"equal": drawn(0), "also": drawn(1), "worse": drawn(2, shift=0.15)}
    found = across_tasks(scores)
    assert found.better.tolist() == [[0, 0, 1], [0, 0, 1], [-1, -1, 0]]
    assert found.order[-1] == 2
    assert found.adjusted[0, 2] == pytest.approx(3 * found.p[0, 2])
    assert np.array_equal(found.p, found.p.T, equal_nan=True)
    assert found.improvement[0, 2] > 0.8
    assert found.improvement[2, 0] == 1 - found.improvement[0, 2]
    turned = across_tasks(dict(reversed(scores.items())))
    assert (turned.better[::-1, ::-1] == found.better).all()
    assert np.array_equal(turned.p[::-1, ::-1], found.p, equal_nan=True)


def test_labels_are_exchanged_within_tasks() -> None:
    """Two runs against two on one task: of six labelings two are as far apart; on two such tasks, 2 of 36."""
    one = across_tasks({"a": [[1, 2]], "b": [[3, 4]]})
    assert one.p[0, 1] == pytest.approx(1 / 3, abs=0.02)
    two = across_tasks({"a": [[1, 2], [1, 2]], "b": [[3, 4], [3, 4]]})
    assert two.p[0, 1] == pytest.approx(2 / 36, abs=0.01)
    same = across_tasks({"a": [[1, 1]], "b": [[1, 1]]})
    assert (same.p[0, 1], same.better[0, 1], same.improvement[0, 1]) == (1, 0, 0.5)


def test_seeds_decide() -> None:
    scores = {"a": drawn(0), "b": drawn(1, shift=0.02)}
    found = [across_tasks(scores, seed=seed) for seed in (1, 1, 2)]
    assert found[0].p[0, 1] == found[1].p[0, 1] != found[2].p[0, 1]
    assert (found[0].mean_interval == found[1].mean_interval).all()
    assert (found[0].mean_interval != found[2].mean_interval).any()


def test_arrays_as_rliable_takes_them() -> None:
    found = rliable_arrays({"a": [[0.1, 0.2, 0.3], [0.4, 0.5]], "b": drawn(0)})
    assert found["a"].tolist() == [[0.1, 0.4], [0.2, 0.5]]
    assert (found["b"] == drawn(0)).all()


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ({"a": drawn(0), "b": drawn(0, tasks=2)}, "same tasks"),
        ({"a": [[1.0]]}, "'a', task 0: expected two runs"),
        ({"a": [[1.0, np.nan]]}, "'a', task 0: a value is not finite"),
        ({"a": np.zeros(3)}, r"'a': expected shape \(runs, tasks\)"),
        ({"a": []}, "'a' has no task"),
    ],
)
def test_bad_scores_are_named(scores: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        across_tasks(scores)


def times_of(seed: int, mean: float, runs: int = 20, spread: float = 0.28) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return mean * np.clip(1 + spread * generator.standard_normal((runs, 1)), 0.05, None)


def test_a_mean_ratio_is_that_of_the_delta_method() -> None:
    pairs = [
        (times_of(1, 1000), times_of(2, 1500, runs=31)),
        (times_of(3, 70), times_of(4, 60)),
        (times_of(5, 9), times_of(6, 9, runs=25)),
    ]
    found = mean_ratio(pairs)
    logs = [np.log(b.mean() / a.mean()) for a, b in pairs]
    parts = [[each.var(ddof=1) / each.mean() ** 2 / len(each) for each in pair] for pair in pairs]
    counts = np.array([[len(each) for each in pair] for pair in pairs])
    error = np.sqrt(np.sum(parts)) / 3
    freedom = np.sum(parts) ** 2 / (np.array(parts) ** 2 / (counts - 1)).sum()
    expected = student.interval(0.95, freedom, np.mean(logs), error)
    assert found.differences == pytest.approx(np.expm1(logs))
    assert found.interval == pytest.approx(np.expm1(expected))
    assert found.p == pytest.approx(2 * student.sf(abs(np.mean(logs)) / error, freedom))
    without = [np.mean(logs[:place] + logs[place + 1 :]) for place in range(3)]
    assert found.left_out == pytest.approx((np.expm1(min(without)), np.expm1(max(without))))
    turned = mean_ratio([(b, a) for a, b in pairs])
    assert turned.p == pytest.approx(found.p)
    assert turned.difference == pytest.approx(1 / (1 + found.difference) - 1)


def test_a_mean_ratio_errs_as_often_as_it_says() -> None:
    """Tasks differ in sign, their mean is 0: about 5 percent of p below .05, 95 percent of intervals around 0."""
    false, covered, times = 0, 0, 1000
    for study in range(times):
        ratios = (1.5, 1 / 1.5, 1.0)
        found = mean_ratio(
            [
                (times_of(7 * study + task, 1000), times_of(100_000 + 7 * study + task, 1000 * ratio))
                for task, ratio in enumerate(ratios)
            ]
        )
        false += found.p <= 0.05
        covered += found.interval[0] <= 0 <= found.interval[1]
    assert covered == times - false
    assert 0.03 < false / times < 0.075


def test_tasks_that_are_drawn_count_as_one_observation_each() -> None:
    """Tasks whose log ratios scatter by .3 around 0: about 5 percent of p below .05, where fixed tasks have many."""
    drawn, fixed, times = 0, 0, 400
    for study in range(times):
        logs = np.random.default_rng(study).normal(0, 0.3, 10)
        found = mean_ratio(
            [
                (
                    times_of(20 * study + task, 1000),
                    times_of(100_000 + 20 * study + task, 1000 * float(np.exp(each))),
                )
                for task, each in enumerate(logs)
            ]
        )
        drawn += found.drawn_p <= 0.05
        fixed += found.p <= 0.05
        low, high = found.drawn_interval
        assert (low <= 0 <= high) == (found.drawn_p > 0.05)
    assert 0.025 < drawn / times < 0.08 < 0.3 < fixed / times
    observed = np.log1p(found.differences)
    assert found.drawn_p == pytest.approx(ttest_1samp(observed, 0).pvalue)
    few = mean_ratio([(times_of(1, 10), times_of(2, 10))] * 7)
    assert np.isnan([few.drawn_p, *few.drawn_interval]).all(), "seven tasks are too few"


def test_a_mean_ratio_needs_tasks_runs_and_times() -> None:
    one = (times_of(0, 10), times_of(1, 10))
    with pytest.raises(OptionError, match="two tasks or more"):
        mean_ratio([one])
    with pytest.raises(OptionError, match="two runs or more"):
        mean_ratio([one, (one[0][:1], one[1])])
    with pytest.raises(OptionError, match="no ratio"):
        mean_ratio([one, (one[0] * 0, one[1])])
    same = np.full((20, 1), 5)
    assert mean_ratio([(same, same), (same, same)]).p == 1
    assert mean_ratio([(same, 2 * same), (same, same)]).p == 0
