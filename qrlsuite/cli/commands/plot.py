"""`qrlsuite plot`: pictures of results and of a task's environment."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from qrlsuite.api.entries import draw_picture
from qrlsuite.cli.arguments import (
    EntryOption,
    HorizonOption,
    JsonOption,
    LabelOption,
    PublishedOption,
    RunsOption,
    split_settings,
)
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.pictures.compose import summaries
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.store import write_atomically


class PlotCommand(TyperCommand):
    """The command with the list of pictures at the end of its help."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write every kind of picture with one line."""
        with formatter.section("Kinds"):
            formatter.write_dl(list(summaries().items()))


def plot(
    kind: Annotated[str, typer.Argument(help="Kind of picture; the kinds are listed below.")],
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME=VALUE",
            help="Settings of the picture (`qrlsuite show picture KIND` lists them); environment.NAME: of the task.",
        ),
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option(
            "--task",
            help="The task, if the folder holds several; repeat --task for a picture of several tasks.",
        ),
    ] = None,
    entry: EntryOption = None,
    label: LabelOption = None,
    study: Annotated[
        list[str] | None,
        typer.Option(
            "--study",
            help="A picture that this study names, or a picture of its entries; `pairs` and `entries`, too, if it "
            "has looks. Repeat it for the pairs that several studies with looks compare, each on another task.",
        ),
    ] = None,
    horizon: HorizonOption = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            help="Only these seeds of every entry, 30 or 0:30. Entries that lack one are left out: sample "
            "complexities of 30 and of 100 runs are not comparable.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="png, pdf or svg; default: TASK-KIND.png, in the results folder if it shows results.",
        ),
    ] = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Draw a picture from the results, or of a task's environment.

    All entries of a picture are cut to the shortest. An entry that ends before the others is left out, and named,
    unless --entry asks for it.

    Examples: qrlsuite plot bars --task beam6g --out bars.pdf; qrlsuite plot surface style=3d;
    qrlsuite plot trajectories environment.degree=5 --task beam6g; qrlsuite plot scaling --study fig7 --published;
    qrlsuite plot pairs --study quantum-or-not
    """
    format_ = pictures.format_of(output)
    picture_settings, environment_settings = _split(settings or [])
    drawn = draw_picture(
        kind,
        Selection.create(runs, task, published, label),
        entry or [],
        study or [],
        horizon=horizon,
        seeds=seeds,
        settings=picture_settings,
        environment=environment_settings,
    )
    for line in drawn.left_out:
        typer.echo(f"left out: {line}", err=True)
    shown = [f"study-{Path(study[0]).stem}"] if study else drawn.tasks
    name = f"{'-'.join(shown)}-{kind}.png".removeprefix("-")
    path = output or (runs / name if drawn.entries or study else Path(name))
    write_atomically(path, pictures.encode(drawn.figure, format_))
    if json_output:
        counts = {e.name: len(e.seeds) for e in drawn.entries}
        typer.echo(json.dumps({"picture": str(path), "kind": kind, "seeds": counts}))
    else:
        typer.echo(f"wrote {path}")


def _split(words: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Divide `NAME=VALUE` words into the picture's settings and the environment's options."""
    names, settings = split_settings(words)
    if names:
        raise OptionError(f"{names[0]}: write settings of the picture as NAME=VALUE")
    picture: dict[str, Any] = {}
    environment: dict[str, Any] = {}
    for full_name, value in settings.items():
        side, dot, name = full_name.rpartition(".")
        if dot and side not in ("environment", "picture"):
            raise OptionError(
                f"{full_name}: write {name}=... for the picture or environment.{name}=... for the task's environment"
            )
        (environment if side == "environment" else picture)[name] = value
    return picture, environment
