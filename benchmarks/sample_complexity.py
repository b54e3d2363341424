"""Speed of the statistics: one entry's bootstrap against a Python loop over resamples, and a board of 500.

    OPENBLAS_NUM_THREADS=1 python benchmarks/sample_complexity.py [--repeats 7] [--entries 500]

Everything is measured in turn in one run and given as medians; trust the ratios more than the times. The
bootstrap is 1000 resamples of 100 runs x 100 epochs on the 49 cells of the surface grid; the loop does the same
arithmetic with numpy, one resample at a time. The board's time goes from curves to tiers.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np

from qrlsuite.statistics import (
    Grid,
    IntervalRule,
    LearningCurves,
    bootstrap_interval,
    outperformance,
)

EPSILONS = [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4]
DELTAS = [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
GRID = Grid.relative(EPSILONS, DELTAS)
STEPS = 2000


def learning_curves(n_runs: int, seed: int, epochs: int = 100) -> np.ndarray:
    """Return made-up runs, shape (n_runs, epochs), that saturate at different levels and speeds."""
    generator = np.random.default_rng(seed)
    level = generator.normal(generator.uniform(0.7, 0.95), 0.05, (n_runs, 1))
    pace = generator.lognormal(np.log(generator.uniform(8, 30)), 0.5, (n_runs, 1))
    curves = level * (1 - np.exp(-np.arange(1, epochs + 1) / pace))
    return np.clip(curves + 0.04 * generator.standard_normal((n_runs, epochs)), 0, 1)


def loop_over_resamples(curves: np.ndarray, n_resamples: int = 1000) -> np.ndarray:
    """Return percentile intervals, shape (E, D, 2), from one resample after the other."""
    generator = np.random.default_rng(0)
    thresholds = np.array(GRID.thresholds)
    required = GRID.required_counts(len(curves))
    draws = []
    for _ in range(n_resamples):
        sample = curves[generator.integers(0, len(curves), len(curves))]
        counts = (sample >= thresholds[:, None, None]).sum(axis=1)
        draws.append(STEPS * (counts[:, None, :] < required[:, None]).sum(axis=2))
    return np.moveaxis(np.percentile(draws, [5, 95], axis=0), 0, -1)


def median_seconds(repeats: int, *functions: Callable[[], object]) -> list[float]:
    """Return the median time of each function, called in turn so that all see the same machine."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for function, taken in zip(functions, times):
            start = time.perf_counter()
            function()
            taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in times]


def board_seconds(entries: Sequence[LearningCurves]) -> float:
    """Return the median time from curves to tiers."""
    return median_seconds(3, lambda: outperformance(entries, GRID, IntervalRule()).ranking)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7, help="measurements of the bootstrap (boards: 3)")
    parser.add_argument("--entries", type=int, default=500, help="entries on the board")
    arguments = parser.parse_args()

    curves = learning_curves(100, seed=0)
    fast, slow = median_seconds(
        arguments.repeats,
        lambda: bootstrap_interval(curves, Grid.relative(EPSILONS, DELTAS), STEPS),
        lambda: loop_over_resamples(curves),
    )
    print("1000-fold bootstrap, 49 cells, 100 runs x 100 epochs")
    print(f"  here                      {1e3 * fast:8.1f} ms")
    print(f"  a loop over resamples     {1e3 * slow:8.1f} ms   {slow / fast:.0f} times slower")

    size = arguments.entries
    equal = [LearningCurves(learning_curves(100, k), STEPS, f"entry {k}") for k in range(size)]
    numbers = [20, 30, 50, 100]
    mixed = [
        LearningCurves(learning_curves(numbers[k % len(numbers)], k), STEPS, f"entry {k}")
        for k in range(size)
    ]
    print("from curves to tiers")
    for label, entries in (
        (f"{size} entries of 100 runs, intervals", equal),
        (f"{size} entries of 20 to 100 runs, intervals", mixed),
    ):
        print(f"  {label:45} {board_seconds(entries):8.2f} s")


if __name__ == "__main__":
    main()
