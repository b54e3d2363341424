"""`qrlsuite tune`: find settings by sample complexity on seeds of their own, and write them to a preset file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import options
from qrlsuite.cli import budget as budgets
from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    EngineOptionsOption,
    PartitionOption,
    TimeOption,
    WorkersOption,
    place,
    plan,
)
from qrlsuite.cli.trials import TuneDisplay, plain, report
from qrlsuite.engine import api
from qrlsuite.errors import OptionError
from qrlsuite.results.store import EntryStore
from qrlsuite.tuning.search import FOLDER, Request, Search

LARGE = 200
"""Trials from which a search without a budget has to be asked for twice."""


class Sampler(StrEnum):
    """In which order settings are tried; `qrlsuite.tuning.samplers.NAMES` says what each does."""

    grid = "grid"
    one_at_a_time = "one-at-a-time"
    random = "random"
    tpe = "tpe"


class Goal(StrEnum):
    """What is minimized."""

    cell = "cell"
    area = "area"


def tune(
    task: Annotated[
        str, typer.Option("--task", help="A task (see `qrlsuite list tasks`) or a task file's path.")
    ],
    model: Annotated[
        str | None, typer.Option("--model", help="A function approximator (see `qrlsuite list models`).")
    ] = None,
    equal_budget: Annotated[
        tuple[str, str] | None,
        typer.Option(
            "--equal-budget",
            metavar="A B",
            help="Two models, with settings if need be (mlp 'vqc-native qubits=6'), instead of --model: both get the "
            "same number of trials, seeds and epochs.",
        ),
    ] = None,
    algorithm: Annotated[
        str | None, typer.Option("--algorithm", help="A learning algorithm; default: the task's.")
    ] = None,
    grid: Annotated[
        str | None, typer.Option("--grid", help="What is varied: `paper`, or a grid file's path.")
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
        Sampler,
        typer.Option("--sampler", help="All combinations, one option at a time, at random, or Optuna's TPE."),
    ] = Sampler.grid,
    trials: Annotated[
        int | None,
        typer.Option("--trials", min=1, max=100_000, help="For random and tpe: how many settings."),
    ] = None,
    sampler_seed: Annotated[
        int, typer.Option("--sampler-seed", min=0, help="For random and tpe: another one proposes others.")
    ] = 0,
    seeds: Annotated[
        str,
        typer.Option(
            "--seeds", help="Runs of each trial, numbered from 1,000,000: protocol seeds stay unseen."
        ),
    ] = "20",
    epochs: Annotated[
        int | None,
        typer.Option("--epochs", min=1, help="Fewer for short trials; default: the task's protocol."),
    ] = None,
    objective: Annotated[
        Goal,
        typer.Option(
            "--objective", help="S_hat at the task's reference cell, or its mean over the ranking grid."
        ),
    ] = Goal.cell,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget", metavar="TIME", help="Begin no trial that would not end within 30min, 2h, ..."
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
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Find settings with a small sample complexity, and write them to a preset file for `run --preset`.

    Every trial is an ordinary set of runs below RUNS/tuning, on seeds that entries are never judged by. Stop with
    Ctrl-C at any time; the same command continues, and ends with the same preset as if it had never stopped.

    Example: qrlsuite tune --task beam6g --model mlp --grid paper --sampler one-at-a-time --seeds 20
    """
    from qrlsuite.tuning import search, space

    if (model is None) == (equal_budget is None):
        raise OptionError("give either --model NAME or --equal-budget A B")
    if out is not None and (equal_budget is not None or out.suffix != ".toml"):
        raise OptionError(f"--out {out}: one file ending in .toml, for one model")
    limit = None if budget is None else budgets.seconds(budget)
    words = tuple(options.parse_setting(word) for word in settings or [])
    requests = []
    for name in equal_budget or [str(model)]:
        first, *own = name.split()
        requests.append(
            search.Request(
                task=task,
                model=first,
                algorithm=algorithm,
                settings=(*(options.parse_setting(word) for word in own), *words),
                grid=None if grid is None else space.load(grid),
                varied=tuple(space.parse_varied(word) for word in vary or []),
                sampler=sampler.value,
                trials=trials,
                sampler_seed=sampler_seed,
                seeds=search.tuning_seeds(seeds),
                epochs=epochs,
                objective=objective.value,
            )
        )
    searches = _searches(requests, runs)
    where = place(engine, workers, partition, time, engine_options, device)
    display = TuneDisplay(searches, where, runs, quiet=json_output)
    display.begin()
    if dry_run:
        if json_output:
            typer.echo(json.dumps({"searches": [plain(each) for each in searches], "complete": False}))
        return
    planned = sum(each.planned for each in searches)
    if planned > LARGE and not yes and limit is None:
        raise OptionError(
            f"{planned} trials are many: --yes starts them all, --budget 2h as many as that holds, "
            "--sampler one-at-a-time or --sampler random --trials 50 tries fewer"
        )
    try:
        complete = _run(searches, runs, where, display, limit)
    except KeyboardInterrupt:
        display.interrupted()
        raise typer.Exit(130) from None
    finally:
        display.close()
    _finish(searches, out, runs, complete, display, json_output)


def _searches(requests: Sequence[Request], runs: Path) -> list[Search]:
    """Build the searches; of two, the larger grid is sampled down to the number of combinations of the smaller."""
    built = [Search(request, runs) for request in requests]
    fewest = min(search.planned for search in built)
    for i, search in enumerate(built):
        if search.planned == fewest:
            continue
        if search.request.sampler != "grid":
            counts = " and ".join(str(each.planned) for each in built)
            raise OptionError(
                f"--equal-budget: sampler '{search.request.sampler}' gives {counts} trials; --sampler random --trials "
                f"{fewest} gives both as many"
            )
        built[i] = Search(dataclasses.replace(search.request, sampler="random", trials=fewest), runs)
    return built


def _run(searches: Sequence[Search], runs: Path, where: Any, display: Any, limit: float | None) -> bool:
    """Run trials, of several searches in turns, until all are over or the budget is; returns whether all are."""
    import time

    def train(entry: Any, seeds: Sequence[int], epochs: int) -> EntryStore:
        work = plan(runs / FOLDER, entry, seeds, epochs, where)
        EntryStore.create(runs / FOLDER, entry)
        display.trial(entry, work)
        if work.groups:
            outcome = where.engine.run(
                api.Work(work.store, work.groups, epochs, where.workers, where.device), display.update
            )
            api.raise_failures(outcome)
            if outcome.submitted is not None:
                display.console.print(outcome.submitted, markup=False)
        return work.store

    began = time.monotonic()
    longest = 0.0
    while not all(search.over for search in searches):
        if limit is not None and time.monotonic() - began + longest > limit:
            return False
        started = time.monotonic()
        for search in searches:
            if not search.over:
                display.told(search, search.step(train))
        longest = max(longest, time.monotonic() - started)
    return not any(search.pending for search in searches)


def _finish(
    searches: Sequence[Search],
    out: Path | None,
    runs: Path,
    complete: bool,
    display: Any,
    json_output: bool,
) -> None:
    """Write the preset files where there is a best trial and none is waited for, and say what came out."""
    written: dict[int, Path] = {}
    for i, search in enumerate(searches):
        if search.best is not None and not search.pending:
            path = out or search.path
            search.write(path)
            written[i] = path
    if json_output:
        rows = [
            {**plain(each), "preset": str(written[i]) if i in written else None}
            for i, each in enumerate(searches)
        ]
        typer.echo(json.dumps({"searches": rows, "complete": complete}))
        return
    report(searches, written, runs, complete)
    if not complete and not written and not any(search.pending for search in searches):
        raise OptionError("--budget does not hold one trial: give more time, or fewer --seeds or --epochs")
