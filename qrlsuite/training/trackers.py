"""Trackers: objects that a run tells of its events. One that fails is reported once and never stops a run.

A tracker has any of these methods, which are called in the worker that trains:

    run_started(run)             a seed begins, or goes on after an interruption
    epoch_finished(run, record)  `record` is the epoch's line of `epochs.jsonl`
    run_finished(run)            the last epoch is done; all results are on disk

`run` is the seed's `run.json` and its `folder`, `RESULTS/TASK/ENTRY/SEED`; `run_started` is given `epochs` and
`history` too, the number of the finished epochs and their records. Epochs after a run's last checkpoint come a second
time when it goes on.

Trackers whose spec says `always` watch every run, others only runs that ask for them: workers read the environment
variable `QRLSUITE_TRACK`, which `qrlsuite run --track` sets.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from qrlsuite import registry, specs
from qrlsuite.errors import PluginError, QrlSuiteError

log = logging.getLogger("qrlsuite")

TRACK = "QRLSUITE_TRACK"
"""Environment variable: the trackers that are asked for, `NAME` or `NAME=TARGET`, one a line."""

EVENTS = ("run_started", "epoch_finished", "run_finished")


def parse(requests: Sequence[str], registered: registry.Registry | None = None) -> dict[str, str | None]:
    """Return targets by name from words `NAME` or `NAME=TARGET`; `known` is this process's registry by default."""
    targets: dict[str, str | None] = {}
    for word in requests:
        name, equals, target = word.strip().partition("=")
        spec = (registered or registry.load()).get(specs.TrackerSpec, name).spec
        for module, command in spec.extras.items():
            if importlib.util.find_spec(module) is None:
                raise QrlSuiteError(f"tracker '{name}' needs the package '{module}': {command}")
        if equals and not target:
            raise QrlSuiteError(
                f"--track {word}: nothing follows '='; write --track {name}, or {name}=TARGET"
            )
        targets[name] = target or None
    return targets


def ask(requests: Sequence[str]) -> None:
    """Ask for trackers, in this process and in the workers that it starts; raises the errors of `parse`."""
    parse(requests)
    os.environ[TRACK] = "\n".join(requests)


@contextlib.contextmanager
def asking(requests: Sequence[str]) -> Iterator[None]:
    """Ask for trackers during a training; without words, for the trackers that the environment names."""
    before = os.environ.get(TRACK)
    if requests:
        ask(requests)
    try:
        yield
    finally:
        if before is not None:
            os.environ[TRACK] = before
        else:
            os.environ.pop(TRACK, None)


def asked() -> list[str]:
    """Return the words that the environment holds."""
    return [line for line in os.environ.get(TRACK, "").splitlines() if line.strip()]


class EventSink:
    """Sends `run_started`, `epoch_finished` and `run_finished` to every tracker that listens.

    Parameters
    ----------
    registered:
        Where trackers are registered.
    requests:
        The trackers that are asked for, `NAME` or `NAME=TARGET`.

    Attributes
    ----------
    problems:
        One line for every tracker that was left out.
    """

    def __init__(self, registered: registry.Registry, requests: Sequence[str] = ()) -> None:
        self.problems: list[str] = []
        self._trackers: dict[str, Any] = {}
        always = [name for name, each in registered.of(specs.TrackerSpec).items() if each.spec.always]
        words = {word.partition("=")[0]: word for word in (*always, *requests)}  # a request says the target
        for name, word in words.items():
            self._guarded(name, "its factory", functools.partial(self._build, registered, word))

    def _build(self, registered: registry.Registry, word: str) -> None:
        [(name, target)] = parse([word], registered).items()
        self._trackers[name] = build(registered.get(specs.TrackerSpec, name).spec, target)

    def heard(self, event: str) -> bool:
        """Whether some tracker listens to an event: reading its arguments takes time."""
        return any(hasattr(tracker, event) for tracker in self._trackers.values())

    def send(self, event: str, **content: Any) -> None:
        """Tell every tracker of an event, each on its own."""
        for name, tracker in list(self._trackers.items()):
            method = getattr(tracker, event, None)
            if method is not None:
                self._guarded(name, event, functools.partial(method, *content.values()))

    def _guarded(self, name: str, event: str, call: Callable[[], Any]) -> None:
        try:
            call()
        except Exception as error:
            self._trackers.pop(name, None)
            message = f"tracker '{name}' failed in {event} and is left out: {registry.words(error)}"
            self.problems.append(message)
            log.warning(message)


def build(spec: specs.TrackerSpec, target: str | None) -> Any:
    """Build a tracker."""
    tracker = specs.resolve(spec.factory)(target)
    if not any(callable(getattr(tracker, event, None)) for event in EVENTS):
        raise PluginError(f"{type(tracker).__name__} has none of the methods {', '.join(EVENTS)}")
    return tracker
