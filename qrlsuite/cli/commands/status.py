"""`qrlsuite status`: show the progress of everything that is unfinished."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption, TaskOption
from qrlsuite.engine.status import survey
from qrlsuite.engine.terminal import printable
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import duration


def status(
    task: TaskOption = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show what is running, waiting and stopped, from any machine that sees the results folder.

    Reads the results folder, and disturbs no worker. Where seeds were submitted to a queue, the queue is asked
    whether it still has them.

    Example: qrlsuite status --task beam6g
    """
    rows = [store_status.as_dict() for store_status in survey(runs, task)]
    if json_output:
        typer.echo(json.dumps(rows))
        return
    for row in rows:
        _print(row)
    if not rows:
        typer.echo(f"{runs} holds no entry{f' of task {task}' if task else ''} yet: qrlsuite run")


def _print(row: dict[str, Any]) -> None:
    """Print an entry and its groups, a line each."""
    seeds = ", ".join(f"{count} {status}" for status, count in row["seeds"].items()) or "none"
    typer.echo(printable(f"{row['task']}  {row['label']}  ({row['entry']}): {seeds}"))
    for problem in row["problems"]:
        typer.echo(f"  damaged: {printable(problem)}")
    if row["queue_problem"]:
        typer.echo(
            f"  what was submitted may have left the queue, which was not asked: {printable(row['queue_problem'])}"
        )
    for group in row["groups"]:
        parts = [f"  {group['state']:<9}"]
        parts += [f"seeds {format_seeds(group['seeds'])}"] if group["seeds"] else []
        parts += [f"epoch {group['epoch']}/{group['epochs']}"] if group["epochs"] else []
        parts += [str(group["phase"])] if group["phase"] and group["state"] == "running" else []
        if isinstance(group["median_score"], int | float):
            parts.append(f"median score {group['median_score']:.3f}")
        if group["seconds_left"] is not None and group["state"] == "running":
            parts.append(f"{duration(group['seconds_left'])} left")
        parts += [group["where"]] if group["where"] != "nobody" else []
        parts += ["continued by the same `qrlsuite run`"] if group["state"] == "stopped" else []
        parts += [str(group["error"])] if group["error"] else []
        typer.echo(printable("  ".join(parts)))
