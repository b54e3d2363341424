"""`--across TASK TASK ...`: an option that takes words up to the next option."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperGroup

OPTION = "--across"


def spread(words: list[str]) -> list[str]:
    """Write the option before each of its words, as Click understands it.

    >>> spread(["--across", "beam6g", "cartpole", "--alpha", "0.1"])
    ['--across', 'beam6g', '--across', 'cartpole', '--alpha', '0.1']
    """
    found, inside = list[str](), False
    for place, word in enumerate(words):
        if word.startswith("-"):
            inside = word == OPTION
        elif inside and words[place - 1] != OPTION:
            found.append(OPTION)
        found.append(word)
    return found


class SeveralTasksGroup(TyperGroup):
    """A group with the option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words."""
        return super().parse_args(ctx, spread(args))


class SeveralTasksCommand(TyperCommand):
    """A command with the option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words."""
        return super().parse_args(ctx, spread(args))
