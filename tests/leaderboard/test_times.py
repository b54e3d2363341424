"""Boards by mean time below threshold: what is decided, marked and written, on page and paper and in files."""

from __future__ import annotations

import doctest
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from qrlsuite import api
from qrlsuite.engine import sheet
from qrlsuite.errors import FileError, OptionError
from qrlsuite.experiment import task as tasks
from qrlsuite.leaderboard import report
from qrlsuite.leaderboard.boards import board, scores
from qrlsuite.leaderboard.boards.compared import compare_entries
from qrlsuite.leaderboard.boards.pair import pair_on
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.store import EntryStore
from tests.commands import say
from tests.conftest import TINY, Train
from tests.leaderboard import boards


def reaching(label: str, *steps: tuple[float, float], seeds: int = 20, spread: int = 2) -> EntryResults:
    """Runs that score 0, and `score` from about an epoch on, for each (score, epoch); run i is i % spread later."""
    curves = np.zeros((seeds, 100))
    for run in range(seeds):
        for score, epoch in steps:
            curves[run, int(epoch) + run % spread :] = score
    return boards.changed(boards.entry(label, seeds), curves=curves)


def times_of(*entries: EntryResults, alpha: float = 0.05) -> Any:
    (section,) = board.build(entries, alpha=alpha).sections
    return section.times


def markdown(*entries: EntryResults) -> str:
    made = boards.of(entries).sheets(explain=True)[0]
    return made.markdown()


def test_mean_times_places_and_differences_by_hand() -> None:
    # half of the runs of `quick` score 1 from epoch 10 on and half from 11: M = 10.5 epochs of 2000 steps
    found = times_of(reaching("slow one", (1, 60)), reaching("quick one", (1, 10)), reaching("never"))
    assert [(row.entry.label, row.mean.mean, row.at_cap, row.mean.half) for row in found.rows] == [
        ("quick one", 21_000, 0, 21_000), ("slow one", 121_000, 0, 100_000), ("never", 200_000, 1, 100_000),
    ]  # fmt: skip
    assert [(row.place, row.ranks) for row in found.rows] == [(1, (1, 1)), (2, (2, 2)), (3, (3, 3))]
    assert [row.place_at_half for row in found.rows] == [1, 3, 2], "equal at half the horizon: by name"
    assert found.rows[0].difference is None
    assert found.rows[1].difference[0] == pytest.approx(122 / 22 - 1), "with half an epoch"
    low, high = found.rows[1].difference[1:]
    assert low < 122 / 22 - 1 < high
    assert (found.n_pairs, found.n_decided) == (3, 3)


def test_ranks_of_entries_that_are_not_told_apart_are_ranges() -> None:
    first, second = reaching("first", (1, 10)), reaching("second", (1, 10), spread=3)
    found = times_of(first, second, reaching("third", (1, 60)), reaching("fourth", (1, 60), spread=3))
    assert [row.rank_text for row in found.rows] == ["1-2", "1-2", "3-4", "3-4"]
    told = [found.told_apart_from_next(row) for row in found.rows]
    assert told == [False, True, False, None]
    (row,) = times_of(first).rows
    assert (row.rank_text, row.difference_text) == ("1", "-")


def test_few_and_unequal_numbers_are_marked_and_below_20_nothing_is_decided() -> None:
    many, few = reaching("many", (1, 10), seeds=100), reaching("few", (1, 60), seeds=20)
    made = times_of(many, few, reaching("five", (1, 5), seeds=5))
    rows = [("many", False, "1"), ("few", True, "2"), ("five", False, "-")]
    assert [(row.entry.label, row.few, row.rank_text) for row in made.rows] == rows
    assert made.n_pairs == 1
    assert made.rows[2].difference is None
    text = markdown(many, few)
    assert r"| 20\*! |" in text
    assert "! fewer than 50 seeds" in text
    enough = times_of(many, reaching("enough", (1, 60), seeds=50))
    assert not any(row.few for row in enough.rows)
    assert "fewer than 50" not in markdown(many, reaching("enough", (1, 60), seeds=50))
    equal = times_of(few, reaching("as few", (1, 60), seeds=20))
    assert not any(row.few for row in equal.rows)


def test_a_pair_whose_decision_may_turn_is_named() -> None:
    (section,) = board.build([reaching("early", (1, 60)), reaching("steady", (1, 30))]).sections
    made = section.times
    assert made.special() == made.as_dict()["within_monte_carlo_error"] == []
    facts = {"adjusted": np.full((2, 2), 0.05), "p_error": 2e-5 * ~np.eye(2, dtype=bool)}
    open_still = replace(made, board=replace(made.board, **facts))
    assert open_still.special() == [
        "within Monte Carlo error of its level after 10 million permutations: steady and early, "
        "adjusted p = .05 +- 2e-05"
    ]
    said = pair_on(open_still, scores.finals(section), *made.rows, section.ranking.grid, ("a", "b")).sentence
    assert "adjusted p = .05 +- 2e-05" in said


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1, float("nan")])
def test_alpha_outside_0_and_1_is_refused(alpha: float) -> None:
    with pytest.raises(OptionError, match=r"alpha = .* is outside \(0, 1\)"):
        boards.board.build([boards.entry("one")], alpha=alpha)


def columns(made: board.Leaderboard, width: int, **asked: bool) -> list[str]:
    """What a terminal of some width shows, line by line."""
    text = io.StringIO()
    console = Console(file=text, width=width, color_system=None, highlight=False)
    for each in made.sheets(**asked):
        console.print(each)
    return text.getvalue().splitlines()


def test_bars_need_no_unicode() -> None:
    (made,) = boards.of(boards.graded(2)).sheets()
    buffer = io.TextIOWrapper(io.BytesIO(), "ascii")
    Console(file=buffer, width=100).print(made)
    buffer.flush()
    assert "=" in buffer.buffer.getvalue().decode("ascii")  # type: ignore[attr-defined]


def test_entries_of_other_lengths_have_a_line_below_the_table() -> None:
    made = boards.of([*boards.graded(3), boards.entry("short one", 20, 40), boards.entry("shorter", 20, 20)])
    assert [section.horizon for section in made.sections] == [200_000, 80_000, 40_000]
    (found,) = made.sheets()
    assert len(found.rows) == 3
    assert found.lines[0].startswith("shorter: short one, 20 seeds, 80k steps, ")
    assert found.lines[1].startswith("shorter: shorter, 20 seeds, 40k steps, ")
    hints = [f"--horizon {steps}000 ranks all at their first {steps}k steps" for steps in (80, 40)]
    assert found.lines[2:] == tuple(hints)


def test_longer_entries_are_in_the_table_of_a_board_without_a_complete_one() -> None:
    made = boards.of([boards.entry("a", 20, 10), boards.entry("b", 20, 10), boards.entry("longer", 20, 30)])
    (found,) = made.sheets()
    assert "20k of 200k steps" in found.title
    assert len(found.rows) == 3
    assert not any("shorter" in line for line in found.lines)
    begun = boards.of([boards.entry("a", 20, 30), boards.entry("b", 20, 30), boards.entry("begun", 20, 1)])
    (found,) = begun.sheets()
    assert "60k of 200k steps" in found.title
    assert found.lines[0].startswith("shorter: begun, ")


def test_filters_change_no_rank() -> None:
    asked = {"published": True, "runs": "none"}
    ((full,), (few,)) = (
        api.board("beam6g", **asked, **more).sections  # type: ignore[arg-type]
        for more in ({}, {"entries": ["mlp width=64", "vqc-native qubits=8"]})
    )
    ranks = {row.entry.label: row.ranks for row in full.times.rows}
    assert len(few.times.rows) == len(few.rows) == 2
    assert all(ranks[row.entry.label] == row.ranks for row in few.times.rows)
    assert (few.times.n_ranked, few.times.n_pairs, few.times.n_decided) == (11, 55, 44)
    tiers = {row.entry.label: row.tier for row in full.tiers}
    assert {row.entry.label: row.tier for row in few.tiers}.items() < tiers.items()
    i, j = few.times.order
    shown = few.times.board.difference[j, i]
    assert few.times.rows[1].difference[0] == shown, "against the first that is shown"
    alone = api.board("beam6g", **asked, entries=[row.entry for row in few.rows])  # type: ignore[arg-type]
    assert alone.sections[0].times.n_ranked == 2


def test_the_matrix_of_pairs() -> None:
    _, found = boards.of([*crossing(), reaching("few", (1, 3), seeds=5)]).sheets(explain=True)
    assert [row[2:] for row in found.cells] == [
        ("", "+", "+", "?"), ("-", "", "+", "?"), ("-", "-", "", "?"), ("?", "?", "?", ""),
    ]  # fmt: skip


def crossing() -> list[EntryResults]:
    early, steady = reaching("early", (0.72, 5), (1, 60)), reaching("steady", (1, 30))
    return [early, steady, reaching("slow one", (1, 80))]


def test_the_paper_s_rule_gives_the_published_tiers() -> None:
    found, pairs = api.board("beam6g", rule="paper", published=True, runs="none").sheets(explain=True)
    assert [column.title for column in found.columns[3:5]] == ["rests on", "cells +/-"]
    assert found.cells[3][:2] + found.cells[3][3:5] == ("2", "mlp width=32", "45 of 48", "176/125")
    assert pairs.cells[1][2] == "+6-2", "width 128 against width 64"


def test_the_page_shows_ranks_and_matrix(opened: Callable[..., Any]) -> None:
    made = boards.of([*crossing(), reaching("slow two", (1, 80), spread=3)])
    for width in (1400, 390):
        tab = opened(made, width)
        assert tab.locator(".ranks .rank").all_inner_texts() == ["1", "2", "3", "4"]
        assert tab.locator(".p-values tbody td").count() == 16
        assert tab.locator(".p-values td.win").count() == tab.locator(".p-values td.loss").count() == 6
        assert tab.evaluate("document.documentElement.scrollWidth") == width


@pytest.mark.parametrize(
    "text", [*boards.HOSTILE, "a_b & 50% #1 $x^2$ ~ \\input{x} [1] --x `y' ''z'' {", "a\nb"]
)
def test_latex_prints_every_name_as_it_is(text: str) -> None:
    shown = sheet.escaped(text)
    assert "\n" not in shown
    spelled = r"\\text[a-z]+\{\}|\\symbol\{\d+\}|\{\[\}|\{\]\}|-\{\}-|'\{\}'|\\[&%$#_{}]"
    assert not set(re.sub(spelled, "", shown)) & set('\\&%$#_{}~^<>|"`[]'), shown
    assert "--" not in shown
    assert "''" not in shown
    (made,) = boards.of([boards.changed(boards.entry("x", 20), label=text), boards.entry("plain")]).sheets()
    written = made.latex()
    rows = [line for line in written.splitlines() if line.endswith(r"\\")]
    assert [len(re.findall(r"(?<!\\)&", row)) for row in rows] == [10, 10, 10]
    assert written.count("{") - written.count(r"\{") == written.count("}") - written.count(r"\}")


def test_latex_is_a_booktabs_table_per_section() -> None:
    assert doctest.testmod(sheet).failed == 0
    made = boards.of([*boards.graded(3, seeds=20), boards.entry("many", 100)])
    (text,) = (each.latex() for each in made.sheets())
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"\caption{", r"\label{tab:beam6g-200000}"):
        assert text.count(part) == 1
    assert "& 20*! &" in text
    [caption] = [line for line in text.splitlines() if "caption" in line]
    assert caption.startswith(r"  \caption{beam6g")
    assert caption.endswith("error 0.05 for all together.}"), "one sentence; other notes are comments"
    assert any(line.startswith("% ") and "! fewer than 50 seeds" in line for line in text.splitlines())


RULED = TINY.replace("[ranking]", '[ranking]\nrule = "times"')


def test_a_task_names_its_rule_and_the_command_overrides(
    tiny_task: str, train: Train, tmp_path: Path
) -> None:
    plain = tasks.load(tiny_task)
    Path(tiny_task).write_text(RULED)
    ruled = tasks.load(tiny_task)
    assert ruled.hash == plain.hash, "ranking is no part of a task's definition"
    assert "rule" not in plain.file.model_dump(mode="json")["ranking"], "as earlier versions wrote it"
    assert ruled.file.model_dump(mode="json")["ranking"]["rule"] == "times"

    path = train("runs", range(2), 3)
    assert EntryStore(path).record().task_file.ranking.rule == "times"
    words = ["leaderboard", "--runs", str(path.parent.parent), "--format", "json"]
    for more, rule in (([], "times"), (["--rule", "intervals"], "intervals")):
        result = say(*words, *more)
        (section,) = json.loads(result.stdout)["sections"]
        assert (section["rule"], json.loads(result.stdout)["rule"]) == (rule, rule)


def test_sections_of_several_tasks_have_their_own_rules() -> None:
    one, other = boards.entry("some one"), boards.entry("another one", task="cartpole")
    ranking = one.task_file.ranking.model_copy(update={"rule": "times"})
    ruled = replace(one, task_file=one.task_file.model_copy(update={"ranking": ranking}))
    made = boards.of([ruled, other])
    rules = {section.task: section.rule for section in made.sections}
    assert rules == {"beam6g": "times", "cartpole": "intervals"}
    assert set(made.rules) == {"intervals", "times"}
    assert "<q>times, intervals</q>" in report.render(made)
    cells = compare_entries(ruled, boards.changed(ruled, name="b")).cells
    assert cells is not None
    assert cells.rule == "times"


def test_an_unknown_rule_is_one_line_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"ranking.rule: unknown rule 'tims'; did you mean 'times'"):
        tasks.parse(RULED.replace('"times"', '"tims"'), "tiny.toml")
    entry = boards.entry("some one")
    ranking = entry.task_file.ranking.model_copy(update={"rule": "gone"})
    stored = replace(entry, task_file=entry.task_file.model_copy(update={"ranking": ranking}))
    made = board.build([stored, boards.entry("another", task="cartpole")])
    assert [section.task for section in made.sections] == ["cartpole"]
    assert "task 'beam6g' at 200000 steps: unknown rule 'gone'" in made.refused[0]
