"""`qrlsuite export`: entries in the form in which they are published."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption, TaskOption
from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard import collect
from qrlsuite.leaderboard.export import export as write
from qrlsuite.results import lookup
from qrlsuite.results.text import counted


def export(
    entries: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ENTRY]...", help="Names or labels, [TASK/] before them, or the beginnings."),
    ] = None,
    task: TaskOption = None,
    everything: Annotated[bool, typer.Option("--all", help="Every complete entry of the folder.")] = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to: DIR/TASK/ENTRY/.")] = Path(
        "leaderboard/entries"
    ),
    force: Annotated[
        bool, typer.Option("--force", help="Replace an entry with more seeds or epochs.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Write entries for a leaderboard: curves of every seed, and how they were made, in less than 200 kB each.

    Only finished seeds are written. `qrlsuite leaderboard verify` checks what was written, and can train some
    seeds again.

    Example: qrlsuite export "mlp width=64" --out leaderboard/entries
    """
    if everything == bool(entries):
        raise OptionError("name the entries to export, or say --all: qrlsuite runs lists them")
    lookup.check_tasks(runs, task)
    if everything:
        found, refused = collect.collect(runs, task)
        for line in refused:
            typer.echo(f"left out: {line}", err=True)
    else:
        found = [
            collect.find(runs, name, tasks=[task] if task else []) for name in dict.fromkeys(entries or [])
        ]
    written = []
    for entry in found:
        try:
            folder = write(entry, out, force)
        except QrlSuiteError as error:
            if not everything:
                raise
            typer.echo(f"left out: {error}", err=True)
            continue
        size = sum(path.stat().st_size for path in folder.iterdir())
        written.append(
            {
                "task": entry.task,
                "entry": entry.name,
                "label": entry.label,
                "folder": str(folder),
                "seeds": len(entry.seeds),
                "bytes": size,
            }
        )
        if not json_output:
            typer.echo(f"wrote {folder} ({counted(len(entry.seeds), 'seed')}, {size / 1000:.0f} kB)")
    if not written:
        raise QrlSuiteError(f"{runs} holds no complete entry: qrlsuite runs --runs {runs} says what is there")
    if json_output:
        typer.echo(json.dumps(written))
    else:
        typer.echo(f"next: {command('leaderboard', 'verify', str(out), '--rerun', '2')}")
