"""`qrlsuite study`: run a paper's experiments by name, and draw their pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import options, registry
from qrlsuite.cli.arguments import JsonOption, PublishedOption, RunsOption
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
from qrlsuite.engine.missing import require_same_code
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError, nearest
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.studies import NOTHING, Drawn
from qrlsuite.results import speed
from qrlsuite.results.seeds import parse_seeds
from qrlsuite.results.text import counted, duration_range
from qrlsuite.studies import runner
from qrlsuite.studies.study import Member, Study, load

app = typer.Typer(no_args_is_help=True, help="A paper's experiments by name: list, status, show, run, draw.")

ALL = "all"
"""In the place of a study's name: every registered one."""

StudyArgument = Annotated[
    str, typer.Argument(metavar="STUDY", help="A study (see `qrlsuite study list`) or a study file's path.")
]
SomeStudies = Annotated[
    list[str] | None, typer.Argument(metavar="[STUDY]...", help="Studies, or files; default: all.")
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


@app.command("list")
def list_studies(json_output: JsonOption = False) -> None:
    """List the studies: those of the suite, and those of plugins.

    Example: qrlsuite study list
    """
    known = registry.load()
    rows = []
    for name in known.names("studies"):
        origin = known.entries["studies"][name].distribution
        file = load(name).file
        rows.append(
            {
                "name": name,
                "summary": file.summary,
                "source": file.source,
                "core_hours": file.core_hours,
                "distribution": origin,
            }
        )
    if json_output:
        typer.echo(json.dumps(rows))
        return
    width = max((len(str(row["name"])) for row in rows), default=0)
    for row in rows:
        origin = "" if row["distribution"] == "qrlsuite" else f"  [{row['distribution']}]"
        typer.echo(f"{row['name']:<{width}}  {row['summary']}{origin}")


@app.command()
def show(
    name: StudyArgument,
    seeds: SeedsOption = None,
    epochs: EpochsOption = None,
    settings: SetOption = None,
    models: MapOption = None,
    only: OnlyOption = None,
    engine: EngineOption = "local",
    workers: WorkersOption = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show a study's entries: finished seeds, missing seeds, and the time the missing ones will take.

    Published seeds are counted beside those that you trained, which alone `qrlsuite study run` continues.

    Example: qrlsuite study show fig7 --published
    """
    where = where_of(engine, workers)
    study, members = _members(name, settings, models, only)
    seed_numbers = None if seeds is None else parse_seeds(seeds)
    items = runner.survey(members, runs, where, speed.known(runs), seed_numbers, epochs)
    counts = studies.published_seeds(items) if published else None
    overview = runner.Overview(study, items, where.workers, counts)
    if json_output:
        typer.echo(json.dumps(overview.as_dict()))
    else:
        table_console().print(overview, soft_wrap=True)


@app.command()
def status(
    names: SomeStudies = None,
    seeds: SeedsOption = None,
    epochs: EpochsOption = None,
    engine: EngineOption = "local",
    workers: WorkersOption = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show every study in a line: finished seeds, decided pairs of entries, and the core-hours of what is missing.

    With --published, the published seeds have a column, and pairs of published entries count as well.

    Example: qrlsuite study status --published
    """
    where = where_of(engine, workers)
    seed_numbers = None if seeds is None else parse_seeds(seeds)
    speeds = speed.known(runs)
    rows = []
    for name in names or registry.load().names("studies"):
        study = _load(name)
        members = study.members()
        items = runner.survey(members, runs, where, speeds, seed_numbers, epochs)
        rows.append((study, items, studies.decided_pairs(studies.read(runs, members, published).values())))
    every = [item for _, items, _ in rows for item in items]
    counts = studies.published_seeds(every) if published else None
    overview = runner.Status(rows, where.workers, counts)
    if json_output:
        typer.echo(json.dumps(overview.as_dict()))
    else:
        table_console().print(overview, soft_wrap=True)


@app.command()
def run(
    name: StudyOrAll,
    seeds: SeedsOption = None,
    epochs: EpochsOption = None,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget", metavar="TIME", help="90s, 30min, 2h: stop at a group's end when it is used up."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be trained, and train nothing.")
    ] = False,
    settings: SetOption = None,
    models: MapOption = None,
    only: OnlyOption = None,
    format_: OutOption = "png",
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
    """Train a study's missing seeds, cheapest entry first, and draw its pictures.

    Entries are those that `qrlsuite run` trains, in the same folders: nothing is trained twice. Stop with Ctrl-C at
    any time, or give a --budget; the same command continues. `all` begins with the study that lacks least, so that
    the next answer comes as soon as it can.

    Examples: qrlsuite study run fig6 --seeds 20 --budget 30min; qrlsuite study run all --budget 8h
    """
    _check_format(format_)
    where = where_of(engine, workers, partition, time, engine_options, device, fresh, same)
    limit = seconds(budget) if budget is not None else None
    seed_numbers = None if seeds is None else parse_seeds(seeds)
    speeds = speed.known(runs)
    chosen = _chosen(name, settings, models, only)

    def items_of(members: Sequence[Member]) -> list[runner.PendingEntry]:
        return runner.survey(members, runs, where, speeds, seed_numbers, epochs)

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
                _say(studies.write(study, members, runs, format_))
            raise typer.Exit(130) from None
        drawn = studies.write(study, members, runs, format_)
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

    The sample complexity of few seeds is another quantity than that of many: --seeds 20 draws equal numbers.

    Example: qrlsuite study draw degree --published --seeds 20 --format pdf
    """
    _check_format(format_)
    study, members = _members(name, settings, models, only)
    drawn = studies.write(study, members, runs, format_, published, seeds)
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


def _load(name: str) -> Study:
    """Load a study whose pictures exist."""
    study = load(name)
    studies.check(study)
    return study


def _members(
    name: str, settings: list[str] | None, models: list[str] | None, only: list[str] | None
) -> tuple[Study, list[Member]]:
    """Load a study and resolve its entries."""
    study = _load(name)
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
    for study in map(_load, registry.load().names("studies")):
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
