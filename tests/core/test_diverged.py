"""Agents whose numbers are no longer finite are counted while they train, and marked where they are ranked."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from qrlsuite import api
from qrlsuite.leaderboard.shelf import import_seeds, published
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.results.store import EntryStore
from qrlsuite.training import group
from tests.commands import qrlsuite
from tests.conftest import Train, results

TOO_FAST = ("width=16", "algorithm.lr=1e30")


def test_seeds_that_diverge_are_recorded_from_the_epoch_on_and_keep_their_scores(
    train: Train, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    entry = train("straight", [0, 1], 3, settings=TOO_FAST)
    sound = train("straight", [0, 1], 3)
    run = EntryStore(entry).seed(0).read()
    assert run.diverged == 1
    assert run.scores.shape[0] == 3
    assert EntryStore(sound).seed(0).read().diverged is None
    assert "diverged" not in EntryStore(sound).seed(0).epochs()[0].content
    monkeypatch.setattr(group, "CHECKPOINT_SECONDS", 0.0)
    train("stopped", [0, 1], 2, settings=TOO_FAST)
    stopped = train("stopped", [0, 1], 3, settings=TOO_FAST)
    assert results(entry, 1) == results(stopped, 1), "as never stopped"
    assert [EntryStore(path).seed(0).record().diverged for path in (entry, stopped, sound)] == [1, 1, None]
    loaded = api.load("mlp width=16 lr=1e+30", runs=tmp_path / "straight")
    assert loaded.diverged == (0, 1)
    assert "2, 2 diverged" in loaded.facts["seeds"]
    probe = {"result": "equal", "seed": 1, "epochs": 1}
    probed = EntryStore(entry).seed(1)
    probed.write_record(probed.record().changed(probe={**probe, "host": "mine"}))
    folder = export(loaded, tmp_path / "export")
    there = published.read(folder)
    assert (there.entry_results().diverged, there.published.probe.content) == ((0, 1), probe)
    import_seeds.import_seeds(EntryStore(folder), tmp_path / "imported")
    (here,) = (tmp_path / "imported").glob("*/*")
    assert EntryStore(here).seed(0).read().diverged == 1
    assert EntryStore(here).seed(1).record().probe.content == probe


def test_the_end_of_a_run_and_the_board_say_it(tiny_task: str, tmp_path: Path) -> None:
    words = ["run", "--task", tiny_task, "--model", "mlp", "--set", "algorithm.lr=1e30", "--seeds", "2"]
    done = qrlsuite(*words, "--epochs", "2", "--runs", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "2 of them diverged: numbers of their agents are no longer finite." in done.stderr
    board = ["leaderboard", "--runs", str(tmp_path), "--format"]
    (section,) = json.loads(qrlsuite(*board, "json").stdout)["sections"]
    assert section["rows"][0]["diverged_seeds"] == [0, 1]
    assert "(2 of 2 seeds)" in qrlsuite(*board, "markdown").stdout
