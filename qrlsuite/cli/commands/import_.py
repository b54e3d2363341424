"""`qrlsuite import`: take over seeds trained elsewhere, and learning curves of other programs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.shelf import external, importing, published_studies
from qrlsuite.leaderboard.shelf.importing import Imported
from qrlsuite.results import points
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import counted


def import_entries(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="PATH...",
            help="Results folders, folders that `export` wrote, or entries' folders in them. Or files with the curves "
            "of other programs: csv (entry,seed,step,score), monitor.csv or evaluations.npz of Stable-Baselines3, "
            "event files of TensorBoard, *.wandb.",
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(
            "--task", help="Of files: a task of the suite, or the name of a new one; default: external."
        ),
    ] = None,
    maximum: Annotated[
        float | None,
        typer.Option(
            "--maximum",
            metavar="BEST",
            help="Of files: the best possible score; scores become fractions of it.",
        ),
    ] = None,
    thresholds: Annotated[
        str | None,
        typer.Option(
            "--thresholds", metavar="A,B,...", help="Of files: scores that count as reached, for a new task."
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(
            "--every",
            metavar="STEPS",
            help="Of files: environment steps between grid points, for a new task.",
        ),
    ] = None,
    metric: Annotated[
        str | None,
        typer.Option("--metric", metavar="NAME", help="Of files: the column or scalar that is the score."),
    ] = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Take over seeds that were trained elsewhere: they count as trained here, and `run` trains only what is missing.

    From a results folder, agents and checkpoints are copied too, from an export the agents that it has. Seeds that
    are here already stay. Stop with Ctrl-C at any time; the same command continues.

    Curves of other programs become external entries, which can be compared and drawn as any. At every grid point
    stands the last score at or before it. A path names a run: logs/small/seed-3/evaluations.npz is seed 3 of `small`.

    Examples: qrlsuite import /mnt/cluster/runs; qrlsuite import curves.csv --maximum 500
    """
    files = [path for path in paths if not path.is_dir()]
    of_files = {
        "--task": task,
        "--maximum": maximum,
        "--thresholds": thresholds,
        "--every": every,
        "--metric": metric,
    }
    if files and len(files) < len(paths):
        raise OptionError("import folders and files by commands of their own")
    if not files and (given := [name for name, value in of_files.items() if value is not None]):
        raise OptionError(
            f"{given[0]} is for files with curves; a folder of this suite says it itself: leave it out"
        )
    if files:
        found = points.read_files(files, metric)
        taken = external.import_points(found, runs, task, maximum, _numbers(thresholds), every)
    done = []
    for each in taken if files else (each for path in paths for each in _taken(path, runs)):
        done.append(each)
        if json_output:
            continue
        new = f"imported seeds {format_seeds(each.new)}" if each.new else "nothing new"
        known = f", {counted(len(each.known), 'seed')} here already" if each.known else ""
        typer.echo(f"{each.label} on {each.task}: {new}{known}")
        for note in each.notes:
            typer.echo(f"  note: {note}", err=True)
    if json_output:
        typer.echo(json.dumps({"entries": [each.as_dict() for each in done]}))
    elif files:
        for line in external.told(done):
            typer.echo(line)
        typer.echo(f"next: {command('leaderboard', '--task', done[0].task, runs=runs)}")
    else:
        typer.echo(f"next: {command('runs', runs=runs)}")


def _taken(folder: Path, runs: Path) -> Iterator[Imported]:
    if published_studies.is_published(folder):
        yield from published_studies.import_study(folder, runs)
    else:
        yield from (importing.import_seeds(source, runs) for source in importing.sources(folder))


def _numbers(text: str | None) -> Sequence[float]:
    """Read the numbers of `--thresholds`."""
    try:
        return [float(word) for word in text.split(",")] if text is not None else []
    except ValueError:
        raise OptionError(f"--thresholds {text}: write numbers, such as --thresholds 100,200") from None
