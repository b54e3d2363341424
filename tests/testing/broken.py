"""What the tests of broken plugins share: edits of a good plugin, each of which breaks one rule."""

from __future__ import annotations

import importlib
import itertools
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from qrlsuite.specs import Spec
from qrlsuite.testing import group, reproducible
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import Finding

NUMBERS = itertools.count()


@dataclass(frozen=True)
class Edit:
    """A change that makes something good break one rule.

    Attributes
    ----------
    message:
        A regular expression for what the broken rule says.
    changes:
        Texts and what stands in their place, in turn.
    also:
        Rules that cannot but break with it.
    spec:
        What else the spec says.
    """

    rule: str
    message: str
    changes: tuple[str, ...]
    also: frozenset[str]
    spec: Mapping[str, Any]

    def of(self, good: str) -> str:
        """Return what is broken."""
        for old, new in zip(self.changes[::2], self.changes[1::2], strict=True):
            assert old in good
            good = good.replace(old, new, 1)
        return good


def edit(rule: str, message: str, *changes: str, also: Iterable[str] = (), **spec: Any) -> Edit:
    return Edit(rule, message, changes, frozenset(also), spec)


def ids(edits: Iterable[Edit]) -> list[str]:
    """Return what pytest calls each case."""
    return [f"{edit.rule.replace(' ', '-')}-{number}" for number, edit in enumerate(edits)]


def good(kind: str) -> str:
    """Return the good plugin of a kind."""
    return Path(__file__).with_name("good").joinpath(f"{kind}.py").read_text()


def module(source: str) -> str:
    """Return the name of a new module with this source."""
    made = ModuleType(f"broken_{next(NUMBERS)}")
    sys.modules[made.__name__] = made
    exec(compile(source, made.__name__, "exec"), made.__dict__)
    return made.__name__


ROUNDS, FEWER = 12, ((0,), (3,), (4, 1, 3))
"""Of an epoch of a toy, and groups of seeds: fewer than a plugin is checked with, and each break shows in them."""


def own_rules(spec: Spec, settings: Mapping[str, Any] | None = None, **more: Any) -> list[Finding]:
    """Go through the rules of a kind, without those that all kinds share (they start an interpreter each time)."""
    rules = importlib.import_module(f"qrlsuite.testing.{spec.kind}")
    with pytest.MonkeyPatch.context() as patch:
        for module in (rules, group, reproducible):
            for name, value in (("ROUNDS", ROUNDS), ("SIZES", FEWER)):
                if hasattr(module, name):
                    patch.setattr(module, name, value)
        findings: list[Finding] = rules.check(Subject(spec, None, (), dict(settings or {})), **more)
    return findings


def assert_breaks(spec: Spec, rule: str, message: str, also: frozenset[str] = frozenset()) -> None:
    """Assert that a plugin breaks exactly this rule, and what is said about it."""
    broken = {finding.rule: finding.message for finding in own_rules(spec) if not finding.ok}
    assert rule in broken, f"'{rule}' holds; broken are {broken}"
    assert re.search(message, broken[rule]), broken[rule]
    assert broken.keys() == {rule} | also, f"also broken: {broken.keys() - {rule}}"


def assert_all_good(spec: Spec, settings: Mapping[str, Any] | None = None) -> set[str]:
    """Assert that no rule is broken; return the rules."""
    findings = own_rules(spec, settings)
    assert all(finding.ok for finding in findings), findings
    return {finding.rule for finding in findings}
