"""The option `--across TASK TASK ...`, which takes all words up to the next option."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

OPTION = "--across"


def spread(arguments: list[str]) -> list[str]:
    """Write the option before each of its words, as Click understands it.

    >>> spread(["--across", "beam6g", "cartpole", "--alpha", "0.1"])
    ['--across', 'beam6g', '--across', 'cartpole', '--alpha', '0.1']
    """
    expanded, inside = list[str](), False
    for index, word in enumerate(arguments):
        if word.startswith("-"):
            inside = word == OPTION
        elif inside and arguments[index - 1] != OPTION:
            expanded.append(OPTION)
        expanded.append(word)
    return expanded


class SeveralTasksCommand(TyperCommand):
    """A command with the option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words."""
        return super().parse_args(ctx, spread(args))
