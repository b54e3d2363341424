"""`qrlsuite leaderboard`: entries ranked by significant outperformance."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import api
from qrlsuite.cli.arguments import (
    AcrossOption,
    AlphaOption,
    EntryOption,
    HorizonOption,
    MinSeedsOption,
    PublishedOption,
    RunsOption,
    TaskOption,
    names_of,
)
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard import across as several
from qrlsuite.leaderboard import board as boards
from qrlsuite.leaderboard import report, tables
from qrlsuite.leaderboard.board import Leaderboard
from qrlsuite.leaderboard.costs import CostBoard
from qrlsuite.leaderboard.scores import rank_by_score
from qrlsuite.leaderboard.sheet import WIDE, Sheet, csv_rows
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.times import ALPHA
from qrlsuite.results.store import write_atomically


class Format(StrEnum):
    """How a leaderboard is written."""

    table = "table"
    markdown = "markdown"
    json = "json"
    csv = "csv"
    html = "html"
    latex = "latex"


class By(StrEnum):
    """What entries are ranked by."""

    steps = "steps"
    executions = "executions"
    shots = "shots"
    core_hours = "core-hours"
    score = "score"
    area = "area"


def leaderboard(
    task: TaskOption = None,
    entry: EntryOption = None,
    study: Annotated[
        str | None,
        typer.Option(
            "--study",
            help="Only the entries of this study (see `qrlsuite list studies`), or of a study file.",
            autocompletion=names_of("studies"),
        ),
    ] = None,
    horizon: HorizonOption = None,
    min_seeds: MinSeedsOption = 1,
    format_: Annotated[Format, typer.Option("--format", help="How to write it.")] = Format.table,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="For html; default: leaderboard.html in the results folder."
        ),
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(
            "--rule",
            metavar="NAME",
            help="Tiers by cells of the grid in the place of ranks: paper, or a name of `qrlsuite list rules`.",
        ),
    ] = None,
    alpha: AlphaOption = ALPHA,
    by: Annotated[
        By,
        typer.Option(
            "--by",
            help="What entries are ranked by: environment steps, executions, shots or core-hours below threshold, the "
            "final score, or the area under the learning curve.",
        ),
    ] = By.steps,
    pairs: Annotated[bool, typer.Option("--pairs", help="Print the matrix of all pairs, too.")] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Say below the table what its columns and marks mean.")
    ] = False,
    across: AcrossOption = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
) -> None:
    """Rank the entries of each task by significant outperformance.

    A outperforms B if it needs significantly fewer environment steps at a threshold of the task and significantly
    more at none: permutation tests, with Holm's correction over all pairs of the board, so that --alpha is the
    probability of any false difference. An entry's rank is 1 + the number of entries that outperform it; a range says
    which ranks the decided pairs leave. The order is by steps below threshold. Entries with fewer than 20 seeds are
    not ranked. --entry and --min-seeds choose what is shown, and change no rank.

    --rule paper ranks by the paper's definition instead: tiers of significant outperformance in the cells of the
    task's grid, by intervals of the sample complexity.

    With --published, your own copy of a published entry is shown too if it has fewer epochs. --across compares
    entries that were trained on several tasks with the same options. The page also shows the studies with
    looks in the results folder.

    --by executions, shots or core-hours ranks entries by what their learning cost, as their records say, within
    the same budget for all. Entries whose record does not hold it, or not so that it can be compared, have no rank.
    --by score ranks by the mean score of the last tenth of the epochs, and --by area by that of all epochs.

    Examples: qrlsuite leaderboard --task beam6g --format markdown; qrlsuite leaderboard --study ppo --published
    """
    if output is not None and format_ is not Format.html:
        raise OptionError(f"--out {output}: only the page is written to a file; add --format html")
    if by is not By.steps and (across is not None or rule is not None):
        other = "--across" if across is not None else f"--rule {rule}"
        raise OptionError(f"--by {by.value}: leave {other} out, which counts in environment steps")
    if pairs and (across is not None or by is not By.steps):
        raise OptionError(
            "--pairs: only the board by steps has the matrix of pairs; --format json has the others'"
        )
    if across is not None and study is not None:
        raise OptionError(f"--study {study}: leave --across out, or name the entries with --entry")
    if across is not None:
        _across(
            across,
            task,
            entry or [],
            horizon,
            min_seeds,
            format_,
            output,
            rule,
            alpha,
            explain,
            published,
            runs,
        )
        return
    if by in (By.score, By.area):
        chosen = functools.partial(
            api.board, task, runs=runs, published=published, horizon=horizon, study=study, alpha=alpha
        )
        _by_score(chosen, by, entry or [], min_seeds, alpha, format_, explain)
        return
    costs = None
    if by is not By.steps:
        costs = api.costs(
            task,
            by=by.value,
            runs=runs,
            published=published,
            alpha=alpha,
            horizon=horizon,
            entries=entry or (),
            study=study,
            min_seeds=min_seeds,
        )
        if format_ is not Format.html:
            _by_cost(costs, format_, task, runs, explain)
            return
    board = api.board(
        task,
        runs=runs,
        published=published,
        rule=rule,
        alpha=alpha,
        horizon=horizon,
        entries=entry or (),
        study=study,
        min_seeds=min_seeds,
    )
    if format_ is Format.json:
        typer.echo(json.dumps(board.as_dict()))
        return
    for line in board.refused:
        typer.echo(f"left out: {line}", err=True)
    if format_ is Format.html and _page(
        board, output, runs, _tasks_of(board, task, study), published, costs=costs
    ):
        return
    if not board.sections:
        raise _empty(runs, task)
    if format_ is Format.csv:
        typer.echo(csv_rows(tables.flat(board)), nl=False)
        return
    _write(board.sheets(explain, pairs), format_)


def _write(sheets: Sequence[Sheet], format_: Format) -> None:
    """Write tables to the terminal, or as text."""
    if format_ is Format.markdown:
        typer.echo("\n".join(sheet.markdown() for sheet in sheets))
    elif format_ is Format.latex:
        typer.echo("\n".join(sheet.latex() for sheet in sheets), nl=False)
    else:
        console = table_console(WIDE)
        for sheet in sheets:
            console.print(sheet)


def _tasks_of(board: Leaderboard, task: str | None, study: str | None) -> list[str]:
    """Return the tasks whose studies with looks a page shows; none means all."""
    if task is not None:
        return [task]
    return sorted({section.task for section in board.sections}) if study is not None else []


def _empty(runs: Path, task: str | None) -> UnknownNameError:
    return UnknownNameError(
        f"{runs} holds no results{f' of task {task}' if task else ''} yet: qrlsuite run; "
        "--published shows those that come with the suite"
    )


def _by_cost(board: CostBoard, format_: Format, task: str | None, runs: Path, explain: bool) -> None:
    """Write a board by cost."""
    if format_ is Format.json:
        typer.echo(json.dumps(board.as_dict()))
        return
    for line in board.refused:
        typer.echo(f"left out: {line}", err=True)
    if not board.sections:
        raise _empty(runs, task)
    if format_ is Format.csv:
        typer.echo(csv_rows(board.flat()), nl=False)
        return
    _write([section.sheet(explain) for section in board.sections], format_)


def _by_score(
    chosen: Callable[..., Leaderboard],
    by: By,
    names: Sequence[str],
    min_seeds: int,
    alpha: float,
    format_: Format,
    explain: bool,
) -> None:
    """Write the entries of each task by final score or by area; `names` and `min_seeds` choose what is shown."""
    if format_ in (Format.html, Format.csv):
        raise OptionError(
            f"--by {by.value}: no {format_.value}; choose --format table, markdown, latex or json"
        )
    board, shown = chosen(), None
    if names or min_seeds > 1:
        filtered = chosen(entries=names, min_seeds=min_seeds)
        shown = {row.entry.name for section in filtered.sections for row in section.rows}
    for line in board.refused:
        typer.echo(f"left out: {line}", err=True)
    tasks = dict.fromkeys(section.task for section in board.sections)
    mains = [tables.main_section([each for each in board.sections if each.task == task]) for task in tasks]
    rankings = [
        rank_by_score([row.entry for row in section.rows], section.horizon, by.value, alpha)
        for section in mains
    ]
    if format_ is Format.json:
        typer.echo(json.dumps([ranking.as_dict() for ranking in rankings]))
    else:
        _write([ranking.sheet(explain, shown) for ranking in rankings], format_)


def _page(
    board: Leaderboard,
    output: Path | None,
    runs: Path,
    tasks: Sequence[str],
    published: bool,
    across: several.AcrossBoard | None = None,
    costs: CostBoard | None = None,
) -> bool:
    """Write the page, with the studies with looks of the tasks; returns whether there is anything to show."""
    studies, unreadable = published_studies.collected(runs, tasks, published)
    for line in unreadable:
        typer.echo(f"left out: {line}", err=True)
    if not board.sections and not studies:
        return False
    path = output or runs / "leaderboard.html"
    shown = replace(board, refused=(*board.refused, *unreadable))
    write_atomically(path, report.render(shown, studies=studies, across=across, costs=costs).encode())
    typer.echo(f"wrote {path}")
    return True


def _across(
    across: Sequence[str],
    task: str | None,
    entries: Sequence[str],
    horizon: int | None,
    min_seeds: int,
    format_: Format,
    output: Path | None,
    rule: str | None,
    alpha: float,
    explain: bool,
    published: bool,
    runs: Path,
) -> None:
    """Compare entries over several tasks."""
    if task is not None:
        raise OptionError(f"--across {across[0]}: leave --task {task} out, --across names the tasks")
    if rule is not None:
        raise OptionError(f"--rule {rule} judges single tasks: leave it out with --across")
    selected, refused = several.collected(runs, across, entries, published, horizon, min_seeds)
    board = several.compare(selected, across, horizon, alpha, refused)
    if format_ is Format.json:
        typer.echo(json.dumps(board.as_dict()))
        return
    for line in board.refused:
        typer.echo(f"left out: {line}", err=True)
    if format_ is Format.html:
        single = boards.build(selected, board.refused, horizon=horizon, alpha=alpha)
        _page(single, output, runs, across, published, board)
    elif format_ is Format.csv:
        typer.echo(csv_rows(board.flat()), nl=False)
    else:
        _write([board.sheet(explain)], format_)
