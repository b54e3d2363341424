"""`qrlsuite view`: the leaderboard's page in a browser, refreshed while runs go on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import api
from qrlsuite.cli.arguments import PublishedOption, RunsOption, TaskOption
from qrlsuite.engine.status import survey
from qrlsuite.leaderboard import report
from qrlsuite.leaderboard.report.live import Live, Server, serve
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.studies import looks


def view(
    task: TaskOption = None,
    published: PublishedOption = False,
    port: Annotated[
        int | None,
        typer.Option(
            "--port", metavar="N", min=1, max=65535, help="Default: the first free one from 8010 on."
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
) -> None:
    """Show the results folder in a browser, refreshed while runs go on: progress, learning curves, board.

    It prints an address that only browsers on this machine can open, changes nothing, and ends with Ctrl-C.

    Example: qrlsuite view
    """
    selection = Selection.create(runs, task, published).named()

    def render() -> str:
        board = api.board(task, runs=runs, published=published)
        studies, unreadable = published_studies.collected(selection)
        shown = replace(board, refused=(*board.refused, *unreadable))
        return report.render(shown, studies=studies, live=True)

    with Server(port) as server:
        typer.echo(f"reading {runs} ...")
        live = Live(
            render,
            lambda: (
                survey(runs, next(iter(selection.tasks), None), looks.folders(runs))
                if runs.is_dir() or not published
                else []
            ),
        )
        typer.echo(f"{runs} is shown to browsers on this machine, until Ctrl-C, at {server.address}")
        serve(server, live)
    typer.echo("\nended; nothing in the folder was changed")
