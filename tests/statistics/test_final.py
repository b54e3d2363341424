"""Scores at the end and over all of training, and one pair by its times: answers known by hand."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
from scipy.stats import ttest_ind

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Direction,
    Grid,
    LearningCurves,
    areas,
    compare_scores,
    final,
    final_scores,
    last_epochs,
    times_board,
    times_pair,
)


def test_the_last_tenth_counts_rounded_up() -> None:
    assert doctest.testmod(final).attempted
    assert [last_epochs(n) for n in (1, 9, 10, 20, 21, 100)] == [1, 1, 1, 2, 3, 10]


def test_final_scores_and_areas_by_hand() -> None:
    rising = np.arange(20) / 20
    entry = LearningCurves(np.stack([rising, np.full(20, 0.5)]), 1000)
    assert final_scores(entry) == pytest.approx([(0.9 + 0.95) / 2, 0.5])
    assert areas(entry) == pytest.approx([9.5 / 20, 0.5])


def test_more_is_better() -> None:
    low, high = np.linspace(0, 1, 40), np.linspace(0, 1, 40) + 0.5
    found = compare_scores({"low": low, "high": high})
    assert found.order == (1, 0)
    assert found.mean == pytest.approx([0.5, 1.0])
    assert found.interquartile_mean == pytest.approx([0.5, 1.0])
    assert (found.mean_interval[:, 0] < found.mean).all()
    assert (found.mean < found.mean_interval[:, 1]).all()
    assert (found.interquartile_interval[:, 0] < found.interquartile_interval[:, 1]).all()
    assert found.better.tolist() == [[0, -1], [1, 0]]
    assert found.difference[1, 0] == pytest.approx(0.5)
    welch = ttest_ind(high, low, equal_var=False).confidence_interval(0.95)
    assert found.difference_interval[1, 0] == pytest.approx([welch.low, welch.high])
    assert found.difference_interval[0, 1] == pytest.approx([-welch.high, -welch.low])


def test_improvement_and_holm_by_hand() -> None:
    # 3 > 1, 3 > 2, 1 = 1, 1 < 2: two and a half of four
    assert compare_scores({"a": [3, 1], "b": [1, 2]}).improvement[0, 1] == 2.5 / 4
    equal = np.linspace(0, 1, 30)
    found = compare_scores({"a": equal, "b": equal, "c": equal + 2})
    assert found.p[0, 1] == 1
    assert found.p[0, 2] < 1e-3
    assert found.adjusted[0, 2] == pytest.approx(3 * found.p[0, 2])
    assert found.better.tolist() == [[0, 0, -1], [0, 0, -1], [1, 1, 0]]


def test_scores_that_do_not_vary_have_no_width() -> None:
    found = compare_scores({"a": [0.5, 0.5], "b": [0.25, 0.25, 0.25]})
    assert found.difference_interval[0, 1].tolist() == [0.25, 0.25]


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ({}, "needs an entry"),
        ({"a": [1.0]}, "'a', task 0: expected two runs"),
        ({"a": [1, np.nan]}, "not finite"),
    ],
)
def test_bad_scores_are_refused(scores: dict[str, list[float]], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        compare_scores(scores)


def curves(reached_at: np.ndarray, name: str) -> LearningCurves:
    """Runs of 50 epochs of 1000 steps, at .9 from an epoch on."""
    return LearningCurves(np.where(np.arange(50) >= reached_at[:, None], 0.9, 0.2), 1000, name)


def test_a_pair_is_judged_as_by_a_board_of_two() -> None:
    generator = np.random.default_rng(0)
    grid = Grid.relative([0.2, 0.5, 0.05], [0.5])
    for shift, expected in ((12, Direction.FEWER), (-12, Direction.MORE), (0, Direction.NOT_TOLD_APART)):
        first = curves(generator.integers(13, 30, 30), "a")
        second = curves(generator.integers(13, 30, 40) + shift, "b")
        pair, board = times_pair(first, second, grid), times_board([first, second], grid)
        assert pair.direction is board.directions[0][1] is expected
        assert pair.p == board.p[0, 1]
        assert pair.difference[0] == pytest.approx(board.difference[0, 1])
        assert pair.difference[1:] == pytest.approx(board.difference_interval[0, 1])
        assert pair.at_cap.tolist() == [[0, 0, 1], [0, 0, 1]]
        assert pair.differences[2].tolist() == [0, 0, 0]
        assert (pair.failed, board.failed) == ((0, 0), (0, 0))
        assert pair.spreads == board.spreads


def test_each_threshold_has_its_own_difference() -> None:
    pair = times_pair(curves(np.full(20, 10), "a"), curves(np.full(20, 20), "b"), Grid.relative([0.2], [0.5]))
    assert pair.means.tolist() == [[10_000], [20_000]]
    assert pair.differences == pytest.approx(np.full((1, 3), 10.5 / 20.5 - 1))
    assert pair.difference == pytest.approx(np.full(3, 10.5 / 20.5 - 1))
    assert pair.p_each[0] < 1e-3
