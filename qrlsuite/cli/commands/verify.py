"""`qrlsuite leaderboard verify`: check published entries."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption
from qrlsuite.leaderboard import published
from qrlsuite.leaderboard import verify as checks
from qrlsuite.results.progress import Progress as RunProgress


def verify(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[PATH]...", help="Entries, or folders of entries; default: those of the suite."
        ),
    ] = None,
    rerun: Annotated[int, typer.Option("--rerun", min=0, help="Seeds of each entry to train again.")] = 0,
    choice: Annotated[
        int | None,
        typer.Option(
            "--choice",
            min=0,
            help="The number that an earlier check printed, to choose the same seeds again.",
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Check published entries, and train some of their seeds again.

    Files: hashes, names and labels are computed again; every seed must have every epoch, and scores in range.
    With --rerun K, K seeds of each entry, chosen at random, are trained from nothing. On the same type of machine
    and the same versions their curves must be equal. Elsewhere initial parameters, first episodes and the score
    before training must agree to 1e-5, and final scores must be plausible members of the entry (rank test,
    p > .01). The report says which check was made. Exit code 1 if an entry fails.

    Example: qrlsuite leaderboard verify leaderboard/entries --rerun 2
    """
    folders = [folder for path in paths or published.folders() for folder in checks.find(path)]
    number = secrets.randbelow(10**9) if choice is None else choice
    verdicts = []
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        whole = bar.add_task("", total=len(folders))
        for index, folder in enumerate(folders):

            def report(progress: RunProgress, index: int = index) -> None:
                bar.update(whole, completed=index + progress.epoch / max(1, progress.epochs))

            bar.update(whole, description=Text(folder.name).plain, completed=index)
            generator = np.random.default_rng([number, index])
            verdicts.append(checks.verify(folder, rerun, generator, report))
            if not json_output:
                last = verdicts[-1]
                typer.echo(f"{'ok    ' if last.ok else 'FAILED'} {last.name}: {last.message}")
    if json_output:
        typer.echo(json.dumps({"choice": number, "entries": [verdict.as_dict() for verdict in verdicts]}))
    else:
        good = sum(verdict.ok for verdict in verdicts)
        again = f"; the same seeds again: --choice {number}" if rerun else ""
        typer.echo(f"{good} of {len(verdicts)} entries ok{again}")
    if not all(verdict.ok for verdict in verdicts):
        raise typer.Exit(1)
