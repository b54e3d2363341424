"""All that an engine needs of the suite: its input, its result, and helpers.

An engine decides only *where* groups of seeds are trained: it starts `worker_command` for every group, on machines that
share the results folder. A worker finds everything it needs in the entry's folder, leaves everything there, and may be
started twice for the same group: the second finds the seeds claimed, or done.
"""

from qrlsuite.engine.local import LocalEngine, WorkerJob, held, usable_cores, worker_environment
from qrlsuite.engine.work import (
    Engine,
    EngineOutcome,
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
from qrlsuite.training.interrupts import Interruptible

__all__ = [
    "Claim", "Engine", "EngineOutcome", "EntryStore", "Interruptible", "LocalEngine", "SeedGroup", "Show", "Snapshot",
    "Work", "WorkerJob", "certain", "held", "raise_failures", "submitted", "usable_cores", "worker_command",
    "worker_environment", "write_submitted",
]  # fmt: skip
