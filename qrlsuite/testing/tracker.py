"""Rules of trackers: methods with the right names and arguments, which accept a run's events."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qrlsuite import specs
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, require
from qrlsuite.training.trackers import build

RUNS = "two runs at once, resumed, and a metric without a value"

RUN: dict[str, Any] = {
    "task": "example",
    "task_hash": "0123456789abcdef",
    "entry": "ddqn-mlp-01234567",
    "label": "ddqn mlp width=64",
    "algorithm": "ddqn",
    "algorithm_options": {"gamma": 0.95},
    "model": "mlp",
    "family": "classical",
    "model_options": {"width": 64},
    "parameters": {"classical": 4611, "quantum": 0, "networks": 1},
    "seed": 7,
    "interactions_per_epoch": 2000,
}
"""A run as a tracker sees it."""

RECORD: dict[str, Any] = {
    "epoch": 1,
    "scores": [0.5, 0.75],
    "loss": 0.25,
    "train_return": None,
    "train_score": None,
    "executions": {"forward": 12},
}
"""An epoch's line as `epoch_finished` sees it; a metric without a value is None."""


def check(subject: Subject) -> list[Finding]:
    """Check a tracker, which writes into a temporary folder meanwhile."""
    spec = subject.spec
    assert isinstance(spec, specs.TrackerSpec)
    rules = Checklist()
    trackers: list[Any] = []
    with tempfile.TemporaryDirectory() as folder:
        for target in (None, str(Path(folder) / "target")):
            if not rules.run(
                "builds" if target is None else "target",
                f"factory({'None' if target is None else 'target'}), with a method for an event",
                lambda target=target: trackers.append(build(spec, target)),  # type: ignore[misc]
                "the factory takes one argument: what the user writes after --track NAME=, or None",
            ):
                return rules.findings
        rules.run("events", RUNS, lambda: _sent(trackers, Path(folder)))
    return rules.findings


def _sent(trackers: list[Any], folder: Path) -> None:
    for tracker in trackers:

        def send(event: str, tracker: Any = tracker, **content: Any) -> None:
            method = getattr(tracker, event, None)
            if method is not None:
                method(*content.values())

        _a_run(send, folder)


def _a_run(send: Callable[..., None], folder: Path) -> None:
    """Send the events of two seeds' runs: two epochs, and the second again after resuming."""
    runs = []
    for seed in (7, 8):
        seed_folder = folder / f"seed-{seed:04d}"
        seed_folder.mkdir(exist_ok=True)
        runs.append({**RUN, "seed": seed, "folder": str(seed_folder)})
    for first, last in ((1, 2), (2, 2)):
        history = [{**RECORD, "epoch": epoch} for epoch in range(1, first)]
        for run in runs:
            _unchanged(send, "run_started", run={**run, "epochs": first - 1, "history": history})
        for epoch in range(first, last + 1):
            for run in runs:
                _unchanged(send, "epoch_finished", run=run, record=copy.deepcopy({**RECORD, "epoch": epoch}))
    for run in runs:
        _unchanged(send, "run_finished", run={**run, "epochs": 2})


_CHANGES = "changes the mapping that it is given: copy it, for the next tracker is given the same"


def _unchanged(send: Callable[..., None], event: str, **content: Any) -> None:
    kept = copy.deepcopy(content)
    try:
        send(event, **content)
    except Exception as error:
        raise BrokenRuleError(
            f"{event} raises {type(error).__name__}: {error}; qrlsuite.training.trackers says what it is given"
        ) from error
    require(content == kept, f"{event} {_CHANGES}")
