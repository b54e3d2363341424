"""An engine's input and result; engines import them from `qrlsuite.engine.api`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.results.seeds import SeedGroup, format_seeds
from qrlsuite.results.store import EntryStore

Snapshot = dict[str, dict[str, Any]]
"""Progress by group id."""

Show = Callable[[Snapshot], None]


@dataclass(frozen=True)
class Missing:
    """The seeds of an entry that are to be trained, and in which groups.

    Attributes
    ----------
    store:
        The entry's folder in it, which need not exist yet.
    busy:
        Seeds that another process trains, or that wait in a queue.
    groups:
        The other missing seeds, in groups.
    """

    runs: Path
    entry: Entry
    store: EntryStore
    seeds: Sequence[int]
    epochs: int
    busy: frozenset[int] = frozenset()
    groups: Sequence[SeedGroup] = field(default_factory=list)
    code: CodeIdentity | None = None

    @property
    def todo(self) -> list[int]:
        """The seeds of the groups, sorted."""
        return sorted(seed for group in self.groups for seed in group.seeds)

    @property
    def left(self) -> int:
        """Epochs to train, summed over the seeds; 0 for seeds that an interrupted longer run has already trained."""
        return sum(len(group.seeds) * max(0, self.epochs - group.epoch) for group in self.groups)

    @property
    def together(self) -> int | None:
        """Seeds of the largest group, None where there is none."""
        return max((len(group.seeds) for group in self.groups), default=None)


@dataclass(frozen=True)
class Work:
    """Groups of one entry's seeds, to be trained to `epochs`, `workers` at a time.

    Attributes
    ----------
    others:
        Folders of further entries whose seeds are trained in the same populations; only an engine whose groups run on
        this machine gets any. `worker_command` names them.
    script:
        Words of `worker_command` that hand a script's command over; a worker starts no other.
    """

    store: EntryStore
    groups: Sequence[SeedGroup]
    epochs: int
    workers: int
    device: str = "cpu"
    others: Sequence[EntryStore] = ()
    script: Sequence[str] = ()


@dataclass(frozen=True)
class EngineOutcome:
    """How the groups ended.

    Attributes
    ----------
    failed:
        Message of failure by group id.
    taken:
        By group id, who else is training seeds of a group that was therefore left to them.
    submitted:
        Where the groups wait to be run, for engines that submit and leave: one line for the user.
    """

    failed: dict[str, str] = field(default_factory=dict)
    taken: dict[str, str] = field(default_factory=dict)
    submitted: str | None = None

    def __add__(self, other: EngineOutcome) -> EngineOutcome:
        """Return how the groups of both ended."""
        lines = [line for line in (self.submitted, other.submitted) if line is not None]
        return EngineOutcome(
            {**self.failed, **other.failed}, {**self.taken, **other.taken}, "\n".join(lines) or None
        )


def job_name(work: Work, group: SeedGroup, works: Sequence[Work]) -> str:
    """Return the name of a group in snapshots and outcomes: its id, after the entry's name where there are several."""
    return group.id if len(works) == 1 else f"{work.store.path.name} {group.id}"


class Engine(Protocol):
    """A place where groups run; built as `factory(options)`, `options` None for a spec without options."""

    def workers(self, requested: int | None) -> int:
        """Return how many groups may run at a time, given the requested number."""

    def queued(self, store: EntryStore) -> set[int]:
        """Return the seeds of an entry that were handed to this engine before and still wait for their turn."""

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        """Train the groups, calling `show` with their progress now and then; or hand them over and return.

        Of all works together, as many groups at a time as `workers` of the first says. `job_name` names a group.
        """


def worker_command(work: Work, group: SeedGroup) -> list[str]:
    """Return the command line that trains a group."""
    # -P: never import from the folder one stands in, which may be a source tree without its plugins
    command = [sys.executable, "-P", "-m", "qrlsuite.engine.worker"]
    return [
        *command,
        *(str(store.path.absolute()) for store in (work.store, *work.others)),
        "--seeds",
        format_seeds(group.seeds),
        "--epochs",
        str(work.epochs),
        "--device",
        work.device,
        *work.script,
    ]


def raise_failures(outcome: EngineOutcome) -> None:
    """Turn failed groups into one error."""
    if outcome.failed:
        alike: dict[str, list[str]] = {}
        for name, message in sorted(outcome.failed.items()):
            alike.setdefault(message, []).append(name)
        lines = [
            f"{'group' if len(names) == 1 else 'groups'} {', '.join(names)}: {message}"
            for message, names in alike.items()
        ]
        raise QrlSuiteError(
            f"{len(outcome.failed)} group(s) failed, finished epochs are kept: " + "; ".join(lines)
        )
