"""`qrlsuite plot`: pictures of what was trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.cli.app import RunsOption


def plot(
    kind: Annotated[str, typer.Argument(help="curves")],
    task: Annotated[
        str | None, typer.Option("--task", help="Needed where the folder holds several tasks.")
    ] = None,
    entry: Annotated[
        list[str] | None, typer.Option("--entry", help="Only these entries (name, or the beginning of it).")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--out", help="png, pdf or svg; default: TASK-KIND.png in the results folder."),
    ] = None,
    runs: RunsOption = Path("runs"),
) -> None:
    """Draw a picture from the results.

    Example: qrlsuite plot curves --task beam6g --out curves.pdf
    """
    from qrlsuite.errors import OptionError, UnknownNameError, nearest
    from qrlsuite.leaderboard import collect, pictures
    from qrlsuite.store import write_atomically

    if kind not in pictures.KINDS:
        raise UnknownNameError(f"unknown picture '{kind}'{nearest(kind, pictures.KINDS)}")
    found, refused = collect.collect(runs, task)
    for line in refused:
        typer.echo(f"left out: {line}", err=True)
    if entry:
        names = {collect.find(runs, word).name for word in entry}
        found = [e for e in found if e.name in names]
    tasks = sorted({e.task for e in found})
    if not found:
        raise UnknownNameError(
            f"{runs} holds no results{f' of task {task}' if task else ''} yet: qrlsuite run"
        )
    if len(tasks) > 1:
        raise OptionError(f"{runs} holds several tasks; choose one with --task {' or --task '.join(tasks)}")
    path = output or runs / f"{tasks[0]}-{kind}.png"
    format_ = path.suffix.removeprefix(".").lower()
    if format_ not in ("png", "pdf", "svg"):
        raise OptionError(f"--out {path}: the file's ending must be .png, .pdf or .svg")
    write_atomically(path, pictures.encode(pictures.draw(kind, found), format_))
    typer.echo(f"wrote {path}")
