"""The interface of engines: an engine runs `python -m qrlsuite.engine.worker` for every group of seeds.

An engine decides only *where* groups run. Whatever it starts finds everything it needs in the entry's folder and
leaves everything there, and may be started twice for the same group: the second finds the seeds claimed, or done.
A Dask, Kubernetes or ssh engine is a plugin of one class; `qrlsuite/engine/local.py` is the shortest example.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

from qrlsuite import options, registry, specs
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.results.seeds import SeedGroup, format_seeds
from qrlsuite.results.store import EntryStore

Snapshot = dict[str, dict[str, Any]]
"""Progress by group id."""

Show = Callable[[Snapshot], None]


@dataclass(frozen=True)
class Work:
    """Input of an engine: groups of one entry's seeds, to be trained to `epochs`, `workers` at a time."""

    store: EntryStore
    groups: Sequence[SeedGroup]
    epochs: int
    workers: int
    device: str = "cpu"


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


def worker_command(work: Work, group: SeedGroup) -> list[str]:
    """Return the command line that trains a group."""
    # -P: never import from the folder one stands in, which may be a source tree without its plugins
    command = [sys.executable, "-P", "-m", "qrlsuite.engine.worker", str(work.store.path.absolute())]
    return [
        *command,
        "--seeds",
        format_seeds(group.seeds),
        "--epochs",
        str(work.epochs),
        "--device",
        work.device,
    ]


def create(name: str, option_values: Mapping[str, Any]) -> Engine:
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
    return cast(Engine, specs.resolve(spec.factory)(chosen))


class Queues:
    """Queues of submitting engines; one that fails to answer is not asked again."""

    def __init__(self) -> None:
        self._engines: dict[str, Engine] = {}
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
