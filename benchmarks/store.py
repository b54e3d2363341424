"""What storing and checkpointing cost: shares of one run of an MLP with 100 seeds, and large experiments.

    python benchmarks/store.py [--seeds 100] [--epochs 5] [--task beam6g] [--runs DIR]
    python benchmarks/store.py --models 20 --seeds 1000 --epochs 100

Clocks around the runner's own steps count the processor seconds of one training in this process, which other work on
the same cores does not stretch, and which leave out the wait for the disk: *record* (a line per seed and
epoch), *capture* (copying the state after every epoch), *save* (forcing lines to the disk, writing the checkpoint),
*finish* (trained agents, tables, records; once per run). A run saves every minute, or after every epoch that takes
longer; so the share is given per minute of a long run, from the seconds that each step took. Target: under 3 percent.

With `--models`, that many models are stored without being trained: their scores are drawn, all else is what a run does.
Then come the claims of 100 processes on one entry, and the commands that read the folder: processor seconds, seconds
by the clock, and most memory.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite.experiment.entry import resolve
from qrlsuite.results import claims
from qrlsuite.results.store import EntryStore
from qrlsuite.training import group
from qrlsuite.training.group import GroupRun
from qrlsuite.training.trainer import Epoch, Trainer

STEPS = {
    "epoch": (Trainer, "train_epoch"),
    "record": (GroupRun, "_record"),
    "capture": (Trainer, "capture"),
    "save": (GroupRun, "_save"),
    "finish": (GroupRun, "_finish"),
}


def clocked(seconds: dict[str, list[float]], name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    def step(self: Any, *arguments: Any) -> Any:
        began = time.process_time()
        try:
            return method(self, *arguments)
        finally:
            seconds[name].append(time.process_time() - began)

    return step


def measure(task: str, seeds: int, epochs: int, runs: Path) -> dict[str, Any]:
    """Train and return seconds per step, shares and sizes."""
    seconds: dict[str, list[float]] = defaultdict(list)
    for name, (owner, method) in STEPS.items():
        setattr(owner, method, clocked(seconds, name, getattr(owner, method)))
    store = EntryStore.create(runs, resolve(task, "mlp"))
    began = time.process_time()
    GroupRun([(store.entry(), store, range(seeds))], epochs).run()
    total = time.process_time() - began
    mean = {name: sum(values) / len(values) for name, values in seconds.items()}
    period = max(group.CHECKPOINT_SECONDS, mean["epoch"])
    per_epoch = mean["record"] + mean["capture"]
    share = per_epoch / (mean["epoch"] + per_epoch) + max(seconds["save"]) / period
    return {
        "seeds": seeds,
        "epochs": epochs,
        "total_seconds": total,
        "seconds_per": {name: round(value, 4) for name, value in mean.items()},
        "checkpoint_megabytes": sum(p.stat().st_size for p in store.groups.glob("*/*.safetensors")) / 1e6,
        "percent_of_this_run": 100 * sum(sum(seconds[name]) for name in STEPS) / total,
        "percent_of_a_long_run": 100 * share,
    }


WATCH = """
import json, resource, subprocess, sys, time
began = time.perf_counter()
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([status, used.ru_utime + used.ru_stime, time.perf_counter() - began, used.ru_maxrss]))
"""
"""Runs a command from a small process: a child's memory is at least that of the process that it was forked from."""


def drawn_epoch(trainer: Trainer) -> Epoch:
    """Return an epoch without training: scores that rise at a rate of each seed's own."""
    trainer.epoch += 1
    rates = 0.002 + 0.01 * np.random.default_rng(trainer.seeds).random(trainer.S)
    noise = np.random.default_rng([trainer.epoch, *trainer.seeds]).normal(0, 0.05, (trainer.S, trainer.V))
    scores = np.clip((0.4 + rates * trainer.epoch)[:, None] + noise, 0, 1)
    metrics = {name: scores.mean(1) for name in ("loss", "train_return", "train_score")}
    seconds = {"train": 0.0, "validate": 0.0, "cpu": 0.0}
    return Epoch(
        trainer.epoch,
        metrics,
        scores,
        {},
        [{} for _ in trainer.seeds],
        seconds,
        np.zeros(trainer.S, np.bool_),
    )


def store_untrained(models: int, seeds: int, epochs: int, task: str, runs: Path) -> None:
    """Store models that were not trained, in groups of 50 seeds, and print what each part costs."""
    Trainer.train_epoch = drawn_epoch  # type: ignore[method-assign]
    seconds: dict[str, list[float]] = defaultdict(list)
    for name, (owner, method) in STEPS.items():
        setattr(owner, method, clocked(seconds, name, getattr(owner, method)))
    began, clock = time.process_time(), time.perf_counter()
    for model in range(models):
        entry = resolve(task, f"mlp width=16 algorithm.buffer=1 algorithm.lr={1e-4 * (model + 1):g}")
        store = EntryStore.create(runs, entry)
        for first in range(0, seeds, 50):
            GroupRun([(entry, store, range(first, min(first + 50, seeds)))], epochs).run()
    total, clock = time.process_time() - began, time.perf_counter() - clock
    files = [path.stat().st_size for path in runs.rglob("*") if path.is_file()]
    each = models * seeds
    print(f"{each} seeds of {epochs} epochs: {1e3 * total / each:.1f} ms of a processor and "
          f"{1e3 * clock / each:.1f} ms by the clock each, {len(files) / each:.1f} files, "
          f"{sum(files) / each / 1e3:.1f} kB")  # fmt: skip
    shares = ", ".join(f"{name} {1e3 * sum(values) / each:.2f}" for name, values in seconds.items())
    print(f"ms of a processor a seed: {shares}", flush=True)


def claim(path: Path, number: int) -> None:
    """Claim seeds of one process, and let them go, five times."""
    store = EntryStore(path)
    for _ in range(5):
        held = claims.acquire(store, [10**6 + number])
        held.refresh()
        held.release()


def claim_together(runs: Path, processes: int) -> None:
    """Print what claims of many processes on one entry cost."""
    path = next(runs.glob("*/*/entry.json")).parent
    began, used = time.perf_counter(), os.times()
    running = [multiprocessing.Process(target=claim, args=(path, number)) for number in range(processes)]
    for each in running:
        each.start()
    for each in running:
        each.join()
    spent = os.times()
    processor = spent.children_user + spent.children_system - used.children_user - used.children_system
    clock = time.perf_counter() - began
    print(
        f"{processes} processes, 5 claims each on one entry: {200 * processor / processes:.1f} ms of a processor and "
        f"{200 * clock / processes:.1f} ms by the clock a claim",
        flush=True,
    )


def command(*words: str) -> None:
    """Run a command of the suite and print its seconds and memory."""
    asked = [sys.executable, "-c", WATCH, sys.executable, "-m", "qrlsuite", *words]
    answer = subprocess.run(asked, stdout=subprocess.PIPE, text=True, check=True).stdout
    status, processor, clock, memory = json.loads(answer)
    problem = f", status {status}" if status else ""
    print(
        f"qrlsuite {words[0]:<12} {processor:7.1f} s of a processor, {clock:7.1f} s by the clock, "
        f"{memory / 1e6:5.2f} GB{problem}",
        flush=True,
    )


def experiment(models: int, seeds: int, epochs: int, task: str, runs: Path) -> None:
    """Store a large experiment, claim in it, and read it."""
    store_untrained(models, seeds, epochs, task, runs)
    claim_together(runs, 100)
    place = ("--runs", str(runs))
    command("runs", *place)
    command("leaderboard", "--task", task, *place)
    command("leaderboard", "--format", "html", "--out", str(runs / "page.html"), "--task", task, *place)
    command(
        "export", "mlp width=16 algorithm.buffer=1 algorithm.lr=0.0001", "--out", str(runs / "one"), *place
    )
    command(
        "run", "mlp width=16 algorithm.buffer=1 algorithm.lr=0.0001", "--task", task, "--seeds", str(seeds),
        "--epochs", str(epochs), *place,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--models", type=int, default=0, help="store so many models without training them")
    parser.add_argument("--task", default="beam6g")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--runs", type=Path, help="where to store; default: a temporary folder")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.models:
            experiment(
                arguments.models,
                arguments.seeds,
                arguments.epochs,
                arguments.task,
                arguments.runs or Path(folder),
            )
            return
        print(
            json.dumps(
                measure(arguments.task, arguments.seeds, arguments.epochs, arguments.runs or Path(folder)),
                indent=1,
            )
        )


if __name__ == "__main__":
    main()
