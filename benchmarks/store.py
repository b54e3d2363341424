"""What storing and checkpointing cost: shares of one run of an MLP with 100 seeds.

    python benchmarks/store.py [--seeds 100] [--epochs 5] [--task beam6g] [--runs DIR]

Clocks around the runner's own steps count the processor seconds of one training in this process, which other work on
the same cores does not stretch, and which leave out the wait for the disk: *record* (a line per seed and
epoch), *capture* (copying the state after every epoch), *save* (forcing lines to the disk, writing the checkpoint),
*finish* (trained agents, tables, records; once per run). A run saves every minute, or after every epoch that takes
longer; so the share is given per minute of a long run, from the seconds that each step took. Target: under 3 percent.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qrlsuite.experiment.entry import resolve
from qrlsuite.results.store import EntryStore
from qrlsuite.training import group
from qrlsuite.training.group import GroupRun
from qrlsuite.training.trainer import Trainer

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
    GroupRun(store.entry(), store, range(seeds), epochs).run()
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="beam6g")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--runs", type=Path, help="where to store; default: a temporary folder")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(
            json.dumps(
                measure(arguments.task, arguments.seeds, arguments.epochs, arguments.runs or Path(folder)),
                indent=1,
            )
        )


if __name__ == "__main__":
    main()
