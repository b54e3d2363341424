"""All that an engine needs of the suite: its input, its result, and helpers.

An engine decides only *where* groups of seeds are trained. There are two ways:

- It starts `worker_command` for every group, on machines that share the results folder. Whatever it starts finds
  everything it needs in the entry's folder, leaves everything there, and may be started twice for the same group: the
  second finds the seeds claimed, or done. `plugins/engines/slurm.py` and `plugins/engines/command.py` are examples.
- It carries bytes to workers that share no folder, and the answers back: `run` returns `train_remotely`, which sends
  through the engine's `connect`, and a worker calls `qrlsuite.training.remote_task.work_on`. Claims, trackers and the
  results folder stay with the process that sends. `plugins/engines/dask.py` is the example.
"""

from qrlsuite.engine.local import ONE_THREAD, LocalEngine, WorkerJob, usable_cores
from qrlsuite.engine.remote import train as train_remotely
from qrlsuite.engine.work import (
    Answer,
    ChoosingLink,
    Engine,
    EngineOutcome,
    Link,
    RemoteEngine,
    Show,
    Snapshot,
    Work,
    raise_failures,
    worker_command,
)
from qrlsuite.results.claims import Claim, certain
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore
from qrlsuite.results.survey import submitted, write_submitted
from qrlsuite.training.remote_task import MOST_BYTES, differing

__all__ = [
    "MOST_BYTES", "ONE_THREAD", "Answer", "ChoosingLink", "Claim", "Engine", "EngineOutcome", "EntryStore",
    "Link", "LocalEngine", "RemoteEngine", "SeedGroup", "Show", "Snapshot", "Work", "WorkerJob", "certain",
    "differing", "raise_failures", "submitted", "train_remotely", "usable_cores", "worker_command",
    "write_submitted",
]  # fmt: skip
