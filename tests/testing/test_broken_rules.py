"""Significance rules, engines and trackers that break one rule of their kind each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from qrlsuite import hookimpl
from qrlsuite.engine.api import Answer
from qrlsuite.specs import EngineSpec, RuleSpec, Spec, TrackerSpec
from qrlsuite.testing import check
from qrlsuite.training.remote_task import work_on
from tests.testing.broken import Broken, assert_breaks, own_rules

HERE = __name__


class GoodRule:
    name = "good"
    promise = "none"

    def sign(self, first: Any, second: Any) -> Any:
        fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
        return fewer.astype("int8") - more.astype("int8")

    def __call__(self, first: Any, second: Any) -> Any:
        return self.sign(first, second)


class Unnamed:
    promise = "none"

    def __call__(self, first: Any, second: Any) -> Any:
        return GoodRule().sign(first, second)


class NoPromise(GoodRule):
    promise = ""


class Floats(GoodRule):
    def __call__(self, first: Any, second: Any) -> Any:
        return self.sign(first, second) / 2


class Flat(GoodRule):
    def __call__(self, first: Any, second: Any) -> Any:
        return self.sign(first, second).ravel()


class Moody(GoodRule):
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, first: Any, second: Any) -> Any:
        self.calls += 1
        swings = first.entry.name == "fast" and second.entry.name == "slow" and self.calls % 2
        return self.sign(first, second) * (0 if swings else 1)


class Partial(GoodRule):
    def __call__(self, first: Any, second: Any) -> Any:
        return np.maximum(self.sign(first, second), 0)


class Vain(GoodRule):
    def __call__(self, first: Any, second: Any) -> Any:
        order = ("fast", "same", "slow", "never", "mixed")
        if {first.entry.name, second.entry.name} == {"fast", "same"}:
            less = order.index(first.entry.name) < order.index(second.entry.name)
            return np.full(first.grid.shape, 1 if less else -1, dtype=np.int8)
        return self.sign(first, second)


class Backwards(GoodRule):
    def __call__(self, first: Any, second: Any) -> Any:
        return -self.sign(first, second)


class Hasty(GoodRule):
    def against(self, first: Any, others: Sequence[Any]) -> Any:
        return np.zeros((len(others), *first.grid.shape), dtype=np.int8)


class GoodEngine:
    def __init__(self, options: None) -> None:
        pass

    def workers(self, asked: int | None) -> int:
        return asked or 4

    def queued(self, store: Any) -> set[int]:
        return set()

    def run(self, works: Any, show: Any) -> None:
        raise AssertionError("a check starts nothing")


def picky_engine() -> GoodEngine:
    return GoodEngine(None)


class ShortRun(GoodEngine):
    def run(self, works: Any) -> None:  # type: ignore[override]
        pass


class WithoutQueue:
    workers, run = GoodEngine.workers, GoodEngine.run

    def __init__(self, options: None) -> None:
        pass


class Idle(GoodEngine):
    def workers(self, asked: int | None) -> int:
        return 0


class Many(GoodEngine):
    def workers(self, asked: int | None) -> int:
        return 4


class Queue(GoodEngine):
    def queued(self, store: Any) -> Any:
        return [0, 1]


class GoodLink:
    """Works on its tasks itself, when answers are asked for."""

    def __init__(self) -> None:
        self.tasks: list[tuple[str, bytes]] = []

    def send(self, key: str, task: bytes, priority: int) -> None:
        self.tasks.append((key, task))

    def receive(self, seconds: float) -> list[Answer]:
        answers = [Answer(key, work_on(task)) for key, task in self.tasks]
        self.tasks.clear()
        return answers

    def close(self) -> None:
        self.tasks.clear()


class GoodRemote:
    link: type[GoodLink] = GoodLink
    workers, queued, run = GoodEngine.workers, GoodEngine.queued, GoodEngine.run

    def __init__(self, options: None) -> None:
        pass

    def connect(self, workers: int, versions: Mapping[str, str | None]) -> GoodLink:
        return self.link()


class ShortConnect(GoodRemote):
    def connect(self, address: str) -> GoodLink:  # type: ignore[override]
        return GoodLink()


class TextLink(GoodLink):
    def receive(self, seconds: float) -> list[Answer]:
        return [Answer(each.key, str(each.content)) for each in super().receive(seconds)]  # type: ignore[arg-type]


class CutLink(GoodLink):
    def receive(self, seconds: float) -> list[Answer]:
        return [Answer(each.key, each.content[:-1]) for each in super().receive(seconds)]


class EchoLink(GoodLink):
    def receive(self, seconds: float) -> list[Answer]:
        tasks = dict(self.tasks)
        return [Answer(each.key, tasks[each.key]) for each in super().receive(seconds)]


class MixingLink(GoodLink):
    def receive(self, seconds: float) -> list[Answer]:
        came = super().receive(seconds)
        return [Answer(each.key, other.content) for each, other in zip(came, reversed(came))]


class RepeatingLink(GoodLink):
    def receive(self, seconds: float) -> list[Answer]:
        return 2 * super().receive(seconds)


class TextRemote(GoodRemote):
    link = TextLink


class CutRemote(GoodRemote):
    link = CutLink


class EchoRemote(GoodRemote):
    link = EchoLink


class MixingRemote(GoodRemote):
    link = MixingLink


class RepeatingRemote(GoodRemote):
    link = RepeatingLink


class GoodTracker:
    def __init__(self, target: str | None) -> None:
        pass

    def epoch_finished(self, run: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        sum(record["scores"])


def deaf_tracker(target: str | None) -> object:
    return object()


def no_target(target: str | None) -> GoodTracker:
    if target is not None:
        raise ValueError("a target is not supported")
    return GoodTracker(target)


class Careless(GoodTracker):
    def epoch_finished(self, run: Any, record: Any) -> None:
        format(record["train_return"], ".3f")


class Rewriting(GoodTracker):
    def run_started(self, run: Any) -> None:
        run["seed"] = 0


def rule(name: str) -> Spec:
    return RuleSpec(name="broken", summary="Breaks a rule", factory=f"{HERE}:{name}")


def engine(name: str) -> Spec:
    return EngineSpec(name="broken", summary="Breaks a rule", factory=f"{HERE}:{name}")


def tracker(name: str) -> Spec:
    return TrackerSpec(name="broken", summary="Breaks a rule", factory=f"{HERE}:{name}")


BROKEN = [
    ("rules", "builds", Broken(rule("NoPromise"), r"promise is '', and must be text")),
    ("rules", "signs", Broken(rule("Floats"), r"as float64, and must hold -1, 0 and 1 as int8")),
    ("rules", "repeatable", Broken(
        rule("Moody"), r"judged differently the second time: draw", frozenset({"antisymmetric"})
    )),
    ("rules", "antisymmetric", Broken(rule("Partial"), r"ranks would depend on the order")),
    ("rules", "equal entries", Broken(rule("Vain"), r"same curves differ significantly")),
    ("rules", "direction", Broken(rule("Backwards"), r"-1 for an entry that needs about 300")),
    ("rules", "against", Broken(rule("Hasty"), r"is not rule\(first, other\) for each")),
    ("engines", "builds", Broken(engine("picky_engine"), r"the factory takes the options, or None")),
    ("engines", "methods", Broken(engine("ShortRun"), r"run\(works, show\) cannot be called")),
    ("engines", "workers", Broken(engine("Many"), r"workers\(1\) returned 4: more than --workers 1 allows")),
    ("engines", "queued", Broken(engine("Queue"), r"returned \[0, 1\] .* seeds in it are never trained")),
    ("trackers", "builds", Broken(tracker("deaf_tracker"), r"object has none of the methods run_started")),
    ("trackers", "target", Broken(tracker("no_target"), r"not supported; the factory takes one argument")),
    ("trackers", "events", Broken(tracker("Careless"), r"epoch_finished raises TypeError: .*show hook")),
    ("rules", "builds", Broken(rule("Unnamed"), r"Unnamed has no name: see qrlsuite.statistics")),
    ("rules", "signs", Broken(rule("Flat"), r"has shape \(6,\), and must have \(epsilons, deltas\)")),
    ("engines", "methods", Broken(engine("WithoutQueue"), r"has no method queued\(store\): see qrlsuite.engine.api")),
    ("engines", "workers", Broken(engine("Idle"), r"workers\(None\) returned 0, and must return how many")),
    ("engines", "methods", Broken(engine("ShortConnect"), r"connect\(workers, versions\) cannot be called")),
    ("engines", "answers", Broken(engine("TextRemote"), r"in the place of bytes")),
    ("engines", "answers", Broken(engine("CutRemote"), r"answer to task 'first' is not what `work_on` returned")),
    ("engines", "answers", Broken(engine("EchoRemote"), r"are answers mixed up, or not made by qrlsuite.training")),
    ("engines", "answers", Broken(engine("MixingRemote"), r"answer to task 'first' is .*'token': 'third'")),
    ("engines", "once", Broken(engine("RepeatingRemote"), r"answers came to first, first, second, second, third")),
    ("trackers", "events", Broken(tracker("Rewriting"), r"run_started changes the mapping")),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "case"), BROKEN)
def test_one_rule_is_broken(kind: str, name: str, case: Broken) -> None:
    assert_breaks(kind, name, case)


@pytest.mark.parametrize(
    ("kind", "spec"),
    [
        ("rules", rule("GoodRule")),
        ("engines", engine("GoodEngine")),
        ("engines", engine("GoodRemote")),
        ("trackers", tracker("GoodTracker")),
    ],
)
def test_every_rule_is_broken_by_one(kind: str, spec: Spec) -> None:
    findings = own_rules(kind, spec)
    assert all(finding.ok for finding in findings), findings
    optional = {"rules": {"against"}, "engines": {"answers", "once"}}.get(kind, set())
    assert {finding.rule for finding in findings} | optional == {name for k, name, _ in BROKEN if k == kind}


def made_at_run_time() -> ModuleType:
    module = ModuleType("made_at_run_time")
    module.__dict__["run_started"] = hookimpl(lambda run: None)
    return module


class Unmarked:
    def run_started(self, run: Any) -> None:
        pass


class Misnamed:
    @hookimpl
    def epoch_finished(self, run: Any, line: Any) -> None:
        pass


class Failing:
    @hookimpl
    def run_finished(self, run: Any) -> None:
        raise RuntimeError("no network")


@pytest.mark.parametrize(
    ("plugin", "name", "message"),
    [
        ("no_such_module_of_mine", "imports", "nor is there a module of that name"),
        (Unmarked(), "hooks", "run_started: write @hookimpl above it"),
        (object(), "hooks", "it implements none of run_started"),
        (Misnamed(), "hooks", "line"),
        (Failing(), "events", "run_finished raises RuntimeError: no network"),
        (made_at_run_time(), "lazy imports", "ModuleNotFoundError: No module named 'made_at_run_time'"),
    ],
)
def test_plugins_that_watch_runs(plugin: Any, name: str, message: str) -> None:
    [broken] = [finding for finding in check("tracker", plugin) if not finding.ok]
    assert broken.rule == name
    assert message in broken.message


def test_a_plugin_that_watches_runs_and_imports_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import scipy\nfrom qrlsuite import hookimpl\n@hookimpl\ndef run_started(run): pass\n"
    (tmp_path / "watches_with_scipy.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    [broken] = [finding for finding in check("tracker", "watches_with_scipy") if not finding.ok]
    assert "importing 'watches_with_scipy' imports scipy: import it inside the hook" in broken.message
