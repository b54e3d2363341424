"""Local processes: one per group, a few at a time, restarted when they die.

A killed worker loses at most the work since its last checkpoint, and disturbs no other worker.
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO

from qrlsuite.engine.work import EngineOutcome, Show, Work, job_name, worker_command
from qrlsuite.results.claims import Claim, certain
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore
from qrlsuite.training.interrupts import Interruptible

ATTEMPTS = 3
"""Deaths of a group's worker, with nothing gained between them, before the group is given up."""

ALONE = "if memory is used up, not one seed fits: give fewer --workers, a smaller model, or a smaller replay buffer"

IGNORED = (signal.SIGUSR1, signal.SIGUSR2)
"""Signals with which a cluster warns its jobs. They reach every process; a worker saves when its supervisor says so."""


ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Environment variables of every worker: sums are added in the same order on any number of cores."""

PASSED_ON = ("QRLSUITE_", "PYTHONPATH", "NUMBA_")
"""Beginnings of the names of environment variables that a worker on another machine needs."""


class WorkerJob:
    """A group of one of the works, the process that was started for it, and how often that died."""

    def __init__(self, work: Work, group: SeedGroup, works: Sequence[Work]) -> None:
        self.work, self.group, self.name = work, group, job_name(work, group, works)
        self.progress = ProgressFile(work.store, group.id)
        self.deaths, self.gained = 0, (-1, 0, 0)
        """Deaths since the last gain; finished seeds, their number at a time (negative) and the epoch at that time."""
        self.process: subprocess.Popen[bytes] | None = None
        self.output: IO[bytes] | None = None

    def claimed(self, claims: Iterable[Claim]) -> bool:
        """Return whether somebody trains seeds of the group, by the result of `held`."""
        entry, seeds = self.work.store.path, set(self.group.seeds)
        return any(claim.path.is_relative_to(entry) and seeds & set(claim.seeds) for claim in claims)

    def finished(self) -> bool:
        """Return whether all seeds of the group are there."""
        return self.work.store.finished(self.group.seeds, self.work.epochs) == set(self.group.seeds)

    def take_output(self) -> str:
        """Return the output of an ended process, and close its file."""
        if self.output is None or self.output.closed:
            return ""
        with self.output:
            self.output.seek(0)
            return self.output.read().decode(errors="replace").strip()

    def said(self, text: str) -> None:
        """Take the output of a process on another machine."""
        self.output = io.BytesIO(text.encode())

    def died(self, reason: str, text: str) -> str | None:
        """Count a death; return why the group is given up, None if it is to be started again.

        Parameters
        ----------
        reason:
            How the process ended: `signal SIGKILL`.
        """
        size = self.progress.size(len(self.group.seeds))
        done = len(self.work.store.finished(self.group.seeds, self.work.epochs))
        gained = done, -size, int(self.progress.read().get("epoch") or 0)
        self.deaths = 1 if gained > self.gained else self.deaths + 1
        self.gained = gained
        if self.deaths < ATTEMPTS:
            return None
        last = f": {text.splitlines()[-1]}" if text else ""
        alone = f"; {ALONE}" if size == 1 < len(self.group.seeds) else ""
        return f"its worker died {ATTEMPTS} times ({reason}){alone}{last}\n{text}"

    def ended(self, code: int, outcome: EngineOutcome) -> bool:
        """Judge an ended worker; return whether to try again, else record its end in the outcome."""
        text = self.take_output()
        if code == 0:
            return False
        if code in (2, 3):
            message = str(self.progress.read().get("error") or text or "failed").removeprefix("qrlsuite: ")
            (outcome.failed if code == 2 else outcome.taken)[self.name] = message
            return False
        reason = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        given_up = self.died(reason, text)
        if given_up is None:
            return True
        outcome.failed[self.name] = given_up
        return False


def held(stores: Iterable[EntryStore]) -> list[Claim]:
    """Return the claims in the entries' folders whose holders are alive for certain."""
    return [claim for store in {store.path: store for store in stores}.values() for claim in certain(store)]


def worker_environment() -> dict[str, str]:
    """Return the environment variables that a worker on another machine is given."""
    own = {name: value for name, value in os.environ.items() if name.startswith(PASSED_ON)}
    return {**own, **ONE_THREAD}


def usable_cores() -> int:
    """Return the number of cores that this process may use, or the machine's number if the system does not tell."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS


def available_memory(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Return the bytes for new processes; the machine's whole memory if only that is known; None if unknown."""
    try:
        for line in meminfo.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf
        return None


class LocalEngine:
    """Supervises worker processes on this machine."""

    def __init__(self, options: None = None) -> None:
        self._running: list[WorkerJob] = []

    def workers(self, requested: int | None) -> int:
        """Return the number asked for, else one per core that this process may use."""
        return requested or usable_cores()

    def queued(self, store: EntryStore) -> set[int]:
        """Return no seeds: local seeds wait in this process."""
        return set()

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        """Train groups in worker processes until all have finished or failed."""
        jobs = [WorkerJob(work, group, works) for work in works for group in work.groups]
        waiting = deque(jobs)
        outcome = EngineOutcome()
        for job in jobs:
            job.progress.clear(len(job.group.seeds))
        pause = 0.01  # grows until another job begins, so that a short run is seen to end at once
        try:
            with Interruptible() as guard:
                while waiting or self._running:
                    with (
                        guard.deferred()
                    ):  # a fork loses exceptions, and a process without a name is not stopped
                        while waiting and len(self._running) < works[0].workers and self._fits(jobs):
                            job = waiting.popleft()
                            self._running.append(job)
                            _start(job)
                            pause = 0.01
                    time.sleep(pause)
                    pause = min(1.5 * pause, 0.2)
                    for job in list(self._running):
                        code = job.process.poll() if job.process else None
                        if code is None:
                            continue
                        self._running.remove(job)
                        if job.ended(code, outcome):
                            waiting.append(job)
                    show({job.name: job.progress.read() for job in jobs})
        except BaseException:
            self.stop()
            raise
        return outcome

    def _fits(self, jobs: Sequence[WorkerJob]) -> bool:
        """Return whether one more group fits into memory, by the largest that was measured; the first always does."""
        free = available_memory()
        if not self._running or free is None:
            return True
        measured = {job.name: job.progress.read().get("memory") for job in jobs}
        taken = {name: size if isinstance(size, int) else 0 for name, size in measured.items()}
        largest = max(taken.values())
        to_come = sum(largest - taken[job.name] for job in self._running)
        return 0 < largest <= free - to_come

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
            job.take_output()
        self._running.clear()


def _start(job: WorkerJob) -> None:
    job.output = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the worker has ended
    # a session of its own: Ctrl-C reaches the workers once, from here
    job.process = subprocess.Popen(
        [*worker_command(job.work, job.group), "--follow-parent", str(os.getpid())],
        env={**os.environ, **ONE_THREAD},
        stdin=subprocess.DEVNULL,
        stdout=job.output,
        stderr=job.output,
        start_new_session=True,
        preexec_fn=_ignore_warnings,  # sets signals only: takes no lock that another thread may hold
    )


def _ignore_warnings() -> None:
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)
