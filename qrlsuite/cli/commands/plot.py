"""`qrlsuite plot`: pictures of what was trained, of a task's environment, and of the estimator."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from matplotlib.figure import Figure
from typer.core import TyperCommand

from qrlsuite import options, registry, specs
from qrlsuite.cli.arguments import (
    EntryOption,
    HorizonOption,
    JsonOption,
    MinSeedsOption,
    PublishedOption,
    RunsOption,
)
from qrlsuite.errors import OptionError, PluginError, UnknownNameError, nearest
from qrlsuite.experiment import task as task_files
from qrlsuite.leaderboard import collect, pictures
from qrlsuite.leaderboard.curves import EntryCurves
from qrlsuite.options import parse_setting
from qrlsuite.results import lookup
from qrlsuite.results.store import write_atomically
from qrlsuite.specs import EnvironmentSpec, PictureSpec


class Command(TyperCommand):
    """The command with the list of pictures at the end of its help."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write every kind of picture with one line."""
        with formatter.section("Kinds"):
            formatter.write_dl(list(_summaries().items()))


def plot(
    kind: Annotated[str, typer.Argument(help="What to draw; the kinds are listed below.")],
    task: Annotated[
        list[str] | None,
        typer.Option(
            "--task", help="Which task, where there are several; more than one where a picture can."
        ),
    ] = None,
    entry: EntryOption = None,
    horizon: HorizonOption = None,
    min_seeds: MinSeedsOption = 1,
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

    Entries that would cut the others to their own length are left out and named, unless --entry names them.

    Examples: qrlsuite plot bars --task beam6g --out bars.pdf; qrlsuite plot surface --set style=3d;
    qrlsuite plot trajectories --task beam6g --set environment.degree=5
    """
    spec = _lookup(kind, task or [])
    reference = pictures.KINDS[kind].options if spec is None else spec.options
    if list_settings:
        _print_settings(kind, options.describe(specs.resolve(reference)), json_output)
        return
    format_ = output.suffix.removeprefix(".").lower() if output is not None else "png"
    if format_ not in pictures.FORMATS:
        raise OptionError(f"--out {output}: the file's ending must be .png, .pdf or .svg")
    own, world = _split(settings or [])
    found: list[EntryCurves] = []
    if spec is not None:
        figure, name, folder = (
            _of_environment(kind, spec, task or [], own, world),
            "-".join(task or []),
            Path(),
        )
    else:
        if world:
            raise OptionError(
                f"--set environment.{next(iter(world))}: picture '{kind}' shows what was trained"
            )
        of = pictures.KINDS[kind].of
        if of == "episodes":
            raise OptionError(f"picture '{kind}' is drawn by: qrlsuite evaluate ENTRY --out {kind}.png")
        given = {"--task": task, "--entry": entry, "--horizon": horizon, "--min-seeds": min_seeds > 1}
        if of == "nothing" and any(given.values()):
            name = next(name for name, value in given.items() if value)
            raise OptionError(f"picture '{kind}' shows no results: leave {name} out")
        if of == "entries":
            cuts = "horizon" in options.field_names(specs.resolve(reference))
            if cuts and horizon is not None:
                own.setdefault("horizon", horizon)
            found = _entries(runs, published, task or [], entry or [], horizon, min_seeds, cuts)
        figure = pictures.draw(kind, found, **own)
        name, folder = ("-".join(dict.fromkeys(e.task for e in found)), runs) if found else ("", Path())
    path = output or folder / f"{name}-{kind}.png".removeprefix("-")
    write_atomically(path, pictures.encode(figure, format_))
    if json_output:
        seeds = {e.name: len(e.seeds) for e in found}
        typer.echo(json.dumps({"picture": str(path), "kind": kind, "seeds": seeds}))
    else:
        typer.echo(f"wrote {path}")


def _environment_pictures() -> dict[str, dict[str, PictureSpec]]:
    """Return the pictures that environments bring: by picture, then by environment."""
    found: dict[str, dict[str, PictureSpec]] = {}
    for registered in registry.load().entries["environments"].values():
        spec = cast(EnvironmentSpec, registered.spec)
        for picture in spec.pictures:
            found.setdefault(picture.name, {})[spec.name] = picture
    return found


def _summaries() -> dict[str, str]:
    """Return one line for every picture; those of environments say of which."""
    lines = {name: picture.summary for name, picture in pictures.KINDS.items()}
    for name, owners in _environment_pictures().items():
        summary = next(iter(owners.values())).summary
        lines.setdefault(name, f"{summary} (tasks of {', '.join(owners)})")
    return lines


def _lookup(kind: str, tasks: list[str]) -> PictureSpec | None:
    """Return the environment's picture of that name, None for one of the suite's own kinds."""
    if kind in pictures.KINDS:
        return None
    owners = _environment_pictures().get(kind)
    if owners is None:
        raise UnknownNameError(f"unknown picture '{kind}'{nearest(kind, _summaries())}")
    if not tasks:
        if len(owners) == 1:
            return next(iter(owners.values()))
        raise OptionError(f"several environments have a picture '{kind}': choose one with --task TASK")
    environment = task_files.load(tasks[0]).environment.name
    if environment not in owners:
        raise OptionError(
            f"picture '{kind}' shows tasks of {', '.join(owners)}; '{tasks[0]}' is a task of {environment}"
        )
    return owners[environment]


def _of_environment(
    kind: str, spec: PictureSpec, tasks: list[str], own: dict[str, Any], world: dict[str, Any]
) -> Figure:
    """Draw a picture that an environment brings, of one or several tasks."""
    if not tasks:
        raise OptionError(f"picture '{kind}' shows the environment of a task: add --task TASK")
    loaded = [task_files.load(name).with_environment(world) for name in tasks]
    if len({task.environment.name for task in loaded}) > 1:
        raise OptionError(f"picture '{kind}': {' and '.join(tasks)} have different environments")
    chosen = options.build(specs.resolve(spec.options), own, f"picture '{kind}'")
    figure = specs.resolve(spec.draw)({task.name: task.environment_options for task in loaded}, chosen)
    if not isinstance(figure, Figure):
        raise PluginError(
            f"picture '{kind}' of environment '{loaded[0].environment.name}' returned {type(figure).__name__}, "
            "not a matplotlib.figure.Figure"
        )
    return figure


def _split(words: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Divide `--set` words into the picture's settings and the environment's options."""
    own: dict[str, Any] = {}
    world: dict[str, Any] = {}
    for setting in map(parse_setting, words):
        if setting.side not in (None, "environment", "picture"):
            raise OptionError(
                f"--set {setting.side}.{setting.name}: write {setting.name}=... for the picture or "
                f"environment.{setting.name}=... for the task's environment"
            )
        (world if setting.side == "environment" else own)[setting.name] = setting.value
    return own, world


def _entries(
    runs: Path,
    shipped: bool,
    tasks: list[str],
    names: list[str],
    horizon: int | None,
    min_seeds: int,
    cuts: bool,
) -> list[EntryCurves]:
    """Return the entries to draw: those named, in that order, else all of the task, the smallest model first.

    Parameters
    ----------
    cuts:
        Whether the picture cuts all entries to one length.
    """
    lookup.check_tasks(runs, *tasks)
    found, left_out = collect.select(runs, tasks, names, shipped, horizon, min_seeds)
    if not names:
        found.sort(key=lambda e: (e.model, sum(e.parameters), e.label))
        found = [replace(entry, color=place) for place, entry in enumerate(found)]
        if cuts:
            found, short = collect.equally_long(found)
            left_out += short
    for line in left_out:
        typer.echo(f"left out: {line}", err=True)
    held = sorted({e.task for e in found})
    if not found:
        wanted = f" of task {' or '.join(tasks)}" if tasks else ""
        raise UnknownNameError(
            f"{runs} holds no results{wanted} yet: qrlsuite run; --published draws those that come with the suite"
        )
    if len(held) > 1 and not tasks and not names:
        raise OptionError(f"{runs} holds several tasks; choose with --task {' or --task '.join(held)}")
    return found


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
