"""Rules of trackers: they take what a run tells them, and change nothing of it."""

from __future__ import annotations

import contextlib
import copy
import tempfile
from pathlib import Path
from typing import Any

from qrlsuite import specs
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import Checklist, Finding, require
from qrlsuite.training.trackers import EVENTS, build

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
RECORD: dict[str, Any] = {"epoch": 1, "scores": [0.5, 0.75], "loss": 0.25, "train_return": None}
"""An epoch's line; a metric without a value is None."""


def check(subject: Subject) -> list[Finding]:
    """Check a tracker without and with a target; it writes into a temporary folder."""
    spec, rules = subject.spec, Checklist()
    assert isinstance(spec, specs.TrackerSpec)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for rule, target in (("events", None), ("target", "target")):
            cause = f"the factory takes {target!r}; {', '.join(EVENTS)} are in `qrlsuite.training.trackers`"
            seen = "of an interrupted run, in a temporary folder; none is changed"
            rules.run(rule, seen, lambda target=target: _tell(build(spec, target)), cause)  # type: ignore[misc]
    return rules.findings


def _tell(tracker: Any) -> None:
    """Tell a tracker of a run that is interrupted in its second epoch, which comes again."""
    run = {**RUN, "folder": str(Path("runs", "example", "entry", "seed-0007").absolute())}
    Path(run["folder"]).mkdir(parents=True, exist_ok=True)
    second = {**RECORD, "epoch": 2}
    for event, *content in (
        ("run_started", {**run, "epochs": 0, "history": []}),
        ("epoch_finished", run, RECORD),
        ("epoch_finished", run, second),
        ("run_started", {**run, "epochs": 1, "history": [RECORD]}),
        ("epoch_finished", run, second),
        ("run_finished", {**run, "epochs": 2}),
    ):
        if hasattr(tracker, event):
            given = copy.deepcopy(content)
            getattr(tracker, event)(*given)
            changed = "changes what it is given: copy it, for the next tracker is given the same"
            require(given == content, f"{event} {changed}")
