"""`qrlsuite run`: train the missing seeds of an entry."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import options, registry, specs
from qrlsuite.cli.arguments import JsonOption, RunsOption, names_of
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    EngineOptionsOption,
    FreshOption,
    MinutesOption,
    PartitionOption,
    SameOption,
    TimeOption,
    TrackOption,
    WorkersOption,
    where_of,
)
from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.experiment import entry as entries
from qrlsuite.results.seeds import parse_seeds
from qrlsuite.training import trackers

QUICK_SEEDS = 8
QUICK_EPOCHS = 10
QUICK_QUBITS = 4


def run(
    task: Annotated[
        str,
        typer.Option(
            "--task",
            help="A task (see `qrlsuite list tasks`) or a task file's path.",
            autocompletion=names_of("tasks"),
        ),
    ],
    model: Annotated[
        str,
        typer.Option(
            "--model",
            help="A function approximator (see `qrlsuite list models`).",
            autocompletion=names_of("models"),
        ),
    ],
    algorithm: Annotated[
        str | None,
        typer.Option(
            "--algorithm",
            help="A learning algorithm; default: the task's.",
            autocompletion=names_of("algorithms"),
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="An option, for example --set qubits=6, --set algorithm.gamma=.9, --set environment.degree=4.",
        ),
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", help="One of the task's presets of settings.")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option("--seeds", help="100, or 0:20, or 0,3,10:12; default: the task's protocol.")
    ] = None,
    epochs: Annotated[
        int | None, typer.Option("--epochs", min=1, help="Default: the task's protocol.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help=f"A small budget: {QUICK_SEEDS} seeds, {QUICK_EPOCHS} epochs, {QUICK_QUBITS} qubits.",
        ),
    ] = False,
    minutes: MinutesOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    partition: PartitionOption = None,
    time: TimeOption = None,
    engine_options: EngineOptionsOption = None,
    device: DeviceOption = "cpu",
    fresh: FreshOption = False,
    same: SameOption = None,
    track: TrackOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Also start a training that will take more than a day.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train the missing seeds of an entry (a model and an algorithm on a task).

    Stop with Ctrl-C at any time; the same command continues where it stopped. More --seeds or --epochs add to
    earlier results; repeating a finished command does nothing.

    Example: qrlsuite run --task beam6g --model vqc-pennylane --set qubits=6 --seeds 20
    """
    chosen = [options.parse_setting(word) for word in settings or []]
    if quick:
        chosen = _quick_settings(model, chosen)
    entry = entries.resolve(task, model, algorithm, chosen, preset)
    if track:
        trackers.ask(track)
    seed_numbers = parse_seeds(seeds) if seeds else list(range(QUICK_SEEDS)) if quick else None
    last = epochs or (QUICK_EPOCHS if quick else None)
    where = where_of(engine, workers, partition, time, engine_options, device, fresh, same)
    missing.check_minutes(minutes, where)
    for line in missing.require_same_code(runs, [entry], where):
        typer.echo(line, err=True)
    work = missing.find(runs, entry, where, seed_numbers, last)
    display = RunDisplay(work, where.workers, quiet=json_output)
    if not json_output:
        display.expected = missing.expected(work, where)
    try:
        outcome = missing.train(work, where, display, minutes, confirmed=yes)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    if outcome.submitted is not None:
        typer.echo(json.dumps({"submitted": outcome.submitted}) if json_output else outcome.submitted)
        return
    summary = missing.summarize(work)
    if json_output:
        typer.echo(json.dumps(summary))
    else:
        display.finished(summary)


def _quick_settings(model: str, chosen: list[Any]) -> list[Any]:
    """Reduce the qubits of a circuit, unless they were set by hand."""
    names = options.field_names(specs.resolve(registry.get(specs.ModelSpec, model).options))
    if "qubits" in names and not any(word.name == "qubits" for word in chosen):
        return [options.Setting("model", "qubits", QUICK_QUBITS), *chosen]
    return chosen
