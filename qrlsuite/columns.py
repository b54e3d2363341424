"""A column of a table as data: terminal, Markdown, LaTeX, the page, csv, JSON and Arrow are made of the same list.

A short one is `Column("seeds", lambda entry: len(entry.seeds), str, "complete runs")`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

Row = TypeVar("Row", contravariant=True)


@dataclass(frozen=True)
class Column(Generic[Row]):
    """A column of a table.

    Attributes
    ----------
    name:
        Its key in JSON, csv and Arrow; empty where only tables show it.
    value:
        The plain value of a row; None where it has none. An interval is a list of two numbers.
    text:
        Writes a value into a cell; None where only files have the column.
    meaning:
        Its meaning in a sentence; empty where the name explains it.
    head:
        Its name in tables; by default `name`.
    cell:
        Writes a row into a cell, where that shows more than the value: an interval, or a mark.
    flat:
        Its heads in a spreadsheet, one for each part of the value; by default an interval's names end in `_low` and
        `_high`. Empty where spreadsheets leave it out.
    words:
        Whether cells are words, which stand at the left and may be broken into lines; numbers stand at the right.
    bar:
        A row's bar: low, point and high of an interval, from 0 on; None where there is none. The terminal draws it
        from the low to the high end, the page with the point.
    beside, hover:
        Texts of the page, which has room: behind a row's cell, and where a pointer rests on it.
    most:
        Whether the page sorts the largest first.
    unit:
        Unit of its numbers, for Arrow; empty for scores, and counts whose name is the unit.
    type:
        Type of its values in Arrow: text, whole or real numbers, truth values; None takes the type that occurs.
    """

    name: str
    value: Callable[[Row], Any]
    text: Callable[[Any], str] | None = None
    meaning: str = ""
    head: str = ""
    cell: Callable[[Row], str] | None = None
    flat: tuple[str, ...] | None = None
    words: bool = False
    bar: Callable[[Row], tuple[float, float, float] | None] | None = None
    beside: Callable[[Row], str] | None = None
    hover: Callable[[Row], str] | None = None
    most: bool = False
    unit: str = ""
    type: type[Any] | None = None

    @property
    def title(self) -> str:
        """Its name in tables."""
        return self.head or self.name.replace("_", " ")

    @property
    def shown(self) -> bool:
        """Whether tables show it."""
        return self.cell is not None or self.text is not None

    def written(self, row: Row) -> str:
        """Return the text of a row's cell; `-` where it has no value."""
        if self.cell is not None:
            return self.cell(row)
        value = self.value(row)
        return "-" if value is None or self.text is None else self.text(value)

    def of(self, read: Callable[[Any], Row]) -> Column[Any]:
        """Return the column for other rows, from which its own are read."""

        def through(write: Callable[[Row], Any]) -> Callable[[Any], Any]:
            return lambda row: write(read(row))

        names = ("value", "cell", "bar", "beside", "hover")
        read_first: Any = {name: through(own) for name in names if (own := getattr(self, name))}
        return replace(self, **read_first)

    @property
    def heads(self) -> tuple[str, ...]:
        """Its heads in a spreadsheet."""
        if self.flat is not None:
            return self.flat
        stem = self.name.removesuffix("_interval")
        return (f"{stem}_low", f"{stem}_high") if self.name.endswith("interval") else (self.name,)


def record(columns: Iterable[Column[Row]], row: Row) -> dict[str, Any]:
    """Return a row's plain values by name, for JSON."""
    return {column.name: column.value(row) for column in columns if column.name}


def flat(columns: Iterable[Column[Row]], row: Row) -> dict[str, Any]:
    """Return a row's plain values for a spreadsheet: an interval is two of them.

    >>> flat([Column("a", len), Column("mean_interval", lambda row: [row[0], row[-1]])], [1, 2, 3])
    {'a': 3, 'mean_low': 1, 'mean_high': 3}
    """
    values: dict[str, Any] = {}
    for column in columns:
        if not column.name or not column.heads:
            continue
        value = column.value(row)
        if column.flat and isinstance(value, Mapping):
            values |= dict(zip(column.heads, value.values()))
        elif len(column.heads) == 1:
            values[column.heads[0]] = value
        else:
            values |= dict(zip(column.heads, value or [None] * len(column.heads)))
    return values
