"""Reads the state of a results folder: entries, seeds, groups, and checkpoints that nobody needs."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.results import checkpoint, requests
from qrlsuite.results.claims import Claim, SeedsClaimedError, acquire, living, move_away
from qrlsuite.results.progress import read_progress
from qrlsuite.results.records import EntryRecord
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, entries, parameters_of, read_json, write_json
from qrlsuite.results.text import duration

STATUSES = ("finished", "running", "interrupted", "submitted", "damaged")
"""Statuses of a seed. `submitted`: handed to a queue and not begun, according to our files or the queue."""


@dataclass(frozen=True)
class EntrySurvey:
    """One entry's folder.

    Attributes
    ----------
    seeds:
        Number of seeds by status.
    asked:
        Number of seeds that were asked for; 0 without a record.
    epochs:
        Fewest and most epochs that a seed has recorded; None if no seed has begun.
    size:
        Bytes on disk.
    last_activity:
        Time of the last write in the folder, seconds since 1970 by the file system's clock.
    problems:
        One line for each damaged file.
    """

    folder: Path
    task: str
    name: str
    label: str
    seeds: Mapping[str, int]
    asked: int
    epochs: tuple[int, int] | None
    size: int
    last_activity: float
    problems: tuple[str, ...] = ()


def look(store: EntryStore, queued: Collection[int] | None = None) -> EntrySurvey:
    """Look at one entry.

    Parameters
    ----------
    queued:
        The seeds that a queue still has; None where no queue was asked, and our own files are believed.
    """
    problems: list[str] = []
    try:
        record: EntryRecord | None = store.record()
    except StoreError as error:
        problems.append(str(error))
        record = None
    statuses, epochs = _seeds(store, problems, queued)
    try:
        asked = len(requests.read(store)[0])
    except StoreError as error:
        problems.append(str(error))
        asked = 0
    size, newest = _usage(store.path)
    return EntrySurvey(
        folder=store.path,
        task=store.path.parent.name if record is None else record.task_name,
        name=store.path.name,
        label=f"{'?' if record is None else record.label} {store.mark}".rstrip(),
        seeds=dict(Counter(statuses.values())),
        asked=asked,
        epochs=(min(epochs), max(epochs)) if epochs else None,
        size=size,
        last_activity=newest,
        problems=tuple(problems),
    )


def outline(store: EntryStore) -> dict[str, Any]:
    """Return an entry's options and the distinct provenances of its seeds, as plain values."""
    record = store.record()
    seeds = store.seeds()
    records = [store.seed(seed).record() for seed in seeds]
    made_with: list[Any] = []
    for origin in (origin.content for run in records if run is not None for origin in run.provenance):
        made_with += [origin] if origin not in made_with else []
    return {
        "label": f"{record.label} {store.mark}".rstrip(),
        "name": f"{record.name}{store.mark}",
        "hash": record.hash,
        "preset": record.preset,
        "tuning": record.tuned,
        "task_name": record.task_name,
        "task_hash": record.task_hash,
        "identity": record.identity.content,
        **({"imported": record.content["imported"]} if record.imported else {}),
        "seeds": len(seeds),
        "provenance": made_with,
        "parameters": parameters_of(records),
    }


def _seeds(
    store: EntryStore, problems: list[str], queued: Collection[int] | None
) -> tuple[dict[int, str], list[int]]:
    """Return the status of every seed, and the numbers of recorded epochs of seeds that have begun."""
    held = {seed for claim in living(store) for seed in claim.seeds}
    statuses: dict[int, str] = {}
    for task in waiting(store, problems):
        for seed in task["seeds"]:
            statuses[seed] = "submitted" if queued is None or seed in queued else "interrupted"
    epochs = []
    for seed in store.seeds():
        folder = store.seed(seed)
        try:
            finished = folder.finished()
            epochs.append(folder.trained_epochs() if finished else folder.newest_epoch())
        except StoreError as error:
            statuses[seed] = "damaged"
            problems.append(str(error))
            continue
        if finished:
            statuses[seed] = "finished"
        elif seed not in held and statuses.get(seed) != "submitted":
            statuses[seed] = "interrupted"
    statuses |= {seed: "running" for seed in held if statuses.get(seed) != "finished"}
    return statuses, epochs


def waiting(store: EntryStore, problems: list[str]) -> list[dict[str, Any]]:
    """Return the tasks that an engine wrote down when it handed them to a queue (`job`, `seeds`, `epochs`)."""
    queued: list[dict[str, Any]] = []
    for path in sorted(store.path.glob("*/submitted.json")):
        try:
            tasks = read_json(path).get("tasks")
        except StoreError as error:
            problems.append(str(error))
            continue
        if not isinstance(tasks, list) or not all(is_task(task) for task in tasks):
            problems.append(
                f"{path} is damaged: delete it; seeds that still wait may then be submitted twice"
            )
            continue
        queued += tasks
    return queued


def submitted(store: EntryStore) -> list[dict[str, Any]]:
    """Return the tasks of `waiting`; unreadable files are an error."""
    problems: list[str] = []
    tasks = waiting(store, problems)
    if problems:
        raise StoreError(problems[0])
    return tasks


def write_submitted(store: EntryStore, engine: str, tasks: Sequence[Mapping[str, Any]]) -> None:
    """Write down which tasks of an entry an engine has handed to a queue: `job`, `seeds`, `epochs`, `time`."""
    write_json(store.path / engine / "submitted.json", {"tasks": list(tasks)})


def is_task(task: Any) -> bool:
    """Tell whether a value of `submitted.json` is a task."""
    return (
        isinstance(task, dict)
        and isinstance(task.get("job"), str)
        and isinstance(task.get("seeds"), list)
        and all(isinstance(seed, int) for seed in task["seeds"])
    )


def _usage(folder: Path) -> tuple[int, float]:
    """Return the bytes that a folder takes, and the newest time in it."""
    size, newest = 0, 0.0
    for parent, _, names in os.walk(folder):
        for name in names:
            try:
                status = os.lstat(os.path.join(parent, name))
            except OSError:
                continue  # replaced a moment ago
            size += status.st_size
            newest = max(newest, status.st_mtime)
    return size, newest


@dataclass(frozen=True)
class GroupStatus:
    """A group at work, waiting, or stopped.

    Attributes
    ----------
    state:
        `running`, `submitted`, `stopped` or `failed`.
    where:
        Host and process, or the job in a queue, or the job that is no longer there.
    progress:
        Its `progress.json`: phase, epoch, epochs, median_score, epoch_seconds, error.
    """

    seeds: tuple[int, ...]
    state: str
    where: str
    progress: Mapping[str, Any] = field(default_factory=dict)

    @property
    def seconds_left(self) -> float | None:
        """Seconds to the last epoch at the pace of the last one; None where unknown."""
        pace, epoch, epochs = (self.progress.get(name) for name in ("epoch_seconds", "epoch", "epochs"))
        if not all(isinstance(value, int | float) for value in (pace, epoch, epochs)):
            return None
        return float(max(0.0, (epochs - epoch) * pace))  # type: ignore[operator]

    @property
    def text(self) -> str:
        """One line: state, seeds, how far it is, and who has it."""
        epoch, epochs, phase, score, error = (
            self.progress.get(name) for name in ("epoch", "epochs", "phase", "median_score", "error")
        )
        running = self.state == "running"
        parts = [f"{self.state:<9}"]
        parts += [f"seeds {format_seeds(self.seeds)}"] if self.seeds else []
        parts += [f"epoch {epoch}/{epochs}"] if epochs else []
        parts += [str(phase)] if phase and running else []
        parts += [f"median score {score:.3f}"] if isinstance(score, int | float) else []
        if running and self.seconds_left is not None:
            parts.append(f"{duration(self.seconds_left)} left")
        parts += [self.where] if self.where != "nobody" else []
        parts += [str(error)] if error else []
        return "  ".join(parts)


def groups(store: EntryStore, queued: Collection[int] | None = None) -> list[GroupStatus]:
    """Return the unfinished groups of an entry: running groups first, then waiting, then stopped ones.

    Parameters
    ----------
    queued:
        As for `look`.
    """
    alive = living(store)
    statuses = [_running(store, claim) for claim in alive]
    seen = {seed for claim in alive for seed in claim.seeds}
    done, damaged = _finished(store)
    gone: list[GroupStatus] = []
    for task in waiting(store, []):
        rest = tuple(seed for seed in task["seeds"] if seed not in seen | done)
        if rest:
            path = store.groups / checkpoint.group_id(task["seeds"]) / "progress.json"
            progress, job = read_progress(path), f"job {task['job']}"
            waits = tuple(seed for seed in rest if queued is None or seed in queued)
            if waits:
                statuses.append(GroupStatus(waits, "submitted", job, progress))
            if len(waits) < len(rest):
                left_out = tuple(seed for seed in rest if seed not in waits)
                gone.append(GroupStatus(left_out, "stopped", f"{job} has left the queue", progress))
            seen |= set(rest)
    left = set(store.seeds()) - seen - done - damaged
    for path in sorted(store.groups.glob("*/progress.json")):
        progress = read_progress(path)
        if progress.get("error") and left:
            statuses.append(GroupStatus((), "failed", path.parent.name, progress))
    statuses += gone
    if left:
        statuses.append(GroupStatus(tuple(sorted(left)), "stopped", "nobody"))
    return statuses


def _running(store: EntryStore, claim: Claim) -> GroupStatus:
    path = store.groups / checkpoint.group_id(claim.seeds or (0,)) / "progress.json"
    return GroupStatus(claim.seeds, "running", f"{claim.host}, process {claim.pid}", read_progress(path))


def _finished(store: EntryStore) -> tuple[set[int], set[int]]:
    """Return the finished seeds, and the seeds whose records cannot be read, which no run continues."""
    done, damaged = set(), set()
    for seed in store.seeds():
        try:
            if store.seed(seed).finished():
                done.add(seed)
        except StoreError:
            damaged.add(seed)
    return done, damaged


@dataclass(frozen=True)
class Garbage:
    """A group's folder that is not needed to read the results: its seeds have all finished."""

    store: EntryStore
    folder: Path
    seeds: tuple[int, ...]
    size: int


def garbage(runs: Path, task: str | None = None) -> tuple[list[Garbage], list[str]]:
    """Find the checkpoints of groups whose seeds have all finished and are not being extended.

    Returns
    -------
    tuple
        The removable checkpoints, and one line for each damaged entry, which is left alone.
    """
    unused: list[Garbage] = []
    problems: list[str] = []
    for store in entries(runs, task):
        try:
            done = store.finished(store.seeds(), 0)
            held = {seed for claim in living(store) for seed in claim.seeds}
            for header in checkpoint.headers(store):
                if set(header.seeds) <= done - held:
                    size, _ = _usage(header.path.parent)
                    unused.append(Garbage(store, header.path.parent, header.seeds, size))
        except QrlSuiteError as error:
            problems.append(str(error))
    return unused, problems


def remove(items: Sequence[Garbage]) -> int:
    """Remove the checkpoints that `garbage` found, unless a run has claimed their seeds; return the bytes freed."""
    freed = 0
    for item in items:
        try:
            claim = acquire(item.store, item.seeds)
        except SeedsClaimedError:
            continue
        try:
            shutil.rmtree(item.folder)
        except OSError as error:
            raise StoreError(f"cannot remove {item.folder}: {error.strerror or error}") from None
        finally:
            claim.release()
        freed += item.size
    return freed


def delete(runs: Path, store: EntryStore, queued: Collection[int] | None = None) -> int:
    """Delete an entry with all its seeds; returns the bytes freed.

    Parameters
    ----------
    runs:
        The results folder. Targets of links out of it are not touched.
    queued:
        As for `look`.
    """
    path = store.path
    if path.is_symlink() or path.parent.is_symlink() or path.resolve().parents[1] != runs.resolve():
        raise StoreError(
            f"{path} is, or lies in, a link to {path.resolve()}: links are not followed; remove it there"
        )
    waits = [group for group in groups(store, queued) if group.state == "submitted"]
    if waits:
        raise StoreError(
            f"{path} waits in a queue ({waits[0].where}): cancel that first; nothing was deleted"
        )
    size, _ = _usage(path)
    gone = path.with_name(f".deleted-{path.name}-{secrets.token_hex(4)}")
    move_away(store, gone)
    try:
        (gone / "entry.json").unlink()  # so that what is left, if this is interrupted, is no entry
        shutil.rmtree(gone)
    except OSError as error:
        raise StoreError(f"cannot remove {gone}: {error.strerror or error}") from None
    return size


def withdraw(stores: Sequence[EntryStore], seeds: Sequence[int], reason: str) -> int:
    """Record why seeds, there or not, are no longer asked for, and delete them; returns the bytes freed."""
    for store in stores:
        if unknown := sorted(set(seeds) - {*requests.read(store)[0], *store.seeds()}):
            raise OptionError(f"--seeds: {store.path} has no seeds {format_seeds(unknown)}, missing or not")
    freed = 0
    with contextlib.ExitStack() as claims:
        for store in stores:
            claims.callback(acquire(store, seeds).release)
        for store in stores:
            requests.add(store, seeds, withdrawn=reason)
            for folder in (store.seed(seed).path for seed in seeds):
                freed += _usage(folder)[0]
                shutil.rmtree(folder, ignore_errors=True)
    return freed
