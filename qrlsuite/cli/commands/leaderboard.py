"""`qrlsuite leaderboard`: entries ranked by significant outperformance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from qrlsuite import api
from qrlsuite.api.entries import write_page
from qrlsuite.cli.arguments import (
    AlphaOption,
    EntryOption,
    HorizonOption,
    LabelOption,
    PublishedOption,
    RunsOption,
    TasksOption,
    names_of,
    refuse_typed,
)
from qrlsuite.engine.sheet import WIDE, csv_rows
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard.boards.board import AXES, Leaderboard
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.rules import STEPS
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.store import write_atomically

Format = Literal["table", "markdown", "json", "csv", "html", "latex"]
ENDINGS: dict[str, Format] = {
    ".html": "html",
    ".tex": "latex",
    ".md": "markdown",
    ".csv": "csv",
    ".json": "json",
}
"""Formats by the ending of a file."""


def leaderboard(
    context: typer.Context,
    task: TasksOption = None,
    entry: EntryOption = None,
    label: LabelOption = None,
    study: Annotated[
        str | None,
        typer.Option(
            "--study",
            help="Only the entries of this study (see `qrlsuite list studies`), or of a study file.",
            autocompletion=names_of("studies"),
        ),
    ] = None,
    horizon: HorizonOption = None,
    format_: Annotated[Format, typer.Option("--format", help="Format of the board.")] = "table",
    output: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Write to this html, tex, md, csv or json file; of html, default: leaderboard.html in the results "
            "folder.",
        ),
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(
            "--rule",
            metavar="NAME",
            help="Show tiers by cells of the grid instead of ranks: paper, or a name of `qrlsuite list rules`.",
        ),
    ] = None,
    alpha: AlphaOption = ALPHA,
    by: Annotated[
        str,
        typer.Option(
            "--by",
            metavar="|".join(AXES),
            help="Axis of the ranking: environment steps, executions, shots or core-hours below threshold, the "
            "final score, the area under the learning curve, the spread between seeds, or a cost that the task's "
            "[ranking] names.",
            autocompletion=lambda: list(AXES),
        ),
    ] = "steps",
    explain: Annotated[
        bool,
        typer.Option("--explain", help="Explain columns and marks, and how each pair was decided."),
    ] = False,
    all_codes: Annotated[
        bool,
        typer.Option("--all-codes", help="Show entries of every code, not only of the newest with 20 seeds."),
    ] = False,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
) -> None:
    """Rank the entries of each task by significant outperformance.

    A outperforms B if it needs significantly fewer environment steps, as a mean over the task's thresholds: permutation
    tests, with Holm's correction over all pairs of the board, so that --alpha is the probability of any false
    difference. An entry's rank is 1 + the number of entries that outperform it; a range has all ranks that the decided
    pairs leave. The order is by steps below threshold. Entries with fewer than 20 seeds are not ranked. --entry hides
    other rows, and changes no rank.

    --rule paper ranks by the paper's definition instead: tiers of significant outperformance in the cells of the
    task's grid, by intervals of the sample complexity.

    With --published, your own seeds of a published entry are added to it, or shown beside it if they have fewer
    epochs. Several --task compare the entries that were trained on all these tasks with the same options. The page
    also shows the studies with looks in the results folder.

    --by executions, shots or core-hours ranks entries by their cost of learning, as their records say, within the same
    budget for all; --entry then compares these alone. Entries without a comparable cost in their record have no rank.
    --by score ranks by the mean score of the last tenth of the epochs, --by area by the mean of all epochs, --by spread
    by how far seeds are from the median seed, in steps below threshold. Metrics of the environment that the task file
    names in [ranking] costs are columns; --by their names ranks by them, less first.

    Examples: qrlsuite leaderboard --task beam6g --format markdown; qrlsuite leaderboard --study ppo --published
    """
    if output is not None:
        ending = ENDINGS.get(output.suffix, format_)
        if ending == "table":
            raise OptionError(f"--out {output}: end it with {', '.join(ENDINGS)}")
        if format_ not in ("table", ending):
            raise OptionError(f"--format {format_} and --out {output}, which is {ending}: give one of them")
        format_ = ending
    tasks = list(task or ())
    if format_ in ("html", "csv", "json"):
        refuse_typed(context, f"in {format_}", "explain")
    elif rule not in (None, STEPS):
        refuse_typed(context, f"in tiers by rule '{rule}', which has an error of its own", "alpha")
    asked: dict[str, Any] = {
        "by": by,
        "study": study,
        "rule": rule,
        "alpha": alpha,
        "horizon": horizon,
        "entries": entry or (),
        "all_codes": all_codes,
        "labels": label or (),
    }
    if format_ == "html":
        path, refused = write_page(output, Selection.create(runs, tasks, published), **asked)
        _left_out(refused)
        if path is None:
            raise _nothing(runs, tasks)
        typer.echo(f"wrote {path}")
        return
    board = api.board(tasks, runs=runs, published=published, **asked)
    if format_ != "json":
        _left_out(board.refused)
        if not board.sections:
            raise _nothing(runs, tasks)
    if format_ == "table":
        console = table_console(WIDE)
        for sheet in board.sheets(explain):
            console.print(sheet)
        return
    text = _text(board, explain, format_)
    if output is None:
        typer.echo(text, nl=False)
    else:
        write_atomically(output, text.encode())
        typer.echo(f"wrote {output}")


def _left_out(lines: Sequence[str]) -> None:
    for line in lines:
        typer.echo(f"left out: {line}", err=True)


def _nothing(runs: Path, tasks: Sequence[str]) -> UnknownNameError:
    return UnknownNameError(
        f"{runs} holds no results{f' of task {tasks[0]}' if tasks else ''} yet: qrlsuite run; --published "
        "shows the entries that come with the suite"
    )


def _text(board: Leaderboard, explain: bool, format_: Format) -> str:
    match format_:
        case "json":
            return json.dumps(board.as_dict()) + "\n"
        case "csv":
            return csv_rows(board.flat())
        case "markdown":
            return "\n".join(sheet.markdown() for sheet in board.sheets(explain)) + "\n"
    return "\n".join(sheet.latex() for sheet in board.sheets(explain))
