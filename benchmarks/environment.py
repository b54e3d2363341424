"""Speed of BeamManagement6G: validation epochs in lanes, and against Gymnasium's SyncVectorEnv.

    python benchmarks/environment.py [--repeats 5] [--degree 3]

Everything is measured in turn in one run and given as medians; trust the ratios more than the times. An epoch is
200 steps in every lane with drawing, interpolating and tabulating all trajectories, the next episodes' first
observations included; lanes come in groups of 100 with one random stream each, as a validation epoch has them.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import gymnasium
import numpy as np

from qrlsuite.plugins.environments.beam6g import ID, BeamOptions, make_vector

GROUP = 100
RELEASED_EPOCH = 11.0
"""Seconds of a 100-lane validation epoch with the paper's released code, on a core of a 2-core AMD EPYC."""


def lanes(options: BeamOptions, count: int) -> None:
    """Run one epoch of `count` lanes, random actions."""
    env = make_vector(options, count)
    env.seed_lanes([np.random.default_rng(g) for g in range(count // GROUP)])
    env.reset()
    for row in np.random.default_rng(0).integers(0, 3, (options.steps, count)):
        env.step(row)


def sync(options: BeamOptions, count: int) -> None:
    """Run the same through Gymnasium's own vector environment over single environments."""
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    make = [lambda: gymnasium.make(ID, degree=options.degree) for _ in range(count)]
    env = gymnasium.vector.SyncVectorEnv(make, autoreset_mode=mode)
    env.reset(seed=0)
    for row in np.random.default_rng(0).integers(0, 3, (options.steps, count)):
        env.step(row)


def timed(work: Callable[[], None]) -> float:
    """Return the seconds that `work` takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--degree", type=int, default=3)
    arguments = parser.parse_args()
    options = BeamOptions(degree=arguments.degree)
    jobs: dict[str, tuple[int, Callable[[], None]]] = {
        "lanes, 100": (100, lambda: lanes(options, 100)),
        "lanes, 10,000": (10_000, lambda: lanes(options, 10_000)),
        "SyncVectorEnv, 100": (100, lambda: sync(options, 100)),
    }
    lanes(options, GROUP)  # tables of the physics and of the spline are made once per process
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(arguments.repeats):
        for name, (_, work) in jobs.items():
            times[name].append(timed(work))
    medians = {name: statistics.median(values) for name, values in times.items()}
    print(f"{'':20}{'epoch, ms':>12}{'lane, us':>12}{'steps/s':>14}{'ratio':>9}")
    slow = medians["SyncVectorEnv, 100"] / 100
    for name, (count, _) in jobs.items():
        lane = medians[name] / count
        print(
            f"{name:20}{medians[name] * 1e3:12.1f}{lane * 1e6:12.1f}{options.steps / lane:14,.0f}{slow / lane:9.1f}"
        )
    print(
        f"100 lanes against the released code's {RELEASED_EPOCH:g} s: {RELEASED_EPOCH / medians['lanes, 100']:,.0f}x"
    )


if __name__ == "__main__":
    main()
