"""Adds `qrlsuite import-released`, which turns result files of the paper's released code into an entry."""

from __future__ import annotations

import typer

from qrlsuite import hookimpl


@hookimpl
def register_commands(app: typer.Typer) -> None:
    """Add the command `import-released`."""
    from qrlsuite_released.command import import_results

    app.command("import-released")(import_results)
