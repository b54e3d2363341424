"""Several tasks at once: aggregates known by hand, and decided pairs."""

from __future__ import annotations

import doctest
from typing import Any

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Grid,
    LearningCurves,
    across,
    across_tasks,
    horizon_shares,
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
