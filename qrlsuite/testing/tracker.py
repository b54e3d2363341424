"""Rules of trackers: methods or hooks with the right names and arguments, which accept a run's events."""

from __future__ import annotations

import copy
import importlib
import inspect
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pluggy

from qrlsuite import hookspecs, specs
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, require
from qrlsuite.testing.fresh import HEAVY, fresh_process
from qrlsuite.training.trackers import EVENTS

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


def check(subject: Subject) -> list[Finding]:
    """Check a tracker that is asked for by name, which writes into a temporary folder meanwhile."""
    spec = subject.spec
    assert isinstance(spec, specs.TrackerSpec)
    rules = Checklist()
    trackers: list[Any] = []
    with tempfile.TemporaryDirectory() as folder:
        for target in (None, str(Path(folder) / "target")):
            if not rules.run(
                "builds" if target is None else "target",
                f"factory({'None' if target is None else 'target'}), with a method for an event",
                lambda target=target: trackers.append(_build(spec, target)),  # type: ignore[misc]
                "the factory takes one argument: what the user writes after --track NAME=, or None",
            ):
                return rules.findings
        rules.run(
            "events",
            RUNS,
            lambda: _sent(trackers, Path(folder)),
        )
    return rules.findings


def _build(spec: specs.TrackerSpec, target: str | None) -> Any:
    tracker = specs.resolve(spec.factory)(target)
    require(
        any(callable(getattr(tracker, event, None)) for event in EVENTS),
        f"{type(tracker).__name__} has none of the methods {', '.join(EVENTS)}",
    )
    return tracker


def _sent(trackers: list[Any], folder: Path) -> None:
    for tracker in trackers:

        def send(event: str, tracker: Any = tracker, **content: Any) -> None:
            method = getattr(tracker, event, None)
            if method is not None:
                method(*content.values())

        _a_run(send, folder)


def check_plugin(plugin: Any) -> list[Finding]:
    """Check a plugin that watches every run, given as a module, an object or a module's name."""
    rules = Checklist()
    plugins: list[Any] = [plugin]
    if isinstance(plugin, str):
        plugins.clear()
        if not rules.run(
            "imports",
            "the module can be imported",
            lambda: plugins.append(importlib.import_module(plugin)),
            "no tracker of that name is registered, nor is there a module of that name",
        ):
            return rules.findings
    plugin_object = plugins[0]
    if not rules.run("hooks", "at least one run event, with its arguments", lambda: _hooks(plugin_object)):
        return rules.findings
    if isinstance(plugin_object, ModuleType):
        rules.run(
            "lazy imports",
            f"importing it imports none of {', '.join(HEAVY)}",
            lambda: _lazy(plugin_object.__name__),
        )
    with tempfile.TemporaryDirectory() as folder:
        rules.run(
            "events",
            RUNS,
            lambda: _a_run(_caller(plugin_object), Path(folder)),
        )
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
    error = result.get("crash") or result["modules"].get(module)
    require(error is None, f"in a fresh process: {error}")
    require(
        not result["heavy"],
        f"importing '{module}' imports {', '.join(result['heavy'])}: import it inside the hook, so that commands "
        "start at once",
    )


def _caller(plugin: Any) -> Callable[..., None]:
    """Return `send(event, **content)`, which lets a tracker's error through."""
    manager = _manager(plugin)

    def send(event: str, **content: Any) -> None:
        for implementation in getattr(manager.hook, event).get_hookimpls():
            implementation.function(*[content[argument] for argument in implementation.argnames])

    return send


def _a_run(send: Callable[..., None], folder: Path) -> None:
    """Send what two seeds' runs send: two epochs, the second of them again after resuming."""
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
            f"{event} raises {type(error).__name__}: {error}; `qrlsuite show hook {event}` says what it is given"
        ) from error
    require(content == kept, f"{event} {_CHANGES}")
