"""How far from the best a search ends: its real regret, and what it says of it, on surfaces whose optimum is known.

    OPENBLAS_NUM_THREADS=1 python benchmarks/tuning.py [--options 6] [--repetitions 200] [--runs 150 300 600]

A surface gives the mean steps of settings. Its logarithm is a bowl with a random optimum, up to 15 percent outside
of the ranges; an option at half its range from there costs 22 percent in the middle, some far more, some nearly
nothing, and they interact (`Surface`). Far away it levels off, where nothing is learned; ripples of 2 percent lie on
all of it. Runs scatter by 28 percent. Three searches get equally many runs: `random` on 20 seeds each, successive
halving over seeds, which was the default once, and today's. All of them try the untuned setting, which lies anywhere.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import math
import os
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.stats import qmc

from qrlsuite.tuning.samplers import REGRET
from qrlsuite.tuning.surrogate import BATCH, NEAR, SPREAD, Climb

Floats = NDArray[np.float64]
VISIT = 4
SEEDS = 20


class Surface:
    """Log mean steps over places in D ranges, 0 at the optimum."""

    def __init__(self, options: int, generator: np.random.Generator, width: float, ripple: float) -> None:
        self.generator = generator
        self.optimum = generator.uniform(-0.15, 1.15, options)
        widths = np.exp(generator.normal(math.log(width), 0.6, options))
        mixed = np.eye(options) + 0.3 * generator.normal(size=(options, options))
        self.scaled = mixed / np.linalg.norm(mixed, axis=1, keepdims=True) / widths[:, None]
        self.level = generator.uniform(0.8, 1.8)
        self.waves = generator.normal(size=(40, options)) / 0.35
        self.phases = generator.uniform(0, 2 * np.pi, 40)
        self.ripple = ripple * math.sqrt(2 / 40)
        starts = self.optimum + 0.15 * generator.normal(size=(4000, options))
        starts = starts[np.argsort(self(starts))[:2]]
        self.least = min(
            float(optimize.minimize(lambda x: float(self(x[None])[0]), start, method="L-BFGS-B").fun)
            for start in starts
        )

    def __call__(self, places: Floats) -> Floats:
        """Return log mean steps (P,) at places (P, D)."""
        distance = 0.5 * (((places - self.optimum) @ self.scaled.T) ** 2).sum(axis=1)
        bowl = self.level * (1 - np.exp(-distance / self.level))
        result: Floats = bowl + self.ripple * np.cos(places @ self.waves.T + self.phases).sum(axis=1)
        return result

    def runs(self, place: Floats, count: int) -> Floats:
        """Draw the steps of runs."""
        shape = 1 / SPREAD**2
        mean = math.exp(float(self(place[None])[0]))
        return mean * self.generator.gamma(shape, 1 / shape, count)

    def regret(self, place: Floats) -> float:
        """Return the real regret of a place."""
        return math.exp(float(self(place[None])[0]) - self.least) - 1


def climb(
    surface: Surface, untuned: Floats, runs: Sequence[int], seed: int, shared: int
) -> list[list[float]]:
    """Return real regret, and expected regret, 5th and 95th percentile and probability of 3 percent as stated.

    Behind them, populations for each place so far; the runs after which at most 5 percent were stated first, and the
    real regret then; nan before that. The first `shared` options have six values, and places that differ in them train
    apart.
    """

    def snap(place: Floats) -> Floats:
        return np.concatenate([np.round(5 * place[:shared]) / 5, place[shared:]])

    search = Climb([snap(untuned)], snap, seed=seed, shared=range(shared))
    populations, visits = 0, 0
    found: dict[int, Floats] = {}
    results = []
    first = [math.nan, math.nan]
    for most in runs:
        while sum(map(len, found.values())) + VISIT * len(wanted := search.next()) <= most:
            visits += len(wanted)
            populations += len({search.tried[number][:shared].tobytes() for number in wanted})
            for number in wanted:
                drawn = surface.runs(search.tried[number], VISIT)
                found[number] = np.concatenate([found.get(number, np.empty(0)), drawn])
            means = np.array([each.mean() for each in found.values()])
            spreads = np.array([each.std(ddof=1) / each.mean() for each in found.values()])
            search.tell([*found], means, spreads, np.array([len(each) for each in found.values()], float))
            if (
                math.isnan(first[0])
                and search.regret
                and search.regret.expected <= REGRET
                and not search.moved
            ):
                first = [sum(map(len, found.values())), surface.regret(search.tried[search.best])]
        said = search.regret
        assert said is not None
        real = surface.regret(search.tried[search.best])
        results.append([real, said.expected, said.low, said.high, said.near, populations / visits, *first])
    return results


def ladder(settings: int) -> list[tuple[int, int]]:
    """Return settings and seeds of each rung; a third rises, and the last has fresh seeds."""
    rungs = [(settings, SEEDS // 5)]
    while (kept := math.ceil(rungs[-1][0] / 3)) > 3:
        rungs.append((kept, min(SEEDS, 3 * rungs[-1][1])))
    return rungs


def halving(surface: Surface, untuned: Floats, runs: int) -> float:
    """Return the regret of successive halving, whose ranges move after half and three quarters of the settings."""

    def needed(settings: int) -> int:
        rungs = ladder(settings)
        seeds = [0, *(each for _, each in rungs)]
        return sum(c * (s - k) for (c, s), k in zip(rungs, seeds)) + min(3, settings) * SEEDS

    settings = 1
    while needed(settings + 1) <= runs:
        settings += 1
    sequence = qmc.Halton(len(untuned), scramble=False)
    sequence.fast_forward(1)
    low, high = np.zeros(len(untuned)), np.ones(len(untuned))
    places, seen = [untuned], [surface.runs(untuned, SEEDS // 5)]
    for share in (0.5, 0.75, 1.0):
        while len(places) < math.ceil(share * settings):
            places.append(low + (high - low) * sequence.random(1)[0])
            seen.append(surface.runs(places[-1], SEEDS // 5))
        tried, best = np.array(places), places[int(np.argmin([each.mean() for each in seen]))]
        for d, shift in enumerate((high - low) / 2):
            at = (best[d] - low[d]) / (high[d] - low[d])
            side = int(best[d] >= tried[:, d].max() and at > 2 / 3) - int(
                best[d] <= tried[:, d].min() and at < 1 / 3
            )
            low[d], high[d] = low[d] + side * shift, high[d] + side * shift
    alive = list(range(settings))
    for count, seeds in ladder(settings)[1:]:
        alive = sorted(alive, key=lambda i: seen[i].mean())[:count]
        for i in alive:
            seen[i] = np.concatenate([seen[i], surface.runs(places[i], seeds - len(seen[i]))])
    alive = sorted(alive, key=lambda i: seen[i].mean())[:3]
    last = [surface.runs(places[i], SEEDS).mean() for i in alive]
    return surface.regret(places[alive[int(np.argmin(last))]])


def random(surface: Surface, untuned: Floats, runs: int) -> float:
    """Return the regret of the best of random places."""
    places = [untuned, *surface.generator.random((runs // SEEDS - 1, len(untuned)))]
    return surface.regret(places[int(np.argmin([surface.runs(each, SEEDS).mean() for each in places]))])


def repeat(
    number: int, options: int, runs: Sequence[int], width: float, ripple: float, shared: int
) -> Floats:
    """Return, (runs, 10): the three searches' regrets, and what today's says of its own."""
    generator = np.random.default_rng([50, number])
    surface, untuned = Surface(options, generator, width, ripple), generator.random(options)
    mine = climb(surface, untuned, runs, number, shared)
    others = [[random(surface, untuned, most), halving(surface, untuned, most)] for most in runs]
    return np.concatenate([others, mine], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--options", type=int, default=6)
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--runs", type=int, nargs="+", default=[150, 300, 600])
    parser.add_argument("--width", type=float, default=0.8)
    parser.add_argument("--ripple", type=float, default=0.02)
    parser.add_argument("--shared", type=int, default=0, help="options that take a population of their own")
    arguments = parser.parse_args()
    begin = time.monotonic()
    with concurrent.futures.ProcessPoolExecutor(os.cpu_count()) as pool:
        count = arguments.repetitions
        own = arguments.options, arguments.runs, arguments.width, arguments.ripple, arguments.shared
        results = np.array(list(pool.map(repeat, range(count), *([each] * count for each in own))))
    print(f"{arguments.options} options, {count} surfaces, {BATCH} settings at once on {VISIT} seeds each")
    print(
        "runs | random | halving | today's | it says | real within its 90 percent | within 3 percent | it says | "
        "populations"
    )
    for most, each in zip(arguments.runs, results.transpose(1, 0, 2)):
        other, old, real, said, low, high, near, populations, *_ = each.T
        error = real.std(ddof=1) / math.sqrt(count)
        inside = np.mean((low <= real + 1e-9) & (real <= high + 1e-9))
        print(
            f"{most} | {other.mean():.1%} | {old.mean():.1%} | {real.mean():.1%} +- {error:.1%} | {said.mean():.1%} | "
            f"{inside:.0%} | {np.mean(real <= NEAR):.0%} | {near.mean():.0%} | {BATCH * populations.mean():.1f}"
        )
    ended = results[:, -1, -2:]
    ended = ended[~np.isnan(ended[:, 0])]
    at, error = ended[:, 1].mean(), ended[:, 1].std() / math.sqrt(len(ended))
    print(f"{len(ended) / count:.0%} of today's searches state {REGRET:.0%} or less by then,")
    print(
        f"first after {ended[:, 0].mean():.0f} runs on average; their real regret is then {at:.1%} +- {error:.1%}"
    )
    print(f"{time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main()
