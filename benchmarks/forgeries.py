"""What `qrlsuite verify` finds: forged curves, by how many seeds trained again, and false alarms.

    python benchmarks/forgeries.py --twins twins.npz --train      # 100 seeds of width 16 again: 3 minutes
    python benchmarks/forgeries.py --twins twins.npz [--draws 1000] [--markdown]

Published curves of `ddqn mlp width=16` are the honest ones. Their twins are the same seeds trained again with torch's
kernels for another processor (ATEN_CPU_CAPABILITY=default), as whoever verifies would elsewhere. Printed are

1. how long twins stay together;
2. the power of candidate checks (25 seeds), twins measured, and with twins that are the same run with probability r;
3. forgeries, and how often `verify` finds them: where bits are comparable (exact), and elsewhere (by drawing seeds).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from qrlsuite.leaderboard.shelf import plausible, published
from qrlsuite.leaderboard.shelf.published import PublishedEntry
from qrlsuite.leaderboard.shelf.verify import retrain

WIDTH_16, WIDTH_32 = "ddqn mlp width=16", "ddqn mlp width=32"
KERNELS = {"ATEN_CPU_CAPABILITY": "default"}
LEVEL = plausible.FALSE_ALARM / 2
KEPT = 5
"""First epochs that a careful forger leaves as they are."""

Curves = np.ndarray


def entry(label: str) -> PublishedEntry:
    """Return a published entry of beam6g."""
    found = (published.read(path) for path in sorted(published.PUBLISHED.glob("beam6g/*")))
    return next(each for each in found if each.record.label == label)


HONEST = entry(WIDTH_16)
GRID, STEPS = HONEST.task_file.ranking.grid, HONEST.task_file.protocol.interactions


def times(curves: Curves) -> Curves:
    return plausible.per_run(curves, GRID, STEPS)


def replaced(curves: Curves, by: Curves, count: int, kept: int = 0) -> Curves:
    """Return curves of which the `count` slowest are replaced by the fastest of others."""
    forged, slowest = curves.copy(), np.argsort(times(curves))[::-1][:count]
    forged[slowest, kept:] = by[np.argsort(times(by))[:count], kept:]
    return forged


def after_first(curves: Curves, forged: Curves) -> Curves:
    """Return forged curves with honest first epochs."""
    return np.concatenate([curves[:, :KEPT], forged[:, KEPT:]], axis=1)


def forgeries(honest: Curves, more: Curves, twins: Curves) -> dict[str, Curves]:
    """Return forged curves by name; `more` are 100 further honest runs, `twins` the same seeds elsewhere."""
    noise = 1e-4 * np.random.default_rng(1).standard_normal(honest.shape)
    half = honest[np.argsort(times(honest))[: len(honest) // 2]]
    three = plausible.faster(honest, 3)
    three[:, -1] = honest[:, -1]
    quickest = np.where((times(twins) < times(honest))[:, None], twins, honest)
    tenth = np.where((np.arange(len(honest)) % 10 == 0)[:, None], plausible.faster(honest, 2), honest)
    return {
        "none: honest curves": honest,
        "every curve three times as fast, last epoch kept": three,
        "every curve 10 percent faster": plausible.faster(honest),
        "all scores + .05": np.minimum(1, honest + 0.05),
        "best half of the seeds twice, with noise of 1e-4": np.clip(
            np.concatenate([half, half]) + noise, 0, 1
        ),
        "best 100 of 200": replaced(honest, more, 50),
        "10 of 100 seeds replaced": replaced(honest, more, 10),
        "own: every curve 10 percent faster after 5 honest epochs": after_first(
            honest, plausible.faster(honest)
        ),
        "own: 10 of 100 seeds replaced after 5 honest epochs": replaced(honest, more, 10, KEPT),
        "own: the running maximum, a run that never forgets": np.maximum.accumulate(honest, axis=1),
        "own: curves of width 32": entry(WIDTH_32).curves,
        "own: every tenth curve twice as fast after 5 honest epochs": after_first(honest, tenth),
        "own: of two trainings on two machines the better": quickest,
    }


def by_new(stated: Curves, again: Curves, places: list[int]) -> bool:
    """Return whether `verify` calls curves implausible where bits are not comparable."""
    here, there = times(again[places]), times(stated)
    return (
        bool(plausible.strangers(again[places], stated, places))
        or plausible.paired_p(there[places] - here) <= LEVEL
        or plausible.rank_p(here, np.delete(there, places)) <= LEVEL
    )


def by_final(stated: Curves, again: Curves, places: list[int]) -> bool:
    """Return the same of version 0.1.1: the rank of the last scores."""
    others = np.delete(stated[:, -1], places)
    return plausible.rank_p(again[places, -1], others) <= plausible.FALSE_ALARM


def by_pairs(stated: Curves, again: Curves, places: list[int]) -> bool:
    return plausible.paired_p(times(stated[places]) - times(again[places])) <= plausible.FALSE_ALARM


def by_rank(stated: Curves, again: Curves, places: list[int]) -> bool:
    others = np.delete(times(stated), places)
    return plausible.rank_p(times(again[places]), others) <= plausible.FALSE_ALARM


def by_either(stated: Curves, again: Curves, places: list[int]) -> bool:
    here, there = times(again[places]), times(stated)
    paired = plausible.paired_p(there[places] - here)
    return min(paired, plausible.rank_p(here, np.delete(there, places))) <= LEVEL


Check = Callable[[Curves, Curves, list[int]], bool]


def share(check: Check, stated: Curves, again: Curves, seeds: int, draws: int, r: float = 1) -> float:
    """Return how often a check finds something, over draws of the seeds that are trained again.

    With r below 1, each twin is the seed's own run with this probability, else another seed's: M of twins then has
    this correlation.
    """
    generator, found, own = np.random.default_rng(0), 0, np.arange(len(stated))
    for _ in range(draws):
        places = sorted(generator.choice(len(stated), seeds, replace=False).tolist())
        other = generator.integers(0, len(stated), len(stated))
        found += check(stated, again[np.where(generator.random(len(stated)) < r, own, other)], places)
    return found / draws


def table(rows: Sequence[Sequence[str]], markdown: bool) -> None:
    """Print rows, the first as a head."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    for number, row in enumerate(rows):
        cells = [cell.ljust(width) for cell, width in zip(row, widths)]
        print("| " + " | ".join(c.strip() for c in cells) + " |" if markdown else "  ".join(cells).rstrip())
        if markdown and not number:
            print("|" + "---|" * len(row))
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--twins", type=Path, required=True, help="file of the seeds trained again")
    parser.add_argument("--train", action="store_true", help="train them, and write it")
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--markdown", action="store_true")
    arguments = parser.parse_args()
    if arguments.train:
        if any(os.environ.get(name) != value for name, value in KERNELS.items()):
            os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **KERNELS})
        np.savez(arguments.twins, curves=retrain(HONEST).curves)
    with np.load(arguments.twins) as file:
        twins = file["curves"]
    honest, draws, markdown = HONEST.curves, arguments.draws, arguments.markdown
    apart = np.abs(twins - honest)
    epochs = [1, 2, 3, 5, 10, 15, 20, 30, 50, 100]
    rows = [["epoch", "seeds within 1e-6 of their twin"]]
    rows += [[str(t), f"{(apart[:, t - 1] < 1e-6).mean():.0%}"] for t in epochs]
    table(rows, markdown)
    print(f"M of twins: correlation {np.corrcoef(times(honest), times(twins))[0, 1]:.2f}\n")

    generator = np.random.default_rng(2)
    more = honest[generator.permutation(len(honest))]
    forged = forgeries(honest, more, twins)
    again = plausible.needed(len(honest))
    checks = {"last scores": by_final, "M, pairs": by_pairs, "M, rank": by_rank, "either": by_either}
    rows = [["twins", "forgery", *checks]]
    for name in ("none: honest curves", *(n for n in forged if "10 percent" in n or "replaced" in n)):
        for r in (1, 0.5, 0):
            there = twins if r == 1 else honest
            found = [share(check, forged[name], there, again, draws // 4, r) for check in checks.values()]
            rows.append(["measured" if r == 1 else f"r = {r:g}", name, *(f"{p:.2f}" for p in found)])
    table(rows, markdown)

    few = (2, 10)
    rows = [
        [
            "forgery",
            "M",
            "bits, 25 seeds",
            *(f"elsewhere, {k} seeds" for k in (*few, again)),
            "0.1.1, 2 seeds",
        ]
    ]
    for name, curves in forged.items():
        wrong = int((curves != honest).any(axis=1).sum())
        caught = plausible.found_by(again, wrong, len(honest)) if wrong else 0.0
        found = [share(by_new, curves, twins, seeds, draws) for seeds in (*few, again)]
        before = share(by_final, curves, twins, 2, draws)
        shares = [f"{p:.0%}" if p in (0, 1) or p >= 0.1 else f"{p:.1%}" for p in (caught, *found, before)]
        rows.append([name, f"{times(curves).mean() / 1000:.1f}k", *shares])
    table(rows, markdown)


if __name__ == "__main__":
    main()
