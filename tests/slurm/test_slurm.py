"""A real SLURM: `sh tests/slurm/setup.sh` makes one of this machine. Skipped where there is none."""

from __future__ import annotations

import getpass
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.results.claims import claims
from qrlsuite.results.store import EntryStore
from tests.conftest import TINY, Train, results


def _slurm() -> str | None:
    """Why there is no usable SLURM here, None where there is."""
    for program in ("sbatch", "squeue", "sacct", "scancel", "sinfo"):
        if shutil.which(program) is None:
            return f"no SLURM here: {program} is not installed (tests/slurm/setup.sh)"
    try:
        answer = subprocess.run(
            ["sinfo", "-h", "-o", "%T"], capture_output=True, text=True, timeout=10, check=False
        )
    except subprocess.TimeoutExpired:
        return "SLURM does not answer"
    if answer.returncode != 0 or not answer.stdout.strip():
        return "SLURM is installed, but not running (tests/slurm/setup.sh)"
    try:
        import submitit  # noqa: F401
    except ImportError:
        return "submitit is not installed (pip install '.[slurm]')"
    return None


pytestmark = [pytest.mark.long, pytest.mark.skipif(_slurm() is not None, reason=_slurm() or "")]

SEEDS, GROUPS = 8, 8


def run(folder: Path, *words: str, epochs: int, seeds: int = SEEDS) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "qrlsuite", "run", "--task", str(folder / "tiny.toml"), "--model", "mlp"]
    command += ["--set", "width=16", "--seeds", str(seeds), "--epochs", str(epochs), "--workers", str(GROUPS)]
    done = subprocess.run(
        [*command, *words], capture_output=True, text=True, timeout=900, check=False, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return done


def submit(folder: Path, limit: str, epochs: int) -> str:
    answer = run(folder, "--engine", f"slurm time={limit} grace=10", "--json", epochs=epochs)
    words = json.loads(answer.stdout)["submitted"].split()
    return str(words[words.index("job") + 1].rstrip(";"))


def waiting() -> set[str]:
    user = os.environ.get("USER") or getpass.getuser()
    answer = subprocess.run(
        ["squeue", "-h", "-r", "-u", user, "-o", "%i"], capture_output=True, text=True, check=True
    )
    return set(answer.stdout.split())


def until(condition: Callable[[], Any], what: str, seconds: float = 300) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited {seconds:.0f} s until {what}"
        time.sleep(0.3)


def starts(entry: Path, job: str, index: int) -> int:
    """How often submitit started a task, by its log."""
    log = entry / "slurm" / f"{job}_{index}_0_log.out"
    return log.read_text().count("Loading pickle") if log.exists() else 0


def test_a_wrong_partition_is_slurms_own_message(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TINY)
    command = [sys.executable, "-m", "qrlsuite", "run", "--task", "tiny.toml", "--model", "mlp"]
    command += ["--engine", "slurm partition=nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2
    assert "SLURM refused the job" in done.stderr
    assert "invalid partition specified" in done.stderr
    assert "Traceback" not in done.stderr


def longer_than_a_minute(train: Train) -> int:
    """Epochs that take a task about 80 seconds here and now, so that it meets its limit of one minute."""
    store = EntryStore(train("measured", [0], 40))
    return int(80 / (store.seed(0).seconds() / 40))


def test_canceled_killed_and_timed_out_tasks_all_finish_once(tmp_path: Path, train: Train) -> None:
    """Eight groups: one canceled, one killed, one at its time limit; submitted again, everything is there once."""
    (tmp_path / "tiny.toml").write_text(TINY)
    epochs = longer_than_a_minute(train)
    job = submit(tmp_path, "1", epochs)
    entry = next((tmp_path / "runs" / "tiny").iterdir())
    store = EntryStore(entry)

    def worker(seed: int) -> int | None:
        return next((claim.pid for claim in claims(store) if claim.seeds == (seed,)), None)

    until(lambda: worker(0) and worker(1), "two tasks run")
    again = run(tmp_path, "--engine", "slurm", "--json", epochs=epochs)
    assert json.loads(again.stdout)["seeds"] == 0, "what is queued is not submitted twice"
    status = subprocess.run(
        [sys.executable, "-m", "qrlsuite", "runs", "--json"],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    groups = json.loads(status.stdout)[0]["groups"]
    states = [group["state"] for group in groups]
    assert len(states) == GROUPS
    assert "submitted" in states
    assert set(states) <= {"running", "submitted"}

    until(lambda: store.seed(0).lines.exists() and store.seed(1).lines.exists(), "epochs are recorded")
    subprocess.run(["scancel", f"{job}_0"], check=True)
    until(lambda: worker(1), "the second task runs, again where it has reached its limit")
    killed = worker(1)
    assert killed is not None
    os.kill(os.getpgid(killed), 0)
    parent = int(Path(f"/proc/{killed}/stat").read_text().rpartition(")")[2].split()[1])
    os.kill(parent, signal.SIGKILL)  # the task itself; its worker ends with it
    until(
        lambda: worker(0) is None and worker(1) is None,
        "the canceled and the killed worker have saved and ended",
    )
    until(
        lambda: any(starts(entry, job, index) > 1 for index in range(2, GROUPS)),
        "a task reached its limit twice",
    )
    until(lambda: not waiting(), "the queue is empty", 900)

    finished = store.finished(range(SEEDS), epochs)
    assert not finished & {0, 1}, "the canceled and the killed task were not to finish"
    assert finished == set(range(2, SEEDS))
    before = {seed: results(entry, seed) for seed in finished}
    second = submit(tmp_path, "30", epochs)
    assert second != job
    until(lambda: not waiting(), "the queue is empty again", 600)
    assert store.finished(range(SEEDS), epochs) == set(range(SEEDS))
    assert {seed: results(entry, seed) for seed in before} == before, "finished seeds were left alone"
    for seed in range(SEEDS):
        assert [row.epoch for row in store.seed(seed).epochs()] == list(range(1, epochs + 1))

    run(tmp_path, "--runs", "straight", "--workers", "2", epochs=epochs, seeds=3)
    straight = next((tmp_path / "straight" / "tiny").iterdir())
    for seed in (0, 1, 2):
        assert results(straight, seed) == results(entry, seed)
