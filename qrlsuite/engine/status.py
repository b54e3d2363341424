"""Progress of all entries of a results folder, from its files and from the queues of submitting engines."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qrlsuite.engine.where import Queues
from qrlsuite.errors import QrlSuiteError
from qrlsuite.results import lookup
from qrlsuite.results.store import entries
from qrlsuite.results.survey import EntrySurvey, GroupStatus, groups, look


@dataclass(frozen=True)
class EntryStatus:
    """An entry, and its groups that have not finished.

    Attributes
    ----------
    queue_problem:
        Why a queue that was handed some of its seeds did not answer; None where each did.
    """

    entry: EntrySurvey
    groups: tuple[GroupStatus, ...]
    queue_problem: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            **dataclasses.asdict(self.entry),
            "folder": str(self.entry.folder),
            "queue_problem": self.queue_problem,
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


def survey(runs: Path, task: str | None = None) -> list[EntryStatus]:
    """Look at every entry of a results folder, or of one task in it; disturbs no worker.

    Raises
    ------
    UnknownNameError
        If there is no such task.
    StoreError
        If there is no such folder.
    """
    lookup.check_tasks(runs, task)
    statuses = []
    queues = Queues()
    for store in entries(runs, task):
        entry, queued, problem = look(store), None, None
        if entry.seeds.get("submitted"):
            try:
                queued = queues.waiting(store)
                entry = look(store, queued)
            except QrlSuiteError as error:
                problem = str(error)
        statuses.append(EntryStatus(entry, tuple(groups(store, queued)), problem))
    return statuses
