"""`qrlsuite compare`: which of two entries needs fewer steps, by how much and how surely, and how both end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qrlsuite import api
from qrlsuite.cli.arguments import (
    AmongOption,
    JsonOption,
    LabelOption,
    PublishedOption,
    RuleOption,
    RunsOption,
    TableFileOption,
    entries_here,
)
from qrlsuite.engine.sheet import text_of
from qrlsuite.engine.terminal import command
from qrlsuite.leaderboard.boards.scores import OF_RUNS
from qrlsuite.results.store import write_atomically
from qrlsuite.statistics import Direction


def compare(
    first: Annotated[
        str,
        typer.Argument(
            metavar="ENTRY",
            help="An entry: its name or label, or the beginning of one, after [TASK/].",
            autocompletion=entries_here,
        ),
    ],
    second: Annotated[
        str,
        typer.Argument(metavar="ENTRY", help="Another entry of the same task.", autocompletion=entries_here),
    ],
    task: AmongOption = None,
    rule: RuleOption = None,
    by: Annotated[
        str,
        typer.Option(
            "--by",
            metavar="|".join(("steps", *OF_RUNS)),
            help="The number that decides the verdict, or a cost that the task's [ranking] names.",
        ),
    ] = "steps",
    label: LabelOption = None,
    out: TableFileOption = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Say which of two entries needs fewer steps, by how much and how surely, and how both end.

    The thresholds follow one by one, then the verdict on the board of all entries of the task, which is stricter, and
    how settings were found. --rule paper adds the paper's cells, at equal numbers of seeds; --by score, area or spread
    begins with that number.

    Example: qrlsuite compare --task beam6g "mlp width=64" "mlp width=16"
    """
    comparison = api.compare(
        first, second, task=task, runs=runs, published=published, rule=rule, by=by, labels=label or ()
    )
    if out is not None:
        write_atomically(out, text_of(comparison.sheets(), out).encode())
    if json_output:
        typer.echo(json.dumps(comparison.as_dict()))
        return
    if out is not None:
        typer.echo(f"wrote {out}")
        return
    Console().print(comparison)
    pair = comparison.pair.times
    if pair.direction in (Direction.UNDECIDED, Direction.NOT_TOLD_APART) and min(pair.n_runs) > 1:
        among = ["--task", task] if task else []
        words = [*among, "--published"] if published else among
        typer.echo(f"how many seeds it takes: {command('power', first, second, *words, runs=runs)}")
