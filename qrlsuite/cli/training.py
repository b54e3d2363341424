"""What every command that trains shares: the options of engines, a plan, the engine at work, the progress display."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, cast

import typer

from qrlsuite import options, registry, specs
from qrlsuite.cli.display import RunDisplay
from qrlsuite.cli.terminal import printable
from qrlsuite.engine import api
from qrlsuite.engine.api import Engine, Outcome
from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.claims import living
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import Group, plan_groups
from qrlsuite.results.store import EntryStore
from qrlsuite.training import device as devices

WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", min=1, help="Processes, or array tasks; default: one per core, or 10 tasks."),
]
EngineOption = Annotated[
    str, typer.Option("--engine", help="Where the work is done (see `qrlsuite list engines`).")
]
PartitionOption = Annotated[
    str | None, typer.Option("--partition", help="For --engine slurm: the partition.")
]
TimeOption = Annotated[
    str | None,
    typer.Option("--time", help="For --engine slurm: the time limit, 90 (minutes), 2:00:00 or 1-12:00:00."),
]
EngineOptionsOption = Annotated[
    list[str] | None,
    typer.Option("--engine-set", metavar="NAME=VALUE", help="A further option of the engine."),
]
MinutesOption = Annotated[
    float | None,
    typer.Option(
        "--minutes",
        metavar="MINUTES",
        help="Stop after this time with what is there, saved as by Ctrl-C; the same command continues.",
    ),
]
TrackOption = Annotated[
    list[str] | None,
    typer.Option(
        "--track",
        metavar="NAME[=TARGET]",
        help="Watch with a tracker (see `qrlsuite list trackers`): --track tensorboard, --track tensorboard=DIR.",
    ),
]
DeviceOption = Annotated[
    str, typer.Option("--device", help="Where networks are trained: cpu, cuda or cuda:1.")
]


@dataclass(frozen=True)
class Place:
    """Where training is done: an engine, as many groups at a time as `workers`, and their device.

    Attributes
    ----------
    submits:
        Whether the engine hands the groups to a queue and returns.
    """

    engine: Engine
    workers: int
    device: str = "cpu"
    submits: bool = False


@dataclass(frozen=True)
class Plan:
    """What is to be trained of an entry.

    Attributes
    ----------
    seeds:
        All seeds that were asked for.
    epochs:
        The epoch to which each is to be trained.
    busy:
        Those that another process trains, or that wait in a queue.
    groups:
        The rest of those that are missing.
    """

    entry: Entry
    store: EntryStore
    seeds: Sequence[int]
    epochs: int
    busy: frozenset[int] = frozenset()
    groups: Sequence[Group] = field(default_factory=list)

    @property
    def missing(self) -> list[int]:
        """The seeds of the groups, sorted."""
        return sorted(seed for group in self.groups for seed in group.seeds)


def place(
    engine: str,
    workers: int | None = None,
    partition: str | None = None,
    time: str | None = None,
    settings: Sequence[str] | None = None,
    device: str = "cpu",
) -> Place:
    """Build an engine from a command's options.

    Raises
    ------
    UnknownNameError, OptionError, QrlSuiteError
        If there is no such engine, it has no such option or value, a package is not installed, or there can be
        no such device.
    """
    devices.check(device)  # whether it is there is seen where the work is done
    given = {setting.name: setting.value for setting in map(options.parse_setting, settings or [])}
    built = api.create(engine, {"partition": partition, "time": time, **given})
    spec = cast(specs.EngineSpec, registry.load().get("engines", engine).spec)
    return Place(built, built.workers(workers), device, spec.submits)


def plan(runs: Path, entry: Entry, seeds: Sequence[int], epochs: int, where: Place) -> Plan:
    """Find out what of an entry is missing in a results folder; writes nothing.

    Raises
    ------
    StoreError
        If the entry's folder is damaged, or belongs to another entry.
    """
    store = EntryStore.find(runs, entry)
    busy = {seed for claim in living(store) for seed in claim.seeds} | where.engine.queued(store)
    busy &= set(seeds)
    missing = plan_groups(store, sorted(set(seeds) - busy), epochs, where.workers)
    return Plan(entry, store, seeds, epochs, frozenset(busy), missing)


class _TimeIsUp(Exception):
    """Ends an engine's work as Ctrl-C does."""


def train(
    work: Plan, where: Place, display: RunDisplay, minutes: float | None = None, confirmed: bool = True
) -> Outcome:
    """Train what is planned, showing progress; returns how it ended.

    Parameters
    ----------
    minutes:
        After which training stops, with every finished epoch saved. None for no limit.
    confirmed:
        Whether to go on, on a terminal, where the first measurement says that it will take more than a day.

    Raises
    ------
    typer.Exit
        With code 130 after Ctrl-C, when every worker has saved and ended.
    QrlSuiteError
        If a group failed; finished epochs are kept.
    """
    import time

    began = time.monotonic()

    def show(snapshot: api.Snapshot) -> None:
        display.update(snapshot)
        if display.endless and not confirmed and minutes is None and display.console.is_terminal:
            raise QrlSuiteError("stopped, for this takes more than a day: --yes starts it all the same")
        if minutes is not None and time.monotonic() - began >= 60 * minutes:
            raise _TimeIsUp

    display.deadline = None if minutes is None else began + 60 * minutes
    if not where.submits and work.groups:
        _check_device(where.device)
    fresh = not work.store.path.exists()
    EntryStore.create(work.store.path.parent.parent, work.entry)
    holders = sorted({f"process {claim.pid} on {claim.host}" for claim in living(work.store)})
    display.begin(work.busy, where.submits, holders)
    if not work.groups:
        return api.Outcome()
    try:
        outcome = where.engine.run(
            api.Work(work.store, work.groups, work.epochs, where.workers, where.device), show
        )
    except _TimeIsUp:
        display.out_of_time(minutes or 0.0)
        return api.Outcome()
    except KeyboardInterrupt:
        display.interrupted()
        raise typer.Exit(130) from None
    finally:
        display.close()
    for message in sorted({m for group in work.groups for m in _warnings(work.store, group)}):
        display.console.print(f"warning: {printable(message)}", markup=False, emoji=False, soft_wrap=True)
    if fresh and outcome.failed and not work.store.seeds() and not living(work.store):
        _remove(work.store.path)
        raise QrlSuiteError("; ".join(sorted(set(outcome.failed.values()))))
    api.raise_failures(outcome)
    for message in outcome.taken.values():
        display.console.print(f"left out: {printable(message)}", markup=False, emoji=False)
    return outcome


def _check_device(name: str) -> None:
    """Look whether there is such a device; torch is imported for a GPU only.

    Raises
    ------
    OptionError
        If this machine or this build of torch has none.
    """
    if name != "cpu":
        from qrlsuite.training import device

        device.find(name)


def _remove(folder: Path) -> None:
    """Remove the folder of an entry of which nothing could be built, and those above it that are then empty."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


def _warnings(store: EntryStore, group: Group) -> list[str]:
    """Return what a group's worker left for the user to know."""
    left = ProgressFile(store, group.id).read().get("warnings")
    return [str(message) for message in left] if isinstance(left, list) else []
