"""What a rule must keep to: valid signs, from the evidence alone, antisymmetric in the two entries."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite import specs
from qrlsuite.statistics import Evidence, Grid, LearningCurves, Resampling, SignificanceRule
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import Checklist, Finding, require

RUNS, EPOCHS, STEPS = 30, 12, 100
GRID = Grid.relative([0.2, 0.4, 0.6], [0.5, 0.8])
ENTRIES = ("fast", "same", "slow", "never", "mixed")


def check(subject: Subject) -> list[Finding]:
    """Check a rule on entries of 30 runs, 12 epochs, and a grid of three thresholds and two probabilities."""
    spec = subject.spec
    assert isinstance(spec, specs.RuleSpec)
    rules = Checklist()
    rules_built: list[Any] = []
    cause = "the factory is called without arguments"
    if not rules.run(
        "builds", "a rule with a name and a promise", lambda: rules_built.append(_build(spec)), cause
    ):
        return rules.findings
    rule = rules_built[0]
    cause = "it is called with two qrlsuite.statistics.Evidence objects"
    if not rules.run("signs", "an integer of -1, 0 or 1 in every cell", lambda: _signs(rule), cause):
        return rules.findings
    rules.run("repeatable", "asked twice, the same answer", lambda: _repeatable(rule))
    rules.run("antisymmetric", "rule(a, b) == -rule(b, a)", lambda: _antisymmetric(rule))
    rules.run("equal entries", "nobody wins against itself", lambda: _equal(rule))
    rules.run("direction", "+1 is for the one that needs fewer samples", lambda: _direction(rule))
    if hasattr(rule, "against"):
        rules.run("against", "one against many is one against each", lambda: _against(rule))
    return rules.findings


def evidence(name: str) -> Evidence:
    """Return one of `ENTRIES`: curves (30, 12) that rise from 0 to 1 at an epoch of their own."""
    source = np.random.Generator(np.random.Philox(key=ENTRIES.index(name) if name != "same" else 0))
    begin = {"fast": 2, "same": 2, "slow": 8, "never": EPOCHS + 1, "mixed": 4}[name]
    spread = 6 if name == "mixed" else 2
    starts = begin + source.integers(spread, size=(RUNS, 1))
    values = np.clip((np.arange(EPOCHS) - starts + 1) / 2, 0.0, 1.0)
    return Evidence(LearningCurves(values, STEPS, name), GRID, RUNS, Resampling(n_resamples=200))


def _build(spec: specs.RuleSpec) -> Any:
    rule = specs.resolve(spec.factory)()
    missing = [name for name in ("name", "promise", "__call__") if not hasattr(rule, name)]
    require(
        isinstance(rule, SignificanceRule) and callable(rule),
        f"{type(rule).__name__} has no {' and no '.join(missing)}: see qrlsuite.statistics.SignificanceRule",
    )
    for name in ("name", "promise"):
        value = getattr(rule, name)
        require(
            isinstance(value, str) and bool(value.strip()),
            f"{name} is {value!r}, and must be text: a board prints it beside its ranks",
        )
    return rule


def _judge(rule: Any, first: str, second: str) -> NDArray[Any]:
    return np.asarray(rule(evidence(first), evidence(second)))


def _signs(rule: Any) -> None:
    for first in ENTRIES:
        for second in ENTRIES:
            signs = _judge(rule, first, second)
            require(
                signs.shape == GRID.shape,
                f"the answer has shape {signs.shape}, and must have (epsilons, deltas) = {GRID.shape}",
            )
            require(
                signs.dtype.kind == "i" and set(np.unique(signs)) <= {-1, 0, 1},
                f"the answer holds {np.unique(signs).tolist()} as {signs.dtype}, and must hold -1, 0 and 1 as int8",
            )


def _repeatable(rule: Any) -> None:
    for first, second in (("fast", "mixed"), ("mixed", "slow"), ("fast", "slow")):
        require(
            np.array_equal(_judge(rule, first, second), _judge(rule, first, second)),
            "the same two entries are judged differently the second time: draw from the evidence's resampling seed, "
            "and remember nothing",
        )


def _antisymmetric(rule: Any) -> None:
    for first in ENTRIES:
        for second in ENTRIES:
            require(
                np.array_equal(_judge(rule, first, second), -_judge(rule, second, first)),
                f"rule(a, b) is not -rule(b, a) for the entries '{first}' and '{second}': ranks would depend on the "
                "order in which entries are listed",
            )


def _equal(rule: Any) -> None:
    for first, second in (("fast", "fast"), ("never", "never"), ("fast", "same")):
        require(
            not _judge(rule, first, second).any(),
            "two entries with the same curves differ significantly: ties, and cells that neither reaches, are 0",
        )


def _direction(rule: Any) -> None:
    for second in ("slow", "never"):
        needs = "needs 900" if second == "slow" else "never gets there"
        require(
            not bool((_judge(rule, "fast", second) < 0).any()),
            f"-1 for an entry that needs about 300 samples against one that {needs}: +1 says that the first needs "
            "significantly fewer",
        )


def _against(rule: Any) -> None:
    others = [evidence(name) for name in ENTRIES]
    signs = np.asarray(rule.against(evidence("mixed"), others))
    expected = np.stack([_judge(rule, "mixed", name) for name in ENTRIES])
    require(
        signs.shape == expected.shape and np.array_equal(signs, expected),
        f"against(first, others) of shape {signs.shape} is not rule(first, other) for each of {len(ENTRIES)} others",
    )
