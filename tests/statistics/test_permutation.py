"""Tests that exchange the labels of whole runs."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from benchmarks.simulated import power
from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Evidence,
    Grid,
    LearningCurves,
    MaxT,
    Resampling,
    SmoothedRuns,
    StepsRule,
    TimesRule,
    compare,
)
from qrlsuite.statistics.permutation import CHUNK, ratio_t, relabelings, relabelings_for, smallest, welch_t
from tests.statistics.conftest import SURFACE, entry


def column(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)[:, None]


def relabeled(first: np.ndarray, second: np.ndarray, **options: object) -> MaxT:
    test = MaxT([(first, second)], **options)  # type: ignore[arg-type]
    test.extend(CHUNK)
    return test


def test_two_runs_against_two_by_hand() -> None:
    """Six labelings, of which 1, 2 | 3, 4 and its reverse have the largest difference: p = 1/3."""
    test = relabeled(column(1, 2), column(3, 4))
    assert test.t.tolist() == [[pytest.approx(2 / 0.5**0.5)]], "positive: the first needs less"
    assert test.p[0] == pytest.approx(1 / 3, abs=0.015)
    assert test.n_relabelings.tolist() == [CHUNK]
    assert test.p[0] == (1 + test.reached[0, 0]) / (1 + CHUNK)


@pytest.mark.parametrize("sizes", [(4, 4), (3, 5), (5, 3)])
@pytest.mark.parametrize("scale", [1, 10**7])
def test_p_is_the_share_of_all_labelings(sizes: tuple[int, int], scale: int) -> None:
    """All labelings counted one by one; large numbers take the way of double precision."""
    generator = np.random.default_rng(3)
    pooled = generator.integers(0, 40, size=(sum(sizes), 2)) * scale + generator.integers(0, 2, (8, 1))
    first, second = pooled[: sizes[0]], pooled[sizes[0] :]
    observed = np.abs(welch_t(first, second))
    largest = []
    for chosen in combinations(range(8), sizes[0]):
        rest = np.setdiff1d(np.arange(8), chosen)
        largest.append(np.abs(welch_t(pooled[list(chosen)], pooled[rest])).max())
    expected = (np.array(largest)[:, None] >= observed - 1e-9).mean(axis=0)
    assert relabeled(first, second).p_each[0] == pytest.approx(expected, abs=0.02)


def test_one_relabeling_is_used_for_all_comparisons() -> None:
    """A comparison repeated is no second comparison: p stays what it was."""
    generator = np.random.default_rng(0)
    first, second = generator.integers(0, 50, (10, 1)), generator.integers(10, 60, (10, 1))
    alone = relabeled(first, second)
    repeated = relabeled(np.repeat(first, 3, axis=1), np.repeat(second, 3, axis=1))
    assert repeated.p_each.tolist() == [[alone.p[0]] * 3]
    other = generator.integers(0, 50, (10, 1)), generator.integers(0, 50, (10, 1))
    both = relabeled(np.hstack([first, other[0]]), np.hstack([second, other[1]]))
    assert both.p_each[0, 0] > alone.p[0], "another comparison has its price"


def test_degenerate_pairs() -> None:
    same = relabeled(column(*[5] * 10), column(*[5] * 10))
    assert (same.t[0, 0], same.p[0]) == (0, 1)
    for n_second in (10, 12):
        apart = relabeled(column(*[5] * 10), column(*[9] * n_second))
        assert apart.t[0, 0] == np.inf
        assert apart.p[0] < 0.001
        assert relabeled(column(*[9] * n_second), column(*[5] * 10)).t[0, 0] == -np.inf
    with pytest.raises(OptionError, match="two runs or more"):
        MaxT([(column(1), column(2, 3))])


@pytest.mark.parametrize("n_second", [25, 30])
def test_swapping_a_pair_changes_the_sign_and_nothing_else(n_second: int) -> None:
    generator = np.random.default_rng(1)
    first, second = generator.integers(0, 50, (30, 4)), generator.integers(3, 53, (n_second, 4))
    there, back = relabeled(first, second), relabeled(second, first)
    assert (there.p_each == back.p_each).all()
    assert (there.t == -back.t).all()


def test_pairs_together_are_pairs_alone() -> None:
    generator = np.random.default_rng(2)
    pairs = [(generator.integers(0, 50, (n, 3)), generator.integers(5, 55, (m, 3))) for n, m in
             [(20, 20), (20, 20), (20, 30), (25, 25)]]  # fmt: skip
    together = MaxT(pairs)
    together.extend(CHUNK)
    for index, pair in enumerate(pairs):
        assert (together.p_each[index] == relabeled(*pair).p_each[0]).all()
    before = together.reached.copy()
    together.extend(2 * CHUNK, np.array([1]))
    assert together.n_relabelings.tolist() == [CHUNK, 2 * CHUNK, CHUNK, CHUNK]
    assert (together.reached[[0, 2, 3]] == before[[0, 2, 3]]).all()
    whole = MaxT(pairs[1:2])
    whole.extend(2 * CHUNK)
    assert (whole.reached[0] == together.reached[1]).all(), "to go on is to have begun with more"


def test_labels_are_exchanged_within_blocks() -> None:
    """Two blocks of one run each way: four labelings, two of them as far apart as the observed one."""
    first, second = column(1, 11), column(2, 12)
    assert relabeled(first, second, blocks=((1, 1), (1, 1))).p[0] == pytest.approx(0.5, abs=0.02)
    assert relabeled(first, second).p[0] == pytest.approx(2 / 3, abs=0.02)
    with pytest.raises(OptionError, match="do not add up"):
        MaxT([(first, second)], blocks=((1, 1),))


def test_relabelings_are_uniform_and_seeded() -> None:
    labels = relabelings(3, 5)
    assert labels.shape == (8, CHUNK)
    assert (labels.sum(axis=0) == 3).all()
    assert labels.mean(axis=1) == pytest.approx(np.full(8, 3 / 8), abs=0.02)
    _, counts = np.unique(labels, axis=1, return_counts=True)
    assert len(counts) == 56
    assert ((counts - CHUNK / 56) ** 2 / (CHUNK / 56)).sum() < 100, "chi squared with 55 degrees of freedom"
    others = [relabelings(3, 5, chunk=1), relabelings(3, 5, seed=1), relabelings(3, 5, block=1)]
    assert all((labels != other).any() for other in others)
    relabelings.cache_clear()
    assert (labels == relabelings(3, 5)).all()


def test_equal_keys_do_not_change_the_number_of_labels() -> None:
    keys = np.array([[3, 1, 1, 1], [4, 3, 2, 1]], dtype=np.uint32)
    assert smallest(keys, 2).tolist() == [[False, True, True, False], [False, False, True, True]]


def test_a_level_that_would_take_hours_is_refused() -> None:
    with pytest.raises(
        OptionError, match=r"a level of 1e-07 for each test takes 2e\+08 permutations.*larger alpha"
    ):
        relabelings_for(1e-7)


def test_twenty_over_the_level_and_ten_thousand_or_more() -> None:
    assert [relabelings_for(level) for level in (0.5, 0.05, 0.002, 0.0019)] == [
        CHUNK,
        CHUNK,
        CHUNK,
        2 * CHUNK,
    ]


def test_times_takes_all_runs_of_both() -> None:
    """Runs beyond the smaller number count: here 80 that never learn, behind 20 equal ones."""
    few = SmoothedRuns(entry(0)).draw(20, np.random.default_rng(0))
    many = LearningCurves(np.concatenate([few.values, np.zeros((80, 100))]), 2000, "many")
    won = np.array(compare(few, many, SURFACE, TimesRule()).verdicts) == "win"
    assert won.all()
    assert (np.array(compare(many, few, SURFACE, TimesRule()).verdicts) == "loss").all()


def test_all_deltas_of_a_tolerance_have_its_sign() -> None:
    signs = TimesRule()(*(Evidence(each, SURFACE, 30) for each in (entry(0), entry(1))))
    assert (signs == signs[:, :1]).all()
    assert (signs > 0).all()


@pytest.mark.parametrize("rule", [TimesRule, StepsRule])
def test_alpha_and_seed_decide(rule: type) -> None:
    with pytest.raises(OptionError, match="alpha"):
        rule(0)
    model, generator = SmoothedRuns(entry(0)), np.random.default_rng(5)
    pair = [model.draw(30, generator) for _ in range(2)]
    late = LearningCurves(np.concatenate([np.zeros((30, 4)), pair[1].values[:, :-4]], axis=1), 2000, "late")
    found = [
        np.count_nonzero(rule(alpha)(*(Evidence(each, SURFACE, 30) for each in (pair[0], late))))
        for alpha in (0.9, 0.05, 1e-4)
    ]
    assert found[0] >= found[1] >= found[2]
    assert found[0] > found[2]
    seeded = [
        [Evidence(each, SURFACE, 30, Resampling(10, seed)) for each in (pair[0], late)] for seed in (1, 1)
    ]
    assert (rule()(*seeded[0]) == rule()(*seeded[1])).all()


@pytest.mark.parametrize(("rule", "index"), [(TimesRule(), 0), (StepsRule(), 1)], ids=["times", "steps"])
def test_equal_entries_rarely_differ_and_slow_ones_are_found(rule: TimesRule, index: int) -> None:
    model = SmoothedRuns(entry(index))
    rates = power(model, model, 30, 30, SURFACE, rule, n_pairs=60)
    assert rates.any_cell <= 0.1
    late = LearningCurves(
        np.concatenate([np.zeros((30, 20)), entry(index).values[:, :-20]], axis=1), 2000, "late"
    )
    assert power(model, SmoothedRuns(late), 30, 30, SURFACE, rule, n_pairs=20).first_wins >= 0.8


def test_a_grid_of_one_cell() -> None:
    grid = Grid.relative([0.1], [0.5])
    pair = [Evidence(each, grid, 30) for each in (entry(0), entry(1))]
    assert TimesRule()(*pair).tolist() == [[1]]


def test_the_log_ratio_over_its_error_by_hand() -> None:
    """Means 2 and 4, variances of the means 1 / 2 each: relative ones of 1 / 8 and 1 / 32 add up."""
    first, second = column(1, 3) * 6, column(3, 5) * 6
    # (1, 3): variance 2 over 2 runs is 1, over 2^2 is 1 / 4; (3, 5): 1 over 4^2 is 1 / 16
    expected = np.log(2) / np.sqrt(1 / 4 + 1 / 16)
    assert ratio_t(first, second) == pytest.approx([expected])
    assert ratio_t(second, first) == pytest.approx([-expected])
    assert ratio_t(10**9 * first, 10**9 * second) == pytest.approx([expected]), (
        "squares of sums exceed whole numbers"
    )
    assert ratio_t(column(5, 5), column(5, 5)).tolist() == [0]
    assert ratio_t(column(5, 5), column(9, 9)).tolist() == [np.inf]


@pytest.mark.parametrize("sizes", [(4, 4), (3, 5), (5, 3)])
def test_few_labelings_of_a_ratio_are_all_counted(sizes: tuple[int, int]) -> None:
    generator = np.random.default_rng(0)
    first, second = (generator.integers(1, 9, (size, 2)) ** 2 for size in sizes)
    test = relabeled(first, second, ratio=True)
    pooled, maxima = np.concatenate([first, second]), []
    for chosen in combinations(range(8), sizes[0]):
        mask = np.isin(np.arange(8), chosen)
        maxima.append(np.abs(ratio_t(pooled[mask], pooled[~mask])).max())
    exact = [np.mean(np.array(maxima) >= abs(t) * (1 - 1e-9)) for t in ratio_t(first, second)]
    assert test.n_relabelings.tolist() == [len(maxima)]
    assert test.p_each[0].tolist() == exact
    assert not test.turns(np.full(1, exact[0]), 1e-3).any(), "all labelings leave no error"
    critical = test.critical(exact[0])[0]
    assert [abs(t) > critical for t in test.t[0]] == [p <= exact[0] for p in exact]


def test_shuffled_labelings_of_a_ratio_count_as_fresh_ones() -> None:
    """Chunks after the first shuffle the runs: together, and pair by pair, they count what fresh labels count."""
    generator = np.random.default_rng(1)
    pairs = [(generator.integers(20, 70, (25, 1)), generator.integers(25, 75, (n, 1))) for n in (25, 25, 40)]
    together, fresh = MaxT(pairs, ratio=True), []
    together.extend(10 * CHUNK)
    for index, (first, second) in enumerate(pairs):
        alone = relabeled(first, second, ratio=True)
        alone.extend(10 * CHUNK)
        assert alone.reached[0, 0] == together.reached[index, 0]
        pooled = np.concatenate([first, second])[:, 0]
        orders = generator.permuted(np.tile(pooled, (50_000, 1)), axis=1)
        sides = orders[:, : len(first)].T, orders[:, len(first) :].T
        fresh.append(np.mean(np.abs(ratio_t(*sides)) >= abs(together.t[index, 0]) * (1 - 1e-9)))
    assert together.p == pytest.approx(fresh, abs=0.01)
    swapped = relabeled(*pairs[2][::-1], ratio=True)
    assert swapped.t[0, 0] == -together.t[2, 0]
    swapped.extend(10 * CHUNK)
    assert swapped.p[0] == together.p[2]


def test_whether_more_relabelings_can_turn_a_decision() -> None:
    """Robbins by hand: 10,000 relabelings of which 100 reach leave .01 open, and neither .005 nor .02."""
    generator = np.random.default_rng(2)
    test = relabeled(*(generator.integers(1, 50, (20, 1)) for _ in range(2)), ratio=True)
    test.reached[:] = 100
    assert [bool(test.turns(np.full(1, level), 1e-3)[0]) for level in (0.005, 0.0085, 0.01, 0.012, 0.02)] == [
        False,
        True,
        True,
        True,
        False,
    ]
