"""Everything that the suite registers itself passes the checks that plugin authors run, and every rule of its kind."""

from __future__ import annotations

import importlib.util

import pytest

from qrlsuite import registry
from qrlsuite.specs import KINDS, NO_MODEL
from qrlsuite.testing import check
from qrlsuite.testing.selection import CheckTarget, of_distribution

EVERYTHING = of_distribution("qrlsuite")
NEEDS = {
    ("engines", "dask"): "distributed",
    **{("tasks", name): "Box2D" for name in ("lunarlander", "lunarlander-continuous")},
}

COMMON = ["name", "references", "lazy imports", "spawn"]
OPTIONS = ["options documented", "options"]
RULES = {
    "ansatzes": [
        "builds", "pure", "inputs used", "parameters used", "layers", "effects", "backends",
    ],
    "circuit_backends": ["builds", "shapes", "values", "gradients", "repeatable", "seed independence"],
    "models": [
        "builds", "shapes", "parameters registered", "nothing unregistered", "quantum parameters", "same seed",
        "different seed", "global randomness", "pure", "rows apart", "no cache", "gradients",
        "finite differences", "copies", "population", "seed independence", "options per agent", "state",
    ],
    "environments": [
        "gymnasium", "spaces", "shapes", "episodes end", "score", "same seed", "different seed",
        "seed independence", "state", "validation",
    ],
    "algorithms": [
        "builds", "trains", "interactions", "acts", "learns", "same seed", "different seed",
        "state is seed-first", "seed independence", "options per agent", "state",
    ],
    "trackers": ["events", "target"],
    "tasks": ["file", "format", "says what is registered", "identity", "algorithms", "settings", "ranking", "scores"],
}  # fmt: skip
"""Rules of each kind that has some, after those that all have in common."""

BACKENDS = ("native", "pennylane", "qiskit")
WHERE_OFFERED = {
    ("circuit_backends", "native"): ["mean field", "shots"],
    ("circuit_backends", "pennylane"): ["shots"],
    ("circuit_backends", "qiskit"): ["shots"],
    **{("algorithms", name): ["masks"] for name in ("ddqn", "reinforce")},
    ("models", "cnn"): ["an image, channels first"],
    ("algorithms", "drqn"): ["memory of episodes", "masks"],
    ("algorithms", "ppo"): [
        "masks",
        "box actions",
        "multi-discrete actions",
        "multi-binary actions",
        "memory of episodes",
    ],
    ("algorithms", "sac"): ["masks", "discrete actions"],
}
"""Rules about what a thing need not have."""

CHOICES = {
    ("ansatzes", "cx"): ["gate=xyz", "gate=u3", "entangled=separable", "entangled=mean-field"],
    ("circuit_backends", "native"): ["gradient=parameter-shift", "gradient=spsa", "noise_model=depolarizing"],
    ("models", "mlp"): ["activation=tanh", "activation=sin", "activation=none", "init=he", "init=siren"],
    ("algorithms", "ppo"): ["validation=sampled"],
}
"""Values of options that are tried, of some."""


@pytest.mark.parametrize("item", EVERYTHING, ids=lambda item: f"{item.kind.kinds}-{item.name}")
def test_it_conforms(item: CheckTarget) -> None:
    """A rule that is silently skipped would never be broken: so every one is named."""
    package = NEEDS.get((item.kind.kinds, item.name))
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    findings = check(item.kind.kind, item.name)
    broken = [f"{finding.rule}: {finding.message}" for finding in findings if not finding.ok]
    assert not broken
    spec = registry.load().get(item.kind, item.name).spec
    options = OPTIONS if getattr(spec, "options", None) else []
    offered = WHERE_OFFERED.get((item.kind.kinds, item.name), [])
    nothing_to_build = (item.kind.kinds, item.name) == ("models", NO_MODEL)
    expected = [*COMMON, *options, *([] if nothing_to_build else RULES.get(item.kind.kinds, [])), *offered]
    rules = [finding.rule for finding in findings]
    assert sorted(rule for rule in rules if "=" not in rule) == sorted(expected)
    if (item.kind.kinds, item.name) in CHOICES:
        assert [rule for rule in rules if "=" in rule] == CHOICES[item.kind.kinds, item.name]


def test_no_kind_is_left_out() -> None:
    assert RULES.keys() < KINDS.keys() == {item.kind.kinds for item in EVERYTHING}
