"""`qrlsuite power`: how many seeds, and core-hours, it takes to find a difference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import api
from qrlsuite.cli.arguments import AmongOption, JsonOption, PublishedOption, RunsOption, entries_here
from qrlsuite.engine.terminal import table_console


def power(
    first: Annotated[
        str,
        typer.Argument(
            metavar="ENTRY",
            help="An entry like those to compare, with two seeds or more.",
            autocompletion=entries_here,
        ),
    ],
    second: Annotated[
        str | None,
        typer.Argument(
            metavar="[ENTRY]",
            help="Another one, to be told apart from the first.",
            autocompletion=entries_here,
        ),
    ] = None,
    task: AmongOption = None,
    draws: Annotated[
        int, typer.Option("--draws", min=20, help="Simulated pairs per line; more take longer.")
    ] = 200,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Say how many seeds it takes to find that another entry is 10, 25 or 50 percent slower than this one.

    For two entries, also say how many it takes to find the difference between them. Pairs are simulated from the
    curves and judged by rule `times` at alpha = .05: all seeds at once, and with looks, as
    `qrlsuite study new` writes them.

    Example: qrlsuite power "mlp width=64" --task beam6g --published
    """
    found = api.power(
        first, second, task=task, draws=draws, runs=runs, published=published, progress=not json_output
    )
    if json_output:
        typer.echo(json.dumps(found.as_dict()))
    else:
        table_console().print(found, soft_wrap=True)
