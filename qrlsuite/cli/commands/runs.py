"""`qrlsuite runs`: what the results folder holds and how far it is; `runs gc` and `runs rm` remove parts of it."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption, TaskOption
from qrlsuite.engine.sheet import csv_rows
from qrlsuite.engine.status import EntryStatus, survey
from qrlsuite.engine.terminal import printable
from qrlsuite.engine.where import Queues
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.shelf import collect, fields
from qrlsuite.results import lookup
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import entries
from qrlsuite.results.survey import STATUSES, EntrySurvey, delete, garbage, look, remove
from qrlsuite.results.text import duration, size_text

app = typer.Typer(invoke_without_command=True)


@app.callback()
def runs(
    context: typer.Context,
    task: TaskOption = None,
    runs: RunsOption = Path("runs"),
    format_: Annotated[
        Literal["table", "csv"],
        typer.Option(
            "--format", help="csv: a row for each entry, with its scores, its costs and every option."
        ),
    ] = "table",
    json_output: JsonOption = False,
) -> None:
    """List the results folder: task, entry, seeds by status, epochs, size on disk, last activity.

    Under an entry stand its groups of seeds that run, wait or stopped, from any machine that sees the folder.
    Workers are not disturbed. Where seeds were submitted to a queue, the queue is asked whether it still has them.

    Examples: qrlsuite runs --task beam6g; qrlsuite runs rm "mlp width=64" --task beam6g
    """
    if context.invoked_subcommand is not None:
        action = context.invoked_subcommand
        for name in context.params:
            if getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE":
                raise OptionError(
                    f"put options after the action: qrlsuite runs {action} --task TASK --runs DIR"
                )
        return
    statuses = survey(runs, task)
    if format_ == "csv":
        typer.echo(csv_rows(_flat(runs, statuses)), nl=False)
        return
    if json_output:
        typer.echo(json.dumps([status.as_dict() for status in statuses]))
        return
    for status in statuses:
        for problem in status.entry.problems:
            typer.echo(f"damaged: {printable(problem)}", err=True)
    if not statuses:
        typer.echo(f"{runs} holds no entry{f' of task {task}' if task else ''} yet: qrlsuite run")
        return
    now = time.time()
    table = [
        ("task", "entry", "label", "seeds", "epochs", "size", "last activity"),
        *(_row(status.entry, now) for status in statuses),
    ]
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in table]
    typer.echo(lines[0])
    for line, entry_status in zip(lines[1:], statuses):
        typer.echo("\n".join([line, *map(printable, _unfinished(entry_status))]))


@app.command("gc")
def collect_garbage(
    task: TaskOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="Remove them; without it they are only listed.")] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Remove the checkpoints of finished groups: curves and agents stay, but cannot be extended by more epochs.

    Example: qrlsuite runs gc --yes
    """
    lookup.check_tasks(runs, task)
    _collect_garbage(runs, task, yes, json_output)


@app.command("rm")
def delete_entries(
    names: Annotated[
        list[str],
        typer.Argument(metavar="ENTRY...", help="Its name or label, or the beginning of one, after [TASK/]."),
    ],
    task: TaskOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Delete entries with all their seeds. It asks first, and deletes no entry that is being trained.

    Example: qrlsuite runs rm "mlp width=64" --task beam6g
    """
    lookup.check_tasks(runs, task)
    _delete(runs, task, names, yes, json_output)


def _flat(runs: Path, statuses: Sequence[EntryStatus]) -> list[dict[str, Any]]:
    """Return a row of values for each entry: how far it is, and what `qrlsuite.api.table` says of it."""
    results = {}
    if statuses:
        found, _ = collect.collect(runs, {status.entry.task for status in statuses})
        results = {(row["task"], row["name"]): row for row in fields.table(found, "entries").to_pylist()}
    rows = []
    for status in statuses:
        entry = status.entry
        known = results.get(
            (entry.task, entry.name), {"task": entry.task, "entry": entry.label, "name": entry.name}
        )
        low, high = entry.epochs or (0, 0)
        far = {
            "epochs_least": low,
            "epochs_most": high,
            "bytes": entry.size,
            "last_activity": entry.last_activity,
        }
        rows.append({**{f"seeds_{each}": entry.seeds.get(each, 0) for each in STATUSES}, **far, **known})
    names = dict.fromkeys(name for row in [*results.values(), *rows] for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


def _row(entry: EntrySurvey, now: float) -> tuple[str, ...]:

    seeds = ", ".join(f"{entry.seeds[status]} {status}" for status in STATUSES if entry.seeds.get(status))
    low, high = entry.epochs or (0, 0)
    return (
        printable(entry.task),
        printable(entry.name),
        printable(entry.label),
        seeds or "none",
        f"{low}" if low == high else f"{low} to {high}",
        size_text(entry.size),
        f"{duration(max(0.0, now - entry.last_activity))} ago",
    )


def _unfinished(status: EntryStatus) -> list[str]:
    """Return a line for each group of an entry that has not finished."""
    problem = status.queue_problem
    silent = [f"the queue was not asked, seeds may have left it: {problem}"] if problem else []
    return [f"  {line}" for line in (*silent, *(group.text for group in status.groups))]


def _collect_garbage(folder: Path, task: str | None, yes: bool, json_output: bool) -> None:

    items, problems = garbage(folder, task)
    total = sum(item.size for item in items)
    freed = remove(items) if yes else 0
    if json_output:
        rows = [{"folder": str(item.folder), "seeds": item.seeds, "size": item.size} for item in items]
        typer.echo(json.dumps({"groups": rows, "size": total, "freed": freed, "problems": problems}))
        return
    for problem in problems:
        typer.echo(f"left alone: {printable(problem)}", err=True)
    if not items:
        typer.echo("nothing to remove: no finished group has a checkpoint")
        return
    for item in items:
        typer.echo(f"{size_text(item.size):>7}  {item.folder}  (seeds {format_seeds(item.seeds)})")
    if yes:
        typer.echo(f"removed, {size_text(freed)} freed")
        return
    typer.echo(
        f"would remove {len(items)} checkpoint{'s' * (len(items) > 1)}, {size_text(total)}. Curves and trained agents "
        "stay, but these seeds can then not be extended by more epochs. To do it: qrlsuite runs gc --yes"
    )


def _delete(folder: Path, task: str | None, names: list[str], yes: bool, json_output: bool) -> None:

    stored = lookup.stored(entries(folder, task))
    searched = f"{folder}, task {task}" if task else folder
    chosen = list(dict.fromkeys(lookup.choose(stored, name, searched).store for name in names))
    summaries = [look(store) for store in chosen]
    for entry in summaries:
        count = sum(entry.seeds.values())
        description = f"{entry.task}/{entry.name} ({entry.label}, {count} seed{'s' * (count != 1)})"
        typer.echo(f"{size_text(entry.size):>7}  {printable(description)}", err=json_output)
    if not yes and not typer.confirm("Delete this for good?", err=json_output):
        typer.echo("nothing was deleted", err=json_output)
        raise typer.Exit(1)
    queues, freed = Queues(), 0
    for store, entry in zip(chosen, summaries):
        queued = queues.waiting(store) if entry.seeds.get("submitted") else None
        freed += delete(folder, store, queued)
    if json_output:
        rows = [{"task": entry.task, "entry": entry.name, "size": entry.size} for entry in summaries]
        typer.echo(json.dumps({"deleted": rows, "freed": freed}))
    else:
        typer.echo(f"deleted, {size_text(freed)} freed")
