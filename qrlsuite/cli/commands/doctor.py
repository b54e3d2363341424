"""`qrlsuite doctor`: test the installation, and print the facts for a bug report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import typer
from rich.console import Console
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import printable
from qrlsuite.installation import diagnose


def doctor(runs: RunsOption = Path("runs"), json_output: JsonOption = False) -> None:
    """Test the installation, the plugins and the results folder, and print the facts for a bug report.

    Imports every package that is needed and computes a circuit, which takes some seconds. Nothing is changed.

    Exit codes: 0 the suite can be used, 1 something that it needs is broken.

    Example: qrlsuite doctor > report.txt
    """
    with Console(stderr=True).status("") as status:
        diagnosis = diagnose(runs, lambda step: status.update(Text(printable(step))))
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
            typer.secho("everything that is needed works", fg="green", bold=True)
    if diagnosis.broken:
        raise typer.Exit(1)
