"""As many seeds as it takes: levels, decisions, and what stays as it was."""

from __future__ import annotations

import dataclasses
import doctest
import math
import sys
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Decided,
    Grid,
    LearningCurves,
    MaxT,
    PairDecision,
    SequentialDesign,
    SmoothedRuns,
    Spending,
    decide,
    nominal_levels,
    slower,
    times_below,
)
from qrlsuite.statistics.permutation import CHUNK
from tests.statistics.conftest import SURFACE, entry

CELL = Grid.relative([0.1], [0.5])
LOOKS = (20, 40, 60, 80, 100)


def learner(name: str, *first_good: int, n_runs: int, epochs: int = 40) -> LearningCurves:
    starts = np.resize(first_good, n_runs)
    return LearningCurves((np.arange(epochs) >= starts[:, None]).astype(float), 100, name)


def design(*entries: str, **options: Any) -> SequentialDesign:
    return SequentialDesign(entries or ("a", "b"), **options)


def test_a_single_look_has_all_of_alpha() -> None:
    for spending in Spending:
        assert nominal_levels((20,), 0.05, spending) == pytest.approx((0.05,))
        assert nominal_levels((20,), 0.05, spending, 1) == pytest.approx((0.05,))


def test_levels_are_those_of_the_literature() -> None:
    """Five looks at .05 on two sides: the bounds on |Z| that Lan and DeMets's program prints."""
    assert doctest.testmod(sys.modules[decide.__module__]).attempted
    bounds = {
        Spending.POCOCK: (2.4380, 2.4268, 2.4101, 2.3966, 2.3859),
        Spending.OBRIEN_FLEMING: (4.8769, 3.3569, 2.6803, 2.2898, 2.0310),
    }
    for spending, expected in bounds.items():
        found = -ndtri(np.array(nominal_levels(LOOKS, 0.05, spending)) / 2)
        assert found == pytest.approx(expected, abs=2e-4)
    first = nominal_levels(LOOKS, 0.05, Spending.POCOCK)[0]
    assert first == pytest.approx(0.05 * math.log1p((math.e - 1) / 5)), "it spends its increment, and no more"


def test_levels_spend_alpha_in_a_simulation() -> None:
    """The share of random walks that any look stops is alpha, for each function, on one side and on two."""
    generator = np.random.default_rng(0)
    walks = generator.standard_normal((200_000, 5)).cumsum(axis=1) / np.sqrt(np.arange(1, 6))
    for spending in Spending:
        two = (2 * ndtr(-np.abs(walks)) <= nominal_levels(LOOKS, 0.05, spending)).any(axis=1).mean()
        one = (ndtr(-walks) <= nominal_levels(LOOKS, 0.05, spending, 1)).any(axis=1).mean()
        assert two == pytest.approx(0.05, abs=0.0015)
        assert one == pytest.approx(0.05, abs=0.0015)
    early = nominal_levels(LOOKS, 0.05, Spending.OBRIEN_FLEMING)
    assert early[0] < 1e-4 < early[1] < early[2] < early[3] < early[4] < 0.05


def test_a_clear_pair_is_decided_at_the_first_look() -> None:
    runs = {"a": learner("a", 4, 6, n_runs=20), "b": learner("b", 20, 22, n_runs=20)}
    decision = decide(design(), runs, CELL)
    [pair] = decision.pairs
    assert decision.finished
    assert (pair.decided, pair.n_runs, pair.verdict) == (Decided.FIRST, 20, "a needs fewer")
    assert pair.difference == pytest.approx(3.2), "21 epochs are 320 percent more than 5"
    assert list(pair.p) == pytest.approx([1 / (CHUNK + 1)])
    assert list(pair.levels) == pytest.approx([0.01477], abs=1e-5)
    assert decide(design("b", "a"), runs, CELL).pairs[0].verdict == "a needs fewer"
    assert decide(design("b", "a"), runs, CELL).pairs[0].decided is Decided.SECOND


def test_equal_entries_are_found_equal_once_that_is_allowed() -> None:
    runs = {name: learner(name, 20, 22, n_runs=100) for name in "ab"}
    [pair] = decide(design(), runs, CELL).pairs
    assert (pair.verdict, pair.n_runs) == ("equal within 10 percent", 40)
    [late] = decide(design(equal_from=60), runs, CELL).pairs
    assert late.n_runs == 60
    [never] = decide(design(equal_from=101), runs, CELL).pairs
    assert never.decided is Decided.NOT_TOLD_APART
    # log ratio 0, standard error sqrt(2 / 100) s / m with m = 21 epochs, s = 1.005; level .0169 on both sides
    assert never.interval[1] == pytest.approx(math.expm1(2.41 * math.sqrt(0.02) * 1.005 / 21), rel=0.01)
    assert never.verdict == "not told apart by 100 seeds: no difference above 2 percent"


def test_few_percent_fewer_is_both() -> None:
    starts = {"a": (99, 101), "b": (102, 104)}
    runs = {name: learner(name, *each, n_runs=100, epochs=200) for name, each in starts.items()}
    [pair] = decide(design(looks=(40, 100)), runs, CELL).pairs
    assert pair.verdict == "a needs fewer, by under 10 percent"


def test_a_look_waits_for_the_runs_of_open_pairs_only() -> None:
    model = SmoothedRuns(entry(0))
    base = model.draw(40, np.random.default_rng(4)).values
    late = np.concatenate([np.zeros((40, 60)), base[:, :-60]], axis=1)
    runs = {name: LearningCurves(values, 2000, name) for name, values in
            {"a": base, "b": base[::-1], "late": late}.items()}  # fmt: skip
    three = design("a", "b", "late")
    nothing = decide(three, {}, SURFACE)
    assert nothing.wanted == {"a": 20, "b": 20, "late": 20}
    assert [pair.verdict for pair in nothing.pairs] == ["open"] * 3
    twenty = {name: LearningCurves(each.values[:20], 2000) for name, each in runs.items()}
    first = decide(three, twenty, SURFACE)
    assert [pair.decided for pair in first.pairs] == [None, Decided.FIRST, Decided.FIRST]
    assert first.wanted == {"a": 40, "b": 40}, "the late one is done"
    assert not first.finished
    # it goes on without runs of the late one, and what was decided stays as it was
    second = decide(three, {**runs, "late": LearningCurves(late[:20], 2000)}, SURFACE)
    assert second.pairs[1:] == first.pairs[1:]
    assert len(second.pairs[0].p) == 2
    assert second == decide(three, runs, SURFACE), "runs of a closed entry are not looked at"


def test_levels_are_divided_and_grow_with_each_rejection() -> None:
    """Of three pairs two are clear: the third is then tested at all of alpha."""
    model = SmoothedRuns(entry(0))
    draws = [model.draw(20, np.random.default_rng(seed)).values for seed in (0, 1)]
    late = np.concatenate([np.zeros((20, 60)), draws[0][:, :-60]], axis=1)
    runs = {name: LearningCurves(values, 2000) for name, values in zip("abc", (*draws, late))}
    pairs = decide(design("a", "b", "c"), runs, SURFACE).pairs
    assert [pair.levels[0] for pair in pairs] == [pytest.approx(0.01477, abs=1e-5)] * 3
    same = {name: LearningCurves(draws[0], 2000) for name in "abc"}
    undivided = decide(design("a", "b", "c"), same, SURFACE).pairs
    third = nominal_levels(LOOKS, 0.05 / 3, Spending.POCOCK)[0]
    assert [pair.levels[0] for pair in undivided] == [third] * 3


def test_a_pair_found_equal_keeps_its_share_of_alpha() -> None:
    starts = {"a": (20, 22), "b": (20, 22), "c": range(5, 38)}
    runs = {name: learner(name, *each, n_runs=60) for name, each in starts.items()}
    pairs = decide(design("a", "b", "c", looks=(40, 60)), runs, CELL).pairs
    assert pairs[0].decided is Decided.EQUAL
    assert pairs[1].levels[1] == nominal_levels((40, 60), 0.05 / 3, Spending.POCOCK)[1]


def test_labels_are_nested_across_looks() -> None:
    """What a later look adds does not change how the runs of an earlier one are relabeled."""
    generator = np.random.default_rng(0)
    first, second = generator.integers(0, 50, (20, 1)), generator.integers(8, 58, (20, 1))
    constant = np.zeros((20, 1), dtype=np.int64)
    early = MaxT([(first, second)], ((20, 20),))
    later = MaxT([tuple(np.concatenate([each, constant]) for each in (first, second))], ((20, 20), (20, 20)))  # type: ignore[list-item]
    for test in (early, later):
        test.extend(CHUNK)
    # a block in which nothing varies adds nothing to any difference: the same relabelings are at least as large
    assert (later.reached == early.reached).all()
    after = np.concatenate([constant, first]), np.concatenate([constant, second])
    other = MaxT([after], ((20, 20), (20, 20)))
    other.extend(CHUNK)
    assert (other.reached != early.reached).all(), "as the second block they are relabeled otherwise"


def test_a_decision_relabels_within_the_blocks_of_its_looks() -> None:
    model, generator = SmoothedRuns(entry(0)), np.random.default_rng(8)
    runs = {name: model.draw(40, generator) for name in "ab"}
    [pair] = decide(design(alpha=1e-4), runs, SURFACE).pairs
    times = [times_below(runs[name].values, SURFACE, 2000) for name in "ab"]
    for look, expected in enumerate(pair.p):
        n_runs = LOOKS[look]
        test = MaxT([(times[0][:n_runs], times[1][:n_runs])], ((20, 20),) * (look + 1))
        test.extend(int(test.n_relabelings[0]) + 200_000)
        assert test.p[0] == expected


def test_a_look_by_rule_steps_relabels_one_number_until_nothing_can_turn() -> None:
    """Within blocks, of the mean over thresholds with half an epoch; its interval leaves out 0 with its p."""
    model, generator = SmoothedRuns(entry(0)), np.random.default_rng(8)
    runs = {name: model.draw(40, generator) for name in "ab"}
    slow = {**runs, "b": SmoothedRuns(entry(1)).draw(40, generator)}
    pairs = [decide(design(rule="steps"), each, SURFACE).pairs[0] for each in (runs, slow)]
    times = [times_below(runs[name].values, SURFACE, 2000) for name in "ab"]
    for look, p in enumerate(pairs[0].p):
        numbers = [(2 * each[: LOOKS[look]] + 2000).sum(axis=1, keepdims=True) for each in times]
        test = MaxT([tuple(numbers)], ((20, 20),) * (look + 1), ratio=True)  # type: ignore[list-item]
        test.extend(CHUNK)
        assert test.p[0] == p
    assert [pair.differs for pair in pairs] == [False, True]
    for pair in pairs:
        assert (pair.interval[0] < 0 < pair.interval[1]) != pair.differs


def test_sentences_of_all_kinds() -> None:
    pair = PairDecision("x", "y", n_runs=100, interval=(-0.04, 0.12))
    verdicts = {
        None: "open",
        Decided.FIRST: "x needs fewer",
        Decided.SECOND: "y needs fewer",
        Decided.TRADE_OFF: "trade-off",
        Decided.EQUAL: "equal within 10 percent",
        Decided.NOT_TOLD_APART: "not told apart by 100 seeds: no difference above 12 percent",
    }
    for decided, verdict in verdicts.items():
        assert dataclasses.replace(pair, decided=decided).verdict == verdict


def test_degenerate_pairs_are_closed() -> None:
    capped = {name: learner(name, 40, n_runs=100) for name in "ab"}
    assert decide(design(), capped, CELL).pairs[0].verdict == "equal within 10 percent"
    at_once = {name: learner(name, 0, n_runs=100) for name in "ab"}
    [pair] = decide(design(), at_once, CELL).pairs
    assert pair.verdict == "not told apart by 100 seeds", "0 of 0 is no ratio"
    assert math.isnan(pair.difference)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"entries": ("a",)}, "a study needs two or more"),
        ({"entries": ("a", "a")}, "the name 'a' is repeated"),
        ({"looks": (40, 20)}, r"looks = \[40, 20\]: each must be at more runs"),
        ({"looks": ()}, "looks"),
        ({"looks": (10, 20)}, "the first is below 20 runs.*give a reason"),
        ({"alpha": 0.0}, r"alpha = 0.0 is outside \(0, 1\)"),
        ({"alpha": 1.0}, "alpha"),
        ({"spending": "pockock"}, "spending = 'pockock': expected 'pocock' or 'obrien-fleming'"),
        ({"margin": 0.0}, "margin = 0.0 is not a positive number"),
        ({"pairs": (("a", "z"),)}, "'z' is not one of the entries"),
        ({"pairs": (("a", "a"),)}, "'a' is compared with itself"),
        ({"pairs": (("a", "b"), ("b", "a"))}, "a pair is repeated"),
        ({"pairs": ()}, "a pair is repeated, or there is none"),
    ],
)
def test_bad_plans_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        SequentialDesign(**{"entries": ("a", "b"), **options})


def test_a_reason_allows_an_early_look_and_a_name_of_a_function_is_enough() -> None:
    assert design(looks=(10, 20), reason="a pilot").looks == (10, 20)
    assert design(spending="obrien-fleming").spending is Spending.OBRIEN_FLEMING


def test_bad_runs_are_named() -> None:
    with pytest.raises(OptionError, match="'z' is not one of the design's entries"):
        decide(design(), {"z": learner("z", 3, n_runs=20)}, CELL)
    with pytest.raises(OptionError, match="different horizons"):
        decide(design(), {"a": learner("a", 3, n_runs=20), "b": learner("b", 3, n_runs=20, epochs=50)}, CELL)


def test_equals_are_rarely_told_apart_and_slow_ones_are_found_early() -> None:
    model, generator = SmoothedRuns(entry(0)), np.random.default_rng(0)
    worse = SmoothedRuns(slower(entry(0), 1.5))
    found, seeds = 0, []
    for _ in range(30):
        draws = [each.draw(100, generator) for each in (model, model, worse)]
        [pair] = decide(design(), dict(zip("ab", draws[:2])), SURFACE).pairs
        found += pair.decided in (Decided.FIRST, Decided.SECOND, Decided.TRADE_OFF)
        [pair] = decide(design(), dict(zip("ab", draws[1:])), SURFACE).pairs
        seeds.append(pair.n_runs)
        assert pair.decided is Decided.FIRST
    assert found <= 5
    assert np.mean(seeds) < 40
