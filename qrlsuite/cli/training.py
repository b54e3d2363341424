"""Options of every command that trains: engines and time budgets."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Annotated

import typer

from qrlsuite import options
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError

WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", min=1, help="Processes, or array tasks; default: one per core, or 10 tasks."),
]
EngineOption = Annotated[
    str, typer.Option("--engine", help="The engine that runs the training (see `qrlsuite list engines`).")
]
PartitionOption = Annotated[
    str | None, typer.Option("--partition", help="For --engine slurm: the partition.")
]
TimeOption = Annotated[
    str | None,
    typer.Option("--time", help="For --engine slurm: the time limit, 90 (minutes), 2:00:00 or 1-12:00:00."),
]
EngineOptionsOption = Annotated[
    list[str] | None,
    typer.Option("--engine-set", metavar="NAME=VALUE", help="A further option of the engine."),
]
MinutesOption = Annotated[
    float | None,
    typer.Option(
        "--minutes",
        metavar="MINUTES",
        help="Stop after this many minutes and save, as Ctrl-C does; the same command continues.",
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

FreshOption = Annotated[
    bool,
    typer.Option(
        "--fresh",
        help="Where the code of an entry has changed: train anew, and move the old seeds to a folder beside it.",
    ),
]
SameOption = Annotated[
    str | None,
    typer.Option(
        "--same",
        metavar="REASON",
        help="Where the code has changed: your word that nothing changed in effect; the seeds are continued.",
    ),
]


def where_of(
    engine: str,
    workers: int | None,
    partition: str | None = None,
    time: str | None = None,
    settings: list[str] | None = None,
    device: str = "cpu",
    fresh: bool = False,
    same: str | None = None,
) -> Where:
    """Build the engine that a command's options name; the errors are those of `Where.create`."""
    chosen = {setting.name: setting.value for setting in map(options.parse_setting, settings or [])}
    built = Where.create(engine, workers, {"partition": partition, "time": time, **chosen}, device)
    return replace(built, fresh=fresh, same=same)


_PIECE = re.compile(r"(\d+(?:\.\d+)?)\s*(seconds|sec|s|minutes|min|m|hours|h|days|d)")
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


def seconds(text: str) -> float:
    """Read `90s`, `30min`, `2h` or `1h 30min`.

    Raises
    ------
    OptionError
        If it is nothing of that kind.

    >>> seconds("1h 30min")
    5400.0
    """
    duration = text.strip().lower()
    pieces = _PIECE.findall(duration)
    if not pieces or _PIECE.sub("", duration).strip():
        raise OptionError(f"--budget {text}: write a time, for example 90s, 30min, 2h or 1h30min")
    return sum(float(number) * _SECONDS[unit[0]] for number, unit in pieces)
