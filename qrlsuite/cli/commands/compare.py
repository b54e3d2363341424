"""`qrlsuite compare`: two entries, cell by cell, and in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qrlsuite import api
from qrlsuite.cli.arguments import AmongOption, JsonOption, PublishedOption, RuleOption, RunsOption
from qrlsuite.leaderboard import tables


def compare(
    first: Annotated[
        str,
        typer.Argument(
            metavar="ENTRY", help="An entry: its name or label, or the beginning of one, after [TASK/]."
        ),
    ],
    second: Annotated[str, typer.Argument(metavar="ENTRY", help="Another entry of the same task.")],
    task: AmongOption = None,
    rule: RuleOption = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Say whether the first entry outperforms the second, cell by cell of the task's ranking grid.

    Both are compared at equal numbers of seeds and equal horizons.

    Example: qrlsuite compare --task beam6g "mlp width=64" "mlp width=16"
    """
    comparison = api.compare(first, second, task=task, runs=runs, published=published, rule=rule)
    if json_output:
        typer.echo(json.dumps(comparison.as_dict()))
        return
    Console().print(tables.comparison_table(comparison))
    typer.echo(
        "\n".join([comparison.legend, f"{comparison.headline}:", comparison.sentence, *comparison.remarks])
    )
