"""`qrlsuite import`: import seeds that were trained elsewhere."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import command
from qrlsuite.leaderboard.shelf import importing, published_studies
from qrlsuite.leaderboard.shelf.importing import Imported
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import counted


def _taken(folder: Path, runs: Path) -> Iterator[Imported]:
    if published_studies.is_published(folder):
        yield from published_studies.import_study(folder, runs)
    else:
        yield from (importing.import_seeds(source, runs) for source in importing.sources(folder))


def import_entries(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="A results folder, a folder that `export` wrote, or one entry's folder in it.",
        ),
    ],
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Take over seeds that were trained elsewhere: they count as trained here, and `run` trains only what is missing.

    From a results folder, agents and checkpoints are copied too, from an export the agents that it has. Seeds that
    are here already stay. Stop with Ctrl-C at any time; the same command continues.

    Example: qrlsuite import /mnt/cluster/runs
    """
    done = []
    for taken in _taken(folder, runs):
        done.append(taken)
        if json_output:
            continue
        new = f"imported seeds {format_seeds(taken.new)}" if taken.new else "nothing new"
        known = f", {counted(len(taken.known), 'seed')} here already" if taken.known else ""
        label = f"{taken.entry.label} {taken.store.mark}".rstrip()
        typer.echo(f"{label} on {taken.entry.task.name}: {new}{known}")
        for note in taken.notes:
            typer.echo(f"  note: {note}", err=True)
    if json_output:
        typer.echo(json.dumps({"entries": [taken.as_dict() for taken in done]}))
    else:
        typer.echo(f"next: {command('runs', runs=runs)}")
