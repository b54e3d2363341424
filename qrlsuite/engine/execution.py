"""Trains the missing seeds of an entry: builds an engine, plans the groups, runs them, reports the outcome.

Everything that trains goes through here: `run`, `tune` and `study` on the command line, and `qrlsuite.api`.
"""

from __future__ import annotations

import contextlib
import math
import shutil
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from qrlsuite import registry, specs
from qrlsuite.engine import api, remote
from qrlsuite.engine.api import Engine, EngineOutcome, RemoteEngine
from qrlsuite.engine.local import LocalEngine
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import OptionError, QrlSuiteError, TaskError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import codes, probes, speed
from qrlsuite.results.claims import certain, living
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import LARGEST_GROUP, SeedGroup, plan_groups
from qrlsuite.results.store import EntryStore
from qrlsuite.results.text import duration_range
from qrlsuite.statistics.curves import reached
from qrlsuite.training import device as devices
from qrlsuite.training import memory

if TYPE_CHECKING:
    from qrlsuite.engine.display import RunDisplay  # which imports this module


@dataclass(frozen=True)
class Execution:
    """How training is executed: by which engine, how many groups at a time, on which device.

    Attributes
    ----------
    submits:
        Whether the engine hands the groups to a queue and returns.
    name:
        The engine's name, for messages.
    remote:
        Whether groups run on other machines than this one.
    fresh:
        Whether an entry whose code has changed is begun anew, and its old seeds set aside.
    same:
        Its author's word that a change of code changes nothing: the reason.
    """

    engine: Engine | RemoteEngine
    workers: int
    device: str = "cpu"
    submits: bool = False
    name: str = "local"
    remote: bool = False
    fresh: bool = False
    same: str | None = None

    def run(self, work: Plan, show: api.Show) -> EngineOutcome:
        """Let the engine train the groups of a plan."""
        handed = api.Work(work.store, work.groups, work.epochs, self.workers, self.device)
        if isinstance(self.engine, RemoteEngine):
            return remote.train(self.engine, handed, show)
        return self.engine.run(handed, show)

    @property
    def room(self) -> int:
        """How many runs can be trained side by side; 1 where the engine trains one entry after the other."""
        return LARGEST_GROUP * self.workers if isinstance(self.engine, LocalEngine) else 1

    def divide(self, plans: Sequence[Plan]) -> list[list[Plan]]:
        """Divide the plans that have groups into those that `run_together` can train: as few lists as can be."""
        alike: dict[str, list[Plan]] = {}
        for each in plans:
            if each.groups:
                # of an entry that another process trains too, other seeds are free than of the rest
                side_by_side = isinstance(self.engine, LocalEngine) and not each.busy
                key = each.entry.population_key if side_by_side else each.entry.hash
                alike.setdefault(key, []).append(each)
        return list(alike.values())

    def run_together(self, plans: Sequence[Plan], show: api.Show) -> EngineOutcome:
        """Let the engine train plans to the same epoch, one of the lists of `divide`: several in common populations."""
        if len(plans) > 1 and isinstance(self.engine, LocalEngine):
            return self.engine.run_all(self._populations(plans), show)
        return self.run(plans[0], show)

    def _populations(self, plans: Sequence[Plan]) -> list[api.Work]:
        """Divide plans whose entries can be trained in one population among the workers.

        Seeds are divided first, and entries where there are more workers than seeds, or groups would be too large.
        """
        seeds = sorted({seed for each in plans for seed in each.missing})
        pieces = min(self.workers, len(seeds))
        groups = [
            SeedGroup(tuple(seeds[i * len(seeds) // pieces : (i + 1) * len(seeds) // pieces]), 0)
            for i in range(pieces)
        ]
        free = memory.available() if self.device == "cpu" else None
        parts = min(len(plans), math.ceil(self.workers / pieces))
        while parts < len(plans):
            size = math.ceil(len(plans) / parts) * math.ceil(len(seeds) / pieces)
            needed = min(self.workers, parts * pieces) * memory.group_bytes(plans[0].entry, size)
            if size <= LARGEST_GROUP and (free is None or needed <= free):
                break
            parts += 1
        work = []
        for i in range(parts):
            first, *others = plans[i * len(plans) // parts : (i + 1) * len(plans) // parts]
            stores = [each.store for each in others]
            work.append(api.Work(first.store, groups, first.epochs, self.workers, self.device, stores))
        return work


@dataclass(frozen=True)
class Plan:
    """The seeds of an entry that are to be trained, and in which groups.

    Attributes
    ----------
    runs:
        The results folder.
    store:
        The entry's folder in it, which need not exist yet.
    seeds:
        All seeds that were asked for.
    epochs:
        The epoch to which each is to be trained.
    busy:
        Those that another process trains, or that wait in a queue.
    groups:
        The rest of those that are missing.
    """

    runs: Path
    entry: Entry
    store: EntryStore
    seeds: Sequence[int]
    epochs: int
    busy: frozenset[int] = frozenset()
    groups: Sequence[SeedGroup] = field(default_factory=list)

    @property
    def missing(self) -> list[int]:
        """The seeds of the groups, sorted."""
        return sorted(seed for group in self.groups for seed in group.seeds)

    @property
    def left(self) -> int:
        """Epochs to train, summed over the seeds; none for those that an interrupted longer run has already."""
        return sum(len(group.seeds) * max(0, self.epochs - group.epoch) for group in self.groups)

    @property
    def together(self) -> int | None:
        """Seeds of the largest group, None where there is none."""
        return max((len(group.seeds) for group in self.groups), default=None)


def create(
    engine: str = "local",
    workers: int | None = None,
    options: Mapping[str, Any] | None = None,
    device: str = "cpu",
) -> Execution:
    """Build an engine by name.

    Parameters
    ----------
    workers:
        Groups that are trained at a time; None lets the engine choose.
    options:
        The engine's options; None stands for an option that was not given.

    Raises
    ------
    UnknownNameError, OptionError, QrlSuiteError
        If there is no such engine, it has no such option or value, a package is not installed, or there can be
        no such device.
    """
    devices.check(device)  # the machine that trains checks whether it has this device
    built = api.create(engine, options or {})
    spec = cast(specs.EngineSpec, registry.load().get("engines", engine).spec)
    return Execution(built, built.workers(workers), device, spec.submits, engine, spec.remote or spec.submits)


def plan(
    runs: Path,
    entry: Entry,
    execution: Execution,
    seeds: Sequence[int] | None = None,
    epochs: int | None = None,
) -> Plan:
    """Find out what of an entry is missing in a results folder; writes nothing.

    Parameters
    ----------
    seeds, epochs:
        None takes those of the task's protocol.

    Raises
    ------
    StoreError
        If the entry's folder is damaged, or belongs to another entry.
    """
    requested = list(range(entry.task.file.protocol.seeds)) if seeds is None else seeds
    last = entry.task.epochs(entry.algorithm.name) if epochs is None else epochs
    store = EntryStore.find(runs, entry)
    busy = {seed for claim in certain(store) for seed in claim.seeds} | execution.engine.queued(store)
    busy &= set(requested)
    left = sorted(set(requested) - busy)
    missing = plan_groups(store, left, last, execution.workers)
    if missing and isinstance(execution.engine, RemoteEngine):
        missing = plan_groups(store, left, last, execution.workers, remote.seeds_per_task(entry))
    return Plan(runs, entry, store, requested, last, frozenset(busy), missing)


def require_same_code(runs: Path, entries: Sequence[Entry], execution: Execution) -> list[str]:
    """Refuse entries of which another code has begun seeds: before they are planned, and anything is trained.

    With `execution.fresh`, such seeds are set aside; with `execution.same`, the codes are declared to be the same.

    Returns
    -------
    list of str
        What was moved, one line each.

    Raises
    ------
    StoreError
        Saying what changed and the ways on, or why seeds cannot be set aside.
    OptionError
        If both ways are asked for, or the reason is none.
    """
    if execution.fresh and execution.same is not None:
        raise OptionError(
            "--fresh and --same: the old seeds are either set aside or continued; give one of them"
        )
    moved: list[str] = []
    for entry in entries:
        store, code = EntryStore.find(runs, entry), identity.of(entry)
        if execution.same is not None:
            codes.declare_same(store, code, execution.same)
        elif execution.fresh:
            old, earlier = codes.set_aside(runs, store, code, execution.engine.queued(store))
            moved += [] if old is None else [f"the seeds of another code are now in {old}"]
            moved += [] if earlier is None else [f"{earlier} has seeds of this code: they are continued"]
        else:
            codes.require(store, code)
    return moved


class _TimeIsUp(Exception):
    """Ends an engine's work as Ctrl-C does."""


def check_minutes(minutes: float | None, execution: Execution) -> None:
    """Refuse a time limit that cannot be kept.

    Raises
    ------
    OptionError
        If it is no positive, finite number, or the engine hands its work to a queue.
    """
    if minutes is None:
        return
    if not 0 < minutes < float("inf"):
        raise OptionError(f"--minutes {minutes:g}: give a time, for example --minutes 2 or --minutes 0.5")
    if execution.submits:
        raise OptionError(
            f"--minutes: engine '{execution.name}' leaves its tasks in a queue; give --time instead"
        )


def train(
    work: Plan,
    execution: Execution,
    display: RunDisplay,
    minutes: float | None = None,
    confirmed: bool = True,
) -> EngineOutcome:
    """Train what is planned, showing progress; returns how it ended.

    Parameters
    ----------
    minutes:
        After which training stops, with every finished epoch saved. None for no limit.
    confirmed:
        Whether to go on, on a terminal, where the first measurement says that it will take more than a day.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, when every worker has saved and ended.
    QrlSuiteError
        If a group failed; finished epochs are kept.
    """
    began = time.monotonic()

    def show(snapshot: api.Snapshot) -> None:
        display.update(snapshot)
        if display.endless and not confirmed and minutes is None and display.console.is_terminal:
            raise QrlSuiteError("stopped: this takes more than a day; --yes starts it anyway")
        if minutes is not None and time.monotonic() - began >= 60 * minutes:
            raise _TimeIsUp

    display.deadline = None if minutes is None else began + 60 * minutes
    code = identity.of(work.entry)
    codes.require(work.store, code)
    if certain(work.store):  # somebody has begun it, and maybe no seed says so yet
        codes.require_sent(work.store, code, socket.gethostname())
    if not execution.remote and work.groups:
        _check_device(execution.device)
        check_memory(work, execution)
    fresh = not work.store.path.exists()
    EntryStore.create(work.runs, work.entry)
    if work.groups:
        codes.prepare(work.store, code)
    holders = sorted({f"process {claim.pid} on {claim.host}" for claim in certain(work.store)})
    display.begin(execution.submits, holders)
    if not work.groups:
        return EngineOutcome()
    try:
        outcome = execution.run(work, show)
    except _TimeIsUp:
        display.out_of_time(minutes or 0.0)
        return EngineOutcome()
    except KeyboardInterrupt:
        display.interrupted()
        raise
    finally:
        display.close()
    if display.probing and (probe := _newest_probe(work)):
        display.console.print(probe, markup=False, soft_wrap=True)
    for message in sorted({m for group in work.groups for m in _warnings(work.store, group)}):
        display.console.print(f"warning: {printable(message)}", markup=False, emoji=False, soft_wrap=True)
    if fresh and outcome.failed and not work.store.seeds() and not living(work.store):
        _remove(work.store.path)
        raise QrlSuiteError("; ".join(sorted(set(outcome.failed.values()))))
    api.raise_failures(outcome)
    for message in outcome.taken.values():
        display.console.print(f"left out: {printable(message)}", markup=False, emoji=False)
    return outcome


def expected(work: Plan, execution: Execution) -> str | None:
    """Say how long training should take, None where nothing is known before the first epoch."""
    if not work.groups or execution.remote or execution.device != "cpu":
        return None
    try:
        estimate = speed.known(work.runs).estimate(work.entry, work.together)
    except TaskError:  # a plugin's file of reference speeds is malformed, which `qrlsuite check` says
        return None
    seconds = estimate.range(work.left / min(execution.workers, len(work.groups)))
    return seconds and f"it should take {duration_range(*seconds)} ({speed.BASES[estimate.basis]})"


def check_memory(work: Plan, execution: Execution) -> None:
    """Refuse what does not fit into this machine's memory; a GPU's and a cluster's are not known.

    Raises
    ------
    OptionError
        Saying how many seeds would fit.
    """
    if execution.device == "cpu" and not execution.remote:
        groups = [group.seeds for group in work.groups]
        memory.require(work.entry, groups, execution.workers, memory.available())


def summarize(work: Plan) -> dict[str, Any]:
    """Return what a finished (or partly finished) plan amounts to by now, as plain values."""
    store, epochs = work.store, work.epochs
    curves = {seed: store.seed(seed).read() for seed in work.seeds if store.seed(seed).record()}
    runs = [run for run in curves.values() if len(run.scores) >= epochs]
    complete = [run.curve[:epochs] for run in runs]
    grid = work.entry.task.file.ranking.grid
    return {
        "task": work.entry.task.name,
        "entry": work.entry.name,
        "label": work.entry.label,
        "folder": str(store.path),
        "seeds": len(complete),
        "epochs": epochs,
        "median_score": float(np.median([curve[-1] for curve in complete])) if complete else None,
        "best_score": float(np.max(complete)) if complete else None,
        "lowest_threshold": min(grid.thresholds),
        "threshold_reached": bool(reached(np.stack(complete), grid).any()) if complete else None,
        "diverged": sum(run.diverged is not None and run.diverged <= epochs for run in runs),
    }


def _check_device(name: str) -> None:
    """Look whether there is such a device; torch is imported for a GPU only.

    Raises
    ------
    OptionError
        If this machine or this build of torch has none.
    """
    if name != "cpu":
        devices.find(name)


def _remove(folder: Path) -> None:
    """Remove the folder of an entry of which nothing could be built, and those above it that are then empty."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


def _newest_probe(work: Plan) -> str | None:
    """Say what the probe of a plan's seeds has found, and what it took; None where there is none."""
    for seed in work.missing:
        probe = probes.of_record(work.store.seed(seed).record() or {})
        if probe and probe["result"] != probes.DIFFERS:
            return probes.sentence(probe)
    return None


def _warnings(store: EntryStore, group: SeedGroup) -> list[str]:
    """Return what a group's worker left for the user to know."""
    left = ProgressFile(store, group.id).read().get("warnings")
    return [str(message) for message in left] if isinstance(left, list) else []
