"""`qrlsuite run`: train the missing seeds of an entry."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import options, registry, specs
from qrlsuite.cli.arguments import JsonOption, RunsOption, names_of
from qrlsuite.cli.training import (
    BudgetOption,
    DeviceOption,
    EngineOption,
    FreshOption,
    SameOption,
    TrackOption,
    WorkersOption,
    where_of,
)
from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.experiment.entry import resolve
from qrlsuite.notation import Written, parse_entry
from qrlsuite.results.seeds import parse_seeds
from qrlsuite.results.store import plugins_in
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
    entry: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENTRY]",
            help="[ALGORITHM] MODEL [NAME=VALUE ...] [preset=FILE], as boards print it: mlp width=16, or ppo mlp. "
            "--model and --set say the same.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help="A function approximator (see `qrlsuite list models`).",
            autocompletion=names_of("models"),
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
    budget: BudgetOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
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

    Examples: qrlsuite run mlp width=16 --task beam6g --seeds 20; qrlsuite run --task beam6g --model vqc-pennylane
    --set qubits=6
    """
    written = _written(entry or [], model, settings or [])
    try:
        resolved = resolve(task, _quick(written) if quick else written)
    except UnknownNameError as error:
        raise UnknownNameError(f"{error}{plugins_in(runs, str(error))}") from None
    if track:
        trackers.ask(track)
    seed_numbers = parse_seeds(seeds) if seeds else list(range(QUICK_SEEDS)) if quick else None
    last = epochs or (QUICK_EPOCHS if quick else None)
    where = where_of(engine, workers, device, fresh, same)
    missing.check_budget(budget, where)
    for line in missing.require_same_code(runs, [resolved], where):
        typer.echo(line, err=True)
    work = missing.find(runs, resolved, where, seed_numbers, last)
    display = RunDisplay(work, where.workers, quiet=json_output)
    if not json_output:
        display.expected = missing.expected(work, where)
    try:
        outcome = missing.train(work, where, display, budget, confirmed=yes)
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


def _written(words: list[str], model: str | None, settings: list[str]) -> Written:
    """Read the entry, given as arguments or by --model, and what --set adds."""
    if bool(words) == (model is not None):
        problem = f"'{' '.join(words)}' and --model {model}: give one of them" if words else "name a model"
        raise OptionError(f"{problem}, for example: qrlsuite run mlp width=16 --task beam6g")
    text = " ".join(words) or str(model)
    return parse_entry(text).given(settings=tuple(map(options.parse_setting, settings)))


def _quick(written: Written) -> Written:
    """Reduce the qubits of a circuit, unless they are written."""
    names = options.field_names(specs.resolve(registry.get(specs.ModelSpec, written.model).options))
    if "qubits" not in names or any(setting.name == "qubits" for setting in written.settings):
        return written
    return written.given(settings=(options.Setting("model", "qubits", QUICK_QUBITS),))
