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

app = typer.Typer(
    help="Write a new plugin package.\n\nExample: qrlsuite new plugin --from ring.py",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.callback()
def new() -> None:
    """Write a new plugin package.

    Example: qrlsuite new plugin --from ring.py
    """


@app.command("plugin")
def plugin(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="Name of the package: acme-ring. Default: the name of the file or folder."
        ),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="PATH", help="The plugin's file, or the folder of its package: ring.py."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder to write it into.")] = Path(),
    json_output: JsonOption = False,
) -> None:
    """Write a package of a plugin that is a file: pyproject.toml, hooks, its code, a test, a README.

    Nothing is overwritten. The package can be installed (`pip install -e .`), and `pytest` checks it. docs/plugins.md
    has files to begin with: a circuit, a network and an algorithm.

    Examples: qrlsuite new plugin --from ring.py; qrlsuite new plugin acme-ring --from ring.py
    """
    if source is None:
        raise OptionError("name the plugin's file: --from ring.py; docs/plugins.md has examples")
    files = scaffold.package(source, name)
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
