"""Boards by cost: who is first by hand, what is not ranked and why, and every way to write them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.boards import board, costs
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.records import Provenance
from tests.commands import say
from tests.leaderboard import boards

STEPS = 2000
"""Environment steps of an epoch."""
ALPHA, BETA = Provenance(processor="Alpha"), Provenance(processor="Beta")
SHOTS = {"model_options": {"shots": 100}}


def learner(
    label: str, epochs_below: int, per_step: float, seeds: int = 20, epochs: int = 100, **facts: Any
) -> EntryResults:
    """An entry whose runs score 0, and 1 from an epoch on (every second one an epoch later); each step has a cost."""
    entry = boards.entry(label, seeds, epochs, quantum=144)
    curves = np.ones((seeds, epochs))
    for run in range(seeds):
        curves[run, : epochs_below + run % 2] = 0
    executions = per_step * STEPS * epochs
    known = {"clocked": False, "provenance": [ALPHA], "executions": executions, "seconds": executions}
    return boards.changed(entry, curves=curves, **{**known, **facts})


def section(*entries: EntryResults, by: str = "executions") -> costs.CostSection:
    (found,) = board.build(entries, by=by).sections
    return found


def labels(found: costs.CostSection) -> list[str]:
    return [row.entry.label for row in found.rows]


def test_the_cheaper_step_can_outweigh_the_fewer_steps() -> None:
    few, cheap = learner("few steps", 20, 20), learner("cheap steps", 30, 10)
    found = section(few, cheap)
    assert found.budget == 100 * STEPS * 10, "what the cheaper one spent in all"
    assert labels(found) == ["cheap steps", "few steps"]
    first, second = found.rows
    assert found.mean(first).mean * found.part == pytest.approx(30.5 * STEPS * 10, abs=found.part)
    assert found.mean(second).mean * found.part == pytest.approx(20.5 * STEPS * 20, abs=found.part)
    assert [found.rank_text(row) for row in found.rows] == ["1", "2"]
    cells = found.sheet().cells
    assert cells[0][3:5] == ("10", "620k (620k to 620k)"), "31 epochs: half of them need 30"
    assert [row[-2:] for row in cells] == [("few steps", "-"), ("-", "cheap steps")]
    (by_steps,) = boards.of([few, cheap]).sections
    assert [row.entry.label for row in by_steps.times.rows] == ["few steps", "cheap steps"]


def test_cheap_steps_do_not_make_an_entry_first_that_never_learns() -> None:
    never, learns = learner("never", 100, 1), learner("learns", 20, 10)
    found = section(never, learns)
    assert found.budget == 100 * STEPS, "10 of 100 epochs of the one that learns"
    assert [found.mean(row).at_cap.mean() for row in found.rows] == [1, 1]
    assert [found.rank_text(row) for row in found.rows] == ["1-2", "1-2"]
    (of_never,) = (row for row in found.sheet().cells if row[1] == "never")
    assert of_never[4] == ">= 200k (200k to 200k, at cap)"


def test_equal_prices_are_compared_at_whole_epochs() -> None:
    found = section(learner("a", 20, 7), learner("b", 30, 7))
    assert found.exact
    assert found.part == pytest.approx(7 * STEPS)
    assert [found.mean(row).mean for row in found.rows] == [20.5, 30.5]
    assert not any("parts" in line for line in found.notes())


@pytest.mark.parametrize(
    ("change", "by", "problem"),
    [
        ({"executions": 0, "parameters": {"classical": 9}}, "executions", "executes no circuits"),
        ({"executions": 0}, "executions", "in its record: its model counts none, or"),
        ({}, "shots", "exact values, without shots"),
        ({"seconds": 0}, "core-hours", "no times in its record"),
        ({"clocked": None}, "core-hours", "does not say whether its hours are processor time"),
        ({"clocked": True}, "core-hours", "hours by the clock"),
        ({"provenance": [ALPHA, BETA]}, "core-hours", "made on Alpha, Beta"),
        ({"provenance": []}, "core-hours", "its processor is not recorded"),
        ({"provenance": [BETA]}, "core-hours", "made on Beta, the others on Alpha"),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_has_no_rank_and_a_reason(
    change: dict[str, Any], by: str, problem: str
) -> None:
    others = [learner("one", 20, 2, identity=SHOTS), learner("two", 30, 2, identity=SHOTS)]
    found = section(learner("odd", 1, 0.1, **change), *others, by=by)
    assert labels(found) == ["one", "two", "odd"], "not first, whatever it would cost"
    assert [found.rank_text(row) for row in found.rows] == ["1", "2", "-"]
    assert problem in found.rows[2].price.problem
    assert any(line.startswith("not ranked: odd: ") and problem in line for line in found.notes())
    assert [row["comparable"] for row in found.as_dict()["rows"]] == [True, True, False]


def test_numbers_that_cannot_be_compared_are_marked() -> None:
    found = section(learner("clock", 20, 2, clocked=True), learner("other", 20, 2), by="core-hours")
    (marked,) = (row for row in found.sheet().cells if row[1] == "clock")
    assert marked[3].startswith("~")
    assert "~ : not comparable with the others" in found.notes()
    alone = section(learner("clock", 20, 2, clocked=True), by="core-hours")
    assert alone.compared is None
    assert alone.as_dict()["rows"][0]["mean_cost"] is None


def test_seeds_that_cost_differently_and_seeds_without_a_record() -> None:
    entry = learner("uneven", 20, 1)
    records = {s: replace(each, executions=1000 * (2 if s else 3)) for s, each in entry.records.items()}
    found = section(replace(entry, records=records))
    assert any("up to 1.5 times as much in one seed" in line for line in found.notes())
    records[0] = replace(records[0], executions=0)
    found = section(replace(entry, records=records))
    assert found.rows[0].price.problem == "the records of some of its seeds hold no executions"


def test_shots_are_executions_times_shots() -> None:
    many, few = ({"model_options": {"shots": shots}} for shots in (1000, 10))
    entries = [learner("many", 20, 1, identity=many), learner("few", 40, 1, identity=few)]
    assert labels(section(*entries)) == ["many", "few"]
    assert any("--by shots counts shots" in line for line in section(*entries).notes())
    found = section(*entries, by="shots")
    assert labels(found) == ["few", "many"]
    assert [row.price.per_step for row in found.rows] == [10, 1000]


def test_few_seeds_and_short_entries() -> None:
    short = learner("short", 1, 0.001, epochs=3)
    made = board.build([learner("a", 20, 2), learner("few", 20, 2, seeds=5), short], by="executions")
    (found,) = made.sections
    assert [found.rank_text(row) for row in found.rows] == ["1", "undecided"]
    assert made.refused == ("short: ends at 6000 steps; --horizon 6000 shows it",)
    assert found.budget == 2 * 100 * STEPS, "the short entry does not shrink the budget"


def test_an_unknown_axis_is_one_error() -> None:
    with pytest.raises(OptionError, match=r"steps, executions, shots, .*; did you mean 'shots'"):
        board.build([learner("a", 20, 2)], by="shot")


def test_a_cost_has_a_section_of_the_page_and_a_table_for_a_paper(tmp_path: Path) -> None:
    page, words = tmp_path / "page.html", ["leaderboard", "--published", "--task", "beam6g", "--runs", "none"]
    words += ["--by", "executions", "--entry", "vqc-native qubits=6", "--format"]
    assert say(*words, "html", "--out", str(page)).exit_code == 0
    assert '<a href="#beside-1">beam6g by executions</a>' in page.read_text()
    assert page.read_text().count('id="beside-1-title"') == 1
    assert r"\label{tab:beam6g-executions}" in say(*words, "latex").stdout


def test_costs_are_not_mixed_with_what_counts_steps() -> None:
    for rule in ("times", "paper"):
        said = boards.refused("leaderboard", "--by", "shots", "--rule", rule)
        assert "judges cells of one task in environment steps" in said
