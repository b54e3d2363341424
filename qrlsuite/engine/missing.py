"""Finds the missing seeds of an entry, has them trained, reports the outcome: for `run`, `tune` and `study`."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from qrlsuite.engine import script
from qrlsuite.engine.budget import Budget, seconds
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.terminal import command, printable
from qrlsuite.engine.where import Where
from qrlsuite.engine.work import EngineOutcome, Missing, Snapshot, raise_failures
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.results import checkpoint, codes, probes, requests, speed
from qrlsuite.results.claims import certain, living
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import SeedGroup, format_seeds, plan_groups
from qrlsuite.results.store import EntryStore, entries
from qrlsuite.results.text import counted, duration_range
from qrlsuite.statistics.curves import reached
from qrlsuite.training import devices


def find(
    runs: Path,
    entry: Entry,
    where: Where,
    seeds: Sequence[int] | None = None,
    epochs: int | None = None,
    code: CodeIdentity | None = None,
) -> Missing:
    """Find an entry's missing seeds in a results folder; writes nothing.

    Parameters
    ----------
    seeds, epochs:
        None takes the task's protocol.
    code:
        As `settle_codes` returned it; None computes it.
    """
    requested = list(range(entry.task.file.protocol.seeds)) if seeds is None else seeds
    last = entry.epochs if epochs is None else epochs
    code = code or identity.of(entry)
    store = codes.place(runs, entry, code)
    busy = {seed for claim in certain(store) for seed in claim.seeds} | where.engine.queued(store)
    busy &= set(requested)
    left = sorted(set(requested) - busy)
    if entry.script is not None:
        _require_one_command(runs, entry)
        if last > entry.epochs:
            raise OptionError(
                f"'{entry.label}' ends after {entry.epochs} epochs: for {last}, say "
                f"steps={last * entry.task.file.protocol.interactions}"
            )
        done = store.finished(left, last)
        groups = [SeedGroup((seed,), 0) for seed in left if seed not in done]
    else:
        groups = plan_groups(store, left, last, where.workers)
    return Missing(runs, entry, store, requested, last, frozenset(busy), groups, code)


def _require_one_command(runs: Path, entry: Entry) -> None:
    """Refuse a script under a name that another command has here: boards and pictures show the name alone."""
    for store in entries(runs, entry.task.name) if runs.is_dir() else ():
        with contextlib.suppress(StoreError):  # is said where it is read
            record = store.record()
            if record.label == entry.label and record.hash != entry.hash:
                raise OptionError(
                    f"{store.path} is '{entry.label}' of another command: give this one another name, or remove that: "
                    f"{command('runs', 'rm', f'{entry.task.name}/{store.path.name}', runs=runs)}"
                )


def settle_codes(
    runs: Path, entries: Sequence[Entry], where: Where, quiet: bool = False
) -> list[CodeIdentity]:
    """Return the code of each entry; print which entries have earlier seeds of another code, unless `quiet`.

    A study with looks is refused then. With `where.same`, the codes are linked, once a checkpoint was loaded.
    """
    reason = where.same
    if reason is not None and (not reason.strip() or not reason.isprintable()):
        raise OptionError("--same: say in one line why results do not change, for example --same 'renamed'")
    for entry in entries:
        script.require_typed(entry)
    anew, found = [], [identity.of(entry) for entry in entries]
    for entry, code in zip(entries, found):
        store = codes.place(runs, entry, code)
        before = codes.other(runs, entry, code)
        if before is not None and reason is not None:
            _require_loadable(entry, before)
            codes.link(before, code, reason)
        elif before is not None and codes.of(store) is None:
            seeds = f"{before.path} has seeds {format_seeds(before.seeds())} of another code"
            if entry.study is not None:
                raise codes.ChangedCodeError(
                    f"{seeds}: {codes.change(before, code)}. Nothing was trained. Restore that code, or write another "
                    'study, or say with --same "REASON" that results do not change'
                )
            anew.append(
                f"{seeds}: {codes.change(before, code)}. Training starts over as '{entry.label} {store.mark}'; "
                '--same "REASON" continues the old seeds, if results do not change'
            )
    if anew:
        more = f" (and so for {counted(len(anew) - 1, 'more entry')})" if len(anew) > 1 else ""
        console = Console(stderr=True, quiet=quiet, highlight=False)
        console.print(f"{anew[0]}{more}", markup=False, soft_wrap=True)
    return found


def prepare(work: Missing) -> None:
    """Create the entry's folder, if need be, and write down the requested seeds and the code that trains them."""
    EntryStore.create(work.runs, work.entry, work.store.mark)
    if work.groups:
        code = work.code or identity.of(work.entry)
        codes.prepare(work.store, code, identity.plugins(work.entry))
        requests.add(work.store, work.seeds, work.epochs, code=code.digest)


def _require_loadable(entry: Entry, store: EntryStore) -> None:
    """Load a checkpoint of an entry's seeds with the code that is installed."""
    from qrlsuite.training.trainer import Trainer  # imports torch

    if not (newest := checkpoint.latest(store)):
        return
    seed = min(newest)
    try:
        Trainer(entry, [seed]).restore(*checkpoint.load(store, [seed]))
    except QrlSuiteError as error:
        raise StoreError(
            f"--same: {store.path} cannot be continued: loading the checkpoint of seed {seed} fails: {error}"
        ) from error


def require_trainable(entries: Sequence[Entry], where: Where, quiet: bool = False) -> None:
    """Refuse entries whose parts do not fit (wrong actions, say), before anything is trained or queued.

    Seeds of third-party code that would share weights or episodes are refused, too; unless `quiet`, a question that got
    no answer is printed.
    """
    from qrlsuite.training import trainer  # imports torch

    unanswered = []
    alike: dict[str, list[Entry]] = {}
    for entry in (entry for entry in entries if entry.script is None):
        alike.setdefault(entry.population_key, []).append(entry)
    for population in alike.values():
        try:
            trainer.build_envs(population[0], 1, lambda: None)
        except QrlSuiteError:
            if where.remote:
                continue
            raise
        unanswered.append(trainer.require_trainable(population))
    console = Console(stderr=True, quiet=quiet, highlight=False)
    for note in dict.fromkeys(filter(None, unanswered)):
        console.print(f"note: {printable(note)}", markup=False, emoji=False, soft_wrap=True)


class _TimeIsUp(Exception):
    """Ends an engine's work as Ctrl-C does."""


def check_budget(budget: str | None, where: Where) -> None:
    """Refuse a budget that cannot be kept."""
    if budget is None:
        return
    Budget.parse(budget)
    if where.submits:
        raise OptionError(
            f"--budget: engine '{where.name}' leaves its tasks in a queue; limit these: "
            f"--engine '{where.name} time=2:00:00'"
        )


def train(
    work: Missing,
    where: Where,
    display: RunDisplay,
    budget: str | None = None,
    confirmed: bool = True,
    began: float | None = None,
) -> EngineOutcome:
    """Train the planned groups, showing progress; return how it ended.

    Parameters
    ----------
    budget:
        After which training stops, with every finished epoch saved. None for no limit.
    confirmed:
        Whether to go on, on a terminal, where the first measurement says that it will take more than a day.
    began:
        When the budget began, by `time.monotonic`; None is now.
    """
    began, limit = time.monotonic() if began is None else began, seconds(budget, where.workers)

    def show(snapshot: Snapshot) -> None:
        display.update(snapshot)
        if display.endless and not confirmed and limit is None and display.console.is_terminal:
            raise QrlSuiteError("stopped: this takes more than a day; --yes starts it anyway")
        if limit is not None and time.monotonic() - began >= limit:
            raise _TimeIsUp

    if work.entry.start is not None:  # what is missing is said before anything is trained
        work.store.initial([seed for group in work.groups if group.epoch == 0 for seed in group.seeds])
    display.deadline = None if limit is None else began + limit
    if not where.remote and work.groups:
        _check_device(where.device)
    fresh = not work.store.path.exists()
    prepare(work)
    holders = sorted({f"process {claim.pid} on {claim.host}" for claim in certain(work.store)})
    display.begin(where.submits, holders)
    if not work.groups:
        return EngineOutcome()
    try:
        outcome = where.run([work], show)
    except _TimeIsUp:
        display.out_of_time(budget or "")
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
    if (
        fresh
        and outcome.failed
        and work.entry.script is None
        and not work.store.seeds()
        and not living(work.store)
    ):
        _remove(work.store.path)
        raise QrlSuiteError("; ".join(sorted(set(outcome.failed.values()))))
    raise_failures(outcome)
    for message in outcome.taken.values():
        display.console.print(f"left out: {printable(message)}", markup=False, emoji=False)
    return outcome


def expected(work: Missing, where: Where) -> str | None:
    """Say how long training should take, None where this entry was not measured here before."""
    if not work.groups or where.remote or where.device != "cpu":
        return None
    measured = speed.measure(work.store, work.together)
    if measured is None:
        return None
    seconds = measured.range(work.left / min(where.workers, len(work.groups)))
    return f"it should take {duration_range(*seconds)} ({speed.MEASURED})"


def summarize(work: Missing) -> dict[str, Any]:
    """Return a summary of a (partly) finished training as plain values."""
    store, epochs = work.store, work.epochs
    runs = [run for seed in work.seeds if len((run := store.seed(seed).read()).scores) >= epochs]
    complete = [run.curve[:epochs] for run in runs]
    file = work.entry.task.file
    grid, sign = file.ranking.grid, file.score.sign
    return {
        "task": work.entry.task.name,
        "entry": f"{work.entry.name}{store.mark}",
        "label": f"{work.entry.label} {store.mark}".rstrip(),
        "folder": str(store.path),
        "seeds": len(complete),
        "epochs": epochs,
        "median_score": float(np.median([curve[-1] for curve in complete])) if complete else None,
        "best_score": sign * float(np.max(sign * np.stack(complete))) if complete else None,
        "lowest_threshold": sign * min(sign * level for level in grid.thresholds),
        "threshold_reached": bool(reached(np.stack(complete), grid).any()) if complete else None,
        "diverged": sum(run.diverged is not None and run.diverged <= epochs for run in runs),
    }


def _check_device(name: str) -> None:
    """Look whether there is such a device; torch is imported for a GPU only."""
    if name != "cpu":
        devices.find(name)


def _remove(folder: Path) -> None:
    """Remove the folder of an entry that could not be built, and empty folders above it."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


def _newest_probe(work: Missing) -> str | None:
    """Describe the newest probe of these seeds, with its cost; None without one."""
    found = probes.of_records(work.store.seed(seed).record() for seed in work.todo)
    return next((probes.sentence(probe) for probe in found if probe.result != probes.DIFFERS), None)


def _warnings(store: EntryStore, group: SeedGroup) -> list[str]:
    left = ProgressFile(store, group.id).read().get("warnings")
    return [str(message) for message in left] if isinstance(left, list) else []
