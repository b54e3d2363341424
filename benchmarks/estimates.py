"""Compares the time that `qrlsuite run` says is left with what it then takes: ten entries, idle or beside other work.

    python benchmarks/estimates.py [--busy 2] [--only mlp] [--workers 2]

An estimate is judged at the moment at which it is first shown, when the second epoch of a group has ended.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Any

from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.where import Where
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting

ENTRIES = (
    ("beam6g", None, "mlp width=16", 20, 20),
    ("beam6g", None, "mlp width=64", 20, 20),
    ("beam6g", None, "mlp width=256", 20, 12),
    ("beam6g", None, "vqc-native qubits=4", 20, 12),
    ("beam6g", None, "vqc-native qubits=6", 20, 12),
    ("beam6g", None, "vqc-native qubits=8", 10, 10),
    ("beam6g", None, "fourier", 20, 20),
    ("beam6g", "ppo", "mlp", 20, 20),
    ("cartpole", "reinforce", "mlp", 20, 20),
    ("beam6g", None, "vqc-pennylane qubits=3 layers=1", 4, 5),
)
"""Task, algorithm, model with its options, seeds, epochs."""

FACTOR = 1.5


class Watching(RunDisplay):
    """A display that notes when it first knew what is left."""

    said: tuple[float, float] | None = None

    def update(self, snapshot: dict[str, dict[str, Any]]) -> None:
        """Note what is left."""
        super().update(snapshot)
        now = time.monotonic()
        left = self.estimate.remaining(snapshot, now)
        if left is not None and self.said is None:
            self.said = now, left


def measure(task: str, algorithm: str | None, words: str, seeds: int, epochs: int, workers: int) -> str:
    """Train an entry; returns a row of the table."""
    model, *settings = words.split()
    entry = resolve(task, model, algorithm, [parse_setting(word) for word in settings])
    with tempfile.TemporaryDirectory() as folder:
        where = Where.create(workers=workers)
        work = missing.find(Path(folder), entry, where, list(range(seeds)), epochs)
        display = Watching(work, where.workers, quiet=True)
        began = time.monotonic()
        missing.train(work, where, display)
        ended = time.monotonic()
    if display.said is None:
        return f"| {task} | {entry.label} | {seeds} x {epochs} | {ended - began:.0f} s | | | |"
    when, left = display.said
    ratio = left / (ended - when)
    good = "yes" if 1 / FACTOR <= ratio <= FACTOR else "no"
    cells = (f"{ended - began:.0f} s", f"{when - began:.0f} s", f"{left:.0f} s", f"{ratio:.2f}", good)
    return f"| {task} | {entry.label} | {seeds} x {epochs} | {' | '.join(cells)} |"


def _burn() -> None:
    while True:
        sum(range(10_000))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--busy", type=int, default=0, help="processes that keep a core busy beside the training"
    )
    parser.add_argument("--only", default="", help="entries whose model and options contain this text")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    others = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(given.busy)]
    for other in others:
        other.start()
    print("| task | entry | seeds x epochs | took | first said after | said | said / true | within 1.5 |")
    print("|---|---|---|---|---|---|---|---|")
    for task, algorithm, words, seeds, epochs in ENTRIES:
        if given.only in words:
            print(measure(task, algorithm, words, seeds, epochs, given.workers), flush=True)


if __name__ == "__main__":
    main()
