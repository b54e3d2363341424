"""The interfaces of engines, which decide only *where* groups of seeds are trained.

An `Engine` runs `python -m qrlsuite.engine.worker` for every group, on machines that share the results folder. Whatever
it starts finds everything it needs in the entry's folder and leaves everything there, and may be started twice for the
same group: the second finds the seeds claimed, or done. `qrlsuite/engine/local.py` is the shortest example.

A `RemoteEngine` needs no shared folder: it carries tasks to workers and answers back, both bytes, and a worker calls
`qrlsuite.training.remote_task.work_on(task)`. Claims, trackers and the results folder stay with the process that sends
the tasks (`qrlsuite/engine/remote.py`). `qrlsuite/engine/dask.py` is the example.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

from qrlsuite import options, registry, specs
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment.entry import Entry
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
    def todo(self) -> list[int]:
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


@dataclass(frozen=True)
class Work:
    """Input of an engine: groups of one entry's seeds, to be trained to `epochs`, `workers` at a time.

    Attributes
    ----------
    others:
        Folders of further entries, of which the same seeds are trained in the same populations; only the local engine
        is given any.
    """

    store: EntryStore
    groups: Sequence[SeedGroup]
    epochs: int
    workers: int
    device: str = "cpu"
    others: Sequence[EntryStore] = ()


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


class Engine(Protocol):
    """A place where groups run; built as `factory(options)`, `options` None for a spec without options."""

    def workers(self, requested: int | None) -> int:
        """Return how many groups may run at a time, given what the user asked for."""

    def queued(self, store: EntryStore) -> set[int]:
        """Return the seeds of an entry that were handed to this engine before and still wait for their turn."""

    def run(self, work: Work, show: Show) -> EngineOutcome:
        """Train the groups, calling `show` with their progress now and then; or hand them over and return.

        Raises
        ------
        KeyboardInterrupt
            After Ctrl-C, when every worker has saved and ended.
        QrlSuiteError
            If nothing can be started.
        """


@dataclass(frozen=True)
class Answer:
    """What became of a task.

    Attributes
    ----------
    key:
        With which the task was sent.
    content:
        What `work_on` returned for it, None where the task was lost, as when its worker died.
    problem:
        Why it was lost.
    """

    key: str
    content: bytes | None
    problem: str = ""


class Link(Protocol):
    """A connection to workers that call `qrlsuite.training.remote_task.work_on`."""

    def send(self, key: str, task: bytes, priority: int) -> None:
        """Have a task worked on by any worker, now or when one is free.

        Parameters
        ----------
        key:
            New for every task.
        priority:
            Tasks with a higher one go first where they can; those of groups that have begun have a higher one.
        """

    def receive(self, seconds: float) -> list[Answer]:
        """Return the answers that have come, each once; waits for the first of them, that long at most.

        Raises
        ------
        QrlSuiteError
            If no further answer will come, as when the connection is lost.
        """

    def close(self) -> None:
        """Forget the tasks that have no answer yet, and disconnect."""


@runtime_checkable
class ChoosingLink(Link, Protocol):
    """A link that can choose who works on a task: now and then, a second worker repeats what a first one did."""

    def send_apart(self, key: str, task: bytes, priority: int, other: str) -> None:
        """Have a task worked on by another worker than the one that answered the task `other`, if there is another."""


@runtime_checkable
class RemoteEngine(Protocol):
    """Workers without a shared folder; built as `factory(options)`, `options` None for a spec without options."""

    def workers(self, requested: int | None) -> int:
        """Return how many groups may be trained at a time, given what the user asked for."""

    def queued(self, store: EntryStore) -> set[int]:
        """Return the seeds of an entry that were handed to this engine before and still wait for their turn."""

    def connect(self, workers: int, versions: Mapping[str, str | None]) -> Link:
        """Return a connection to workers.

        Parameters
        ----------
        workers:
            How many tasks will be sent at a time.
        versions:
            What a worker must have: versions of distributions, and of `python`. `work_on` refuses where they differ;
            a link that knows which worker has what sends it nothing.

        Raises
        ------
        QrlSuiteError
            If there is nobody to connect to.
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
    ]


def create(name: str, option_values: Mapping[str, Any]) -> Engine | RemoteEngine:
    """Build a registered engine.

    Parameters
    ----------
    option_values:
        Its options by name; None stands for an option that was not given.

    Raises
    ------
    UnknownNameError, OptionError
        If there is no such engine, or it has no such option or value.
    QrlSuiteError
        If a package that it needs is not installed; the message has the pip command.
    """
    spec = cast(specs.EngineSpec, registry.load().get("engines", name).spec)
    chosen_values = {key: value for key, value in option_values.items() if value is not None}
    if spec.options is None and chosen_values:
        raise OptionError(f"engine '{name}' has no options, got {', '.join(sorted(chosen_values))}")
    for module, command in spec.extras.items():
        if importlib.util.find_spec(module) is None:
            raise QrlSuiteError(f"engine '{name}' needs the package '{module}': {command}")
    chosen = None
    if spec.options is not None:
        chosen = options.build(specs.resolve(spec.options), chosen_values, f"engine '{name}'")
    return cast(Engine | RemoteEngine, specs.resolve(spec.factory)(chosen))


class Queues:
    """Queues of submitting engines; one that fails to answer is not asked again."""

    def __init__(self) -> None:
        self._engines: dict[str, Engine | RemoteEngine] = {}
        self._silent: dict[str, QrlSuiteError] = {}

    def waiting(self, store: EntryStore) -> set[int]:
        """Return the seeds of an entry that were handed to a queue and are still there.

        Raises
        ------
        QrlSuiteError
            If a queue that was handed seeds cannot be asked on this machine.
        """
        seeds: set[int] = set()
        for path in sorted(store.path.glob("*/submitted.json")):  # in a folder that has the engine's name
            name = path.parent.name
            if name in self._silent:
                raise self._silent[name]
            try:
                if name not in self._engines:
                    self._engines[name] = create(name, {})
                seeds |= self._engines[name].queued(store)
            except QrlSuiteError as error:
                self._silent[name] = error
                raise
        return seeds


def raise_failures(outcome: EngineOutcome) -> None:
    """Turn failed groups into one error.

    Raises
    ------
    QrlSuiteError
        Naming every group that failed and why; groups that failed alike are named together.
    """
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
