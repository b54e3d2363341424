"""A line of a board as the page shows it, and the cells of its columns."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from qrlsuite.columns import Column
from qrlsuite.leaderboard.boards.steps import Row
from qrlsuite.leaderboard.boards.times import TimeRow
from qrlsuite.leaderboard.report.encode import clean
from qrlsuite.leaderboard.report.entries import EntryView
from qrlsuite.results.text import mean_text


@dataclass(frozen=True)
class RowView:
    """A line of the leaderboard; `name` is the label, without the algorithm if all entries of the board share it."""

    place: int
    entry: EntryView
    name: str
    row: Row

    @property
    def time(self) -> TimeRow:
        """Its rank."""
        return self.row.time

    @property
    def mean(self) -> str:
        """Its mean steps below threshold."""
        return mean_text(self.time.mean.mean)

    @property
    def kind(self) -> str:
        """`quantum`, `classical`, or `external`: another program trained it, and its kind is unknown."""
        if self.entry.curves.external:
            return "external"
        return "quantum" if self.entry.quantum else "classical"


def sentence(line: str, longest: int = 1000) -> str:
    """Return a note or a head with a capital letter, unless it begins with an option, and without marks of code."""
    text = clean(line, longest).replace("`", "")
    return text if "=" in text.split(" ")[0] else text[:1].upper() + text[1:]


def cell(column: Column[Any], row: Any) -> tuple[str, str]:
    """Return a cell in two parts, the second in gray: the interval of a number."""
    text, beside = clean(column.written(row), 600), column.beside(row) if column.beside else ""
    if not column.words and text.endswith(")"):
        text, _, rest = text.partition(" (")
        beside = f"({rest}"
    return _typeset(text), _typeset(clean(beside))


def sorted_by(column: Column[Any], row: Any) -> str | float:
    """Return what the page sorts a column by; empty where a row has no value."""
    value = column.value(row)
    value = value[0] if isinstance(value, list) else value
    return "" if value is None else clean(value) if isinstance(value, str) else value


def _typeset(text: str) -> str:
    """Write dashes, minus and `≥` as print does."""
    if text == "-":
        return "–"
    text = re.sub(r"^(\d+)-(\d+)$", r"\1–\2", text.replace(">= ", "≥ "))
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)
