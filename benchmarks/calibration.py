"""How often each rule declares a winner where there is none, and how often it finds one where there is.

    OPENBLAS_NUM_THREADS=1 python benchmarks/calibration.py [--draws 1000]

What `qrlsuite calibrate` measures on one's own entries, here on the two networks whose curves the tests keep (30
runs each of an MLP of width 64 and one of width 16), on the 49 cells of the surface grid; and besides, what few
runs do to S_hat, what intervals of unequal numbers of runs would do. The tables of
docs/statistics.md are its output.
"""

from __future__ import annotations

import argparse
import gzip
import json
from pathlib import Path

import numpy as np

from qrlsuite.leaderboard import calibration
from qrlsuite.leaderboard.findings import tables
from qrlsuite.statistics import (
    Grid,
    IntervalRule,
    LearningCurves,
    SmoothedRuns,
    bootstrap_interval,
    sample_complexity,
)

CURVES = Path(__file__).parents[1] / "tests" / "golden" / "statistics.json.gz"
RULES = (IntervalRule(),)


def own_intervals(model: SmoothedRuns, n_first: int, n_second: int, grid: Grid, pairs: int) -> float:
    """Return how often there is a winner if each entry keeps the interval of its own number of runs."""
    generator, contradictions = np.random.default_rng(0), 0
    deltas = [float(delta) for delta in grid.deltas]
    for _ in range(pairs):
        first, second = (
            bootstrap_interval(
                model.draw(n, generator).values,
                Grid.relative(grid.epsilons or (), deltas),
                model.entry.steps_per_epoch,
            )
            for n in (n_first, n_second)
        )
        fewer, more = first[..., 1] < second[..., 0], first[..., 0] > second[..., 1]
        contradictions += bool(fewer.any() != more.any())
    return contradictions / pairs


def print_bias(entry: LearningCurves, draws: int) -> None:
    """Print the mean S_hat of entries of few and many runs, in thousands of steps."""
    model, generator = SmoothedRuns(entry), np.random.default_rng(0)
    deltas = [0.5, 0.75, 0.9]
    for n_runs in (5, 10, 20, 50, 100, 1000):
        estimates = [
            sample_complexity(
                model.draw(n_runs, generator).values,
                Grid.relative([0.2], deltas),
                entry.steps_per_epoch,
            )[0]
            for _ in range(draws)
        ]
        means = " | ".join(f"{value / 1000:.1f}" for value in np.mean(estimates, axis=0))
        print(f"| {entry.name} | {n_runs} | {means} |", flush=True)


def print_tables(jobs: list[calibration.Job], cells: int, board: int) -> None:
    """Compute and print tables in markdown, as `qrlsuite calibrate` shows them."""
    for sentence, rows in tables([job.run() for job in jobs], cells, board):
        print(f"\n{sentence}\n")
        for k, row in enumerate(rows):
            print(f"| {' | '.join(row)} |" + (f"\n|{'---|' * len(row)}" if k == 0 else ""), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--draws", type=int, default=1000, help="pairs; for power a fifth, for boards a tenth"
    )
    arguments = parser.parse_args()
    draws = arguments.draws
    with gzip.open(CURVES) as file:
        cases = json.load(file)
    grid = Grid.relative(cases[0]["epsilons"], cases[0]["deltas"])
    entries = [LearningCurves(np.array(c["curves"]), c["steps_per_epoch"], c["name"]) for c in cases]

    print("| network | runs | delta .5 | delta .75 | delta .9 |\n|---|---|---|---|---|")
    for entry in entries:
        print_bias(entry, draws)

    numbers = [(20, 20), (50, 50), (100, 100), (10, 40), (25, 50), (30, 100)]
    print_tables(calibration.plan(entries, grid, RULES, draws, ["pairs"], numbers), grid.size, 0)

    print("\n| network | runs | a winner, each entry keeping its own interval |\n|---|---|---|")
    for entry in entries:
        for sizes in numbers[3:]:
            rate = own_intervals(SmoothedRuns(entry), *sizes, grid, draws)
            print(f"| {entry.name} | {sizes[0]}, {sizes[1]} | {rate:.1%} |", flush=True)

    for board in (5, 10):
        print_tables(
            calibration.plan(entries, grid, RULES, 2 * draws // 5, ["boards"], [(100, 100)], board),
            grid.size,
            board,
        )
    for n_runs in (20, 50, 100):
        jobs = calibration.plan(entries, grid, RULES, draws // 5, ["power"], [(n_runs, n_runs)])
        print_tables(jobs, grid.size, 0)


if __name__ == "__main__":
    main()
