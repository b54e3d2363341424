"""Significance rules: the built-in ones enter by the third party's door, and a third party's are fenced."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
import pytest

from qrlsuite import registry, specs
from qrlsuite.errors import PluginError, UnknownNameError
from qrlsuite.hookspecs import hookimpl
from qrlsuite.leaderboard import rules
from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.boards.compared import compare_entries
from qrlsuite.statistics import Evidence, Grid, IntervalRule, LearningCurves, compare, outperformance
from tests.leaderboard.test_pictures import learner

GRID = Grid.relative([0.2, 0.1], [0.5, 0.75])


class Half:
    """Whoever needs less than half is the winner: the example of the manual."""

    name = "half"
    promise = "none: whoever needs less than half is declared the winner"

    def __call__(self, first: Evidence, second: Evidence) -> Any:
        fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
        return fewer.astype("int8") - more.astype("int8")


class Raises(Half):
    def __call__(self, first: Evidence, second: Evidence) -> Any:
        raise ZeroDivisionError("by nothing")


class Flat(Half):
    def __call__(self, first: Evidence, second: Evidence) -> Any:
        return [1, 0]


class Doubtful(Half):
    def __call__(self, first: Evidence, second: Evidence) -> Any:
        return np.full(first.grid.shape, 0.5)


class FlatAgainst(Half):
    def against(self, first: Evidence, others: Any) -> Any:
        return np.zeros((1, 1))


class Promiseless(Half):
    promise = ""


@pytest.fixture
def third_party(monkeypatch: pytest.MonkeyPatch) -> Callable[[type], Any]:
    """Register a rule class as `acme`'s, and load it by name as the commands do."""

    def load(rule: type) -> Any:
        module = types.ModuleType("acme_rules")
        module.Rule = rule  # type: ignore[attr-defined]

        @hookimpl
        def register_rules(register: Callable[[specs.RuleSpec], None]) -> None:
            register(specs.RuleSpec("half", "Half as many", "acme_rules:Rule"))

        module.register_rules = register_rules  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "acme_rules", module)
        own = ("acme", metadata.EntryPoint("rules", "acme_rules", "qrlsuite"))
        found = registry.create(points=lambda: [*registry._entry_points(), own])
        monkeypatch.setattr(registry, "load", lambda: found)
        return rules.load("half")

    return load


def curves(first_good: int, name: str) -> LearningCurves:
    return LearningCurves(learner(first_good=first_good).curves, 2000, name)


def test_built_in_rules_are_registered_like_anyones() -> None:
    known = registry.load()
    assert set(known.names(specs.RuleSpec)) == {"intervals", "times", "steps"}
    for name in known.names(specs.RuleSpec):
        assert known.get(specs.RuleSpec, name).distribution == "qrlsuite"
        assert rules.load(name).name == name
    assert isinstance(rules.load(), IntervalRule), "the paper's rule is the default"
    with pytest.raises(UnknownNameError, match="did you mean 'intervals'"):
        rules.load("intervalls")


def test_a_third_partys_rule_judges_pairs_and_boards(third_party: Callable[[type], Any]) -> None:
    rule = third_party(Half)
    fast, medium, slow = curves(10, "fast"), curves(15, "medium"), curves(31, "slow")
    assert compare(fast, slow, GRID, rule).sentence.startswith("outperforms")
    assert compare(fast, medium, GRID, rule).sentence == "no significant difference: in none of 4 cells"
    tiers = outperformance([fast, medium, slow], GRID, rule).ranking.tiers
    assert [[entry.name for entry in tier] for tier in tiers] == [["fast", "medium"], ["slow"]]

    entries = [learner("ddqn fast", 10), learner("ddqn slow", 31)]
    made = board.build(entries, rule=rule)
    assert (made.rule, made.promise) == ("half", Half.promise)
    assert made.as_dict()["rule"] == "half"
    cells = compare_entries(*entries, rule).cells
    assert cells is not None
    assert cells.rule == "half"


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (Raises, "fails: ZeroDivisionError: by nothing"),
        (Flat, r"must answer -1, 0 or 1 in an array of shape \(2, 2\)"),
        (Doubtful, "must answer -1, 0 or 1"),
    ],
)
def test_what_goes_wrong_in_it_names_the_distribution(
    rule: type, message: str, third_party: Callable[[type], Any]
) -> None:
    loaded = third_party(rule)
    pattern = f"rule 'half' of distribution 'acme'.*{message}"
    with pytest.raises(PluginError, match=pattern):
        compare(curves(10, "a"), curves(20, "b"), GRID, loaded)
    with pytest.raises(PluginError, match="distribution 'acme'"):
        board.build([learner("ddqn a", 10), learner("ddqn b", 20)], rule=loaded)


def test_an_answer_for_many_is_checked_too(third_party: Callable[[type], Any]) -> None:
    loaded = third_party(FlatAgainst)
    with pytest.raises(PluginError, match=r"distribution 'acme'.*shape \(1, 2, 2\)"):
        outperformance([curves(10, "a"), curves(20, "b")], GRID, loaded)


@pytest.mark.parametrize(
    ("rule", "message"),
    [(Promiseless, "its promise must be a sentence"), (dict, "dict is no rule"), (lambda: 1 / 0, "division")],
)
def test_what_is_no_rule_is_refused_by_name(rule: Any, message: str, third_party: Any) -> None:
    with pytest.raises(PluginError, match=f"'half' of distribution 'acme'.*{message}"):
        third_party(rule)


def test_the_papers_rule_is_named_among_the_choices() -> None:
    with pytest.raises(UnknownNameError, match="unknown rule 'papr'; did you mean 'paper'"):
        rules.load("papr")
