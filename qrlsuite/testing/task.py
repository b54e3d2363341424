"""What a task keeps to: a file that says all there is to say, about things that exist."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from qrlsuite import options, registry, specs
from qrlsuite.task import Task, parse
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, require

LONGEST = 20_000


def check(subject: Subject) -> list[Finding]:
    """Check a task's file, and one validation episode of random actions in each of two lanes."""
    spec = subject.spec
    assert isinstance(spec, specs.TaskSpec)
    rules = Checklist()
    made: list[Task] = []
    rules.run("file", "an absolute path, to a file that is there", lambda: _file(spec))
    if not rules.run("format", "valid, with an environment that exists", lambda: made.append(_parse(spec))):
        return rules.findings
    task = made[0]
    rules.run("says what is registered", "name and summary are the file's", lambda: _names(spec, task))
    rules.run("identity", "plain values, the same hash every time", lambda: _identity(spec, task))
    rules.run("algorithms", "the default one and those with presets exist", lambda: _algorithms(task))
    rules.run("ranking", "horizons hold an epoch or more", lambda: _ranking(task))
    rules.run("scores", "an episode ends with a score, in [0, 1] where it is relative", lambda: _scores(task))
    return rules.findings


def _file(spec: specs.TaskSpec) -> None:
    require(
        Path(spec.path).is_absolute(),
        f"path = {spec.path!r} is relative to the folder where a command runs: write str(Path(__file__).parent / ...)",
    )
    require(
        Path(spec.path).is_file(),
        f"{spec.path} is not there: is the TOML file among the package data, [tool.setuptools.package-data]?",
    )


def _parse(spec: specs.TaskSpec) -> Task:
    return parse(Path(spec.path).read_text(encoding="utf-8"), Path(spec.path).name)


def _names(spec: specs.TaskSpec, task: Task) -> None:
    require(
        task.file.name == spec.name,
        f"registered as '{spec.name}', and the file says name = '{task.file.name}': results would lie under another "
        "name than the command's",
    )
    require(
        task.file.summary == spec.summary,
        f"registered with the summary {spec.summary!r}, and the file says {task.file.summary!r}: read it from the file",
    )


def _identity(spec: specs.TaskSpec, task: Task) -> None:
    json.dumps(task.definition, allow_nan=False)
    require(
        _parse(spec).hash == task.hash,
        "read twice, the task has two hashes: do its options hold plain values?",
    )


def _algorithms(task: Task) -> None:
    registry.algorithm(task.file.default_algorithm)
    for preset, by_algorithm in task.file.presets.items():
        for name, families in by_algorithm.items():
            where = f"[presets.{preset}.{name}]"
            try:
                cls = specs.resolve(registry.algorithm(name).options)
                for family in ("classical", "quantum"):
                    options.build(cls, {**families.get("all", {}), **families.get(family, {})}, where)
            except Exception as error:
                raise BrokenRuleError(f"{where} cannot be used: {error}") from error


def _ranking(task: Task) -> None:
    epoch, horizon = task.file.protocol.interactions, min(task.file.ranking.horizons)
    require(
        horizon >= epoch,
        f"the horizon {horizon} is shorter than an epoch of {epoch} interactions: nothing could be told apart",
    )


def _scores(task: Task) -> None:
    from qrlsuite.entry import Entry
    from qrlsuite.run import build_envs

    algorithm = registry.algorithm(task.file.default_algorithm)
    known = registry.load().entries["models"]
    model = next(entry.spec for entry in known.values())
    assert isinstance(model, specs.ModelSpec)
    envs = build_envs(Entry(task, algorithm, model, None, None, None), 2, lambda: None)
    envs.seed_lanes([np.random.Generator(np.random.Philox(key=k)) for k in range(2)])
    envs.reset()
    choose = np.random.Generator(np.random.Philox(key=9))
    choices = int(envs.single_action_space.n)  # type: ignore[attr-defined]
    for _ in range(LONGEST):
        envs.step(choose.integers(choices, size=2))
        _, returns, scores = envs.take_finished()
        if scores.size == 0:
            continue
        if task.file.ranking.epsilons is not None:
            require(
                bool(np.isfinite(scores).all() and (scores >= 0).all() and (scores <= 1 + 1e-9).all()),
                f"an episode of random actions has the return {returns[0]:.6g} and the score {scores[0]:.6g}, outside "
                "[0, 1]: is max_return the best possible return, and no return negative? Else rank on thresholds",
            )
        require(bool(np.isfinite(scores).all()), f"an episode of random actions has the score {scores[0]}")
        return
    raise BrokenRuleError(
        f"no episode ended within {LONGEST} steps of random actions: the task needs a time limit"
    )
