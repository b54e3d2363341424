"""The regret of a real search, measured by one ten times as large: `python benchmarks/regret.py --runs DIR`.

Each network below is tuned until the search states a regret of 5 percent. A search ten times as large follows: five
times as many seeds for each trial, and twice as many trials, without an earlier end. The settings of both are trained
on 200 seeds that neither search has seen. The difference of their steps below threshold is the regret, with a 95%
interval. It is measured against the best that the large search found, so it is a lower bound of the regret against the
best there is. About an hour of one core. A repeated call continues.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qrlsuite import api
from qrlsuite.engine.worker import train_group
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.store import EntryStore
from qrlsuite.statistics import Grid
from qrlsuite.statistics.times import times_below
from qrlsuite.tuning.search import Search

NETWORKS = (
    ("vqe-h2", "mlp width=6", None, (2e-4, 1e-2), (0.3, 30)),
    ("vqe-h2", "mlp width=6 activation=sin", None, (2e-4, 1e-2), (0.3, 30)),
    ("cartpole", "reinforce mlp width=8", 50, (2e-3, 2e-1), (0.1, 10)),
)
"""Task, network, epochs (None takes the task's), and the ranges of learning rate and gain, as in the studies."""

# As a file: these two options are varied, and none of those that models and algorithms name for tuning.
VARIED = """
format_version = 1

[search.all.all]
lr = {{ low = {}, high = {}, log = true }}
input_scale = {{ low = {}, high = {}, log = true }}
"""
FIRST_SEED = 1_100_000
SEEDS = 200


@dataclass(frozen=True)
class Network:
    """What is tuned, and below which folder."""

    task: str
    model: str
    epochs: int | None
    lr: tuple[float, float]
    gain: tuple[float, float]
    runs: Path

    def searched(self, folder: str, sampler: str = "bayesian", seeds: int | None = None) -> Search:
        """Return a finished search."""
        runs = self.runs / folder
        runs.mkdir(parents=True, exist_ok=True)
        varied = runs / f"varied-{self.task}.toml"
        varied.write_text(VARIED.format(*self.lr, *self.gain))
        [search] = api.tune(
            self.task, self.model, vary=str(varied), sampler=sampler, seeds=seeds, epochs=self.epochs,
            runs=runs, workers=1, progress=False,
        )  # fmt: skip
        return search

    def fresh_times(self, entry: Entry) -> tuple[float, float]:
        """Return the mean steps of an entry on fresh seeds, and their standard error."""
        store = EntryStore.create(self.runs / "fresh", entry)
        seeds = list(range(FIRST_SEED, FIRST_SEED + SEEDS))
        train_group(store.path, seeds, self.epochs or entry.task.epochs(entry.algorithm.name))
        curves = np.array([store.seed(seed).read().curve for seed in seeds])
        grid = Grid.relative(entry.task.file.ranking.epsilons, [0.5])
        times = times_below(curves, grid, entry.task.file.protocol.interactions).mean(axis=1)
        return float(times.mean()), float(times.std(ddof=1) / len(times) ** 0.5)


def main() -> None:
    """Print a row for each network."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, default=Path("regret"), help="the results folder")
    runs = parser.parse_args().runs
    print("| task | network | runs | it says | runs of the large search | it says | measured regret (95%) |")
    print("|---|---|---|---|---|---|---|")
    for task, model, *given in NETWORKS:
        network = Network(task, model, *given, runs)
        small = network.searched("small")
        trials = 2 * math.ceil(small.runs_done / 4 / 2)
        large = network.searched("large", f"bayesian regret=.0001 trials={trials}", 20)
        entries = [search.best.entry for search in (small, large) if search.best]
        (own, error), (best, error_best) = map(network.fresh_times, entries)
        reach = 1.96 * math.hypot(error / own, error_best / best) * (entries[0].hash != entries[1].hash)
        low, middle, high = (math.expm1(math.log(own / best) + sign * reach) for sign in (-1, 0, 1))
        says = [search.as_dict()["regret"]["expected"] for search in (small, large)]
        print(
            f"| `{task}` | {model} | {small.runs_done} | {says[0]:.1%} | {large.runs_done} | {says[1]:.1%} "
            f"| {middle:.1%} ({low:.1%} to {high:.1%}) |",
            flush=True,
        )


if __name__ == "__main__":
    main()
