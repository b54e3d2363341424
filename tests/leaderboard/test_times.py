"""Boards by mean time below threshold: what is decided, marked and written, on page and paper and in files."""

from __future__ import annotations

import csv
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
from typer.testing import CliRunner

from qrlsuite.cli.app import build
from qrlsuite.errors import OptionError, TaskError
from qrlsuite.experiment import task as tasks
from qrlsuite.leaderboard import board, latex, report, tables
from qrlsuite.leaderboard.curves import EntryCurves
from qrlsuite.results.store import EntryStore
from qrlsuite.statistics import Direction
from tests.conftest import TINY
from tests.leaderboard import boards

EPSILONS = [0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40]
"""Of beam6g's ranking grid, at 2000 steps per epoch and 100 epochs."""


def reaching(label: str, *steps: tuple[float, float], seeds: int = 20, spread: int = 2) -> EntryCurves:
    """Runs that score 0, and `score` from about an epoch on, for each (score, epoch); run i is i % spread later."""
    curves = np.zeros((seeds, 100))
    for run in range(seeds):
        for score, epoch in steps:
            curves[run, int(epoch) + run % spread :] = score
    return replace(boards.entry(label, seeds), curves=curves)


def times_of(*entries: EntryCurves, alpha: float = 0.05) -> Any:
    (section,) = board.build(entries, alpha=alpha).sections
    return section.times


def test_mean_times_places_and_differences_by_hand() -> None:
    # half of the runs of `quick` score 1 from epoch 10 on and half from 11: M = 10.5 epochs of 2000 steps
    found = times_of(reaching("slow one", (1, 60)), reaching("quick one", (1, 10)), reaching("never"))
    assert [row.entry.label for row in found.rows] == ["quick one", "slow one", "never"]
    assert [row.mean.mean for row in found.rows] == [21_000, 121_000, 200_000]
    assert [row.at_cap for row in found.rows] == [0, 0, 1]
    assert [row.mean.half for row in found.rows] == [21_000, 100_000, 100_000]
    assert [row.place for row in found.rows] == [1, 2, 3]
    assert [row.place_at_half for row in found.rows] == [1, 3, 2], "equal at half the horizon: by name"
    assert [row.ranks for row in found.rows] == [(1, 1), (2, 2), (3, 3)]
    assert found.rows[0].difference is None
    assert found.rows[1].difference[0] == pytest.approx(121 / 21 - 1)
    low, high = found.rows[1].difference[1:]
    assert low < 121 / 21 - 1 < high
    assert (found.n_pairs, found.n_decided) == (3, 3)
    assert found.cells(found.rows[1])[4].startswith("121k (")


def test_neighbors_that_are_not_told_apart_are_joined() -> None:
    first, second = reaching("first", (1, 10)), reaching("second", (1, 10), spread=3)
    found = times_of(first, second, reaching("third", (1, 60)), reaching("fourth", (1, 60), spread=3))
    assert [row.joined for row in found.rows] == ["/", "\\", "/", "\\"]
    assert [row.rank_text for row in found.rows] == ["1-2", "1-2", "3-4", "3-4"]
    (row,) = times_of(first).rows
    assert (row.joined, row.rank_text, row.difference_text) == ("", "1", "-")
    assert {r.joined for r in times_of(first, reaching("third", (1, 60))).rows} == {""}
    three = times_of(first, second, reaching("other", (1, 10), spread=4))
    assert [row.joined for row in three.rows] == ["/", "|", "\\"]


def test_few_and_unequal_numbers_are_marked_and_below_20_nothing_is_decided() -> None:
    many, few = reaching("many", (1, 10), seeds=100), reaching("few", (1, 60), seeds=20)
    made = times_of(many, few, reaching("five", (1, 5), seeds=5))
    assert [(row.entry.label, row.few, row.rank_text) for row in made.rows] == [
        ("many", False, "1"),
        ("few", True, "2"),
        ("five", False, "undecided"),
    ]
    assert made.cells(made.rows[1])[3] == "20!"
    assert made.n_pairs == 1
    assert made.rows[2].difference is None
    assert any("fewer than 50 seeds" in note for note in made.notes())
    enough = times_of(many, reaching("enough", (1, 60), seeds=50))
    assert not any(row.few for row in enough.rows)
    assert not any("fewer than 50" in note for note in enough.notes())
    equal = times_of(few, reaching("as few", (1, 60), seeds=20))
    assert not any(row.few for row in equal.rows)


def test_trade_offs_are_named() -> None:
    # up to .75 is early of one and late of the other, and the reverse beyond
    made = times_of(reaching("early", (0.72, 5), (1, 60)), reaching("steady", (1, 30)))
    (line,) = made.trade_offs()
    assert line == (
        "trade-off: steady needs fewer steps at epsilon 0.1, 0.15, 0.2, 0.25; early at epsilon 0.3, 0.35, 0.4"
    )
    assert line in made.notes()
    assert [row.rank_text for row in made.rows] == ["1-2", "1-2"]
    assert {row.joined for row in made.rows} == {""}, "a trade-off is told apart"


def test_a_pair_decided_against_the_order_of_the_means_is_named() -> None:
    # at epsilon .1 `sure` is three epochs ahead in every run; elsewhere two of its runs are 55 behind
    sure, other = reaching("sure", (0.85, 5), (1, 61)), reaching("other", (0.85, 5), (1, 64))
    sure.curves[:2, :60] = 0
    made = times_of(sure, other)
    assert made.board.directions[0][1] is Direction.FEWER
    assert [row.entry.label for row in made.rows] == ["other", "sure"]
    assert made.against_the_order() == [
        "against the order of M: sure needs significantly fewer steps than other at epsilon 0.1, and more at others, "
        "not significantly"
    ]
    assert [row.rank_text for row in made.rows] == ["2", "1"]


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1, float("nan")])
def test_alpha_outside_0_and_1_is_refused(alpha: float) -> None:
    with pytest.raises(OptionError, match=r"alpha = .* is outside \(0, 1\)"):
        boards.board.build([boards.entry("one")], alpha=alpha)
    result = CliRunner().invoke(build(), ["leaderboard", "--published", "--alpha", str(alpha)])
    assert isinstance(result.exception, OptionError)


def test_alpha_decides_levels_and_pairs() -> None:
    entries = [boards.entry("some a", speed=1.0), boards.entry("some bb", speed=1.15)]
    strict, loose = (times_of(*entries, alpha=alpha) for alpha in (0.0001, 0.2))
    assert (strict.level, loose.level) == ("99.99%", "80%")
    widths = [np.diff(made.rows[0].mean.interval)[0] for made in (strict, loose)]
    assert widths[0] > widths[1]
    assert strict.n_decided <= loose.n_decided


def four() -> board.Leaderboard:
    return boards.of([*boards.graded(3), boards.entry("model-x", 30, speed=0.9), boards.entry("short", 5)])


def test_json_holds_the_matrix_of_adjusted_p() -> None:
    made = four()
    (section,) = json.loads(json.dumps(board.as_dict(made), allow_nan=False))["sections"]
    found = section["times"]
    p = np.array(found["adjusted_p"], dtype=float)
    assert p.shape == (5, 5)
    ranked = p[:4, :4]
    assert np.isnan(np.diag(ranked)).all()
    assert (ranked[~np.eye(4, dtype=bool)] > 0).all()
    np.testing.assert_array_equal(ranked, ranked.T)
    assert np.isnan(p[4]).all(), "fewer than 20 seeds"
    assert found["verdicts"][4][0] == "undecided"
    assert [row["entry"] for row in found["entries"]][-1] == "short"
    for i in range(4):
        for j in range(4):
            decided = found["verdicts"][i][j] in ("needs fewer", "needs more", "trade-off")
            assert i == j or decided == (p[i, j] <= 0.05)


def test_csv_holds_the_same_numbers() -> None:
    made = four()
    (section,) = board.as_dict(made)["sections"]
    found = section["times"]
    names = [row["entry"] for row in found["entries"]]
    written = list(csv.DictReader(io.StringIO(tables.csv_text(made))))
    assert len(written) == 5
    for row in written:
        place = names.index(row["entry"])
        told = found["entries"][place]
        assert float(row["mean_time"]) == told["mean_time"]
        assert row["time_place"] == ("" if told["place"] is None else str(told["place"]))
        given = dict(part.split(": ") for part in row["adjusted_p"].split("; ") if part)
        stated = {n: p for n, p in zip(names, found["adjusted_p"][place]) if p is not None}
        assert {n: float(p) for n, p in given.items()} == pytest.approx(stated, rel=1e-5)


def test_markdown_shows_both_tables_and_escapes_the_bracket() -> None:
    text = tables.markdown(boards.of([reaching(name, (1, 10)) for name in ("a b", "c d", "e f")]))
    assert "by mean time below threshold" in text
    lines = [line for line in text.splitlines() if line.startswith("| 1-3 |")]
    assert [line.split(" | ")[1] for line in lines] == ["/", "\\|", "\\\\"]
    columns = {len(re.findall(r"(?<!\\)\|", line)) for line in text.splitlines() if line.startswith("| 1-3")}
    assert columns == {9}


def test_the_page_shows_brackets_matrix_and_trade_offs(opened: Callable[..., Any]) -> None:
    entries = [
        reaching("early", (0.72, 5), (1, 60)),
        reaching("steady", (1, 30)),
        reaching("slow one", (1, 80)),
        reaching("slow two", (1, 80), spread=3),
    ]
    for width in (1400, 390):
        tab = opened(boards.of(entries), width)
        assert tab.locator(".timed tbody tr").count() == 4
        assert tab.locator(".timed .rank.start").count() == tab.locator(".timed .rank.end").count() == 1
        assert tab.locator(".p-values tbody td").count() == 16
        assert tab.locator(".p-values td.both").count() == 2
        assert tab.locator(".special").count() == 1
        assert "Trade-off: steady needs fewer steps at epsilon 0.1" in tab.locator(".special").inner_text()
        assert tab.evaluate("document.documentElement.scrollWidth") == width
        bottom, top = (tab.locator(f".timed .rank.{end}").bounding_box() for end in ("start", "end"))
        assert bottom["x"] == top["x"]


@pytest.mark.parametrize("text", [*boards.HOSTILE, "a_b & 50% #1 $x^2$ ~ \\input{x} [1] --x `y' {", "a\nb"])
def test_latex_prints_every_name_as_it_is(text: str) -> None:
    shown = latex.escaped(text)
    assert "\n" not in shown
    spelled = r"\\text[a-z]+\{\}|\\symbol\{\d+\}|\{\[\}|\{\]\}|-\{\}-|\\[&%$#_{}]"
    assert not set(re.sub(spelled, "", shown)) & set("\\&%$#_{}~^<>|\"`'[]"), shown
    assert "--" not in shown
    written = latex.tables(boards.of([replace(boards.entry("x", 20), label=text), boards.entry("plain")]))
    rows = [line for line in written.splitlines() if line.endswith(r"\\")]
    assert [len(re.findall(r"(?<!\\)&", row)) for row in rows] == [8, 8, 8]
    assert written.count("{") - written.count(r"\{") == written.count("}") - written.count(r"\}")


def test_latex_is_a_booktabs_table_per_section() -> None:
    assert doctest.testmod(latex).failed == 0
    made = boards.of([*boards.graded(3, seeds=20), boards.entry("many", 100)])
    text = latex.tables(made)
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"\caption{", r"\label{tab:beam6g-200000}"):
        assert text.count(part) == 1
    assert r"20$^\dagger$" in text
    assert r"$\dagger$: fewer than 50 seeds" in text
    assert r"$\alpha = 0.05$" in text


RULED = TINY.replace("[ranking]", '[ranking]\nrule = "times"')


def test_a_task_names_its_rule_and_the_command_overrides(
    tiny_task: str, train: Callable[..., Path], tmp_path: Path
) -> None:
    plain = tasks.load(tiny_task)
    Path(tiny_task).write_text(RULED)
    ruled = tasks.load(tiny_task)
    assert ruled.hash == plain.hash, "ranking is no part of a task's definition"
    assert "rule" not in plain.file.model_dump(mode="json")["ranking"], "as earlier versions wrote it"
    assert ruled.file.model_dump(mode="json")["ranking"]["rule"] == "times"

    path = train("runs", range(2), 3)
    assert EntryStore(path).record()["task_file"]["ranking"]["rule"] == "times"
    words = ["leaderboard", "--runs", str(path.parent.parent), "--format", "json"]
    for more, rule in (([], "times"), (["--rule", "intervals"], "intervals")):
        result = CliRunner().invoke(build(), [*words, *more], catch_exceptions=False)
        (section,) = json.loads(result.stdout)["sections"]
        assert (section["rule"], json.loads(result.stdout)["rule"]) == (rule, rule)


def test_sections_of_several_tasks_have_their_own_rules() -> None:
    one, other = boards.entry("some one"), boards.entry("another one", task="cartpole")
    ranking = one.task_file.ranking.model_copy(update={"rule": "times"})
    ruled = replace(one, task_file=one.task_file.model_copy(update={"ranking": ranking}))
    made = boards.of([ruled, other])
    assert {section.task: section.rule for section in made.sections} == {
        "beam6g": "times",
        "cartpole": "intervals",
    }
    assert set(made.rules) == {"intervals", "times"}
    assert "<q>times, intervals</q>" in report.render(made)
    assert board.compare_entries(ruled, replace(ruled, name="b")).rule == "times"


def test_an_unknown_rule_is_one_line_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(
        TaskError, match=r"ranking.rule: unknown significance test 'tims'; did you mean 'times'"
    ):
        tasks.parse(RULED.replace('"times"', '"tims"'), "tiny.toml")
    entry = boards.entry("some one")
    ranking = entry.task_file.ranking.model_copy(update={"rule": "gone"})
    stored = replace(entry, task_file=entry.task_file.model_copy(update={"ranking": ranking}))
    made = board.build([stored, boards.entry("another", task="cartpole")])
    assert [section.task for section in made.sections] == ["cartpole"]
    assert "task 'beam6g' at 200000 steps: unknown significance test 'gone'" in made.refused[0]
