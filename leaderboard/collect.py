"""Reading entries for ranking: every number of a leaderboard is computed from raw curves."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from qrlsuite import registry
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, UnknownNameError
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
    color:
        Number of its color and pattern in pictures, so that it keeps them where others are left out; None counts.
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
    color: int | None = None

    def reaching(self, epochs: int) -> EntryCurves | None:
        """Return the entry with every run that has reached a number of epochs, itself where all have; None for none."""
        if not self.runs:
            return self if self.curves.shape[1] >= epochs else None
        kept = {seed: curve[:epochs] for seed, curve in self.runs.items() if len(curve) >= epochs}
        if not kept:
            return None
        out = tuple(sorted(set(self.runs) - set(kept)))
        return replace(self, curves=np.stack(list(kept.values())), seeds=tuple(kept), left_out=out, runs={})

    def cut(self, epochs: int) -> EntryCurves | None:
        """Return the first epochs of every run that has reached a number of them; None for none."""
        reached = self.reaching(epochs)
        return None if reached is None else replace(reached, curves=reached.curves[:, :epochs], runs={})

    @property
    def legend(self) -> str:
        """The label, with the ansatz where the model has one and the label leaves the default out."""
        ansatz = self.identity.get("model_options", {}).get("ansatz")
        if ansatz is None or " ansatz=" in self.label:
            return self.label
        return f"{self.label} ansatz={ansatz}"

    @property
    def longest(self) -> int:
        """The epochs of the longest run."""
        return max((len(curve) for curve in self.runs.values()), default=int(self.curves.shape[1]))

    @property
    def mixed_versions(self) -> tuple[str, ...]:
        """The distributions of which more than one version made the runs."""
        return tuple(name for name, found in self.versions.items() if len(found) > 1)

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
        both is shown once, the copy with more seeds: equal seeds are the same runs, not further evidence. Where the
        own copy gets less far towards the task's shortest horizon, both are shown.

    Returns
    -------
    tuple
        The entries that have at least one epoch, and one line for each folder that was refused and why.
    """
    good: dict[tuple[str, str, str], list[EntryCurves]] = {}
    refused = []
    for store in _folders(runs, shipped, task):
        try:
            entry = read(store)
        except QrlSuiteError as error:
            refused.append(str(error))
            continue
        if entry is None:
            continue
        good.setdefault((entry.task, entry.task_hash, entry.name), []).append(entry)
    found = []
    for copies in good.values():
        shown = _shown(copies) if shipped else copies[-1:]
        found += shown
        for other in copies if shipped and len(shown) < len(copies) else ():
            if other is not shown[0]:
                size = f"{len(other.seeds)} seeds of {other.curves.shape[1]} epochs"
                refused.append(f"{other.folder}: {size}; shown once, from {shown[0].folder}")
    return found, refused


def select(
    runs: Path,
    tasks: Collection[str] = (),
    names: Iterable[str] = (),
    shipped: bool = False,
    horizon: int | None = None,
    min_seeds: int = 1,
) -> tuple[list[EntryCurves], list[str]]:
    """Read the entries for a board or a picture.

    Parameters
    ----------
    tasks, names:
        The tasks and the entries (see `find`) to read; all where empty.
    shipped:
        As for `collect`.
    horizon:
        Environment steps: longer curves are cut to it, shorter entries left out. None cuts nothing.
    min_seeds:
        Entries with fewer seeds are left out.

    Returns
    -------
    tuple
        The entries, in the order named; and one line for each that was left out and why.

    Raises
    ------
    OptionError
        If the horizon is no whole number of epochs of a task.
    UnknownNameError
        If none or several entries match a name, or none is left.
    """
    named = {
        (copy.task_hash, copy.name): copy
        for name in names
        for copy in _shown(_read_copies(runs, name, shipped, tasks))
    }
    found, left_out = list(named.values()), list[str]()
    if not named:
        found, left_out = collect(runs, next(iter(tasks)) if len(tasks) == 1 else None, shipped)
        found = [entry for entry in found if not tasks or entry.task in tasks]
    there = len(found)
    kept = []
    for entry in found:
        if horizon is not None and (horizon < 1 or horizon % entry.steps_per_epoch):
            epochs = max(1, round(horizon / entry.steps_per_epoch))
            raise OptionError(
                f"--horizon {horizon}: an epoch of task '{entry.task}' has {entry.steps_per_epoch} steps; write a "
                f"multiple of it, such as --horizon {epochs * entry.steps_per_epoch}"
            )
        reached = entry if horizon is None else entry.cut(horizon // entry.steps_per_epoch)
        if reached is None:
            left_out.append(
                f"{entry.label}: ends at {entry.longest * entry.steps_per_epoch} of {horizon} steps"
            )
        elif len(reached.seeds) < min_seeds:
            count = len(reached.seeds)
            left_out.append(f"{entry.label}: {count} seed{'s' * (count != 1)}, fewer than {min_seeds}")
        else:
            kept.append(reached)
    if there and not kept:
        raise UnknownNameError(f"no entry is left: {'; '.join(left_out[-there:])}")
    return kept, left_out


def equally_long(entries: Sequence[EntryCurves]) -> tuple[list[EntryCurves], list[str]]:
    """Leave out entries that would cut a picture: those shorter than half of the others, task by task.

    Where any entry of a task reaches the task's shortest horizon, those that do not are left out first.

    Returns
    -------
    tuple
        The entries that stay, in their order; and one line for each that was left out.
    """
    enough: dict[str, int] = {}
    for task in {entry.task_hash for entry in entries}:
        members = [entry for entry in entries if entry.task_hash == task]
        lengths = sorted((int(entry.curves.shape[1]) for entry in members), reverse=True)
        least = min(members[0].task_file.ranking.horizons) // members[0].steps_per_epoch
        reaching = [length for length in lengths if length >= least] or lengths
        enough[task] = reaching[(len(reaching) - 1) // 2]
    kept, lines = [], []
    for entry in entries:
        if entry.curves.shape[1] >= enough[entry.task_hash]:
            kept.append(entry)
            continue
        steps = int(entry.curves.shape[1]) * entry.steps_per_epoch
        lines.append(f"{entry.label}: ends at {steps} steps; --horizon {steps} shows it")
    return kept, lines


def find(runs: Path, name: str, shipped: bool = False, tasks: Collection[str] = ()) -> EntryCurves:
    """Read the entry that has a name (see `qrlsuite.results.lookup`), or whose folder it is.

    Parameters
    ----------
    shipped:
        Look among the published entries that come with the suite, too.
    tasks:
        Look among the entries of these tasks only; of all where empty.

    Raises
    ------
    UnknownNameError
        If none or several match; the message says what to type.
    """
    return max(_read_copies(runs, name, shipped, tasks), key=_weight)


def _read_copies(runs: Path, name: str, shipped: bool, tasks: Collection[str]) -> list[EntryCurves]:
    if (Path(name) / "entry.json").exists():
        folders = [EntryStore(Path(name))]
    else:
        everything = [e for e in lookup.stored(_folders(runs, shipped)) if not tasks or e.task in tasks]
        unique = list({entry.key: entry for entry in everything}.values())
        key = lookup.choose(unique, name, _place(runs, tasks)).key
        folders = [entry.store for entry in everything if entry.key == key]
    found = [entry for entry in map(read, folders) if entry is not None]
    if not found:
        raise UnknownNameError(f"entry '{name}' has no finished epoch yet")
    if tasks and found[0].task not in tasks:
        raise UnknownNameError(
            f"{name} is an entry of task {found[0].task}, not of {' or '.join(sorted(tasks))}"
        )
    return found


def _shown(copies: Sequence[EntryCurves]) -> list[EntryCurves]:
    """Return what is shown of an entry's copies: the better one; or both where the own one gets less far."""
    own, best = copies[0], max(copies, key=_weight)
    if own.source == "runs" and _weight(own)[0] < _weight(best)[0]:
        return [own, replace(best, name=f"{best.name}-published", label=f"{best.label} (published)")]
    return [best]


def _place(runs: Path, tasks: Collection[str]) -> str:
    """Say where an entry was looked for."""
    return f"{runs}, task {' or '.join(sorted(tasks))}" if tasks else str(runs)


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
