"""Text in a terminal: tables, commands to type next, and the text of strangers (plugins, damaged files)."""

from __future__ import annotations

import contextlib
import contextvars
import io
import os
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

_AGAIN: contextvars.ContextVar[Literal["command", "call"]] = contextvars.ContextVar("again", default="call")


def again() -> Literal["command", "call"]:
    """Return the way to continue stopped work, for messages: repeat the command, or the call of a function."""
    return _AGAIN.get()


@contextlib.contextmanager
def as_command() -> Iterator[None]:
    """Let messages speak to somebody who typed a command."""
    token = _AGAIN.set("command")
    try:
        yield
    finally:
        _AGAIN.reset(token)


class Shown:
    """A result that shows itself as its table: printed, at a Python prompt, and as HTML in a notebook.

    Subclasses have `__rich_console__` or `__rich__`, and are dataclasses with `repr=False`.
    """

    def __repr__(self) -> str:
        text = io.StringIO()
        width = table_console().width
        Console(file=text, width=width, color_system=None, highlight=False, force_jupyter=False).print(self)
        return "\n".join(line.rstrip() for line in text.getvalue().rstrip().split("\n"))

    def _repr_html_(self) -> str:
        console = Console(width=130, file=io.StringIO(), force_jupyter=False)
        return "\n".join(part for each in _parts(self, console) if (part := _html(each)))


def _parts(shown: Any, console: Console) -> Iterator[Any]:
    """Return the parts of a result, in order: tables, texts, and sheets, which write themselves as HTML."""
    if hasattr(shown, "__rich__"):
        yield from _parts(shown.__rich__(), console)
    elif isinstance(shown, str | Text | Table) or hasattr(shown, "html"):
        yield shown
    else:
        for part in shown.__rich_console__(console, console.options):
            yield from _parts(part, console)


def _html(part: Any) -> str:
    """Return a part of a result as HTML, with every text escaped; a part without words is left out."""
    if isinstance(part, Table):
        return _table_html(part)
    if isinstance(part, str | Text):
        bold = isinstance(part, Text) and "bold" in str(part.style)
        lines = "<br>".join(map(escape, str(part).strip().splitlines()))
        return f"<p><b>{lines}</b></p>" if bold else f"<p>{lines}</p>" * bool(lines)
    return str(part.html())


def _table_html(table: Table) -> str:
    """Return a table as one of HTML: numbers at the right, as in a terminal; title above, caption below."""
    columns = table.columns
    places = [f" style='text-align:{column.justify}'" for column in columns]

    def row(cells: Iterable[object], tag: str) -> str:
        texts = (escape(" ".join(str(cell).replace("-\n", "-").split())) for cell in cells)
        return f"<tr>{''.join(f'<{tag}{place}>{text}</{tag}>' for place, text in zip(places, texts))}</tr>"

    head = row((column.header for column in columns), "th") if table.show_header else ""
    body = "".join(row(cells, "td") for cells in zip(*(column.cells for column in columns)))
    below = "".join(f"<p><small>{escape(line)}</small></p>" for line in str(table.caption or "").splitlines())
    title = f"<p><b>{escape(str(table.title))}</b></p>" if table.title else ""
    return f"{title}<table><thead>{head}</thead><tbody>{body}</tbody></table>{below}"


def show_figures_in_notebook() -> None:
    """Let the notebook in which this process runs, if any, show matplotlib figures.

    IPython does so once pyplot was imported. Figures of the suite are made without pyplot, which would keep them all.
    """
    if "IPython" not in sys.modules:
        return
    from IPython import get_ipython
    from IPython.core.pylabtools import select_figure_formats

    shell = get_ipython()
    if (
        shell is not None
        and "matplotlib.figure.Figure" not in shell.display_formatter.formatters["image/png"]
    ):
        select_figure_formats(shell, {"png"})


def table_console(least: int = 130) -> Console:
    """Return where tables are printed: as wide as the terminal, and in a pipe or a file `least` columns or more."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(width=max(console.width, least), highlight=False)


def command(*arguments: str, runs: Path | None = None) -> str:
    """Return a `qrlsuite` command line that works where it is pasted: quoted, with the results folder that it needs.

    Where the shell does not find this installation's `qrlsuite`, for its virtual environment is not active, the line
    begins with the program's path.

    Parameters
    ----------
    runs:
        The results folder of a command that takes `--runs`; it is left out where it is the default.
    """
    default = Path(os.environ.get("QRLSUITE_RUNS") or "runs")
    runs_option = [] if runs is None or runs == default else ["--runs", str(runs)]
    return f"{_program()} {shlex.join([*arguments, *runs_option])}"


def _program() -> str:
    installed = (
        Path(sys.executable).parent / "qrlsuite"
    )  # not resolved: a virtual environment's python is a link
    on_path = shutil.which("qrlsuite")
    if on_path is not None and installed.exists() and os.path.samefile(on_path, installed):
        return "qrlsuite"
    if not installed.exists():
        return f"{shlex.quote(sys.executable)} -m qrlsuite"
    here = Path.cwd()
    return shlex.quote(str(installed.relative_to(here) if installed.is_relative_to(here) else installed))


def printable(text: object) -> str:
    r"""Return one line in which nothing controls a terminal.

    White space becomes a space. Any other character that is not printable (escape sequences, marks that reverse the
    direction of writing, halves of surrogate pairs) is written out, as in `\x1b`.
    """
    return "".join(map(_shown, str(text)))


def printable_lines(text: object) -> str:
    """Return text of several lines, each of them `printable`."""
    return "\n".join(printable(line) for line in str(text).split("\n"))


def _shown(character: str) -> str:
    if character.isprintable():
        return character
    return " " if character.isspace() else character.encode("unicode_escape").decode()
