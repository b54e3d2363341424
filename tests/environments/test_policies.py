"""What task files say that policies score: played again, or computed from the environment's table of transitions."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from qrlsuite import registry, specs
from qrlsuite.experiment import task
from qrlsuite.experiment.entry import resolve
from qrlsuite.training import evaluation

STATED = [name for name in registry.load().names(specs.TaskSpec) if task.load(name).file.ranking.policies]
BY_TABLE = ("frozenlake", "frozenlake-8x8", "taxi")
"""Their best policy is that of dynamic programming."""


@pytest.mark.parametrize("name", STATED)
def test_stated_scores_are_what_the_policies_get(name: str) -> None:
    if name.startswith("lunarlander"):
        pytest.importorskip("Box2D")
    stated = dict(task.load(name).file.ranking.policies)
    if "best known" in stated:  # by others: the comment that gives its source has the number
        comment = " ".join(
            Path(registry.get(specs.TaskSpec, name).path).read_text().replace("\n#", "").split()
        )
        assert re.search(rf"RL Baselines3 Zoo .* {stated.pop('best known'):g} \(", comment)
    if name in BY_TABLE:
        stated.pop("optimal")
    ours = task.load(name).file.score.of_optimum
    count = 400 if ours else 100
    if name == "pulse-pair":  # gradient ascent from a hundred pulses takes its time
        count = 10
    played = {each.name: each for each in evaluation.references(resolve(name, "mlp"), count)}
    assert "random" in stated
    for policy, score in stated.items():
        each = played[policy]
        values = (each.returns if each.scores is None else each.scores)[0]
        rare = 1 / count * (values.max() <= 1)  # a success that may not have occurred
        noise = 4 * values.std() / math.sqrt(count) + rare
        assert values.mean() == pytest.approx(score, abs=noise + 0.006 * max(1, abs(score))), policy


@pytest.mark.parametrize("name", BY_TABLE)
def test_optimal_scores_are_those_of_dynamic_programming(name: str) -> None:
    file = task.load(name).file
    options = file.environment.options
    made = gymnasium.make(options["id"], **options.get("arguments", {}))
    assert made.spec is not None
    assert made.spec.max_episode_steps is not None
    inner = made.unwrapped
    table = inner.P  # type: ignore[attr-defined]
    best = np.zeros(len(table))
    uniform = np.zeros(len(table))

    def values(after: Any, over: Any) -> Any:
        """Over the actions, the best or the mean of what each brings and of what is reached after it."""
        return np.array(
            [
                over([sum(p * (r + after[to] * (not end)) for p, to, r, end in way) for way in ways.values()])
                for ways in table.values()
            ]
        )

    for _ in range(made.spec.max_episode_steps):
        best, uniform = values(best, max), values(uniform, np.mean)
    start = inner.initial_state_distrib  # type: ignore[attr-defined]
    stated = file.ranking.policies
    assert float(start @ best) == pytest.approx(stated["optimal"], abs=0.005)
    assert float(start @ uniform) == pytest.approx(
        stated["random"], abs=0.0006 * max(1, abs(stated["random"]))
    )


def test_the_table_of_quantum_tasks_has_these_scores() -> None:
    text = (Path(__file__).parents[2] / "docs" / "faq.md").read_text()
    rows = re.findall(r"^\| `([\w-]+)` \| (?:\\\||[^|])+\|([^|]*)\|([^|]*)\|([^|]*)\|$", text, re.M)
    assert len(rows) == 7
    for name, *cells in rows:
        told = [float(re.findall(r"\d[\d.]*\d|\d", cell)[0]) for cell in cells]
        assert sorted(told) == sorted(task.load(name).file.ranking.policies.values()), name
