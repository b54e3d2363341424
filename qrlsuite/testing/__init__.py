"""Conformance checks: what a plugin author runs before shipping, and what the suite runs on its own plugins.

In pytest, one line::

    from qrlsuite.testing import assert_conforms

    def test_it_conforms():
        assert_conforms("ansatz", "my-ansatz")

or, one finding after another::

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
    "check_environment",
    "check_model",
    "check_task",
    "check_tracker",
]

CHECKED = ("ansatzes", "circuit_backends", "models", "environments", "algorithms", "tasks")
"""Kinds with checks of their own; of other kinds, what all have in common is checked."""

Settings = Mapping[str, Any] | None


def check(kind: str, name_or_spec: Any, settings: Settings = None, **more: Any) -> list[Finding]:
    """Check a registered thing, or a spec, by its kind in the singular or the plural; or a tracker.

    Parameters
    ----------
    kind:
        `"ansatz"`, `"circuit-backend"`, `"model"`, `"environment"`, `"algorithm"`, `"task"`, `"tracker"`, ...
    name_or_spec:
        A registered name, or a spec that need not be registered. For a tracker: a module, or its name.
    settings:
        Values of options; others take their defaults (and circuit models two qubits and one layer).

    Raises
    ------
    QrlSuiteError
        If there is no such kind or name.
    """
    import importlib

    from qrlsuite.testing import common

    wanted = plural(kind)
    if wanted == "trackers":
        from qrlsuite.testing import tracker

        return tracker.check(name_or_spec)
    subject = common.subject(wanted, name_or_spec, settings)
    findings, usable = common.check_common(subject)
    if not usable or wanted not in CHECKED:
        return findings
    file = {"ansatzes": "ansatz", "circuit_backends": "backend"}.get(wanted, wanted[:-1])
    own: list[Finding] = importlib.import_module(f"qrlsuite.testing.{file}").check(subject, **more)
    return findings + own


def plural(kind: str) -> str:
    """Return a kind's name in the plural, as the registry has it; `"trackers"` for trackers.

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
    known |= {"tracker": "trackers", "trackers": "trackers"}
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


def check_tracker(plugin: Any) -> list[Finding]:
    """Check a tracker, given as a module, an object or a module's name: its hooks, and what they are sent."""
    return check("tracker", plugin)


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
