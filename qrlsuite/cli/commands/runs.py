"""`qrlsuite runs`: list the results folder; `runs gc` removes checkpoints no longer needed, `runs rm` entries."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption, TaskOption
from qrlsuite.engine.api import Queues
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import OptionError, nearest
from qrlsuite.results import lookup
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import entries
from qrlsuite.results.survey import STATUSES, EntrySurvey, delete, garbage, look, remove, survey
from qrlsuite.results.text import duration, size_text


def runs(
    action: Annotated[
        str | None,
        typer.Argument(
            metavar="[gc|rm]", help="gc: remove the checkpoints of finished groups. rm: delete entries."
        ),
    ] = None,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENTRY]...", help="For rm: its name or label, or the beginning of one, after [TASK/]."
        ),
    ] = None,
    task: TaskOption = None,
    yes: Annotated[
        bool,
        typer.Option(
            "--yes",
            help="With gc: remove; without --yes, gc only lists. With rm: do not ask for confirmation.",
        ),
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """List the results folder: task, entry, seeds by status, epochs, size on disk, last activity.

    `rm` asks before it deletes, and deletes no entry that is being trained.

    Examples: qrlsuite runs --task beam6g; qrlsuite runs rm "mlp width=64" --task beam6g
    """
    lookup.check_tasks(runs, task)
    if action == "rm":
        _delete(runs, task, names or [], yes, json_output)
        return
    if names:
        raise OptionError(f"`qrlsuite runs {action}` takes no entry: leave '{names[0]}' out")
    if action == "gc":
        _collect_garbage(runs, task, yes, json_output)
        return
    if action is not None:
        raise OptionError(f"`qrlsuite runs` has no action '{action}'{nearest(action, ['gc', 'rm'])}")
    if yes:
        raise OptionError("--yes belongs to `qrlsuite runs gc` and `qrlsuite runs rm`")
    _list(runs, task, json_output)


def _list(folder: Path, task: str | None, json_output: bool) -> None:

    summaries = survey(folder, task)
    if json_output:
        rows = [{**dataclasses.asdict(entry), "folder": str(entry.folder)} for entry in summaries]
        typer.echo(json.dumps(rows))
        return
    for entry in summaries:
        for problem in entry.problems:
            typer.echo(f"damaged: {problem}", err=True)
    if not summaries:
        typer.echo(f"{folder} holds no entry{f' of task {task}' if task else ''} yet: qrlsuite run")
        return
    now = time.time()
    table = [
        ("task", "entry", "label", "seeds", "epochs", "size", "last activity"),
        *(_row(e, now) for e in summaries),
    ]
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    for row in table:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())


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


def _collect_garbage(folder: Path, task: str | None, yes: bool, json_output: bool) -> None:

    items, problems = garbage(folder, task)
    total = sum(item.size for item in items)
    freed = remove(items) if yes else 0
    if json_output:
        rows = [{"folder": str(item.folder), "seeds": item.seeds, "size": item.size} for item in items]
        typer.echo(json.dumps({"groups": rows, "size": total, "freed": freed, "problems": problems}))
        return
    for problem in problems:
        typer.echo(f"left alone: {problem}", err=True)
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

    if not names:
        raise OptionError("name the entries to delete: qrlsuite runs lists them")
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
