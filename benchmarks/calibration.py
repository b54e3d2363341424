"""How often each rule declares a winner where there is none, and how often it finds one where there is.

    python benchmarks/calibration.py [--pairs 1000] [--boards 200] [--jitter 0.3]

Draws runs from smoothed models of the two networks whose curves the tests keep (30 runs each of an MLP of width
64 and one of width 16), on the 49 cells of the surface grid. The tables of docs/statistics.md are its output.
"""

from __future__ import annotations

import argparse
import gzip
import json
from pathlib import Path

import numpy as np

from qrlsuite.statistics import (
    DifferenceRule,
    Grid,
    IntervalRule,
    LearningCurves,
    Resampling,
    SmoothedRuns,
    board_false_winners,
    bootstrap_interval,
    false_winners,
    power,
    sample_complexity,
)

CURVES = Path(__file__).parents[1] / "tests" / "golden" / "statistics.json.gz"
RULES = (IntervalRule(), DifferenceRule())


def slower(entry: LearningCurves, factor: float) -> LearningCurves:
    """Return runs that take `factor` times as long to get as far."""
    epochs = np.arange(1, entry.values.shape[1] + 1)
    values = np.array([np.interp(epochs / factor, epochs, run) for run in entry.values])
    return LearningCurves(values, entry.steps_per_epoch, f"{entry.name}, {factor} times slower")


def own_intervals(model: SmoothedRuns, n_first: int, n_second: int, grid: Grid, pairs: int) -> float:
    """Return how often there is a winner if each entry keeps the interval of its own number of runs."""
    generator, found = np.random.default_rng(0), 0
    deltas = [float(delta) for delta in grid.deltas]
    for _ in range(pairs):
        first, second = (
            bootstrap_interval(
                model.draw(n, generator).values, grid.epsilons or (), deltas, model.entry.steps_per_epoch
            )
            for n in (n_first, n_second)
        )
        fewer, more = first[..., 1] < second[..., 0], first[..., 0] > second[..., 1]
        found += bool(fewer.any() != more.any())
    return found / pairs


def print_bias(entry: LearningCurves, jitter: float, draws: int) -> None:
    """Print the mean S_hat of entries of few and many runs, in thousands of steps."""
    model, generator = SmoothedRuns(entry, jitter), np.random.default_rng(0)
    deltas = [0.5, 0.75, 0.9]
    for n_runs in (5, 10, 20, 50, 100, 1000):
        found = [
            sample_complexity(model.draw(n_runs, generator).values, [0.2], deltas, entry.steps_per_epoch)[0]
            for _ in range(draws)
        ]
        means = " | ".join(f"{value / 1000:.1f}" for value in np.mean(found, axis=0))
        print(f"| {entry.name} | {n_runs} | {means} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--boards", type=int, default=200)
    parser.add_argument("--jitter", type=float, default=0.3)
    arguments = parser.parse_args()
    with gzip.open(CURVES) as file:
        cases = json.load(file)
    grid = Grid.relative(cases[0]["epsilons"], cases[0]["deltas"])
    entries = [LearningCurves(np.array(c["curves"]), c["steps_per_epoch"], c["name"]) for c in cases]

    print("| network | runs | delta .5 | delta .75 | delta .9 |\n|---|---|---|---|---|")
    for entry in entries:
        print_bias(entry, arguments.jitter, arguments.pairs)

    print("\n| network | runs | rule | a cell, mean | a cell, worst | any cell | a winner |")
    print("|---|---|---|---|---|---|---|")
    for entry in entries:
        model = SmoothedRuns(entry, arguments.jitter)
        for sizes in ((20, 20), (50, 50), (100, 100), (10, 40), (25, 50), (30, 100)):
            for rule in RULES:
                rates = false_winners(model, *sizes, grid, rule, arguments.pairs)
                cells = rates.per_cell
                print(
                    f"| {entry.name} | {sizes[0]}, {sizes[1]} | {rule.name} | {cells.mean():.2%} "
                    f"| {cells.max():.1%} | {rates.any_cell:.1%} | {rates.winner:.1%} |",
                    flush=True,
                )

    print("\n| network | runs | a winner, each entry keeping its own interval |\n|---|---|---|")
    for entry in entries:
        for sizes in ((10, 40), (25, 50), (30, 100)):
            rate = own_intervals(SmoothedRuns(entry, arguments.jitter), *sizes, grid, arguments.pairs)
            print(f"| {entry.name} | {sizes[0]}, {sizes[1]} | {rate:.1%} |", flush=True)

    print("\n| network | board of equals | rule | boards with a winner |\n|---|---|---|---|")
    for entry in entries:
        model = SmoothedRuns(entry, arguments.jitter)
        for size in (5, 10):
            for rule in RULES:
                rate = board_false_winners(model, [100] * size, grid, rule, arguments.boards)
                print(f"| {entry.name} | {size} entries of 100 runs | {rule.name} | {rate:.1%} |", flush=True)

    print(
        "\nten entries of 100 runs, rule difference with alpha = .05 / 45 pairs, 10,000 resamples, 40 boards:"
    )
    for entry in entries:
        model, strict = SmoothedRuns(entry, arguments.jitter), DifferenceRule(alpha=0.05 / 45)
        rate = board_false_winners(model, [100] * 10, grid, strict, 40, resampling=Resampling(10_000))
        print(f"{entry.name}: {rate:.1%}", flush=True)

    print("\n| network | slower by | runs | rule | found |\n|---|---|---|---|---|")
    for entry in entries:
        for factor in (1.1, 1.25, 1.5):
            other = SmoothedRuns(slower(entry, factor), arguments.jitter)
            for n_runs in (20, 50, 100):
                for rule in RULES:
                    model = SmoothedRuns(entry, arguments.jitter)
                    rates = power(model, other, n_runs, n_runs, grid, rule, max(1, arguments.pairs // 5))
                    print(
                        f"| {entry.name} | {factor - 1:.0%} | {n_runs} | {rule.name} | {rates.first_wins:.0%} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
