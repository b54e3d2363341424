"""Where seeds are trained: an engine with its workers, and how it divides the seeds that are missing among them."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from qrlsuite import options, registry, specs
from qrlsuite.engine import script
from qrlsuite.engine.work import Engine, EngineOutcome, Missing, Show, Work
from qrlsuite.errors import OptionError, PluginError, QrlSuiteError
from qrlsuite.notation import parse_named
from qrlsuite.results.seeds import LARGEST_GROUP, SeedGroup
from qrlsuite.results.store import EntryStore
from qrlsuite.training import devices


@dataclass(frozen=True)
class Where:
    """Where seeds are trained: by which engine, how many groups at a time, on which device.

    Attributes
    ----------
    submits:
        Whether the engine hands the groups to a queue and returns.
    name:
        The engine's name, for messages.
    remote:
        Whether groups run on other machines than this one.
    same:
        Its author's word that a change of code changes nothing: the reason.
    """

    engine: Engine
    workers: int
    device: str = "cpu"
    submits: bool = False
    name: str = "local"
    remote: bool = False
    same: str | None = None

    @classmethod
    def create(
        cls,
        engine: str = "local",
        workers: int | None = None,
        device: str = "cpu",
    ) -> Where:
        """Build an engine.

        Parameters
        ----------
        engine:
            A name with options: `slurm partition=gpu`.
        workers:
            Groups that are trained at a time; None lets the engine choose.
        """
        devices.check(device)  # the machine that trains checks whether it has this device
        name, values = parse_named(engine, "--engine ")
        built = build(name, values)
        spec = registry.get(specs.EngineSpec, name)
        return cls(built, built.workers(workers), device, spec.submits, name, spec.remote or spec.submits)

    def run(self, several: Sequence[Missing], show: Show) -> EngineOutcome:
        """Let the engine train one of the lists of `divide` to the same epoch: several entries in populations."""
        if len(several) > 1:
            return self.engine.run(self._populations(several), show)
        [missing] = several
        words = script.words(missing.entry)
        work = Work(missing.store, missing.groups, missing.epochs, self.workers, self.device, script=words)
        return self.engine.run([work], show)

    @property
    def room(self) -> int:
        """How many seeds can be trained side by side; 1 where the engine trains one entry after the other."""
        return 1 if self.remote else LARGEST_GROUP * self.workers

    def divide(self, several: Sequence[Missing]) -> list[list[Missing]]:
        """Group the entries that one population can train: each list of them is one call of `run`."""
        alike: dict[str, list[Missing]] = {}
        for missing in several:
            if missing.groups:
                # of an entry that another process trains too, other seeds are free than of the rest
                side_by_side = not (self.remote or missing.busy)
                key = missing.entry.population_key if side_by_side else missing.entry.hash
                alike.setdefault(key, []).append(missing)
        return list(alike.values())

    def _populations(self, several: Sequence[Missing]) -> list[Work]:
        """Divide entries that one population can train among the workers.

        Seeds are divided first, and entries where there are more workers than seeds, or groups would be too large.
        """
        seeds = sorted({seed for missing in several for seed in missing.todo})
        pieces = min(self.workers, len(seeds))
        groups = [
            SeedGroup(tuple(seeds[i * len(seeds) // pieces : (i + 1) * len(seeds) // pieces]), 0)
            for i in range(pieces)
        ]
        parts = min(len(several), math.ceil(self.workers / pieces))
        while parts < len(several):
            if math.ceil(len(several) / parts) * math.ceil(len(seeds) / pieces) <= LARGEST_GROUP:
                break
            parts += 1
        work = []
        for i in range(parts):
            first, *others = several[i * len(several) // parts : (i + 1) * len(several) // parts]
            stores = [missing.store for missing in others]
            work.append(Work(first.store, groups, first.epochs, self.workers, self.device, stores))
        return work


def build(name: str, option_values: Mapping[str, Any]) -> Engine:
    """Build a registered engine."""
    spec = registry.get(specs.EngineSpec, name)
    if spec.options is None and option_values:
        raise OptionError(f"engine '{name}' has no options, got {', '.join(sorted(option_values))}")
    for module, command in spec.extras.items():
        if importlib.util.find_spec(module) is None:
            raise QrlSuiteError(f"engine '{name}' needs the package '{module}': {command}")
    chosen = None
    if spec.options is not None:
        chosen = options.build(specs.resolve(spec.options), option_values, f"engine '{name}'")
    built: Engine = specs.resolve(spec.factory)(chosen)
    if not callable(getattr(built, "run", None)):
        raise PluginError(f"engine '{name}' has no method `run(works, show)` (see `qrlsuite.engine.api`)")
    return built


class Queues:
    """Queues of submitting engines; one that fails to answer is not asked again."""

    def __init__(self) -> None:
        self._engines: dict[str, Engine] = {}
        self._silent: dict[str, QrlSuiteError] = {}

    def waiting(self, store: EntryStore) -> set[int]:
        """Return the seeds of an entry that were handed to a queue and are still there."""
        seeds: set[int] = set()
        for path in sorted(store.path.glob("*/submitted.json")):  # in a folder that has the engine's name
            name = path.parent.name
            if name in self._silent:
                raise self._silent[name]
            try:
                if name not in self._engines:
                    self._engines[name] = build(name, {})
                seeds |= self._engines[name].queued(store)
            except QrlSuiteError as error:
                self._silent[name] = error
                raise
        return seeds
