"""Local processes: one per group, a few at a time, restarted when they die.

A worker that is killed loses at most what it did since its last checkpoint, and disturbs no other.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from qrlsuite.engine.groups import Group, ProgressFile, format_seeds
from qrlsuite.errors import QrlSuiteError
from qrlsuite.store import EntryStore

ATTEMPTS = 3
"""Deaths of a group's worker, without a finished epoch between them, after which it is given up."""

Snapshot = dict[str, dict[str, Any]]
"""Progress by group id."""


@dataclass
class _Job:
    group: Group
    progress: ProgressFile
    deaths: int = 0
    epoch_at_death: int = -1
    process: subprocess.Popen[bytes] | None = None
    output: IO[bytes] | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Outcome:
    """How the groups ended: `failed` maps group ids to messages."""

    failed: dict[str, str]


def run_groups(
    store: EntryStore,
    groups: Sequence[Group],
    epochs: int,
    workers: int,
    device: str,
    show: Callable[[Snapshot], None],
) -> Outcome:
    """Train groups in worker processes until all have finished or failed.

    Parameters
    ----------
    show:
        Called several times a second with every group's progress.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, when every worker has saved and ended.
    """
    jobs = [_Job(group, ProgressFile(store, group.id)) for group in groups]
    waiting = deque(jobs)
    running: list[_Job] = []
    failed: dict[str, str] = {}
    for job in jobs:
        job.progress.clear()
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                job = waiting.popleft()
                _start(job, store, epochs, device)
                running.append(job)
            time.sleep(0.2)
            for job in list(running):
                code = job.process.poll() if job.process else None
                if code is None:
                    continue
                running.remove(job)
                message = _ended(job, code)
                if message is None:
                    continue
                if message == "":
                    waiting.append(job)
                else:
                    failed[job.group.id] = message
            show({job.group.id: job.progress.read() for job in jobs})
    except BaseException:
        _stop(running)
        raise
    return Outcome(failed)


def _start(job: _Job, store: EntryStore, epochs: int, device: str) -> None:
    command = [sys.executable, "-m", "qrlsuite.engine.worker", str(store.path)]
    command += ["--seeds", format_seeds(job.group.seeds), "--epochs", str(epochs), "--device", device]
    command += ["--follow-parent"]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    job.output = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the worker has ended
    # a session of its own: Ctrl-C reaches the workers once, from here
    job.process = subprocess.Popen(
        command,
        env={**os.environ, **threads},
        stdin=subprocess.DEVNULL,
        stdout=job.output,
        stderr=job.output,
        start_new_session=True,
    )


def _ended(job: _Job, code: int) -> str | None:
    """Judge an ended worker: None finished, empty text to try again, else the message of its failure."""
    text = ""
    if job.output is not None:
        job.output.seek(0)
        text = job.output.read().decode(errors="replace").strip()
        job.output.close()
    if code == 0:
        return None
    progress = job.progress.read()
    if code in (2, 3):
        return str(progress.get("error") or text or "failed").removeprefix("qrlsuite: ")
    epoch = int(progress.get("epoch", 0))
    job.deaths = 1 if epoch > job.epoch_at_death else job.deaths + 1
    job.epoch_at_death = epoch
    if job.deaths < ATTEMPTS:
        return ""
    reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    last = f": {text.splitlines()[-1]}" if text else ""
    return f"its worker died {ATTEMPTS} times ({reason}){last}\n{text}"


def _stop(running: Sequence[_Job], patience: float = 60.0) -> None:
    """Ask every worker to save and end; after `patience` seconds, end them."""
    processes = [job.process for job in running if job.process is not None]
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + patience
    for process in processes:
        try:
            process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def raise_failures(outcome: Outcome) -> None:
    """Turn failed groups into one error.

    Raises
    ------
    QrlSuiteError
        Naming every group that failed and why.
    """
    if outcome.failed:
        lines = [f"group {name}: {message}" for name, message in sorted(outcome.failed.items())]
        raise QrlSuiteError(f"{len(lines)} group(s) failed, finished epochs are kept: " + "; ".join(lines))
