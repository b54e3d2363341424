"""`qrlsuite tune`: search for settings with a small sample complexity, and write them to a preset file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.api.arguments import where_of
from qrlsuite.cli.arguments import JsonOption, RunsOption, TrainedTaskOption
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    SameOption,
    WorkersOption,
)
from qrlsuite.engine.terminal import command, table_console
from qrlsuite.errors import OptionError
from qrlsuite.experiment import identity
from qrlsuite.notation import write_setting
from qrlsuite.results.survey import garbage
from qrlsuite.results.text import counted, hours_text, size_text
from qrlsuite.tuning import runner as tuning_runner
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.search import FOLDER, Search, preset_path, read_requests

LARGE = 200
"""Trials from which a search without a budget has to be asked for twice."""
MUCH = 1_000_000_000
"""Bytes of checkpoints from which a search says how to free them."""


class Goal(StrEnum):
    """The number to minimize."""

    time = "time"
    cell = "cell"
    area = "area"


def tune(
    entries: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY...",
            help="'[ALGORITHM] MODEL [NAME=VALUE ...]': a model, and options that all trials share. Several get equal "
            "budgets.",
        ),
    ],
    task: TrainedTaskOption,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="NAME=VALUES",
            help="The varied options: 'lr=1e-3,5e-4', 'lr={low=1e-4, high=1e-2, log=true}', or a grid: "
            "`paper`, or a file's path; or settings to be tried first, 'lr=.002 buffer=10000' or "
            "preset=FILE.toml. Default: the options that models and algorithms name for tuning.",
        ),
    ] = None,
    sampler: Annotated[
        str | None,
        typer.Option(
            "--sampler",
            metavar="NAME",
            help="Until the expected regret is small (`bayesian`), all combinations (`grid`), or `random`, with "
            "`trials` and `seed`: 'random trials=50', 'bayesian regret=.03 trials=50 last=100' (`trials` per varied "
            "option; then the best three on `last` other seeds). Default: bayesian, or all combinations of the lists "
            "in --vary.",
        ),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            help="Runs of each trial, numbered from 1,000,000: protocol seeds stay unseen. Default: 20; bayesian: 4, "
            "and 4 more in each further trial of the same settings.",
        ),
    ] = None,
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
            help="Time for all trials, 30min or 8h: one that would take longer is not begun. For bayesian, "
            "2core-hours: as many trials as fit, for each entry.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.toml", help="The preset file; default: below --runs."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help=f"Start a search of more than {LARGE} trials.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planned trials, and stop.")] = False,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    device: DeviceOption = "cpu",
    same: SameOption = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Find settings with which models learn in few steps, and write them to preset files.

    Several entries get equal budgets. Every trial is an ordinary set of runs below RUNS/tuning, on seeds that entries
    are never judged by. Stop with Ctrl-C at any time: the best settings so far are written. The same command
    continues, and ends with the same presets as if it had never stopped.

    Example: qrlsuite tune "mlp width=16" "vqc-native qubits=6" --task beam6g
    """
    where = where_of(engine, workers, device, same)
    requests = read_requests(
        task, entries, vary or (), sampler, seeds, epochs, objective.value, budget, where
    )
    path = preset_path(out, requests)
    searches = tuning_runner.build(requests, runs)
    display = TuneDisplay(searches, where, json_output)
    display.begin()
    if not (dry_run or yes or budget):
        _require_few(searches)
    complete = not dry_run and tuning_runner.run(searches, runs, where, display, path)
    if json_output:
        typer.echo(json.dumps({"searches": [each.as_dict() for each in searches], "complete": complete}))
    if json_output or dry_run:
        return
    _report(searches, runs, complete)
    if not complete and not any(each.trials or each.pending for each in searches):
        raise OptionError("--budget is too small for one trial: give more time, or fewer --seeds or --epochs")


def _require_few(searches: Sequence[Search]) -> None:
    planned = sum(
        each.planned for each in searches if each.request.sampler != "bayesian"
    )  # which ends by itself
    if planned > LARGE:
        raise OptionError(
            f"{planned} trials are many: --yes starts all, --budget 2h as many as fit into 2 hours, "
            "--sampler 'random trials=50' tries fewer"
        )


def _report(searches: Sequence[Search], runs: Path, complete: bool) -> None:
    """Print the best settings of each search, its preset file, and the next command."""
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
        left = counted(sum(each.planned - each.asked for each in searches), "trial")
        wide.print(f"the budget is spent, {left} left: the same command continues")
    for each in searches:
        if each.written is None:
            continue
        words = [each.base.model.name, write_setting("preset", str(each.written))]
        line = command(
            "run", *words, "--task", each.request.task, *identity.plugin_words(each.base), runs=runs
        )
        wide.print(f"next: {line}", markup=False, soft_wrap=True)
    task = searches[0].base.task.name
    kept = sum(item.size for item in garbage(runs / FOLDER, task)[0])
    if kept >= MUCH:
        line = command("runs", "gc", "--task", task, "--yes", runs=runs / FOLDER)
        wide.print(
            f"trials keep {size_text(kept)} so that they can be extended by more epochs; to free it: {line}",
            markup=False,
            soft_wrap=True,
        )
