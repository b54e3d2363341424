"""How far from the best a search ends: its real regret, and what it says of it, on surfaces whose optimum is known.

    OPENBLAS_NUM_THREADS=1 python benchmarks/tuning.py [--options 6] [--repetitions 200] [--runs 150 300 600]

A surface gives the mean steps of settings. Its logarithm is a bowl with a random optimum, up to 15 percent outside
of the ranges; an option at half its range from there costs 22 percent in the middle, some far more, some nearly
nothing, and they interact (`Surface`). Far away it levels off, where nothing is learned; ripples of 2 percent lie on
all of it. Runs scatter by 28 percent. Three searches get equally many runs: `random` on 20 seeds each, successive
halving over seeds, which was the default once, and today's. All of them try the untuned setting, which lies anywhere.

    python benchmarks/tuning.py --stored runs/tuning [--repetitions 100] [--out FILE.png]

In place of drawn surfaces, those of stored searches: the surrogate's mean after all trials of a search, with runs
that scatter as its own. A search with a last round is repeated on each until it states 5 percent, or has 40 trials an
option, and what it says is held against the surface. That is smoother than what was searched, so coverage is rather
too good. Further tables (--repetitions 0: these alone) say how many more steps a model needs when an option moves by a
factor of 2 from its best value, which --out draws for other factors, and what one setting for all tasks costs it.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import math
import os
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.stats import qmc

from qrlsuite import notation, options
from qrlsuite.experiment import preset
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.results.store import entries
from qrlsuite.statistics.times import times_below
from qrlsuite.tuning.bayesian import FINALISTS, LAST_SEEDS, PER_OPTION
from qrlsuite.tuning.samplers import LAST, REGRET
from qrlsuite.tuning.surrogate import BATCH, NEAR, SPREAD, Climb, Surrogate, regret_among, variances

Floats = NDArray[np.float64]
VISIT = 4
SEEDS = 20
COLORS = {"circuit": "C0", "mean-field": "C1", "network": "C2", "sines": "C3"}


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


def measured(found: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
    """Return mean, spread in units of the mean, and number of the runs of each place."""
    means = np.array([each.mean() for each in found])
    spreads = np.array([each.std(ddof=1) for each in found]) / means
    return means, spreads, np.array([len(each) for each in found], float)


def visit(search: Climb, surface: Surface | Stored, found: dict[int, Floats]) -> None:
    """Run the places that a search wants next, and tell it of all runs so far."""
    for number in search.next():
        drawn = surface.runs(search.tried[number], VISIT)
        found[number] = np.concatenate([found.get(number, np.empty(0)), drawn])
    search.tell([*found], *measured([*found.values()]))


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
            visit(search, surface, found)
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


class Stored:
    """The surface of a stored search; its preset file lies beside its trials."""

    def __init__(self, path: Path) -> None:
        found = preset.load(path)
        record = found.tuning
        assert record is not None
        space = record.space or {}
        self.varied, self.ends = [*space], np.log([[ends["low"], ends["high"]] for ends in space.values()])
        entry = resolve(
            record.task or "", notation.parse_entry(f"{found.algorithm} {found.model} preset={path}")
        )
        _, fixed = self._split(entry)
        grid, steps = entry.task.file.ranking.grid, entry.task.file.protocol.interactions
        control = dict(found.model_options.get("ansatz_options") or {}).get("entangled")
        network = "sines" if found.model_options.get("activation") == "sin" else "network"
        self.task, self.model = record.task, network if found.model == "mlp" else control or "circuit"
        tried, runs = [], []
        for store in entries(path.parent, record.task):
            identity = store.record().identity
            if (identity.algorithm, identity.model) != (found.algorithm, found.model):
                continue
            place, own = self._split(store.entry())
            if own != fixed:
                continue
            search = [seed for seed in store.seeds() if seed < preset.TUNING_SEEDS + LAST_SEEDS]
            if len(done := store.finished(search, record.epochs or 1)) >= VISIT:
                curves = np.array([store.seed(seed).read().curve[: record.epochs] for seed in sorted(done)])
                runs.append(times_below(curves, grid, steps).mean(axis=1))
                tried.append(place)
        numbers = measured(runs)
        noise = variances(*numbers) / numbers[2]
        self.surrogate = Surrogate(np.array(tried), np.log(numbers[0]) + noise / 2, noise)
        many = numbers[2] >= min(2 * VISIT, numbers[2].max())
        self.sources = [(at, own / own.mean()) for at, own, kept in zip(tried, runs, many) if kept]
        low, high = np.min(tried, axis=0), np.max(tried, axis=0)
        places = np.array([*tried, *(low + (high - low) * qmc.Halton(len(low), seed=0).random(4000))])
        self.best = places[int(self(places).argmin())]
        self.least = float(self(self.best[None])[0])
        self.generator = np.random.default_rng(0)

    def _split(self, entry: Entry) -> tuple[Floats, object]:
        """Return the place of an entry's varied options, and all that stays."""
        sides = {"algorithm": entry.algorithm_options, "model": entry.model_options}
        own = {f"{side}.{name}": v for side, each in sides.items() for name, v in options.plain(each).items()}
        return self.place(np.array([own.pop(name) for name in self.varied])), own

    def place(self, values: Floats) -> Floats:
        """Return places, 0 and 1 at the ends of the ranges, of values (..., D)."""
        result: Floats = (np.log(values) - self.ends[:, 0]) / np.diff(self.ends)[:, 0]
        return result

    def __call__(self, places: Floats) -> Floats:
        """Return log mean steps (P,) at places (P, D)."""
        return self.surrogate.means(places)

    def runs(self, place: Floats, count: int) -> Floats:
        """Draw runs that scatter around the surface's mean as those of the nearest setting with several."""
        scatter = min(self.sources, key=lambda source: float(((source[0] - place) ** 2).sum()))[1]
        return math.exp(float(self(place[None])[0])) * self.generator.choice(scatter, count)

    def regret(self, place: Floats) -> float:
        """Return the real regret of a place."""
        return max(0.0, math.exp(float(self(place[None])[0]) - self.least) - 1)

    def moved(self, d: int, factors: Floats) -> Floats:
        """Return how many more steps option d costs at factors (F,) of its best value, as shares (F,).

        Where no setting was tried, the surrogate extrapolates.
        """
        places = np.repeat(self.best[None], len(factors), axis=0)
        places[:, d] += np.log(factors) / np.diff(self.ends)[d]
        result: Floats = np.maximum(0, np.expm1(self(places) - self.least))
        return result

    def repeat(self, number: int) -> list[float]:
        """Return runs; regret, said, inside, below before the last round; among the last, said, inside; regret after.

        Inside: the regret lies in the stated interval; below: it is at most the interval's upper end.
        """
        self.generator = np.random.default_rng([74, number])
        untuned = self.generator.random(len(self.varied))
        search, found = Climb([untuned], extends=lambda d, low, high: False, seed=number), dict[int, Floats]()
        most = PER_OPTION * len(self.varied) * VISIT
        while not (said := search.regret) or (
            said.expected > REGRET and sum(map(len, found.values())) < most
        ):
            visit(search, self, found)
        real = self.regret(search.tried[search.best])
        three = [search.tried[each] for each in search.order[:FINALISTS]]
        last = [self.runs(each, LAST * VISIT) for each in three]
        among = regret_among(*measured(last))
        regrets = [self.regret(each) for each in three]
        after = regrets[int(np.argmin([each.mean() for each in last]))]
        own = (1 + after) / (1 + min(regrets)) - 1
        inside = [each.low - 1e-9 <= at <= each.high + 1e-9 for each, at in ((said, real), (among, own))]
        runs = sum(map(len, found.values()))
        below = real <= said.high + 1e-9
        return [runs, real, said.expected, inside[0], below, own, among.expected, inside[1], after]


def _print_shares(name: str, numbers: Floats) -> None:
    runs, *shares = numbers
    print(f"{name} | {runs:.0f} | {' | '.join(f'{share:.1%}' for share in shares)}", flush=True)


def stored(folder: Path, repetitions: int, out: Path | None) -> None:
    """Print the tables of stored searches, and draw what moving an option costs."""
    searches = [Stored(path) for path in sorted(folder.glob("*.toml"))]
    searches.sort(key=lambda search: [*COLORS].index(search.model))
    if repetitions:
        print(
            "task | model | runs | regret | it says | within 90% | at most its end | "
            "among three | it says | within 90% | after"
        )
        every = []
        with concurrent.futures.ProcessPoolExecutor(os.cpu_count()) as pool:
            for each in searches:
                every.append(np.mean([*pool.map(each.repeat, range(repetitions))], axis=0))
                _print_shares(f"{each.task} | {each.model}", every[-1])
        _print_shares(f"mean of {len(searches)} | {repetitions} repetitions of each", np.mean(every, axis=0))
    groups = defaultdict(list)
    for each in searches:
        groups[each.model, (*each.varied,)].append(each)
    print("\nmodel | option | more steps at half of the best value and at twice it, mean (task by task)")
    for (model, names), group in groups.items():
        for d, name in enumerate(names):
            costs = np.array([each.moved(d, np.array([0.5, 2.0])) for each in group])
            told = ", ".join(f"{each.task} {low:.0%} {high:.0%}" for each, (low, high) in zip(group, costs))
            low, high = costs.mean(axis=0)
            print(f"{model} | {name.split('.')[1]} | {low:.0%} and {high:.0%} ({told})")
    print("\nmodel | one setting for all tasks | more steps than at each task's own")
    for (model, names), group in groups.items():
        ends = np.array([each.ends for each in group])
        low, high = ends[..., 0].min(axis=0), ends[..., 1].max(axis=0)
        values = np.exp(low + (high - low) * qmc.Halton(len(names), seed=0).random(4000))
        costs = np.array([each(each.place(values)) - each.least for each in group])
        at = int(costs.mean(axis=0).argmin())
        setting = " ".join(f"{n.split('.')[1]}={v:.3g}" for n, v in zip(names, values[at]))
        print(
            f"{model} | {setting} | {', '.join(f'{g.task} {math.expm1(c):.0%}' for g, c in zip(group, costs[:, at]))}"
        )
    if out:
        draw(searches, out)


def draw(searches: Sequence[Stored], out: Path) -> None:
    """Draw what factors of the best value of each option cost: a color for each model, a thin line for each task."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    factors = 2 ** np.linspace(-3, 3, 49)
    options = [*dict.fromkeys(name for each in searches for name in each.varied)]
    figure = Figure((3.2 * len(options), 3.6), layout="constrained")
    panels = figure.subplots(1, len(options), squeeze=False, sharey=True)[0]
    for option, axes in zip(options, panels):
        lines = defaultdict(list)
        for each in searches:
            if option in each.varied:
                lines[each.model].append(each.moved(each.varied.index(option), factors))
        for model, found in lines.items():
            [line] = axes.plot(
                factors, np.mean(found, axis=0), color=COLORS[model], linewidth=2.5, label=model
            )
            axes.plot(factors, np.transpose(found), color=line.get_color(), linewidth=0.6, alpha=0.6)
        axes.set_xscale("log", base=2)
        axes.set(xlabel=f"{option.split('.')[1]} / its best value", ylim=(0, 1))
        axes.yaxis.set_major_formatter(PercentFormatter(1))
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize="small")
    panels[0].set_ylabel("more steps than at the best")
    figure.savefig(out, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--options", type=int, default=6)
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--runs", type=int, nargs="+", default=[150, 300, 600])
    parser.add_argument("--width", type=float, default=0.8)
    parser.add_argument("--ripple", type=float, default=0.02)
    parser.add_argument("--shared", type=int, default=0, help="options that take a population of their own")
    parser.add_argument("--stored", type=Path, help="a folder of stored searches, such as runs/tuning")
    parser.add_argument(
        "--out", type=Path, help="draw what stored searches say of moved options to this file"
    )
    arguments = parser.parse_args()
    if arguments.stored:
        stored(arguments.stored, arguments.repetitions, arguments.out)
        return
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
