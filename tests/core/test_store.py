"""The results on disk: damage is named, never repaired silently, and nothing is lost."""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import qrlsuite
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.results import checkpoint, provenance, store
from qrlsuite.results.claims import SeedsClaimedError, acquire, living
from qrlsuite.results.seeds import format_seeds, parse_seeds, plan_groups
from qrlsuite.statistics.grid import settled
from tests.commands import answer
from tests.conftest import Train, results


def test_a_torn_last_line_is_dropped_and_a_broken_one_named(tmp_path: Path) -> None:
    path = tmp_path / "epochs.jsonl"
    path.write_bytes(b'{"epoch":1}\n{"epoch":2}\n{"epo')
    assert [row["epoch"] for row in store.read_lines(path)] == [1, 2]
    path.write_bytes(b'{"epoch":1}\n{"ep\n{"epoch":3}\n')
    with pytest.raises(StoreError, match="line 2: not JSON"):
        store.read_lines(path)


@pytest.mark.parametrize("read", [store.read_json, store.read_lines, store.read_table, store.read_arrays])
def test_a_pipe_in_the_place_of_a_file_is_refused(read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    handle = os.open(path, os.O_RDWR)
    writer = threading.Timer(5, os.close, (handle,))  # a reader that waits goes on then
    writer.start()
    with pytest.raises(StoreError, match="not a regular file"):
        read(path)
    writer.cancel()
    os.close(handle)


def test_float32_scores_survive_every_round_trip(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random(1000, dtype=np.float32)
    rows = [
        {
            "epoch": 1,
            "scores": store.shortest(values),
            "loss": 0.1,
            "executions": {"forward": 3},
            "nothing": None,
        }
    ]
    path = tmp_path / "t.parquet"
    path.write_bytes(store.table_bytes(rows))
    back = store.read_table(path)
    assert back == rows
    assert (np.array(back[0]["scores"], np.float32) == values).all()


def test_the_table_is_what_the_lines_were(kept: Train) -> None:
    folder = store.EntryStore(kept("runs", [0])).seed(0)
    rows = folder.epochs()
    assert not folder.lines.exists()
    assert [row.epoch for row in rows] == [1, 2, 3]
    assert len(rows[0].scores) == 5
    folder.cut(2)
    assert [row.epoch for row in folder.epochs()] == [1, 2]
    assert folder.epochs() == rows[:2]


def test_scores_are_read_and_those_that_cannot_be_are_refused(kept: Train) -> None:
    folder = store.EntryStore(kept("runs", [0], 1)).seed(0)
    assert folder.read().scores.shape == (1, 5)
    (row,) = folder.epochs()
    folder.table.unlink()
    for scores in ([], [None, 0.5]):
        folder.lines.write_bytes(store.json_line({**row.content, "scores": scores}))
        with pytest.raises(StoreError, match=r"epochs\.jsonl, line 1 is not an epoch's record: scores"):
            folder.read()


def test_another_format_version_is_refused(train: Train) -> None:
    entry = train("runs", [0])
    content = json.loads((entry / "entry.json").read_text())
    (entry / "entry.json").write_text(json.dumps({**content, "format_version": 2}))
    with pytest.raises(StoreError, match="has format version 2, this suite reads 1"):
        train("runs", [0])


def test_a_missing_epoch_is_an_error(kept: Train) -> None:
    folder = store.EntryStore(kept("runs", [0])).seed(0)
    rows = folder.epochs()
    folder.table.unlink()
    folder.lines.write_bytes(b"".join(store.json_line(row.content) for row in (rows[0], rows[2])))
    with pytest.raises(StoreError, match="epoch 2 is missing"):
        folder.read()


def test_a_truncated_table_and_a_damaged_checkpoint_are_named(kept: Train) -> None:
    entry = store.EntryStore(kept("runs", [0], 1))
    folder = entry.seed(0)
    for content in (b"", b"PAR1", b"not parquet at all", b"\0" * 100):
        folder.table.write_bytes(content)
        with pytest.raises(StoreError, match=r"epochs\.parquet is not a readable parquet file"):
            folder.read()
    (path,) = entry.groups.glob("*/checkpoint.safetensors")
    for content in (b"", b"\xff" * 20, b"\x10\0\0\0\0\0\0\0{}              "):
        path.write_bytes(content)
        with pytest.raises(StoreError, match="is damaged"):
            checkpoint.headers(entry)


def test_a_finished_run_without_checkpoint_is_not_started_again(train: Train) -> None:
    entry = store.EntryStore(train("runs", [0]))
    before = entry.seed(0).table.read_bytes()
    for path in entry.groups.glob("*/checkpoint.safetensors"):
        path.unlink()
    with pytest.raises(StoreError, match="its checkpoint is gone: it cannot be extended"):
        train("runs", [0], 6)
    assert entry.seed(0).table.read_bytes() == before


def test_two_workers_never_share_a_seed(kept: Train) -> None:
    entry = store.EntryStore(kept("runs", [0, 1]))
    claim = acquire(entry, [1, 2])
    with pytest.raises(SeedsClaimedError, match=r"1 of these seeds \(from 2\) are being trained by process"):
        acquire(entry, [2, 3])
    acquire(entry, [3, 4]).release()
    claim.release()
    assert living(entry) == []
    acquire(entry, [2, 3]).release()


def test_the_claim_of_a_dead_process_is_taken_over(train: Train) -> None:
    entry = store.EntryStore(train("runs", [0]))
    claim = acquire(entry, [0])
    content = json.loads(claim.path.read_text())
    claim.path.write_text(json.dumps({**content, "started": "another process of the same number"}))
    assert living(entry) == []
    acquire(entry, [0]).release()
    assert not claim.refresh(), "a holder whose claim was taken over finds out"


def test_seeds_are_parsed() -> None:
    texts = {"3": [0, 1, 2], "2:4": [2, 3], "0,3,10:12": [0, 3, 10, 11], "5,1": [1, 5]}
    assert {text: parse_seeds(text) for text in texts} == texts


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "-1",
        "3:1",
        "1,1",
        "1:",
        "0",
        "2.5",
        "9" * 11,
        "9" * 400,
        "9" * 5000,
        "1" * 40,
        f"5:{'9' * 11}",
    ],
)
def test_seeds_that_are_none(text: str) -> None:
    with pytest.raises(OptionError, match="seed"):
        parse_seeds(text)


@given(st.sets(st.integers(0, 40) | st.integers(0, 10**6), min_size=1))
def test_format_seeds_is_the_inverse_of_parse_seeds(seeds: set[int]) -> None:
    assert parse_seeds(format_seeds(sorted(seeds))) == sorted(seeds)


def test_groups_are_even_and_keep_epochs_apart(kept: Train) -> None:
    entry = store.EntryStore(kept("runs", [0, 1], 2))
    groups = plan_groups(entry, range(10), 5, workers=2)
    assert [(g.seeds, g.epoch) for g in groups] == [((2, 3, 4, 5), 0), ((6, 7, 8, 9), 0), ((0, 1), 2)]
    assert plan_groups(entry, [0, 1], 2, workers=2) == []


def test_a_folder_that_cannot_be_written_or_is_not_there_gives_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"cannot write .*: Not a directory; the old file is unchanged"):
        store.write_atomically(tmp_path / "file" / "x.json", b"{}")
    with pytest.raises(QrlSuiteError, match="there is no results folder"):
        store.entries(tmp_path / "none")


def test_a_torn_line_of_timings_costs_nothing(train: Train) -> None:
    path = train("runs", [0, 1], 1)
    seed = store.EntryStore(path).seed(0)
    with seed.timings.open("ab") as file:
        file.write(b'{"epoch": 2, "tr')
    train("runs", [0, 1], 2)
    assert [line["epoch"] for line in store.read_lines(seed.timings)] == [1, 2]
    assert seed.seconds() > 0


def test_a_deleted_folder_of_a_seed_starts_again(train: Train) -> None:
    """As messages advise, although the group's checkpoint holds its agent."""
    path = train("runs", [0, 1], 2)
    kept = store.EntryStore(path)
    before = results(path, 1)
    shutil.rmtree(kept.seed(1).path)
    assert [(group.seeds, group.epoch) for group in plan_groups(kept, [0, 1], 2, 1)] == [((1,), 0)]
    train("runs", [0, 1], 2)
    assert results(path, 1) == before


def test_neither_a_record_nor_a_checkpoint_stands_for_epochs_that_are_gone(train: Train) -> None:
    seed = store.EntryStore(train("runs", [0], 2)).seed(0)
    seed.table.unlink()
    with pytest.raises(StoreError, match="finished 2 epochs and holds 0: restore the file or delete"):
        seed.read()
    with pytest.raises(StoreError, match="holds 0 epochs, its checkpoint 2: restore the file, or delete"):
        train("runs", [0], 3)


def test_means_of_float32_scores_reach_what_the_scores_reach() -> None:
    curve = store.SeedRun(0, None, np.full((1, 100), 0.95, np.float32), 0.0, 0).curve
    assert np.asarray(curve).tolist() == [0.95]


def test_core_seconds_are_processor_time_where_it_was_recorded(kept: Train) -> None:
    seed = store.EntryStore(kept("runs", [0], 2)).seed(0)
    lines = store.read_lines(seed.timings)
    assert [line["epoch"] for line in lines] == [1, 2]
    assert seed.seconds() == pytest.approx(sum(float(line["cpu"]) for line in lines))
    assert not seed.read().clocked
    seed.timings.write_text(
        '{"train": 2.0, "validate": 1.0, "cpu": 0.5}\n{"train": 3.0, "validate": 1.0}\n', encoding="utf-8"
    )
    assert seed.seconds() == 4.5, "an older version's epoch counts by the clock"
    assert seed.read().clocked
    seed.timings.write_text('{"train": 2.0, "validate": 1.0, "cpu": -1}\n', encoding="utf-8")
    with pytest.raises(StoreError, match=r"timings\.jsonl, line 1 is not a record of times: cpu = -1: "):
        seed.seconds()


def test_the_recorded_version_is_that_of_the_code_that_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: "0.0.1")  # an editable installation from before
    assert provenance.collect(["tomli-w"]).versions == {
        **dict.fromkeys([*provenance.PACKAGES, "tomli-w"], "0.0.1"),
        "qrlsuite": qrlsuite.__version__,
    }


def test_an_entry_shows_once_what_made_all_its_seeds(kept: Train) -> None:
    entry = kept("runs", [0, 1, 2], epochs=1)
    shown = answer("show", entry.name, "--runs", str(entry.parents[1]))
    record = store.EntryStore(entry).record()
    assert (shown["label"], shown["seeds"]) == (record.label, 3)
    [origin] = shown["provenance"]
    assert origin["versions"]["qrlsuite"] == qrlsuite.__version__


def test_means_are_rounded_to_what_float32_scores_hold() -> None:
    """Seven decimals; small scores keep seven digits, but for the noise of larger ones that cancel."""
    scores = np.array([[0.95] * 100, [1e-9, 3e-9] * 50, [0.1, 0.2, -0.3, 0.0] * 25], np.float32)
    assert store.learning_curve(scores).tolist() == [0.95, 2e-9, 0.0]
    assert settled(np.array([6 / 11, 0.0, -2 / 3e9, 1e-310])).tolist() == [
        0.5454545,
        0.0,
        -6.666667e-10,
        0.0,
    ]
    tiny = 7.993605777301127e-17  # 10.0 ** 23 of numpy differs in the last bit from processor to processor
    assert settled(np.array([tiny])).tolist() == [7.993606e-17]
