"""The engine `dask`: workers of a Dask cluster, whose machines see the results folder.

A task is one call of `work`, which starts a group's worker beside the Dask worker and waits for it. All else is read
from the results folder. Dask pickles its own message, in which the call is text that names the function; of a result,
the client accepts bytes only.

The scheduler is somebody else's (`scheduler`), or one on this machine for the time of the run. TLS is set up by Dask's
own settings (`distributed.comm.tls` in its configuration, addresses that begin with `tls://`).
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import json
import logging
import os
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic.dataclasses import dataclass

from qrlsuite.engine.api import (
    EngineOutcome,
    EntryStore,
    Interruptible,
    Show,
    Work,
    WorkerJob,
    held,
    usable_cores,
    worker_command,
    worker_environment,
)
from qrlsuite.errors import QrlSuiteError, StoreError, listed
from qrlsuite.registry import words

log = logging.getLogger("qrlsuite")

MODULE = "qrlsuite.plugins.engines.dask"
CALL = (
    f"__import__('{MODULE}', fromlist=['work']).work(*task) "
    "if __import__('importlib.util').util.find_spec('qrlsuite') else b''"
)
"""The text that a Dask worker evaluates. A pickled function of ours would end a worker that cannot import it."""

TASKS = 10
"""Tasks at a time, where no number of workers was asked for and the scheduler is somebody else's."""

LOOK_SECONDS = 0.2
"""Seconds between two looks: of the client at its tasks, of a task at its process."""

FETCH_SECONDS = 5.0
"""Seconds for which a result is fetched; if its Dask worker has died, the task runs again first."""

PATIENCE = 15.0
"""Seconds without any worker before a message says so."""

SAVE_SECONDS = 60.0
"""Seconds for which workers that were told to stop are waited for."""

IGNORE_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""For Dask workers on this terminal: Ctrl-C reaches the command, which ends them."""

UNSEEN = -1000
"""In the place of an exit code: the Dask worker does not see the folder."""


@dataclass(frozen=True, config={"extra": "forbid"})
class DaskOptions:
    """Options of the engine `dask`."""

    scheduler: Annotated[
        str | None,
        pydantic.Field(
            description="address of the scheduler, such as tcp://10.0.0.5:8786; without one, a cluster of --workers "
            "processes is started on this machine"
        ),
    ] = None
    timeout: Annotated[float, pydantic.Field(gt=0, description="seconds to wait for the scheduler")] = 10.0


def work(mark: str, arguments: Sequence[str], environment: Mapping[str, str]) -> bytes:
    """Run a task: start a group's worker, and return its exit code and output.

    The worker saves and ends when the task is canceled, which a client's end does too, or the Dask worker ends.

    Parameters
    ----------
    mark:
        A file of the client's, which a machine sees that shares the folder.
    arguments:
        The worker's command line after Python's own path, which is this machine's.
    """
    if not Path(mark).exists():
        return json.dumps([UNSEEN, socket.gethostname()]).encode()
    own = {**os.environ, **environment}
    # set by Dask for its workers: each large array would be returned to the system, and cleared page by page again
    own.pop("MALLOC_TRIM_THRESHOLD_", None)
    dask_worker = _module("distributed").get_worker()
    key = dask_worker.get_current_task()
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [sys.executable, *arguments, "--follow-parent", str(os.getpid())],
            env=own,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,  # Ctrl-C reaches the worker once, from here
        )
        told = False
        while process.poll() is None:
            task = dask_worker.state.tasks.get(key)
            ends = dask_worker.status.name in ("closing", "closed", "failed")
            if not told and (ends or task is None or task.state != "executing"):
                process.terminate()
                told = True
            time.sleep(LOOK_SECONDS)
        output.seek(0)
        return json.dumps([process.returncode, output.read().decode(errors="replace").strip()]).encode()


class DaskEngine:
    """Starts workers by the tasks of a Dask cluster and follows them in the results folder."""

    def __init__(self, options: DaskOptions) -> None:
        self.options = options

    def workers(self, requested: int | None) -> int:
        """Return the number asked for, else `TASKS`, or with a cluster of our own one per core."""
        return requested or (TASKS if self.options.scheduler else usable_cores())

    def queued(self, store: EntryStore) -> set[int]:
        """Return nothing: a task ends with the process that sent it."""
        return set()

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        """Train the groups until all have finished or failed."""
        jobs = [WorkerJob(work, group, works) for work in works for group in work.groups]
        for job in jobs:
            job.progress.clear(len(job.group.seeds))
        with self.connected(works[0].workers) as cluster, contextlib.ExitStack() as stack:
            marks = {work.store.path: _mark(work.store, stack) for work in works}
            try:
                return self._follow(cluster, jobs, marks, works[0].workers, show)
            except BaseException:
                cluster.stop()
                raise

    @contextlib.contextmanager
    def connected(self, workers: int) -> Iterator[Cluster]:
        """Connect to the scheduler, or to one with as many workers that is started on this machine."""
        with contextlib.ExitStack() as stack:
            address = self.options.scheduler
            if address is None:
                local = _module("distributed").LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                    preload=[IGNORE_CTRL_C],
                )
                stack.callback(_quietly, local.close)
                address = str(local.scheduler_address)
            client = _connected(address, self.options.timeout)
            stack.callback(_quietly, client.close)
            yield Cluster(client, address)

    def _follow(
        self, cluster: Cluster, jobs: Sequence[WorkerJob], marks: Mapping[Path, str], workers: int, show: Show
    ) -> EngineOutcome:
        """Keep as many tasks out as there are workers, until all groups have finished or failed."""
        outcome, waiting, running, begun = EngineOutcome(), deque(jobs), cluster.running, cluster.begun
        with Interruptible() as guard:
            while waiting or running:
                claims = held(job.work.store for job in jobs)
                begun |= {job for job in running if job.claimed(claims)}
                with guard.deferred():  # a task that nobody has written down is not canceled
                    for _ in range(len(waiting)):
                        job = waiting.popleft()
                        # a worker whose Dask worker was lost may still be saving
                        if len(running) < workers and not (job in begun and job.claimed(claims)):
                            cluster.submit(job, marks[job.work.store.path])
                        else:
                            waiting.append(job)
                time.sleep(LOOK_SECONDS)
                for job, code in cluster.ended():
                    lost = code == 3 and job in begun  # the seeds are still those of the worker before
                    if code == 0 and not job.finished():
                        job.said("it ended, but this machine does not see all of its results")
                        code = 1
                    if lost or job.ended(code, outcome):
                        waiting.append(job)
                    else:
                        begun.discard(job)  # whoever claims its seeds from now on is somebody else
                show({job.name: job.progress.read() for job in jobs})
        return outcome


class Cluster:
    """A Dask cluster, and the tasks that are out."""

    def __init__(self, client: Any, address: str) -> None:
        self.client, self.address = client, address
        self.running: dict[WorkerJob, Any] = {}
        self.begun: set[WorkerJob] = set()
        """Groups that have not ended, and whose seeds were claimed while a task of theirs was out."""
        self._begun, self._looked = time.monotonic(), False

    def submit(self, job: WorkerJob, mark: str) -> None:
        """Start a group's worker on a machine of the cluster."""
        task = (mark, worker_command(job.work, job.group)[1:], worker_environment())
        try:
            self.running[job] = self.client.submit(eval, CALL, {"task": task}, pure=False)
        except (Exception, asyncio.CancelledError):  # the client has just noticed it
            raise self._gone() from None

    def _gone(self) -> QrlSuiteError:
        return QrlSuiteError(
            f"the Dask scheduler at {self.address} is gone; finished epochs are kept, and the same command "
            "continues with another"
        )

    def ended(self) -> Iterator[tuple[WorkerJob, int]]:
        """Yield the groups whose task has ended, with the exit code of the worker; 1 where the task was lost."""
        if self.client.status not in ("running", "connecting"):
            raise self._gone()
        if not self._looked and time.monotonic() - self._begun > PATIENCE:
            self._looked = True
            with contextlib.suppress(Exception):  # it is gone, which the next look says
                if not self.client.nthreads():
                    log.warning(f"the Dask scheduler at {self.address} has no worker: waiting for one")
        for job, future in [*self.running.items()]:
            if future.status == "pending":
                continue
            try:
                code, text = self._result(future)
            except TimeoutError:
                continue
            del self.running[job]
            if code == UNSEEN:
                raise StoreError(
                    f"the Dask worker on {text} does not see {job.work.store.path.absolute()}: share the results "
                    "folder with the cluster, or repeat the command there without --engine, and take over its "
                    "results here with `qrlsuite import FOLDER`"
                )
            job.said(text)
            yield job, code

    def _result(self, future: Any) -> tuple[int, str]:
        """Return a worker's exit code and its output."""
        try:
            content = future.result(timeout=FETCH_SECONDS)
        except TimeoutError:
            raise
        except Exception as error:
            return 1, words(error)
        except BaseException as error:  # asyncio's CancelledError is no Exception
            if isinstance(error, KeyboardInterrupt | SystemExit):
                raise
            return 1, "the scheduler has forgotten it"
        if content == b"":
            raise QrlSuiteError(
                f"a worker of the Dask scheduler at {self.address} has no qrlsuite: install the same version there"
            )
        code, text = json.loads(content)
        return int(code), str(text)

    def stop(self) -> None:
        """Cancel the tasks, and wait until their workers have saved and ended, and those of lost Dask workers, too."""
        jobs, keys = self.begun.union(self.running), {task.key for task in self.running.values()}
        _quietly(self.client.cancel, [*self.running.values()])
        deadline = time.monotonic() + SAVE_SECONDS
        while time.monotonic() < deadline:
            # first the calls: a worker may start in one, and claim its seeds a moment later
            if not self._called(keys):
                claims = held(job.work.store for job in jobs)
                if not any(job.claimed(claims) for job in jobs):
                    return
            time.sleep(LOOK_SECONDS)

    def _called(self, keys: Set[str]) -> bool:
        """Return whether a call of these tasks may not have returned: it returns after its worker."""
        if self.client.status != "running":
            return False  # nobody can tell
        try:
            calls = self.client.sync(self.client.scheduler.call_stack, callback_timeout=FETCH_SECONDS)
        except (Exception, asyncio.CancelledError):  # a Dask worker has just been lost
            return True
        return any(keys & set(its) for its in calls.values())


def _mark(store: EntryStore, stack: contextlib.ExitStack) -> str:
    """Write a file in an entry's folder by which a machine knows the folder; removed at the end."""
    try:
        return stack.enter_context(
            tempfile.NamedTemporaryFile(dir=store.path.absolute(), prefix="dask-")
        ).name
    except OSError as error:
        raise StoreError(f"cannot write {store.path}: {error.strerror or error}") from None


def _connected(address: str, timeout: float) -> Any:
    """Return a client of the scheduler at an address, whose Dask and Python are ours."""
    distributed = _module("distributed")
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said in our words
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
            client = distributed.Client(
                address,
                timeout=timeout,
                set_as_default=False,
                name="qrlsuite",
                deserializers=["dask", "msgpack"],  # no pickle: a result is bytes
            )
    except Exception as error:
        raise QrlSuiteError(
            f"no Dask scheduler answers at {address} within {timeout:g} s ({words(error)}): is it running there, and "
            "can this machine reach it?"
        ) from None
    found = client.get_versions()
    here, there = (_versions(found[side]["packages"]) for side in ("client", "scheduler"))
    if here != there:
        client.close()
        different = listed(
            [f"{name} {there[name]} instead of {here[name]}" for name in here if here[name] != there[name]]
        )
        raise QrlSuiteError(
            f"the Dask scheduler at {address} has {different}: Dask needs the same on both sides"
        )
    return client


def _versions(packages: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions that both sides need, of Python as `3.12` for Dask's `3.12.1.final.0`."""
    python = ".".join(str(packages.get("python")).split(".")[:2])
    return {"distributed": str(packages.get("distributed")), "python": python}


def _module(name: str) -> Any:
    """Import a module of Dask, which is not there in every installation; its types are its own matter."""
    return importlib.import_module(name)


def _quietly(function: Any, *arguments: Any) -> None:
    """Call a function of Dask's where nothing is lost if the scheduler is gone."""
    with contextlib.suppress(Exception, asyncio.CancelledError):
        function(*arguments)
