"""The tables of published decision plans in README and docs: `make pictures` writes them anew.

A comment names the plan and the kind of the table that follows it:

    <!-- table: quantum-or-not verdicts -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

from qrlsuite.leaderboard import plans
from qrlsuite.results.text import hours_text, steps_text
from qrlsuite.studies.decided import DecisionOutcome, by_question, difference_text, versus
from qrlsuite.training.trainer import count_parameters

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "docs" / "quantum-or-not.md",)
TABLE = re.compile(r"(?<=<!-- table: )([\w-]+) (\w+) -->\n\n(?:\|.*\n)*")

Rows = Iterator[Sequence[str]]


def settings(outcome: DecisionOutcome) -> Rows:
    """What tuning found for each entry, and M of these settings on the tuning's last seeds."""
    yield "entry", "parameters", "settings", "trials", "M"
    for planned in outcome.study.file.entries:
        if planned.tuning is None:
            continue
        entry, tuning = outcome.study.entries[str(planned.name)], planned.tuning
        found = []
        for option in tuning.space or ():
            side, _, name = option.partition(".")
            options = entry.model_options if side == "model" else entry.algorithm_options
            found.append(f"{name} {getattr(options, name):g}")
        name = str(planned.name).removesuffix(", tuned")
        parameters = str(sum(count_parameters(entry)))
        yield name, parameters, ", ".join(found), str(tuning.trials), steps_text(tuning.value or 0.0)


def verdicts(outcome: DecisionOutcome) -> Rows:
    """Every pair below its question."""
    yield "pair A / B", "verdict", "seeds", "B against A", "interval"
    for question, pairs in by_question(outcome.study, outcome.pairs):
        yield f"**{question}**", "", "", "", ""
        for pair in pairs:
            seeds = str(pair.n_runs) if pair.n_runs else ""
            yield versus(pair), pair.verdict, seeds, *difference_text(pair)


def entries(outcome: DecisionOutcome) -> Rows:
    """Mean times and costs of the entries that a look has reached."""
    yield "entry", "seeds", "M (95%)", "core-hours"
    for entry in outcome.as_dict()["entries"]:
        if entry["mean_time"] is not None:
            low, high = map(steps_text, entry["mean_time_interval"])
            took = f"{steps_text(entry['mean_time'])} ({low} to {high})"
            yield entry["name"], str(entry["seeds"]), took, hours_text(entry["core_hours"])


KINDS: dict[str, Callable[[DecisionOutcome], Rows]] = {
    "settings": settings,
    "verdicts": verdicts,
    "entries": entries,
}


@cache
def published(name: str) -> DecisionOutcome:
    """Return what a published plan has decided."""
    return plans.read(plans.PUBLISHED / name)


def filled(text: str) -> str:
    """Return a page with every table as the published plans now give it."""

    def table(found: re.Match[str]) -> str:
        plan, kind = found.groups()
        header, *rows = KINDS[kind](published(plan))
        lines = [header, ["---"] * len(header), *rows]
        body = "\n".join(
            "|" + "|".join(f" {cell} " if cell else " " for cell in line) + "|" for line in lines
        )
        return f"{plan} {kind} -->\n\n{body.replace(' --- ', '---')}\n"

    return TABLE.sub(table, text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
