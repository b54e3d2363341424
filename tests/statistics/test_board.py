"""A board says of every pair what the comparison of that pair says."""

from __future__ import annotations

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Evidence,
    Grid,
    IntervalRule,
    LearningCurves,
    Outcome,
    Resampling,
    SignificanceRule,
    TimesRule,
    Verdict,
    compare,
    outperformance,
)
from tests.statistics.conftest import SURFACE, entry

FEW = Resampling(200)


class Faster:
    """A rule as a plugin would write it: one pair at a time."""

    name, promise = "faster", "none"

    def __call__(self, first: Evidence, second: Evidence) -> np.ndarray:
        return np.sign(second.point - first.point).astype(np.int8)


def mixed_board() -> list[LearningCurves]:
    wide, narrow = entry(0).values, entry(1).values
    return [
        LearningCurves(wide, 2000, "wide"),
        LearningCurves(narrow, 2000, "narrow"),
        LearningCurves(wide[:24], 2000, "wide, fewer runs"),
        LearningCurves(narrow[:, :60], 2000, "narrow, shorter"),
        LearningCurves(wide[:10], 2000, "too few"),
        LearningCurves(narrow[:22, ::2], 4000, "narrow, coarser"),
    ]


@pytest.mark.parametrize("rule", [IntervalRule(), TimesRule(), Faster()], ids=lambda rule: rule.name)
@pytest.mark.parametrize("horizon", [None, 80_000])
def test_a_board_is_all_its_comparisons(rule: SignificanceRule, horizon: int | None) -> None:
    entries = mixed_board()
    board = outperformance(entries, SURFACE, rule, FEW, horizon)
    for i, first in enumerate(entries):
        for j, second in enumerate(entries):
            if i == j:
                continue
            result = compare(first, second, SURFACE, rule, FEW, horizon)
            assert board.decided[i, j] == (result.outcome is not Outcome.UNDECIDED)
            assert board.better_cells[i, j] == result.count(Verdict.WIN)
            assert board.outperforms[i, j] == (result.outcome is Outcome.OUTPERFORMS)


def test_a_board_ranks() -> None:
    ranking = outperformance(mixed_board(), SURFACE, resampling=FEW).ranking
    assert {entry.name for entry in ranking.tiers[0]} == {"wide", "wide, fewer runs"}
    assert [entry.name for entry in ranking.undecided] == ["too few"]


def test_a_pair_that_cannot_be_cut_is_named() -> None:
    entries = [*mixed_board(), LearningCurves(entry(0).values, 1500, "odd")]
    with pytest.raises(OptionError, match="'narrow, coarser' and 'odd' cannot be compared at 150000 steps"):
        outperformance(entries, SURFACE, resampling=FEW)


def test_undecided_pairs_cannot_be_cut_wrongly() -> None:
    odd = LearningCurves(entry(0).values[:5, :31], 1500, "odd")
    board = outperformance([*mixed_board(), odd], SURFACE, resampling=FEW)
    assert not board.decided[-1].any()


def test_a_rule_may_be_cyclic_and_the_board_still_ranks() -> None:
    # three entries, three thresholds: each needs few samples at one threshold, and many at another
    grid = Grid.relative([0.9, 0.5, 0.1], [0.5])

    class Rotating:
        name, promise = "rotating", "none"
        order = "abc"

        def __call__(self, first: Evidence, second: Evidence) -> np.ndarray:
            lead = (self.order.index(second.entry.name) - self.order.index(first.entry.name)) % 3
            return np.full((3, 1), {0: 0, 1: 1, 2: -1}[lead])

    board = outperformance([LearningCurves(entry(0).values, 2000, name) for name in "abc"], grid, Rotating())
    assert [len(tier) for tier in board.ranking.tiers] == [3]
    assert board.ranking.entries[0].cycle == ("a", "b", "c")


def test_three_entries_in_a_circle_collapse_into_one_tier_under_the_papers_rule() -> None:
    # At each of three thresholds one is fast, the next slow, and of the third half the runs are fast, half slow:
    # its interval overlaps both. So a beats b, b beats c, c beats a, each at one threshold only.
    pace = {"fast": np.full(30, 2), "slow": np.full(30, 18), "either": np.repeat([2, 18], 15)}

    def runs(name: str, *paces: str) -> LearningCurves:
        curves = np.zeros((30, 60))
        for part, (score, word) in enumerate(zip((0.1, 0.5, 0.9), paces)):
            for run, delay in enumerate(pace[word]):
                curves[run, 20 * part + delay :] = score
        return LearningCurves(curves, 100, name)

    a = runs("a", "fast", "either", "slow")
    b = runs("b", "slow", "fast", "either")
    c = runs("c", "either", "slow", "fast")
    behind = LearningCurves(np.zeros((30, 60)), 100, "behind")
    board = outperformance([a, b, c, behind], Grid.relative([0.9, 0.5, 0.1], [0.5]))
    assert board.outperforms[:3, :3].tolist() == [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    assert [[entry.name for entry in tier] for tier in board.ranking.tiers] == [["a", "b", "c"]]
    assert [entry.name for entry in board.ranking.not_reached] == ["behind"]
    assert board.ranking.entries[0].cycle == ("a", "b", "c")
