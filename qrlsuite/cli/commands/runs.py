"""`qrlsuite runs`: content and progress of the results folder; `runs gc` and `runs rm` remove parts of it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Literal

import typer

from qrlsuite.api.tables import progress_table
from qrlsuite.cli.arguments import JsonOption, RunsOption, TaskOption, entries_here, is_typed
from qrlsuite.engine.sheet import csv_rows
from qrlsuite.engine.status import EntryStatus, choose, delete_each, survey
from qrlsuite.engine.terminal import command, printable, table_console
from qrlsuite.errors import OptionError
from qrlsuite.notation import parse_named
from qrlsuite.results import lookup
from qrlsuite.results.seeds import format_seeds, parse_seeds
from qrlsuite.results.store import EntryStore
from qrlsuite.results.survey import garbage, remove, withdraw
from qrlsuite.results.text import counted, duration, size_text
from qrlsuite.studies import looks

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

    Under an entry stand its groups of seeds that run, wait or stopped, from any machine that sees the folder. Entries
    of studies come last, the study before their task.
    Workers are not disturbed. Where seeds were submitted to a queue, the queue is asked whether it still has them.

    Examples: qrlsuite runs --task beam6g; qrlsuite runs rm "mlp width=64" --task beam6g
    """
    if context.invoked_subcommand is not None:
        action = context.invoked_subcommand
        for name in context.params:
            if is_typed(context, name):
                raise OptionError(
                    f"put options after the action: qrlsuite runs {action} --task TASK --runs DIR"
                )
        return
    if format_ == "csv" and json_output:
        raise OptionError("--format csv and --json: give one of them")
    statuses = survey(runs, task, [] if format_ == "csv" else looks.folders(runs))
    if format_ == "csv":
        typer.echo(csv_rows(progress_table(runs, statuses)), nl=False)
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
        *(_row(status, now) for status in statuses),
    ]
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    if sum(widths) + 2 * len(widths) > table_console(10_000).width:  # the label names the entry as well
        table, widths = [(row[0], *row[2:]) for row in table], [widths[0], *widths[2:]]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in table]
    typer.echo(lines[0])
    for line, entry_status in zip(lines[1:], statuses):
        typer.echo("\n".join([line, *map(printable, _unfinished(entry_status))]))


@app.command("gc")
def collect_garbage(
    task: TaskOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Remove them. Without this option they are only listed.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Remove the checkpoints of finished groups: curves and agents stay, but cannot be extended by more epochs.

    Example: qrlsuite runs gc --yes
    """
    task = lookup.task_name(runs, task)
    items, problems = garbage(runs, task)
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
        f"would remove {len(items)} checkpoint{'s' * (len(items) > 1)}, {size_text(total)}. Curves and "
        "trained agents stay, but these seeds cannot get more epochs afterwards. To remove them: "
        + command("runs", "gc", *(["--task", task] if task else []), "--yes", runs=runs)
    )


@app.command("rm")
def delete_entries(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY...",
            help="Its name or label, or the beginning of one, after [TASK/].",
            autocompletion=entries_here,
        ),
    ],
    task: TaskOption = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            metavar="'SEEDS reason=...'",
            help="Withdraw only these seeds, and delete their results; every verdict names the reason.",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Delete entries with all their seeds. It asks first, and deletes no entry that is being trained.

    Examples: qrlsuite runs rm "mlp width=64" --task beam6g; qrlsuite runs rm "mlp width=64" --task beam6g
    --seeds "6,18 reason='the disk failed'"
    """
    withdrawn = None if seeds is None else _withdrawn(seeds)
    chosen = choose(runs, names, task)
    for entry in chosen:
        description = (
            f"{entry.task}/{entry.name} ({entry.label}, {counted(sum(entry.seeds.values()), 'seed')})"
        )
        begin = f"seeds {format_seeds(withdrawn[0])} of" if withdrawn else f"{size_text(entry.size):>7} "
        typer.echo(f"{begin} {printable(description)}", err=json_output)
    if not yes and not typer.confirm("Delete this for good?", err=json_output):
        typer.echo("nothing was deleted", err=json_output)
        raise typer.Exit(1)
    if withdrawn is None:
        freed = delete_each(runs, chosen)
    else:
        freed = withdraw([EntryStore(entry.folder) for entry in chosen], *withdrawn)
    if json_output:
        rows = [{"task": entry.task, "entry": entry.name, "size": entry.size} for entry in chosen]
        typer.echo(json.dumps({"deleted": rows, "freed": freed}))
    else:
        typer.echo(f"deleted, {size_text(freed)} freed")


def _withdrawn(text: str) -> tuple[list[int], str]:
    """Read seeds that are no longer asked for, and the reason."""
    seeds, more = parse_named(text, "--seeds ")
    reason = str(more.get("reason", "")).strip()
    if set(more) - {"reason"} or not reason or not reason.isprintable() or len(reason) > 300:
        example = "--seeds \"6,18 reason='the disk failed'\""
        raise OptionError(f"--seeds {text}: give a reason, in one line, for example {example}")
    if seeds.isdecimal():  # elsewhere it is the first so many
        raise OptionError(
            f"--seeds {seeds}: write {seeds}:{int(seeds) + 1} for this seed, 0:{seeds} for so many"
        )
    return parse_seeds(seeds), reason


def _row(status: EntryStatus, now: float) -> tuple[str, ...]:
    entry = status.entry
    low, high = entry.epochs or (0, 0)
    return (
        printable(status.task),
        printable(entry.name),
        printable(entry.label),
        status.seeds,
        f"{low}" if low == high else f"{low} to {high}",
        size_text(entry.size),
        f"{duration(max(0.0, now - entry.last_activity))} ago",
    )


def _unfinished(status: EntryStatus) -> list[str]:
    """Return a line for each group of an entry that has not finished."""
    problem = status.queue_problem
    silent = [f"could not ask the queue, so seeds may have left it: {problem}"] if problem else []
    again = f"  continued by the same `qrlsuite {'study run' if status.study else 'run'}`"
    lines = (group.text + again * (group.state == "stopped") for group in status.groups)
    return [f"  {line}" for line in (*silent, *lines)]
