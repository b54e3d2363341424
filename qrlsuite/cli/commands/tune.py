"""`qrlsuite tune`: search for settings with a small sample complexity, and write them to a preset file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import options
from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    EngineOptionsOption,
    FreshOption,
    PartitionOption,
    SameOption,
    TimeOption,
    WorkersOption,
    seconds,
    where_of,
)
from qrlsuite.engine.terminal import command, table_console
from qrlsuite.errors import OptionError
from qrlsuite.results.text import hours_text
from qrlsuite.tuning import runner, search, space
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.search import Search

LARGE = 200
"""Trials from which a search without a budget has to be asked for twice."""


class SamplerName(StrEnum):
    """In which order settings are tried; `qrlsuite.tuning.samplers.NAMES` says what each does."""

    halving = "halving"
    grid = "grid"
    one_at_a_time = "one-at-a-time"
    random = "random"
    tpe = "tpe"


class Goal(StrEnum):
    """What is minimized."""

    time = "time"
    cell = "cell"
    area = "area"


def tune(
    task: Annotated[
        str, typer.Option("--task", help="A task (see `qrlsuite list tasks`) or a task file's path.")
    ],
    models: Annotated[
        list[str],
        typer.Option(
            "--model",
            metavar="'NAME [SETTING=VALUE ...]'",
            help="A function approximator (see `qrlsuite list models`), with settings if need be: 'mlp width=16'. "
            "Repeat it to tune several with equal budgets.",
        ),
    ],
    algorithm: Annotated[
        str | None, typer.Option("--algorithm", help="A learning algorithm; default: the task's.")
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(
            "--grid",
            help="What is varied: `paper`, or a grid file's path; default: the options that models and algorithms "
            "name for tuning.",
        ),
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary", metavar="NAME=[...]", help="What is varied, without a file: 'lr=[1e-3, 5e-4]'."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A value that all trials share; not varied then."),
    ] = None,
    sampler: Annotated[
        SamplerName | None,
        typer.Option(
            "--sampler",
            help="Successive halving, all combinations, one option at a time, at random, or Optuna's TPE; default: "
            "halving, or all combinations of a --grid or --vary.",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials",
            min=1,
            max=100_000,
            help="How many settings: for random and tpe in all, for halving per varied option (default 8).",
        ),
    ] = None,
    core_hours: Annotated[
        float | None,
        typer.Option(
            "--core-hours", help="For halving: as many settings as so many core-hours of each model hold."
        ),
    ] = None,
    sampler_seed: Annotated[
        int, typer.Option("--sampler-seed", min=0, help="For random and tpe: the seed of the proposals.")
    ] = 0,
    seeds: Annotated[
        str,
        typer.Option(
            "--seeds",
            help="Runs of each trial (halving: of each in the last rung), numbered from 1,000,000: protocol seeds "
            "stay unseen.",
        ),
    ] = "20",
    epochs: Annotated[
        int | None,
        typer.Option("--epochs", min=1, help="Epochs of each trial; default: the task's protocol."),
    ] = None,
    objective: Annotated[
        Goal,
        typer.Option(
            "--objective",
            help="What to minimize: steps below threshold (time), sample complexity at the task's reference cell "
            "(cell), or sample complexity averaged over the task's ranking grid (area).",
        ),
    ] = Goal.time,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget",
            metavar="TIME",
            help="Time for all trials, 30min or 2h; a trial that would take longer is not begun.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.toml", help="The preset file; default: below --runs."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help=f"Start a search of more than {LARGE} trials.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what it would be, and stop.")] = False,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    partition: PartitionOption = None,
    time: TimeOption = None,
    engine_options: EngineOptionsOption = None,
    device: DeviceOption = "cpu",
    fresh: FreshOption = False,
    same: SameOption = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Find settings with which models learn in few steps, and write them to preset files for `run --preset`.

    Several models get equal budgets. Every trial is an ordinary set of runs below RUNS/tuning, on seeds that entries
    are never judged by. Stop with Ctrl-C at any time; the same command continues, and ends with the same presets as
    if it had never stopped.

    Example: qrlsuite tune --task beam6g --model "mlp width=16" --model "vqc-native qubits=6"
    """
    if out is not None and (len(models) > 1 or out.suffix != ".toml"):
        raise OptionError(f"--out {out}: one file ending in .toml, for one model")
    limit = None if budget is None else seconds(budget)
    shared = search.Request(
        task=task,
        entry="",
        algorithm=algorithm,
        settings=tuple(options.parse_setting(word) for word in settings or []),
        grid=None if grid is None else space.load(grid),
        varied=tuple(space.parse_varied(word) for word in vary or []),
        sampler=sampler.value if sampler else search.default_sampler(grid or vary),
        trials=trials,
        core_hours=core_hours,
        sampler_seed=sampler_seed,
        seeds=search.tuning_seeds(seeds),
        epochs=epochs,
        objective=objective.value,
    )
    searches = runner.build([replace(shared, entry=each) for each in models], runs)
    where = where_of(engine, workers, partition, time, engine_options, device, fresh, same)
    display = TuneDisplay(searches, where, quiet=json_output)
    display.begin()
    if dry_run:
        if json_output:
            content = {"searches": [search.as_dict(each) for each in searches], "complete": False}
            typer.echo(json.dumps(content))
        return
    if not yes and limit is None:
        _require_few(searches)
    try:
        complete = runner.run(searches, runs, where, display, limit, out)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    if json_output:
        rows = [
            {**search.as_dict(each), "preset": None if each.written is None else str(each.written)}
            for each in searches
        ]
        typer.echo(json.dumps({"searches": rows, "complete": complete}))
        return
    _report(searches, runs, complete)
    if not complete and not any(each.trials or each.pending for each in searches):
        raise OptionError("--budget does not hold one trial: give more time, or fewer --seeds or --epochs")


def _require_few(searches: Sequence[Search]) -> None:
    planned = sum(each.planned for each in searches)
    if planned > LARGE:
        raise OptionError(
            f"{planned} trials are many: --yes starts them all, --budget 2h as many as that holds, "
            "--sampler one-at-a-time or --sampler random --trials 50 tries fewer"
        )


def _report(searches: Sequence[Search], runs: Path, complete: bool) -> None:
    """Print the best settings of each search, its preset file, and what to type next."""
    wide = table_console()
    for each in searches:
        if each.trials:
            wide.print(each)
        if each.written is not None:
            wide.print(f"wrote {each.written}", markup=False, soft_wrap=True)
    if len(searches) > 1:
        counts = " and ".join(
            f"{len(each.trials)} ({each.runs_done} runs, {hours_text(each.core_seconds / 3600)} core-hours)"
            for each in searches
        )
        wide.print(f"trials of {' and '.join(each.base.label for each in searches)}: {counts}", markup=False)
    waiting = sum(len(each.pending) for each in searches)
    if waiting:
        wide.print(
            f"{waiting} trials wait for other processes or a queue: repeat this command when they have ended"
        )
    elif not complete:
        left = sum(each.planned - each.asked for each in searches)
        wide.print(f"the budget is spent, {left} trials are left: the same command continues")
    for each in searches:
        if each.written is None:
            continue
        base = each.base
        arguments = ["run", "--task", each.request.task, "--model", base.model.name]
        if base.algorithm.name != base.task.file.default_algorithm:
            arguments += ["--algorithm", base.algorithm.name]
        line = command(*arguments, "--preset", str(each.written), runs=runs)
        wide.print(f"next: {line}", markup=False, soft_wrap=True)
