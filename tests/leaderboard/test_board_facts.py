"""What a board says beside a tier: how few cells it rests on, and who reached no goal at all."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrlsuite import api
from qrlsuite.engine.sheet import csv_rows
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import UnknownNameError
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard import report, rules
from qrlsuite.leaderboard.boards import board, steps
from qrlsuite.leaderboard.boards.compared import compare_entries
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.boards.scores import rank_by_score
from qrlsuite.leaderboard.pictures import tiers
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.options import parse_setting
from qrlsuite.results.records import DeviceRecord, Provenance
from qrlsuite.results.store import EntryStore
from tests.leaderboard import boards


def markdown(made: board.Leaderboard) -> str:
    """The board with all its notes."""
    return "\n".join(sheet.markdown() for sheet in made.sheets(explain=True))


def paper(made: board.Leaderboard) -> str:
    """The same entries by the paper's rule."""
    sections = tuple(replace(section, by_tiers=True) for section in made.sections)
    return markdown(replace(made, sections=sections))


def flat(label: str, score: float, last: float | None = None) -> EntryResults:
    """An entry of 20 seeds at one score all along, or from epoch 50 on at another."""
    curves = np.full((20, 100), score)
    if last is not None:
        curves[:, 50:] = last
    return boards.changed(boards.entry(label), curves=curves)


@pytest.fixture
def mostly_at_the_cap() -> board.Leaderboard:
    """Best reaches .6 (epsilon .4, seven cells of 49) halfway; the two others reach nothing."""
    return boards.of([flat("best one", 0.1, 0.62), flat("poor one", 0.1), flat("poor two", 0.2)])


def test_entries_that_reached_no_threshold_are_named_with_what_ranks_them(
    mostly_at_the_cap: board.Leaderboard,
) -> None:
    named = "poor one (20 of 20 seeds)"
    line = "failed (reached no threshold; `--by area` ranks by the learning curves alone): "
    assert f"{line}{named}, poor two (20 of 20 seeds)" in markdown(mostly_at_the_cap)
    one = markdown(boards.of([flat("best one", 0.1, 0.62), flat("poor one", 0.1)]))
    assert f"failed (reached no threshold): {named}" in one


def test_entries_at_the_cap_everywhere_are_not_reached_and_below_who_reached(
    mostly_at_the_cap: board.Leaderboard,
) -> None:
    (section,) = mostly_at_the_cap.sections
    rows = [("best one", 1, False), ("poor one", None, True), ("poor two", None, True)]
    assert [(row.entry.label, row.tier, row.not_reached) for row in section.tiers] == rows
    assert [row.outperformed_by for row in section.tiers[1:]] == [("best one",)] * 2
    text = paper(mostly_at_the_cap)
    assert "| not reached | poor one |" in text
    assert "not reached: at the cap in every cell" in text
    written = [row["verdict"] for row in csv.DictReader(io.StringIO(csv_rows(mostly_at_the_cap.flat())))]
    assert [verdict.partition(":")[0] for verdict in written] == ["ranked", "not reached", "not reached"]


def test_two_that_reached_nothing_are_not_called_equal(mostly_at_the_cap: board.Leaderboard) -> None:
    best, one, two = (row.entry for row in mostly_at_the_cap.sections[0].tiers)
    neither = "not reached: both are at the cap in all 49 cells"
    most = "significantly fewer samples in 7 of 49 cells, significantly more in none; both at the cap in 42"
    for entry, said in ((one, neither), (best, f"outperforms: {most}")):
        assert compare_entries(entry, two, rules.load("paper")).as_dict()["cells"]["sentence"] == said


def test_a_tier_says_on_how_few_cells_it_rests() -> None:
    made = boards.of([flat("best one", 0.1, 0.62), flat("later one", 0.1, 0.62)])
    later = made.sections[0].rows[1].entry
    later.curves[:, :70] = 0.1
    made = boards.of([made.sections[0].rows[0].entry, later])
    first, second = made.sections[0].tiers
    assert first.rests_on is None
    assert second.rests_on == steps.Support("best one", "later one", cells=7, at_cap=42, total=49)
    assert re.search(r"\| 2 \| later one \| [^|]* \| 7 of 7 \|", paper(made))
    page = report.render(made)
    assert ">7 of 7</abbr>" in page
    assert '<p class="verdict">best one needs ' in page


def test_the_picture_of_tiers_names_who_reached_nothing(mostly_at_the_cap: board.Leaderboard) -> None:
    figure = tiers.draw([row.entry for row in mostly_at_the_cap.sections[0].tiers])
    shown = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert [text.rpartition("   ")[2].strip() for text in shown] == ["tier 1", "not reached", ""]


def test_settings_chosen_on_protocol_seeds_are_marked() -> None:
    entries = boards.graded(2)
    marked = [boards.changed(entries[0], tuning={"steps": 1, "on_protocol_seeds": True}), entries[1]]
    made = boards.of(marked)
    note = "settings chosen after seeing runs on protocol seeds, which may flatter"
    assert f"† {note}" in markdown(made)
    assert f"| {entries[0].label} † |" in markdown(made)
    assert f"{entries[0].label}</a> †" in report.render(made)
    assert "protocol seeds, which" not in markdown(boards.of(entries))


def test_parameters_counted_in_two_ways_are_told_apart(tiny_task: str, tmp_path: Path) -> None:
    """A record of an older version counts PPO's policy alone; one new record of the entry says it all."""
    stores = {}
    for algorithm in ("ppo", "ddqn"):
        entry = resolve(tiny_task, "mlp", algorithm, [parse_setting("width=16")])
        stores[algorithm] = EntryStore.create(tmp_path / "runs", entry)
        train_group(stores[algorithm].path, [0, 1], 3)

    def forget(*seeds: int) -> None:
        for store in stores.values():
            for seed in seeds:
                path = store.seed(seed).path / "run.json"
                record = json.loads(path.read_text())
                record["parameters"] = {"classical": 387, "quantum": 0}
                path.write_text(json.dumps(record))

    def told() -> tuple[dict[str, int], str, str]:
        made = board.build(collect.collect(collect.Selection(tmp_path / "runs"))[0])
        rows = made.as_dict()["sections"][0]["rows"]
        counts = {row["label"].split()[0]: row["parameters"]["classical"] for row in rows}
        return counts, markdown(made), report.render(made)

    both = {"ppo": 387 + 353, "ddqn": 387}
    counts, text, page = told()
    assert counts == both
    assert "first network alone" not in text + page
    assert "740 classical, 0 quantum in 2 networks" in page
    forget(0)
    assert told()[0] == both
    forget(1)
    counts, text, page = told()
    assert counts == {"ppo": 387, "ddqn": 387}
    note = "arameters of the first network alone (older records count no other, such as a critic): ppo mlp width=16"
    assert text.count(note) == page.count(note) == 1
    assert f"{note}, ddqn" not in text + page

    ppo = collect.read_entry(stores["ppo"])
    assert ppo is not None
    export(ppo, tmp_path / "old")
    (old,) = collect.collect(collect.Selection(tmp_path / "old"))[0]
    assert (old.parameters, old.networks) == ((387, 0), None)


CPU, CUDA = (Provenance(device=DeviceRecord(kind=kind), versions={"torch": kind}) for kind in ("cpu", "cuda"))
REGRET = {"goal": 0.05, "expected": 0.04, "low": 0.01, "high": 0.1, "near": 0.5}
NOTES: dict[str, dict[str, Any]] = {
    "trained on several kinds of device, see `qrlsuite show ENTRY`: {} (cpu, cuda)": {"provenance": [CPU, CUDA]},
    "made with several versions, see `qrlsuite show ENTRY`: {} (torch)": {"provenance": [CPU, CUDA]},
    "diverged (numbers of the agents are no longer finite), judged with the scores that they had: {} (20 of 20 seeds)":
    {"diverged": 3},
    "settings: tuned (3 trials, regret 4%), search: bayesian, too few: {}; default, not tuned: model-1 width=2":
    {"tuning": {"sampler": "bayesian", "trials": 3, "note": "regret 4%; too few", "regret": REGRET}},
    "failed (reached no threshold): {} (20 of 20 seeds)": {"curves": np.zeros((20, 100))},
}  # fmt: skip


@pytest.mark.parametrize("note", NOTES)
def test_every_verdict_names_what_may_lie_behind_it(note: str) -> None:
    one, two = boards.graded(2)
    changed, plain = (boards.changed(each, provenance=[CPU]) for each in (one, two))
    changed, text = boards.changed(changed, **NOTES[note]), note.format(one.label)
    assert text in markdown(boards.of([changed, plain])).split("  \n")
    assert text in compare_entries(changed, plain).remarks
    assert text in rank_by_score([changed, plain], 200_000, "score").notes()
    others = compare_entries(boards.changed(one, provenance=[CPU]), plain).remarks
    assert text not in others
    assert "settings: default, not tuned" in others


def test_a_setting_is_judged_by_the_run_as_trained_not_as_cut() -> None:
    """The target is copied every 2000 of 20,000 gradient steps; a run of 30 epochs copies it 3 times."""
    whole = boards.changed(boards.entry("mlp"), identity={"algorithm_options": {"target_steps": 2000}})
    cut, short = whole.cut(30), boards.changed(whole, curves=whole.curves[:, :30])
    assert cut is not None
    assert cut.curves.shape == short.curves.shape
    assert whole.unusable == cut.unusable == []
    said = "target_steps=2000 copies the target network 3 times in 6000 gradient steps, first after 33% of the run"
    assert short.unusable == [said]
    assert f"{said}: {short.label}" in compare_entries(short, boards.entry("mlp-2 width=2")).remarks


def test_unfinished_seeds_are_named() -> None:
    one, two = boards.graded(2)
    short = {seed: replace(one.records[seed], scores=one.records[seed].scores[:40]) for seed in (6, 7, 9)}
    begun = replace(one, records={**one.records, **short})
    said = f"unfinished seeds, left out: {one.label} (6:8,9)"
    assert said in compare_entries(begun, two).remarks
    assert said in markdown(boards.of([begun, two])).split("  \n")


def test_the_board_says_where_settings_come_from() -> None:
    one, two, three = boards.graded(3)
    record = {"trials": 16, "seeds": "1000000:1000032", "changed": [], "budget": "8 settings per option"}
    identity = {"algorithm_options": {"lr": 2e-3}}
    tuned, released = boards.changed(one, tuning=record), boards.changed(two, preset="released")
    by_hand = boards.changed(three, preset="released", identity=identity)
    told = ["tuned (16 trials, 32 seeds)", "released", "released but lr"]
    assert [entry.settings for entry in (tuned, released, by_hand)] == told
    assert boards.changed(one, tuning={"changed": ["algorithm.lr"]}).settings == "tuned but lr"
    assert boards.changed(one, preset="released", identity={"algorithm": "mine"}).settings == "default", (
        "as older records have it"
    )
    assert boards.changed(one, preset="mine.toml").settings == "mine.toml"
    assert boards.changed(one, tuning={"trials": None, "seeds": "1000000:?"}).settings == "tuned"
    mixed = "tuned and untuned settings are compared: a difference may come from tuning"
    text = markdown(boards.of([tuned, released, by_hand]))
    assert mixed in text.split("  \n")
    assert "| tuned (16 trials, 32 seeds) |" in text
    equal = markdown(boards.of([tuned, boards.changed(two, tuning=record)]))
    assert mixed not in equal
    assert "different budgets" not in equal
    less = {**record, "budget": "2 settings per option"}
    unequal = markdown(boards.of([tuned, boards.changed(two, tuning=less)]))
    assert "different budgets: 2 settings per option; 8 settings per option" in unequal


def test_a_published_variant_of_a_task_is_known_by_its_name(tmp_path: Path) -> None:
    (section,) = api.board("beam6g+7d1167f1", runs=tmp_path, published=True).sections
    assert {row.entry.task for row in section.rows} == {"beam6g+7d1167f1"}
    with pytest.raises(UnknownNameError, match="did you mean 'beam6g'"):
        api.board("beam6g+7d1167f1", runs=tmp_path)


def test_stated_scores_of_policies_do_not_split_the_vote_on_the_cells() -> None:
    def stating(policies: dict[str, float], **cells: object) -> EntryResults:
        one = boards.entry("one")
        ranking = one.task_file.ranking.model_copy(update={"policies": policies, **cells})
        return replace(one, task_file=one.task_file.model_copy(update={"ranking": ranking}))

    split = [*[stating({})] * 2, *[stating({"random": 0.3})] * 2]
    made = ranking_of([*split, *[stating({}, epsilons=[0.5, 0.6])] * 3])
    assert (made.epsilons, made.policies) == (split[0].task_file.ranking.epsilons, {"random": 0.3})
