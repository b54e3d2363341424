"""Options of every command that trains: engines and budgets."""

from __future__ import annotations

from typing import Annotated

import typer

WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", min=1, help="Processes, or array tasks; default: one per core, or 10 tasks."),
]
EngineOption = Annotated[
    str,
    typer.Option(
        "--engine",
        metavar="NAME",
        help="The engine that runs the training, with its options: 'slurm partition=gpu time=2:00:00' (see `qrlsuite "
        "list engines`).",
    ),
]
BudgetOption = Annotated[
    str | None,
    typer.Option(
        "--budget",
        metavar="TIME",
        help="30min, 8h or 2core-hours: stop then and save, as Ctrl-C does; the same command continues.",
    ),
]
TrackOption = Annotated[
    list[str] | None,
    typer.Option(
        "--track",
        metavar="NAME[=TARGET]",
        help="Watch with a tracker (see `qrlsuite list trackers`): --track tensorboard, --track tensorboard=DIR.",
    ),
]
DeviceOption = Annotated[
    str, typer.Option("--device", help="Where networks are trained: cpu, cuda or cuda:1.")
]

SameOption = Annotated[
    str | None,
    typer.Option(
        "--same",
        metavar="REASON",
        help="After a change of code: your word that results do not change; the old seeds are continued.",
    ),
]
