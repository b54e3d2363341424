"""`qrlsuite power`: how many seeds, and core-hours, it takes to find a difference."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import api
from qrlsuite.cli.arguments import (
    AmongOption,
    JsonOption,
    PublishedOption,
    RunsOption,
    entries_here,
    refuse_typed,
)
from qrlsuite.cli.commands.import_ import divide
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError


def power(
    context: typer.Context,
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ENTRY [ENTRY]",
            help="An entry like the ones to compare, with two seeds or more; and a second one, to ask "
            "about this pair. With --like also options of `import`, such as maximum=500.",
            autocompletion=entries_here,
        ),
    ] = None,
    like: Annotated[
        list[Path] | None,
        typer.Option(
            "--like",
            metavar="FILE",
            help="Look for ENTRY in this file of curves, see `import`; default: all of its entries. Repeatable.",
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
    curves and judged by rule `steps` at alpha = .05: all seeds at once, and with looks, as
    `qrlsuite study new` writes them.

    Examples: qrlsuite power "mlp width=64" --task beam6g --published; qrlsuite power --like results.csv maximum=500
    """
    if like:
        refuse_typed(context, "with --like", "published", "runs")
        names, options = divide(words or ())
        with tempfile.TemporaryDirectory() as folder:
            done = api.import_curves(like, task=task, runs=folder, **options)
            entries: list[Any] = [
                api.load(name, runs=folder) for name in names or [each.label for each in done]
            ]
    else:
        entries = list(words or ())
    if not 1 <= len(entries) <= 2:
        raise OptionError("name one or two entries: qrlsuite power 'mlp width=64'")
    found = api.power(
        *entries, task=task, draws=draws, runs=runs, published=published, progress=not json_output
    )
    if json_output:
        typer.echo(json.dumps(found.as_dict()))
    else:
        table_console().print(found, soft_wrap=True)
