"""`qrlsuite runs`: what the results folder holds; `qrlsuite runs gc`: remove checkpoints that are done with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption, TaskOption
from qrlsuite.cli.terminal import printable

if TYPE_CHECKING:
    from qrlsuite.results.survey import EntrySurvey


def runs(
    action: Annotated[
        str | None, typer.Argument(metavar="[gc]", help="gc: remove the checkpoints of finished groups.")
    ] = None,
    task: TaskOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="With gc: do it; without, it says what it would do.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """List what is there: task, entry, seeds by status, epochs, size on disk, last activity.

    Example: qrlsuite runs --task beam6g
    """
    from qrlsuite.errors import OptionError, nearest
    from qrlsuite.results import lookup

    lookup.check_tasks(runs, task)
    if action == "gc":
        _collect_garbage(runs, task, yes, json_output)
        return
    if action is not None:
        raise OptionError(f"`qrlsuite runs` has no action '{action}'{nearest(action, ['gc'])}")
    if yes:
        raise OptionError("--yes belongs to `qrlsuite runs gc`")
    _list(runs, task, json_output)


def size_text(size: int) -> str:
    """Write a number of bytes as people say it."""
    amount = float(size)
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if amount >= 10 or unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"


def _list(folder: Path, task: str | None, json_output: bool) -> None:
    import dataclasses
    import json
    import time

    from qrlsuite.results.survey import survey

    found = survey(folder, task)
    if json_output:
        rows = [{**dataclasses.asdict(entry), "folder": str(entry.folder)} for entry in found]
        typer.echo(json.dumps(rows))
        return
    for entry in found:
        for problem in entry.problems:
            typer.echo(f"damaged: {problem}", err=True)
    if not found:
        typer.echo(f"{folder} holds no entry{f' of task {task}' if task else ''} yet: qrlsuite run")
        return
    now = time.time()
    table = [
        ("task", "entry", "label", "seeds", "epochs", "size", "last activity"),
        *(_row(e, now) for e in found),
    ]
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    for row in table:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())


def _row(entry: EntrySurvey, now: float) -> tuple[str, ...]:
    from qrlsuite.cli.display import duration
    from qrlsuite.results.survey import STATUSES

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
    import json

    from qrlsuite.results.seeds import format_seeds
    from qrlsuite.results.survey import garbage, remove

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
