"""Text of strangers in a terminal: names, summaries and errors of plugins, content of damaged files."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def table_console(least: int = 130) -> Console:
    """Return where tables are printed: as wide as the terminal, and in a pipe or a file `least` columns or more."""
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(width=max(console.width, least), highlight=False)


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
