"""The regret of a real search, measured by one ten times as large: `python benchmarks/regret.py --runs DIR`.

Each network below is tuned until the search states a regret of 5 percent, or has made its trials. The same search goes
on to ten times as many runs, without stopping earlier. The settings of both are trained on 200 seeds that neither
search has seen, and the difference of their steps below threshold is the regret, with a 95% interval. It is measured
against the best that the large search found, so it is mostly less than the regret against the best there is. Half an
hour of one core; it continues where it stopped.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

from qrlsuite import api
from qrlsuite.engine.worker import train_group
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.store import EntryStore
from qrlsuite.statistics import Grid
from qrlsuite.statistics.times import times_below
from qrlsuite.tuning.search import Search

NETWORKS = (("vqe-h2", "mlp width=6"), ("vqe-h2", "mlp width=16"), ("vqe-h2", "mlp width=6 activation=sin"))
VARIED = {
    "lr": {"low": 2e-4, "high": 1e-2, "log": True},
    "input_scale": {"low": 0.3, "high": 30, "log": True},
}
FIRST_SEED = 1_100_000
SEEDS = 200
VISIT = 4  # seeds of a trial
TIMES = 10


def searched(task: str, model: str, sampler: str, runs: Path) -> Search:
    """Return a finished search."""
    [search] = api.tune(task, model, vary=VARIED, sampler=sampler, runs=runs, workers=1, progress=False)
    return search


def log_mean(entry: Entry, runs: Path) -> tuple[float, float]:
    """Return the logarithm of an entry's mean steps on fresh seeds, and its standard error."""
    store = EntryStore.create(runs, entry)
    seeds = list(range(FIRST_SEED, FIRST_SEED + SEEDS))
    epochs = entry.task.epochs(entry.algorithm.name)
    train_group(store.path, seeds, epochs)
    curves = np.array([store.seed(seed).read().curve for seed in seeds])
    grid = Grid.relative(entry.task.file.ranking.epsilons, [0.5])
    times = times_below(curves, grid, entry.task.file.protocol.interactions).mean(axis=1)
    return math.log(times.mean()), float(times.std(ddof=1) / times.mean() / len(times) ** 0.5)


def main() -> None:
    """Print a row for each network."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, default=Path("regret"), help="the results folder")
    runs = parser.parse_args().runs
    print("| task | network | runs | it says | runs of the large search | measured regret (95%) |")
    print("|---|---|---|---|---|---|", flush=True)
    for task, model in NETWORKS:
        small = searched(task, model, "bayesian", runs / "searches")
        trials = math.ceil(TIMES * small.runs_done / VISIT / len(VARIED))
        large = searched(task, model, f"bayesian regret=.0001 trials={trials}", runs / "searches")
        entries = [search.best.entry for search in (small, large) if search.best]
        (own, error), (best, error_best) = (log_mean(entry, runs / "fresh") for entry in entries)
        reach = 1.96 * math.hypot(error, error_best) * (entries[0].hash != entries[1].hash)
        low, middle, high = (math.expm1(own - best + sign * reach) for sign in (-1, 0, 1))
        measured = f"{middle:.1%} ({low:.1%} to {high:.1%})"
        says = small.as_dict()["regret"]["expected"]
        print(
            f"| {task} | {model} | {small.runs_done} | {says:.1%} | {large.runs_done} | {measured} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
