"""A table of results, written five ways: for a terminal, as Markdown, LaTeX, HTML and csv."""

from __future__ import annotations

import csv
import functools
import io
import re
import textwrap
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from qrlsuite.columns import Column
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import OptionError

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
class Sheet:
    """A table with title and notes.

    Attributes
    ----------
    columns:
        In the order of their importance: where a line has no room for all, the last are left out. Columns for files
        alone are left out, too.
    notes:
        In the order of their importance: the first three are written, unless `explained`.
    explained:
        Whether all notes, and the meanings of the columns that are written, stand below the table.
    lines:
        Lines that always stand below the table.
    name:
        Its title on a page with several tables.
    """

    title: str
    columns: tuple[Column[Any], ...]
    rows: Sequence[Any] = ()
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
        """Return the sheet of some rows of text; `words` names the columns of words."""
        columns = (
            Column("", itemgetter(place), str, head=head, words=head in words)
            for place, head in enumerate(heads)
        )
        return cls(title, tuple(columns), rows, tuple(notes), explained, label=label, name=name)

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", tuple(column for column in self.columns if column.shown))

    @functools.cached_property
    def cells(self) -> list[tuple[str, ...]]:
        """The text of every cell, row by row."""
        return [tuple(column.written(row) for column in self.columns) for row in self.rows]

    def remarks(self, columns: Sequence[Column[Any]] | None = None) -> list[str]:
        """Return the notes below a table: all columns' in a file, these columns' in a terminal."""
        shown = self.columns if columns is None else columns
        if self.explained:
            meanings = [f"{column.title}: {column.meaning}" for column in shown if column.meaning]
            left_out = [column.title for column in self.columns if column not in shown]
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
        texts = {id(column): [row[k] for row in self.cells] for k, column in enumerate(self.columns)}
        for column in shown:
            width = self._width(column)
            room = max(width, self._least(column) + spare if column.bar else 0)
            title = column.title
            lines = [title] if column.words else _wrapped(title, room)
            justify: Literal["left", "right"] = "left" if column.words or column.bar else "right"
            table.add_column(
                Text("\n".join(lines)), justify=justify, overflow="fold", no_wrap=not column.words
            )
            if column.bar:
                bars = self._bars(column, BAR[0] + spare)
                texts[id(column)] = [
                    f"{text:<{width}} {bar}" if bar else text for text, bar in zip(texts[id(column)], bars)
                ]
        plain = {} if encoding.lower().startswith("utf") else _PLAIN
        for cells in zip(*(texts[id(column)] for column in shown)):
            table.add_row(*(Text(text.translate(plain)) for text in cells))
        return table

    def _width(self, column: Column[Any]) -> int:
        """Return the characters that a column needs: of its longest cell, or of the longest part of its head."""
        place = self.columns.index(column)
        return max(map(len, (*(row[place] for row in self.cells), *_wrapped(column.title, 1))))

    def _least(self, column: Column[Any]) -> int:
        """Return the characters that a column needs with its bars, and with its words folded."""
        width = self._width(column)
        return min(width, FOLDED) if column.words else width + (BAR[0] + 1) * bool(column.bar)

    def _bars(self, column: Column[Any], length: int) -> list[str]:
        """Return a bar for each row, solid to its low end and shaded to its high end; the longest has a length."""
        ends = [column.bar(row) if column.bar else None for row in self.rows]
        longest = max((bar[2] for bar in ends if bar), default=1) or 1
        bars = []
        for bar in ends:
            solid, shaded = (round(length * bar[end] / longest) for end in (0, 2)) if bar else (0, 0)
            bars.append("█" * solid + "▒" * (shaded - solid))
        return bars

    def _fitting(self, width: int) -> tuple[list[Column[Any]], int]:
        """Return the columns for which a line has room, and the characters left for longer bars."""
        shown = list(self.columns)
        least = {id(column): self._least(column) for column in shown}

        def spare() -> int:
            return width - sum(least[id(column)] for column in shown) - 2 * (len(shown) - 1)

        while len(shown) > 2 and spare() < 0:
            shown.pop()
        return shown, min(max(spare(), 0), BAR[1] - BAR[0])

    def markdown(self) -> str:
        """Return heading, table and notes as Markdown."""
        heads = [column.title for column in self.columns]
        lines = [f"### {_plain(self.title)}", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        lines += [f"| {' | '.join(map(_plain, row))} |" for row in self.cells]
        return "\n".join([*lines, "", *(f"{_plain(line, '')}  " for line in self.remarks()), ""])

    def html(self) -> str:
        """Return heading, table and notes as HTML for a notebook; every text is escaped."""
        places = [f" style='text-align:{'left' if column.words else 'right'}'" for column in self.columns]

        def row(cells: Iterable[str], tag: str) -> str:
            texts = (f"<{tag}{place}>{escape(cell)}</{tag}>" for place, cell in zip(places, cells))
            return f"<tr>{''.join(texts)}</tr>"

        head = row((column.title for column in self.columns), "th")
        body = "".join(row(cells, "td") for cells in self.cells)
        return (
            (f"<p><b>{escape(self.title)}</b></p>" if self.title else "")
            + f"<table><thead>{head}</thead><tbody>{body}</tbody></table>"
            + "".join(f"<p><small>{escape(line)}</small></p>" for line in self.remarks())
        )

    def latex(self) -> str:
        """Return a table for a paper, further notes as comments; it needs the package booktabs and nothing else."""
        spec = "".join("l" if column.words else "r" for column in self.columns)
        first, *others = self.remarks() or [""]
        caption = "; ".join(filter(None, (self.title, first)))
        caption = escaped(caption if caption.endswith(("?", ".")) else f"{caption}.")
        lines = [" & ".join(map(_math, row)) + r" \\" for row in self.cells]
        return "\n".join(
            [
                "% needs \\usepackage{booktabs}",
                *(f"% {escaped(line)}" for line in others),
                r"\begin{table*}",
                r"  \centering",
                rf"  \caption{{{caption}}}",
                rf"  \label{{tab:{''.join(c if c.isascii() and c.isalnum() else '-' for c in self.label)}}}",
                rf"  \begin{{tabular}}{{{spec}}}",
                r"    \toprule",
                f"    {' & '.join(escaped(column.title) for column in self.columns)} " + r"\\",
                r"    \midrule",
                *(f"    {line}" for line in lines),
                r"    \bottomrule",
                r"  \end{tabular}",
                r"\end{table*}",
                "",
            ]
        )


def _wrapped(title: str, room: int) -> list[str]:
    """Return the lines of a head; names such as `beam6g-a2-0` are not broken."""
    return textwrap.wrap(title, room, break_long_words=False)


WRITTEN = {".tex": Sheet.latex, ".md": Sheet.markdown}
"""How tables are written into a file, by its ending."""


def text_of(sheets: Iterable[Sheet], path: Path) -> str:
    """Return tables as the text of a file."""
    if path.suffix not in WRITTEN:
        raise OptionError(f"--out {path}: a table is written to a file that ends with {' or '.join(WRITTEN)}")
    return "\n".join(map(WRITTEN[path.suffix], sheets))


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
        flat = {
            name: "; ".join(map(str, value)) if isinstance(value, list) else value
            for name, value in row.items()
        }
        writer.writerow({name: _harmless(value) for name, value in flat.items()})
    return buffer.getvalue()


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
    shown = "".join(_SPECIAL.get(c, c) for c in plain)
    return shown.replace("--", "-{}-").replace("''", "'{}'")  # two would become a dash, or a quotation mark


def _math(cell: str) -> str:
    """Write a cell, its signs or range as LaTeX sets them."""
    if cell == "-":
        return "--"
    if cell.startswith(">= "):
        return r"$\geq$ " + escaped(cell[3:])
    best, dash, worst = cell.partition("-")
    if dash and best.isdigit() and worst.isdigit():
        return f"{best}--{worst}"
    return re.sub(r"(?<![\w.])[+-](?=\d)", r"$\g<0>$", escaped(cell))
