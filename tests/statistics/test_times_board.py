"""A board by mean times: what is decided among all pairs, and which ranks remain."""

from __future__ import annotations

import doctest
import sys

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Direction,
    Grid,
    LearningCurves,
    MaxT,
    SmoothedRuns,
    holm,
    rank_ranges,
    times_board,
)
from qrlsuite.statistics.permutation import CHUNK
from qrlsuite.statistics.steps import holm_levels, settle
from qrlsuite.statistics.times_board import log_ratios
from tests.statistics.conftest import SURFACE, entry

CELL = Grid.relative([0.1, 0.5], [0.5])


def learner(
    name: str, *first_good: int, n_runs: int = 30, epochs: int = 10, steps: int = 100
) -> LearningCurves:
    """Runs that reach the goal at given epochs, in turn, and stay there."""
    starts = np.resize(first_good, n_runs)
    return LearningCurves((np.arange(epochs) >= starts[:, None]).astype(float), steps, name)


def test_holm_by_hand() -> None:
    # .01 x 3, .03 x 2 and .04 x 1, never falling
    assert holm([0.01, 0.04, 0.03]).tolist() == [0.03, 0.06, 0.06]
    assert holm([0.5, 0.6]).tolist() == [1, 1]
    assert holm([]).size == 0
    assert doctest.testmod(sys.modules[times_board.__module__]).attempted


def test_rank_ranges_by_hand() -> None:
    # a before c, b before c; nothing known about a and b
    better = np.zeros((3, 3), bool)
    better[0, 2] = better[1, 2] = True
    assert rank_ranges(better).tolist() == [[1, 2], [1, 2], [3, 3]]
    assert rank_ranges(np.zeros((3, 3), bool)).tolist() == [[1, 3]] * 3
    assert rank_ranges(np.zeros((3, 3), bool), [True, False, True]).tolist() == [[1, 2], [0, 0], [1, 2]]


def test_a_board_by_hand() -> None:
    """Nothing varies: times of 200, 400 and 400 steps; the first is before both others, which are equal."""
    board = times_board([learner("c", 4), learner("a", 2), learner("b", 4)], CELL)
    assert [board.names[index] for index in board.order] == ["a", "b", "c"]
    assert [mean.mean for mean in board.means] == [400, 200, 400]
    assert board.directions[1] == (Direction.FEWER, Direction.UNDECIDED, Direction.FEWER)
    assert board.directions[0] == (Direction.UNDECIDED, Direction.MORE, Direction.NOT_TOLD_APART)
    assert board.ranks.tolist() == [[2, 3], [1, 1], [2, 3]]
    assert board.difference[1].tolist() == pytest.approx([-4 / 9, 0, -4 / 9]), "250 to 450 with half an epoch"
    assert board.difference_interval[0, 1].tolist() == pytest.approx([0.8, 0.8]), "450 is 80 percent over 250"
    assert board.p[0, 2] == board.adjusted[0, 2] == 1
    assert board.p[0, 1] == pytest.approx(1e-4, abs=1e-4)
    assert np.isnan(board.p.diagonal()).all()
    assert board.outperforms.tolist() == [[False] * 3, [True, False, True], [False] * 3]
    assert board.order_at_half == board.order
    assert not board.few.any()


def test_the_difference_and_its_interval_by_hand() -> None:
    # means 2 and 4, standard deviations 1 of two runs each: parts (1/2)/4 and (1/2)/16
    times = [np.array([[1], [3]]) * 100, np.array([[3], [5]]) * 100]
    ratio, error, freedom = log_ratios(times)
    assert ratio[1, 0] == pytest.approx(np.log(2))
    assert error[1, 0] ** 2 == pytest.approx(2 / 2 / 4 + 2 / 2 / 16)
    assert freedom[1, 0] == pytest.approx((1 / 4 + 1 / 16) ** 2 / (1 / 16 + 1 / 256))


def test_each_p_is_tested_at_the_level_of_its_step() -> None:
    """Of four, .001 meets alpha / 4 and .012 alpha / 3; .03 misses alpha / 2, where the procedure ends."""
    assert holm_levels(np.array([0.03, 0.001, 0.5, 0.012]), 0.05).tolist() == [0.025, 0.0125, 0.025, 0.05 / 3]
    assert holm_levels(np.array([0.01, 0.02]), 0.05).tolist() == [0.025, 0.05], "all are rejected"
    assert holm_levels(np.array([]), 0.05).size == 0


def test_intervals_of_a_board_leave_out_zero_where_a_pair_is_decided() -> None:
    generator = np.random.default_rng(3)
    starts = [generator.integers(low, low + 12, 30) for low in (2, 4, 5, 9)]
    board = times_board([learner(str(k), *each, epochs=30) for k, each in enumerate(starts)], CELL)
    directions = [board.directions[i][j] for i in range(4) for j in range(i)]
    assert {*directions} == {Direction.MORE, Direction.NOT_TOLD_APART}
    for i in range(4):
        for j in range(i):
            low, high = board.difference_interval[i, j]
            assert (low > 0) == (board.directions[i][j] is Direction.MORE)
            assert low < board.difference[i, j] < high
            assert 1 / (1 + board.difference_interval[j, i]) - 1 == pytest.approx([high, low])


def test_degenerate_boards() -> None:
    capped = times_board([learner("a", 10), learner("b", 10)], CELL)
    assert capped.directions[0][1] is Direction.NOT_TOLD_APART
    assert capped.means[0].at_cap.tolist() == [1, 1]
    assert capped.difference[0, 1] == 0
    at_once = times_board([learner("a", 0), learner("b", 4)], CELL)
    assert at_once.directions[0][1] is Direction.FEWER
    assert at_once.difference[1, 0] == pytest.approx(8), (
        "450 over the half epoch of one that is there at once"
    )
    alone = times_board([learner("a", 3)], CELL)
    assert alone.ranks.tolist() == [[1, 1]]
    few = times_board([learner("a", 3), learner("b", 8), learner("few", 1, n_runs=19)], CELL)
    assert few.directions[2] == (Direction.UNDECIDED,) * 3
    assert few.ranks.tolist() == [[1, 1], [2, 2], [0, 0]]
    assert [few.names[index] for index in few.order] == ["a", "b", "few"]
    assert few.adjusted[0, 1] == few.p[0, 1], "an entry that stands apart is no part of the family"


def test_unequal_numbers_are_marked_where_the_smaller_is_below_fifty() -> None:
    counts = (20, 50, 100)
    board = times_board([learner(str(n), 3, 5, n_runs=n) for n in counts], CELL)
    assert board.few.tolist() == [[False, True, True], [True, False, False], [True, False, False]]


def test_bad_boards_are_named() -> None:
    with pytest.raises(OptionError, match="two entries are called 'a'"):
        times_board([learner("a", 3), learner("a", 4)], CELL)
    with pytest.raises(OptionError, match="'a' ends at 1000 steps, 'b' at 900: give a horizon"):
        times_board([learner("a", 3), learner("b", 4, epochs=9)], CELL)
    assert times_board([learner("a", 3), learner("b", 4, epochs=9)], CELL, horizon=900).horizon == 900
    with pytest.raises(OptionError, match="alpha = 1 is outside"):
        times_board([learner("a", 3)], CELL, alpha=1)
    with pytest.raises(OptionError, match="a board needs an entry"):
        times_board([], CELL)


def test_only_pairs_near_their_level_are_relabeled_further() -> None:
    generator = np.random.default_rng(0)
    base = generator.integers(50, 100, (20, 30, 1))
    pairs = [(each, generator.integers(50, 100, (30, 1))) for each in base[:18]]
    pairs += [(base[18], base[18] + 100), (base[19], generator.integers(60, 114, (30, 1)))]
    test = MaxT(pairs, ratio=True)
    assert not settle(test, 0.05).any()
    assert (test.n_relabelings[:18] == CHUNK).all()
    assert CHUNK < test.n_relabelings.max() < 10_000_000
    again = MaxT(pairs, ratio=True)
    settle(again, 0.05)
    assert (test.reached == again.reached).all()
    stopped = MaxT(pairs, ratio=True)
    settle(stopped, 0.05, seconds=0)
    assert (stopped.n_relabelings == CHUNK).all()


def test_a_pair_behind_one_that_holm_keeps_is_not_relabeled_further() -> None:
    """Of p .04 and .05, Holm keeps the first at .025, so that the second's level of .05 decides nothing."""
    generator = np.random.default_rng(4)
    pairs = [tuple(generator.integers(50, 100, (2, 20, 1))) for _ in range(300)]
    test = MaxT(pairs, ratio=True)  # type: ignore[arg-type]
    test.extend(CHUNK)
    kept, near = (int(np.abs(test.p - p).argmin()) for p in (0.04, 0.05))
    assert test.p[[kept, near]] == pytest.approx([0.04, 0.05], abs=0.005)
    alone, both = (MaxT([pairs[k] for k in chosen], ratio=True) for chosen in ([near], [kept, near]))  # type: ignore[misc]
    settle(alone, 0.05)
    settle(both, 0.05)
    assert alone.n_relabelings[0] > CHUNK
    assert both.n_relabelings.tolist() == [CHUNK, CHUNK]


def test_equals_are_rarely_told_apart_and_seeds_decide() -> None:
    model, generator = SmoothedRuns(entry(0)), np.random.default_rng(1)
    found = 0
    for _ in range(20):
        entries = [LearningCurves(model.draw(30, generator).values, 2000, str(k)) for k in range(4)]
        board = times_board(entries, SURFACE)
        found += any(Direction.FEWER in row for row in board.directions)
    assert found <= 4
    seeded = [times_board(entries, SURFACE, seed=seed).p for seed in (0, 0, 1)]
    assert np.array_equal(seeded[0], seeded[1], equal_nan=True)
    assert not np.array_equal(seeded[0], seeded[2], equal_nan=True)


def test_a_pair_behind_one_that_holm_keeps_is_relabeled_while_it_may_come_first() -> None:
    """Ten thousand relabelings put the second behind the first, which Holm keeps at .025; more put it below .025."""

    class Scripted(MaxT):
        def extend(self, n_relabelings: int, which: np.ndarray | None = None) -> None:
            chosen = np.arange(2) if which is None else which
            p = np.array([0.0275, 0.0285 if n_relabelings == CHUNK else 0.02])
            self.n_relabelings[chosen] = n_relabelings
            self.reached[chosen, 0] = np.rint(p * n_relabelings)[chosen]

    generator = np.random.default_rng(5)
    test = Scripted([tuple(generator.integers(50, 100, (2, 20, 1))) for _ in range(2)], ratio=True)  # type: ignore[misc]
    assert not settle(test, 0.05).any()
    assert test.p == pytest.approx([0.0275, 0.02])
