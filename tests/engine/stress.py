"""Killing `qrlsuite run` and its workers at random moments, again and again."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections import Counter
from pathlib import Path

from qrlsuite.results.claims import claims
from qrlsuite.results.store import EntryStore
from tests import commands
from tests.conftest import results

ENTRY = "mlp width=16"


def words(task: Path, runs: Path, seeds: int, epochs: int, workers: int, trained: str) -> list[str]:
    command = ["run", trained, "--task", str(task), "--seeds", str(seeds), "--epochs", str(epochs)]
    return [*command, "--workers", str(workers), "--runs", str(runs), "--json"]


def environment() -> dict[str, str]:
    """Return the environment of the commands: checkpoints so far apart that a kill finds lines newer than the last."""
    return {**os.environ, "QRLSUITE_CHECKPOINT_SECONDS": "0.3"}


def children(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def training(runs: Path) -> set[int]:
    """Return the processes that hold a claim."""
    return {claim.pid for path in runs.glob("tiny/*/entry.json") for claim in claims(EntryStore(path.parent))}


def finished(runs: Path, seeds: int, epochs: int) -> Path | None:
    for path in runs.glob("tiny/*/entry.json"):
        if len(EntryStore(path.parent).finished(range(seeds), epochs)) == seeds:
            return path.parent
    return None


def disturbed(
    task: Path,
    runs: Path,
    kills: int,
    dice: random.Random,
    seeds: int,
    epochs: int,
    workers: int,
    pause: float,
    trained: str = ENTRY,
) -> Counter[str]:
    """Start the command again and again, killing it or a worker, until `kills` have hit or everything has finished."""
    killed: Counter[str] = Counter()
    while finished(runs, seeds, epochs) is None and killed["supervisor"] + killed["worker"] < kills:
        run = commands.start(*words(task, runs, seeds, epochs, workers, trained), env=environment())
        killed["starts"] += 1
        while run.poll() is None and killed["supervisor"] + killed["worker"] < kills:
            while run.poll() is None and not training(runs) & set(children(run.pid)):
                time.sleep(0.01)
            time.sleep(dice.uniform(0, pause))
            victims = children(run.pid)
            if dice.random() < 0.2 or not victims:
                victims = [run.pid]
            victim = dice.choice(victims)
            if run.poll() is None:
                at_work = victim in training(runs)
                with contextlib.suppress(ProcessLookupError):  # it has just finished
                    os.kill(victim, signal.SIGKILL)
                    killed["at work"] += at_work
                    killed["supervisor" if victim == run.pid else "worker"] += 1
        if run.poll() is None:
            run.send_signal(signal.SIGTERM)  # its workers save and end with it
        assert run.wait() != 2 or killed["worker"], "the command was refused"
    return killed


def undisturbed(task: Path, runs: Path, seeds: int, epochs: int, workers: int, trained: str = ENTRY) -> Path:
    """Run the command to its end; returns the entry's folder."""
    while True:
        assert commands.qrlsuite(*words(task, runs, seeds, epochs, workers, trained)).returncode == 0
        entry = finished(runs, seeds, epochs)
        if entry is not None:  # else a worker of a killed command was still saving
            return entry


def compare(straight: Path, entry: Path, seeds: int, epochs: int) -> None:
    """Raise AssertionError unless all bytes are equal and every epoch is there once."""
    for seed in range(seeds):
        assert results(straight, seed) == results(entry, seed), f"seed {seed} differs"
        assert [row.epoch for row in EntryStore(entry).seed(seed).epochs()] == list(range(1, epochs + 1))
