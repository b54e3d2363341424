"""Local processes: one per group, a few at a time, restarted when they die.

A worker that is killed loses at most what it did since its last checkpoint, and disturbs no other.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections import deque
from dataclasses import dataclass, field
from typing import IO

from qrlsuite.engine.api import EngineOutcome, Show, Work, worker_command
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore

ATTEMPTS = 3
"""Deaths of a group's worker, without a finished epoch between them, after which it is given up."""

IGNORED = (signal.SIGUSR1, signal.SIGUSR2)
"""Signals with which a cluster warns its jobs: they reach every process, and a worker is told by its supervisor."""


@dataclass
class _Job:
    group: SeedGroup
    progress: ProgressFile
    deaths: int = 0
    epoch_at_death: int = -1
    process: subprocess.Popen[bytes] | None = None
    output: IO[bytes] | None = field(default=None, repr=False)


def usable_cores() -> int:
    """Return the number of cores that this process may use; where the system does not say, that of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS


class LocalEngine:
    """Supervises worker processes on this machine."""

    def __init__(self, options: None = None) -> None:
        self._running: list[_Job] = []

    def workers(self, requested: int | None) -> int:
        """Return the number asked for, else one per core that this process may use."""
        return requested or usable_cores()

    def queued(self, store: EntryStore) -> set[int]:
        """Return nothing: what waits for a local process waits in that process."""
        return set()

    def run(self, work: Work, show: Show) -> EngineOutcome:
        """Train groups in worker processes until all have finished or failed.

        Raises
        ------
        KeyboardInterrupt
            After Ctrl-C, when every worker has saved and ended.
        """
        jobs = [_Job(group, ProgressFile(work.store, group.id)) for group in work.groups]
        waiting = deque(jobs)
        outcome = EngineOutcome()
        for job in jobs:
            job.progress.clear()
        try:
            while waiting or self._running:
                while waiting and len(self._running) < work.workers:
                    job = waiting.popleft()
                    self._running.append(job)
                    _start(job, work)
                time.sleep(0.2)
                for job in list(self._running):
                    code = job.process.poll() if job.process else None
                    if code is None:
                        continue
                    self._running.remove(job)
                    if _ended(job, code, outcome):
                        waiting.append(job)
                show({job.group.id: job.progress.read() for job in jobs})
        except BaseException:
            self.stop()
            raise
        return outcome

    def stop(self, patience: float = 60.0) -> None:
        """Ask every worker to save and end; after `patience` seconds, end them."""
        processes = [job.process for job in self._running if job.process is not None]
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
        for job in self._running:
            if job.output is not None:
                job.output.close()
        self._running.clear()


def _start(job: _Job, work: Work) -> None:
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    job.output = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the worker has ended
    # a session of its own: Ctrl-C reaches the workers once, from here
    job.process = subprocess.Popen(
        [*worker_command(work, job.group), "--follow-parent", str(os.getpid())],
        env={**os.environ, **threads},
        stdin=subprocess.DEVNULL,
        stdout=job.output,
        stderr=job.output,
        start_new_session=True,
        preexec_fn=_ignore_warnings,  # sets signals only: takes no lock that another thread may hold
    )


def _ignore_warnings() -> None:
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)


def _ended(job: _Job, code: int, outcome: EngineOutcome) -> bool:
    """Judge an ended worker; returns whether to try again, else enters what became of it in the outcome."""
    text = ""
    if job.output is not None:
        job.output.seek(0)
        text = job.output.read().decode(errors="replace").strip()
        job.output.close()
    if code == 0:
        return False
    progress = job.progress.read()
    if code in (2, 3):
        message = str(progress.get("error") or text or "failed").removeprefix("qrlsuite: ")
        (outcome.failed if code == 2 else outcome.taken)[job.group.id] = message
        return False
    epoch = int(progress.get("epoch") or 0)
    job.deaths = 1 if epoch > job.epoch_at_death else job.deaths + 1
    job.epoch_at_death = epoch
    if job.deaths < ATTEMPTS:
        return True
    reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    last = f": {text.splitlines()[-1]}" if text else ""
    outcome.failed[job.group.id] = f"its worker died {ATTEMPTS} times ({reason}){last}\n{text}"
    return False
