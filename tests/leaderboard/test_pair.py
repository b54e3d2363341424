"""Two entries in words: the verdict, thresholds with intervals of their own, and the board that is stricter."""

from __future__ import annotations

import doctest
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard import rules
from qrlsuite.leaderboard.boards import pair, scores
from qrlsuite.leaderboard.boards.compared import compare_entries, pair_table
from qrlsuite.leaderboard.shelf.curves import BESIDE, EntryResults
from qrlsuite.statistics import Direction
from tests.leaderboard import boards

GRID = boards.entry("any").task_file.ranking.grid


def entry(
    label: str, reached_at: list[int] | np.ndarray, score: float = 0.95, start: float = 0.1
) -> EntryResults:
    """One run per number: the epoch of 100 from which it has the score."""
    curves = np.full((len(reached_at), 100), start)
    for run, epoch in enumerate(reached_at):
        curves[run, epoch:] = score
    return boards.changed(boards.entry(label), curves=curves, name=label.replace(" ", "-"))


def begun_with(entry: EntryResults, epsilons: list[float]) -> EntryResults:
    """An entry in whose record the task has other thresholds."""
    ranking = entry.task_file.ranking.model_copy(update={"epsilons": epsilons})
    return boards.changed(entry, task_file=entry.task_file.model_copy(update={"ranking": ranking}))


def spread(around: int, count: int = 30) -> np.ndarray:
    return around + np.arange(count) % 5


def test_the_helpers_are_right_by_hand() -> None:
    assert doctest.testmod(pair).failed == 0
    assert [pair.said(p) for p in (0.0212, 1 / 10_001, float("nan"))] == ["p = .021", "p < .0001", ""]


def test_the_first_is_the_subject_in_sentence_and_table() -> None:
    """M of 20 and 40 epochs, with half an epoch: 40.5 / 20.5 - 1."""
    fast, slow = entry("fast", spread(18)), entry("slow", spread(38))
    unseen = "; final score 0.950 against 0.950, p = 1; none of 30 seeds failed, but up to 9.5% of others may"
    there, back = compare_entries(fast, slow), compare_entries(slow, fast)
    assert (
        there.sentence
        == f"fast needs 49% fewer steps than slow (48% to 51%, 30 seeds each, p < .0001){unseen}"
    )
    assert (
        back.sentence
        == f"slow needs 98% more steps than fast (92% to 103%, 30 seeds each, p < .0001){unseen}"
    )
    for compared, sign, word in ((there, "-49%", "fewer"), (back, "+98%", "more")):
        assert {(row[3].partition(" ")[0], row[-1]) for row in compared.pair.rows()} == {(sign, word)}


def test_every_threshold_has_numbers_of_its_own() -> None:
    """Both reach .75 at epoch 20 on average and the first alone .95: thresholds above .75 are never reached."""
    first, second = entry("first", spread(18)), entry("second", spread(18), score=0.75)
    compared = compare_entries(first, second)
    rows = {row[0]: row[1:] for row in compared.pair.rows()}
    assert rows["0.9"][:2] == ("40k", "never")
    assert rows["0.9"][2].startswith("-80% (")
    assert rows["0.9"][-1] == "fewer"
    assert rows["0.7"] == ("40k", "40k", "+0.0% (-4.0% to +4.1%)", "1", "not told apart")


def test_the_verdict_is_that_of_the_mean_whatever_a_threshold_says() -> None:
    """The first is a little earlier at .6 in every run, and as good as the second or worse above."""
    first, second = entry("first", spread(20), 0.62), entry("second", spread(25), 0.62)
    noise = np.random.default_rng(0)
    for each, seed in ((first, 0), (second, 7)):
        for run in range(30):
            each.curves[run, noise.integers(30, 100) + seed // 20 :] = 0.95
    compared = compare_entries(first, second)
    assert compared.sentence.startswith(
        "not told apart: first needs 4.7% more steps than second, 11% fewer to 23%"
    )
    assert "; so many seeds would show 21% fewer in 4 of 5 cases; final score 0." in compared.sentence
    assert [row[-1] for row in compared.pair.rows()].count("fewer") == 1


def test_what_so_few_seeds_cannot_know_is_a_clause() -> None:
    many = entry("many", spread(18, 60))
    assert compare_entries(many, entry("others", spread(38, 60))).sentence.endswith("p = 1")
    wide = entry("wide", np.resize([2, 96], 20))
    said = compare_entries(wide, entry("narrow", spread(5, 20))).sentence
    assert said.startswith("wide needs 560% more steps than narrow (")
    assert said.endswith(
        "; none of 20 seeds failed, but up to 14% of others may; one entry's seeds vary 5 times as much as the "
        "other's, which so few seeds can mistake for a difference"
    )
    failing = entry("failing", [18, 20, 100, 19, 22])
    assert (
        "; none of 8 seeds of quick failed, but up to 31% of others may"
        in compare_entries(failing, entry("quick", spread(2, 8))).sentence
    )


def test_two_that_reached_nothing_are_told_what_to_do() -> None:
    first, second = entry("first", spread(18), 0.5), entry("second", spread(18), 0.2)
    said = compare_entries(first, second).sentence
    assert said == (
        "neither reached any of the 7 thresholds within 200k steps: train longer, or lower them; "
        "final score 0.500 against 0.200, p < .0001"
    )
    compared = compare_entries(first, second)
    assert compared.pair.notes[-1].endswith("of the epochs (10); difference +0.3 (+0.3 to +0.3)")
    assert compared.remarks[0] == (
        "failed (reached no threshold; `--by area` ranks by the learning curves alone): "
        "first (30 of 30 seeds), second (30 of 30 seeds)"
    )
    assert [pair._signed(value) for value in (130.4, -99.6, -3.44, 0.0123)] == [
        "+130",
        "-99.6",
        "-3.4",
        "+0.012",
    ]


def test_equals_are_not_told_apart_and_too_few_cannot_decide() -> None:
    first, second = entry("first", spread(20)), entry("second", spread(20))
    assert compare_entries(first, second).sentence == (
        "not told apart: first needs 0.0% fewer steps than second, 3.3% fewer to 3.4% more (30 seeds each, p = 1); "
        "so many seeds would show 4.6% fewer in 4 of 5 cases; final score 0.950 against 0.950, p = 1"
    )
    few = compare_entries(entry("few", spread(20, 3)), second)
    assert few.sentence == (
        "cannot be decided with so few seeds (4 each could): so far few needs 4.4% fewer steps than second (3 and 30 "
        "seeds); final score 0.950 against 0.950"
    )
    assert {row[-2:] for row in few.pair.rows()} == {("-", "undecided")}
    four = compare_entries(entry("four", spread(20, 4)), entry("later", spread(60, 4)))
    assert four.sentence.startswith(
        "four needs 65% fewer steps than later (61% to 68%, 4 seeds each, p = .029); final score 0.950 "
    )
    one = compare_entries(entry("one", spread(20, 1)), second)
    assert one.sentence.endswith("so far one needs 8.9% fewer steps than second (1 and 30 seeds)")


def test_where_thresholds_cross_the_sentence_says_where_the_other_is_ahead() -> None:
    early, late = entry("early", spread(18), 0.72), entry("late", spread(40))
    early.curves[:, 90:] = 0.95
    compared = compare_entries(early, late)
    assert compared.pair.times.direction is Direction.MORE
    assert ", p < .0001), but early needs fewer at 0.7, 0.65, 0.6; final score " in compared.sentence
    turned = compare_entries(late, early).sentence
    assert turned.startswith("late needs ")
    assert ", p < .0001), but early needs fewer at 0.7, 0.65, 0.6; final score " in turned


def test_another_number_may_stand_first() -> None:
    """The last tenth of 100 epochs: .72 against .95."""
    low, high = entry("low", spread(18), 0.72), entry("high", spread(40))
    steps = "; low needs "
    said = {
        by: compare_entries(low, high, by=by).sentence.partition(steps) for by in ("score", "area", "spread")
    }
    assert all(rest for _, found, rest in said.values() if found == steps)
    assert said["score"][0] == "low has a lower final score than high (0.720 against 0.950, p < .0001)"
    assert said["area"][0].startswith("not told apart: area under the learning curve 0.59")
    assert said["spread"][0].startswith("low has a lower spread between seeds than high (")
    alike, apart = entry("alike", np.resize([20, 22, 30], 30)), entry("apart", np.resize([20, 24, 90], 30))
    found = compare_entries(alike, apart, by="spread")
    assert found.sentence.startswith(
        "alike has a lower spread between seeds than apart (6.67k against 46.7k, p = .0009); alike needs "
    ), "2, 0 and 8 epochs of 2000 steps from the median; 4, 0 and 66"
    few = compare_entries(entry("few", np.resize([20, 22], 19)), apart, by="spread")
    assert few.sentence.startswith("cannot be decided with so few seeds: spread between seeds ")
    assert found.as_dict()["times"]["spread"]["means"] == pytest.approx([20_000 / 3, 140_000 / 3])
    with pytest.raises(OptionError, match="--by shots: expected score or area or spread"):
        compare_entries(alike, apart, by="shots")


def test_cells_are_there_by_a_rule_alone() -> None:
    pair_of = entry("fast", spread(18)), entry("slow", spread(38))
    assert compare_entries(*pair_of).cells is None
    assert "cells" not in compare_entries(*pair_of).as_dict()
    judged = compare_entries(*pair_of, rule=rules.load("paper"))
    assert judged.further[-1].startswith("by the paper's rule, cell by cell, 30 seeds each: outperforms: ")
    assert judged.as_dict()["cells"]["outcome"] == "outperforms"
    assert judged.sentence == compare_entries(*pair_of).sentence


def test_the_board_of_more_entries_is_stricter() -> None:
    first = entry("first", np.arange(10, 50))
    second = entry("second", np.arange(16, 56))
    alone = compare_entries(first, second)
    assert alone.pair.times.direction is Direction.FEWER
    others = [entry(f"other {k}", spread(20 + k)) for k in range(6)]
    few = entry("few", spread(30, 19))
    among = pair.on_board(first, second, [first, second, *others, few], 0.05)
    assert among is not None
    assert among.n_entries == 8
    assert alone.pair.times.p < 0.05 < among.adjusted
    assert among.text.startswith(
        "on the board of 8 entries, which is stricter (28 pairs): not told apart, adjusted p = "
    )
    renamed = replace(first, mark=BESIDE)
    assert pair.on_board(first, second, [renamed, second, *others], 0.05) == among
    assert pair.on_board(first, second, [first, second], 0.05) is None
    assert pair.on_board(first, few, [first, few, *others], 0.05) is None


@pytest.mark.parametrize(
    ("labels", "reached_at"),
    [(("mlp width=16", "mlp width=64"), (18, 38)), (("mine steps=6000", "mine steps=7000"), (100, 100))],
)
def test_numbers_are_never_cut_by_a_narrow_terminal(
    labels: tuple[str, str], reached_at: tuple[int, int]
) -> None:
    compared = compare_entries(*(entry(*each) for each in zip(labels, map(spread, reached_at))))
    console = Console(width=80, file=io.StringIO())
    console.print(pair_table(compared.pair))
    shown = console.file.getvalue()
    assert "   ".join(label.split()[1] for label in labels) in shown
    for cells in compared.pair.rows():
        assert all(cell in shown for cell in (*cells[:-1], *cells[-1].split())), cells


def test_thresholds_that_changed_after_the_first_seed_are_named() -> None:
    first, second = entry("first", spread(18)), entry("second", spread(38))
    kept = first.task_file.ranking.epsilons
    changed, same = begun_with(first, [0.1, 0.2]), begun_with(second, kept[::-1])
    said = "thresholds changed after the first seed: first"
    assert any(each.startswith(said) for each in compare_entries(changed, same).remarks)
    named, unchanged = (boards.of([one, same]).sheets(explain=True)[0] for one in (changed, first))
    assert said in named.markdown()
    assert "thresholds changed" not in unchanged.markdown()


def test_an_entry_is_not_compared_with_itself() -> None:
    first = entry("first", spread(18))
    with pytest.raises(QrlSuiteError, match="'first' is compared with itself"):
        compare_entries(first, first)


def test_entries_whose_task_files_have_other_thresholds_than_the_board_are_named() -> None:
    """A task that is a file: each entry keeps the file with which it began, and most of them decide."""
    first, second, third = (
        entry(name, spread(18 + k)) for k, name in enumerate(("first", "second", "third"))
    )
    first = begun_with(first, [0.5])
    first = replace(first, task_file=first.record.task_file)
    [sheet] = boards.of([first, second, third]).sheets()
    assert "thresholds changed after the first seed: first (judged by 0.6, 0.65, " in sheet.markdown()


def test_the_board_says_of_a_pair_what_compare_says_with_its_own_p() -> None:
    """A board of two is the pair's own test, so that all words but p's name are equal; a larger board adjusts p."""
    late = entry("late", spread(40))
    equal = entry("equal", spread(40)), entry("as equal", spread(40))
    for one, other in (
        (entry("fast", spread(18)), late),
        equal,
        (entry("few", spread(9, 5)), late),
    ):
        alone = compare_entries(one, other)
        [section] = boards.of([one, other]).sections
        rows = {row.entry.label: row for row in section.times.rows}
        row_of = [rows[each.label] for each in (one, other)]
        on = pair.pair_on(section.times, scores.finals(section), *row_of, GRID, alone.pair.labels)
        without = re.sub("; so many [^;]*", "", alone.sentence)
        assert on.sentence.replace("adjusted ", "") == without
    close = entry("first", np.arange(10, 50)), entry("second", np.arange(16, 56))
    [section] = boards.of([*close, *(entry(f"other {k}", spread(20 + k)) for k in range(6))]).sections
    rows = {row.entry.label: row for row in section.times.rows}
    alone = compare_entries(*close)
    on = pair.pair_on(
        section.times, scores.finals(section), rows["first"], rows["second"], GRID, alone.pair.labels
    )
    assert alone.sentence.startswith("first needs ")
    assert on.sentence.startswith("not told apart: first needs ")
    assert on.times.p > alone.pair.times.p


def test_a_verdict_of_short_runs_begins_with_their_steps() -> None:
    short = [entry(name, spread(start)).cut(50) for name, start in (("first", 20), ("second", 40))]
    said = compare_entries(*short).sentence
    assert said.startswith("after 100k of 200k steps: first needs 4")
