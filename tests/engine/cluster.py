"""A Dask cluster of real processes over TCP on 127.0.0.1, each in a folder of its own."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import distributed

from tests.commands import HANGS, Command, start_dask

LOCAL = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")


class Cluster:
    """A scheduler and its workers; all are killed at the end."""

    def __init__(self, folder: Path, env: Mapping[str, str] | None = None, protocol: str = "tcp") -> None:
        self.folder, self.protocol = folder, protocol
        self.workers: list[Command] = []
        self._numbers = itertools.count()
        self.start_scheduler(env)

    def start_scheduler(self, env: Mapping[str, str] | None = None) -> None:
        """Start a scheduler, at a new address."""
        folder = self._folder("scheduler")
        file = folder / "scheduler.json"
        words = [
            "scheduler",
            *LOCAL,
            "--port",
            "0",
            "--protocol",
            self.protocol,
            "--scheduler-file",
            str(file),
        ]
        self.scheduler = start_dask(*words, env=_environment(env), cwd=folder)
        while not file.exists() or not file.read_bytes().endswith(b"}"):
            assert self.scheduler.poll() is None, self.scheduler.communicate()[1]
            time.sleep(0.02)
        self.address = str(json.loads(file.read_text())["address"])

    def add(self, env: Mapping[str, str] | None = None) -> None:
        """Start a worker more."""
        folder = self._folder("worker")
        words = [
            "worker",
            self.address,
            *LOCAL,
            "--no-nanny",
            "--nthreads",
            "1",
            "--local-directory",
            str(folder),
        ]
        self.workers.append(start_dask(*words, env=_environment(env), cwd=folder))

    def wait(self, workers: int) -> None:
        """Return when the scheduler knows that many workers."""
        with distributed.Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(workers, HANGS)

    def _folder(self, name: str) -> Path:
        folder = self.folder / f"{name}-{next(self._numbers)}"
        folder.mkdir(parents=True)
        return folder

    def kill(self, worker: Command) -> None:
        """End a worker without a word."""
        self.workers.remove(worker)
        _kill(worker)

    def kill_all(self) -> None:
        """End the scheduler and the workers without a word."""
        for worker in list(self.workers):
            self.kill(worker)
        _kill(self.scheduler)

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill_all()


def _environment(more: Mapping[str, str] | None) -> dict[str, str]:
    one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return {**os.environ, **one, **(more or {})}


def _kill(process: Command) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.pid, signal.SIGKILL)
    process.wait()
