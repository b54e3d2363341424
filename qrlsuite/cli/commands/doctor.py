"""`qrlsuite doctor`: test the installation, and print what a bug report needs."""

from __future__ import annotations

import dataclasses
import json
import textwrap
from pathlib import Path

import typer
from rich.console import Console
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import printable
from qrlsuite.installation.diagnosis import Diagnosis, diagnose
from qrlsuite.installation.report import rows

WIDTH = 100


def doctor(runs: RunsOption = Path("runs"), json_output: JsonOption = False) -> None:
    """Look at the installation, the machine, the plugins and the results folder, for a bug report.

    Imports every package that is needed and computes a circuit, which takes some seconds. Nothing is changed.

    Exit codes: 0 the suite can be used, 1 something that it needs is broken.

    Example: qrlsuite doctor > report.txt
    """
    with Console(stderr=True).status("") as status:
        diagnosis = diagnose(runs, lambda doing: status.update(Text(printable(doing))))
    if json_output:
        typer.echo(json.dumps({"ok": not diagnosis.broken, **dataclasses.asdict(diagnosis)}))
    else:
        _print(diagnosis)
    if diagnosis.broken:
        raise typer.Exit(1)


def _print(diagnosis: Diagnosis) -> None:

    home = str(Path.home())
    console = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    for name, text in rows(diagnosis.facts):
        full_line = printable(text.replace(home, "~") if len(home) > 1 else text)
        lines = textwrap.wrap(full_line, WIDTH - 14, break_long_words=False, break_on_hyphens=False) or ["-"]
        for number, line in enumerate(lines):
            console.print(f"{'' if number else printable(name):<13} {line}")
    console.print()
    for problem in diagnosis.broken:
        console.print(f"broken: {printable(problem)}", style="bold red")
    for remark in diagnosis.remarks:
        console.print(f"note: {printable(remark)}", style="yellow")
    if not diagnosis.broken:
        console.print("everything that is needed works", style="bold green")
