"""What trackers cost: processor time to begin and end a run, and for each epoch of it.

    python benchmarks/trackers.py [--runs 50] [--epochs 20]

The time of W&B's service, a process of its own, is counted too.
"""

from __future__ import annotations

import argparse
import itertools
import os
import tempfile
from pathlib import Path

from qrlsuite import registry, specs

RUN = {
    **{
        "task": "example",
        "task_hash": "0123456789abcdef",
        "entry": "ddqn-mlp-01234567",
        "label": "ddqn mlp width=64",
    },
    **{"algorithm": "ddqn", "algorithm_options": {"gamma": 0.95}, "model": "mlp", "family": "classical"},
    **{"model_options": {"width": 64}, "parameters": {"classical": 4611, "quantum": 0, "networks": 1}},
    "interactions_per_epoch": 2000,
}
RECORD = {"scores": [0.5, 0.75], "loss": 0.25, "train_return": None, "executions": {"forward": 12}}


def measure(name: str, runs: int, epochs: int) -> tuple[float, float, float]:
    """Return processor seconds of the first run's beginning, of each other run, and of an epoch of a run."""
    with tempfile.TemporaryDirectory() as folder:
        tracker = specs.resolve(registry.get(specs.TrackerSpec, name).factory)(folder)
        every = []
        for seed in range(runs):
            (own := Path(folder, "results", "task", "entry", f"seed-{seed:04d}")).mkdir(parents=True)
            every.append({**RUN, "seed": seed, "folder": str(own), "epochs": 0, "history": []})
        marks = [_seconds()]
        for run in every:
            tracker.run_started(run)
            if run is every[0]:
                marks.append(_seconds())
        marks.append(_seconds())
        for epoch in range(1, epochs + 1):
            for run in every:
                tracker.epoch_finished(run, {**RECORD, "epoch": epoch})
        marks.append(_seconds())
        for run in every:
            getattr(tracker, "run_finished", lambda run: None)(run)
        marks.append(_seconds())
    first, others, logged, ended = (after - before for before, after in itertools.pairwise(marks))
    return first, (others + ended) / (runs - 1), logged / (epochs * runs)


def _seconds() -> float:
    """Return the processor seconds of this process and of those that it started and that live."""
    own = os.times()
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        fields = path.read_text().rpartition(")")[2].split()
        if int(fields[1]) == os.getpid():
            ticks += int(fields[11]) + int(fields[12])
    return own.user + own.system + ticks / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure the built-in trackers one after the other."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--runs", type=int, default=50)
    arguments.add_argument("--epochs", type=int, default=20)
    given = arguments.parse_args()
    for name in ("tensorboard", "wandb", "mlflow"):
        first, run, epoch = measure(name, given.runs, given.epochs)
        print(f"{name:12} first {first:.1f} s, each run {1e3 * run:.0f} ms, each epoch {1e3 * epoch:.2f} ms")


if __name__ == "__main__":
    main()
