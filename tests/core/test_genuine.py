"""Folders are what they say: copies, links, other names and other people's words."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from typer.testing import CliRunner

from qrlsuite.cli.app import build
from qrlsuite.errors import StoreError
from qrlsuite.experiment.task import digest
from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.results.store import EntryStore, json_line
from qrlsuite.results.survey import groups
from tests.commands import say
from tests.conftest import Train


@pytest.fixture
def store(kept: Train) -> EntryStore:
    return EntryStore(kept("runs", range(3), 4))


def change(path: Path, **values: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def counted(store: EntryStore) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """The seeds that a board counts, and why others do not."""
    entry = collect.read_entry(store)
    assert entry is not None
    return entry.seeds, entry.refused


def test_a_copied_folder_is_no_further_seed(store: EntryStore) -> None:
    for seed in (5, 24):
        shutil.copytree(store.seed(2).path, store.seed(seed).path)
    seeds, refused = counted(store)
    assert seeds == (0, 1, 2)
    assert [line.partition(":")[0] for line in refused] == ["seed 5", "seed 24"]
    assert "does not say that it is seed 5 of ddqn-mlp-" in refused[0]
    assert "(seed is 2 in it)" in refused[0]
    with pytest.raises(StoreError, match="does not say that it is seed 24"):
        store.finished([0, 24], 4)


@pytest.mark.parametrize(
    ("name", "value"), [("entry", "ddqn-mlp-00000000"), ("task", "beam6g"), ("task_hash", "0")]
)
def test_a_seed_of_another_entry_or_task_does_not_count(store: EntryStore, name: str, value: str) -> None:
    change(store.seed(1).path / "run.json", **{name: value})
    seeds, (line,) = counted(store)
    assert seeds == (0, 2)
    assert f"({name} is {value!r} in it)" in line


def test_swapped_folders_do_not_count(store: EntryStore) -> None:
    store.seed(0).path.rename(store.path / "aside")
    store.seed(1).path.rename(store.seed(0).path)
    (store.path / "aside").rename(store.seed(1).path)
    assert counted(store)[0] == (2,)


def test_names_are_exact(store: EntryStore) -> None:
    for name in ("seed-00000", "seed-000", "seed-0\N{ARABIC-INDIC DIGIT ONE}01", "seed-0001 "):
        shutil.copytree(store.seed(0).path, store.path / name)
    assert store.seeds() == [0, 1, 2]
    assert store.seed(12345).path.name == "seed-12345"
    store.seed(12345).path.mkdir()
    assert store.seeds() == [0, 1, 2, 12345]


@pytest.mark.parametrize("linked", ["seed-0001", "seed-0001/epochs.parquet", "seed-0001/run.json"])
def test_links_in_an_entry_do_not_count(store: EntryStore, linked: str, tmp_path: Path) -> None:
    (store.path / linked).rename(tmp_path / "elsewhere")
    (store.path / linked).symlink_to(tmp_path / "elsewhere")
    seeds, (line,) = counted(store)
    assert seeds == (0, 2)
    assert f"{linked} is a link: links in a results folder are not followed" in line


def test_entries_and_tasks_that_are_links_are_refused_and_the_results_folder_may_be_one(
    store: EntryStore, tmp_path: Path
) -> None:
    runs = store.path.parents[1]
    (tmp_path / "root").symlink_to(runs)
    (found,), refused = collect.collect(collect.Selection(tmp_path / "root"))
    assert (found.seeds, refused) == ((0, 1, 2), [])
    (runs / "other").symlink_to(runs / "tiny")
    (runs / "tiny" / "again").symlink_to(store.path)
    (found,), refused = collect.collect(collect.Selection(runs))
    assert found.folder == store.path
    assert len(refused) == 3
    assert all("is a link" in line for line in refused)
    entry = store.entry()
    (runs / "tiny").rename(tmp_path / "moved")
    (runs / "tiny").symlink_to(tmp_path / "moved")
    with pytest.raises(StoreError, match="tiny is a link"):
        EntryStore.find(runs, entry)


def with_scores(store: EntryStore, seed: int, values: list[float]) -> None:
    """Give a seed other scores."""
    folder = store.seed(seed)
    rows = folder.epochs()
    folder.table.unlink()
    changed = [{**row.content, "scores": [value] * 5} for row, value in zip(rows, values, strict=True)]
    folder.lines.write_bytes(b"".join(map(json_line, changed)))


def test_a_copy_that_names_itself_rightly_is_found_by_its_scores(store: EntryStore) -> None:
    shutil.copytree(store.seed(2).path, store.seed(7).path)
    change(store.seed(7).path / "run.json", seed=7)
    with_scores(store, 2, [0.1, 0.2, 0.3, 0.2])
    with_scores(store, 7, [0.1, 0.2, 0.3, 0.2])
    seeds, (line,) = counted(store)
    assert seeds == (0, 1)
    assert "seeds 2,7 are copies of each other" in line


def test_agents_that_learn_nothing_may_coincide_unless_their_parameters_do(store: EntryStore) -> None:
    for seed in (0, 1, 2):
        with_scores(store, seed, [0.25] * 4)
    assert counted(store) == ((0, 1, 2), ())
    shutil.copy(store.seed(0).agent, store.seed(1).agent)
    seeds, (line,) = counted(store)
    assert seeds == (2,)
    assert "seeds 0:2 are copies" in line
    dead = {name: np.full_like(array, np.nan) for name, array in load_file(store.seed(0).agent).items()}
    for seed in (0, 1):
        save_file(dead, store.seed(seed).agent)
    assert counted(store) == ((0, 1, 2), ())


@pytest.mark.parametrize("damaged", ["run.json", "epochs.parquet", "timings.jsonl"])
def test_a_damaged_file_leaves_out_one_seed(store: EntryStore, damaged: str) -> None:
    (store.seed(1).path / damaged).write_bytes(b"{\n")
    seeds, (line,) = counted(store)
    assert seeds == (0, 2)
    assert line.startswith("seed 1: ")
    assert damaged in line
    done = say("leaderboard", "--runs", str(store.path.parents[1]))
    assert done.exit_code == 0
    assert f"left out: {line}" in done.stderr
    for seed in (0, 2):
        (store.seed(seed).path / damaged).write_bytes(b"{\n")
    with pytest.raises(StoreError, match=r"seed 0: .*; seed 1: .*; seed 2: "):
        collect.read_entry(store)


def test_hashes_are_computed_again(store: EntryStore) -> None:
    path = store.path / "entry.json"
    whole = path.read_text()
    identity = json.loads(whole)["identity"]
    assert digest(identity) == store.record().hash
    for values, message in (
        (
            {"identity": {**identity, "model_options": {"width": 512}}},
            "the options do not have the entry's hash",
        ),
        ({"task_hash": "0" * 16}, "the task's definition does not have its hash"),
        ({"name": "ddqn-mlp-00000000"}, "it is named 'ddqn-mlp-00000000'"),
        (
            {"identity": {**identity, "task": None}},
            "identity.task = None: Input should be a valid dictionary",
        ),
    ):
        path.write_text(whole)
        change(path, **values)
        with pytest.raises(StoreError, match=message):
            store.record()


ESCAPE = "\x1b]0;owned\x07"


@pytest.mark.parametrize(
    "values", [{"label": f"ddqn {ESCAPE}"}, {"preset": ESCAPE}, {"plan": ["\x9b31m"]}, {"label": "ddqn\nmlp"}]
)
def test_no_word_of_a_stranger_controls_the_terminal(store: EntryStore, values: dict[str, Any]) -> None:
    runs = store.path.parents[1]
    shutil.copytree(store.path, runs / "tiny" / f"second{ESCAPE}")
    change(store.path / "entry.json", **values)
    change(runs / "tiny" / f"second{ESCAPE}" / "entry.json", hash="0" * 16)
    for words in (["leaderboard"], ["runs"], ["leaderboard", "--format", "html"]):
        done = CliRunner().invoke(build(), [*words, "--runs", str(runs)])
        said = done.stdout + done.stderr + str(done.exception)
        assert "left out" in said or "damaged" in said
        assert not [c for c in done.stdout + done.stderr if not c.isprintable() and c != "\n"], words


def test_markdown_shows_labels_as_they_are() -> None:
    from tests.leaderboard.boards import entry

    (sheet,) = board.build([entry("mlp [a](http://x) *b* `c` _d_ e_f & <i>"), entry("mlp")]).sheets()
    shown = sheet.markdown()
    assert r"mlp \[a\](http://x) \*b\* \`c\` \_d\_ e_f &amp; &lt;i>" in shown


def test_a_damaged_seed_is_not_said_to_go_on(store: EntryStore) -> None:
    store.seed(1).path.joinpath("run.json").write_text("{")
    assert not [group for group in groups(store) if group.state == "stopped"]
    store.seed(0).write_record(store.seed(0).record().changed(status="running"))
    assert [group.seeds for group in groups(store) if group.state == "stopped"] == [(0,)]
