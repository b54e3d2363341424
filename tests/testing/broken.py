"""What the tests of broken plugins share: a table of rules, the plugin that breaks each, and the expected message."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from qrlsuite.specs import Spec
from qrlsuite.testing import _FILES
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import Finding


@dataclass(frozen=True)
class Broken:
    """A spec that breaks one rule.

    Attributes
    ----------
    message:
        A regular expression for what the broken rule says.
    also:
        Rules that cannot but break with it.
    """

    spec: Spec
    message: str
    also: frozenset[str] = field(default_factory=frozenset)


Cases = Sequence[tuple[str, Broken]]
"""Broken plugins by the rule that they break; a rule may be broken in several ways."""


def ids(cases: Cases) -> list[str]:
    """Return what pytest calls each case: the rule, and the spec's name."""
    return [f"{rule.replace(' ', '-')}-{case.spec.name}" for rule, case in cases]


def own_rules(kind: str, spec: Spec, settings: Mapping[str, Any] | None = None) -> list[Finding]:
    """Go through the rules of a kind, without those that all kinds share (they start an interpreter each time)."""
    module = importlib.import_module(f"qrlsuite.testing.{_FILES[kind]}")
    findings: list[Finding] = module.check(Subject(kind, spec, None, (), dict(settings or {})))
    return findings


def assert_breaks(kind: str, rule: str, case: Broken) -> None:
    """Assert that a plugin breaks exactly this rule, and what is said about it."""
    broken = {finding.rule: finding.message for finding in own_rules(kind, case.spec) if not finding.ok}
    assert rule in broken, f"'{rule}' holds; broken are {broken}"
    assert re.search(case.message, broken[rule]), broken[rule]
    assert broken.keys() == {rule} | case.also, f"also broken: {broken.keys() - {rule}}"
