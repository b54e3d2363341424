"""How often each rule declares a winner where there is none, and how often it finds one where there is.

    OPENBLAS_NUM_THREADS=1 python benchmarks/calibration.py [ENTRY ...] [--rule NAME] [--draws 1000]

On entries of one task, published or in ./runs, or without any on the two networks whose curves the tests keep (30 runs
each of an MLP of width 64 and one of width 16): random halves of their real runs, pairs and boards of simulated equals,
and simulated entries that are slower. Without entries also: what few runs do to S_hat, and what intervals of unequal
numbers of runs would do. The tables of docs/error-rates.md about `width64` and `width16` are its output.
"""

from __future__ import annotations

import argparse
import gzip
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from simulated import Rates, board_false_winners, power, split_halves

from qrlsuite import api
from qrlsuite.leaderboard import rules
from qrlsuite.leaderboard.boards.ranked import learning_curves
from qrlsuite.statistics import (
    Grid,
    LearningCurves,
    SignificanceRule,
    SmoothedRuns,
    bootstrap_interval,
    sample_complexity,
    slower,
)

CURVES = Path(__file__).parents[1] / "tests" / "golden" / "statistics.json.gz"
SIZES = [(20, 20), (50, 50), (100, 100), (10, 40), (25, 50), (30, 100)]


def kept() -> tuple[list[LearningCurves], Grid]:
    """Return the two networks whose curves the tests keep, and the surface grid."""
    with gzip.open(CURVES) as file:
        cases = json.load(file)
    grid = Grid.relative(cases[0]["epsilons"], cases[0]["deltas"])
    return [LearningCurves(np.array(c["curves"]), c["steps_per_epoch"], c["name"]) for c in cases], grid


def read(names: Sequence[str], task: str | None) -> tuple[list[LearningCurves], Grid]:
    """Return entries of one task, cut to one horizon, and the task's grid."""
    entries = [api.load(name, task=task, published=True) for name in names]
    if len({entry.task_hash for entry in entries}) > 1:
        raise SystemExit("the entries belong to several tasks: choose one with --task")
    curves = [replace(learning_curves(entry), name=entry.label) for entry in entries]
    horizon = min(entry.horizon for entry in curves)
    return [entry.cut(horizon) for entry in curves], entries[0].task_file.ranking.grid


def own_intervals(model: SmoothedRuns, n_first: int, n_second: int, grid: Grid, pairs: int) -> float:
    """Return how often there is a winner if each entry keeps the interval of its own number of runs."""
    generator, contradictions = np.random.default_rng(0), 0
    for _ in range(pairs):
        first, second = (
            bootstrap_interval(model.draw(n, generator).values, grid, model.entry.steps_per_epoch)
            for n in (n_first, n_second)
        )
        fewer, more = first[..., 1] < second[..., 0], first[..., 0] > second[..., 1]
        contradictions += bool(fewer.any() != more.any())
    return contradictions / pairs


def print_bias(entry: LearningCurves, draws: int) -> None:
    """Print the mean S_hat of entries of few and many runs, in thousands of steps."""
    model, generator = SmoothedRuns(entry), np.random.default_rng(0)
    grid = Grid.relative([0.2], [0.5, 0.75, 0.9])
    for n_runs in (5, 10, 20, 50, 100, 1000):
        estimates = [
            sample_complexity(model.draw(n_runs, generator).values, grid, entry.steps_per_epoch)[0]
            for _ in range(draws)
        ]
        line(entry.name, n_runs, *(f"{value / 1000:.1f}" for value in np.mean(estimates, axis=0)))


def line(*cells: object) -> None:
    print(f"| {' | '.join(str(cell) for cell in cells)} |", flush=True)


def head(title: str, *columns: str) -> None:
    print(f"\n{title}\n")
    line(*columns)
    print("|" + "---|" * len(columns), flush=True)


def shown(rates: Rates, *winners: float) -> list[str]:
    """Return the cells of a line: different in a cell on average and in the worst one, in any; and with a winner."""
    cells = rates.per_cell
    return [f"{cells.mean():.2%}, {cells.max():.1%}", *(f"{rate:.1%}" for rate in (rates.any_cell, *winners))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("entries", nargs="*", metavar="ENTRY")
    parser.add_argument("--task")
    parser.add_argument("--rule", action="append", metavar="NAME", help="default: intervals and times")
    parser.add_argument(
        "--draws", type=int, default=1000, help="pairs; a fifth for halves and power, a tenth for boards"
    )
    arguments = parser.parse_args()
    draws, names = arguments.draws, arguments.entries
    entries, grid = read(names, arguments.task) if names else kept()
    judges: list[SignificanceRule] = [rules.load(name) for name in arguments.rule or ("intervals", "times")]
    bounds = (0.0, 1.0) if grid.epsilons is not None else None
    models = [SmoothedRuns(entry, bounds=bounds) for entry in entries]
    each = [(model, rule) for model in models for rule in judges]

    if not names:
        head(f"Mean of S_hat, {draws} entries", "network", "runs", "delta .5", "delta .75", "delta .9")
        for entry in entries:
            print_bias(entry, draws)
        head(f"A winner if each keeps its own interval, {draws} pairs", "network", "runs", "a winner")
        for model in models:
            for sizes in SIZES[3:]:
                rate = own_intervals(model, *sizes, grid, draws)
                line(model.entry.name, "{}, {}".format(*sizes), f"{rate:.1%}")

    columns = ("entry", "runs", "rule", "cell, worst", "any cell")
    splits = max(1, draws // 5)
    head(f"Random halves of real runs, {splits} splits: every winner is false", *columns, "a winner")
    for model, rule in each:
        rates = split_halves(model.entry, grid, rule, splits)
        line(model.entry.name, "{}, {}".format(*rates.n_runs), rule.name, *shown(rates, rates.winner))

    head(f"Simulated equals, {draws} pairs: every winner is false", *columns, "a winner")
    for model, rule in each:
        for sizes in SIZES:
            rates = power(model, model, *sizes, grid, rule, draws)
            line(model.entry.name, "{}, {}".format(*sizes), rule.name, *shown(rates, rates.winner))

    boards = max(1, draws // 10)
    head(f"Boards of simulated equals, {boards} each", "entry", "board", "rule", "boards with a winner")
    for model, rule in each:
        for size in (5, 10):
            rate = board_false_winners(model, [100] * size, grid, rule, boards)
            line(model.entry.name, f"{size} entries of 100 runs", rule.name, f"{rate:.1%}")

    pairs = max(1, draws // 5)
    head(f"One entry takes longer, {pairs} pairs", *columns, "slower by", "found", "wrong direction")
    for model, rule in each:
        for factor in (1.1, 1.25, 1.5):
            late = SmoothedRuns(slower(model.entry, factor), bounds=bounds)
            for n_runs in (20, 50, 100):
                rates = power(model, late, n_runs, n_runs, grid, rule, pairs)
                cells, anywhere, first, second = shown(rates, rates.first_wins, rates.second_wins)
                line(model.entry.name, n_runs, rule.name, cells, anywhere, f"{factor - 1:.0%}", first, second)


if __name__ == "__main__":
    main()
