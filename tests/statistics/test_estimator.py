"""The estimator, first on cases that a person can count."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from qrlsuite.statistics import Grid, at_cap, sample_complexity, unsettled

CURVE, SOME = [[0.1, 0.9, 0.5, 0.95]], [[-500.0, -110.0, -np.inf], [np.inf, -90.0, -110.0]]


@pytest.mark.parametrize(
    ("curves", "grid", "steps", "expected"),
    [
        (CURVE, Grid.relative([0.1], [0.5]), 10, [[20]]),
        ([[0.0, 1.0, 0.0, 0.0, 1.0]], Grid.relative([0.5], [1.0]), 1, [[3]]),  # after the first crossing, too
        ([[0.15]], Grid.relative([0.85], [1.0]), 1, [[0]]),  # touched; 1 - 0.85 is 0.15000000000000002
        ([[np.nextafter(0.15, 0)]], Grid.relative([0.85], [1.0]), 1, [[1]]),
        (np.array([[0.7]], np.float32), Grid.relative([0.3], [1.0]), 1, [[0]]),  # 0.7 in float32 is less than 0.7
        (np.zeros((4, 5)), Grid.relative([0.1, 0.2], [0.5]), 7, [[35], [35]]),
        (np.ones((4, 5)), Grid.relative([0.0], [1.0]), 7, [[0]]),
        (SOME, Grid.absolute([-110, 0], [0.5, 1]), 10, [[0, 20], [20, 30]]),
    ],
)  # fmt: skip
def test_epochs_below_the_threshold_are_counted(
    curves: Any, grid: Grid, steps: int, expected: list[list[int]]
) -> None:
    assert sample_complexity(curves, grid, steps).tolist() == expected


@pytest.mark.parametrize("delta", [0.7, "0.7", Decimal("0.7"), np.float32(0.7), np.arange(0.1, 1, 0.1)[6]])
def test_seventy_of_a_hundred_runs_are_enough_for_delta_seven_tenths(delta: object) -> None:
    curves = np.zeros((100, 2))
    curves[:70, 0] = 1.0
    curves[:69, 1] = 1.0
    assert sample_complexity(curves, Grid.relative([0.1], [delta]), 1000).tolist() == [[1000]]


@pytest.mark.parametrize("delta", [Fraction(k, 20) for k in range(1, 21)])
@pytest.mark.parametrize("n_runs", [1, 3, 20, 30, 100, 1000])
def test_required_counts_are_exact(delta: Fraction, n_runs: int) -> None:
    [needed] = Grid.relative([0.1], [float(delta)]).required_counts(n_runs)
    assert Fraction(int(needed), n_runs) >= delta > Fraction(int(needed) - 1, n_runs)


def test_noise_of_a_computed_grid_does_not_ask_for_one_run_more() -> None:
    noisy = 0.1 + 0.2
    assert noisy > 0.3
    assert Grid.relative([0.1], [noisy]).required_counts(100).tolist() == [30]


def test_unsettled_looks_at_the_last_epoch_only() -> None:
    curves = [[0, 1, 0], [0, 1, 1]]
    assert unsettled(curves, Grid.relative([0.5], [0.5, 0.6])).tolist() == [[False, True]]
    assert unsettled(curves, Grid.absolute([1], [0.5, 0.6])).tolist() == [[False, True]]
    assert unsettled(np.zeros((4, 5)), Grid.relative([0.1, 0.2], [0.5])).tolist() == [[True], [True]]
    assert unsettled(np.ones((4, 5)), Grid.relative([0.0], [1.0])).tolist() == [[False]]


def test_at_cap_looks_at_the_upper_percentile() -> None:
    intervals = [[[10.0, 200.0], [10.0, 199.9], [200.0, 200.0]]]
    assert at_cap(intervals, 200).tolist() == [[True, False, True]]


unit = st.floats(0, 1, width=32)
scores = hnp.arrays(
    np.float64, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12), elements=unit
)
hundredths = st.lists(st.integers(1, 99), min_size=1, max_size=5, unique=True).map(sorted)


@given(scores, hundredths, hundredths, st.integers(1, 3000))
def test_s_hat_is_the_sum_of_the_definition(
    curves: np.ndarray, epsilons: list[int], deltas: list[int], steps: int
) -> None:
    def s_hat(epsilon: int, delta: int) -> int:
        shares = [
            Fraction(int((at >= float(Decimal(100 - epsilon) / 100)).sum()), len(at)) for at in curves.T
        ]
        return steps * sum(share < Fraction(delta, 100) for share in shares)

    expected = [[s_hat(epsilon, delta) for delta in deltas] for epsilon in epsilons]
    found = sample_complexity(
        curves, Grid.relative([e / 100 for e in epsilons], [d / 100 for d in deltas]), steps
    )
    assert found.dtype == np.int64
    assert found.tolist() == expected


@given(scores, hundredths, hundredths)
def test_s_hat_falls_with_epsilon_and_rises_with_delta(
    curves: np.ndarray, epsilons: list[int], deltas: list[int]
) -> None:
    found = sample_complexity(
        curves, Grid.relative([e / 100 for e in epsilons], [d / 100 for d in deltas]), 1
    )
    assert (np.diff(found, axis=0) <= 0).all()
    assert (np.diff(found, axis=1) >= 0).all()


@given(scores, hundredths, hundredths)
def test_s_hat_does_not_depend_on_the_order_of_runs_or_epochs(
    curves: np.ndarray, epsilons: list[int], deltas: list[int]
) -> None:
    grid = (Grid.relative([e / 100 for e in epsilons], [d / 100 for d in deltas]), 1)
    assert (sample_complexity(curves, *grid) == sample_complexity(curves[::-1, ::-1], *grid)).all()
    assert (sample_complexity(curves, *grid) == sample_complexity(np.repeat(curves, 3, axis=0), *grid)).all()
