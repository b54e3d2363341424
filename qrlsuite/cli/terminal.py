"""Text of strangers in a terminal: names, summaries and errors of plugins, content of damaged files."""

from __future__ import annotations


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
