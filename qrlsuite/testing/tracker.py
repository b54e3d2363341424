"""What a tracker keeps to: hooks of the right names and arguments that take what a run sends."""

from __future__ import annotations

import copy
import importlib
import inspect
from types import ModuleType
from typing import Any

import pluggy

from qrlsuite import hookspecs
from qrlsuite.events import EventSink
from qrlsuite.testing.common import HEAVY, fresh_process
from qrlsuite.testing.findings import Checklist, Finding, require

EVENTS = ("run_started", "epoch_finished", "run_finished")

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
    "parameters": {"classical": 4611, "quantum": 0},
    "seed": 7,
    "interactions_per_epoch": 2000,
}
"""A run as the hooks see it."""

RECORD: dict[str, Any] = {
    "epoch": 1,
    "scores": [0.5, 0.75],
    "loss": 0.25,
    "train_return": None,
    "train_score": None,
    "executions": {"forward": 12},
}
"""An epoch's line as `epoch_finished` sees it; a metric without a value is None."""


def check(plugin: Any) -> list[Finding]:
    """Check a tracker, given as a module, an object or a module's name."""
    rules = Checklist()
    found: list[Any] = [plugin]
    if isinstance(plugin, str):
        found.clear()
        if not rules.run(
            "imports", "the module can be imported", lambda: found.append(importlib.import_module(plugin))
        ):
            return rules.findings
    made = found[0]
    if not rules.run("hooks", "at least one run event, with its arguments", lambda: _hooks(made)):
        return rules.findings
    if isinstance(made, ModuleType):
        rules.run(
            "lazy imports", f"importing it imports none of {', '.join(HEAVY)}", lambda: _lazy(made.__name__)
        )
    rules.run("events", "two runs at once, and a metric without a value", lambda: _events(made))
    return rules.findings


def _hooks(plugin: Any) -> None:
    marked = [
        name
        for name, function in inspect.getmembers(plugin, callable)
        if getattr(function, f"{hookspecs.PROJECT}_impl", None) is not None
    ]
    silent = [name for name in EVENTS if hasattr(plugin, name) and name not in marked]
    require(not silent, f"{', '.join(silent)}: write @hookimpl above it (from qrlsuite import hookimpl)")
    require(
        any(name in marked for name in EVENTS),
        f"it implements none of {', '.join(EVENTS)}: is @hookimpl above the functions?",
    )
    _manager(plugin)


def _manager(plugin: Any) -> pluggy.PluginManager:
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    manager.register(plugin)
    manager.check_pending()
    return manager


def _lazy(module: str) -> None:
    result = fresh_process((module,), ())
    require("crash" not in result, f"a fresh process fails: {result.get('crash')}")
    require(not result["modules"], f"in a fresh process: {result['modules'].get(module)}")
    require(
        not result["heavy"],
        f"importing '{module}' imports {', '.join(result['heavy'])}: import it inside the hook, so that commands "
        "start at once",
    )


class _Sink(EventSink):
    """Lets a tracker's error through, instead of leaving the tracker out."""

    def send(self, event: str, **content: Any) -> None:
        for implementation in getattr(self.manager.hook, event).get_hookimpls():
            implementation.function(*[content[argument] for argument in implementation.argnames])


def _events(plugin: Any) -> None:
    sink = _Sink(_manager(plugin))
    runs = [{**RUN, "seed": seed} for seed in (7, 8)]
    kept = copy.deepcopy((runs, RECORD))
    for run in runs:
        sink.send("run_started", run=run)
    for epoch in (1, 2):
        for run in runs:
            sink.send("epoch_finished", run=run, record={**RECORD, "epoch": epoch})
    for run in runs:
        sink.send("run_finished", run=run)
    require(
        (runs, RECORD) == kept,
        "a hook changes the mapping that it is given: copy it, for the next tracker and the run's files use it too",
    )
