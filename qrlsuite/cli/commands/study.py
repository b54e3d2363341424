"""`qrlsuite study`: run experiments by name, with or without looks."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import api, registry, specs
from qrlsuite.api.arguments import where_of
from qrlsuite.api.needs import power_lines, study_power
from qrlsuite.api.studies import (
    ALL,
    end_study,
    find_studies,
    require_unchanged,
    take_looks,
    train_studies,
)
from qrlsuite.cli.arguments import JsonOption, RunsOption, TrainedTaskOption, split_settings
from qrlsuite.cli.training import (
    BudgetOption,
    DeviceOption,
    EngineOption,
    SameOption,
    WorkersOption,
)
from qrlsuite.engine.missing import check_budget
from qrlsuite.engine.terminal import command, table_console
from qrlsuite.errors import OptionError, nearest
from qrlsuite.leaderboard import studies
from qrlsuite.notation import parse_named
from qrlsuite.results.text import counted
from qrlsuite.studies.state import State

app = typer.Typer(
    no_args_is_help=True,
    help="Run experiments by name, a paper's or your own; compare entries with as many seeds as it takes.",
)

StudyArgument = Annotated[
    str, typer.Argument(metavar="STUDY", help="A study (see `qrlsuite list studies`) or a study file's path.")
]
StudyOrAll = Annotated[
    str, typer.Argument(metavar="STUDY", help="A study, a study file's path, or `all` that are registered.")
]
SeedsOption = Annotated[
    str | None, typer.Option("--seeds", help="100, or 0:20, or 0,3,10:12; default: each task's protocol.")
]
EpochsOption = Annotated[int | None, typer.Option("--epochs", min=1, help="Default: each task's protocol.")]
WordsArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="WORD|OPTION=VALUE",
        help="Only entries with one of these words in group, label or task, or with this name. qubits=6 sets an "
        "option wherever an entry has it; vqc-native=vqc-pennylane replaces a model by another.",
    ),
]


LOOKS = "20,40,60,80,100"
LOOKS_OPTIONS = ("alpha", "margin", "spending", "first_seed", "reason")


@app.command()
def new(
    path: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="The file to write.")],
    entries: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY ENTRY ...",
            help="Two or more: 'mlp width=64' 'vqc-native qubits=10'; tuned: 'mlp preset=FILE.toml'; "
            "with a name: 'wide: mlp width=64'.",
        ),
    ],
    task: TrainedTaskOption,
    epochs: EpochsOption = None,
    looks: Annotated[
        str,
        typer.Option(
            "--looks",
            metavar="N,M,...",
            help="Seeds of each entry at each look, and further keys of the file's table [looks]: '20,40 alpha=.01' "
            "(probability of any false difference), margin=.1 (entries that differ by less count as equal), spending, "
            "first_seed, and the reason for a first look before 20 seeds.",
        ),
    ] = LOOKS,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Write a study with looks: it compares entries with as many seeds as it takes. Trains nothing.

    Every pair is compared. To compare only some pairs, add [[looks.questions]] with these pairs to the file; claims
    about an entry and several rivals are [[looks.claims]], and `qrlsuite show` then has their power.

    Example: qrlsuite study new width.toml "mlp width=64" "mlp width=32" --task beam6g
    """
    numbers, more = _looks(looks)
    outcome = api.new_study(path, entries, task=task, epochs=epochs, looks=numbers, runs=runs, **more)
    found = study_power(outcome.study)
    if json_output:
        typer.echo(json.dumps({**outcome.as_dict(), "power": None if found is None else asdict(found)}))
        return
    table_console().print(outcome, soft_wrap=True)
    typer.echo("\n".join(power_lines(found)))
    typer.echo(f"wrote {path}")
    typer.echo(f"next: {command('study', 'run', str(path), runs=runs)}")


def _looks(text: str) -> tuple[list[int], dict[str, Any]]:
    """Read --looks: numbers of seeds, and options of the table [looks]."""
    words, more = parse_named(text if "=" not in text.partition(" ")[0] else f"{LOOKS} {text}", "--looks ")
    for name in more:
        if name not in LOOKS_OPTIONS:
            raise OptionError(f"--looks: unknown option '{name}'{nearest(name, LOOKS_OPTIONS)}")
    try:
        return [int(word) for word in words.split(",")], more
    except ValueError:
        raise OptionError(f"--looks {text}: write numbers of seeds, for example --looks 20,40,60") from None


@app.command()
def run(
    name: StudyOrAll,
    words: WordsArgument = None,
    seeds: SeedsOption = None,
    epochs: EpochsOption = None,
    budget: BudgetOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the planned training, and train nothing.")
    ] = False,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    device: DeviceOption = "cpu",
    same: SameOption = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train a study's missing seeds, the entry that lacks least first.

    `qrlsuite run` trains the same entries in the same folders: nothing is trained twice. Stop with Ctrl-C at
    any time, or give a --budget; the same command continues. `all` begins with the study that lacks least.

    A study with looks is trained look by look, until every pair is decided or the last look was taken. An entry stops
    when all its pairs are closed.

    Examples: qrlsuite study run fig6 --seeds 20 --budget 30min; qrlsuite study run fig7 mlp width=32;
    qrlsuite study run all --budget 8h
    """
    where = where_of(engine, workers, device, same)
    if name != ALL and (study := studies.find(name)).looks is not None:
        given = {"--seeds": seeds, "--epochs": epochs, "--dry-run": dry_run}
        require_unchanged(name, {**dict.fromkeys(words or (), True), **given})
        outcome = take_looks(study, where, budget, runs, not json_output)
        _report(name, outcome, budget, runs, json_output)
        return
    check_budget(budget, where)
    chosen, left_out = find_studies(name, *_changes(words), seeds, epochs, where, runs)
    for line in left_out:
        typer.echo(f"left out: {line}", err=True)
    done = []
    for found in chosen if dry_run else train_studies(chosen, where, budget, not json_output):
        done.append(found.as_dict())
        if dry_run and not json_output:
            table_console().print(found, soft_wrap=True)
        elif not json_output:
            shown = found.study.name if name == ALL else name
            typer.echo("\n".join([*found.submitted, *studies.next_steps(shown, found, runs)]))
    if json_output:
        typer.echo(json.dumps(done if name == ALL else done[0]))


@app.command()
def end(name: StudyArgument, runs: RunsOption = Path("runs")) -> None:
    """End a study with looks before all is decided: open pairs stay open, and it cannot go on.

    Example: qrlsuite study end width.toml
    """
    end_study(name, runs=runs)
    typer.echo(f"ended; what was decided stays: {command('show', name, runs=runs)}")


def _changes(words: list[str] | None) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """Return the options that words set, the models that they replace, and the words that entries must have."""
    only, settings = split_settings(words)
    registered = registry.load().names(specs.ModelSpec)
    models = {name: str(settings.pop(name)) for name in list(settings) if name in registered}
    return settings, models, only


def _report(name: str, outcome: State, budget: str | None, runs: Path, json_output: bool) -> None:
    """Print the outcome of a study with looks, and the next command."""
    if json_output:
        typer.echo(json.dumps(outcome.as_dict()))
        return
    for line in outcome.submitted:
        typer.echo(line)
    table_console().print(outcome, soft_wrap=True)
    if missing := outcome.missing:
        lacking = ", ".join(f"{counted(count, 'seed')} of {name}" for name, count in missing.items())
        who = "others train" if budget is None else "the budget is used up, or others train"
        typer.echo(f"{who} {lacking}: repeat this command when they have finished")
    elif outcome.finished:
        typer.echo(f"next: {command('plot', 'pairs', '--study', name, runs=runs)}")
