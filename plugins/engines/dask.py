"""The engine `dask`: workers of a Dask cluster, which need no shared folder.

A task is one call of `qrlsuite.training.remote_task.work_on`: bytes go out and come back. Dask pickles its own message,
in which the call is text that names the function; of an answer, the client accepts bytes only.

The scheduler is somebody else's (`scheduler`), or one on this machine for the time of the run. TLS is set up by Dask's
own settings (`distributed.comm.tls` in its configuration, addresses that begin with `tls://`).
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import pydantic
from pydantic.dataclasses import dataclass

from qrlsuite.engine.api import (
    MOST_BYTES,
    Answer,
    EngineOutcome,
    EntryStore,
    Show,
    Work,
    differing,
    train_remotely,
    usable_cores,
)
from qrlsuite.errors import QrlSuiteError, listed
from qrlsuite.registry import words

log = logging.getLogger("qrlsuite")

CALL = "__import__('qrlsuite.training.remote_task', fromlist=['work_on']).work_on(task)"
"""What a worker evaluates. A pickled function of ours would end a worker that cannot import it."""

TASKS = 10
"""Tasks at a time, where no number of workers was asked for and the scheduler is somebody else's."""

LOOK_SECONDS = 1.0
"""Seconds between two looks at which workers there are, where nothing is sent."""

SEND_SECONDS = 0.1
"""Shorter if there are tasks to send: a new worker is registered before it gets a task."""

POLL_SECONDS = 0.1
"""Seconds between two looks at whether an answer has come."""

FETCH_SECONDS = 5.0
"""For which an answer is fetched; one whose worker has died meanwhile is worked on again first."""

PATIENCE = 15.0
"""Seconds without any worker before a message says so."""


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
    timeout: Annotated[
        float, pydantic.Field(gt=0, description="seconds for which the scheduler is waited for")
    ] = 10.0


class DaskEngine:
    """Carries tasks to the workers of a Dask cluster."""

    def __init__(self, options: DaskOptions) -> None:
        self.options = options

    def workers(self, requested: int | None) -> int:
        """Return the number asked for, else `TASKS`, or with a cluster of our own one per core."""
        return requested or (TASKS if self.options.scheduler else usable_cores())

    def queued(self, store: EntryStore) -> set[int]:
        """Return nothing: a task ends with the process that sent it."""
        return set()

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        """Send the groups of each work as tasks, and write the answers."""
        return train_remotely(self, works, show)

    def connect(self, workers: int, versions: Mapping[str, str | None]) -> DaskLink:
        """Connect to the scheduler, or start one with as many workers on this machine."""
        return DaskLink(self.options, workers, versions)


class DaskLink:
    """A connection to a Dask scheduler."""

    def __init__(self, options: DaskOptions, workers: int, versions: Mapping[str, str | None]) -> None:
        self._versions = versions
        self._futures: dict[str, Any] = {}
        self._allowed: dict[str, frozenset[str]] = {}
        self._done_by: dict[str, frozenset[str]] = {}
        self._unsent: list[str] = []
        self._refused: dict[str, str] = {}
        self._usable: frozenset[str] = frozenset()
        self._looked, self._worker_seen = 0.0, time.monotonic()
        self._exit = contextlib.ExitStack()
        with self._exit as exit_stack:
            quiet = {"distributed.admin.large-graph-warning-threshold": 2 * MOST_BYTES}
            exit_stack.enter_context(_module("dask.config").set(quiet))
            address = options.scheduler
            if address is None:
                cluster = _module("distributed").LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )
                exit_stack.callback(cluster.close)
                address = str(cluster.scheduler_address)
            self.address = address
            self._client = _connected(address, options.timeout)
            exit_stack.callback(self._client.close)
            self._require_version()
            self._exit = exit_stack.pop_all()

    def _require_version(self) -> None:
        """Refuse a scheduler whose Dask or Python is not ours."""
        found = self._client.get_versions()
        ours, theirs = found["client"]["packages"], found["scheduler"]["packages"]
        here, there = (
            {"distributed": p.get("distributed"), "python": _minor(p.get("python"))} for p in (ours, theirs)
        )
        if different := differing(here, there):
            raise QrlSuiteError(
                f"the Dask scheduler at {self.address} has {different}: Dask needs the same on both sides"
            )

    def send(self, key: str, task: bytes, priority: int) -> None:
        """Have a task worked on by any worker of our versions."""
        self._submit(key, task, priority)

    def send_apart(self, key: str, task: bytes, priority: int, other: str) -> None:
        """Have a task worked on by another worker than the one that answered `other`, if there is another."""
        self._submit(key, task, priority, self._done_by.get(other, frozenset()))

    def _submit(self, key: str, task: bytes, priority: int, but: frozenset[str] = frozenset()) -> None:
        if time.monotonic() - self._looked >= SEND_SECONDS:
            self._look()
        if self._refused and not self._usable:
            self._unsent.append(key)  # `receive` says so
            return
        allowed = self._usable if self._refused else frozenset[str]()
        if but:
            allowed = self._usable - but or allowed
        restricted = {"workers": sorted(allowed)} if allowed else {}
        self._allowed[key] = allowed
        self._futures[key] = self._client.submit(
            eval, CALL, {"task": task}, key=f"train-{key}", priority=priority, pure=False, **restricted
        )

    def receive(self, seconds: float) -> list[Answer]:
        """Return the answers that have come, waiting for the first of them that long at most."""
        deadline = time.monotonic() + seconds
        while True:
            if self._client.status not in ("running", "connecting"):
                raise QrlSuiteError(
                    f"the Dask scheduler at {self.address} is gone; finished epochs are kept, and the same command "
                    "continues with another"
                )
            ended = [key for key, future in self._futures.items() if future.status != "pending"]
            if ended or time.monotonic() >= deadline:
                break
            time.sleep(POLL_SECONDS)
        answers = [answer for key in ended if (answer := self._fetch(key)) is not None]
        lost = bool(self._unsent) or any(answer.content is None for answer in answers)
        if lost or time.monotonic() - self._looked >= LOOK_SECONDS:
            self._look()
            answers += self._stranded()
        return answers

    def _fetch(self, key: str) -> Answer | None:
        """Return the answer to an ended task, None where its bytes are on a worker that has just died."""
        future = self._futures[key]
        try:
            answer = Answer(key, _bytes(future.result(timeout=FETCH_SECONDS)))
            self._done_by[key] = frozenset(next(iter(self._client.who_has([future]).values()), ()))
        except TimeoutError:
            return None
        except Exception as error:
            answer = Answer(key, None, words(error))
        except BaseException as error:  # asyncio's CancelledError is no Exception
            if isinstance(error, KeyboardInterrupt | SystemExit):
                raise
            answer = Answer(key, None, "the scheduler has forgotten it")
        self._forget(key)
        return answer

    def _forget(self, key: str) -> None:
        with contextlib.suppress(Exception):  # the scheduler may be gone
            self._futures[key].cancel()
        del self._futures[key], self._allowed[key]

    def _look(self) -> None:
        """See which workers there are, and which of them have our versions."""
        self._looked = time.monotonic()
        if self._client.status != "running":  # `receive` says when it is gone
            return
        with contextlib.suppress(OSError, TimeoutError):
            there = frozenset(self._client.nthreads())
            self._refused = {address: reason for address, reason in self._refused.items() if address in there}
            if there - self._usable - self._refused.keys():
                self._ask_versions(there)
            self._usable = there - self._refused.keys()
            if there:
                self._worker_seen = self._looked
        if self._looked - self._worker_seen > PATIENCE:
            self._worker_seen = float("inf")
            log.warning(f"the Dask scheduler at {self.address} has no worker: waiting for one")

    def _stranded(self) -> list[Answer]:
        """Return as lost the tasks that only workers that are gone may do."""
        if self._refused and not self._usable:
            reasons = [f"{address} has {reason}" for address, reason in sorted(self._refused.items())]
            raise QrlSuiteError(
                f"no worker of the Dask scheduler at {self.address} can be used: {listed(reasons, 3)}; install "
                "the same versions there"
            )
        gone = [key for key, allowed in self._allowed.items() if allowed and not allowed & self._usable]
        for key in gone:
            self._forget(key)
        gone, self._unsent = gone + self._unsent, []
        return [Answer(key, None, "the workers that could do it are gone") for key in gone]

    def _ask_versions(self, there: frozenset[str]) -> None:
        """Ask the workers for their versions, and note who has others than ours."""
        names = [name for name in self._versions if name != "python"]
        answers = self._client.get_versions(packages=names)["workers"]
        for address in sorted(there & answers.keys() - self._usable):
            packages = answers[address]["packages"]
            found = {**packages, "python": _minor(packages.get("python"))}
            different = differing(self._versions, found)
            if different and address not in self._refused:
                self._refused[address] = different
                log.warning(f"worker {address} is left out: it has {different}")

    def close(self) -> None:
        """Cancel the tasks that have no answer yet, and disconnect."""
        with contextlib.suppress(Exception):
            self._client.cancel(list(self._futures.values()))
        self._futures.clear()
        with contextlib.suppress(Exception):  # there is nothing left to lose
            self._exit.close()


def _connected(address: str, timeout: float) -> Any:
    """Return a client of the scheduler at an address."""
    distributed = _module("distributed")
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said in our words
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
            return distributed.Client(
                address,
                timeout=timeout,
                set_as_default=False,
                name="qrlsuite",
                deserializers=["dask", "msgpack"],  # no pickle: an answer is bytes
            )
    except Exception as error:
        raise QrlSuiteError(
            f"no Dask scheduler answers at {address} within {timeout:g} s ({words(error)}): is it running there, and "
            "can this machine reach it?"
        ) from None


def _module(name: str) -> Any:
    """Import a module of Dask, which is not there in every installation; its types are its own matter."""
    return importlib.import_module(name)


def _minor(python: Any) -> str:
    """Return `3.12` for Dask's `3.12.1.final.0`."""
    return ".".join(str(python).split(".")[:2])


def _bytes(content: object) -> bytes:
    if not isinstance(content, bytes):
        raise TypeError(f"a worker answered with {type(content).__name__} in the place of bytes")
    return content
