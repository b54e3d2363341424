"""`qrlsuite plot`: pictures of what was trained, of a task's environment, and of the estimator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from qrlsuite.cli.arguments import (
    EntryOption,
    HorizonOption,
    JsonOption,
    MinSeedsOption,
    PublishedOption,
    RunsOption,
)
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.pictures.compose import compose, settings_of, summaries
from qrlsuite.options import parse_setting
from qrlsuite.results.store import write_atomically


class PlotCommand(TyperCommand):
    """The command with the list of pictures at the end of its help."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write every kind of picture with one line."""
        with formatter.section("Kinds"):
            formatter.write_dl(list(summaries().items()))


def plot(
    kind: Annotated[str, typer.Argument(help="What to draw; the kinds are listed below.")],
    task: Annotated[
        list[str] | None,
        typer.Option(
            "--task",
            help="The task, if the folder holds several; repeat --task for a picture of several tasks.",
        ),
    ] = None,
    entry: EntryOption = None,
    horizon: HorizonOption = None,
    min_seeds: MinSeedsOption = 1,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            help="Only these seeds of every entry, 30 or 0:30: the sample complexity of 30 runs is another quantity "
            "than that of 100.",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="A setting of the picture; environment.NAME: of the task."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="png, pdf or svg; default: TASK-KIND.png, in the results folder where it shows results.",
        ),
    ] = None,
    list_settings: Annotated[
        bool, typer.Option("--settings", help="List the settings of this kind, and draw nothing.")
    ] = False,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Draw a picture from the results, or of a task's environment.

    All entries of a picture are cut to the shortest. An entry that ends before the others is left out, and named,
    unless --entry asks for it.

    Examples: qrlsuite plot bars --task beam6g --out bars.pdf; qrlsuite plot surface --set style=3d;
    qrlsuite plot trajectories --task beam6g --set environment.degree=5
    """
    if list_settings:
        _print_settings(kind, settings_of(kind, task or []), json_output)
        return
    format_ = pictures.format_of(output)
    picture_settings, environment_settings = _split(settings or [])
    drawn = compose(
        kind,
        task or [],
        entry or [],
        horizon=horizon,
        min_seeds=min_seeds,
        seeds=seeds,
        runs=runs,
        published=published,
        settings=picture_settings,
        environment=environment_settings,
    )
    for line in drawn.left_out:
        typer.echo(f"left out: {line}", err=True)
    name = f"{'-'.join(drawn.tasks)}-{kind}.png".removeprefix("-")
    path = output or (runs / name if drawn.entries else Path(name))
    write_atomically(path, pictures.encode(drawn.figure, format_))
    if json_output:
        counts = {e.name: len(e.seeds) for e in drawn.entries}
        typer.echo(json.dumps({"picture": str(path), "kind": kind, "seeds": counts}))
    else:
        typer.echo(f"wrote {path}")


def _split(settings: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Divide `--set` words into the picture's settings and the environment's options."""
    picture: dict[str, Any] = {}
    environment: dict[str, Any] = {}
    for setting in map(parse_setting, settings):
        if setting.side not in (None, "environment", "picture"):
            raise OptionError(
                f"--set {setting.side}.{setting.name}: write {setting.name}=... for the picture or "
                f"environment.{setting.name}=... for the task's environment"
            )
        (environment if setting.side == "environment" else picture)[setting.name] = setting.value
    return picture, environment


def _print_settings(kind: str, rows: list[dict[str, Any]], json_output: bool) -> None:
    if json_output:
        typer.echo(json.dumps(rows))
        return
    typer.echo(
        f"settings of '{kind}' (change with --set NAME=VALUE)" if rows else f"'{kind}' has no settings"
    )
    for row in rows:
        typer.echo(f"  {row['name']} = {json.dumps(row['default'])}    {row['values']}")
        typer.echo(f"      {row['description']}")
