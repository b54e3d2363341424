"""Adds `qrlsuite import`, which turns result files of the paper's released code into an entry."""

from __future__ import annotations

import typer

from qrlsuite import hookimpl


@hookimpl
def register_commands(app: typer.Typer) -> None:
    """Add the command `import`."""
    from qrlsuite_released.command import import_results

    app.command("import")(import_results)
