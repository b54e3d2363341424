"""Rules of tasks: a complete file, known names, scores in [0, 1]."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite import options, registry, specs
from qrlsuite.actions import draw
from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import Task, parse
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, require

LONGEST = 20_000
"""Steps within which an episode must end."""
EPISODES = 10
"""How many are looked at, within `LONGEST` steps."""


def check(subject: Subject) -> list[Finding]:
    """Check a task's file, and some episodes of random actions."""
    spec = subject.spec
    assert isinstance(spec, specs.TaskSpec)
    rules = Checklist()
    if not rules.run("file", "an absolute path, to a file that is there", lambda: _path(spec.path)):
        return rules.findings
    cause = "values are hashed as JSON, which has neither nan nor infinity"
    tasks: list[Task] = []
    if not rules.run(
        "format", "valid, with an environment that exists", lambda: tasks.append(_parsed(spec)), cause
    ):
        return rules.findings
    task = tasks[0]
    rules.run("says what is registered", "name and summary are the file's", lambda: _names(spec, task))
    rules.run("identity", "the same hash every time", lambda: _identity(spec, task))
    rules.run("algorithms", "the default one and those with presets exist", lambda: _algorithms(task))
    rules.run("settings", "of use in a run of the protocol's length", lambda: _settings(task))
    rules.run("ranking", "horizons are whole epochs, within a complete run", lambda: _ranking(task))
    rules.run("scores", "episodes end with a score, in [0, 1] where it is relative", lambda: _scores(task))
    return rules.findings


def _path(path: str) -> None:
    """Require that the spec leads to a file, from whatever folder a command runs in."""
    require(
        Path(path).is_absolute(),
        f"path = {path!r} is relative to the folder where a command runs: write str(Path(__file__).parent / ...)",
    )
    require(
        Path(path).is_file(),
        f"{path} is not there: is the TOML file among the package data, [tool.setuptools.package-data]?",
    )


def _parsed(spec: specs.TaskSpec) -> Task:
    path = Path(spec.path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BrokenRuleError(f"{path.name} is not text in UTF-8, as TOML is: {error}") from error
    return parse(text, path.name)


def _names(spec: specs.TaskSpec, task: Task) -> None:
    name, summary = task.file.name, task.file.summary
    require(
        name == spec.name,
        f"registered as '{spec.name}', and the file says name = '{name}': results would lie under another name than "
        "the command's",
    )
    require(
        summary == spec.summary,
        f"registered with the summary {spec.summary!r}, and the file says {summary!r}: read it from the file",
    )


def _identity(spec: specs.TaskSpec, task: Task) -> None:
    require(
        _parsed(spec).hash == task.hash,
        "read twice, the task has two hashes, under which results are kept: does an option of its environment take its "
        "default from a clock, a counter or a random number?",
    )


def _algorithms(task: Task) -> None:
    _algorithm("default_algorithm", task.file.default_algorithm)
    for name in task.file.protocol.algorithm_epochs:
        _algorithm("protocol.algorithm_epochs", name)
    for preset, by_algorithm in task.file.presets.items():
        for name, families in by_algorithm.items():
            for family in ("classical", "quantum"):
                values = {**families.get("all", {}), **families.get(family, {})}
                _algorithm(f"[presets.{preset}.{name}]", name, values)


def _algorithm(location: str, name: str, values: Mapping[str, Any] | None = None) -> None:
    """Require that an algorithm exists and takes values of options; `location` the file says so."""
    try:
        spec = registry.get(specs.AlgorithmSpec, name)
        if values is not None:
            options.build(specs.resolve(spec.options), values, f"algorithm '{name}'")
    except QrlSuiteError as error:
        raise BrokenRuleError(f"{location}: {error}") from error


def _settings(task: Task) -> None:
    """Require that a complete run can use every setting: a target network that is never copied learns nothing."""
    model = registry.get(specs.ModelSpec, specs.NO_MODEL)
    chosen = [(preset, name) for preset, by_algorithm in task.file.presets.items() for name in by_algorithm]
    for preset, name in [(None, task.file.default_algorithm), *chosen]:
        for family in ("classical", "quantum"):
            try:
                spec = registry.get(specs.AlgorithmSpec, name)
                used, values = task.preset(preset, name, family)
                given = options.build(specs.resolve(spec.options), values, f"algorithm '{name}'")
            except QrlSuiteError:
                continue  # another rule names it, or the preset is for the other family
            unusable = "; ".join(Entry(task, spec, model, given, None, used).unusable(task.epochs(name)))
            place = f"[presets.{used or 'default'}.{name}.all]"
            require(not unusable, f"{unusable}: write another value in {place}, or raise protocol.epochs")


def _ranking(task: Task) -> None:
    protocol = task.file.protocol
    complete = max(protocol.epochs, *protocol.algorithm_epochs.values(), 0) * protocol.interactions
    for horizon in task.file.ranking.horizons:
        require(
            horizon <= complete,
            f"the horizon {horizon} lies beyond a complete run, {complete} interactions: no entry would reach it; "
            "raise protocol.epochs, or protocol.algorithm_epochs of one algorithm",
        )


def _scores(task: Task) -> None:
    from qrlsuite.training.trainer import build_envs

    registered = registry.load()
    algorithm = next(iter(registered.of(specs.AlgorithmSpec).values())).spec
    model = next(iter(registered.of(specs.ModelSpec).values())).spec
    choose = np.random.Generator(np.random.Philox(key=9))
    ended = 0
    envs = build_envs(Entry(task, algorithm, model, None, None, None), 2, lambda: None)
    envs.seed_lanes([np.random.Generator(np.random.Philox(key=k)) for k in range(2)])
    envs.reset()
    for _ in range(LONGEST):
        envs.step(draw(envs.single_action_space, choose, 2))
        _, returns, scores = envs.take_finished()
        for value, score in zip(returns, scores):
            _score(task, float(value), float(score))
        ended += scores.size
        if ended >= EPISODES:
            return
    require(
        ended > 0, f"no episode ended within {LONGEST} steps of random actions: the task needs a time limit"
    )


def _score(task: Task, value: float, score: float) -> None:
    """Require that one episode's score is usable; `value` is its return."""
    observed = f"an episode of random actions has the return {value:.6g} and the score {score:.6g}"
    require(
        task.file.ranking.epsilons is None or 0 <= score <= 1 + 1e-9,
        f"{observed}, outside [0, 1]: is max_return the best possible return, and no return negative? Else rank on "
        "thresholds",
    )
