"""Calibration of rules: what is planned, computed, and said in words."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import calibration
from qrlsuite.leaderboard.calibration import CalibrationResult
from qrlsuite.leaderboard.findings import summary, tables
from qrlsuite.statistics import (
    DecisionPlan,
    Evidence,
    Grid,
    IntervalRule,
    LearningCurves,
    SmoothedRuns,
    TimesRule,
    decision_rates,
    false_winners,
    slower,
)
from tests.statistics.conftest import entry

GRID = Grid.relative([0.3, 0.2], [0.5])


class Always:
    """Declares the first the winner everywhere: wrong by design."""

    name, promise = "always", "nothing"

    def __call__(self, first: Evidence, second: Evidence) -> Any:
        return np.ones(first.grid.shape, dtype=int)


def test_every_part_is_planned_for_every_entry_and_rule() -> None:
    jobs = calibration.plan([entry(0), entry(1)], GRID, [IntervalRule(), TimesRule()], draws=40)
    counts = {part: sum(job.part == part for job in jobs) for part in calibration.PARTS}
    assert counts == {"halves": 4, "pairs": 12, "boards": 4, "power": 12, "decisions": 10}
    assert {job.draws for job in jobs if job.part == "boards"} == {10}


def test_a_rule_that_always_errs_is_found_out() -> None:
    jobs = calibration.plan([entry(0)], GRID, [Always()], 4, numbers=[(20, 20)], board=3)
    found = [job.run() for job in jobs]
    assert {each.part for each in found} == set(calibration.PARTS) - {"decisions"}
    assert all(each.winner == 1 for each in found)
    assert {each.wrong for each in found if each.part == "power"} == {0}
    words = summary(found, "always", 3)
    assert "false winner between two equal entries of 20 seeds in 100.0% of cases" in words
    assert "somewhere on 100.0% of boards of 3 equals" in words


def test_rates_are_those_of_the_statistics_and_ticks_count_draws() -> None:
    ticks: list[int] = []
    (job,) = calibration.plan([entry(1)], GRID, [IntervalRule()], 6, ["pairs"], [(20, 20)])
    found = job.run(lambda: ticks.append(1))
    rates = false_winners(SmoothedRuns(entry(1)), 20, 20, GRID, IntervalRule(), 6)
    assert (found.winner, found.any_cell, found.draws) == (rates.winner, rates.any_cell, 6)
    assert len(ticks) == 6
    assert json.loads(json.dumps(found.as_dict()))["seeds"] == [20, 20]


def test_decision_plans_are_played_where_times_is_measured() -> None:
    jobs = calibration.plan([entry(0)], GRID, [IntervalRule(), TimesRule()], 8, ["decisions"], board=3)
    ticks: list[int] = []
    found = [job.run(lambda: ticks.append(1)) for job in jobs]
    assert [(each.entries, each.factor, each.draws) for each in found] == [
        (2, None, 8),
        (3, None, 2),
        *((2, factor, 8) for factor in calibration.FACTORS),
    ]
    assert len(ticks) == 8 * 4 + 2
    model = SmoothedRuns(entry(0))
    rates = decision_rates([model, model], DecisionPlan(("a", "b")), GRID, 8)
    assert (found[0].winner, found[0].mean_seeds) == (rates.any_difference, rates.mean_runs[0])
    assert found[0].wrong is None
    assert found[-1].winner > 0.8
    assert found[-1].wrong == 0
    assert found[-1].mean_seeds is not None
    assert found[-1].mean_seeds < 100
    [(sentence, rows)] = tables(found, GRID.size, 3)
    assert "at most 100 seeds, 8 or 2 plans each" in sentence
    assert [row[1] for row in rows[1:]] == [
        "2 equals",
        "3 equals",
        "10% slower",
        "25% slower",
        "50% slower",
    ]
    assert "seeds on average, not 100, where an entry takes 50% longer" in summary(found, "times", 3)


def test_the_table_of_decision_plans_holds_each_rate_in_its_column() -> None:
    common = ("decisions", "a", "times", (100, 100), 8)
    plans = [
        CalibrationResult(*common, winner=0.25, entries=3, equal=0.5, mean_seeds=60),
        CalibrationResult(*common, winner=0.75, factor=1.5, wrong=0.125, equal=0.0, mean_seeds=40),
    ]
    [(_, (head, *rows))] = tables(plans, GRID.size, 3)
    assert head == ["entry", "against", "differ", "wrong", "equal", "seeds"]
    assert [[row[1], row[2].split()[0], *row[3:]] for row in rows] == [
        ["3 equals", "25.0", "", "50.0%", "60"],
        ["50% slower", "75.0", "12.5%", "0.0%", "40"],
    ]


def test_tables_state_the_spread_over_entries_and_no_error_of_splits() -> None:
    jobs = calibration.plan([entry(0), entry(1)], GRID, [Always()], 4, ["halves"])
    ((sentence, rows),) = tables([job.run() for job in jobs], GRID.size, 5)
    assert "only the spread over entries" in sentence
    assert rows[-1][0] == "over 2 entries"
    assert all("±" not in cell for row in rows for cell in row)


def test_an_estimate_is_measured() -> None:
    jobs = calibration.plan([entry(0)], GRID, [IntervalRule()], 100, ["pairs"])
    assert calibration.estimate(jobs) > 0
    assert calibration.estimate([]) == 0


def test_slower_runs_get_as_far_later() -> None:
    rising = LearningCurves(np.linspace(0.1, 1, 10)[None], 100, "a")
    late = slower(rising, 2)
    assert late.values[0, 9] == pytest.approx(rising.values[0, 4])
    assert late.values[0, 3] == pytest.approx(rising.values[0, 1])
    assert (slower(rising, 1).values == rising.values).all()
    with pytest.raises(OptionError, match=r"factor = 0\.5"):
        slower(rising, 0.5)
