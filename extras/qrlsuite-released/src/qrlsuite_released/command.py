"""`qrlsuite import-released`: import result files of the paper's released code as an entry."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError
from qrlsuite.experiment.task import load
from qrlsuite.results.seeds import format_seeds
from qrlsuite_released.entries import import_files


def import_results(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Pickled result files, one per run.")
    ],
    task: Annotated[str, typer.Option("--task", help="The task on which the files were made.")],
    algorithm: Annotated[
        str | None,
        typer.Option("--algorithm", help="The algorithm that made the files; default: the task's."),
    ] = None,
    label: Annotated[
        str | None, typer.Option("--label", help="The entry's label; default: the name of the files' folder.")
    ] = None,
    quantum: Annotated[
        str | None,
        typer.Option(
            "--quantum", metavar="PATTERN", help="The model's tensors that belong to a circuit, as 'vqc.*'."
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Import released result files as the seeds of one entry, marked "(imported)" everywhere.

    A pickle is a program, and none is run: its instructions are listed, in a process with limited memory and time. A
    file that names what a released file does not need is refused. Files that were imported before are skipped.

    Example: qrlsuite import-released results/mlp/*.pkl --task beam6g --label "MLP of the paper"
    """
    loaded = load(task)
    name = (label if label is not None else files[0].absolute().parent.name).strip()
    if not name or len(name) > 80 or not name.isprintable():
        raise OptionError(f"--label {name!r}: one line of at most 80 characters")
    done = import_files(files, loaded, algorithm or loaded.file.default_algorithm, name, runs, quantum)
    if json_output:
        content = {
            "folder": str(done.store.path),
            "seeds": done.new,
            "known": done.known,
            "differing": done.differing,
        }
        typer.echo(json.dumps(content))
        return
    if done.known:
        typer.echo(f"{done.known} of {len(files)} files were imported before")
    if done.new:
        typer.echo(f"imported {len(done.new)} runs as seeds {format_seeds(done.new)} of {done.store.path}")
    if done.differing:
        typer.echo(
            f"note: the runs differ in their arguments {', '.join(done.differing)}: are they one entry?",
            err=True,
        )
    typer.echo(f"next: {command('leaderboard', '--task', loaded.name, runs=runs)}")
