"""Text in a terminal: tables, commands to type next, and the text of strangers (plugins, damaged files)."""

from __future__ import annotations

import io
import os
import shlex
import shutil
import sys
from pathlib import Path

from rich.console import Console


class Shown:
    """A result that shows itself as its table: printed, at a Python prompt, and in a notebook.

    Subclasses have `__rich_console__` or `__rich__`, and are dataclasses with `repr=False`.
    """

    def __repr__(self) -> str:
        text = io.StringIO()
        width = table_console().width
        Console(file=text, width=width, color_system=None, highlight=False, force_jupyter=False).print(self)
        return "\n".join(line.rstrip() for line in text.getvalue().rstrip().split("\n"))

    def _repr_html_(self) -> str:
        console = Console(record=True, file=io.StringIO(), width=130, highlight=False, force_jupyter=False)
        console.print(self)
        style = "white-space:pre;overflow-x:auto;line-height:normal;font-family:monospace"
        return console.export_html(inline_styles=True, code_format=f"<pre style='{style}'>{{code}}</pre>")


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
