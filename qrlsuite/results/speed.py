"""Estimates training time on this machine, from measured epochs and reference measurements.

A speed is the time of one epoch of one seed, training and validation, on one core, as a share of its group's time.
The share depends on the size of the group: a small network alone takes thirty times as long as in a group of fifty.
So every estimate is for groups of a given size. It is a range, and names its basis:

- `measured`: epochs of this very entry in this results folder, in groups of about this size;
- `reference`: the most similar row among the reference table and the entries measured here in groups of about this
  size; a row of another machine is multiplied by the ratio of the two machines' calibrations (see `calibration`);
- `unknown`: no basis until a first epoch has been trained.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

import qrlsuite
from qrlsuite import files, options, registry, specs
from qrlsuite.errors import StoreError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import TaskFile
from qrlsuite.results import provenance
from qrlsuite.results.store import EntryStore, entries, write_atomically

SAMPLED_SEEDS = 8
"""Number of seeds of an entry whose timings are read; timings within a group hardly differ."""

BASES = {
    "measured": "measured on its own epochs",
    "reference": "the most similar reference speed, scaled to the speed of this machine",
    "unknown": "not known before a first epoch is trained",
}

Basis = Literal["measured", "reference", "unknown"]

WITHIN: Mapping[Basis, float] = {"measured": 1.25, "reference": 3.0, "unknown": 1.0}
"""An estimate ranges from its value divided by this factor to its value times this factor. For `reference`, the range
covers the hours of all published entries (a test checks it). For `measured`, the range also covers the 10th to the
90th percentile of the epochs."""

SAME_SIZE = 2.0
"""Groups up to this many times larger or smaller count as groups of one size."""

CALIBRATION_FILE = "qrlsuite/speed.json"
REPETITIONS, PRODUCTS = 5, 1500


@dataclass(frozen=True)
class Speed:
    """A measured speed and its subject.

    Attributes
    ----------
    kind:
        Environment, algorithm and model: speeds of different kinds say nothing about each other.
    options:
        All other settings that may matter, by name.
    seconds:
        Seconds per seed and epoch on one core, in groups of `group` seeds.
    group:
        Seeds trained together, 1 or more.
    alone:
        Seconds per epoch of a seed that is trained alone; None where not known.
    calibration:
        Of a reference: the result of `calibration()` on its machine; None if unknown.
    within:
        Of a measurement: the factor by which its epochs spread, from their 10th to their 90th percentile.
    """

    kind: tuple[str, str, str]
    options: Mapping[str, Any]
    seconds: float
    hash: str = ""
    group: int = 1
    alone: float | None = None
    calibration: float | None = None
    within: float = 1.0

    def resembles(self, seeds: int) -> bool:
        """Tell whether it counts as measured in groups of `seeds`."""
        return max(self.group / seeds, seeds / self.group) <= SAME_SIZE

    def together(self, seeds: int) -> float:
        """Return the seconds per seed and epoch in a group of `seeds`; `seconds` if `alone` is unknown.

        An epoch costs a fixed time for the group and a time for every seed: a seed's share in a group of G seeds is
        `fixed / G + own`. Two measurements, alone and in a group, give both.

        >>> speed = Speed(("beam6g", "ddqn", "mlp"), {}, 0.02, group=50, alone=0.51)
        >>> [round(speed.together(seeds), 3) for seeds in (1, 5, 50)]
        [0.51, 0.11, 0.02]
        """
        if self.alone is None or self.group == 1:
            return self.seconds
        fixed = max(0.0, self.alone - self.seconds) / (1 - 1 / self.group)
        return self.seconds + fixed / seeds - fixed / self.group


@dataclass(frozen=True)
class Estimate:
    """Seconds per seed and epoch on one core, None if unknown, with their basis.

    The truth is expected between `seconds / within` and `seconds * within`.
    """

    seconds: float | None
    basis: Basis
    within: float = 1.0

    def range(self, epochs: float) -> tuple[float, float] | None:
        """Return the least and the most seconds that this many epochs of one seed should take; None where unknown."""
        if self.seconds is None:
            return None
        return self.seconds * epochs / self.within, self.seconds * epochs * self.within


class _Row(options.Table):
    environment: str
    algorithm: str
    model: str
    options: Annotated[dict[str, Any], Field(description="of the model, the algorithm or the task")] = {}
    seconds: Annotated[float, Field(gt=0, lt=1e9)]
    group: Annotated[int, Field(ge=1, description="seeds that were trained together")] = 1
    alone: Annotated[float | None, Field(gt=0, lt=1e9, description="seconds of a seed by itself")] = None
    source: Annotated[str, Field(description="where the seconds are from, if not from the benchmark")] = ""


class SpeedFile(options.Table):
    """A file of reference speeds: the machine that measured them, and one row per measurement.

    Without `calibration`, the speeds hold for every machine.
    """

    format_version: Literal[1]
    machine: str
    calibration: Annotated[float | None, Field(gt=0, lt=1e9, description="of that machine, in seconds")] = (
        None
    )
    speeds: list[_Row]


def _calibrated() -> float:
    return calibration()


@dataclass
class Speeds:
    """Speeds measured in a results folder, and reference speeds.

    Attributes
    ----------
    calibrate:
        Returns this machine's calibration; called when an estimate rests on another machine's speed.
    """

    measured: list[Speed] = field(default_factory=list)
    references: list[Speed] = field(default_factory=list)
    calibrate: Callable[[], float] = field(default_factory=lambda: _calibrated)

    def estimate(self, entry: Entry, together: int | None) -> Estimate:
        """Return the best estimate for an entry in groups of `together` seeds; None for as many as were measured."""
        own = next((speed for speed in self.measured if speed.hash == entry.hash), None)
        size = together or (own.group if own is not None else None)
        here = [speed for speed in self.measured if size is None or speed.resembles(size)]
        if own is not None and own in here:
            return Estimate(own.seconds, "measured", max(own.within, WITHIN["measured"]))
        row = _nearest(_subject(entry), [*here, *self.references])
        if row is None:
            return Estimate(None, "unknown")
        machine = 1.0 if row.calibration is None else self.calibrate() / row.calibration
        return Estimate(row.together(size or row.group) * machine, "reference", WITHIN["reference"])

    def note(self, store: EntryStore) -> None:
        """Read the timings of an entry's folder again."""
        measured = measure(store)
        if measured is not None:
            self.measured = [*(speed for speed in self.measured if speed.hash != measured.hash), measured]


def known(*folders: Path) -> Speeds:
    """Read the speeds of results folders, and the reference speeds of all studies: the evidence of every estimate."""
    references = [
        registered.spec.speeds for _, registered in sorted(registry.load().of(specs.StudySpec).items())
    ]
    speeds = gather(folders[0], dict.fromkeys(references))
    for folder in folders[1:]:
        speeds.measured += gather(folder).measured
    return speeds


def gather(runs: Path, references: Iterable[str | None] = ()) -> Speeds:
    """Read the speeds of every entry in a results folder, and files of reference speeds; damage is passed over."""
    speeds = Speeds(references=[row for path in references if path is not None for row in load(Path(path))])
    for store in entries(runs) if runs.is_dir() else []:
        try:
            speeds.note(store)
        except StoreError:
            continue
    return speeds


def load(path: Path) -> list[Speed]:
    """Read a file of reference speeds."""
    file = files.load(path, SpeedFile, "speeds")
    return [
        Speed(
            (row.environment, row.algorithm, row.model),
            row.options,
            row.seconds,
            group=row.group,
            alone=row.alone,
            calibration=file.calibration,
        )
        for row in file.speeds
    ]


@functools.cache
def calibration() -> float:
    """Return the processor seconds of a fixed piece of work on this machine: measured once, in a second, and kept.

    It is kept per processor and version of the suite in `qrlsuite/speed.json`, in the folder that `QRLSUITE_CACHE`
    names, else in the user's cache folder. If it cannot be read there, it is measured anew.
    """
    standard = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    path = Path(os.environ.get("QRLSUITE_CACHE") or standard).expanduser() / CALIBRATION_FILE
    key = f"{provenance.processor()}, qrlsuite {qrlsuite.__version__}"
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        content = {}
    kept = content if isinstance(content, dict) else {}
    seconds = kept.get(key)
    if isinstance(seconds, int | float) and 0 < seconds < 1e9:
        return float(seconds)
    seconds = measure_calibration()
    with contextlib.suppress(StoreError):  # without a folder for it, every command measures
        write_atomically(path, json.dumps({**kept, key: seconds}).encode())
    return seconds


def measure_calibration() -> float:
    """Return the median processor seconds of a fixed piece of work, over a few repetitions.

    The work resembles the training of small networks: 1500 times the products of 50 matrices (64, 32) with 50
    matrices (32, 32), and the hyperbolic tangent of each, in float32 on one thread. The time is the thread's own: other
    work on the machine has little influence.
    """
    times = []
    for _ in range(REPETITIONS):
        x = np.linspace(-1, 1, 50 * 64 * 32, dtype=np.float32).reshape(50, 64, 32)
        weight = np.linspace(-1, 1, 50 * 32 * 32, dtype=np.float32).reshape(50, 32, 32)
        began = time.thread_time()
        for _ in range(PRODUCTS):
            x = np.tanh(x @ weight / 32)
        times.append(time.thread_time() - began)
    return statistics.median(times)


def measure(store: EntryStore) -> Speed | None:
    """Return the median speed of an entry's epochs, None if too few were timed (imported entries, for example).

    A seed's first epoch does not count: it includes the start of the process. Small groups do not count beside larger
    ones: a seed alone takes many times its share of a group.
    """
    by_group: dict[int, list[float]] = {}
    for seed in store.seeds()[-SAMPLED_SEEDS:]:
        with contextlib.suppress(StoreError):  # damaged times tell nothing
            for line in store.seed(seed).times()[1:]:
                if line.train is not None and line.validate_ is not None:
                    by_group.setdefault(line.group, []).append(line.train + line.validate_)
    largest = max(by_group, default=1)
    seconds = by_group.get(largest, [])
    if not seconds or not statistics.median(seconds) > 0:
        return None
    median = float(statistics.median(seconds))
    low, high = (float(value) for value in np.percentile(seconds, [10, 90]))
    record = store.record()
    identity, task = record.identity, record.task_file
    return Speed(
        (task.environment.name, identity.algorithm, identity.model),
        _options(task, identity.algorithm_options, identity.model_options),
        median,
        record.hash,
        group=largest,
        within=max(median / low if low > 0 else 1.0, high / median),
    )


def _subject(entry: Entry) -> Speed:
    kind = (entry.task.environment.name, entry.algorithm.name, entry.model.name)
    sides = options.identity(entry.algorithm_options), options.identity(entry.model_options)
    return Speed(kind, _options(entry.task.file, *sides), math.nan, entry.hash)


def _options(task: TaskFile, *sides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that an entry's speed may depend on, by name; a list counts by its length."""
    protocol = task.protocol
    values: dict[str, Any] = {
        "environments": protocol.environments,
        "interactions": protocol.interactions,
        "validation_episodes": protocol.validation_episodes,
    }
    for side in (task.environment.options, *sides):
        values |= side
    return {name: len(value) if isinstance(value, list) else value for name, value in values.items()}


def _nearest(subject: Speed, known: Sequence[Speed]) -> Speed | None:
    """Return the most similar speed of one kind: few options differ, and numbers by a small ratio.

    Exact circuits say nothing about sampled or noisy circuits, nor one gradient method about another: with the
    parameter-shift rule an epoch takes a hundred times as long.
    """
    same = [
        speed
        for speed in known
        if speed.kind == subject.kind and _work(speed.options) == _work(subject.options)
    ]
    return min(same, key=lambda speed: _distance(subject.options, speed.options), default=None)


def _work(values: Mapping[str, Any]) -> tuple[bool, Any, Any]:
    """Return how circuits are computed: whether with shots, with which noise, and by which gradient."""
    return values.get("shots") is not None, values.get("noise_model"), values.get("gradient") or "auto"


def _distance(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    total = 0.0
    for name in first.keys() & second.keys():
        a, b = first[name], second[name]
        if a == b:
            continue
        numbers = all(
            isinstance(value, int | float) and not isinstance(value, bool) and value > 0 for value in (a, b)
        )
        total += abs(math.log(a / b)) if numbers else 1.0
    return total
