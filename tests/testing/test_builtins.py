"""Everything that is registered passes the checks that plugin authors run."""

from __future__ import annotations

import importlib.util

import pytest

from qrlsuite import registry
from qrlsuite.testing import assert_conforms, check

EVERYTHING = [(kind, found.spec.name) for kind, found in registry.load()]
NEEDS = {("tasks", "lunarlander"): "Box2D"}


@pytest.mark.parametrize(("kind", "name"), EVERYTHING)
def test_it_conforms(kind: str, name: str) -> None:
    package = NEEDS.get((kind, name))
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    assert_conforms(kind, name)


RULES = {
    "ansatzes": ["builds", "pure", "inputs used", "parameters used", "layers", "gradients", "backends"],
    "circuit_backends": ["shapes", "values", "gradients", "repeatable", "seed independence"],
    "models": [
        "shapes", "parameters registered", "quantum parameters", "same seed", "different seed",
        "global randomness", "pure", "gradients", "finite differences", "copies", "population",
        "seed independence", "state",
    ],
    "environments": [
        "gymnasium", "spaces", "shapes", "episodes end", "score", "same seed", "different seed",
        "seed independence", "state", "validation",
    ],
    "algorithms": [
        "builds", "trains", "interactions", "acts", "learns", "same seed", "different seed",
        "state is seed-first", "seed independence", "state",
    ],
    "tasks": ["file", "format", "says what is registered", "identity", "algorithms", "ranking", "scores"],
}  # fmt: skip


@pytest.mark.parametrize("kind", RULES)
def test_no_rule_is_left_out(kind: str) -> None:
    """A rule that is silently skipped would pass every test above."""
    name = {"tasks": "beam6g", "models": "mlp", "circuit_backends": "native"}.get(
        kind, registry.load().names(kind)[0]
    )
    rules = [finding.rule for finding in check(kind, name)]
    common = ["name", "references", "lazy imports", "spawn"]
    if kind != "tasks":
        common += ["options documented", "options"]
    assert [rule for rule in rules if rule != "builds"] == common + [r for r in RULES[kind] if r != "builds"]
