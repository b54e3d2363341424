"""Verdicts and outperformance of one pair."""

from __future__ import annotations

import doctest
import json
from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import rules
from qrlsuite.statistics import (
    MIN_RUNS,
    Evidence,
    Grid,
    IntervalRule,
    LearningCurves,
    Outcome,
    Resampling,
    SignificanceRule,
    StepsRule,
    TimesRule,
    Verdict,
    bootstrap_interval,
    common_horizon,
    compare,
    estimator,
    sample_complexity,
    significance,
)
from tests.statistics.conftest import DELTAS, SURFACE

CELL = Grid.relative([0.1], [0.5])
RULES: list[SignificanceRule] = [IntervalRule(), TimesRule(), StepsRule()]


def learner(
    first_good: int, epochs: int = 10, n_runs: int = 30, steps: int = 100, name: str = "a"
) -> LearningCurves:
    """Runs that all reach the goal at the same epoch and stay there: no spread at all."""
    curves = np.zeros((n_runs, epochs))
    curves[:, first_good:] = 1
    return LearningCurves(curves, steps, name)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [
        (2, 6, Verdict.WIN),
        (6, 2, Verdict.LOSS),
        (4, 4, Verdict.TIE),
        (10, 10, Verdict.BOTH_AT_CAP),
        (2, 10, Verdict.WIN),
    ],
)
def test_verdicts_without_spread(rule: SignificanceRule, first: int, second: int, verdict: Verdict) -> None:
    result = compare(learner(first), learner(second, name="b"), CELL, rule)
    assert result.verdicts == ((verdict,),)
    assert result.names == ("a", "b")
    assert result.points.tolist() == [[[100.0 * first]], [[100.0 * second]]]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_below_twenty_runs_everything_is_undecided(rule: SignificanceRule) -> None:
    few, many = learner(0, n_runs=MIN_RUNS - 1), learner(10, n_runs=MIN_RUNS - 1, name="b")
    assert compare(few, many, CELL, rule).verdicts == ((Verdict.UNDECIDED,),)
    assert compare(few, many, CELL, rule).sentence == "undecided: fewer than 20 seeds"
    enough = compare(learner(0, n_runs=MIN_RUNS), learner(10, n_runs=MIN_RUNS), CELL, rule)
    assert enough.verdicts == ((Verdict.WIN,),)


def evidence(interval: tuple[float, float]) -> Any:
    class Fixed:
        def interval(self, percentiles: tuple[float, float]) -> np.ndarray:
            return np.array([[interval]])

    return Fixed()


@pytest.mark.parametrize(
    ("first", "second", "sign"),
    [((0, 10), (10, 20), 0), ((0, 10), (10.5, 20), 1), ((21, 22), (10, 20), -1), ((5, 6), (0, 20), 0)],
)
def test_touching_intervals_overlap(first: Any, second: Any, sign: int) -> None:
    assert IntervalRule()(evidence(first), evidence(second)).tolist() == [[sign]]


def signs_of(*cells: int) -> SignificanceRule:
    class Fixed:
        name, promise = "fixed", "none"

        def __call__(self, first: Evidence, second: Evidence) -> np.ndarray:
            return np.array([cells])

    return Fixed()


@pytest.mark.parametrize(
    ("cells", "outcome", "sentence"),
    [
        (
            (1, 0, 1),
            Outcome.OUTPERFORMS,
            "outperforms: significantly fewer samples in 2 of 3 cells, significantly more in none",
        ),
        (
            (0, 0, -1),
            Outcome.OUTPERFORMED,
            "is outperformed: significantly more samples in 1 of 3 cells, significantly fewer in none",
        ),
        (
            (1, -1, -1),
            Outcome.TRADE_OFF,
            "trade-off: significantly fewer samples in 1 of 3 cells, significantly more in 2",
        ),
        ((0, 0, 0), Outcome.NO_DIFFERENCE, "no significant difference: in none of 3 cells"),
    ],
)
def test_outcomes_in_words(cells: tuple[int, ...], outcome: Outcome, sentence: str) -> None:
    grid = Grid.relative([0.1], [0.3, 0.5, 0.7])
    result = compare(learner(3), learner(3), grid, signs_of(*cells))
    assert result.outcome is outcome
    assert result.sentence == sentence
    assert result.count(Verdict.WIN) == cells.count(1)


@pytest.mark.parametrize(("first", "second"), [(10, 4), (4, 10)])
def test_one_entry_at_the_cap_is_a_tie_where_nothing_is_significant(first: int, second: int) -> None:
    assert compare(learner(first), learner(second), CELL, signs_of(0)).verdicts == ((Verdict.TIE,),)


def test_a_comparison_is_plain_values_for_json(wide: LearningCurves, narrow: LearningCurves) -> None:
    content = json.loads(json.dumps(compare(wide, narrow, SURFACE).as_dict()))
    assert content["deltas"] == DELTAS
    assert content["verdicts"][0][0] == "win"
    assert content["outcome"] == "outperforms"


def test_golden_wide_outperforms_narrow(wide: LearningCurves, narrow: LearningCurves) -> None:
    result = compare(wide, narrow, SURFACE)
    assert result.outcome is Outcome.OUTPERFORMS
    for side, entry in enumerate((wide, narrow)):
        arguments = (entry.values, SURFACE, entry.steps_per_epoch)
        assert (result.points[side] == sample_complexity(*arguments)).all()
        assert (result.intervals[side] == bootstrap_interval(*arguments)).all()
    won = np.array(result.verdicts) == Verdict.WIN
    assert (won == (result.intervals[0, ..., 1] < result.intervals[1, ..., 0])).all()


def test_the_larger_entry_is_judged_by_draws_of_the_smaller_number(
    wide: LearningCurves, narrow: LearningCurves
) -> None:
    small = LearningCurves(narrow.values[:22], 2000, "small")
    result = compare(wide, small, SURFACE)
    assert result.n_runs == 22
    expected = bootstrap_interval(wide.values, SURFACE, 2000, n_runs=22)
    assert (result.intervals[0] == expected).all()
    assert (result.intervals[1] == bootstrap_interval(small.values, SURFACE, 2000)).all()
    assert (result.points[1] == sample_complexity(small.values, SURFACE, 2000)).all()


def test_pairs_are_cut_to_the_shorter_horizon() -> None:
    short, long = learner(4, epochs=5, name="short"), learner(8, epochs=20, name="long")
    result = compare(short, long, CELL)
    assert result.horizon == 500
    assert result.points.ravel().tolist() == [400, 500]
    assert compare(short, long, CELL, horizon=300).points.ravel().tolist() == [300, 300]
    assert compare(short, long, CELL, horizon=300).verdicts == ((Verdict.BOTH_AT_CAP,),)


def test_a_horizon_that_is_not_whole_epochs_of_both_is_refused() -> None:
    fine, coarse = learner(2, epochs=9, steps=50, name="fine"), learner(2, steps=100, name="coarse")
    with pytest.raises(
        OptionError, match=r"'fine' and 'coarse' cannot be compared at 450 steps.*for 'coarse'"
    ):
        compare(fine, coarse, CELL)
    assert common_horizon(fine, coarse, 400) == 400
    assert compare(fine, coarse, CELL, horizon=400).points.ravel().tolist() == [100, 200]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
@pytest.mark.parametrize("n_resamples", [400, 401])
def test_swapping_the_entries_swaps_the_verdicts(
    rule: SignificanceRule, n_resamples: int, wide: LearningCurves, narrow: LearningCurves
) -> None:
    # closer together than the originals, so that the answer hangs on the draws
    mixed = LearningCurves(np.concatenate([narrow.values[:18], wide.values[:12]]), 2000, "mixed")
    pair = [Evidence(entry, SURFACE, 30, Resampling(n_resamples)) for entry in (mixed, narrow)]
    signs = rule(*pair)
    assert 0 < np.count_nonzero(signs) < signs.size + (rule.name == "steps")
    assert (signs == -rule(*pair[::-1])).all()


@pytest.mark.parametrize("answer", [np.zeros(3), np.full((1, 1), 2), np.full((1, 1), np.nan)])
def test_a_rule_that_answers_nonsense_is_named(answer: np.ndarray) -> None:
    class Broken:
        name, promise = "broken", "none"

        def __call__(self, first: Evidence, second: Evidence) -> np.ndarray:
            return answer

    with pytest.raises(
        OptionError, match=r"rule 'broken' must answer -1, 0 or 1 in an array of shape \(1, 1\)"
    ):
        compare(learner(1), learner(2), CELL, Broken())


def test_seeds_decide(wide: LearningCurves, narrow: LearningCurves) -> None:
    results = [compare(wide, narrow, SURFACE, resampling=Resampling(100, seed)) for seed in (1, 1, 2)]
    assert (results[0].intervals == results[1].intervals).all()
    assert (results[0].intervals != results[2].intervals).any()


def test_the_suites_own_rules_are_not_fenced() -> None:
    assert [type(rules.load(rule.name)) for rule in RULES] == [type(rule) for rule in RULES]


@pytest.mark.parametrize("module", [significance, estimator])
def test_docstring_examples_run(module: Any) -> None:
    result = doctest.testmod(module)
    assert result.attempted
    assert not result.failed
