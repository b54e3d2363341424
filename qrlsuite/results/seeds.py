"""Dividing the seeds of an entry into groups, each trained as one population in one process."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from qrlsuite.errors import OptionError
from qrlsuite.results import checkpoint
from qrlsuite.results.store import EntryStore

LARGEST_GROUP = 100
MOST_SEEDS = 100_000
LONGEST_RANGE = 36
"""Digits of a seed or of both ends of a range: more are a slip of the hand, and may be too many for a number."""


@dataclass(frozen=True)
class SeedGroup:
    """Seeds at one epoch that are trained together."""

    seeds: tuple[int, ...]
    epoch: int

    @property
    def id(self) -> str:
        """The group's folder name."""
        return checkpoint.group_id(self.seeds)


def parse_seeds(text: str) -> list[int]:
    """Parse `100` (seeds 0..99), `0:20`, or a list such as `0,3,10:12`."""
    seeds: list[int] = []
    for piece in (f"0:{text}" if text.isdecimal() else text).split(","):
        first, colon, last = piece.strip().partition(":")
        if not first.isdecimal() or (colon and not last.isdecimal()) or len(first + last) > LONGEST_RANGE:
            raise OptionError(f"seeds '{text}': write a number (100), a range (0:20) or a list (0,3,10:12)")
        more = range(int(first), int(last) if colon else int(first) + 1)
        if len(seeds) + max(0, more.stop - more.start) > MOST_SEEDS:
            raise OptionError(f"seeds '{text}': {MOST_SEEDS} seeds are the most that an entry takes at once")
        seeds += more
    if not seeds or len(set(seeds)) != len(seeds):
        one = " (a single number is how many seeds; seed 0 alone is 0:1)" if text == "0" else ""
        raise OptionError(f"seeds '{text}': at least one seed, none twice, is needed{one}")
    return sorted(seeds)


def read_seeds(requested: int | str | Iterable[int]) -> list[int]:
    """Return the seeds of a number (100: seeds 0 to 99), of a text as in `parse_seeds`, or of a sequence of seeds."""
    if isinstance(requested, str):
        return parse_seeds(requested)
    if _is_seed(requested):
        return parse_seeds(str(requested))
    seeds = list(requested) if isinstance(requested, Iterable) else [requested]
    wrong = [seed for seed in seeds if not _is_seed(seed)]
    if wrong:
        raise OptionError(
            f"seeds {wrong[0]!r}: give a number (100), seeds ([0, 3, 10]) or text ('0,3,10:12')"
        )
    return parse_seeds(",".join(f"{seed}:{seed + 1}" for seed in seeds))


def _is_seed(value: object) -> TypeGuard[int]:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 0)


def format_seeds(seeds: Sequence[int]) -> str:
    """Write sorted seeds as `parse_seeds` reads them."""
    pieces: list[str] = []
    start = previous = None
    for seed in [*sorted(seeds), None]:
        if start is None:
            start = previous = seed
        elif seed is not None and previous is not None and seed == previous + 1:
            previous = seed
        else:
            pieces.append(
                f"{start}:{previous + 1}" if previous is not None and previous != start else f"{start}"
            )
            start = previous = seed
    text = ",".join(pieces)
    return f"{text}:{int(text) + 1}" if text.isdecimal() else text  # a lone number would count from 0


def plan_groups(store: EntryStore, seeds: Sequence[int], epochs: int, workers: int) -> list[SeedGroup]:
    """Divide the unfinished seeds into groups: as many as workers, seeds at different epochs apart."""
    finished = store.finished(seeds, epochs)
    newest = checkpoint.latest(store)
    by_epoch: dict[int, list[int]] = {}
    for seed in sorted(set(seeds) - finished):
        by_epoch.setdefault(newest[seed].epoch if seed in newest else 0, []).append(seed)
    unfinished = sum(len(members) for members in by_epoch.values())
    size = min(LARGEST_GROUP, max(1, math.ceil(unfinished / max(1, workers))))
    groups = []
    for epoch, members in sorted(by_epoch.items()):
        pieces = math.ceil(len(members) / size)
        for piece in range(pieces):  # as even as can be
            low, high = piece * len(members) // pieces, (piece + 1) * len(members) // pieces
            groups.append(SeedGroup(tuple(members[low:high]), epoch))
    return groups
