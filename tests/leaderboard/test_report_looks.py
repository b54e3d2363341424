"""The page's sections of studies with looks and of several tasks."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.report import looks as looks_report
from qrlsuite.leaderboard.report import render
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.records import RunRecord
from qrlsuite.results.store import EntryStore, json_line, table_bytes, write_atomically
from qrlsuite.studies.looks import Study, in_folder, new
from tests.commands import say
from tests.conftest import TINY
from tests.leaderboard import boards

STARTS = {"mlp width=16": 5, "mlp width=8": 5, "mlp width=4": 14}
"""The epoch from which the runs of an entry are good, one epoch earlier or later by turns."""


def put(study: Study, looks: int) -> None:
    """Leave the seeds of some looks in the study's folder as workers would, and take the looks."""
    study.begin()
    state = study.look()
    for _ in range(looks):
        for name, count in state.decision.wanted.items():
            store = EntryStore.create(study.folder, study.entries[name])
            for seed in range(study.looks.first_seed, study.looks.first_seed + count):
                start = STARTS[name] + (seed + name.count("8")) % 2
                folder = store.seed(seed)
                rows = [{"epoch": epoch, "scores": [float(epoch >= start)] * 5} for epoch in range(1, 21)]
                write_atomically(folder.table, table_bytes(rows))
                lines = (json_line({"epoch": epoch, "cpu": 1.8}) for epoch in range(1, 21))
                write_atomically(folder.timings, b"".join(lines))
                record = RunRecord(plan=study.hash, seed=seed, **store.names, status="finished", epochs=20)
                folder.write_record(record)
        state = study.look()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with a study that is finished and one that is open; the task file lies beside it."""
    folder = tmp_path_factory.mktemp("studies")
    task = folder / "tiny.toml"
    task.write_text(TINY.replace("seeds = 4\nepochs = 3", "seeds = 100\nepochs = 20"))
    put(new("three", str(task), list(STARTS), folder / "runs"), looks=2)
    put(new("two", str(task), list(STARTS)[:2], folder / "runs"), looks=1)
    return folder / "runs"


def test_a_study_is_shown_with_hash_dates_looks_and_what_was_spent(runs: Path) -> None:
    found, refused = in_folder(runs)
    assert refused == []
    three, two = (looks_report.view(outcome) for outcome in found)
    verdicts = ["equal within 10 percent", "mlp width=16 needs fewer", "mlp width=8 needs fewer"]
    assert [line["verdict"] for line in three["pairs"]] == verdicts
    taken = [(20, True), (40, True), (60, False), (80, False), (100, False)]
    assert [(line["seeds"], line["taken"] != "–") for line in three["looks"]] == taken
    # Pocock's spending at a fifth of the runs: alpha x log(1 + (e - 1) / 5)
    assert [line["spent"] for line in three["looks"]] == ["0.015", "0.026", "0.035", "0.043", "0.050"]
    assert [bool(text) for text, _ in three["looks"][1]["p"]] == [True, False, False], (
        "the others were closed"
    )
    assert [decided for _, decided in three["looks"][0]["p"]] == [False, True, True]
    facts = dict(three["facts"])
    assert facts["State"] == "finished"
    assert facts["Hash of the study"] == found[0].study.hash
    assert facts["Study written"].endswith(" UTC")
    assert facts["First seed begun"] >= facts["Study written"]
    assert facts["Seeds"] == "10000:10100, 100 used, 200 saved"
    assert dict(two["facts"])["State"] == "goes on: next look at 40 seeds"
    assert "p ≤ 0.015 at 40 seeds" in two["pairs"][0]["needs"]
    assert len(three["picture"]["lines"]) == 3
    assert [len(dots) for _, _, dots in three["picture"]["lines"]] == [2, 1, 1]
    other, _ = in_folder(runs, ["beam6g"])
    assert other == []


def test_the_command_puts_studies_on_the_page(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    changed = tmp_path / "runs" / "decisions" / "two" / "plan.toml"
    changed.write_text(changed.read_text().replace("alpha = 0.05", "alpha = 2"))
    words = ["leaderboard", "--format", "html", "--runs", str(tmp_path / "runs")]
    result = say(*words)
    assert result.exit_code == 0, result.output
    text = (tmp_path / "runs" / "leaderboard.html").read_text()
    assert "three: Which needs fewer steps, mlp width=16, mlp width=8 or mlp width=4?" in text
    assert in_folder(runs)[0][0].study.hash in text
    assert re.search(r"plan.toml: alpha = 2.* is outside \(0, 1\)", text), "left out, with the reason"


def test_times_of_the_log_are_written_to_the_minute() -> None:
    assert looks_report._minute("2026-01-02T03:04:05+01:00") == "2026-01-02 02:04 UTC"
    assert looks_report._minute("when it rained") == "when it rained"


@pytest.mark.parametrize("width", [1400, 390])
def test_decisions_and_several_tasks_in_a_browser(opened: Callable[..., Any], runs: Path, width: int) -> None:
    entries = []
    for task in ("beam6g", "cartpole"):
        entries += [
            boards.changed(each, task_name=task, task_hash=task) for each in boards.graded(2, seeds=30)
        ]
    compared = board.build(entries, together=["beam6g", "cartpole"])
    page = render(board.build(entries), studies=in_folder(runs)[0], beside=compared)
    tab = opened(page, width=width)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.locator("nav a[href='#studies']").count() == 1
    studies = tab.locator("#studies article")
    assert studies.count() == 2
    assert "mlp width=16 needs fewer" in studies.first.inner_text()
    assert studies.first.locator("circle").count() == 4
    assert studies.first.locator("circle.closed").count() == 2
    looks = studies.first.locator("details")
    looks.locator("summary").click()
    assert "0.026" in looks.inner_text()
    table = tab.locator("#beside-1 tbody")
    assert table.locator("tr").count() == 2
    assert "model-0 width=1" in table.locator("tr").first.inner_text()


def test_published_studies_are_shown_with_the_boards_of_their_task(tmp_path: Path) -> None:
    found, refused = published_studies.collected(Selection(tmp_path, published=True, tasks=("pulse",)))
    assert refused == []
    assert [outcome.study.name for outcome in found] == ["advantage-pulse", "equal-size-pulse"]


def test_final_scores_and_how_settings_were_found_stand_beside_the_verdicts() -> None:
    """Without p: looks stop by steps, so that no test for a fixed number of seeds applies."""
    state = studies.read_outcome("equal-size-cartpole-ppo", Path("no-runs"))
    pair, [facts, *_] = state.pairs[0], state.as_dict()["pairs"]
    last = [state.curves[name].values[: pair.n_runs, -3:].mean() for name in (pair.first, pair.second)]
    assert facts["final_scores"] == pytest.approx(last)
    (settings,) = (note for note in state.notes if note.startswith("settings: "))
    assert settings.startswith(
        "settings: tuned (160 trials, 56 seeds, regret 6%), search: bayesian: circuit; "
    )
    assert settings in " ".join(str(state).split())
    shown = looks_report.view(state)
    assert shown["pairs"][0]["finals"] == "final score 0.999 / 0.969"
    assert settings in shown["note"]
