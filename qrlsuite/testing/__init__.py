"""Conformance checks, for plugin authors before shipping, and for the suite's own plugins.

In pytest, one line:

    from qrlsuite.testing import assert_conforms

    def test_it_conforms():
        assert_conforms("ansatz", "my-ansatz")

or, one finding after another:

    for finding in check("model", "my-model", settings={"width": 8}):
        print(finding.rule, finding.ok, finding.message)

On the command line: `qrlsuite check my-model`, or `qrlsuite check my-distribution`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qrlsuite.testing.findings import Finding

__all__ = ["Finding", "assert_conforms", "check"]

KINDS = ("ansatz", "circuit_backend", "model", "environment", "algorithm", "task", "tracker")
"""Kinds with rules of their own; of the others, loading and registering are checked."""

Settings = Mapping[str, Any] | None


def check(kind: str, name_or_spec: Any, settings: Settings = None, **more: Any) -> list[Finding]:
    """Check a registered thing, or a spec, by its kind in the singular or the plural.

    Parameters
    ----------
    kind:
        `"ansatz"`, `"circuit-backend"`, `"model"`, `"environment"`, `"algorithm"`, `"task"`, ...
    name_or_spec:
        A registered name, or a spec that need not be registered.
    settings:
        Values of options; others take their defaults (and circuit models two qubits and one layer).
    more:
        For an algorithm or model: `task`, a task or its file, whose environment replaces the toys.
    """
    import importlib

    from qrlsuite import specs
    from qrlsuite.testing import common

    checked = specs.kind(kind)
    subject = common.subject(checked, name_or_spec, settings)
    findings, usable = common.check_common(subject)
    if not usable or checked.kind not in KINDS:
        return findings
    of_kind: list[Finding] = importlib.import_module(f"qrlsuite.testing.{checked.kind}").check(
        subject, **more
    )
    return findings + of_kind


def assert_conforms(kind: str, name_or_spec: Any, settings: Settings = None, **more: Any) -> None:
    """Fail with every broken rule and its likely cause; arguments as for `check`."""
    broken = [finding for finding in check(kind, name_or_spec, settings, **more) if not finding.ok]
    if broken:
        lines = [f"  {finding.rule}: {finding.message}" for finding in broken]
        raise AssertionError("\n".join([f"{kind} {name_or_spec!r} breaks {len(broken)} rules:", *lines]))
