"""The time of an entry's epochs, measured in a results folder where it was trained; unknown elsewhere.

A speed is the time of one epoch of one seed, training and validation, on one core, as a share of its group's time. The
share depends on the size of the group: a small network alone takes thirty times as long as in a group of fifty.
"""

from __future__ import annotations

import contextlib
import statistics
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qrlsuite.errors import StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import codes
from qrlsuite.results.store import EntryStore

SAMPLED_SEEDS = 8
"""Number of seeds of an entry whose timings are read; timings within a group hardly differ."""

SPREAD = 1.25
"""The least factor by which epochs spread up and down."""

MEASURED, UNKNOWN = "measured on its own epochs", "not known before a first epoch is trained"


@dataclass(frozen=True)
class Speed:
    """Seconds per seed and epoch on one core: the median, and the range that is expected."""

    seconds: float
    low: float
    high: float

    def range(self, epochs: float) -> tuple[float, float]:
        """Return the least and the most seconds that this many epochs of one seed should take."""
        return self.low * epochs, self.high * epochs


def find(entry: Entry, together: int | None, *runs: Path) -> Speed | None:
    """Return an entry's speed in groups of `together` seeds, from the first results folder that knows its code's."""
    code = identity.of(entry)
    for folder in runs:
        with contextlib.suppress(StoreError):  # a damaged entry tells nothing
            if (speed := measure(codes.place(folder, entry, code), together)) is not None:
                return speed
    return None


def measure(store: EntryStore, together: int | None = None) -> Speed | None:
    """Return the median speed of an entry's epochs, None if too few were timed (imported entries, for example).

    A seed's first epoch does not count: it includes the start of the process.

    Parameters
    ----------
    together:
        Seeds of a group. The measured groups that are nearest to it in size are taken, and the range allows for the
        difference: an epoch costs a time for the group and a time for every seed, so that a seed of a group that is
        twice as large takes between half the time and the same time. None takes the largest groups.
    """
    by_group: dict[int, list[float]] = {}
    for seed in store.seeds()[-SAMPLED_SEEDS:]:
        with contextlib.suppress(StoreError):  # damaged times tell nothing
            for line in store.seed(seed).times()[1:]:
                if line.train is not None and line.validate_ is not None:
                    by_group.setdefault(line.group, []).append(line.train + line.validate_)
    if not by_group:
        return None
    size = together or max(by_group)
    group = min(by_group, key=lambda number: (max(number / size, size / number), -number))
    seconds = by_group[group]
    median = float(statistics.median(seconds))
    if not median > 0:
        return None
    low, high = (float(value) for value in np.percentile(seconds, [10, 90]))
    within = max(SPREAD, median / low if low > 0 else 1.0, high / median)
    return Speed(median, median / within * min(1.0, group / size), median * within * max(1.0, group / size))
