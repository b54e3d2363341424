"""Run events for trackers: a tracker that fails is reported once and never stops a run.

Two kinds of trackers listen: plugins that implement the hooks `run_started`, `epoch_finished` and `run_finished`,
which watch every run, and those registered with `register_trackers`, which watch when they are asked for. Workers
are asked through the environment variable `QRLSUITE_TRACK`, which `qrlsuite run --track` sets.
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


def parse(requests: Sequence[str]) -> dict[str, str | None]:
    """Return targets by name from words `NAME` or `NAME=TARGET`.

    Raises
    ------
    UnknownNameError
        If no tracker has the name.
    QrlSuiteError
        If a package that a tracker needs is not installed; the message has the pip command.
    """
    targets: dict[str, str | None] = {}
    for word in requests:
        name, equals, target = word.strip().partition("=")
        for module, command in registry.tracker(name).extras.items():
            if importlib.util.find_spec(module) is None:
                raise QrlSuiteError(f"tracker '{name}' needs the package '{module}': {command}")
        if equals and not target:
            raise QrlSuiteError(
                f"--track {word}: nothing follows '='; write --track {name}, or {name}=TARGET"
            )
        targets[name] = target or None
    return targets


def ask(requests: Sequence[str]) -> None:
    """Ask for trackers, in this process and in the workers that it starts; the errors are those of `parse`."""
    parse(requests)
    os.environ[TRACK] = "\n".join(requests)


@contextlib.contextmanager
def asking(requests: Sequence[str]) -> Iterator[None]:
    """Ask for trackers while something is trained; without words, for those that the environment names."""
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
    known:
        Where trackers are registered.
    requests:
        The trackers that are asked for, `NAME` or `NAME=TARGET`.

    Attributes
    ----------
    problems:
        One line for every tracker that was left out.
    """

    def __init__(self, known: registry.Registry, requests: Sequence[str] = ()) -> None:
        self.known = known
        self.problems: list[str] = []
        self._failed: set[str] = set()
        self._asked: dict[str, Any] = {}
        for word in requests:
            self._guarded(word, "its factory", functools.partial(self._build, word))

    def _build(self, word: str) -> None:
        [(name, target)] = parse([word]).items()
        tracker = specs.resolve(registry.tracker(name).factory)(target)
        if not any(callable(getattr(tracker, event, None)) for event in EVENTS):
            raise PluginError(f"{type(tracker).__name__} has none of the methods {', '.join(EVENTS)}")
        self._asked[name] = tracker

    def heard(self, event: str) -> bool:
        """Whether any tracker may listen to an event: what it is told takes time to read."""
        return bool(self._asked) or bool(getattr(self.known.manager.hook, event).get_hookimpls())

    def send(self, event: str, **content: Any) -> None:
        """Tell every tracker of an event, each on its own."""
        for name, call in self._listeners(event, content):
            if name not in self._failed:
                self._guarded(name, event, call)

    def _listeners(self, event: str, content: dict[str, Any]) -> Iterator[tuple[str, Callable[[], Any]]]:
        for hook in getattr(self.known.manager.hook, event).get_hookimpls():
            arguments = [content[name] for name in hook.argnames]
            yield str(hook.plugin_name), functools.partial(hook.function, *arguments)
        for name, tracker in self._asked.items():
            method = getattr(tracker, event, None)
            if method is not None:
                yield name, functools.partial(method, *content.values())

    def _guarded(self, name: str, event: str, call: Callable[[], Any]) -> None:
        try:
            call()
        except Exception as error:
            self._failed.add(name)
            message = f"tracker '{name}' failed in {event} and is left out: {registry.words(error)}"
            self.problems.append(message)
            log.warning(message)
