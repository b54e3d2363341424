"""Rules of engines, checked without starting anything."""

from __future__ import annotations

import inspect
import tempfile
from pathlib import Path
from typing import Any

from qrlsuite import specs
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import Checklist, Finding, require

METHODS = {"workers": ("asked",), "queued": ("store",), "run": ("work", "show")}


def check(subject: Subject) -> list[Finding]:
    """Check an engine; nothing is trained, for that may cost a cluster's time."""
    spec = subject.spec
    assert isinstance(spec, specs.EngineSpec)
    rules = Checklist()
    engines: list[Any] = []
    cause = subject.missing() or "the factory takes the options, or None where the spec has none"
    factory, options = specs.resolve(spec.factory), subject.options()
    if not rules.run("builds", "factory(options)", lambda: engines.append(factory(options)), cause):
        return rules.findings
    if not rules.run(
        "methods", "workers(asked), queued(store), run(work, show)", lambda: _methods(engines[0])
    ):
        return rules.findings
    rules.run("workers", "a number of one or more, asked for or not", lambda: _workers(engines[0]))
    rules.run("queued", "no seed of an entry that was never submitted waits", lambda: _queued(engines[0]))
    return rules.findings


def _methods(engine: Any) -> None:
    for name, arguments in METHODS.items():
        method = getattr(engine, name, None)
        require(
            callable(method),
            f"{type(engine).__name__} has no method {name}({', '.join(arguments)}): see qrlsuite.engine.api.Engine",
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
