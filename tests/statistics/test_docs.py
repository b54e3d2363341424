"""docs/statistics.md and docs/error-rates.md are held to the code."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import qrlsuite.statistics
from qrlsuite import registry, specs
from qrlsuite.statistics import (
    Decided,
    Outcome,
    PairDecision,
    SequentialDesign,
    Spending,
    Verdict,
    nominal_levels,
)

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "\n".join((DOCS / f"{name}.md").read_text() for name in ("statistics", "error-rates"))


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    [example] = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    fast = np.tile(np.linspace(0, 1, 20), (30, 1))
    slow = np.tile(np.linspace(0, 0.8, 20), (30, 1))
    # 30 equal runs each: `slow` never gets within .1 of the optimum, and is behind in the other cells
    exec(example, {"curves": fast, "curves_a": fast, "curves_b": slow})
    assert capsys.readouterr().out.startswith("outperforms: significantly fewer samples in ")


FUNCTIONS = {
    "sample_complexity", "SignificanceRule", "Evidence", "times_below", "mean_time", "times_board", "SequentialDesign",
    "decide", "runs_needed", "runs_to_detect", "across_tasks", "horizon_shares", "rliable_arrays",
}  # fmt: skip


def test_functions_rules_verdicts_and_outcomes_are_on_the_page() -> None:
    assert set(qrlsuite.statistics.__all__) >= FUNCTIONS
    for name in (*FUNCTIONS, *registry.load().names(specs.RuleSpec), *Verdict, *Outcome):
        assert name in PAGE


def test_decisions_on_the_page_are_those_of_the_code() -> None:
    design = SequentialDesign(("A", "B"))
    levels = nominal_levels(design.looks, 0.05, Spending.POCOCK)
    assert " ".join(f"{level:.4f}"[1:] for level in levels) in PAGE
    assert "Looks at 20, 40, 60, 80 and 100 runs" in PAGE
    assert design.looks == (20, 40, 60, 80, 100)
    for decided in Decided:
        pair = PairDecision("A", "B", decided, 100, interval=(0, 0.12))
        assert f"`{pair.verdict}`" in PAGE.replace("above x percent", "above 12 percent")


def test_public_names_exist_and_are_documented() -> None:
    for name in qrlsuite.statistics.__all__:
        assert getattr(qrlsuite.statistics, name).__doc__
