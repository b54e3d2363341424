"""Imports seeds that were trained elsewhere, from an exported entry or another results folder.

They count as seeds that were trained here, and `qrlsuite run` trains only the missing ones. Each seed's folder is
copied beside its place and renamed into it, so that no half copy counts, and a repeated import continues a stopped
one. An existing seed stays unchanged, unless the curve that comes continues its own.
"""

from __future__ import annotations

import functools
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as encode

from qrlsuite import registry, specs
from qrlsuite.errors import StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment import task as tasks
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.leaderboard.shelf import published
from qrlsuite.leaderboard.shelf.curves import require_scores
from qrlsuite.leaderboard.shelf.published import PublishedEntry
from qrlsuite.results import checkpoint, codes, provenance, requests, run_files
from qrlsuite.results.claims import acquire, living
from qrlsuite.results.records import MEASURED, Provenance, RunRecord
from qrlsuite.results.seeds import LARGEST_GROUP, format_seeds
from qrlsuite.results.store import (
    Arrays,
    EntryStore,
    SeedRun,
    SeedStore,
    Writer,
    entries,
    json_line,
    table_bytes,
    write_atomically,
)


@dataclass(frozen=True)
class Imported:
    """The imported seeds of an entry.

    Attributes
    ----------
    store:
        The entry's folder here.
    new, known:
        Copied seeds, and seeds that existed already.
    notes:
        Notes for the reader: seeds that were not imported, with reasons; other versions.
    """

    store: EntryStore
    name: str
    label: str
    task: str
    new: tuple[int, ...]
    known: tuple[int, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "folder": str(self.store.path),
            "entry": self.name,
            "label": self.label,
            "task": self.task,
            "seeds": list(self.new),
            "known": list(self.known),
            "notes": list(self.notes),
        }


def sources(folder: Path) -> list[EntryStore]:
    """Return the entries of a folder: the folder itself, or all entries below a folder of results or exports."""
    if (folder / "entry.json").is_file():
        return [EntryStore(folder.resolve())]
    stores = entries(folder) if folder.is_dir() else []
    if not stores:
        raise StoreError(
            run_files.below(folder)
            or f"{folder} holds no entry: give a results folder, a folder that `qrlsuite export` wrote, or one entry's "
            "folder in it (the one with entry.json)"
        )
    return stores


def import_seeds(source: EntryStore, runs: Path, study: str | None = None) -> Imported:
    """Copy the seeds of an entry that are not in a results folder yet.

    Parameters
    ----------
    study:
        Hash of the study with looks that the results folder belongs to, if it does.
    """
    exported = published.read(source.path) if published.is_published(source.path) else None
    record = source.record()  # a script's seeds can go on here; other programs' curves come from their files
    entry = record.entry(str(source.path)) if record.identity.algorithm == SCRIPT else source.entry()
    if entry.study != study:
        raise StoreError(
            f"{source.path} belongs to a study with looks, whose number of seeds depends on their results: "
            "only the study can continue it"
        )
    held = None if exported is not None else codes.of(source)
    code = exported.record.code_identity if exported is not None else None if held is None else held.first
    store = codes.place(runs, entry, code)
    if store.path.resolve() == source.path.resolve():
        raise StoreError(f"{source.path} is in {runs} itself: there is nothing to import")
    _require_same_task(entry, source, runs)
    every = sorted(exported.seeds if exported is not None else source.seeds())
    seeds = [seed for seed in every if seed < TUNING_SEEDS]
    if not seeds:
        raise StoreError(f"{source.path} holds no seed")
    runs_by_seed = {seed: source.seed(seed).read() for seed in seeds} if exported is None else {}
    for run in runs_by_seed.values():  # all of them, before anything is written
        require_scores(run.curve, entry.task.file, source.seed(run.seed).path)
    agents = {} if exported is None else exported.parameters()
    store = EntryStore.create(runs, entry, store.mark)
    record, links = store.record(), source.record().same
    if more := [link for link in links if link not in record.same]:
        store.write_record(record.changed(same=[*record.same, *more]))
    claim = acquire(store, seeds)
    try:
        offered = _of_runs(source, runs_by_seed) if exported is None else _of_export(exported, agents, entry)
        new, known, differing, notes = unite(store, source.path, offered)
        if exported is None:
            _take_checkpoints(source, store, sorted({*new, *known} - {*differing}))
            records = (run.record for seed, run in runs_by_seed.items() if seed in new)
            notes += _other_versions([made for r in records if r is not None for made in r.provenance], entry)
        else:
            notes += _other_versions(exported.provenance, entry)
            if new:
                notes.append("an export holds no checkpoints: these seeds cannot be trained to more epochs")
            if without := sorted(set(new) - set(agents)):
                notes.append(f"seeds {format_seeds(without)} came without agents: they cannot be evaluated")
        requests.take_over(store, *(requests.read(source) if exported is None else ({}, exported.withdrawn)))
        now, kept = identity.of(entry), codes.of(store)
        if (plugins := identity.plugins(entry)) and (kept is None or now in kept):
            codes.prepare(store, now, plugins)
        label = f"{entry.label} {store.mark}".rstrip()
        return Imported(store, entry.name, label, entry.task.name, tuple(new), tuple(known), tuple(notes))
    finally:
        claim.release()


def _require_same_task(entry: Entry, source: EntryStore, runs: Path) -> None:
    """Refuse an entry whose task is defined differently here, by its registered file or by the entries in `runs`."""
    name = entry.task.name
    if name in registry.load().of(specs.TaskSpec):
        here = {tasks.load(name).hash}
    else:  # a task of the user's own file is known by its entries
        here = {store.record().task_hash for store in (entries(runs, name) if runs.is_dir() else [])}
    if here and entry.task.hash not in here:
        raise StoreError(
            f"{source.path} was made under another definition of task '{name}' ({entry.task.hash}, here "
            f"{', '.join(sorted(here))}): its seeds belong to another task than the one here"
        )


def unite(
    store: EntryStore, source: Path | str, offered: Mapping[int, tuple[NDArray[np.float64], Writer | None]]
) -> tuple[list[int], list[int], list[int], list[str]]:
    """Put seeds into an entry's folder that it lacks, or that are longer than there; no agent is lost by that.

    Parameters
    ----------
    source:
        Where the seeds come from.
    offered:
        By seed its curve (T,), and how it is written; None for a seed that cannot be taken over yet.

    Returns
    -------
    tuple
        The seeds that were put there; the seeds that were there already and stay, and those among them with another
        curve there; and notes.
    """
    new, known, differing, waiting, bare = (list[int]() for _ in range(5))
    present = set(store.seeds())
    for seed, (curve, write) in offered.items():
        own = store.seed(seed).read().curve if seed in present else curve[:0]
        shared = min(len(own), len(curve))
        if not np.array_equal(own[:shared], curve[:shared]):
            differing.append(seed)
        elif write is not None and (seed not in present or len(own) < len(curve)):
            if store.put(seed, write):
                new.append(seed)
                continue
            bare.append(seed)
        elif seed not in present:
            waiting.append(seed)
            continue
        known.append(seed)
    notes = []
    if differing:
        notes.append(
            f"seeds {format_seeds(differing)} have other curves in {source} than in {store.path}: yours "
            "stay, until `qrlsuite runs rm` removes the entry"
        )
    if bare:
        notes.append(f"seeds {format_seeds(bare)} are longer in {source}, without their agents: yours stay")
    if waiting:
        notes.append(
            f"seeds {format_seeds(waiting)} are left there: they are being trained, or have no checkpoint yet"
        )
    return new, known, differing, notes


def _of_runs(
    source: EntryStore, runs: Mapping[int, SeedRun]
) -> dict[int, tuple[NDArray[np.float64], Writer | None]]:
    """Return seeds of a results folder, whose folders are copied, with agents and checkpoints."""
    training = {seed for claim in living(source) for seed in claim.seeds}
    newest = checkpoint.latest(source)
    ready = {seed for seed, run in runs.items() if run.finished or seed in newest} - training
    return {
        seed: (run.curve, functools.partial(_copy, source.seed(seed).path) if seed in ready else None)
        for seed, run in runs.items()
    }


def _copy(folder: Path, made: SeedStore) -> None:
    shutil.copytree(folder, made.path, ignore=shutil.ignore_patterns(".*"))
    for path in made.path.iterdir():
        with path.open("rb") as file:
            os.fsync(file.fileno())


def _take_checkpoints(source: EntryStore, store: EntryStore, seeds: Sequence[int]) -> None:
    """Copy checkpoints of seeds that are here without one or with an earlier one, so that they can go on."""
    theirs, own = checkpoint.latest(source), checkpoint.latest(store)
    by_epoch: dict[int, list[int]] = {}
    for seed in seeds:
        later = seed in theirs and (seed not in own or own[seed].epoch < theirs[seed].epoch)
        if later and len(store.seed(seed).epochs()) >= theirs[seed].epoch:
            by_epoch.setdefault(theirs[seed].epoch, []).append(seed)
    for members in by_epoch.values():
        for first in range(0, len(members), LARGEST_GROUP):
            group = members[first : first + LARGEST_GROUP]
            epoch, arrays = checkpoint.load(source, group)
            checkpoint.save(store, group, epoch, arrays)


def _of_export(
    exported: PublishedEntry, agents: Mapping[int, Arrays], entry: Entry
) -> dict[int, tuple[NDArray[np.float64], Writer | None]]:
    """Return the seeds of an export, which are written anew; it holds no checkpoints, nor all agents."""

    def write(row: int, made: SeedStore) -> None:
        seed, curve = exported.seeds[row], exported.curves[row]
        rows: list[dict[str, Any]] = [{"epoch": t, "score": float(v)} for t, v in enumerate(curve, start=1)]
        for name, values in exported.metrics(row).items():
            for line, value in zip(rows, values.tolist()):
                line[f"{MEASURED}.{name}"] = None if math.isnan(value) else value
        if executions := int(exported.executions[row]):
            rows[-1]["executions"] = {"imported": executions}
        diverged, probe = exported.published.diverged.get(str(seed)), exported.published.probe
        if diverged is not None:
            rows[diverged - 1]["diverged"] = True
        made.path.mkdir(parents=True)
        write_atomically(made.table, table_bytes(rows))
        write_atomically(
            made.timings, json_line({"epoch": len(rows), "cpu": 3600 * float(exported.hours[row])})
        )
        made.write_record(
            RunRecord.model_validate(
                {
                    **({} if entry.study is None else {"plan": entry.study}),
                    "task": entry.task.name,
                    "task_hash": entry.task.hash,
                    "entry": entry.name,
                    "label": entry.label,
                    "algorithm": entry.algorithm.name,
                    "model": entry.model.name,
                    "family": entry.model.family,
                    "parameters": exported.published.parameters,
                    "seed": seed,
                    "interactions_per_epoch": entry.task.file.protocol.interactions,
                    "status": "finished",
                    "epochs": len(rows),
                    **({} if exported.record.code is None else {"code": exported.record.code}),
                    **({} if diverged is None else {"diverged": diverged}),
                    **({} if probe is None or probe.seed != seed else {"probe": probe}),
                    **({} if seed in agents else {"agent": False}),
                    "provenance": [exported.provenance[row]],
                }
            )
        )
        if seed in agents:
            write_atomically(made.agent, encode(agents[seed]))

    return {
        seed: (exported.curves[row], functools.partial(write, row)) for row, seed in enumerate(exported.seeds)
    }


def _other_versions(origins: Sequence[Provenance], entry: Entry) -> list[str]:
    """Name the versions that made the seeds, if they differ from the installed ones."""
    here = provenance.collect(entry.distributions()).versions
    versions_there = provenance.versions(origins)
    relevant = {"qrlsuite", "torch", "numpy", "numba", *entry.distributions()}
    other = [
        f"{name} {', '.join(known)} (here {here[name]})"
        for name, known in versions_there.items()
        if name in relevant and name in here and set(known) != {here[name]}
    ]
    return [f"made with {'; '.join(other)}; boards say where versions mix"] if other else []
