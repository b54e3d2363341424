"""Against numbers printed by the paper's released code."""

from __future__ import annotations

import numpy as np
import pytest

from qrlsuite.statistics import Grid, bootstrap_draws, sample_complexity
from tests.statistics.conftest import GOLDEN


@pytest.mark.parametrize("case", GOLDEN, ids=lambda case: str(case["name"]))
def test_sample_complexity_is_exactly_the_published_codes(case: dict) -> None:
    found = sample_complexity(
        case["curves"], Grid.relative(case["epsilons"], case["deltas"]), case["steps_per_epoch"]
    )
    assert found.tolist() == case["sample_complexity"]


@pytest.mark.parametrize("case", GOLDEN, ids=lambda case: str(case["name"]))
def test_percentiles_before_widening_agree_within_two_epochs(case: dict) -> None:
    draws = bootstrap_draws(
        case["curves"],
        Grid.relative(case["epsilons"], case["deltas"]),
        case["steps_per_epoch"],
        n_resamples=4000,
    )
    found = np.moveaxis(np.percentile(draws, [5, 95], axis=0), 0, -1)
    expected = np.array(case["bootstrap_p5_p95_unclipped_4000_resamples"])
    distance = np.abs(found - expected) / case["steps_per_epoch"]
    assert distance.max() <= 2
    assert distance.mean() < 0.2, "Monte-Carlo error is rare and of both signs"
