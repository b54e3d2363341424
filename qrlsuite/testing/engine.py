"""Rules of engines, checked without training anything."""

from __future__ import annotations

import inspect
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from qrlsuite import specs
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import Checklist, Finding, require

METHODS = {"workers": ("asked",), "queued": ("store",), "run": ("works", "show")}
REMOTE_METHODS = {**METHODS, "connect": ("workers", "versions")}
"""Methods of an engine without a shared folder."""

ANSWER_SECONDS = 60.0
"""How long the answers to the check's tasks are waited for."""

TASKS = ("first", "second", "third")


def check(subject: Subject) -> list[Finding]:
    """Check an engine; nothing is trained, for that may cost a cluster's time.

    An engine that has `connect` is sent three tasks, which `work_on` refuses at once.
    """
    spec = subject.spec
    assert isinstance(spec, specs.EngineSpec)
    rules = Checklist()
    engines: list[Any] = []
    cause = subject.missing() or "the factory takes the options, or None where the spec has none"
    factory, options = specs.resolve(spec.factory), subject.options()
    if not rules.run("builds", "factory(options)", lambda: engines.append(factory(options)), cause):
        return rules.findings
    remote = hasattr(engines[0], "connect")
    methods = REMOTE_METHODS if remote else METHODS
    written = ", ".join(f"{name}({', '.join(arguments)})" for name, arguments in methods.items())
    if not rules.run("methods", written, lambda: _methods(engines[0], methods)):
        return rules.findings
    rules.run("workers", "a number of one or more, asked for or not", lambda: _workers(engines[0]))
    rules.run("queued", "no seed of an entry that was never submitted waits", lambda: _queued(engines[0]))
    if remote:
        answers: list[tuple[str, Any]] = []
        rules.run(
            "answers",
            "a task is answered by what `work_on` returns",
            lambda: _answers(engines[0], answers),
            subject.missing(),
        )
        rules.run("once", "each task is answered once", lambda: _once(answers))
    return rules.findings


def _methods(engine: Any, methods: dict[str, tuple[str, ...]]) -> None:
    for name, arguments in methods.items():
        method = getattr(engine, name, None)
        require(
            callable(method),
            f"{type(engine).__name__} has no method {name}({', '.join(arguments)}): see qrlsuite.engine.api",
        )
        try:
            inspect.signature(method).bind(*arguments)  # type: ignore[arg-type]
        except TypeError as error:
            require(False, f"{name}({', '.join(arguments)}) cannot be called: {error}")


def _workers(engine: Any) -> None:
    for requested in (None, 1, 3):
        got = engine.workers(requested)
        require(
            isinstance(got, int) and not isinstance(got, bool) and got >= 1,
            f"workers({requested}) returned {got!r}, and must return how many groups may run at a time, one or more",
        )
        require(
            requested is None or got <= requested,
            f"workers({requested}) returned {got}: more than --workers {requested} allows",
        )


def _queued(engine: Any) -> None:
    from qrlsuite.results.store import EntryStore

    with tempfile.TemporaryDirectory() as folder:
        got = engine.queued(EntryStore(Path(folder) / "task" / "entry"))
    require(
        isinstance(got, set) and not got,
        f"queued(store) returned {got!r} for an entry that was never submitted, and must return an empty set: seeds "
        "in it are never trained",
    )


def _answers(engine: Any, answers: list[tuple[str, Any]]) -> None:
    """Send tasks for a version that nobody has, and collect key and content of every answer."""
    from qrlsuite.errors import StoreError
    from qrlsuite.training.remote_task import pack, unpack

    link = engine.connect(1, {})
    try:
        for token in TASKS:
            task = {"token": token, "seeds": [0], "versions": {"qrlsuite": "0"}}
            link.send(token, pack(task, {}), 0)
        answers += _received(link)
    finally:
        link.close()
    for key, content in answers:
        try:
            require(isinstance(content, bytes), f"it is {content!r} in the place of bytes")
            header, _ = unpack(content)
        except StoreError as error:
            require(False, f"the answer to task '{key}' is not what `work_on` returned: {error}")
        refused = "instead of 0" in str(header.get("refused"))
        require(
            refused and header.get("token") == key,
            f"the answer to task '{key}' is {header}, and `work_on` refuses it and names its token: are answers mixed "
            "up, or not made by qrlsuite.training.remote_task.work_on?",
        )


def _received(link: Any) -> Iterator[tuple[str, Any]]:
    """Yield key and content of the answers, until all have come and nothing follows."""
    missing, deadline = set(TASKS), time.monotonic() + ANSWER_SECONDS
    while True:
        came = link.receive(0.5)
        for answer in came:
            missing.discard(answer.key)
            yield answer.key, answer.content
        if not came and (not missing or time.monotonic() > deadline):
            return


def _once(answers: list[tuple[str, Any]]) -> None:
    keys = sorted(key for key, _ in answers)
    require(
        keys == sorted(TASKS),
        f"tasks {', '.join(TASKS)} were sent, and answers came to {', '.join(keys) or 'none'}: each must be answered "
        f"once, within {ANSWER_SECONDS:g} s",
    )
