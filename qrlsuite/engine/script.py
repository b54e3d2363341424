"""Trains one seed of a script's entry: starts the command, follows the curve that it writes, and stores that.

A seed is stored whole, when its command has ended well; one that was killed begins again. The command comes with the
worker's own command line, from the call that opened the queue: an entry's folder starts nothing.
"""

from __future__ import annotations

import contextlib
import ctypes
import datetime
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite import options
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import FileError, QrlSuiteError, StoreError, listed
from qrlsuite.experiment import identity
from qrlsuite.experiment import script as scripts
from qrlsuite.experiment.entry import Entry, of_script
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.experiment.task import EXTERNAL, Task
from qrlsuite.results import codes, points, provenance
from qrlsuite.results.points import Points
from qrlsuite.results.progress import Progress, most_memory
from qrlsuite.results.store import EntryStore, SeedStore, json_line, write_atomically
from qrlsuite.statistics.grid import settled
from qrlsuite.training.interrupts import Interruptible

LOOK_SECONDS = 1.0
"""Seconds between two looks at a curve, at least; reading it takes at most a tenth of the time."""

PATIENCE = 10.0
"""Seconds that a command has to end when it is told to."""

REST = 0.1
"""Share of a run, at most, after its last score, which holds there: an episode that has not ended has none."""

KILL_WITH_PARENT = 1, signal.SIGKILL
"""Arguments of Linux's `prctl`: the command does not survive its worker."""

Report = Callable[[Progress], None]


class KilledError(Exception):
    """A signal ended the command: the worker ends, too, and is started again."""


def require_typed(entry: Entry) -> None:
    """Refuse a script whose command was neither typed in this call nor stands in the study file that it names."""
    if entry.script is not None and entry.folder is None:
        raise QrlSuiteError(
            f"'{entry.label}' was found in a results folder: its command is started only if you type it, or name the "
            "study file that has it"
        )


def words(entry: Entry) -> list[str]:
    """Return the words of a worker's command line that hand over the script's command; none for other entries."""
    require_typed(entry)
    if entry.script is None:
        return []
    values = {"folder": str(entry.folder), **options.plain(entry.script)}
    return ["--script", json_line(values).decode().strip()]


def _read(text: str, store: EntryStore) -> Entry:
    """Return the entry that a worker's command line hands over; its folder's record has to be that entry's."""
    values, record = json.loads(text), store.record()
    task = Task(record.task_file, str(store.path))
    given = {name: value for name, value in values.items() if name != "folder"}
    entry = of_script(task, record.identity.model, scripts.build(record.identity.model, given))
    if record.identity.algorithm != SCRIPT or entry.hash != record.hash:
        raise StoreError(f"{store.path} is not the entry of this command: nothing was started")
    return replace(entry, folder=Path(values["folder"]), study=record.plan)


def train(
    started: str, store: EntryStore, seeds: Sequence[int], output: Path, progress: Progress, report: Report
) -> None:
    """Start the command for each unfinished seed, follow its curve, and store that; with the files that are there now.

    Parameters
    ----------
    started:
        What `words` wrote.
    output:
        The file for all that the command prints.
    """
    entry = _read(started, store)
    progress.phase, progress.size = "training", len(seeds)
    for seed in sorted({*seeds} - store.finished(seeds, entry.epochs)):
        code = identity.of(entry)
        codes.require(store, code, socket.gethostname())
        run, before = _Run(entry, seed, output), os.times()
        progress.epoch = 0
        report(progress)
        run.follow(progress, report)
        after = os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        run.save(store, code, cpu)


class _Run:
    """One start of the command."""

    def __init__(self, entry: Entry, seed: int, output: Path) -> None:
        assert entry.script is not None
        assert entry.folder is not None
        self.entry, self.script, self.folder = entry, entry.script, entry.folder
        self.seed, self.output, self.file = seed, output, entry.task.file
        self.words = self.script.words(seed)
        self.name = f"seed {seed}: {shlex.join(self.words)}"
        self._before = self._files()

    def _files(self) -> dict[Path, tuple[int, int]]:
        """Return the files that the pattern names, with time and size: files of earlier runs do not change."""
        found = {}
        for path in self.script.files(self.seed, self.folder):
            with contextlib.suppress(OSError):
                status = path.stat()
                found[path] = status.st_mtime_ns, status.st_size
        return found

    def follow(self, progress: Progress, report: Report) -> None:
        """Run the command to its end; report how far its curve is."""
        self.output.parent.mkdir(parents=True, exist_ok=True)
        began, pause = time.monotonic(), LOOK_SECONDS
        self.output.unlink(missing_ok=True)  # a link in its place is not followed
        with self.output.open("xb") as output, Interruptible() as guard:
            with guard.deferred():  # a command without a name is not stopped
                process = _start(self.words, self.folder, output)
            try:
                while process.poll() is None:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(pause)
                    looked = time.monotonic()
                    self._look(progress, looked - began)
                    progress.memory = most_memory(process.pid) or progress.memory
                    report(progress)
                    pause = max(LOOK_SECONDS, 10 * (time.monotonic() - looked))
            finally:
                with guard.deferred():
                    _end(process)
        if process.returncode < 0:
            raise KilledError(f"{self.name} was ended by {signal.Signals(-process.returncode).name}")
        if process.returncode:
            lines = self.output.read_text(errors="replace").strip().splitlines() or ["it printed nothing"]
            raise QrlSuiteError(
                f"{self.name} ended with exit code {process.returncode}: {printable(lines[-1])[:300]} (all that it "
                f"printed: {self.output})"
            )

    def _look(self, progress: Progress, seconds: float) -> None:
        """Take in how far the curve is; a file that is just being written may end in the middle of a number."""
        try:
            found = self._points()
        except FileError:
            return
        every = self.file.protocol.interactions
        self._on_grid(found, 1)
        epoch = min(int(found.steps[-1]) // every, self.entry.epochs)
        scores = self._scores(found.scores[:-1])
        if epoch > progress.epoch and len(scores):
            progress.epoch_seconds = seconds / epoch
            progress.finished_epoch(epoch, [float(scores[-1])], [False])

    def _points(self) -> Points:
        files = [path for path, status in self._files().items() if status != self._before.get(path)]
        if not files:
            raise FileError(
                f"{self.name} wrote no file that '{self.script.curve}' names in {self.folder}: say where its curve is, "
                "as in curve=logs/{seed}.csv"
            )
        if len({path.parent for path in files}) > 1:
            raise FileError(
                f"{self.name} wrote curves of several runs: {listed([str(path) for path in files])}"
            )
        return points.read_run(files, self.script.metric)

    def _on_grid(self, found: Points, epochs: int) -> NDArray[np.float64]:
        """Return the scores after the first epochs (epochs,), each the last at or before its end."""
        new = self.entry.task.environment.name == EXTERNAL
        cure = f"say every={found.steps[0]}" if new else "give a task with longer epochs"
        return found.on_grid(self.file.protocol.interactions, epochs, f"{self.name}: its curve", cure)

    def _scores(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return scores in the unit of the task: fractions of the best one where it has one."""
        best = 1.0 if self.file.ranking.thresholds is not None else self.file.score.max_return or 1.0
        scores = settled(values / best)
        if self.file.ranking.thresholds is None and not ((scores > -1e-6) & (scores < 1 + 1e-6)).all():
            raise QrlSuiteError(
                f"{self.name}: its scores go from {values.min():g} to {values.max():g}, the task's from 0 to {best:g}"
            )
        return scores

    def _curve(self) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Return the scores after each epoch (T,), each the last at or before its end; and their source."""
        found, every = self._points(), self.file.protocol.interactions
        scores = self._on_grid(found, self.entry.epochs)
        last, steps = int(found.steps[-1]), every * self.entry.epochs
        if last < (1 - REST) * steps:
            raise QrlSuiteError(
                f"{self.name}: its curve ends at step {last} of {steps}: nobody knows the scores after it. If a run is "
                f"shorter, say steps={last // every * every}"
            )
        if self.script.kind is None and scripts.kind_of(found.metric) != self.script.scores:
            raise QrlSuiteError(
                f"{self.name}: its scores are '{found.metric}': say metric={found.metric}, or kind=NAME"
            )
        origin = {"file": printable(found.source), "points": len(found.steps), "last_step": last}
        return self._scores(scores), {**origin, "command": shlex.join(self.words)}

    def save(self, store: EntryStore, code: CodeIdentity, cpu: float) -> None:
        scores, origin = self._curve()
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        made_with = [provenance.collect([]).content]
        facts = {"code": code.record(), "imported": origin, "agent": False, "provenance": made_with}
        planned = {} if self.entry.study is None else {"plan": self.entry.study}
        times = {"epoch": len(scores), "cpu": cpu, "host": socket.gethostname(), "time": now}

        def write(made: SeedStore) -> None:
            made.write_curve(store.record(), scores, **planned, **facts)
            write_atomically(made.timings, json_line(times))

        store.put(self.seed, write)


def _start(command: list[str], folder: Path, output: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start a command without a shell, in a session of its own."""
    libc = ctypes.CDLL(None)
    try:
        return subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=(lambda: libc.prctl(*KILL_WITH_PARENT)) if sys.platform == "linux" else None,
        )
    except OSError as error:
        raise QrlSuiteError(
            f"{command[0]} cannot be started in {folder}: {error.strerror or error}"
        ) from None


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a command that still runs, with the processes that it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(process.pid, number)
                process.wait(PATIENCE)
