"""Progress of all entries of a results folder, from its files and from the queues of submitting engines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qrlsuite.engine.where import Queues
from qrlsuite.errors import QrlSuiteError
from qrlsuite.results import lookup
from qrlsuite.results.store import EntryStore, entries
from qrlsuite.results.survey import STATUSES, EntrySurvey, GroupStatus, delete, groups, look


@dataclass(frozen=True)
class EntryStatus:
    """An entry, and its groups that have not finished.

    Attributes
    ----------
    queue_problem:
        Why a queue that was handed some of its seeds did not answer; None where each did.
    study:
        The study with looks that trains it, in a folder of its own.
    """

    entry: EntrySurvey
    groups: tuple[GroupStatus, ...]
    queue_problem: str | None = None
    study: str | None = None

    @property
    def task(self) -> str:
        """The task's name, after the study's."""
        return self.entry.task if self.study is None else f"{self.study}: {self.entry.task}"

    @property
    def seeds(self) -> str:
        """Numbers of seeds by status, and of all that were asked for where more are to come."""
        there = self.entry.seeds
        text = ", ".join(f"{there[status]} {status}" for status in STATUSES if there.get(status)) or "none"
        return f"{text} of {self.entry.asked}" if self.entry.asked > sum(there.values()) else text

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            **dataclasses.asdict(self.entry),
            "folder": str(self.entry.folder),
            "queue_problem": self.queue_problem,
            "study": self.study,
            "groups": [
                {
                    "seeds": list(group.seeds),
                    "state": group.state,
                    "where": group.where,
                    "seconds_left": group.seconds_left,
                    **{
                        key: group.progress.get(key)
                        for key in ("phase", "epoch", "epochs", "median_score", "error")
                    },
                }
                for group in self.groups
            ],
        }


def survey(runs: Path, task: str | None = None, studies: Sequence[Path] = ()) -> list[EntryStatus]:
    """Look at every entry of a results folder and of studies in it, or of one task; disturbs no worker."""
    name = lookup.task_name(runs, task)
    statuses = []
    queues = Queues()
    for store in (store for folder in (runs, *studies) for store in entries(folder, name)):
        entry, queued, problem = look(store), None, None
        if entry.seeds.get("submitted"):
            try:
                queued = queues.waiting(store)
                entry = look(store, queued)
            except QrlSuiteError as error:
                problem = str(error)
        study = store.path.parents[1].name if store.path.parents[1] in studies else None
        statuses.append(EntryStatus(entry, tuple(groups(store, queued)), problem, study))
    return statuses


def choose(runs: Path, names: Sequence[str], task: str | None = None) -> list[EntrySurvey]:
    """Look at the entries that names mean, each once."""
    task = lookup.task_name(runs, task)
    stored = lookup.stored(entries(runs, task))
    searched = f"{runs}, task {task}" if task else runs
    return [
        look(store) for store in dict.fromkeys(lookup.choose(stored, name, searched).store for name in names)
    ]


def delete_each(runs: Path, chosen: Sequence[EntrySurvey]) -> int:
    """Delete entries with all their seeds; returns the bytes that were freed."""
    queues, freed = Queues(), 0
    for entry in chosen:
        store = EntryStore(entry.folder)
        queued = queues.waiting(store) if entry.seeds.get("submitted") else None
        freed += delete(runs, store, queued)
    return freed
