"""Leaderboards: one row per entry, ranked by steps, costs or scores, on one task or over several.

`build` makes every board. Each kind of section has its own module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, nearest
from qrlsuite.leaderboard.boards import across, costs, scores, steps, tables
from qrlsuite.leaderboard.boards.ranked import of_one_definition
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.rules import DEFAULT
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.statistics import SignificanceRule
from qrlsuite.statistics.times import check_probability

AXES = ("steps", *costs.UNITS, *scores.OF_RUNS)
"""The axes of every board."""


def axes_of(entries: Sequence[EntryResults]) -> tuple[str, ...]:
    """Return the axes that rank these entries: `AXES`, and the costs that their tasks name."""
    named = {name for entry in entries for name in entry.task_file.ranking.costs}
    return (*AXES, *sorted(named - set(AXES)))


@dataclass(frozen=True, repr=False)
class Leaderboard(Shown):
    """All sections by one axis, and the refused entries with reasons. It shows itself as a table per task."""

    sections: tuple[Any, ...]
    refused: tuple[str, ...] = ()
    by: str = "steps"

    @property
    def rules(self) -> dict[str, str]:
        """Name and promise of every rule that judged cells of a section."""
        return {each.rule: each.promise for each in self.sections if isinstance(each, steps.Section)}

    @property
    def rule(self) -> str:
        """Their names, joined by commas; the paper's where there is no section."""
        return ", ".join(self.rules) or DEFAULT

    @property
    def promise(self) -> str:
        """The promises of all rules, joined by semicolons."""
        return "; ".join(self.rules.values())

    def as_dict(self) -> dict[str, Any]:
        """Return the board as plain values, for JSON."""
        rule = {"rule": self.rule} if self.by == "steps" else {}
        sections = [section.as_dict() for section in self.sections]
        return {"by": self.by, **rule, "sections": sections, "refused": list(self.refused)}

    def flat(self) -> list[dict[str, object]]:
        """Return one row of values per entry and section, for a spreadsheet."""
        return [row for section in self.sections for row in section.flat()]

    def sheets(self, explain: bool = False) -> list[Sheet]:
        """Return a table per task; `explain` adds the meanings of columns and marks, and the matrix of pairs."""
        if all(isinstance(section, steps.Section) for section in self.sections):
            return tables.sheets(self.sections, explain)
        return [section.sheet(explain) for section in self.sections]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from self.sheets() if self.sections else [Text("no entries")]
        for line in self.refused:
            yield Text(f"left out: {line}")


def build(
    entries: Sequence[EntryResults],
    refused: Sequence[str] = (),
    rule: SignificanceRule | None = None,
    horizon: int | None = None,
    alpha: float = ALPHA,
    shown: Callable[[EntryResults], bool] | None = None,
    by: str = "steps",
    together: Sequence[str] = (),
    definitions: Mapping[str, str] | None = None,
) -> Leaderboard:
    """Rank entries, task by task, or over several tasks.

    An entry is refused if its task had another definition than most entries have, or than `definitions` names. An
    entry of a study with looks is refused, too: its number of seeds depends on its results.

    Parameters
    ----------
    refused:
        Lines about unreadable entries; they are passed on.
    rule:
        The rule of tiers, see `qrlsuite.leaderboard.rules.load`. None means each task's own rule, or the paper's if the
        task names none. Tables show tiers if a rule other than `steps` is given or named.
    horizon:
        Environment steps at which all entries that reach it are ranked; None means the task's own horizons.
    alpha:
        Error probability of the whole board, see `qrlsuite.leaderboard.boards.times.rank_by_time`.
    shown:
        Selects the entries that have a row; None means all. All entries are compared: a hidden row changes no verdict.
        By cost every entry has a row, since the cheapest sets the budget of the others.
    by:
        One of `axes_of(entries)`: one of `AXES`, or a name in the task's `[ranking] costs`.
    together:
        Tasks over which the means of entries are compared, in one section.
    definitions:
        See `qrlsuite.leaderboard.boards.ranked.of_one_definition`.
    """
    check_probability(alpha, "alpha")
    axes = axes_of(entries)
    if by not in axes:
        raise OptionError(f"by = '{by}': choose among {', '.join(axes)}{nearest(by, axes)}")
    if together and (by in scores.OF_RUNS or by not in AXES):
        raise OptionError(f"--by {by}: scores of several tasks have no common scale; name one task")
    if together:
        section = across.section(entries, together, horizon, alpha, refused, by, definitions)
        return Leaderboard((section,), section.shares.refused, by)
    ranked, unranked = of_one_definition(entries, definitions)
    made, problems = list[Any](), [*refused, *unranked]
    for task in sorted({entry.task for entry in ranked}):
        members = [entry for entry in ranked if entry.task == task]
        found: Sequence[Any]
        if by == "steps":
            found, lines = steps.sections(task, members, rule, horizon, alpha, shown)
        elif by in costs.UNITS:
            found, lines = costs.sections(task, members, by, alpha)
        elif by in scores.OF_RUNS or by in members[0].task_file.ranking.costs:
            found, lines = scores.sections(task, members, horizon, by, alpha, shown)
        else:
            found, lines = [], [f"task '{task}': its [ranking] costs do not name '{by}'"]
        made += found
        problems += lines
    return Leaderboard(tuple(made), tuple(problems), by)
