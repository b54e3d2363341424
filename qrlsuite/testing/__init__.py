"""Conformance checks: what a plugin author runs before shipping, and what the suite runs on its own plugins.

In pytest, one line:

    from qrlsuite.testing import assert_conforms

    def test_it_conforms():
        assert_conforms("ansatz", "my-ansatz")

or, one finding after another:

    for finding in check_model("my-model", settings={"width": 8}):
        print(finding.rule, finding.ok, finding.message)

On the command line: `qrlsuite check my-model`, or `qrlsuite check my-distribution`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qrlsuite.testing.findings import Finding

__all__ = [
    "Finding",
    "assert_conforms",
    "check",
    "check_algorithm",
    "check_ansatz",
    "check_circuit_backend",
    "check_engine",
    "check_environment",
    "check_model",
    "check_rule",
    "check_study",
    "check_task",
    "check_tracker",
]

_FILES = {
    "ansatzes": "ansatz",
    "circuit_backends": "backend",
    "models": "model",
    "environments": "environment",
    "algorithms": "algorithm",
    "tasks": "task",
    "engines": "engine",
    "rules": "rule",
    "studies": "study",
    "trackers": "tracker",
}
"""Where the checks of each kind are."""

Settings = Mapping[str, Any] | None


def check(kind: str, name_or_spec: Any, settings: Settings = None, **more: Any) -> list[Finding]:
    """Check a registered thing, or a spec, by its kind in the singular or the plural; or a tracker.

    Parameters
    ----------
    kind:
        `"ansatz"`, `"circuit-backend"`, `"model"`, `"environment"`, `"algorithm"`, `"task"`, `"tracker"`, ...
    name_or_spec:
        A registered name, or a spec that need not be registered. For a plugin that implements the hooks of run
        events: the module, or its name.
    settings:
        Values of options; others take their defaults (and circuit models two qubits and one layer).

    Raises
    ------
    QrlSuiteError
        If there is no such kind or name.
    """
    import importlib

    from qrlsuite.testing import common

    plural_kind = plural(kind)
    if plural_kind == "trackers" and not _is_named_tracker(name_or_spec):
        from qrlsuite.testing import tracker

        return tracker.check_plugin(name_or_spec)
    subject = common.subject(plural_kind, name_or_spec, settings)
    findings, usable = common.check_common(subject)
    if not usable:
        return findings
    file = importlib.import_module(f"qrlsuite.testing.{_FILES[plural_kind]}")
    kind_findings: list[Finding] = file.check(subject, **more)
    return findings + kind_findings


def _is_named_tracker(subject: Any) -> bool:
    """Tell a tracker that is registered by name from a plugin that implements the hooks of run events."""
    from qrlsuite import registry, specs

    return isinstance(subject, specs.TrackerSpec) or subject in registry.load().entries["trackers"]


def plural(kind: str) -> str:
    """Return a kind's name in the plural, as the registry has it.

    Raises
    ------
    UnknownNameError
        If there is no such kind.
    """
    from qrlsuite import registry
    from qrlsuite.errors import UnknownNameError, nearest

    word = kind.replace("-", "_")
    known = {single: many for many, single in registry.SINGULAR.items()} | {
        many: many for many in registry.KINDS
    }
    if word not in known:
        raise UnknownNameError(f"unknown kind '{kind}'{nearest(kind, known)}")
    return known[word]


def check_ansatz(name_or_spec: Any, settings: Settings = None) -> list[Finding]:
    """Check an ansatz: pure, every input and parameter used, gradients, all backends."""
    return check("ansatz", name_or_spec, settings)


def check_circuit_backend(name_or_spec: Any, settings: Settings = None) -> list[Finding]:
    """Check a circuit backend: shapes, values against dense matrices, gradients, seeds apart, shots."""
    return check("circuit_backend", name_or_spec, settings)


def check_model(name_or_spec: Any, settings: Settings = None) -> list[Finding]:
    """Check a model: shapes, registered parameters, seeds, gradients, copies, its population and state."""
    return check("model", name_or_spec, settings)


def check_environment(
    name_or_spec: Any, settings: Settings = None, deterministic: bool = False
) -> list[Finding]:
    """Check an environment: Gymnasium's rules, shapes, ends, scores, seeds apart, state.

    Parameters
    ----------
    deterministic:
        Whether all episodes are meant to be alike, whatever the seed.
    """
    return check("environment", name_or_spec, settings, deterministic=deterministic)


def check_algorithm(name_or_spec: Any, settings: Settings = None) -> list[Finding]:
    """Check an algorithm: metrics, interactions, greedy actions, seeds apart, exact resuming."""
    return check("algorithm", name_or_spec, settings)


def check_task(name_or_spec: Any) -> list[Finding]:
    """Check a task: its file, what it names, its ranking grid, its scores."""
    return check("task", name_or_spec)


def check_study(name_or_spec: Any) -> list[Finding]:
    """Check a study: its file, its entries, its pictures. It trains nothing."""
    return check("study", name_or_spec)


def check_engine(name_or_spec: Any, settings: Settings = None) -> list[Finding]:
    """Check an engine: its methods, numbers of workers, that a new entry waits for nothing; it trains nothing.

    An engine without a shared folder is connected to, and must answer tasks, each once.
    """
    return check("engine", name_or_spec, settings)


def check_rule(name_or_spec: Any) -> list[Finding]:
    """Check a significance rule: signs, antisymmetry, direction, equal entries, one against many."""
    return check("rule", name_or_spec)


def check_tracker(name_or_plugin: Any) -> list[Finding]:
    """Check a tracker: what a run sends it, two runs at once.

    Parameters
    ----------
    name_or_plugin:
        A registered name or a spec; or a plugin that implements the hooks of run events, as a module, an object
        or a module's name.
    """
    return check("tracker", name_or_plugin)


def assert_conforms(kind: str, name_or_spec: Any, settings: Settings = None, **more: Any) -> None:
    """Fail with every broken rule and its likely cause; the arguments are those of `check`.

    Raises
    ------
    AssertionError
        If a rule does not hold.
    """
    broken = [finding for finding in check(kind, name_or_spec, settings, **more) if not finding.ok]
    if broken:
        lines = [f"  {finding.rule}: {finding.message}" for finding in broken]
        raise AssertionError("\n".join([f"{kind} {name_or_spec!r} breaks {len(broken)} rules:", *lines]))
