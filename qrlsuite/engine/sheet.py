"""A table of results, written five ways: for a terminal, as Markdown, LaTeX, HTML and csv."""

from __future__ import annotations

import csv
import io
import re
import textwrap
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from qrlsuite.engine.terminal import printable

WIDE = 165
"""Characters per line of a table that is written into a pipe or a file."""
FOLDED = 24
"""Characters to which a column of words may be folded, for others to have room."""
BAR = (4, 20)
"""Least and most characters of a bar."""
NOTES = 3
"""Footnotes below a table unless all are asked for."""
_PLAIN = str.maketrans("█▒†", "#=+")


@dataclass(frozen=True)
class Column:
    """A column of a sheet.

    Attributes
    ----------
    head:
        Its name.
    cells:
        A text per row.
    words:
        Whether these are words, which stand at the left and may be broken into lines; numbers stand at the right.
    bars:
        Per row the ends of a bar's solid and shaded part, in shares of the longest; None where there is no bar.
        Only a terminal shows them.
    meaning:
        Explanation of the column; empty if the head is enough.
    """

    head: str
    cells: tuple[str, ...]
    words: bool = False
    bars: tuple[tuple[float, float] | None, ...] = ()
    meaning: str = ""

    @property
    def width(self) -> int:
        """Characters that it needs: of its longest cell, or of the longest word of its head."""
        return max(map(len, (*self.cells, *self.head.replace("-", "- ").split())), default=0)

    @property
    def least(self) -> int:
        """Characters that it needs: with its bars, and with its words folded."""
        return min(self.width, FOLDED) if self.words else self.width + (BAR[0] + 1) * bool(self.bars)


@dataclass(frozen=True)
class Sheet:
    """A table with title and notes.

    Attributes
    ----------
    columns:
        In the order of their importance: where a line has no room for all, the last are left out.
    notes:
        In the order of their importance: the first three are written, unless `explained`.
    explained:
        Whether all notes, and the meanings of the columns that are written, stand below the table.
    lines:
        Lines that always stand below the table.
    label:
        By which LaTeX refers to it.
    name:
        What a page with several tables calls it.
    """

    title: str
    columns: tuple[Column, ...]
    notes: tuple[str, ...] = ()
    explained: bool = False
    lines: tuple[str, ...] = ()
    label: str = ""
    name: str = ""

    @classmethod
    def of(
        cls,
        title: str,
        heads: Sequence[str],
        rows: Sequence[Sequence[str]],
        notes: Sequence[str] = (),
        words: Sequence[str] = (),
        label: str = "",
        explained: bool = False,
        name: str = "",
    ) -> Sheet:
        """Return the sheet of some rows; `words` names the columns of words."""
        columns = (
            Column(head, tuple(row[place] for row in rows), head in words) for place, head in enumerate(heads)
        )
        return cls(title, tuple(columns), tuple(notes), explained, label=label, name=name)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """The cells, row by row."""
        return list(zip(*(column.cells for column in self.columns)))

    def remarks(self, columns: Sequence[Column] | None = None) -> list[str]:
        """Return the notes below a table: all columns' in a file, these columns' in a terminal."""
        shown = self.columns if columns is None else columns
        if self.explained:
            meanings = [f"{column.head}: {column.meaning}" for column in shown if column.meaning]
            left_out = [column.head for column in self.columns if column not in shown]
            room = [f"a wider terminal, or --format markdown, also shows {', '.join(left_out)}"] * bool(
                left_out
            )
            return [*meanings, *self.notes, *room, *self.lines]
        notes, more = list(self.notes[:NOTES]), self.notes[NOTES:]
        if more and columns is not None:
            notes[-1] += f" ({len(more)} more: --explain)"
        return [*notes, *self.lines]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self._table(options.max_width, options.encoding)

    def _table(self, width: int, encoding: str) -> Table:
        shown, spare = self._fitting(width)
        table = Table(
            title=Text(self.title),
            title_justify="left",
            header_style="bold",
            box=box.SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
            pad_edge=False,
            show_edge=False,
            caption=Text("\n".join(self.remarks(shown))),
            caption_justify="left",
        )
        for column in shown:
            room = max(column.width, column.least + spare if column.bars else 0)
            lines = (
                [column.head] if column.words else textwrap.wrap(column.head, room, break_long_words=False)
            )
            justify: Literal["left", "right"] = "left" if column.words or column.bars else "right"
            table.add_column(
                Text("\n".join(lines)), justify=justify, overflow="fold", no_wrap=not column.words
            )
        for place in range(len(shown[0].cells)):
            texts = (_with_bar(column, place, BAR[0] + spare) for column in shown)
            plain = "" if encoding.lower().startswith("utf") else _PLAIN
            table.add_row(*(Text(text.translate(plain) if plain else text) for text in texts))
        return table

    def _fitting(self, width: int) -> tuple[list[Column], int]:
        """Return the columns for which a line has room, and the characters left for longer bars."""
        shown = list(self.columns)

        def spare() -> int:
            return width - sum(column.least for column in shown) - 2 * (len(shown) - 1)

        while len(shown) > 2 and spare() < 0:
            shown.pop()
        return shown, min(max(spare(), 0), BAR[1] - BAR[0])

    def markdown(self) -> str:
        """Return heading, table and notes as Markdown."""
        heads = [column.head for column in self.columns]
        lines = [f"### {_plain(self.title)}", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        lines += [f"| {' | '.join(map(_plain, row))} |" for row in self.rows]
        return "\n".join([*lines, "", *(f"{_plain(line, '')}  " for line in self.remarks()), ""])

    def html(self) -> str:
        """Return heading, table and notes as HTML for a notebook; every text is escaped."""
        places = [f" style='text-align:{'left' if column.words else 'right'}'" for column in self.columns]

        def row(cells: Iterable[str], tag: str) -> str:
            texts = (f"<{tag}{place}>{escape(cell)}</{tag}>" for place, cell in zip(places, cells))
            return f"<tr>{''.join(texts)}</tr>"

        head = row((column.head for column in self.columns), "th")
        body = "".join(row(cells, "td") for cells in self.rows)
        return (
            (f"<p><b>{escape(self.title)}</b></p>" if self.title else "")
            + f"<table><thead>{head}</thead><tbody>{body}</tbody></table>"
            + "".join(f"<p><small>{escape(line)}</small></p>" for line in self.remarks())
        )

    def latex(self) -> str:
        """Return a table for a paper; it needs the package booktabs and nothing else."""
        spec = "".join("l" if column.words else "r" for column in self.columns)
        caption = " ".join(
            f"{escaped(line[:1].upper() + line[1:])}." for line in (self.title, *self.remarks())
        )
        lines = [" & ".join(map(_math, row)) + r" \\" for row in self.rows]
        return "\n".join(
            [
                "% needs \\usepackage{booktabs}",
                r"\begin{table*}",
                r"  \centering",
                rf"  \caption{{{caption}}}",
                rf"  \label{{tab:{''.join(c if c.isascii() and c.isalnum() else '-' for c in self.label)}}}",
                rf"  \begin{{tabular}}{{{spec}}}",
                r"    \toprule",
                f"    {' & '.join(escaped(column.head) for column in self.columns)} " + r"\\",
                r"    \midrule",
                *(f"    {line}" for line in lines),
                r"    \bottomrule",
                r"  \end{tabular}",
                r"\end{table*}",
                "",
            ]
        )


def _with_bar(column: Column, place: int, length: int) -> str:
    text = column.cells[place]
    if not column.bars:
        return text
    ends = column.bars[place]
    if ends is None:
        return text
    solid, shaded = (round(length * end) for end in ends)
    return f"{text:<{column.width}} {'█' * solid}{'▒' * (shaded - solid)}"


def _plain(text: str, further: str = "`|") -> str:
    """Return Markdown that shows a text literally: labels and options are strangers' words.

    An underscore within a word stands for itself, as in `batch_size`.

    Parameters
    ----------
    further:
        Characters to escape beside the usual ones; a remark of ours may have code in it.
    """
    special = rf"[\\*\[\]{further}]|(?<!\w)_|_(?!\w)"
    shown = re.sub(special, lambda found: f"\\{found[0]}", printable(text))
    return shown.replace("&", "&amp;").replace("<", "&lt;")


def csv_rows(rows: Sequence[Mapping[str, object]]) -> str:
    """Write rows, empty where one lacks a column of another; lists are separated by semicolons. No rows are nothing.

    >>> csv_rows([{"task": "pulse"}, {"task": "vqe-h2", "cost": 0.5}]).split()
    ['task,cost', 'pulse,', 'vqe-h2,0.5']
    """
    if not rows:
        return ""
    buffer = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(buffer, list(names), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        flat = {name: "; ".join(value) if isinstance(value, list) else value for name, value in row.items()}
        writer.writerow({name: _harmless(value) for name, value in flat.items()})
    return buffer.getvalue()


def flat_row(
    first: Mapping[str, object], values: Mapping[str, Any], last: Mapping[str, object]
) -> dict[str, object]:
    """Return a row for a spreadsheet: `ranks` and intervals of `values` become two columns each, the rank comes first.

    >>> flat_row({"task": "a"}, {"entry": "b", "ranks": [1, 3], "mean_interval": None}, {"alpha": 0.05})
    {'task': 'a', 'rank': 1, 'rank_worst': 3, 'entry': 'b', 'mean_low': None, 'mean_high': None, 'alpha': 0.05}
    """
    flat: dict[str, object] = {**first, "rank": None, "rank_worst": None}
    for name, value in values.items():
        if name == "ranks" or name.endswith("interval"):
            stem = name.removesuffix("_interval")
            ends = ("rank", "rank_worst") if name == "ranks" else (f"{stem}_low", f"{stem}_high")
            flat |= dict(zip(ends, value or (None, None)))
        else:
            flat[name] = value
    return flat | dict(last)


def _harmless(value: object) -> object:
    """Keep spreadsheets from reading a name as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@\t\r") else value


_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "`": r"\textasciigrave{}",
    "'": r"\symbol{39}",
    "[": "{[}",  # a row that begins with one would be read as an option of the row before
    "]": "{]}",
    "†": r"\dag{}",
}


def escaped(text: str) -> str:
    r"""Return LaTeX that prints a text literally, on one line.

    >>> print(escaped("lr=2e-3 50% & a_b"))
    lr=2e-3 50\% \& a\_b
    """
    plain = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in " ".join(text.split()))
    return "".join(_SPECIAL.get(c, c) for c in plain).replace("--", "-{}-")  # two would become a dash


def _math(cell: str) -> str:
    """Write a cell, its sign or range as LaTeX sets them."""
    if cell == "-":
        return "--"
    if cell.startswith(">= "):
        return r"$\geq$ " + escaped(cell[3:])
    if cell[:1] in "+-" and cell[1:2].isdigit():
        return f"${cell[0]}$" + escaped(cell[1:])
    best, dash, worst = cell.partition("-")
    return f"{best}--{worst}" if dash and best.isdigit() and worst.isdigit() else escaped(cell)
