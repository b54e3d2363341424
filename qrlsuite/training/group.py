"""Trains one group of seeds epoch by epoch, and writes records and checkpoints to the entry's folder.

Killed at any moment and resumed, a group ends with the same curves and parameters, byte for byte, as one never
stopped: lines newer than the checkpoint are cut. `qrlsuite.training.trainer` trains; here is what is on disk of it.
"""

from __future__ import annotations

import datetime
import math
import socket
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from safetensors.numpy import save as encode

from qrlsuite import options, registry
from qrlsuite.errors import EnvironmentFailure, StoreError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import checkpoint, provenance, store
from qrlsuite.training.interrupts import Interruptible
from qrlsuite.training.trackers import EventSink, asked
from qrlsuite.training.trainer import Epoch, Report, Trainer

CHECKPOINT_SECONDS = 60.0


class GroupRun:
    """The training of one group of seeds of an entry, with its files.

    Parameters
    ----------
    entry, entry_store:
        What to run, and its folder.
    seeds:
        Protocol seeds; all at the same epoch.
    epochs:
        The epoch at which to stop.
    device:
        Where the populations live: `cpu`, `cuda` or `cuda:1`.
    report:
        Called after every round with the group's progress.

    Raises
    ------
    QrlSuiteError
        If the entry cannot be built, or there is no such device.
    """

    def __init__(
        self,
        entry: Entry,
        entry_store: store.EntryStore,
        seeds: Sequence[int],
        epochs: int,
        device: str = "cpu",
        report: Report = lambda progress: None,
    ) -> None:
        self.entry, self.store, self.epochs = entry, entry_store, epochs
        self.trainer = Trainer(entry, seeds, device, report)
        self.seeds, self.progress, self.report = self.trainer.seeds, self.trainer.progress, report
        self.events = EventSink(registry.load(), asked())
        self.progress.epochs, self.progress.warnings = epochs, self.events.problems
        self._saved_epoch = -1
        self._snapshot: tuple[int, checkpoint.Arrays] | None = None

    def run(self) -> None:
        """Train to the last epoch; on an interruption, save the last finished epoch and raise it again.

        Raises
        ------
        KeyboardInterrupt
            After an interruption, with everything saved.
        EnvironmentFailure, StoreError
            If the environment raises, or results cannot be written; finished epochs stay.
        """
        with Interruptible() as guard:
            try:
                with guard.deferred():
                    self._begin()
                last_save = time.monotonic()
                while self.trainer.epoch < self.epochs:
                    epoch = self.trainer.train_epoch()
                    with guard.deferred():
                        self._record(epoch)
                        self._snapshot = (epoch.number, self.trainer.capture())
                        if time.monotonic() - last_save >= CHECKPOINT_SECONDS or epoch.number == self.epochs:
                            self._save()
                            last_save = time.monotonic()
                with guard.deferred():
                    self._finish()
            except (KeyboardInterrupt, EnvironmentFailure):
                with guard.deferred():
                    self._save()
                raise

    def _begin(self) -> None:
        """Start fresh, or resume from the newest checkpoint; cut what is newer than it."""
        epoch, arrays = checkpoint.load(self.store, self.seeds)
        for seed in self.seeds:
            folder = self.store.seed(seed)
            old = folder.record() or {}
            if epoch < int(old.get("epochs", 0)) and old.get("status") == "finished":
                raise StoreError(
                    f"{folder.path} finished {old['epochs']} epochs and its checkpoint is gone: it cannot be "
                    "extended; choose another folder with --runs DIR, or delete the seed's folder to start again"
                )
            if (held := folder.cut(epoch)) < epoch:
                raise StoreError(
                    f"{folder.path} holds {held} epochs, its checkpoint {epoch}: restore the file, or delete the "
                    "seed's folder to start again"
                )
        if epoch:
            try:
                self.trainer.restore(epoch, arrays)
            except StoreError as error:
                raise StoreError(f"{self.store.path}: {error}") from error
            self._saved_epoch = epoch
        else:
            self.trainer.start()
        self.progress.epoch = self.trainer.epoch
        origin = provenance.collect(self.entry.distributions(), self.trainer.device)
        for seed in self.seeds:
            folder = self.store.seed(seed)
            old = folder.record() or {}
            made_with = [*old.get("provenance", [])]
            if origin not in made_with:
                made_with.append(origin)
            record = {
                **self._seed_record(seed),
                "status": "running",
                "epochs": self.trainer.epoch,
                "provenance": made_with,
            }
            folder.write_record(record)
            self.events.send("run_started", run={**record, "folder": str(folder.path)})

    def _seed_record(self, seed: int) -> dict[str, Any]:
        planned = {} if self.entry.plan is None else {"plan": self.entry.plan}
        return {
            **planned,
            "task": self.entry.task.name,
            "task_hash": self.entry.task.hash,
            "entry": self.entry.name,
            "label": self.entry.label,
            "algorithm": self.entry.algorithm.name,
            "algorithm_options": options.plain(self.entry.algorithm_options),
            "model": self.entry.model.name,
            "family": self.entry.model.family,
            "model_options": options.plain(self.entry.model_options),
            "parameters": self.trainer.models.trained(),
            "seed": seed,
            "interactions_per_epoch": self.entry.task.file.protocol.interactions,
        }

    def _record(self, epoch: Epoch) -> None:
        """Append one line per seed, and send it to the trackers."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        count = len(self.seeds)
        timing = {name: round(value / count, 6) for name, value in epoch.seconds.items()}
        timing_line = store.json_line(
            {"epoch": epoch.number, **timing, "group": count, "host": socket.gethostname(), "time": now}
        )
        for s, seed in enumerate(self.seeds):
            folder = self.store.seed(seed)
            line: dict[str, Any] = {"epoch": epoch.number, "scores": store.shortest(epoch.scores[s])}
            for name, values in epoch.metrics.items():
                value = float(values[s])
                line[name] = value if math.isfinite(value) else None
            if epoch.executions[s]:
                line["executions"] = epoch.executions[s]
            store.append(folder.lines, store.json_line(line))
            store.append(folder.timings, timing_line)
            run = {**self._seed_record(seed), "folder": str(folder.path)}
            self.events.send("epoch_finished", run=run, record=line)
        self.progress.epoch = epoch.number
        self.progress.seed_scores = epoch.scores.mean(axis=1).tolist()
        self.progress.median_score = float(np.median(self.progress.seed_scores))
        self.report(self.progress)

    def _save(self) -> None:
        """Write the checkpoint of the last finished epoch, if it is newer than the one on disk."""
        if self._snapshot is None or self._snapshot[0] <= self._saved_epoch:
            return
        epoch, arrays = self._snapshot
        for seed in self.seeds:
            self.store.seed(seed).sync()
        checkpoint.save(self.store, self.seeds, epoch, arrays)
        self._saved_epoch = epoch

    def _finish(self) -> None:
        """Publish the trained agents, compact the lines, and mark every seed as finished."""
        policy = self.trainer.policy()
        for s, seed in enumerate(self.seeds):
            folder = self.store.seed(seed)
            agent = {name: np.ascontiguousarray(array[s]) for name, array in policy.items()}
            store.write_atomically(folder.path / "final.safetensors", encode(agent))
            folder.compact()
            record = {
                **(folder.record() or self._seed_record(seed)),
                "status": "finished",
                "epochs": self.trainer.epoch,
            }
            del record["format_version"]
            folder.write_record(record)
            self.events.send("run_finished", run={**record, "folder": str(folder.path)})
        self.progress.phase = "finished"
        self.report(self.progress)
