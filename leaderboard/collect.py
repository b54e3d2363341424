"""Reading entries for ranking: every number of a leaderboard is computed from raw curves."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from qrlsuite import registry
from qrlsuite.errors import QrlSuiteError, StoreError, UnknownNameError
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.experiment.task import Task, TaskFile
from qrlsuite.experiment.task import load as load_task
from qrlsuite.leaderboard import origin
from qrlsuite.results import lookup
from qrlsuite.results.store import EntryStore, SeedCurve, entries


@dataclass(frozen=True)
class EntryCurves:
    """An entry with the learning curves of its complete runs.

    Attributes
    ----------
    curves:
        (N, T) float64: mean validation score per run and epoch. T is what half of the finished runs or more have.
    seeds:
        The N seeds.
    left_out:
        Seeds whose runs have fewer than T epochs yet.
    runs:
        Every run's own curve by seed, shorter ones and longer ones; empty where all have T epochs.
    hours:
        Core-hours spent on the runs, those that were left out too.
    identity:
        What the entry's hash covers: task, algorithm, model and their resolved options.
    options:
        The resolved options under "algorithm", "model" and "environment".
    preset:
        The preset that supplied defaults.
    versions:
        Every version that occurs among the seeds, by distribution; Python's under "python".
    commits, processors:
        Every code revision and processor that occurs among the seeds.
    executions:
        Circuit executions of these runs in all.
    tuning:
        How the settings were found, where a preset file says so.
    source:
        Whether the curves were read from a results folder or from a published entry.
    """

    name: str
    label: str
    task: str
    task_hash: str
    task_file: TaskFile
    algorithm: str
    model: str
    parameters: tuple[int, int]
    curves: NDArray[np.float64]
    seeds: tuple[int, ...]
    left_out: tuple[int, ...]
    hours: float
    folder: Path
    identity: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    preset: str | None = None
    versions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    commits: tuple[str, ...] = ()
    processors: tuple[str, ...] = ()
    executions: int = 0
    tuning: Mapping[str, Any] | None = None
    source: Literal["runs", "published"] = "runs"
    runs: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)

    def reaching(self, epochs: int) -> EntryCurves | None:
        """Return the entry with every run that has reached a number of epochs, itself where all have; None for none."""
        if not self.runs:
            return self if self.curves.shape[1] >= epochs else None
        kept = {seed: curve[:epochs] for seed, curve in self.runs.items() if len(curve) >= epochs}
        if not kept:
            return None
        out = tuple(sorted(set(self.runs) - set(kept)))
        return replace(self, curves=np.stack(list(kept.values())), seeds=tuple(kept), left_out=out, runs={})

    @property
    def longest(self) -> int:
        """The epochs of the longest run."""
        return max((len(curve) for curve in self.runs.values()), default=int(self.curves.shape[1]))

    @property
    def mixed_versions(self) -> tuple[str, ...]:
        """The distributions of which more than one version made the runs."""
        return tuple(name for name, found in self.versions.items() if len(found) > 1)

    @property
    def on_protocol_seeds(self) -> bool:
        """Whether its settings are known to have been chosen on seeds that it is judged by."""
        return bool(self.tuning and self.tuning.get("on_protocol_seeds"))

    @property
    def steps_per_epoch(self) -> int:
        """Environment steps per epoch of one run."""
        return self.task_file.protocol.interactions


def collect(
    runs: Path, task: str | None = None, shipped: bool = False
) -> tuple[list[EntryCurves], list[str]]:
    """Read every entry below a folder of results or of published entries.

    Parameters
    ----------
    shipped:
        Read the published entries that come with the suite, too. `runs` need not exist then. An entry that is in
        both is shown once, the one that gets further towards the task's shortest horizon, else the one with more
        seeds: equal seeds are the same runs, not further evidence.

    Returns
    -------
    tuple
        The entries that have at least one epoch, and one line for each folder that was refused and why.
    """
    good: dict[tuple[str, str, str], EntryCurves] = {}
    refused = []
    for store in _folders(runs, shipped, task):
        try:
            entry = read(store)
        except QrlSuiteError as error:
            refused.append(str(error))
            continue
        if entry is None:
            continue
        key = (entry.task, entry.task_hash, entry.name)
        if shipped and key in good:
            one, other = sorted((good[key], entry), key=_weight, reverse=True)
            size = f"{len(other.seeds)} seeds of {other.curves.shape[1]} epochs"
            refused.append(f"{other.folder}: {size}; shown once, from {one.folder}")
            good[key] = one
        else:
            good[key] = entry
    return list(good.values()), refused


def find(runs: Path, name: str, shipped: bool = False) -> EntryCurves:
    """Read the entry that has a name (see `qrlsuite.results.lookup`), or whose folder it is.

    Raises
    ------
    UnknownNameError
        If none or several match; the message says what to type.
    """
    if (Path(name) / "entry.json").exists():
        folders = [EntryStore(Path(name))]
    else:
        everything = lookup.stored(_folders(runs, shipped))
        unique = list({entry.key: entry for entry in everything}.values())
        key = lookup.choose(unique, name, runs).key
        folders = [entry.store for entry in everything if entry.key == key]
    found = [entry for entry in map(read, folders) if entry is not None]
    if not found:
        raise UnknownNameError(f"entry '{name}' has no finished epoch yet")
    return max(found, key=_weight)


def _weight(entry: EntryCurves) -> tuple[int, int, int]:
    """Return what makes one of two copies of an entry the better one: epochs, seeds, epochs beyond the horizon."""
    epochs = int(entry.curves.shape[1])
    enough = min(entry.task_file.ranking.horizons) // entry.steps_per_epoch
    return min(epochs, enough), len(entry.seeds), epochs


def _folders(runs: Path, shipped: bool, task: str | None = None) -> list[EntryStore]:
    """Return the entries' folders: those in the results folder, and with `shipped` the published ones."""
    from qrlsuite.leaderboard import published

    if not runs.is_dir() and not shipped:
        raise StoreError(
            f"there is no results folder {runs}: `qrlsuite run` makes one, --runs DIR names another, and `qrlsuite "
            "leaderboard --published` shows what comes with the suite"
        )
    stores = entries(runs, task) if runs.is_dir() else []
    return stores + (entries(published.SHIPPED, task) if shipped else [])


def read(store: EntryStore) -> EntryCurves | None:
    """Read one entry, from runs or published; None where no run has finished an epoch.

    Raises
    ------
    StoreError
        If a file is damaged, or a published entry is not what it says.
    """
    from qrlsuite.leaderboard import published

    if published.is_published(store.path):
        return published.read(store.path).entry_curves()
    return read_entry(store)


def read_entry(store: EntryStore) -> EntryCurves | None:
    """Read one entry from its runs; None where no run has finished an epoch. Tuning seeds do not count.

    Raises
    ------
    StoreError
        If a file is damaged, or a score is outside [0, 1].
    """
    record = store.record()
    runs = [store.seed(seed) for seed in store.seeds() if seed < TUNING_SEEDS]
    curves = [run.curve() for run in runs]
    curves = [curve for curve in curves if len(curve.scores)]
    if not curves:
        return None
    length = _common_length(curves)
    kept = [curve for curve in curves if len(curve.scores) >= length]
    stores = [store.seed(curve.seed) for curve in curves]
    records = [seed.record() or {} for seed in stores]
    provenance = [made for run in records for made in run.get("provenance", [])]
    first = records[0]
    parameters = first.get("parameters", {})
    identity = record["identity"]
    task_file = current(
        TaskFile.model_validate(record["task_file"]), record["task_name"], record["task_hash"]
    )
    preset = record["preset"]
    own = {curve.seed: curve.curve for curve in curves}
    require_scores(np.concatenate(list(own.values())), task_file, store.path)
    values = np.stack([own[curve.seed][:length] for curve in kept])
    return EntryCurves(
        name=record["name"],
        label=record["label"],
        task=record["task_name"],
        task_hash=record["task_hash"],
        task_file=task_file,
        algorithm=identity["algorithm"],
        model=identity["model"],
        parameters=(int(parameters.get("classical", 0)), int(parameters.get("quantum", 0))),
        curves=values,
        seeds=tuple(curve.seed for curve in kept),
        left_out=tuple(curve.seed for curve in curves if len(curve.scores) < length),
        hours=sum(seed.seconds() for seed in stores) / 3600,
        folder=store.path,
        identity=identity,
        options={
            "algorithm": _mapping(identity.get("algorithm_options")),
            "model": _mapping(identity.get("model_options")),
            "environment": task_file.environment.options,
        },
        preset=preset if isinstance(preset, str) else None,
        versions=origin.versions(provenance),
        commits=origin.texts(provenance, "commit"),
        processors=origin.texts(provenance, "processor"),
        tuning=record["tuning"],
        executions=sum(origin.executions(seed) for seed in stores),
        runs=own if any(len(curve) != length for curve in own.values()) else {},
    )


def current(stored: TaskFile, name: str, hash_: str) -> TaskFile:
    """Return a task's file as it is registered now, where its runs were made under the same definition of it.

    Ranking is no part of a definition: without this the cells of a board would be those of whichever entry comes first.
    """
    registered = _registered(registry.load(), name)
    return registered.file if registered is not None and registered.hash == hash_ else stored


@functools.lru_cache(maxsize=256)
def _registered(known: registry.Registry, name: str) -> Task | None:
    """Return a registered task, read once for all its entries; None where there is none, or it cannot be built."""
    if name not in known.entries["tasks"]:
        return None
    try:
        return load_task(name)
    except QrlSuiteError:
        return None  # its environment is not installed


def require_scores(scores: NDArray[np.float64], task_file: TaskFile, folder: Path) -> None:
    """Refuse scores that a task cannot give.

    Raises
    ------
    StoreError
        If one is not finite, or outside [0, 1] where the task's scores are relative to the best possible.
    """
    if not np.isfinite(scores).all():
        raise StoreError(f"{folder}: scores must be finite")
    outside = (scores < -_TOLERANCE) | (scores > 1 + _TOLERANCE)
    if task_file.ranking.thresholds is None and outside.any():
        raise StoreError(f"{folder}: a score is {scores[outside][0]:g}, outside [0, 1]")


_TOLERANCE = 1e-6  # a mean of scores in [0, 1] may leave it by rounding


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _common_length(curves: Iterable[SeedCurve]) -> int:
    """Return the epochs that half of the finished runs or more have; before any finished, the fewest of any run."""
    lengths = sorted((len(curve.scores) for curve in curves if curve.finished), reverse=True)
    return lengths[(len(lengths) - 1) // 2] if lengths else min(len(curve.scores) for curve in curves)
