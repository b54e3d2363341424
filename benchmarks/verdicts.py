"""How long the permutation tests take: a pair, and a board of thirty entries.

    OPENBLAS_NUM_THREADS=1 python benchmarks/verdicts.py [--entries 30] [--runs 100]

Entries are drawn from smoothed models of the two networks whose curves the tests keep, some slower than others, on
the 49 cells of the surface grid. A pair's first judgment makes the relabelings that all later ones share.
"""

from __future__ import annotations

import argparse
import gzip
import json
import time
from pathlib import Path

import numpy as np

from qrlsuite.statistics import (
    Evidence,
    Grid,
    LearningCurves,
    SmoothedRuns,
    TimesRule,
    slower,
    times_board,
)
from qrlsuite.statistics.permutation import relabelings

CURVES = Path(__file__).parents[1] / "tests" / "golden" / "statistics.json.gz"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--entries", type=int, default=30)
    parser.add_argument("--runs", type=int, default=100)
    arguments = parser.parse_args()
    with gzip.open(CURVES) as file:
        cases = json.load(file)
    grid = Grid.relative(cases[0]["epsilons"], cases[0]["deltas"])
    golden = [LearningCurves(np.array(c["curves"]), c["steps_per_epoch"], c["name"]) for c in cases]
    generator = np.random.default_rng(0)
    entries = []
    for index in range(arguments.entries):
        model = SmoothedRuns(slower(golden[index % 2], 1 + 0.1 * (index % 6)))
        drawn = model.draw(arguments.runs, generator)
        entries.append(LearningCurves(drawn.values, drawn.steps_per_epoch, f"{index}"))

    rule = TimesRule()
    relabelings.cache_clear()
    seconds = []
    for first, second in zip(entries[:-2], entries[2:]):
        pair = [Evidence(entry, grid, arguments.runs) for entry in (first, second)]
        begin = time.process_time()
        rule(*pair)
        seconds.append(time.process_time() - begin)
    median, worst = np.median(seconds[1:]), max(seconds[1:])
    print(
        f"a pair, rule {rule.name}: {1000 * median:.1f} ms of one core (median; worst {1000 * worst:.1f}), "
        f"the first {1000 * seconds[0]:.1f} ms"
    )
    pairs = arguments.entries * (arguments.entries - 1) // 2
    begin = time.process_time()
    board = times_board(entries, grid)
    seconds_board = time.process_time() - begin
    decided = int((board.adjusted <= board.alpha).sum()) // 2
    print(
        f"a board of {arguments.entries} by mean times: {seconds_board:.2f} s ({pairs} pairs, {decided} decided)"
    )


if __name__ == "__main__":
    main()
