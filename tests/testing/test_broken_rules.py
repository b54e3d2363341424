"""Rules, engines and trackers that break one rule of their kind each."""

from __future__ import annotations

import pytest

from qrlsuite.scaffold import Kind
from qrlsuite.specs import EngineSpec, RuleSpec, Spec, TrackerSpec
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, ids, module, template

RULE = """
import numpy as np


class Good:
    name = "good"
    promise = "none"

    def __call__(self, first, second):
        fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
        signs = fewer.astype("int8") - more.astype("int8")
        return signs
"""
ENGINE = """
class Good:
    def __init__(self, options):
        pass

    def workers(self, asked):
        return asked or 4

    def queued(self, store):
        return set()

    def run(self, work, show):
        raise AssertionError("a check starts nothing")
"""
REMOTE = (
    """
from qrlsuite.engine.api import Answer
from qrlsuite.training.remote_task import work_on


class Link:
    def __init__(self):
        self.tasks = []

    def send(self, key, task, priority):
        self.tasks.append((key, task))

    def receive(self, seconds):
        answers = [Answer(key, work_on(task)) for key, task in self.tasks]
        self.tasks.clear()
        return answers

    def close(self):
        self.tasks.clear()
"""
    + ENGINE
    + """
    def connect(self, workers, versions):
        return Link()
"""
)
SIGNS, ANSWERS, PROMISE = "return signs", "return answers", 'promise = "none"'
GOOD = {"rule": RULE, "engine": ENGINE, "remote": REMOTE, "tracker": template(Kind.tracker)}
EDITS = {
    "rule": [
        edit("builds", r"promise is '', and must be text", PROMISE, "promise = ''"),
        edit("builds", r"Good has no name: see qrlsuite.statistics", 'name = "good"', ""),
        edit("signs", r"as float64, and must hold -1, 0 and 1 as int8", SIGNS, f"{SIGNS} / 2"),
        edit("signs", r"has shape \(6,\), and must have \(epsilons, deltas\)", SIGNS, f"{SIGNS}.ravel()"),
        edit("repeatable", r"judged differently the second time: draw", PROMISE, f"{PROMISE}; calls = 0",
             SIGNS, "self.calls += 1\n        "
             "swings = (first.entry.name, second.entry.name) == ('fast', 'slow')\n        "
             "return signs * (0 if swings and self.calls % 2 else 1)", also=["antisymmetric"]),
        edit("antisymmetric", r"ranks would depend on the order", SIGNS, "return np.maximum(signs, 0)"),
        edit("equal entries", r"same curves differ significantly", SIGNS,
             "pair = first.entry.name, second.entry.name\n        one = np.int8(pair == ('fast', 'same'))\n        "
             "return signs + one - np.int8(pair == ('same', 'fast'))"),
        edit("direction", r"-1 for an entry that needs about 300", SIGNS, "return -signs"),
        edit("against", r"is not rule\(first, other\) for each", SIGNS,
             f"{SIGNS}\n\n    def against(self, first, others):\n        "
             "return np.zeros((len(others), *first.grid.shape), dtype=np.int8)"),
    ],
    "engine": [
        edit("builds", r"the factory takes the options, or None", "self, options", "self"),
        edit("methods", r"run\(works, show\) cannot be called", "work, show", "work"),
        edit("methods", r"has no method queued\(store\): see qrlsuite.engine.api", "def queued", "def _queued"),
        edit("workers", r"workers\(1\) returned 4: more than --workers 1 allows", "return asked or 4", "return 4"),
        edit("workers", r"workers\(None\) returned 0, and must return how many", "return asked or 4", "return 0"),
        edit("queued", r"returned \[0, 1\] .* seeds in it are never trained", "return set()", "return [0, 1]"),
    ],
    "remote": [
        edit("methods", r"connect\(workers, versions\) cannot be called", "workers, versions", "address"),
        edit("answers", r"in the place of bytes", "work_on(task))", "str(work_on(task)))"),
        edit("answers", r"answer to task 'first' is not what `work_on` returned",
             "work_on(task))", "work_on(task)[:-1])"),
        edit("answers", r"are answers mixed up, or not made by qrlsuite.training", "work_on(task))", "task)"),
        edit("answers", r"answer to task 'first' is .*'token': 'third'", ANSWERS,
             "return [Answer(mine.key, other.content) for mine, other in zip(answers, reversed(answers))]"),
        edit("once", r"answers came to first, first, second, second, third", ANSWERS, f"{ANSWERS} * 2"),
    ],
    "tracker": [
        edit("builds", r"object has none of the methods run_started",
             "class Tracker", "Tracker = lambda target: object()\n\n\nclass Other"),
        edit("target", r"not supported; the factory takes one argument",
             "self.path = None", "if target is not None: raise ValueError('a target is not supported')\n        "
             "self.path = None"),
        edit("events", r"epoch_finished raises TypeError: .*training.trackers",
             "{mean:.6f}", "{record['train_return']:.3f}"),
        edit("events", r"run_started changes the mapping",
             "    def epoch_finished",
             "    def run_started(self, run):\n        run['seed'] = 0\n\n    def epoch_finished"),
    ],
}  # fmt: skip
CASES = [(kind, edit) for kind, edits in EDITS.items() for edit in edits]


def spec(kind: str, source: str) -> Spec:
    name = module(source)
    if kind == "tracker":
        return TrackerSpec("broken", "Breaks a rule", factory=f"{name}:Tracker")
    made = RuleSpec if kind == "rule" else EngineSpec
    return made("broken", "Breaks a rule", factory=f"{name}:Good")


@pytest.mark.parametrize(("kind", "edit"), CASES, ids=ids(edit for _, edit in CASES))
def test_one_rule_is_broken(kind: str, edit: Edit) -> None:
    assert_breaks(spec(kind, edit.of(GOOD[kind])), edit.rule, edit.message, edit.also)


@pytest.mark.parametrize("kind", GOOD)
def test_every_rule_is_broken_by_one(kind: str) -> None:
    rules = assert_all_good(spec(kind, GOOD[kind]))
    broken = {edit.rule for edit in EDITS[kind]} | (
        {edit.rule for edit in EDITS["engine"]} if kind == "remote" else set()
    )
    assert rules | ({"against"} if kind == "rule" else set()) == broken
