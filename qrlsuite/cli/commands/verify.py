"""`qrlsuite leaderboard verify`: check published entries."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard import plans, published
from qrlsuite.leaderboard import verify as checks
from qrlsuite.leaderboard.changed import changed
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
    base: Annotated[
        str | None,
        typer.Option(
            "--base",
            metavar="REV",
            help="Check what of leaderboard/ differs from this git commit, entries and plans, in place of PATH.",
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Check published entries and plans, and train some of their seeds again.

    Files: hashes, names and labels are computed again; every seed must have every epoch, and scores in range.
    With --rerun K, K seeds of each entry, chosen at random, are trained from nothing. On the same type of machine
    and the same versions their curves must be equal. Elsewhere initial parameters, first episodes and the score
    before training must agree to 1e-5, and final scores must be plausible members of the entry (rank test,
    p > .01). The report says which check was made. Exit code 1 if an entry fails.

    With --base REV, what is checked are the entries and plans of the repository around this folder, below
    leaderboard/, that differ from a commit or are not committed; a file with a name that no published file has is
    refused.

    Example: qrlsuite leaderboard verify leaderboard/entries --rerun 2
    """
    if base is not None and paths:
        raise OptionError("give PATH or --base, not both")
    given = list(paths or published.folders())
    plan_folders = [path for path in given if plans.is_published(path)]
    if base is not None:
        given, plan_folders = changed(base, Path.cwd())
    folders = [folder for path in given for folder in checks.find(path)]
    checked_plans = [_plan(folder) for folder in plan_folders]
    if not json_output:
        for plan in checked_plans:
            _say(plan["ok"], plan["plan"], plan["message"])
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
                _say(verdicts[-1].ok, verdicts[-1].name, verdicts[-1].message)
    if json_output:
        content = {"choice": number, "entries": [v.as_dict() for v in verdicts], "plans": checked_plans}
        typer.echo(json.dumps(content))
    elif base is not None and not folders:
        typer.echo(f"no entry differs from {printable(base)}")
    else:
        good = sum(verdict.ok for verdict in verdicts)
        again = f"; the same seeds again: --choice {number}" if rerun else ""
        typer.echo(f"{good} of {len(verdicts)} entries ok{again}")
    if not all([*(verdict.ok for verdict in verdicts), *(plan["ok"] for plan in checked_plans)]):
        raise typer.Exit(1)


def _say(ok: bool, name: str, message: str) -> None:
    typer.echo(f"{'ok    ' if ok else 'FAILED'} {printable(f'{name}: {message}')}")


def _plan(folder: Path) -> dict[str, Any]:
    """Read a published plan, and say what is wrong with it."""
    try:
        outcome = plans.read(folder)
    except QrlSuiteError as error:
        return {"plan": folder.name, "folder": str(folder), "ok": False, "message": str(error)}
    message = f"plan sound: {len(outcome.pairs)} pairs, its verdicts computed again"
    return {"plan": folder.name, "folder": str(folder), "ok": True, "message": message}
