"""`qrlsuite new plugin`: write a new plugin package."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import scaffold
from qrlsuite.cli.arguments import JsonOption
from qrlsuite.errors import OptionError
from qrlsuite.scaffold import Kind, from_file

app = typer.Typer(
    help="Write a new plugin package.\n\nExample: qrlsuite new plugin acme-ring --kind ansatz",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.callback()
def new() -> None:
    """Write a new plugin package.

    Example: qrlsuite new plugin acme-ring --kind ansatz
    """


@app.command("plugin")
def plugin(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]",
            help="Name of the package, and of the thing that it registers: acme-ring. With --from: the file's name.",
        ),
    ] = None,
    kind: Annotated[Kind | None, typer.Option("--kind", help="Kind of thing that it adds.")] = None,
    source: Annotated[
        Path | None,
        typer.Option("--from", metavar="PATH", help="Make the package of a plugin that lies there: ring.py."),
    ] = None,
    scores: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range",
            metavar="RANDOM BEST",
            help="For a task: the score of random actions and the best known one, between which its thresholds are "
            "spread. Numbers outside 0..1 are returns. Default: scores of the template's environment.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder to write it into.")] = Path(),
    json_output: JsonOption = False,
) -> None:
    """Write a package that works at once: pyproject.toml, code to edit, a test, a README.

    Nothing is overwritten. What is in it can be installed (`pip install -e .`), passes `qrlsuite check`, and can be
    run; edit it from there.

    Examples: qrlsuite new plugin acme-ring --kind ansatz; qrlsuite new plugin --from ring.py
    """
    if source is not None and (kind is not None or scores is not None):
        raise OptionError("--from PATH says what the package adds: leave --kind and --range out")
    if source is not None:
        files = from_file.package(source, name)
    elif name is None or kind is None:
        raise OptionError(
            "name the package and what it adds, for example acme-ring --kind ansatz; or a file, --from ring.py"
        )
    else:
        files = scaffold.package(name, kind, scores)
    folder = scaffold.write(files, out)
    if json_output:
        content = {"folder": str(folder), "files": sorted(files.files), "next": list(files.commands)}
        typer.echo(json.dumps(content))
        return
    typer.echo(f"wrote {folder}:")
    for path in files.files:
        typer.echo(f"  {path}")
    typer.echo("next:")
    for line in (f"cd {shlex.quote(str(folder))}", "pip install -e '.[test]'", *files.commands):
        typer.echo(f"  {line}")
