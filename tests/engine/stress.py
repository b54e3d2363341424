"""Killing `qrlsuite run` and its workers at random moments, again and again.

The test beside this file does it a few times. By hand, at large, with figures:

    python -m tests.engine.stress --kills 200 --forked --epochs 300 --pause 0.6
    python -m tests.engine.stress --kills 20

A kill waits for a worker at work, and then for a random moment: on a busy machine nearly all others hit a process
that is still importing. With `--forked`, supervisors and workers are forks of a process that has imported everything,
and start at once; otherwise both are started as a user starts them. It prints the kills of supervisors and of workers,
how many of the workers had begun to train, and how many epochs were trained again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qrlsuite.results.claims import claims
from qrlsuite.results.store import EntryStore, read_lines
from tests import commands
from tests.commands import Command
from tests.conftest import TINY, results


def words(task: Path, runs: Path, seeds: int, epochs: int, workers: int) -> list[str]:
    command = [sys.executable, "-m", "qrlsuite", "run", "--task", str(task), "--model", "mlp"]
    command += ["--set", "width=16", "--seeds", str(seeds), "--epochs", str(epochs)]
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


def trained_again(entry: Path, seeds: int, epochs: int) -> int:
    """Count the epochs that were lost and trained again: timings keep a line of every one."""
    return sum(len(read_lines(EntryStore(entry).seed(seed).timings)) - epochs for seed in range(seeds))


def finished(runs: Path, seeds: int, epochs: int) -> Path | None:
    for path in runs.glob("tiny/*/entry.json"):
        if len(EntryStore(path.parent).finished(range(seeds), epochs)) == seeds:
            return path.parent
    return None


def start_forked(command: list[str]) -> Command:
    return commands.start(*command[3:], env=environment())


def start(command: list[str]) -> subprocess.Popen[bytes]:
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, env=environment(), stdout=quiet, stderr=quiet)


def disturbed(
    task: Path,
    runs: Path,
    kills: int,
    dice: random.Random,
    seeds: int,
    epochs: int,
    workers: int,
    pause: float,
    start: Callable[[list[str]], Any] = start,
) -> Counter[str]:
    """Start the command again and again, killing it or a worker, until `kills` have hit or everything has finished."""
    killed: Counter[str] = Counter()
    while finished(runs, seeds, epochs) is None and killed["supervisor"] + killed["worker"] < kills:
        run = start(words(task, runs, seeds, epochs, workers))
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
        run.wait()
    return killed


def undisturbed(task: Path, runs: Path, seeds: int, epochs: int, workers: int) -> Path:
    """Run the command to its end; returns the entry's folder."""
    while True:
        assert commands.qrlsuite(*words(task, runs, seeds, epochs, workers)[3:]).returncode == 0
        entry = finished(runs, seeds, epochs)
        if entry is not None:  # else a worker of a killed command was still saving
            return entry


def compare(straight: Path, entry: Path, seeds: int, epochs: int) -> None:
    """Raise AssertionError unless all bytes are equal and every epoch is there once."""
    for seed in range(seeds):
        assert results(straight, seed) == results(entry, seed), f"seed {seed} differs"
        assert [row["epoch"] for row in EntryStore(entry).seed(seed).epochs()] == list(range(1, epochs + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--epochs", type=int, default=150)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--pause", type=float, default=3.0, help="seconds between kills, at most")
    parser.add_argument("--forked", action="store_true", help="start processes by forking")
    given = parser.parse_args()
    dice = random.Random(0)
    total: Counter[str] = Counter()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        task = Path(folder) / "tiny.toml"
        task.write_text(TINY)
        straight = undisturbed(task, Path(folder) / "straight", given.seeds, given.epochs, given.workers)
        while (done := total["supervisor"] + total["worker"]) < given.kills:
            runs = Path(folder) / f"disturbed-{total['runs']}"
            killed = disturbed(
                task,
                runs,
                given.kills - done,
                dice,
                given.seeds,
                given.epochs,
                given.workers,
                given.pause,
                start_forked if given.forked else start,
            )
            entry = undisturbed(task, runs, given.seeds, given.epochs, given.workers)
            compare(straight, entry, given.seeds, given.epochs)
            again = trained_again(entry, given.seeds, given.epochs)
            total += killed + Counter({"runs": 1, "epochs trained again": again})
            print(json.dumps({**total, "seconds": round(time.monotonic() - began)}), flush=True)


if __name__ == "__main__":
    main()
