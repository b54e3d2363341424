"""`qrlsuite leaderboard`: entries ranked by significant outperformance."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import api
from qrlsuite.cli.arguments import (
    EntryOption,
    HorizonOption,
    MinSeedsOption,
    PublishedOption,
    RuleOption,
    RunsOption,
    TaskOption,
)
from qrlsuite.cli.commands import verify
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard import report, rules, tables
from qrlsuite.results.store import write_atomically


class Format(StrEnum):
    """How a leaderboard is written."""

    table = "table"
    markdown = "markdown"
    json = "json"
    csv = "csv"
    html = "html"


app = typer.Typer(invoke_without_command=True)
app.command("verify")(verify.verify)


@app.callback()
def leaderboard(
    context: typer.Context,
    task: TaskOption = None,
    entry: EntryOption = None,
    horizon: HorizonOption = None,
    min_seeds: MinSeedsOption = 1,
    format_: Annotated[Format, typer.Option("--format", help="How to write it.")] = Format.table,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="For html; default: leaderboard.html in the results folder."
        ),
    ] = None,
    rule: RuleOption = rules.DEFAULT,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
) -> None:
    """Rank the entries of each task by significant outperformance.

    A tier is 1 + the longest chain of entries that outperform one another above it. Entries are compared at
    equal numbers of seeds; below 20 the verdict is undecided. S_hat is the sample complexity: environment steps
    until (and whenever) fewer than delta of the runs score 1 - epsilon, with its 5th to 95th percentile.
    With --published, an entry that you trained less far than the published one is shown beside it.

    Example: qrlsuite leaderboard --task beam6g --format markdown
    """
    if context.invoked_subcommand is not None:
        return

    if output is not None and format_ is not Format.html:
        raise OptionError(f"--out {output}: only the page is written to a file; add --format html")
    board = api.board(
        task,
        runs=runs,
        published=published,
        rule=rule,
        horizon=horizon,
        entries=entry or (),
        min_seeds=min_seeds,
    )
    if format_ is Format.json:
        typer.echo(json.dumps(board.as_dict()))
        return
    for line in board.refused:
        typer.echo(f"left out: {line}", err=True)
    if not board.sections:
        raise UnknownNameError(
            f"{runs} holds no results{f' of task {task}' if task else ''} yet: qrlsuite run; "
            "--published shows those that come with the suite"
        )
    if format_ is Format.html:
        path = output or runs / "leaderboard.html"
        write_atomically(path, report.render(board).encode())
        typer.echo(f"wrote {path}")
    elif format_ is Format.markdown:
        typer.echo(tables.markdown(board))
    elif format_ is Format.csv:
        typer.echo(tables.csv_text(board), nl=False)
    else:
        console = table_console(tables.WIDE)
        for section in board.sections:
            console.print(tables.section_table(section, console.width))
    if board.rule != rules.DEFAULT and format_ not in (Format.html, Format.csv):
        typer.echo(f"rule '{board.rule}': {board.promise}")
