"""Trains one group of seeds epoch by epoch, and writes records and checkpoints to the folder of each one's entry.

Killed at any moment and resumed, a group ends with the same curves and parameters, byte for byte, as a group that
never stopped: lines newer than the checkpoint are cut. `qrlsuite.training.trainer` trains; this module has its files.
"""

from __future__ import annotations

import datetime
import math
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from safetensors.numpy import save as encode

from qrlsuite import options, registry
from qrlsuite.errors import EnvironmentFailure, PluginError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.results import checkpoint, codes, probes, provenance, store
from qrlsuite.results.records import (
    MEASURED,
    EpochLine,
    ProbeRecord,
    Provenance,
    RunRecord,
    TimingLine,
)
from qrlsuite.training.interrupts import Interruptible
from qrlsuite.training.trackers import EventSink, asked
from qrlsuite.training.trainer import Epoch, Report, Trainer

CHECKPOINT_SECONDS = 60.0


class GroupProbe(Protocol):
    """Shows, while a group is trained, that its middle seed does not depend on the others: `qrlsuite.engine.probe`."""

    def require_unchanged(self, trainer: Trainer) -> str:
        """Refuse to train beside seeds that would not become the same again; return why none was trained again."""

    def begin(self, trainer: Trainer) -> bool:
        """Look at a training before its first epoch; returns whether `judge` can be called."""

    def add(self, trainer: Trainer, lines: Sequence[EpochLine], state: checkpoint.Arrays) -> bool:
        """Add an epoch; returns whether `judge` can be called."""

    def judge(self) -> ProbeRecord:
        """Return the value of `probe` in `run.json`."""


def lines_of(epoch: Epoch) -> list[EpochLine]:
    """Return the record of an epoch as plain values: one line of `epochs.jsonl` for each seed."""
    lines = []
    for s, scores in enumerate(epoch.scores):
        line: dict[str, Any] = {"epoch": epoch.number, "scores": store.shortest(scores)}
        measured = {f"{MEASURED}.{name}": values for name, values in epoch.measured.items()}
        for name, values in {**epoch.metrics, **measured}.items():
            value = float(values[s])
            line[name] = value if math.isfinite(value) else None
        if epoch.executions[s]:
            line["executions"] = epoch.executions[s]
        if epoch.diverged[s]:
            line["diverged"] = True
        lines.append(EpochLine.model_validate(line))
    return lines


def timing_of(epoch: Epoch, seeds: int) -> TimingLine:
    """Return a seed's line of `timings.jsonl` for an epoch of a group: the seed's share of the time, where and when."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    timing = {name: round(value / seeds, 6) for name, value in epoch.seconds.items()}
    where = {"group": seeds, "host": socket.gethostname(), "time": now}
    return TimingLine.model_validate({"epoch": epoch.number, **timing, **where})


class GroupFiles:
    """The files of a group of an entry's seeds while it is trained.

    Parameters
    ----------
    seeds:
        Protocol seeds; all at the same epoch.
    """

    def __init__(
        self,
        entry: Entry,
        entry_store: store.EntryStore,
        seeds: Sequence[int],
        events: EventSink,
        code: CodeIdentity,
    ) -> None:
        self.entry, self.store, self.seeds, self.events = entry, entry_store, list(seeds), events
        self.code = code
        self.parameters: dict[str, int] = {}
        self.saved_epoch = 0

    def resume(self) -> tuple[int, checkpoint.Arrays]:
        """Return the epoch and the state of the newest checkpoint; cut newer lines.

        Without a checkpoint, the epoch is 0, and the state an argument of `Trainer.start`: empty, or first agents.
        """
        epoch, arrays = checkpoint.load(self.store, self.seeds)
        for seed in self.seeds:
            folder = self.store.seed(seed)
            old = folder.record()
            if old is not None and old.finished and epoch < old.epochs:
                raise StoreError(
                    f"{folder.path} finished {old.epochs} epochs and its checkpoint is gone: it cannot be "
                    "extended; choose another folder with --runs DIR, or delete the seed's folder to start again"
                )
            if (held := folder.cut(epoch)) < epoch:
                raise StoreError(
                    f"{folder.path} holds {held} epochs, its checkpoint {epoch}: restore the file, or delete the "
                    "seed's folder to start again"
                )
        self.saved_epoch = epoch
        if epoch == 0 and self.entry.start is not None:
            arrays = self.store.initial(self.seeds)
        return epoch, arrays

    def begin(self, epoch: int, parameters: Mapping[str, int], origin: Provenance) -> None:
        """Write `run.json` of every seed: it is being trained from an epoch on.

        Parameters
        ----------
        parameters:
            The numbers of parameters, see `ModelBuilder.trained`.
        origin:
            Where and with which versions, see `qrlsuite.results.provenance.collect`.
        """
        self.parameters = dict(parameters)
        for seed in self.seeds:
            folder = self.store.seed(seed)
            old = folder.record()
            begun: dict[str, Any] = {"code": self.code.record()} if epoch == 0 else {}
            record = RunRecord.model_validate(
                {
                    **self._seed_record(seed),
                    **({} if old is None else old.begun),
                    "status": "running",
                    "epochs": epoch,
                    **begun,
                    "provenance": _with_origin(old, origin),
                }
            )
            folder.write_record(record)
            history = [line.content for line in folder.epochs()] if self.events.heard("run_started") else []
            self.events.send("run_started", run=record.told(folder.path, history=history))

    def add_probe(self, probe: ProbeRecord) -> None:
        """Note a probe's result in `run.json` of every seed."""
        for seed in self.seeds:
            folder = self.store.seed(seed)
            if (record := folder.record()) is not None:
                folder.write_record(record.changed(probe=probe))

    def _seed_record(self, seed: int) -> dict[str, Any]:
        planned = {} if self.entry.study is None else {"plan": self.entry.study}
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
            "parameters": self.parameters,
            "seed": seed,
            "interactions_per_epoch": self.entry.task.file.protocol.interactions,
        }

    def record(self, lines: Sequence[EpochLine], timing: TimingLine) -> None:
        """Append an epoch's line and timing to every seed, and send the line to the trackers.

        Parameters
        ----------
        lines:
            One for each seed, see `lines_of`.
        """
        timing_line = store.json_line(timing.content)
        for seed, line in zip(self.seeds, lines):
            folder = self.store.seed(seed)
            store.append(folder.lines, store.json_line(line.content))
            store.append(folder.timings, timing_line)
            run = {**self._seed_record(seed), "folder": str(folder.path)}
            self.events.send("epoch_finished", run=run, record=line.content)

    def save(self, epoch: int, arrays: checkpoint.Arrays) -> None:
        """Write the checkpoint of an epoch, if it is newer than the one on disk."""
        if epoch <= self.saved_epoch:
            return
        for seed in self.seeds:
            self.store.seed(seed).sync()
        checkpoint.save(self.store, self.seeds, epoch, arrays)
        self.saved_epoch = epoch

    def finish(self, epoch: int, policy: checkpoint.Arrays) -> None:
        """Publish the trained agents, compact the lines, and mark every seed as finished."""
        for s, seed in enumerate(self.seeds):
            folder = self.store.seed(seed)
            agent = {name: np.ascontiguousarray(array[s]) for name, array in policy.items()}
            store.write_atomically(folder.agent, encode(agent))
            diverged = next((line.epoch for line in folder.compact() if line.diverged), None)
            noted = {} if diverged is None else {"diverged": diverged}
            content = self._seed_record(seed) if (begun := folder.record()) is None else begun.content
            record = RunRecord.model_validate({**content, "status": "finished", "epochs": epoch, **noted})
            folder.write_record(record)
            self.events.send("run_finished", run=record.told(folder.path))


def _with_origin(record: RunRecord | None, origin: Provenance) -> list[Provenance]:
    origins = [] if record is None else record.provenance
    return origins if origin in origins else [*origins, origin]


Part = tuple[Entry, store.EntryStore, Sequence[int]]
"""An entry, its folder, and its seeds in a group."""


def _required_code(entry: Entry, entry_store: store.EntryStore) -> CodeIdentity:
    """Return the identity of the code here, unless another one was sent to train the entry or has begun it."""
    code = identity.of(entry)
    codes.require(entry_store, code, socket.gethostname())
    return code


class GroupRun:
    """The training of one group of seeds in this process, with its files.

    Parameters
    ----------
    parts:
        The entries, their folders and seeds, all at the same epoch. Several entries are trained in one population, with
        the results of separate training.
    device:
        Where the populations live: `cpu`, `cuda` or `cuda:1`.
    report:
        Called after every round with the group's progress.
    held:
        Whether the seeds are still this process's own; nothing is written any more once they are not.
    probe:
        The probe of the population's middle seed, or None.

    Attributes
    ----------
    files:
        The files of each entry, in the order of their agents in the population.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        epochs: int,
        device: str = "cpu",
        report: Report = lambda progress: None,
        held: Callable[[], bool] = lambda: True,
        probe: GroupProbe | None = None,
    ) -> None:
        self.epochs, self.held, self.probe = epochs, held, probe
        found = [_required_code(entry, entry_store) for entry, entry_store, _ in parts]
        self.trainer = Trainer(
            [entry for entry, _, seeds in parts for _ in seeds],
            [seed for *_, seeds in parts for seed in seeds],
            device,
            report,
        )
        self.progress, self.report = self.trainer.progress, report
        events = EventSink(registry.load(), asked())
        self.files = [GroupFiles(*part, events, code) for part, code in zip(parts, found)]
        self.progress.epochs, self.progress.warnings = epochs, events.problems
        self._snapshot: tuple[int, checkpoint.Arrays] | None = None
        self._lines: list[EpochLine] = []

    def run(self) -> None:
        """Train to the last epoch; on an interruption, save the last finished epoch and raise it again."""
        with Interruptible() as guard:
            try:
                self._compile()  # first, since records say which kernels compute
                if self.probe is not None:
                    self._compare(self.probe)
                with guard.deferred():
                    self._begin()
                if (
                    self.probe is not None
                    and self.epochs > self.trainer.epoch
                    and self.probe.begin(self.trainer)
                ):
                    self._judge(guard, self.probe)
                last_save = time.monotonic()
                while self.trainer.epoch < self.epochs:
                    epoch = self.trainer.train_epoch()
                    with guard.deferred():
                        self._record(epoch)
                        self._snapshot = (epoch.number, self.trainer.capture())
                        if time.monotonic() - last_save >= CHECKPOINT_SECONDS or epoch.number == self.epochs:
                            self._save()
                            last_save = time.monotonic()
                    if self.probe is not None and self.probe.add(
                        self.trainer, self._lines, self._snapshot[1]
                    ):
                        self._judge(guard, self.probe)
                with guard.deferred():
                    self._finish()
            except (KeyboardInterrupt, EnvironmentFailure, PluginError):
                with guard.deferred():
                    self._save()
                raise

    def parts(self) -> Iterator[tuple[GroupFiles, slice]]:
        """Yield the files of each entry, and the places of its seeds in the population."""
        end = 0
        for files in self.files:
            begin, end = end, end + len(files.seeds)
            yield files, slice(begin, end)

    def _begin(self) -> None:
        """Start fresh, or resume from the newest checkpoints."""
        states = [files.resume() for files in self.files]
        epoch, first = states[0]
        where = ", ".join(str(files.store.path) for files in self.files)
        if any((own, arrays.keys()) != (epoch, first.keys()) for own, arrays in states):
            raise StoreError(f"{where}: these entries are at different epochs, or of different versions")
        try:
            joined = {name: np.concatenate([arrays[name] for _, arrays in states]) for name in first}
            if epoch:
                self.trainer.restore(epoch, joined)
        except (StoreError, ValueError) as error:
            raise StoreError(f"{where}: {error}") from error
        if not epoch:
            self.trainer.start(joined)
        self.progress.epoch = self.trainer.epoch
        parameters = self.trainer.models.trained()
        origin = provenance.of(self.trainer.entry, self.trainer.device)
        for files in self.files:
            files.begin(self.trainer.epoch, parameters, origin)

    def _compile(self) -> None:
        """Compile circuits, where the model has any, before the first epoch: that is once per machine."""
        if self.trainer.models.circuits:
            self.progress.phase = "compiling"
            self.report(self.progress)
            self.trainer.models.compile_circuits()

    def _compare(self, probe: GroupProbe) -> None:
        """Compare an earlier seed with its record."""
        self.progress.phase = "comparing"
        self.report(self.progress)
        if reason := probe.require_unchanged(self.trainer):
            self.progress.warnings.append(reason)

    def _judge(self, guard: Interruptible, probe: GroupProbe) -> None:
        """Make the probe, and record its result; an interruption ends it, and the same command makes it again."""
        self.progress.phase = "probing"
        self.report(self.progress)
        found = probe.judge()
        with guard.deferred():
            for files in self.files:
                files.add_probe(found)
        if found.result == probes.DIFFERS:
            middle = self.trainer.S // 2
            raise probes.refusal(next(f.store for f, places in self.parts() if middle < places.stop), found)

    def _record(self, epoch: Epoch) -> None:
        """Append one line per seed, and show the progress."""
        self._require_held()
        lines, timing = lines_of(epoch), timing_of(epoch, len(self.trainer.seeds))
        self._lines = lines
        for files, places in self.parts():
            files.record(lines[places], timing)
        self.progress.finished_epoch(
            epoch.number, epoch.scores.mean(axis=1).tolist(), epoch.diverged.tolist()
        )
        self.report(self.progress)

    def _require_held(self) -> None:
        """Refuse to write seeds that another worker has taken over."""
        if not self.held():
            raise StoreError(
                "another worker has taken these seeds over, and goes on from their last checkpoint: nothing more is "
                "written here"
            )

    def _save(self) -> None:
        """Write the checkpoint of the last finished epoch, if it is newer than the one on disk."""
        if self._snapshot is None or not self.held():
            return
        epoch, arrays = self._snapshot
        for files, places in self.parts():
            files.save(epoch, {name: array[places] for name, array in arrays.items()})

    def _finish(self) -> None:
        """Publish the trained agents, and mark every seed as finished."""
        self._require_held()
        policy = self.trainer.policy()
        for files, places in self.parts():
            files.finish(self.trainer.epoch, {name: array[places] for name, array in policy.items()})
        self.progress.phase = "finished"
        self.report(self.progress)
