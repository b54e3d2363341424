"""`qrlsuite study`: a paper's experiments by name; what they need, what is there, and their pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qrlsuite import options, registry
from qrlsuite.cli import budget as budgets
from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.cli.studying import Item, Session, cheapest_first, check_budget, fitting, survey
from qrlsuite.cli.terminal import table_console
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    EngineOptionsOption,
    PartitionOption,
    Place,
    TimeOption,
    WorkersOption,
    place,
)
from qrlsuite.errors import OptionError, nearest
from qrlsuite.leaderboard import pictures, studies
from qrlsuite.leaderboard.studies import NOTHING, Drawn
from qrlsuite.results import speed
from qrlsuite.results.seeds import parse_seeds
from qrlsuite.results.speed import BASES, Speeds
from qrlsuite.results.store import write_atomically
from qrlsuite.results.text import counted, duration, hours_text
from qrlsuite.studies.study import Member, Study

app = typer.Typer(no_args_is_help=True, help="A paper's experiments by name: list, show, run, draw.")

StudyArgument = Annotated[
    str, typer.Argument(metavar="STUDY", help="A study (see `qrlsuite study list`) or a study file's path.")
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
        help="Another model in the place of one: vqc-native=vqc-pennylane.",
    ),
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        metavar="WORD",
        help="Only entries whose group, label or task has the word, or one of several; or one entry by name.",
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
    from qrlsuite.studies import study

    known = registry.load()
    rows = []
    for name in known.names("studies"):
        origin = known.entries["studies"][name].distribution
        file = study.load(name).file
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
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show what a study would run, what of it is there, and how long the rest will take here.

    Example: qrlsuite study show fig7
    """
    where = place(engine, workers)
    study, members = _members(name, settings, models, only)
    items, _ = _survey(study, name, members, runs, where, seeds, epochs)
    if json_output:
        typer.echo(json.dumps(_as_dict(study, items, where)))
    else:
        _show(study, items, where)


@app.command()
def run(
    name: StudyArgument,
    seeds: SeedsOption = None,
    epochs: EpochsOption = None,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget", metavar="TIME", help="90s, 30min, 2h: stop at a group's end when it is used up."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")
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
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train what is missing of a study, cheapest entry first, and draw its pictures from what is there.

    Entries are those that `qrlsuite run` trains, in the same folders: nothing is trained twice. Stop with Ctrl-C at
    any time, or give a --budget; the same command continues.

    Example: qrlsuite study run fig6 --seeds 20 --budget 30min
    """
    _check_format(format_)
    where = place(engine, workers, partition, time, engine_options, device)
    limit = budgets.seconds(budget) if budget is not None else None
    study, members = _members(name, settings, models, only)
    items, speeds = _survey(study, name, members, runs, where, seeds, epochs)
    if limit is not None:
        check_budget(items, limit, where.workers)
    if dry_run:
        _dry_run(study, items, where, limit, json_output)
        return
    session = Session(runs, where, speeds, limit, quiet=json_output)
    try:
        left_over = session.run(items)
    except typer.Exit:
        if not json_output:
            _draw(study, members, runs, format_, quiet=False)
        raise
    drawn = _draw(study, members, runs, format_, quiet=json_output)
    after, _ = _survey(study, name, members, runs, where, seeds, epochs)
    if json_output:
        content = _as_dict(study, after, where)
        content |= {"trained": session.trained, "submitted": session.submitted, "pictures": drawn}
        typer.echo(json.dumps(content))
        return
    for line in session.submitted:
        typer.echo(line)
    if left_over and not session.submitted:
        words = ", ".join(
            f"{item.plan.entry.label} ({counted(len(item.plan.missing), 'seed')})" for item in left_over[:4]
        )
        more = f" and {len(left_over) - 4} more entries" if len(left_over) > 4 else ""
        typer.echo(f"the budget is used up; left: {words}{more}. The same command continues.")


@app.command()
def draw(
    name: StudyArgument,
    settings: SetOption = None,
    models: MapOption = None,
    only: OnlyOption = None,
    format_: OutOption = "png",
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Draw a study's pictures from what is there, training nothing.

    Example: qrlsuite study draw fig6 --format pdf
    """
    _check_format(format_)
    study, members = _members(name, settings, models, only)
    drawn = _draw(study, members, runs, format_, quiet=json_output)
    if not any(row["file"] for row in drawn):
        reasons = sorted({str(row["problem"]) for row in drawn})
        raise OptionError(
            f"study '{study.name}' has no picture yet: {'; '.join(reasons)}: qrlsuite study run {name}"
        )
    if json_output:
        typer.echo(json.dumps({"name": study.name, "pictures": drawn}))


def _check_format(format_: str) -> None:

    if format_ not in ("png", "pdf", "svg"):
        raise OptionError(f"--format {format_}{nearest(format_, ['png', 'pdf', 'svg'])}")


def _members(
    name: str, settings: list[str] | None, models: list[str] | None, only: list[str] | None
) -> tuple[Study, list[Member]]:
    """Load a study and resolve its entries."""
    from qrlsuite.studies import study

    given = [options.parse_setting(word) for word in settings or []]
    mapped = {}
    for word in models or []:
        old, equals, new = (part.strip() for part in word.partition("="))
        if not (old and equals and new):
            raise OptionError(f"--model-map {word}: write MODEL=MODEL, for example vqc-native=vqc-pennylane")
        registry.model(new)
        mapped[old] = new
    loaded = study.load(name)
    _check_pictures(loaded)
    members = loaded.members(given, mapped)
    if only:
        kept = [m for m in members if any(_mentions(m, word) for word in only)]
        if not kept:
            raise OptionError(f"--only {' --only '.join(only)}: study '{loaded.name}' has no such entry")
        return loaded, kept
    return loaded, members


def _check_pictures(study: Study) -> None:

    studies.check(study)


def _mentions(member: Member, word: str) -> bool:
    entry = member.entry
    return word == entry.name or any(word in text for text in (member.group, entry.label, entry.task.name))


def _survey(
    study: Study,
    name: str,
    members: Sequence[Member],
    runs: Path,
    where: Place,
    seeds: str | None,
    epochs: int | None,
) -> tuple[list[Item], Speeds]:

    wanted = parse_seeds(seeds) if seeds is not None else None
    speeds = speed.known(runs)
    return survey(members, runs, where, speeds, wanted, epochs), speeds


def _as_dict(study: Study, items: Sequence[Item], where: Place) -> dict[str, Any]:
    costs = [item.seconds for item in items]
    known = [cost for cost in costs if cost is not None]
    return {
        **study.file.model_dump(mode="json", exclude={"format_version", "entries", "pictures"}),
        "entries": [item.as_dict() for item in items],
        "workers": where.workers,
        "core_hours_left": sum(known) / 3600,
        "hours_left": sum(known) / 3600 / where.workers,
        "complete_estimate": len(known) == len(costs),
    }


def _show(study: Study, items: Sequence[Item], where: Place) -> None:

    file = study.file
    console = Console(highlight=False, soft_wrap=True)
    console.print(Text(file.summary, style="bold"))
    if file.source:
        console.print(Text(file.source))
    if file.reports:
        console.print(Text(f"Reported there: {file.reports}"))
    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in ("task", "entry", "seeds", "epochs", "core time left", "because"):
        table.add_column(
            column, justify="right" if column in ("seeds", "epochs") else "left", overflow="fold"
        )
    for item in items:
        cost = item.seconds
        busy = f" (+{len(item.plan.busy)} at work)" if item.plan.busy else ""
        table.add_row(
            *(
                Text(cell)
                for cell in (
                    item.plan.entry.task.name,
                    item.plan.entry.label,
                    f"{item.finished}/{len(item.plan.seeds)}{busy}",
                    str(item.plan.epochs),
                    "-" if cost == 0 else "?" if cost is None else duration(cost),
                    "" if cost == 0 else item.estimate.basis,
                )
            )
        )
    if items:
        table_console().print(table)
    else:
        console.print("nothing to train")
    lacking = [item for item in items if item.plan.groups]
    if items and not lacking:
        console.print("everything is there")
    elif items:
        known = sum(item.seconds or 0.0 for item in lacking)
        unknown = sum(item.seconds is None for item in lacking)
        more = f", and {unknown} entries of unknown cost" if unknown else ""
        console.print(
            f"left: about {duration(known / where.workers)} with {where.workers} "
            f"worker{'s' * (where.workers != 1)} ({hours_text(known / 3600)} core-hours{more})"
        )
        for basis in dict.fromkeys(item.estimate.basis for item in lacking):
            console.print(f"  {basis}: {BASES[basis]}")
    if file.core_hours is not None:
        console.print(f"the paper's software needed about {file.core_hours:,.0f} core-hours for all of it")
    console.print(Text(f"pictures: {', '.join(f'{p.name} ({p.kind})' for p in file.pictures)}"))


def _dry_run(
    study: Study, items: Sequence[Item], where: Place, limit: float | None, json_output: bool
) -> None:

    steps: list[dict[str, Any]] = []
    left = limit
    for item in cheapest_first(items):
        chosen = item.plan.missing if left is None else fitting(item, left, where.workers)
        step = {**item.as_dict(), "would_train": len(chosen)}
        steps.append(step)
        if left is not None and item.seconds is not None:
            left -= item.seconds * len(chosen) / len(item.plan.missing) / where.workers
    if json_output:
        typer.echo(json.dumps({"name": study.name, "steps": steps}))
        return
    for step in steps:
        cost = step["core_seconds_left"]
        text = (
            "of unknown cost" if cost is None else f"{duration(cost)} of core time for all, {step['basis']}"
        )
        typer.echo(
            f"{step['task']}  {step['label']}: {step['finished']} of {counted(step['seeds'], 'seed')} there, would "
            f"train {step['would_train']} of {step['missing']} missing ({text})"
        )
    if not steps:
        typer.echo("nothing is missing")


def _draw(
    study: Study, members: Sequence[Member], runs: Path, format_: str, quiet: bool
) -> list[dict[str, Any]]:
    """Draw every picture, write it, and say what it rests on."""
    rows = []
    for drawn in studies.draw(study, members, runs):
        path = runs / f"study-{study.name}-{drawn.name}.{format_}"
        if drawn.figure is not None:
            write_atomically(path, pictures.encode(drawn.figure, format_))
        rows.append(
            {
                "picture": drawn.name,
                "kind": drawn.kind,
                "file": str(path) if drawn.figure is not None else None,
                "problem": drawn.problem or None,
                "seeds": [
                    {"task": task, "label": label, "seeds": count} for task, label, count in drawn.seeds
                ],
                "short": [
                    {"task": task, "label": label, "epochs": count} for task, label, count in drawn.short
                ],
            }
        )
        if not quiet:
            _say(drawn, path)
    return rows


def _say(drawn: Drawn, path: Path) -> None:

    if drawn.figure is None:
        if drawn.problem != NOTHING:
            typer.echo(f"no picture '{drawn.name}': {drawn.problem}")
        return
    typer.echo(f"wrote {path}")
    several = len({task for task, _, _ in drawn.seeds}) > 1
    names = {(task, label): f"{task} {label}" if several else label for task, label, _ in drawn.seeds}
    epochs = {(task, label): count for task, label, count in drawn.short}
    lines: dict[str, list[str]] = {}
    for task, label, count in sorted(drawn.seeds, key=lambda point: -point[2]):
        begun = epochs.get((task, label))
        words = counted(count, "seed") if count else f"left out, at epoch {begun}" if begun else "nothing yet"
        lines.setdefault(words, []).append(names[task, label])
    for words, labels in lines.items():
        typer.echo(f"  {words}: {', '.join(labels)}")
