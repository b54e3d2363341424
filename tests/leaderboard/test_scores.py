"""Entries by final score and by area: the other way round where the fast one ends lower."""

from __future__ import annotations

import json

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.boards.scores import rank_by_score
from qrlsuite.leaderboard.shelf.curves import EntryResults
from tests.leaderboard.test_pair import entry, spread


def both() -> list[EntryResults]:
    return [entry("fast", spread(10), 0.7), entry("slow", spread(60), 0.9), entry("few", spread(10, 19))]


def test_score_and_area_may_order_differently() -> None:
    score, area = (rank_by_score(both(), 200_000, by) for by in ("score", "area"))
    first, second = score.sheet().cells
    assert first == ("1", "slow", "30", "0.900 (0.900 to 0.900)", "0.900 (0.900 to 0.900)", "-", "1.00")
    assert second[:3] + second[5:] == ("2", "fast", "30", "0.200 (0.200 to 0.200)", "-")
    assert [row[:2] for row in area.sheet().cells] == [("1", "fast"), ("2", "slow")]
    # .1 for 10 + 2 epochs, then .7 for 88; .1 for 62, then .9 for 38
    assert area.results.mean == pytest.approx([0.1 * 0.12 + 0.7 * 0.88, 0.1 * 0.62 + 0.9 * 0.38])
    assert score.n_last == 10
    assert "final score: mean over the last tenth of the epochs (10)" in score.notes()[0]
    assert "fewer than 20 seeds: few" in score.notes()
    assert "(1 of 1: permutation test, Holm" in score.notes()[1]


def test_equals_share_a_range_of_ranks() -> None:
    noise = np.random.default_rng(0)
    made = [entry(name, spread(10)) for name in "abc"]
    for each in made:
        each.curves[:, -10:] = noise.normal(0.8, 0.05, (30, 10))
    ranking = rank_by_score(made, 200_000)
    assert {row[0] for row in ranking.sheet().cells} == {"1-3"}
    assert json.loads(json.dumps(ranking.as_dict()))["better"] == [[0, 0, 0]] * 3


def test_bad_input_is_one_error() -> None:
    with pytest.raises(OptionError, match="--by median: expected score or area"):
        rank_by_score(both(), 200_000, "median")
    with pytest.raises(OptionError, match="no entry has 20 seeds"):
        rank_by_score(both()[2:], 200_000)
    with pytest.raises(OptionError, match="not a whole number of epochs"):
        rank_by_score(both(), 2_001)
