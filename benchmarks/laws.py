"""Level, direction and coverage of tests for a difference in mean steps, on generated runs alone: no stored curve.

    OPENBLAS_NUM_THREADS=1 python benchmarks/laws.py [--pairs 2000] [equal | coverage | power | spread]

A run is one number: its mean time below threshold in epochs, from 0 to a horizon of 100 in multiples of 1/2, plus half
an epoch. Four tests of equal means are compared. Three relabel whole runs: Welch's t (`welch`), the log ratio over its
delta-method standard error (`steps`), and the same corrected for skewness by Hall's cubic (`skewed`); `bootstrap`
compares the log ratio's t with its bootstrap distribution. All labelings are enumerated where there are at most 1000,
else 999 are drawn. `spread` tests with Welch's t whether seeds are equally far from their entry's median seed. The
tables of docs/error-rates.md about generators are its output.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import combinations
from math import comb

import numpy as np

HORIZON, DRAWN, LEVEL = 100.0, 999, 0.05
SEEDS = (4, 5, 6, 8, 10, 20, 50, 100)
VARIANTS = ("welch", "steps", "skewed", "bootstrap", "quantile")
Law = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
Moments = tuple[np.ndarray, np.ndarray, np.ndarray]


def lognormal(mean: float, cv: float) -> Law:
    variance = np.log1p(cv * cv)
    return lambda g, shape: mean * np.exp(g.normal(-variance / 2, np.sqrt(variance), shape))


def gamma(mean: float, cv: float) -> Law:
    return lambda g, shape: g.gamma(cv**-2, mean * cv**2, shape)


def normal(mean: float, cv: float) -> Law:
    return lambda g, shape: np.maximum(g.normal(mean, cv * mean, shape), 0)


def two(low: float, high: float, share: float) -> Law:
    return lambda g, shape: np.where(g.random(shape) < share, high, low)


def failing(law: Law, share: float) -> Law:
    return lambda g, shape: np.where(g.random(shape) < share, HORIZON, law(g, shape))


def cut(law: Law) -> Law:
    return lambda g, shape: np.minimum(law(g, shape), HORIZON)


def mean_of(law: Law) -> float:
    return float(law(np.random.default_rng(0), (1_000_000,)).mean())


USUAL, LONG, LATE = lognormal(30, 0.4), lognormal(20, 1.31), cut(lognormal(120, 0.9))
EQUAL_LAWS = {
    "lognormal, cv .4": USUAL,
    "lognormal, sd 1 of the logarithm": LONG,
    "15% of both fail": failing(USUAL, 0.15),
    "half of both at the horizon": cut(lognormal(100, 0.8)),
    "two values": two(10, 40, 0.5),
    "80% at once": two(0, 20, 0.2),
    "all at once": two(0, 0, 0),
    "all at the horizon": two(HORIZON, HORIZON, 0),
}
EQUAL_MEANS = {
    **{
        f"{share:.0%} fail, none of the other": (
            failing(USUAL, share),
            lognormal(mean_of(failing(USUAL, share)), 0.4),
        )
        for share in (0.05, 0.1, 0.15, 0.3)
    },
    "5% fail, at ten times the time": (failing(lognormal(10, 0.4), 0.05), lognormal(14.5, 0.4)),
    "normal, cv .1; lognormal, sd 1": (normal(20, 0.1), LONG),
    "gamma, cv .3; cv .6": (gamma(30, 0.3), gamma(30, 0.6)),
    "lognormal, cv .2; cv .8": (lognormal(30, 0.2), lognormal(30, 0.8)),
    "half at the horizon; normal, cv .1": (LATE, normal(mean_of(LATE), 0.1)),
    "two values; normal, cv .1": (two(10, 70, 0.5), normal(40, 0.1)),
}


def ratios(ratio: float) -> dict[str, tuple[Law, Law]]:
    """Return laws whose means differ by about a ratio; the second is the slower one."""
    return {
        "lognormal, cv .4": (lognormal(15, 0.4), lognormal(15 * ratio, 0.4)),
        "gamma, cv .6; cv .3": (gamma(15, 0.6), gamma(15 * ratio, 0.3)),
        "15% of the slow fail": (lognormal(32 / ratio, 0.4), failing(lognormal(20, 0.4), 0.15)),
        "15% of the fast fail": (failing(lognormal(10, 0.4), 0.15), lognormal(23.5 * ratio, 0.4)),
        "slow ones at the horizon": (lognormal(15, 0.8), cut(lognormal(15 * ratio**1.5, 0.8))),
        "sd 1; normal, cv .1": (lognormal(15, 1.31), normal(15 * ratio, 0.1)),
    }


def moments(rows: np.ndarray, weights: np.ndarray, count: int) -> Moments:
    """Return mean, relative variance of the mean and its relative third cumulant, (rows, columns of weights)."""
    first, second, third = (rows**power @ weights / count for power in (1, 2, 3))
    variance = second - first**2
    skew = third - first * (3 * second - 2 * first**2)
    flat = variance < 1e-12 * second
    variance[flat] = skew[flat] = 0
    return first, variance / (count - 1) / first**2, skew / count**2 / first**3


def t_of(variant: str, ours: Moments, theirs: Moments, truth: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the statistic of a variant: positive where ours are faster than log(theirs / ours) = truth says."""
    if variant == "welch":
        difference = theirs[0] * np.exp(-truth) - ours[0]
        error = np.sqrt(ours[1] * ours[0] ** 2 + theirs[1] * theirs[0] ** 2 * np.exp(-2 * truth))
    else:
        difference, error = np.log(theirs[0]) - np.log(ours[0]) - truth, np.sqrt(ours[1] + theirs[1])
    difference = np.where(np.abs(difference) < 1e-12, 0, difference)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(difference == 0, 0, difference / error)
        if variant == "skewed":
            skewness = (theirs[2] - ours[2]) / error**3
            cubic = t * (1 + skewness * t / 3 + (skewness * t) ** 2 / 27) + skewness / 6
            t = np.where(np.isfinite(cubic), cubic, t)
    return t


def labelings(n_first: int, n_second: int, generator: np.random.Generator) -> np.ndarray:
    """Return which runs are labeled first, one labeling a column; the first column is the observed one."""
    total = n_first + n_second
    if comb(total, n_first) <= DRAWN + 1:
        chosen = np.array(list(combinations(range(total), n_first)))
    else:
        drawn = generator.random((DRAWN, total)).argsort(axis=1)[:, :n_first]
        chosen = np.concatenate([np.arange(n_first)[None], drawn])
    labels = np.zeros((total, len(chosen)))
    labels[chosen.T, np.arange(len(chosen))] = 1
    return labels


def tested(laws: tuple[Law, Law], counts: tuple[int, int], pairs: int, truth: float) -> np.ndarray:
    """Return (variants, 2) shares of pairs that reject a ratio of means: first too fast for it, or too slow.

    Relabeling tests of a ratio other than 1 multiply the first's runs by it: their intervals hold all ratios that are
    not rejected. `quantile` is the simpler interval exp(l - q s) to exp(l + q s), with q from the runs as they are.
    """
    generator = np.random.default_rng([1, *counts])
    labels, result = labelings(*counts, generator), np.zeros((len(VARIANTS), 2))
    boot = [generator.multinomial(n, [1 / n] * n, DRAWN).T.astype(float) for n in counts]
    for _ in range(0, pairs, 250):
        ours, theirs = (
            np.rint(2 * law(generator, (250, n))) / 2 + 0.5 for law, n in zip(laws, counts, strict=True)
        )
        plain, both = (np.concatenate([ours * factor, theirs], axis=1) for factor in (1, truth))
        first = moments(both, labels, counts[0])
        second = moments(both, 1 - labels, counts[1])
        observed = [tuple(each[:, :1] for each in side) for side in (first, second)]
        centers = np.log(observed[1][0] / observed[0][0])
        again = [moments(rows, w, n) for rows, w, n in zip((ours * truth, theirs), boot, counts, strict=True)]
        for place, variant in enumerate(VARIANTS):
            t = t_of(variant, *observed)
            if variant == "bootstrap":
                others = np.concatenate([t, t_of(variant, *again, centers)], axis=1)
            elif variant == "quantile":
                others = t_of(
                    variant, moments(plain, labels, counts[0]), moments(plain, 1 - labels, counts[1])
                )
            else:
                others = t_of(variant, first, second)
            p = (np.abs(others) >= np.abs(t) * (1 - 1e-9)).mean(axis=1, keepdims=True)
            result[place] += [np.sum((p <= LEVEL) & (sign * t > 0)) for sign in (1, -1)]
    return result / (250 * -(-pairs // 250))


def line(*cells: object) -> None:
    shown = (f"{100 * cell:.1f}" if isinstance(cell, float) else str(cell) for cell in cells)
    print(f"| {' | '.join(shown)} |", flush=True)


def head(title: str, *columns: str) -> None:
    print(f"\n{title} (percent)\n\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)


def print_equal(pairs: int) -> None:
    counts = (*((n, n) for n in SEEDS), (20, 100), (100, 20))
    columns = (str(n) if n == m else f"{n}, {m}" for n, m in counts)
    head(f"Equal means, {pairs} pairs: found to differ", "laws", "variant", *columns)
    for name, laws in {**{name: (law, law) for name, law in EQUAL_LAWS.items()}, **EQUAL_MEANS}.items():
        rates = [tested(laws, each, pairs, 1) for each in counts]
        for place, variant in enumerate(VARIANTS[:-1]):
            line(name, variant, *(float(each[place].sum()) for each in rates))


def shifted(law: Law, by: float) -> Law:
    return lambda g, shape: law(g, shape) + by


def as_spread(law: Law) -> Law:
    """Return a normal law whose numbers are as far from its median, on average, as those of a law."""
    drawn = law(np.random.default_rng(0), (1_000_000,))
    return normal(60, float(np.abs(drawn - np.median(drawn)).mean()) * (np.pi / 2) ** 0.5 / 60)


def print_spread(pairs: int) -> None:
    """Print how often equal spreads are found to differ, and one that is twice the other."""
    counts = (*((n, n) for n in SEEDS), (20, 100), (100, 20))
    laws = {name: (law, law) for name, law in EQUAL_LAWS.items()}
    named = {"lognormal, cv .4": USUAL, "lognormal, sd 1": LONG, "5% fail": failing(USUAL, 0.05)}
    laws |= {f"{name}; 40 epochs later": (law, shifted(law, 40)) for name, law in named.items()}
    laws |= {f"{name}; normal": (law, as_spread(law)) for name, law in named.items()}
    laws["normal, cv .1; cv .2 (power)"] = normal(30, 0.1), normal(30, 0.2)
    head(f"Spread, {pairs} pairs: found to differ", "laws", *(f"{n}, {m}" for n, m in counts))
    for name, pair in laws.items():
        rates = []
        for each in counts:
            generator, found = np.random.default_rng([2, *each]), 0
            labels = labelings(*each, generator)
            for _ in range(0, pairs, 250):
                sides = [np.rint(2 * law(generator, (250, n))) / 2 for law, n in zip(pair, each, strict=True)]
                apart = [np.abs(side - np.median(side, axis=1, keepdims=True)) for side in sides]
                both = (
                    np.concatenate(apart, axis=1) + 0.5
                )  # `moments` divides by the mean, and t takes differences
                t = t_of("welch", moments(both, labels, each[0]), moments(both, 1 - labels, each[1]))
                found += np.sum((np.abs(t) >= np.abs(t[:, :1]) * (1 - 1e-9)).mean(axis=1) <= LEVEL)
            rates.append(float(found / (250 * -(-pairs // 250))))
        line(name, *rates)


def print_coverage(pairs: int) -> None:
    head(f"{pairs} pairs: the 95% interval holds the ratio", "laws", "ratio", "variant", *map(str, SEEDS))
    for ratio in (1.0, 2.0, 5.0):
        for name, laws in ratios(ratio).items():
            truth = (mean_of(laws[1]) + 0.5) / (mean_of(laws[0]) + 0.5)
            rates = [tested(laws, (n, n), pairs, truth) for n in SEEDS]
            for place, variant in enumerate(VARIANTS):
                line(name, f"{truth:.2f}", variant, *(1 - float(each[place].sum()) for each in rates))


def print_power(pairs: int) -> None:
    head(f"{pairs} pairs: the faster found, (the slower)", "laws", "ratio", "variant", *map(str, SEEDS))
    for ratio in (1.25, 1.5, 2.0, 5.0):
        for name, laws in ratios(ratio).items():
            rates = [tested(laws, (n, n), pairs, 1) for n in SEEDS]
            for place, variant in enumerate(VARIANTS[:-1]):
                shown = (f"{100 * each[place, 0]:.0f} ({100 * each[place, 1]:.1f})" for each in rates)
                line(name, f"{mean_of(laws[1]) / mean_of(laws[0]):.2f}", variant, *shown)


PARTS = {"equal": print_equal, "coverage": print_coverage, "power": print_power, "spread": print_spread}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument("--pairs", type=int, default=2000)
    arguments = parser.parse_args()
    for part in arguments.parts or PARTS:
        PARTS[part](arguments.pairs)


if __name__ == "__main__":
    main()
