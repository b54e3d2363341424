"""Where seeds are trained: an engine with its workers, and how it divides the seeds that are missing among them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from qrlsuite import registry, specs
from qrlsuite.engine import api, remote
from qrlsuite.engine.api import Engine, EngineOutcome, Missing, RemoteEngine
from qrlsuite.engine.local import LocalEngine
from qrlsuite.results.seeds import LARGEST_GROUP, SeedGroup
from qrlsuite.training import device as devices
from qrlsuite.training import memory


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

    @classmethod
    def create(
        cls,
        engine: str = "local",
        workers: int | None = None,
        options: Mapping[str, Any] | None = None,
        device: str = "cpu",
    ) -> Where:
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
        return cls(built, built.workers(workers), device, spec.submits, engine, spec.remote or spec.submits)

    def run(self, missing: Missing, show: api.Show) -> EngineOutcome:
        """Let the engine train the groups of missing seeds."""
        handed = api.Work(missing.store, missing.groups, missing.epochs, self.workers, self.device)
        if isinstance(self.engine, RemoteEngine):
            return remote.train(self.engine, handed, show)
        return self.engine.run(handed, show)

    @property
    def room(self) -> int:
        """How many seeds can be trained side by side; 1 where the engine trains one entry after the other."""
        return LARGEST_GROUP * self.workers if isinstance(self.engine, LocalEngine) else 1

    def divide(self, several: Sequence[Missing]) -> list[list[Missing]]:
        """Group the entries that one population can train: each list of them is one call of `run_together`."""
        alike: dict[str, list[Missing]] = {}
        for missing in several:
            if missing.groups:
                # of an entry that another process trains too, other seeds are free than of the rest
                side_by_side = isinstance(self.engine, LocalEngine) and not missing.busy
                key = missing.entry.population_key if side_by_side else missing.entry.hash
                alike.setdefault(key, []).append(missing)
        return list(alike.values())

    def run_together(self, several: Sequence[Missing], show: api.Show) -> EngineOutcome:
        """Let the engine train one of the lists of `divide` to the same epoch: several entries in populations."""
        if len(several) > 1 and isinstance(self.engine, LocalEngine):
            return self.engine.run_all(self._populations(several), show)
        return self.run(several[0], show)

    def _populations(self, several: Sequence[Missing]) -> list[api.Work]:
        """Divide entries that one population can train among the workers.

        Seeds are divided first, and entries where there are more workers than seeds, or groups would be too large.
        """
        seeds = sorted({seed for missing in several for seed in missing.todo})
        pieces = min(self.workers, len(seeds))
        groups = [
            SeedGroup(tuple(seeds[i * len(seeds) // pieces : (i + 1) * len(seeds) // pieces]), 0)
            for i in range(pieces)
        ]
        free = memory.available() if self.device == "cpu" else None
        parts = min(len(several), math.ceil(self.workers / pieces))
        while parts < len(several):
            size = math.ceil(len(several) / parts) * math.ceil(len(seeds) / pieces)
            needed = min(self.workers, parts * pieces) * memory.group_bytes(several[0].entry, size)
            if size <= LARGEST_GROUP and (free is None or needed <= free):
                break
            parts += 1
        work = []
        for i in range(parts):
            first, *others = several[i * len(several) // parts : (i + 1) * len(several) // parts]
            stores = [missing.store for missing in others]
            work.append(api.Work(first.store, groups, first.epochs, self.workers, self.device, stores))
        return work
