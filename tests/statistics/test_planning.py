"""How many runs it takes: by simulation, at fixed seeds."""

from __future__ import annotations

import doctest
import itertools
import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from benchmarks.simulated import judge, simulated_pairs
from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Decided,
    LearningCurves,
    SequentialDesign,
    SmoothedRuns,
    StepsRule,
    decision_rates,
    planning,
    runs_needed,
    runs_to_detect,
    slower,
    times_below,
)
from qrlsuite.statistics.permutation import with_half_epoch
from qrlsuite.statistics.planning import chances
from qrlsuite.statistics.sequential import Decision, PairDecision
from qrlsuite.statistics.simulation import judge_steps, play
from tests.statistics.conftest import SURFACE, entry

PILOT = SmoothedRuns(entry(0))


def test_steps_judged_together_are_judged_as_by_the_rule() -> None:
    pairs = list(simulated_pairs(PILOT, SmoothedRuns(slower(entry(0), 1.2)), 20, 20, 30))
    ours, theirs = (
        np.stack(
            [
                with_half_epoch(times_below(pair[side].values, SURFACE, 2000), 2000).sum(
                    axis=1, keepdims=True
                )
                for pair in pairs
            ]
        )
        for side in (0, 1)
    )
    together = judge_steps(ours, theirs)
    [alone] = judge(pairs, SURFACE, [StepsRule()])
    assert 0 < together.first < 1
    assert (together.first, together.second) == (alone.first_wins, alone.second_wins)
    assert together.found == pytest.approx(alone.any_cell)


def test_larger_differences_need_fewer_runs_and_more_power_needs_more() -> None:
    [ten, more] = runs_to_detect(PILOT, SURFACE, 0.25, n_pairs=60, most=200)
    [fifty] = runs_to_detect(PILOT, SURFACE, 0.5, powers=(0.8,), n_pairs=60, most=200)
    assert ten.fixed is not None
    assert more.fixed is not None
    assert fifty.fixed is not None
    assert fifty.fixed <= ten.fixed <= more.fixed
    assert ten.looks[-1] >= ten.fixed
    assert 20 <= ten.mean_runs <= ten.looks[-1]
    assert runs_to_detect(PILOT, SURFACE, 0.25, n_pairs=60, most=200) == (ten, more), "seeded"


def test_what_cannot_be_had_is_said() -> None:
    [need] = runs_to_detect(PILOT, SURFACE, 0.01, powers=(0.9,), n_pairs=20, most=25)
    assert (need.fixed, need.looks) == (None, ())
    assert math.isnan(need.mean_runs)


def test_even_looks() -> None:
    assert doctest.testmod(planning).attempted
    assert planning.even_looks(20) == (20,)
    assert planning.even_looks(45) == (20, 27, 36, 45)


def test_a_plan_played_many_times() -> None:
    design = SequentialDesign(("a", "b"), looks=(20, 40))
    rates = decision_rates([PILOT, PILOT], design, SURFACE, n_studies=40)
    assert sum(rates.verdicts[0].values()) == pytest.approx(1)
    assert rates.any_difference <= 0.15
    assert 20 <= rates.mean_runs[0] <= 40
    apart = decision_rates([PILOT, SmoothedRuns(entry(1))], design, SURFACE, n_studies=10)
    assert apart.verdicts[0][Decided.FIRST] == 1
    assert apart.mean_runs == (20,)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(OptionError, match="3 models for the 2 entries"):
        decision_rates([PILOT] * 3, SequentialDesign(("a", "b")), SURFACE)
    short = SmoothedRuns(LearningCurves(entry(1).values[:, :50], 2000, "short"))
    with pytest.raises(OptionError, match="cut them to one horizon"):
        runs_needed(PILOT, short, SURFACE)
    with pytest.raises(OptionError, match="power = 1 is outside"):
        runs_needed(PILOT, PILOT, SURFACE, powers=(1,))
    with pytest.raises(OptionError, match="most = 10"):
        runs_needed(PILOT, PILOT, SURFACE, most=10)


def test_runs_that_the_present_difference_needs() -> None:
    """A ratio of z / sqrt(2) standard errors at 20 runs is z standard errors at 40: found there in half of cases."""
    design = SequentialDesign(("a", "b"))
    now, following = (NormalDist().inv_cdf(1 - design.level(look, 1) / 2) for look in (0, 1))
    ratio = 0.1 * following / math.sqrt(2)
    interval = (math.expm1(ratio - 0.1 * now), math.expm1(ratio + 0.1 * now))
    pair = PairDecision("a", "b", None, 20, (0.1,), (0.0147,), math.expm1(ratio), interval)
    decision = Decision(design, (pair,), {"a": 40, "b": 40})
    assert abs((planning.runs_at_difference(decision, pair, power=0.5) or 0) - 40) <= 1
    assert (planning.runs_at_difference(decision, pair) or 0) > 60, "more power needs more"
    assert planning.runs_at_difference(decision, replace(pair, p=())) is None
    assert planning.runs_at_difference(decision, replace(pair, difference=0.0)) is None


def test_chances_are_those_of_played_studies() -> None:
    """Of pairs that differ by 10 percent, some are told apart, some are equal within the margin, and some stay open."""
    design = SequentialDesign(("a", "b"), (20, 40, 60), margin=0.2, rule="steps")
    generator = np.random.default_rng(3)
    means = (9000, 10_000)
    drawn = [np.rint(generator.normal(each, 0.2 * each, (400, 60, 1))).astype(np.int64) for each in means]
    played = play(design, drawn).verdicts[0]
    found = chances(design, 0.2, 0.1)
    assert 0.2 < played[Decided.EQUAL] < 0.6
    assert found[-1] == pytest.approx(played[Decided.FIRST], abs=0.08)
    assert found[0] < found[1] < found[2]
    without = chances(replace(design, margin=0.001), 0.2, 0.1)
    assert without[-1] > found[-1] + 0.1, "a pair that is equal within the margin is told apart no more"


def test_chances_of_a_leader_are_those_of_all_its_pairs() -> None:
    two, three = (
        chances(SequentialDesign(names, (60,), rule="steps"), 0.2, 0.1)
        for names in (("a", "b"), ("a", "b", "c"))
    )
    assert 0.5 * two[0] < three[0] < two[0] - 0.05
    others = tuple(itertools.combinations("bcd", 2))
    design = SequentialDesign(tuple("abcd"), (60,), pairs=(("a", "b"), *others), rule="steps")
    assert three[0] < chances(design, 0.2, 0.1)[0] < two[0] - 0.05, (
        "the level of a pair beside three that are equal"
    )
    with pytest.raises(OptionError, match="lead"):
        chances(SequentialDesign(("a", "b"), (60,)), 0.2, 1.0)
