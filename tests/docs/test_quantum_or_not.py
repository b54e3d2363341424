"""docs/plans.md and docs/quantum-or-not.md say what the published plans say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from qrlsuite.leaderboard.shelf import published_studies
from tests.docs import load

DOCS = Path(__file__).parents[2] / "docs"
PLANS = (DOCS / "plans.md").read_text()
PROSE = " ".join((DOCS / "quantum-or-not.md").read_text().split())
NAMES = sorted(folder.name for folder in published_studies.PUBLISHED.iterdir())

tables = load("tables")


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_are_what_the_published_files_say(page: Path) -> None:
    text = page.read_text()
    assert tables.TABLE.search(text)
    assert tables.filled(text) == text, "run `make pictures`"


def test_a_table_that_was_empty_stands_apart_from_what_follows() -> None:
    text = tables.filled("<!-- table: quantum-or-not settings -->\n\n## Next\n")
    assert re.search(r"<!-- .* -->\n\n\| entry \|.*\n(\|.*\n)+\n## Next\n$", text)
    assert tables.filled(text) == text


def test_a_stale_table_is_replaced() -> None:
    stale = PLANS.replace("| 313 |", "| 312 |", 1)
    assert stale != PLANS
    assert tables.filled(stale) == PLANS


@pytest.mark.parametrize("name", NAMES)
def test_every_plan_is_on_the_page(name: str) -> None:
    file = tables.published(name).study.file
    prose = " ".join(PLANS.split())
    assert f"<!-- table: {name} verdicts -->" in PLANS
    assert f"`{file.hash}`" in prose
    assert f"{len(tables.published(name).pairs)} pairs" in prose
    assert f"seeds {file.first_seed} to {file.first_seed + file.looks[-1] - 1}" in prose
    *looks, last = file.looks
    assert f"Looks after {', '.join(map(str, looks))} and {last} seeds" in prose


def test_the_state() -> None:
    outcome = tables.published("quantum-or-not")
    verdicts = [pair.verdict for pair in outcome.pairs]
    equal, apart = (sum(each.startswith(word) for each in verdicts) for word in ("equal", "not told apart"))
    differ = sum(each.endswith("needs fewer") for each in verdicts)
    assert differ + equal + apart == len(verdicts)
    assert (
        f"{differ} of {len(verdicts)} pairs differ, {equal} are equal within 10 percent, {apart} are not"
        in PROSE
    )
    seeds = sum(outcome.looked.values())
    hours = sum(each["core_hours"] for each in outcome.as_dict()["entries"])
    assert f"The plan took {seeds} seeds and {hours:.1f} core-hours" in PROSE


@pytest.mark.parametrize(
    ("plan", "sentence"),
    [
        ("quantum-or-not", "{} core-hours for all"),
        ("quantum-or-not-cartpole", "whole runs of 500 epochs, in {} core-hours"),
    ],
)
def test_the_hours_of_tuning(plan: str, sentence: str) -> None:
    tunings = [entry.tuning for entry in tables.published(plan).study.file.entries]
    hours = sum(each.core_hours or 0 for each in tunings if each is not None and each.value is not None)
    assert sentence.format(f"{hours:.1f}") in PROSE
