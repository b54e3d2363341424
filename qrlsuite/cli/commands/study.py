"""`qrlsuite study`: run experiments by name, with or without looks, and draw their pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from qrlsuite import api, options, registry, specs
from qrlsuite.cli.arguments import JsonOption, PublishedOption, RunsOption
from qrlsuite.cli.training import (
    BudgetOption,
    DeviceOption,
    EngineOption,
    FreshOption,
    SameOption,
    WorkersOption,
    where_of,
)
from qrlsuite.engine import budget as budgets
from qrlsuite.engine.missing import require_same_code
from qrlsuite.engine.terminal import command, table_console
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, nearest
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.studies import NOTHING, Drawn
from qrlsuite.results import speed
from qrlsuite.results.seeds import parse_seeds
from qrlsuite.results.text import counted, duration_range
from qrlsuite.statistics.sequential import Decision, Spending
from qrlsuite.studies import runner
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome, versus
from qrlsuite.studies.study import Member, Study

app = typer.Typer(
    no_args_is_help=True,
    help="Run experiments by name, a paper's or your own; compare entries with as many seeds as it takes.",
)

ALL = "all"
"""In the place of a study's name: every registered one."""

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
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="An option for every entry that has it, for example --set qubits=6; entries that are then equal are one.",
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--model-map",
        metavar="MODEL=MODEL",
        help="Replace a model by another one: vqc-native=vqc-pennylane.",
    ),
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        metavar="WORD",
        help="Only entries with this word in group, label or task, or with this name. Repeatable.",
    ),
]
OutOption = Annotated[
    str,
    typer.Option("--format", metavar="FORMAT", help="Of the pictures, in the results folder: png, pdf, svg."),
]


@app.command()
def new(
    path: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="The file to write.")],
    entries: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY ENTRY ...",
            help="Two or more: 'mlp width=64' 'vqc-native qubits=10'; tuned: 'mlp preset=FILE.toml'.",
        ),
    ],
    task: Annotated[
        str, typer.Option("--task", help="A task (see `qrlsuite list tasks`) or a task file's path.")
    ],
    epochs: EpochsOption = None,
    looks: Annotated[
        str, typer.Option("--looks", metavar="N,M,...", help="Seeds of each entry at each look.")
    ] = "20,40,60,80,100",
    alpha: Annotated[
        float, typer.Option("--alpha", help="Probability of any false difference, over all pairs and looks.")
    ] = 0.05,
    spending: Annotated[Spending, typer.Option("--spending", help="How alpha is spent over the looks.")] = (
        Spending.POCOCK
    ),
    margin: Annotated[
        float, typer.Option("--margin", help="Entries that differ by less count as equal: 0.1 is 10 percent.")
    ] = 0.1,
    first_seed: Annotated[
        int | None,
        typer.Option(
            "--first-seed",
            min=0,
            help="Where the study's seeds begin; default: the first unused block from 10000.",
        ),
    ] = None,
    reason: Annotated[
        str, typer.Option("--reason", help="Why the first look comes before 20 seeds, if it does.")
    ] = "",
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Write a study with looks: it compares entries with as many seeds as it takes. Trains nothing.

    Every pair is compared. To compare only some pairs, add [[looks.questions]] with these pairs to the file.

    Example: qrlsuite study new width.toml "mlp width=64" "mlp width=32" --task beam6g
    """
    outcome = api.new_study(
        path,
        entries,
        task=task,
        epochs=epochs,
        looks=_numbers(looks),
        alpha=alpha,
        spending=str(spending),
        margin=margin,
        first_seed=first_seed,
        reason=reason,
        runs=runs,
    )
    if json_output:
        typer.echo(json.dumps(outcome.as_dict()))
        return
    print_outcome(outcome)
    typer.echo(f"wrote {path}")
    typer.echo(f"next: {command('study', 'run', str(path), runs=runs)}")


@app.command()
def run(
    name: StudyOrAll,
    seeds: SeedsOption = None,
    epochs: EpochsOption = None,
    budget: BudgetOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be trained, and train nothing.")
    ] = False,
    settings: SetOption = None,
    models: MapOption = None,
    only: OnlyOption = None,
    format_: OutOption = "png",
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    device: DeviceOption = "cpu",
    fresh: FreshOption = False,
    same: SameOption = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train a study's missing seeds, cheapest entry first, and draw its pictures.

    Entries are those that `qrlsuite run` trains, in the same folders: nothing is trained twice. Stop with Ctrl-C at
    any time, or give a --budget; the same command continues. `all` begins with the study that lacks least, so that
    the next answer comes as soon as it can.

    A study with looks is trained look by look, until every pair is decided or the last look was taken. An entry stops
    when all its pairs are closed.

    Examples: qrlsuite study run fig6 --seeds 20 --budget 30min; qrlsuite study run all --budget 8h
    """
    _check_format(format_)
    where = where_of(engine, workers, device, fresh, same)
    limit = budgets.seconds(budget, where.workers)
    if name != ALL and studies.find(name).file.looks is not None:
        _require_none(name, seeds=seeds, epochs=epochs, set=settings, model_map=models, only=only)
        _require_none(name, fresh=fresh, dry_run=dry_run)
        _take_looks(name, where, limit, runs, json_output)
        return
    seed_numbers = None if seeds is None else parse_seeds(seeds)
    speeds = speed.known(runs)
    chosen = _chosen(name, settings, models, only)

    def items_of(members: Sequence[Member]) -> list[runner.PendingEntry]:
        return runner.find_pending(members, runs, where, speeds, seed_numbers, epochs)

    if len(chosen) > 1:
        chosen.sort(key=lambda pair: runner.work_left(items_of(pair[1])))
    everyone = [member for _, members in chosen for member in members]
    every = items_of(everyone)
    if limit is not None:
        runner.check_budget(every, limit, where.workers)
    if dry_run:
        _dry_run(name, runner.dry_run(every, limit, where.workers), json_output)
        return
    for line in require_same_code(runs, [member.entry for member in everyone], where):
        typer.echo(line, err=True)
    session = runner.Session(runs, where, speeds, limit, quiet=json_output)
    results = []
    for study, members in chosen:
        if len(chosen) > 1 and not json_output:
            typer.echo(f"\nstudy {study.name}: {study.file.summary}")
        trained, submitted = session.trained, len(session.submitted)
        try:
            session.run(items_of(members))
        except KeyboardInterrupt:
            if not json_output:
                _say(studies.write(study.name, studies.draw(study, members, runs), runs, format_))
            raise typer.Exit(130) from None
        drawn = studies.write(study.name, studies.draw(study, members, runs), runs, format_)
        if not json_output:
            _say(drawn)
            continue
        content = runner.Overview(study, items_of(members), where.workers).as_dict()
        content |= {"trained": session.trained - trained, "submitted": session.submitted[submitted:]}
        results.append(content | {"pictures": [each.as_dict() for each in drawn]})
    if json_output:
        typer.echo(json.dumps(results if name == ALL else results[0]))
        return
    for line in session.submitted:
        typer.echo(line)
    left_over = runner.cheapest_first(items_of(everyone)) if limit is not None else []
    if left_over and not session.submitted:
        unfinished = ", ".join(
            f"{item.missing.entry.label} ({counted(len(item.missing.todo), 'seed')})"
            for item in left_over[:4]
        )
        more = f" and {len(left_over) - 4} more entries" if len(left_over) > 4 else ""
        typer.echo(f"the budget is used up; left: {unfinished}{more}. The same command continues.")


@app.command()
def draw(
    name: StudyArgument,
    settings: SetOption = None,
    models: MapOption = None,
    only: OnlyOption = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            help="Of every entry these alone: 20, 0:20 or 0,3,10:12; default: all that are finished.",
        ),
    ] = None,
    format_: OutOption = "png",
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Draw a study's pictures from finished seeds; trains nothing.

    The sample complexity of few seeds is another quantity than that of many: --seeds 20 draws equal numbers. Of a study
    with looks, every pair is drawn below its question, and every entry by its steps below threshold.

    Example: qrlsuite study draw degree --published --seeds 20 --format pdf
    """
    _check_format(format_)
    study = studies.find(name)
    if study.file.looks is not None:
        _require_none(name, seeds=seeds, set=settings, model_map=models, only=only)
        pictures = studies.draw_outcome(studies.read_outcome(name, runs))
    else:
        members = runner.select(study, *_changes(settings, models), only or [])
        pictures = studies.draw(study, members, runs, with_published=published, seeds=seeds)
    drawn = studies.write(study.name, pictures, runs, format_)
    if not json_output:
        _say(drawn)
    if not any(each.path for each in drawn):
        reasons = sorted({each.problem for each in drawn})
        more = "" if published else "; --published draws the entries that come with the suite"
        raise OptionError(
            f"study '{study.name}' has no picture yet: {'; '.join(reasons)}: qrlsuite study run {name}{more}"
        )
    if json_output:
        typer.echo(json.dumps({"name": study.name, "pictures": [each.as_dict() for each in drawn]}))


def _check_format(format_: str) -> None:
    if format_ not in ("png", "pdf", "svg"):
        raise OptionError(f"--format {format_}{nearest(format_, ['png', 'pdf', 'svg'])}")


@app.command()
def end(name: StudyArgument, runs: RunsOption = Path("runs")) -> None:
    """End a study with looks before all is decided: open pairs stay open, and it cannot go on.

    Example: qrlsuite study end width.toml
    """
    StudyWithLooks(studies.find(name), runs).end()
    typer.echo(f"ended; what was decided stays: {command('show', name, runs=runs)}")


def _require_none(name: str, **given: object) -> None:
    """Refuse options that would change what a study with looks has fixed."""
    for option, value in given.items():
        if value:
            raise OptionError(
                f"study '{name}' has looks, which fix what is trained: leave --{option.replace('_', '-')} out; "
                f"{command('show', name)} says what it needs"
            )


def _take_looks(name: str, where: Where, budget: float | None, runs: Path, json_output: bool) -> None:
    """Train a study with looks, and say what every look decides."""
    console = Console(stderr=True, quiet=json_output, highlight=False)
    study = StudyWithLooks(studies.find(name), runs)
    session = runner.Session(study.folder, where, speed.known(study.folder, runs), budget, quiet=json_output)
    try:
        outcome = runner.take_looks(study, session, lambda so_far: _say_look(so_far.state.decision, console))
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    if json_output:
        typer.echo(json.dumps(outcome.as_dict()))
        return
    for line in outcome.submitted:
        typer.echo(line)
    print_outcome(outcome)
    if missing := outcome.state.missing:
        lacking = ", ".join(f"{counted(count, 'seed')} of {name}" for name, count in missing.items())
        who = "others train" if budget is None else "the budget is used up, or others train"
        typer.echo(f"{who} {lacking}: repeat this command when they have finished")
    elif outcome.finished:
        typer.echo(f"next: {command('study', 'draw', name, runs=runs)}")


def print_outcome(outcome: StudyOutcome) -> None:
    """Print what a study with looks has come to: tables as wide as there is room, sentences as they are."""
    console = Console(highlight=False, soft_wrap=True, markup=False)
    for part in outcome.parts():
        (table_console() if isinstance(part, Table) else console).print(part)


def _say_look(decision: Decision, console: Console) -> None:
    """Say what the newest look decided, while more is trained."""
    looks = max((len(pair.p) for pair in decision.pairs), default=0)
    if not looks:
        return
    console.print(f"\n[bold]look at {decision.design.looks[looks - 1]} seeds[/bold]")
    for pair in decision.pairs:
        if len(pair.p) == looks:
            console.print(
                f"{versus(pair)}: {pair.verdict} (p = {pair.p[-1]:.2g}, level {pair.levels[-1]:.2g})",
                markup=False,
                soft_wrap=True,
            )


def _numbers(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise OptionError(f"--looks {text}: write numbers of seeds, for example --looks 20,40,60") from None


def _members(
    name: str, settings: list[str] | None, models: list[str] | None, only: list[str] | None
) -> tuple[Study, list[Member]]:
    """Load a study and resolve its entries."""
    study = studies.find(name)
    return study, runner.select(study, *_changes(settings, models), only or [])


def _changes(
    settings: list[str] | None, models: list[str] | None
) -> tuple[list[options.Setting], dict[str, str]]:
    """Parse what is changed in every entry: options, and models by name."""
    mapped = {}
    for word in models or []:
        old, equals, new = (part.strip() for part in word.partition("="))
        if not (old and equals and new):
            raise OptionError(f"--model-map {word}: write MODEL=MODEL, for example vqc-native=vqc-pennylane")
        mapped[old] = new
    return [options.parse_setting(word) for word in settings or []], mapped


def _chosen(
    name: str, settings: list[str] | None, models: list[str] | None, only: list[str] | None
) -> list[tuple[Study, list[Member]]]:
    """Load one study, or all that are registered and have the options and entries that are wanted.

    Raises
    ------
    QrlSuiteError
        If there is none, or one is broken by itself.
    """
    if name != ALL:
        return [_members(name, settings, models, only)]
    changes, chosen, refusals = _changes(settings, models), [], []
    for study in map(studies.find, registry.load().names(specs.StudySpec)):
        try:
            chosen.append((study, runner.select(study, *changes, only or [])))
        except OptionError as error:
            refusals.append(error)
    if refusals and not chosen:
        raise refusals[0]
    for refusal in refusals:
        typer.echo(f"left out: {refusal}", err=True)
    return chosen


def _dry_run(name: str, steps: Sequence[dict[str, Any]], json_output: bool) -> None:
    if json_output:
        typer.echo(json.dumps({"name": name, "steps": steps}))
        return
    for step in steps:
        cost = step["core_seconds_range"]
        text = (
            "of unknown cost"
            if cost is None
            else f"{duration_range(*cost)} of core time for all, {step['basis']}"
        )
        typer.echo(
            f"{step['task']}  {step['label']}: {step['finished']} of {counted(step['seeds'], 'seed')} there, would "
            f"train {step['would_train']} of {step['missing']} missing ({text})"
        )
    if not steps:
        typer.echo("nothing is missing")


def _say(pictures: Sequence[Drawn]) -> None:
    """Say where each picture was written, and what each of its points rests on."""
    for drawn in pictures:
        if drawn.path is None:
            if drawn.problem != NOTHING:
                typer.echo(f"no picture '{drawn.name}': {drawn.problem}")
            continue
        typer.echo(f"wrote {drawn.path}")
        several = len({task for task, _, _ in drawn.seeds}) > 1
        names = {(task, label): f"{task} {label}" if several else label for task, label, _ in drawn.seeds}
        epochs = {(task, label): count for task, label, count in drawn.short}
        lines: dict[str, list[str]] = {}
        for task, label, count in sorted(drawn.seeds, key=lambda point: -point[2]):
            begun = epochs.get((task, label))
            state = (
                counted(count, "seed") if count else f"left out, at epoch {begun}" if begun else "nothing yet"
            )
            lines.setdefault(state, []).append(names[task, label])
        for state, labels in lines.items():
            typer.echo(f"  {state}: {', '.join(labels)}")
