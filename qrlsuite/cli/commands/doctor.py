"""`qrlsuite doctor`: print the facts for a bug report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import typer

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import printable
from qrlsuite.installation import diagnose


def doctor(runs: RunsOption = Path("runs"), json_output: JsonOption = False) -> None:
    """Print the facts for a bug report: versions, devices, plugins, the compile cache, and the results folder.

    Exit codes: 0 nothing is missing, 1 something that the suite needs is missing or broken.

    Example: qrlsuite doctor > report.txt
    """
    diagnosis = diagnose(runs)
    if json_output:
        typer.echo(json.dumps({"ok": not diagnosis.broken, **dataclasses.asdict(diagnosis)}))
    else:
        home = str(Path.home())
        for name, text in diagnosis.facts.items():
            typer.echo(f"{name:<10} {printable(text.replace(home, '~') if len(home) > 1 else text)}")
        for problem in diagnosis.broken:
            typer.secho(f"broken: {printable(problem)}", fg="red", bold=True)
        for remark in diagnosis.remarks:
            typer.secho(f"note: {printable(remark)}", fg="yellow")
        if not diagnosis.broken:
            typer.secho("nothing is missing", fg="green", bold=True)
    if diagnosis.broken:
        raise typer.Exit(1)
