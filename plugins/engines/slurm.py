"""The engine `slurm`: submits every group as a task of a job array, and returns.

A task supervises one worker just as `local` does. Some time before its limit SLURM warns it; it then has the worker
save and end, and puts itself back into the queue, where it continues from the checkpoint. The same happens when the
cluster takes the node away. A task that was canceled or killed is submitted again by the same `qrlsuite run`.

The folder `<entry>/slurm/` holds submitit's own files and logs, and `submitted.json`, which says which job waits
with which seeds. The results folder must be one that every node sees.
"""

from __future__ import annotations

import re
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import pydantic
from pydantic.dataclasses import dataclass

from qrlsuite.engine.api import (
    EngineOutcome,
    EntryStore,
    LocalEngine,
    SeedGroup,
    Show,
    Work,
    raise_failures,
    submitted,
    write_submitted,
)
from qrlsuite.errors import QrlSuiteError, StoreError

TASKS = 10
"""Array tasks, where no number of workers was asked for."""

REQUEUES = 1000
"""How often a task may reach its time limit."""

ASK_SECONDS = 5.0
"""How long an answer of `squeue` is good for: a hundred entries are looked at by asking once."""
ANSWER_SECONDS = 30
"""How long an answer of `squeue` is waited for; a controller that is down is noticed by it after some ten."""

_TIME = re.compile(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?")


def minutes(text: Any) -> int:
    """Read a time limit as SLURM writes it: minutes, `mm:ss`, `hh:mm:ss`, `d-hh`, `d-hh:mm`, `d-hh:mm:ss`."""
    match = _TIME.fullmatch(str(text).strip())
    if match is None:
        raise ValueError("write minutes (90), hh:mm:ss (2:00:00) or d-hh:mm:ss (1-12:00:00)")
    days, *rest = match.groups()
    numbers = [int(number) for number in rest if number is not None]
    units = (3600, 60, 1) if days is not None or len(numbers) == 3 else (60, 1, 0)
    seconds = int(days or 0) * 86400 + sum(n * unit for n, unit in zip(numbers, units))
    if seconds < 60:
        raise ValueError("a task needs at least one minute")
    return -(-seconds // 60)


@dataclass(frozen=True, config={"extra": "forbid"})
class SlurmOptions:
    """Options of the engine `slurm`; where one is absent, the cluster's own default is taken."""

    partition: Annotated[str | None, pydantic.Field(description="as for sbatch")] = None
    time: Annotated[
        int,
        pydantic.BeforeValidator(minutes),
        pydantic.Field(description="time limit of a task in minutes; longer ones go back into the queue"),
    ] = 240
    memory: Annotated[float | None, pydantic.Field(gt=0, description="memory of a task in GB")] = None
    account: Annotated[str | None, pydantic.Field(description="as for sbatch")] = None
    qos: Annotated[str | None, pydantic.Field(description="as for sbatch")] = None
    constraint: Annotated[str | None, pydantic.Field(description="as for sbatch")] = None
    grace: Annotated[
        int,
        pydantic.Field(
            ge=10, description="seconds before the limit at which a task saves and goes back into the queue"
        ),
    ] = 120
    setup: Annotated[
        tuple[str, ...], pydantic.Field(description="shell lines before the task, such as module load")
    ] = ()


class ArrayTask:
    """The function of a task of the array; submitit pickles it for its own job, by reference to this class."""

    def __init__(
        self, folder: str, seeds: tuple[int, ...], epochs: int, device: str, script: Sequence[str] = ()
    ) -> None:
        self.folder, self.seeds, self.epochs, self.device = folder, seeds, epochs, device
        self.script = script
        self._engine: LocalEngine | None = None

    def __call__(self) -> None:
        """Supervise the group's worker until it has finished."""
        signal.signal(signal.SIGTERM, _canceled)
        self._engine = LocalEngine()
        group = SeedGroup(self.seeds, 0)
        store = EntryStore(Path(self.folder))
        work = Work(store, [group], self.epochs, 1, self.device, script=self.script)
        outcome = self._engine.run([work], lambda snapshot: None)
        raise_failures(outcome)
        for message in outcome.taken.values():
            print(f"left out: {message}")

    def checkpoint(self) -> Any:
        """Make the worker save and end; returns the task for submitit to put back into the queue."""
        import submitit

        if self._engine is not None:
            self._engine.stop()
        return submitit.helpers.DelayedSubmission(
            ArrayTask(self.folder, self.seeds, self.epochs, self.device, self.script)
        )


def _canceled(number: int, frame: FrameType | None) -> None:
    """End the supervision on `scancel`: the worker, which SLURM told too, saves and is waited for."""
    raise KeyboardInterrupt


class SlurmEngine:
    """Submits job arrays."""

    def __init__(self, options: SlurmOptions) -> None:
        self.options = options
        self._asked = 0.0
        self._answer: set[str] | None = None

    def workers(self, requested: int | None) -> int:
        """Return the number of array tasks asked for, else `TASKS`."""
        return requested or TASKS

    def queued(self, store: EntryStore) -> set[int]:
        """Return the seeds whose tasks SLURM still knows as waiting or running."""
        tasks = submitted(store)
        if not tasks:
            return set()
        if self._answer is None or time.monotonic() - self._asked > ASK_SECONDS:
            self._answer, self._asked = _waiting(), time.monotonic()
        waiting = self._answer
        return {seed for task in tasks if task["job"] in waiting for seed in task["seeds"]}

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        """Submit the groups of each work as one job array, and return."""
        outcome = EngineOutcome()
        for work in works:
            outcome += self._submit(work)
        return outcome

    def _submit(self, work: Work) -> EngineOutcome:
        import submitit

        folder = work.store.path.absolute() / "slurm"
        options = self.options
        parameters = {
            "partition": options.partition,
            "time": options.time,
            "mem": None if options.memory is None else f"{round(options.memory * 1024)}MB",
            "account": options.account,
            "qos": options.qos,
            "constraint": options.constraint,
            "setup": list(options.setup) or None,
            "signal_delay_s": min(options.grace, options.time * 30),
            "array_parallelism": work.workers,
            "cpus_per_task": 1,
            "job_name": f"qrlsuite-{work.store.path.name}",
            "additional_parameters": {"requeue": True},
        }
        path = str(work.store.path.absolute())
        tasks = [ArrayTask(path, g.seeds, work.epochs, work.device, work.script) for g in work.groups]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            executor = submitit.SlurmExecutor(folder, max_num_timeout=REQUEUES)
            executor.update_parameters(**{k: v for k, v in parameters.items() if v is not None})
            with executor.batch():
                jobs = [executor.submit(task) for task in tasks]
        except OSError as error:
            raise StoreError(f"cannot write {folder}: {error.strerror or error}") from None
        except submitit.core.utils.FailedJobError as error:
            raise QrlSuiteError(f"SLURM refused the job: {_last_line(str(error))}") from None
        except RuntimeError as error:
            raise QrlSuiteError(
                f"there is no SLURM on this machine ({error}); --engine local needs none"
            ) from None
        self._answer = None
        ids = [str(job.job_id) for job in jobs]
        _remember(work.store, ids, work.groups, work.epochs)
        array = ids[0].partition("_")[0]
        plural = "s" * (len(ids) > 1)
        stops = "stops them" if work.script else "stops them with everything saved"
        return EngineOutcome(
            submitted=f"submitted {len(ids)} task{plural} as SLURM job {array}; `qrlsuite runs` shows how far they "
            f"are, `scancel {array}` {stops}, the same command submits what is missing then"
        )


def _remember(store: EntryStore, ids: Sequence[str], groups: Sequence[SeedGroup], epochs: int) -> None:
    """Add tasks to `submitted.json`, and forget tasks that SLURM no longer knows."""
    try:
        waiting = _waiting()
    except QrlSuiteError:
        waiting = None
    old = [task for task in submitted(store) if waiting is None or task["job"] in waiting]
    new = [
        {"job": job, "seeds": list(g.seeds), "epochs": epochs, "time": int(time.time())}
        for job, g in zip(ids, groups)
    ]
    write_submitted(store, "slurm", old + new)


def _waiting() -> set[str]:
    """Return the ids of all jobs that wait or run, array tasks as `123_4`; of all users, who may share a folder."""
    command = ["squeue", "--noheader", "--array", "--format", "%i"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_SECONDS, check=True)
    except FileNotFoundError:
        raise QrlSuiteError(
            "there is no SLURM on this machine (squeue is not found); --engine local needs none"
        ) from None
    except subprocess.CalledProcessError as error:
        raise QrlSuiteError(f"squeue does not answer: {_last_line(error.stderr)}") from None
    except subprocess.TimeoutExpired:
        raise QrlSuiteError(f"squeue does not answer within {ANSWER_SECONDS} s") from None
    except OSError as error:
        raise QrlSuiteError(f"squeue does not answer: {error}") from None
    return set(result.stdout.split())


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no message"
