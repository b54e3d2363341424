"""`qrlsuite demo`: a first comparison, command by command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.app import build
from qrlsuite.cli.arguments import RunsOption
from qrlsuite.engine.terminal import command
from qrlsuite.errors import QrlSuiteError

MODELS = ("mlp", "vqc-pennylane")


def demo(
    minutes: Annotated[
        float, typer.Option("--minutes", min=0, help="Time for the training of each model.")
    ] = 2,
    runs: RunsOption = Path("runs"),
) -> None:
    """Train a small network and a small circuit on beam6g, draw their learning curves, and rank them.

    It takes about five minutes, and prints each command before it runs it. Stop with Ctrl-C at any time; the same
    command continues.

    Example: qrlsuite demo
    """
    for model in MODELS:
        budget = ("--quick", "--epochs", "5", "--minutes", f"{minutes:g}")
        if _do("run", "--task", "beam6g", "--model", model, *budget, runs=runs):
            raise typer.Exit(130)  # Ctrl-C
    picture = ("plot", "curves", "--task", "beam6g")
    try:
        _do(*picture, *(word for model in MODELS for word in ("--entry", model)), runs=runs)
    except QrlSuiteError as error:  # within its time a busy machine may not have finished an epoch of both
        again = command("demo", runs=runs)
        typer.echo(f"{error}\nshowing what there is; to train on, type {again}", err=True)
        _do(*picture, runs=runs)
    _do("leaderboard", "--task", "beam6g", runs=runs)


def _do(*words: str, runs: Path) -> int | None:
    """Print a command and run it; returns its exit code, None for 0."""
    typer.echo(f"\n$ {command(*words, runs=runs)}", err=True)
    code: int | None = build()([*words, "--runs", str(runs)], prog_name="qrlsuite", standalone_mode=False)
    return code
