"""The tables of docs/quantum-or-not.md are what the published plan says."""

from __future__ import annotations

from pathlib import Path

import pytest

from qrlsuite.leaderboard import plans
from qrlsuite.results.text import hours_text, steps_text
from qrlsuite.studies.decided import DecisionOutcome, by_question, difference_text, versus
from qrlsuite.training.trainer import count_parameters

PAGE = (Path(__file__).parents[2] / "docs" / "quantum-or-not.md").read_text()
PROSE = " ".join(PAGE.split())


@pytest.fixture(scope="module")
def outcome() -> DecisionOutcome:
    return plans.read(plans.PUBLISHED / "quantum-or-not")


def table(*columns: str, after: str) -> list[list[str]]:
    """Return the rows of the first table below a heading, without its header, which must be as given."""
    lines = PAGE.partition(f"\n## {after}\n")[2].partition("\n## ")[0].splitlines()
    header, _, *body = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")
    )
    assert tuple(header) == columns
    return body


def test_the_plan_is_named(outcome: DecisionOutcome) -> None:
    file = outcome.study.file
    assert f"`{file.hash}`" in PROSE
    assert f"{len(outcome.pairs)} pairs" in PROSE
    assert f"seeds {file.first_seed} to {file.first_seed + file.looks[-1] - 1}" in PROSE


def test_the_settings_that_tuning_found(outcome: DecisionOutcome) -> None:
    expected, hours = [], 0.0
    for planned in outcome.study.file.entries:
        assert planned.name is not None
        if planned.tuning is None:
            continue
        tuning = planned.tuning
        assert tuning.space is not None
        assert tuning.value is not None
        hours += tuning.core_hours or 0
        entry = outcome.study.entries[planned.name]
        settings = {
            name: getattr(entry.model_options if side == "model" else entry.algorithm_options, name)
            for side, _, name in (option.partition(".") for option in tuning.space)
        }
        parameters = sum(count_parameters(entry))
        expected.append(
            [
                planned.name.removesuffix(", tuned"),
                str(parameters),
                ", ".join(f"{name} {value:g}" for name, value in settings.items()),
                str(tuning.trials),
                steps_text(tuning.value),
            ]
        )
    assert table("entry", "parameters", "settings", "trials", "M", after="Settings") == expected
    assert f"{hours:.1f} core-hours" in PROSE


def test_the_verdicts(outcome: DecisionOutcome) -> None:
    expected = []
    for question, pairs in by_question(outcome.study, outcome.pairs):
        expected.append([f"**{question}**", "", "", "", ""])
        for pair in pairs:
            seeds = str(pair.n_runs) if pair.n_runs else ""
            expected.append([versus(pair), pair.verdict, seeds, *difference_text(pair)])
    columns = ("pair A / B", "verdict", "seeds", "B against A", "interval")
    assert table(*columns, after="Verdicts") == expected


def test_what_each_entry_took(outcome: DecisionOutcome) -> None:
    facts = [entry for entry in outcome.as_dict()["entries"] if entry["mean_time"] is not None]
    expected = []
    for entry in facts:
        low, high = map(steps_text, entry["mean_time_interval"])
        hours = hours_text(entry["core_hours"])
        expected.append(
            [
                entry["name"],
                str(entry["seeds"]),
                f"{steps_text(entry['mean_time'])} ({low} to {high})",
                hours,
            ]
        )
    if expected:
        assert table("entry", "seeds", "M (95%)", "core-hours", after="Entries") == expected
    else:
        assert "\n## Entries\n" not in PAGE
