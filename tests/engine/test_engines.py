"""Engines: registered like everything else, built from options, and free to be anybody's."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from qrlsuite import registry, specs
from qrlsuite.engine import api, local, where, worker
from qrlsuite.engine.local import LocalEngine
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, UnknownNameError
from qrlsuite.options import build as build_options
from qrlsuite.plugins.engines.slurm import SlurmEngine, SlurmOptions, minutes
from qrlsuite.results import checkpoint, survey
from qrlsuite.results.claims import _process_start, acquire
from qrlsuite.results.progress import Progress, ProgressFile
from qrlsuite.results.records import RunRecord
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore, write_json
from tests.commands import answer, qrlsuite, say, start, start_worker
from tests.conftest import Hold, Train, results


def test_engines_enter_by_the_door_of_plugins() -> None:
    assert {"local", "slurm"} <= set(registry.load().names(specs.EngineSpec))
    assert isinstance(where.build("local", {}), LocalEngine)
    with pytest.raises(UnknownNameError, match="unknown engine 'lokal'; did you mean 'local'"):
        where.build("lokal", {})
    with pytest.raises(OptionError, match="engine 'local' has no options, got partition"):
        where.build("local", {"partition": "x"})


def test_a_missing_package_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(QrlSuiteError, match=r"needs the package 'submitit': pip install submitit"):
        where.build("slurm", {})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("90", 90),
        (90, 90),
        ("2:00:00", 120),
        ("1:30", 2),
        ("1-12", 2160),
        ("1-12:30", 2190),
        ("1-00:00:01", 1441),
    ],
)
def test_time_limits_are_read_as_slurm_reads_them(text: object, expected: int) -> None:
    assert minutes(text) == expected


@pytest.mark.parametrize("text", ["", "soon", "1:2:3:4", "-5", "0", "0:30", "1h"])
def test_times_that_are_none(text: str) -> None:
    with pytest.raises(OptionError, match=r"engine 'slurm': time = .*: (write minutes|a task needs)"):
        build_options(SlurmOptions, {"time": text}, "engine 'slurm'")


def test_slurm_that_is_not_there(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit", reason="pip install '.[slurm]'")
    store = EntryStore(train("runs", [0], 1))
    monkeypatch.setenv("PATH", "")
    engine = SlurmEngine(SlurmOptions())
    with pytest.raises(QrlSuiteError, match="there is no SLURM on this machine"):
        engine.run([api.Work(store, [SeedGroup((1,), 0)], 2, 1)], lambda snapshot: None)
    assert engine.queued(store) == set(), "without a submission nobody is asked"
    write_json(
        store.path / "slurm" / "submitted.json", {"tasks": [{"job": "1_0", "seeds": [3], "epochs": 2}]}
    )
    with pytest.raises(QrlSuiteError, match="squeue is not found"):
        engine.queued(store)
    (store.path / "slurm" / "submitted.json").write_text('{"format_version": 1, "tasks": 3}')
    with pytest.raises(StoreError, match="is damaged: delete it"):
        engine.queued(store)


def test_what_is_queued_is_left_to_the_queue(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    store = EntryStore(train("runs", [0], 1))
    tasks = [{"job": "7_0", "seeds": [1, 2]}, {"job": "7_1", "seeds": [3]}, {"job": "6", "seeds": [4]}]
    write_json(store.path / "slurm" / "submitted.json", {"tasks": tasks})
    answer = subprocess.CompletedProcess([], 0, stdout="7_1\n8_0\n6\n", stderr="")
    monkeypatch.setattr(subprocess, "run", lambda *arguments, **options: answer)
    assert SlurmEngine(SlurmOptions()).queued(store) == {3, 4}


def test_a_worker_started_twice_does_no_harm(train: Train) -> None:
    entry = train("runs", [0, 1])
    before = {seed: results(entry, seed) for seed in (0, 1)}
    stamps = {path: path.stat().st_mtime_ns for path in entry.glob("seed-*/*")}
    worker.train_group(entry, [0, 1], 3)
    assert stamps == {path: path.stat().st_mtime_ns for path in entry.glob("seed-*/*")}
    worker.train_group(entry, [0, 1, 2], 3)  # a part has finished: only the rest is trained
    assert before == {seed: results(entry, seed) for seed in (0, 1)}
    assert results(train("alone", [2]), 2) == results(entry, 2)


def test_a_worker_whose_parent_is_gone_does_not_begin(kept: Train) -> None:
    entry = kept("runs", [0], 1)
    words = (str(entry), "--seeds", "0:1", "--epochs", "2", "--follow-parent", str(os.getpid()))
    assert start_worker(*words).wait() == 130, "its parent is the process that it was forked from"
    assert EntryStore(entry).finished([0], 2) == set()


def test_the_time_between_checkpoints_is_checked(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = train("runs", [0], 1)
    monkeypatch.setenv("QRLSUITE_CHECKPOINT_SECONDS", "often")
    assert worker.main([str(entry), "--seeds", "0:1", "--epochs", "2"]) == 2


def test_local_workers_are_as_many_as_cores_or_as_asked() -> None:
    assert LocalEngine().workers(None) == len(os.sched_getaffinity(0))
    assert LocalEngine().workers(7) == 7


@pytest.mark.parametrize(("free", "most"), [(0, 1), (1 << 50, 2)])
def test_a_group_begins_where_it_fits_beside_the_first(
    free: int, most: int, train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It needs what the first one has had in memory after its first rounds."""
    monkeypatch.setattr(local, "available_memory", lambda: free)
    store, engine, seen = EntryStore(train("runs", [9], 1)), LocalEngine(), list[tuple[int, bool]]()

    def show(snapshot: api.Snapshot) -> None:
        seen.append((len(engine._running), any(state.get("memory") for state in snapshot.values())))
        if sum(measured for _, measured in seen) > 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        engine.run([api.Work(store, [SeedGroup((0, 1), 0), SeedGroup((2, 3), 0)], 1_000_000, 2)], show)
    assert {running for running, measured in seen if not measured} == {1}
    assert max(running for running, _ in seen) == most


def test_the_memory_of_the_process_that_started_a_worker_is_not_the_workers() -> None:
    ballast = b"\1" * (600 << 20)
    code = "from qrlsuite.results import progress; print(progress.most_memory())"
    run = subprocess.run(
        [sys.executable, "-c", code], preexec_fn=local._ignore_warnings, stdout=subprocess.PIPE, check=True
    )
    assert int(run.stdout) < len(ballast)


def test_half_as_many_are_trained_at_a_time_after_a_kill_in_the_first_epoch(tmp_path: Path) -> None:
    file, state = ProgressFile(EntryStore(tmp_path), "g"), Progress(size=10, untried=True)
    assert file.size(10) == 10
    file.write(state, force=True)
    assert file.size(10) == 5
    for _ in range(2):
        file.clear(10)
        assert file.size(10) == 5, "another command knows it"
    assert file.size(3) == 3
    state.finished_epoch(1, [0.5], [False])
    file.write(state, force=True)
    assert file.size(10) == 10, "later deaths have other causes"
    for damaged in ("x", -1, None):
        file.path.write_text(json.dumps({"size": damaged, "untried": True}))
        assert file.size(10) == 5


def test_seeds_of_several_entries_are_divided() -> None:
    parts: Any = [("a", "in a", (0, 1, 2)), ("b", "in b", (0, 1))]
    assert list(worker.divided(parts, 5)) == [[("a", "in a", [0, 1, 2]), ("b", "in b", [0, 1])]]
    assert list(worker.divided(parts, 2)) == [
        [("a", "in a", [0, 1])],
        [("a", "in a", [2]), ("b", "in b", [0])],
        [("b", "in b", [1])],
    ]


def test_garbage_is_named_first_then_removed_and_its_seeds_cannot_be_extended(train: Train) -> None:
    entry = train("runs", [0, 1], 2)
    train("runs", [2], 1)
    store = EntryStore(entry)
    store.seed(2).write_record(store.seed(2).record().changed(status="running", epochs=1))
    runs = ("--runs", str(entry.parent.parent))

    def collect(*words: str) -> str:
        return say("runs", "gc", *words, *runs).output

    (listed,) = answer("runs", *runs)
    assert listed["seeds"] == {"finished": 2, "interrupted": 1}
    assert listed["epochs"] == [1, 2]
    before = results(entry, 0)
    assert "would remove 1 checkpoint" in collect()
    assert "cannot get more epochs afterwards" in collect()
    assert len(checkpoint.headers(store)) == 2, "without --yes nothing is removed"
    held = acquire(store, [1])
    assert "nothing to remove" in collect("--yes"), "a group that is being extended keeps its checkpoint"
    held.release()
    assert "freed" in collect("--yes")
    assert [header.seeds for header in checkpoint.headers(store)] == [(2,)], "unfinished groups keep theirs"
    assert results(entry, 0) == before
    assert "nothing to remove" in collect()
    with pytest.raises(StoreError, match="it cannot be extended"):
        train("runs", [0, 1], 3)


def test_status_reads_our_own_files_only(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = train("runs", [0, 1], 1)
    store = EntryStore(entry)
    write_json(entry / "slurm" / "submitted.json", {"tasks": [{"job": "9_3", "seeds": [5, 6], "epochs": 3}]})
    store.seed(1).write_record(RunRecord(seed=1, **store.names, status="running", epochs=1))
    claim = acquire(store, [0])
    monkeypatch.setattr(subprocess, "run", lambda *arguments, **options: pytest.fail("it asked a queue"))
    found = {group.state: group for group in survey.groups(store)}
    assert found["running"].seeds == (0,)
    assert str(os.getpid()) in found["running"].where
    assert (found["submitted"].seeds, found["submitted"].where) == ((5, 6), "job 9_3")
    assert found["stopped"].seeds == (1,)
    claim.release()


def test_a_seed_that_waits_to_be_trained_further_is_not_interrupted(kept: Train) -> None:
    store = EntryStore(kept("runs", [0, 1], 1))
    for seed in (0, 1):
        store.seed(seed).write_record(RunRecord(seed=seed, **store.names, status="running", epochs=1))
    write_json(store.path / "slurm" / "submitted.json", {"tasks": [{"job": "9", "seeds": [1], "epochs": 3}]})
    assert survey.look(store).seeds == {"interrupted": 1, "submitted": 1}
    assert survey.look(store, queued=[]).seeds == {"interrupted": 2}, "it has left the queue"


def test_status_tells_what_waits_from_what_has_left_the_queue(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Task 9_1 was canceled before it began: only SLURM can know."""
    pytest.importorskip("submitit", reason="pip install '.[slurm]'")
    entry = train("runs", [0], 1)
    tasks = [{"job": "9_0", "seeds": [5, 6], "epochs": 3}, {"job": "9_1", "seeds": [7], "epochs": 3}]
    write_json(entry / "slurm" / "submitted.json", {"tasks": tasks})
    squeue = tmp_path / "bin" / "squeue"
    squeue.parent.mkdir()
    squeue.write_text("#!/bin/sh\necho 9_0\n")
    squeue.chmod(0o755)

    command = ("runs", "--runs", str(entry.parent.parent))
    monkeypatch.setenv("PATH", str(squeue.parent))
    (row,) = answer(*command)
    assert row["seeds"] == {"submitted": 2, "interrupted": 1, "finished": 1}
    assert row["queue_problem"] is None
    assert [(group["state"], group["seeds"]) for group in row["groups"]] == [
        ("submitted", [5, 6]),
        ("stopped", [7]),
    ]
    assert "job 9_1 has left the queue  continued by the same `qrlsuite run`" in say(*command).output
    squeue.unlink()
    (row,) = answer(*command)
    assert row["seeds"] == {"submitted": 3, "finished": 1}, "our own files are believed"
    assert "squeue is not found" in row["queue_problem"]
    assert "seeds may have left it: there is no SLURM on this machine" in say(*command).output


def test_squeue_is_asked_once_for_many_entries(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    store = EntryStore(train("runs", [0], 1))
    write_json(store.path / "slurm" / "submitted.json", {"tasks": [{"job": "7_0", "seeds": [1]}]})
    asked = []

    def squeue(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        return subprocess.CompletedProcess([], 0, stdout="7_0\n", stderr="")

    monkeypatch.setattr(subprocess, "run", squeue)
    engine = SlurmEngine(SlurmOptions())
    assert [engine.queued(store) for _ in range(50)] == [{1}] * 50
    assert len(asked) == 1


def test_groups_that_failed_alike_are_named_together() -> None:
    failed = {"b": "no such device", "a": "no such device", "c": "another reason"}
    with pytest.raises(QrlSuiteError) as caught:
        api.raise_failures(api.EngineOutcome(failed=failed))
    assert str(caught.value) == (
        "3 group(s) failed, finished epochs are kept: groups a, b: no such device; group c: another reason"
    )
    api.raise_failures(api.EngineOutcome())


def test_cores_are_counted_where_the_system_does_not_say_which_may_be_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert local.usable_cores() == len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    assert local.usable_cores() == os.cpu_count()


def test_a_process_is_told_from_a_later_one_where_there_is_no_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(path: Path) -> str:
        raise FileNotFoundError(path)

    monkeypatch.setattr(Path, "read_text", missing)
    assert re.search(r"\d\d:\d\d:\d\d", _process_start(os.getpid()) or "")  # when this process began, by `ps`
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    assert _process_start(gone.pid) is None


WITHOUT_LINUX = """
import ctypes
import os
import pathlib

del os.sched_getaffinity
read, link = pathlib.Path.read_text, os.readlink


def hidden(path):
    if str(path).startswith("/proc"):
        raise FileNotFoundError(path)


def read_text(self, *given, **named):
    hidden(self)
    return read(self, *given, **named)


def readlink(path, *given, **named):
    hidden(path)
    return link(path, *given, **named)


class Library(ctypes.CDLL):
    def __getattr__(self, name):
        if name == "prctl":
            raise AttributeError(name)
        return super().__getattr__(name)


pathlib.Path.read_text, os.readlink, ctypes.CDLL = read_text, readlink, Library
"""
"""Loaded with the plugins of a command: what Linux has and other systems, macOS among them, do not."""


def test_a_killed_run_goes_on_where_the_system_lacks_what_linux_has(
    hold: Hold, tiny_task: str, train: Train, tmp_path: Path
) -> None:
    plugin = hold.site / "holding.py"
    plugin.write_text(WITHOUT_LINUX + plugin.read_text())
    runs = tmp_path / "runs"
    command = ["run", "--task", tiny_task, "--model", "mlp"]
    command += ["--set", "width=16", "--seeds", "1", "--epochs", "3", "--runs", str(runs)]
    first = start(*command, env=hold.environment)
    hold.wait(first)
    (entry,) = (runs / "tiny").iterdir()
    first.kill()  # nothing tells the worker that its parent is gone: it looks, saves and gives the seed back
    first.wait()
    while list((entry / "claims").glob("*.json")):
        time.sleep(0.05)
    hold.release()
    second = qrlsuite(*command, env=hold.environment)
    assert second.returncode == 0, second.stderr
    assert results(entry, 0) == results(train("alone", [0]), 0)
