"""`qrlsuite decide`: which of several entries needs fewer steps, with as many seeds as it takes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    EngineOptionsOption,
    PartitionOption,
    SameOption,
    TimeOption,
    WorkersOption,
    where_of,
)
from qrlsuite.engine.terminal import command, table_console
from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import write_atomically
from qrlsuite.results.text import counted, hours_range
from qrlsuite.statistics.sequential import Decision, Spending
from qrlsuite.studies import looks as with_looks
from qrlsuite.studies import outcome as outcomes
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome

app = typer.Typer(
    no_args_is_help=True,
    help="Compare entries with as many seeds as it takes: write a plan, run it, see what is decided.",
)

PlanArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PLAN.toml", help="A plan that `qrlsuite decide new` wrote, or the name of a published one."
    ),
]

StartedArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PLAN.toml",
        help="A plan, a folder in which `qrlsuite decide export` published one, or a published plan's name.",
    ),
]


@app.command()
def new(
    path: Annotated[Path, typer.Argument(metavar="PLAN.toml", help="The file to write.")],
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
    algorithm: Annotated[
        str | None,
        typer.Option("--algorithm", help="The algorithm of entries that name none; default: the task's."),
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", help="One of the task's presets of settings.")
    ] = None,
    epochs: Annotated[
        int | None, typer.Option("--epochs", min=1, help="Default: the task's protocol.")
    ] = None,
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
            help="Where the plan's seeds begin; default: the first unused block from 10000.",
        ),
    ] = None,
    reason: Annotated[
        str, typer.Option("--reason", help="Why the first look comes before 20 seeds, if it does.")
    ] = "",
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Write a plan: what is compared, at which numbers of seeds, and at which error. Trains nothing.

    Every pair is compared. To compare only some pairs, add [[questions]] with these pairs to the file.

    Example: qrlsuite decide new width.toml "mlp width=64" "mlp width=32" --task beam6g
    """
    if path.suffix != ".toml":
        raise OptionError(f"{path}: a plan's name ends in .toml")
    if path.exists():
        raise OptionError(f"{path} is there already: choose another name, or delete it")
    study = with_looks.write(
        path.stem,
        task,
        entries,
        runs,
        algorithm=algorithm,
        preset=preset,
        epochs=epochs,
        looks=_numbers(looks),
        alpha=alpha,
        spending=spending,
        margin=margin,
        first_seed=first_seed,
        reason=reason,
    )
    study.check()
    write_atomically(path, with_looks.dumps(study.file).encode())
    if json_output:
        typer.echo(json.dumps(_plan_as_dict(study)))
        return
    _show_plan(study)
    typer.echo(f"wrote {path}, hash {study.file.hash}: it can be edited until its first seed begins")
    typer.echo(f"next: {command('decide', 'run', str(path), runs=runs)}")


@app.command()
def show(path: PlanArgument, runs: RunsOption = Path("runs"), json_output: JsonOption = False) -> None:
    """Show a plan: entries, looks, levels of significance, and what it costs at most.

    Example: qrlsuite decide show width.toml
    """
    study = _study(path, runs)
    if json_output:
        typer.echo(json.dumps(_plan_as_dict(study)))
    else:
        _show_plan(study)


@app.command()
def run(
    path: PlanArgument,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    partition: PartitionOption = None,
    time: TimeOption = None,
    engine_options: EngineOptionsOption = None,
    device: DeviceOption = "cpu",
    same: SameOption = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train seeds look by look, until every pair is decided or the last look was taken.

    An entry stops when all its pairs are closed. Stop with Ctrl-C at any time; the same command continues.

    Example: qrlsuite decide run width.toml --workers 8
    """
    study = _study(path, runs)
    where = where_of(engine, workers, partition, time, engine_options, device, same=same)
    console = Console(stderr=True, quiet=json_output, highlight=False)
    try:
        outcome = outcomes.run(
            study, where, json_output, looked=lambda so_far: _say_look(so_far.decision, console)
        )
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    if json_output:
        typer.echo(json.dumps({**outcome.as_dict(), "submitted": list(outcome.submitted)}))
        return
    for line in outcome.submitted:
        typer.echo(line)
    _show_status(outcome)
    if missing := study.missing(outcome.decision):
        lacking = ", ".join(f"{counted(count, 'seed')} of {name}" for name, count in missing.items())
        typer.echo(f"others train {lacking}: repeat this command when they have finished")


@app.command()
def status(
    path: StartedArgument,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show what is decided so far, what each open pair needs, and what was saved. Trains and writes nothing.

    Example: qrlsuite decide status width.toml
    """
    outcome = _outcome(path, runs)
    if json_output:
        typer.echo(json.dumps(outcome.as_dict()))
    else:
        _show_status(outcome)


@app.command()
def plot(
    path: StartedArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="png, pdf or svg; default: NAME-pairs.png or NAME-entries.png, in the current folder.",
        ),
    ] = None,
    entries: Annotated[
        bool, typer.Option("--entries", help="Draw each entry's mean time below threshold instead.")
    ] = False,
    runs: RunsOption = Path("runs"),
) -> None:
    """Draw every pair below its question: which entry needs fewer steps, by how much, and with which interval.

    Examples: qrlsuite decide plot width.toml --out width.pdf; qrlsuite decide plot width.toml --entries
    """
    format_ = pictures.format_of(output)
    outcome = _outcome(path, runs)
    from qrlsuite.leaderboard.pictures import outcome as drawing  # matplotlib

    draw = drawing.draw_entries if entries else drawing.draw
    target = output or Path(f"{outcome.study.file.name}-{'entries' if entries else 'pairs'}.png")
    write_atomically(target, pictures.encode(draw(outcome), format_))
    typer.echo(f"wrote {target}")


@app.command()
def export(
    path: PlanArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Write to DIR/NAME/.")] = Path(
        "leaderboard/plans"
    ),
    runs: RunsOption = Path("runs"),
) -> None:
    """Write a plan with the learning curves of its seeds, so that others can compute its verdicts.

    A plan that goes on may be written again. `qrlsuite decide status DIR/NAME` shows its verdicts, `qrlsuite import
    DIR/NAME` takes its seeds over to go on with it elsewhere, and `qrlsuite verify DIR/NAME --rerun 2`
    trains some of them again.

    Example: qrlsuite decide export width.toml
    """
    folder = published_studies.export(_study(path, runs), out)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    typer.echo(f"wrote {folder} ({size / 1000:.0f} kB)")
    typer.echo(f"next: {command('decide', 'status', str(folder))}")


@app.command()
def end(path: PlanArgument, runs: RunsOption = Path("runs")) -> None:
    """End a plan before all is decided: open pairs stay open, and the plan cannot go on.

    Example: qrlsuite decide end width.toml
    """
    study = _study(path, runs)
    study.end()
    typer.echo(f"ended; what was decided stays: {command('decide', 'status', str(path), runs=runs)}")


def _published(path: Path) -> Path | None:
    """Return the folder of a plan that comes with the suite, where its name was given and no path.

    Raises
    ------
    UnknownNameError
        If nothing has that name, neither a published plan nor a file.
    """
    folder = published_studies.PUBLISHED / path
    if len(path.parts) != 1 or path.suffix == ".toml" or path.exists():
        return None
    if published_studies.is_published(folder):
        return folder
    file = path.with_name(f"{path.name}.toml")
    known = [file.name] if file.exists() else [each.name for each in published_studies.PUBLISHED.iterdir()]
    raise UnknownNameError(f"no file and no published plan is named '{path}'{nearest(path.name, known)}")


def _outcome(path: Path, runs: Path) -> StudyOutcome:
    """Read what a plan has decided; of a published one that has begun in the results folder, there."""
    if (folder := _published(path)) is not None:
        study = _study(path, runs)
        return (
            outcomes.read(folder / published_studies.PLAN, runs)
            if study.begun
            else published_studies.read(folder)
        )
    return published_studies.read(path) if path.is_dir() else outcomes.read(path, runs)


def _study(path: Path, runs: Path) -> StudyWithLooks:
    folder = _published(path)
    file = path if folder is None else folder / published_studies.PLAN
    study = StudyWithLooks(with_looks.load(file), str(path), runs)
    study.check()
    return study


def _numbers(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise OptionError(f"--looks {text}: write numbers of seeds, for example --looks 20,40,60") from None


def _plan_as_dict(study: StudyWithLooks) -> dict[str, Any]:
    plan, family = study.plan, len(study.plan.family)
    looks = range(len(plan.looks))
    return {
        **study.file.model_dump(mode="json"),
        "hash": study.file.hash,
        "begun": study.begun,
        "ended": study.ended,
        "folder": str(study.folder),
        "seeds": format_seeds(study.file.block),
        "names": list(study.entries),
        "levels": [plan.level(look, family) for look in looks],
        "equal_levels": [plan.equal_level(look) for look in looks],
        "core_hours_at_most": {name: outcomes.hours(study, name, plan.looks[-1]) for name in study.entries},
    }


def _show_plan(study: StudyWithLooks) -> None:
    file, plan, family = study.file, study.plan, len(study.plan.family)
    console = Console(highlight=False, soft_wrap=True, markup=False)
    state = f"ended {study.ended}" if study.ended else "begun" if study.begun else "not begun"
    console.print(Text(f"{file.name}: {outcomes.question(study)}", style="bold"))
    console.print(f"written {file.written:%Y-%m-%d %H:%M} UTC, hash {file.hash}, {state}")
    first = next(iter(study.entries.values()))
    steps = file.epochs * first.task.file.protocol.interactions
    console.print(f"task {first.task.name}, {file.epochs} epochs ({steps} steps)")
    for name, entry in study.entries.items():
        console.print(f"  {name}  ({entry.name})")
    console.print(
        f"seeds {format_seeds(file.block)}; any false difference with probability {file.alpha:g} "
        f"({counted(family, 'pair')}, {file.spending} spending); equal within {100 * file.margin:g} percent"
    )
    for asked, pairs in outcomes.by_question(study, plan.family):
        if asked:
            console.print(f"  {asked} {'; '.join(' / '.join(pair) for pair in pairs)}")
    for look, seeds in enumerate(plan.looks):
        equal = plan.equal_level(look)
        equality = "" if equal is None else f"; equal at p <= {equal:.4f} on both sides"
        console.print(
            f"  look at {seeds} seeds: different at p <= {plan.level(look, family):.4f}"
            + (" while all pairs are open" if family > 1 else "")
            + equality
        )
    if note := outcomes.reason_note(study):
        console.print(note)
    total = outcomes.total_hours(study, dict.fromkeys(study.entries, plan.looks[-1]))
    cost = "unknown before a first epoch is trained" if total is None else f"{hours_range(*total)} core-hours"
    console.print(f"at most {len(study.entries) * plan.looks[-1]} seeds: {cost}")


def _say_look(decision: Decision, console: Console) -> None:
    """Say what the newest look decided, while more is trained."""
    looks = max((len(pair.p) for pair in decision.pairs), default=0)
    if not looks:
        return
    console.print(f"\n[bold]look at {decision.plan.looks[looks - 1]} seeds[/bold]")
    for pair in decision.pairs:
        if len(pair.p) == looks:
            console.print(
                f"{outcomes.versus(pair)}: {pair.verdict} (p = {pair.p[-1]:.2g}, level {pair.levels[-1]:.2g})",
                markup=False,
                soft_wrap=True,
            )


def _show_status(outcome: StudyOutcome) -> None:
    console = Console(highlight=False, soft_wrap=True, markup=False)
    for part in outcome.parts():
        (table_console() if isinstance(part, Table) else console).print(part)
