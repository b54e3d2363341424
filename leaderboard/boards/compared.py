"""Two entries compared: the verdict by steps, and on request the cells of the sample-complexity surface."""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import QrlSuiteError
from qrlsuite.leaderboard.boards import tables
from qrlsuite.leaderboard.boards.pair import OnBoard, PairVerdict, judge_pair
from qrlsuite.leaderboard.boards.ranked import WITH_LOOKS, learning_curves, ranking_of, rule_of
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.rules import DEFAULT
from qrlsuite.leaderboard.shelf.curves import EntryResults, edited_between
from qrlsuite.statistics import Comparison, SignificanceRule, compare


@dataclass(frozen=True, eq=False, repr=False)
class EntryComparison(Shown):
    """The result of `compare_entries`. It shows itself as a verdict, a table of thresholds, and notes.

    Attributes
    ----------
    names:
        Names of the two entries; `pair.labels` are for readers.
    pair:
        The verdict by steps below threshold, and the final scores.
    remarks:
        Notes on the entries, as below a board: those that may turn the verdict first.
    cells:
        The verdict of every cell of the task's grid by the rule that was asked for; None without one.
    among:
        The pair's verdict on its task's board; None if it was not looked up, or the board has no other entry.
    """

    names: tuple[str, str]
    pair: PairVerdict
    remarks: tuple[str, ...] = ()
    cells: Comparison | None = None
    among: OnBoard | None = None

    @property
    def sentence(self) -> str:
        """Which entry needs fewer steps, by how much and how surely, and both final scores."""
        return self.pair.sentence

    @property
    def p(self) -> float:
        """The p value of the verdict; NaN where there are too few seeds for one."""
        return self.pair.times.p

    @property
    def difference(self) -> float:
        """How many more steps the first entry needs than the second, as a share of the second's: -0.2 is 20% fewer."""
        return float(self.pair.times.difference[0])

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 percent interval of the difference."""
        _, low, high = self.pair.times.difference
        return float(low), float(high)

    @property
    def cells_line(self) -> str:
        """The verdict of the rule for cells of the sample-complexity surface; empty without one."""
        if self.cells is None:
            return ""
        rule = "the paper's rule" if self.cells.rule == DEFAULT else f"rule '{self.cells.rule}'"
        return f"by {rule}, cell by cell, {self.cells.n_runs} seeds each: {self.cells.sentence}"

    @property
    def further(self) -> list[str]:
        """The lines below the table of thresholds."""
        board = self.among.text if self.among is not None else ""
        return [line for line in (board, *self.remarks, self.cells_line) if line]

    def sheets(self) -> list[Sheet]:
        """Return the table of thresholds for a file, with the verdict as its caption."""
        heads = self.pair.columns()
        notes = (self.sentence, *self.pair.notes, *self.further)
        return [Sheet.of("", heads, self.pair.rows(), notes, words=(heads[0], heads[-1]), label="verdict")]

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison as plain values, for JSON."""
        return {
            "names": list(self.names),
            "horizon": self.pair.times.horizon,
            "verdict": self.sentence,
            "times": self.pair.as_dict(),
            "board": None if self.among is None else asdict(self.among),
            "notes": list(self.remarks),
            **({} if self.cells is None else {"cells": self.cells.as_dict()}),
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.sentence)
        yield pair_table(self.pair)
        yield Text("\n".join(self.further))
        if self.cells is not None:
            yield comparison_table(self.cells)
            yield Text(legend(self.cells))


def compare_entries(
    first: EntryResults, second: EntryResults, rule: SignificanceRule | None = None, by: str = "steps"
) -> EntryComparison:
    """Compare two entries of one task: by steps below threshold, and by final score.

    Parameters
    ----------
    rule:
        Judges each cell of the task's grid, too; None means the rule that the task names, if it names one.
    by:
        See `judge_pair`.
    """
    if first.task_hash != second.task_hash:
        raise QrlSuiteError(
            f"'{first.label}' was run on {first.task} and '{second.label}' on {second.task} "
            f"(definitions {first.task_hash} and {second.task_hash}): only entries of one task can be compared"
        )
    if edited := edited_between(first, second):
        raise QrlSuiteError(edited)
    for entry in (first, second):
        if entry.study:
            raise QrlSuiteError(f"'{entry.label}' was {WITH_LOOKS}")
    if (first.folder, first.name, first.seeds) == (second.folder, second.name, second.seeds):
        raise QrlSuiteError(f"'{first.label}' is compared with itself: name another entry")
    epochs = min(first.curves.shape[1], second.curves.shape[1])
    first, second = first.reaching(epochs) or first, second.reaching(epochs) or second
    both = [first, second]
    ranking = ranking_of(both)
    pair, cells = judge_pair(first, second, ranking.grid, ALPHA, by), None
    if rule or ranking.rule:
        cells = compare(learning_curves(first), learning_curves(second), ranking.grid, rule or rule_of(both))
    return EntryComparison((first.name, second.name), pair, tuple(tables.about(both)), cells)


SYMBOLS = {
    "win": ("+", "bold bright_blue", "significantly fewer samples"),
    "loss": ("-", "bold dark_orange", "significantly more samples"),
    "tie": (".", "dim", "no significant difference"),
    "both-at-cap": ("^", "dim", "both at the cap"),
    "undecided": ("?", "yellow", "undecided"),
}
"""Sign, color and meaning of each outcome of a cell; the sign alone is enough."""


LONGEST_WORD = 10
"""Letters that a column's head may have side by side; entries with longer words in their labels are A and B.

So the table fits a terminal of 80 columns.
"""


def pair_table(pair: PairVerdict) -> Table:
    """Return two entries threshold by threshold as a table."""
    heading, *labels, size, p, verdict = pair.columns()
    heads = ["\n".join(textwrap.wrap(label, 9, break_long_words=False)) for label in labels]
    notes = pair.notes
    if max(len(word) for label in labels for word in label.split()) > LONGEST_WORD:
        heads, verdict = ["A", "B"], "A needs"
        notes = [f"A: {labels[0]}; B: {labels[1]}", *notes]
    result = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        show_edge=False,
        caption="\n".join(notes),
        caption_justify="left",
    )
    for name in (heading, *heads, size, p):
        result.add_column(Text(name), justify="right", no_wrap=True)
    result.add_column(Text(verdict))
    for row in pair.rows():
        result.add_row(*map(Text, row))
    return result


def _levels(comparison: Comparison) -> tuple[str, list[str], list[str]]:
    """Return the title of a comparison's grid, its levels (rows), and its deltas (columns)."""
    grid = comparison.grid
    rows = [f"{float(level):g}" for level in grid.levels]
    return f"{grid.level_name} down, delta across", rows, [f"{float(delta):g}" for delta in grid.deltas]


def comparison_table(comparison: Comparison) -> Table:
    """Return a comparison as a table: a sign per cell of the grid."""
    heading, rows, deltas = _levels(comparison)
    result = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=Text(heading), title_justify="left")
    result.add_column("", justify="right")
    for delta in deltas:
        result.add_column(Text(delta), justify="center")
    for name, verdicts in zip(rows, comparison.verdicts):
        result.add_row(Text(name), *(Text(*SYMBOLS[str(verdict)][:2]) for verdict in verdicts))
    return result


def legend(comparison: Comparison) -> str:
    """Explain the signs that occur in a comparison's table."""
    occurring = {str(verdict) for row in comparison.verdicts for verdict in row}
    return ", ".join(f"{sign} {meaning}" for name, (sign, _, meaning) in SYMBOLS.items() if name in occurring)
