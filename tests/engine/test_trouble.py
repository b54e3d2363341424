"""What the user sees when the disk is full, the folder read-only, the clock wrong, or somebody else at work."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from qrlsuite.errors import StoreError
from qrlsuite.results import checkpoint, claims, store
from qrlsuite.results.claims import SeedsClaimedError, acquire, living
from qrlsuite.results.store import EntryStore
from qrlsuite.training.group import GroupRun
from tests.commands import qrlsuite, say, start
from tests.conftest import HANGS, TINY, Hold, Train, results
from tests.engine.stress import finished


@pytest.fixture
def words(tiny_task: str) -> list[str]:
    short = TINY.replace("interactions = 60", "interactions = 20").replace("[180]", "[60]")
    Path(tiny_task).write_text(short)
    return ["run", "--task", tiny_task, "--model", "mlp", "--set", "width=16", "--seeds", "2"]


def remount(disk: Path, option: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{option}", str(disk)], check=True)


def only_line(done: subprocess.CompletedProcess[str]) -> str:
    """The one line after the announcement of the run."""
    assert "Traceback" not in done.stderr, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("qrlsuite: ")]
    return line


def test_a_full_disk(disk: Path, words: list[str], train: Train) -> None:
    runs = ["--runs", str(disk / "runs"), "--workers", "1"]
    full = qrlsuite(*words, *runs, "--epochs", "60")
    assert full.returncode == 2
    assert "finished epochs are kept" in only_line(full)
    assert "No space left on device" in only_line(full)
    assert "to free some: qrlsuite runs gc --runs DIR" in only_line(full)
    for command in ("runs", "leaderboard"):
        assert say(command, "--runs", str(disk / "runs")).exit_code == 0
    remount(disk, "size=20m")
    resumed = qrlsuite(*words, *runs, "--epochs", "60")
    assert resumed.returncode == 0, resumed.stderr
    straight, entry = train("straight", [0, 1], 60), finished(disk / "runs", 2, 60)
    assert entry is not None
    for seed in (0, 1):
        assert results(entry, seed) == results(straight, seed)


def test_a_disk_that_is_full_from_the_start(disk: Path, words: list[str]) -> None:
    status = os.statvfs(disk)
    (disk / "filler").write_bytes(b"x" * (status.f_bavail - 1) * status.f_bsize)
    done = qrlsuite(*words, "--runs", str(disk / "runs"), "--epochs", "2")
    assert done.returncode == 2
    assert "cannot write" in only_line(done)
    assert "No space left on device" in only_line(done)


def test_a_read_only_folder(disk: Path, words: list[str]) -> None:
    runs = ["--runs", str(disk / "runs")]
    remount(disk, "size=20m")
    assert qrlsuite(*words, *runs, "--epochs", "2").returncode == 0
    remount(disk, "ro")
    again = qrlsuite(*words, *runs, "--epochs", "2")
    assert again.returncode == 0, "what is there can be asked for without writing"
    more = qrlsuite(*words, *runs, "--epochs", "3")
    assert more.returncode == 2
    assert "cannot write" in only_line(more)
    assert "Read-only file system" in only_line(more)
    other = qrlsuite(*words[:-4], "--set", "width=8", *runs)
    assert other.returncode == 2
    assert "Read-only file system; the old file is unchanged" in only_line(other)
    for command in (["runs"], ["leaderboard"], ["runs", "gc"]):
        assert say(*command, *runs).exit_code == 0
    with pytest.raises(StoreError, match="Read-only file system"):
        say("runs", "gc", "--yes", *runs)


def test_two_commands_at_once(words: list[str], tmp_path: Path, hold: Hold) -> None:
    """Both begin before either has claimed anything; between them, every seed is trained once."""
    command = [*words, "--epochs", "6", "--runs", str(tmp_path / "runs")]
    both = [start(*command, "--workers", w, env=hold.environment) for w in ("1", "2")]
    while all(process.poll() is None for process in both):  # one ends, for the seeds are held by the other
        time.sleep(0.02)
    hold.release()
    said = [process.communicate(timeout=HANGS)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    text = "".join(said)
    assert "are being trained by" in text, text
    assert "Traceback" not in text
    entry = finished(tmp_path / "runs", 2, 6)
    if entry is None:  # one refused a group for a seed of it that the other trained
        assert qrlsuite(*command).returncode == 0
        entry = finished(tmp_path / "runs", 2, 6)
    assert entry is not None
    for seed in (0, 1):
        assert [row.epoch for row in EntryStore(entry).seed(seed).epochs()] == list(range(1, 7))


INTERRUPTED_AT_A_FORK = """
import os, signal, traceback
import torch
sent = []
def send():
    if not sent and "_start" in {frame.name for frame in traceback.extract_stack()}:
        sent.append(os.kill(os.getpid(), signal.SIGTERM))
os.register_at_fork(after_in_parent=send)  # Python loses an exception that is raised here
class Unused(torch.nn.Module):
    def __init__(self, n_inputs, n_outputs):
        super().__init__()
"""


def test_an_interruption_while_a_worker_is_being_started_stops_the_run(
    words: list[str], tmp_path: Path
) -> None:
    plugin = tmp_path / "plugin.py"
    plugin.write_text(INTERRUPTED_AT_A_FORK)
    run = start("--plugin", str(plugin), *words, "--epochs", "100000", "--runs", str(tmp_path / "runs"))
    try:
        assert run.wait(HANGS) == 130
    finally:
        if run.returncode is None:
            run.kill()


@pytest.fixture
def entry(kept: Train) -> EntryStore:
    return EntryStore(kept("runs", [0], 1))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "WATCH", 0.6)


def elsewhere(store: EntryStore, age: float, seeds: tuple[int, ...] = (0,)) -> Path:
    """A claim of another machine, last refreshed `age` seconds ago."""
    store.claims.mkdir(exist_ok=True)
    path = store.claims / "other.json"
    content = {"host": "node17", "pid": 4711, "namespace": "pid:[1]", "started": "1", "token": "other"}
    path.write_text(json.dumps({**content, "seeds": list(seeds)}))
    os.utime(path, (time.time() - age, time.time() - age))
    return path


@pytest.mark.parametrize("age", [0.0, 100.0, -100.0])
def test_another_machines_fresh_claim_is_respected(entry: EntryStore, age: float, quick: None) -> None:
    elsewhere(entry, age)
    with pytest.raises(
        SeedsClaimedError, match=r"process 4711 on node17.*this folder is a copy.*120 seconds after"
    ):
        acquire(entry, [0])
    acquire(entry, [1]).release()


@pytest.mark.parametrize("age", [1000.0, 1e8, -1000.0, -1e8])
def test_a_claim_is_taken_over_unless_it_is_refreshed_whatever_its_time(
    entry: EntryStore, age: float, quick: None
) -> None:
    """The clock jumped: the holder refreshes, with the times of a clock that is wrong."""
    path = elsewhere(entry, age)
    beats = threading.Timer(0.2, lambda: os.utime(path, (time.time() - age + 5, time.time() - age + 5)))
    beats.start()
    with pytest.raises(SeedsClaimedError, match="on node17"):
        acquire(entry, [0])
    beats.join()
    assert path.exists()
    os.utime(path, (time.time() - age, time.time() - age))
    acquire(entry, [0]).release()
    assert not path.exists()


def test_a_claim_of_this_machine_does_not_depend_on_any_clock(entry: EntryStore) -> None:
    claim = acquire(entry, [0])
    for moment in (0.0, 4e9):
        os.utime(claim.path, (moment, moment))
        assert [holder.token for holder in living(entry)] == [claim.token]
    claim.release()
    assert living(entry) == []


@pytest.mark.parametrize(
    "other", [{"namespace": "pid:[1]"}, {"machine": "another boot, another installation"}, {"machine": None}]
)
def test_a_copy_or_a_container_is_judged_like_another_machine(
    other: dict[str, str | None], entry: EntryStore, quick: None
) -> None:
    """A number that is not running here says nothing about its process; earlier versions wrote no machine."""
    claim = acquire(entry, [0])
    content = json.loads(claim.path.read_text()) | other | {"pid": 2**22}
    claim.path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    with pytest.raises(SeedsClaimedError):
        acquire(entry, [0])


def _named(words: Path) -> Iterator[int]:
    """Yield the numbers of the processes whose command line holds `words`."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if str(words).encode() in path.read_bytes():
                yield int(path.parent.name)


def test_two_process_namespaces_of_one_host_name_share_a_folder(
    words: list[str], tmp_path: Path, train: Train, hold: Hold
) -> None:
    """One holds the seeds and is killed, the other goes on; the bytes are those of one process."""
    inside = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"]
    if subprocess.run([*inside, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no process namespace can be made here")
    runs = tmp_path / "shared"
    command = [*inside, sys.executable, "-m", "qrlsuite", *words, "--epochs", "3", "--runs", str(runs)]
    with (tmp_path / "first.txt").open("w") as output:
        first = subprocess.Popen(
            [*command, "--workers", "1"], env=hold.environment, stderr=output, cwd=tmp_path
        )
        hold.wait(first)  # type: ignore[arg-type]
        (claim,) = runs.glob("*/*/claims/*.json")
        said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stderr
        assert "2 seeds are being trained by" in said
        for process in _named(runs):  # a machine ends as a whole: no part tidies up after another
            os.kill(process, signal.SIGSTOP)
        first.kill()
        first.wait()
        while list(_named(runs)):  # what it began ends soon after
            time.sleep(0.05)
    os.utime(claim, (0, 0))  # as when a machine has long been gone
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    straight, entry = train("straight", [0, 1], 3), finished(runs, 2, 3)
    assert entry is not None
    for seed in (0, 1):
        assert results(entry, seed) == results(straight, seed)


@pytest.mark.parametrize(
    ("answers", "epochs", "saved"), [([True, False, False, False], 5, 1), ([True, True, False], 2, 2)]
)
def test_a_worker_whose_seeds_were_taken_over_writes_nothing_more(
    answers: list[bool], epochs: int, saved: int, entry: EntryStore
) -> None:
    """Asked before a line, a checkpoint and the end: what was written before stays, and no seed is finished."""
    held = iter(answers)
    run = GroupRun([(entry.entry(), entry, [0])], epochs, held=lambda: next(held))
    with pytest.raises(StoreError, match="another worker has taken these seeds over"):
        run.run()
    assert len(entry.seed(0).epochs()) == 2
    assert [header.epoch for header in checkpoint.headers(entry)] == [saved]
    assert not entry.seed(0).finished()


def test_lines_of_two_workers_are_put_in_order_when_the_run_goes_on(train: Train) -> None:
    straight = train("straight", [0], 4)
    entry = EntryStore(train("runs", [0], 2))
    folder = entry.seed(0)
    folder.write_record(folder.record().changed(status="running"))
    further = [store.json_line(row.content) for row in EntryStore(straight).seed(0).epochs()[2:]]
    folder.lines.write_bytes(further[0] + further[0] + further[1] + further[1])
    with pytest.raises(StoreError, match="epoch 4 is missing"):
        folder.epochs()
    assert results(train("runs", [0], 4), 0) == results(straight, 0)


def test_a_file_system_that_does_not_answer_for_a_moment(
    entry: EntryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = acquire(entry, [0])

    def stale(path: object, *rest: object) -> None:
        raise OSError(116, "Stale file handle")

    with monkeypatch.context() as patch:
        patch.setattr(os, "utime", stale)
        assert claim.refresh(), "no reason to stop training"
    claim.release()
    assert not claim.refresh(), "a claim that is gone is lost"


def test_a_folder_copied_while_it_was_at_work(words: list[str], tmp_path: Path) -> None:
    """The copy holds a claim of another machine: at first it is respected, and the message says why and how long."""
    assert qrlsuite(*words, "--runs", str(tmp_path / "here"), "--epochs", "2").returncode == 0
    shutil.copytree(tmp_path / "here", tmp_path / "there")
    (path,) = (tmp_path / "there").glob("*/*/entry.json")
    store = EntryStore(path.parent)
    claim = elsewhere(store, age=0.0, seeds=(0, 1))
    more = [*words, "--runs", str(tmp_path / "there"), "--epochs", "3"]
    waits = qrlsuite(*more)
    assert waits.returncode == 0
    assert "2 seeds are being trained by" in waits.stderr
    assert "nothing is left to do here" in waits.stderr
    assert "node17" in say("runs", "--runs", str(tmp_path / "there")).output
    claim.unlink()
    assert qrlsuite(*more).returncode == 0
    assert store.finished([0, 1], 3) == {0, 1}
