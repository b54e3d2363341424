"""`qrlsuite decide`: which of several entries needs fewer steps, with as many seeds as it takes."""

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

from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.cli.training import (
    DeviceOption,
    EngineOption,
    EngineOptionsOption,
    PartitionOption,
    TimeOption,
    WorkersOption,
    execution_of,
)
from qrlsuite.engine import execution
from qrlsuite.engine.api import EngineOutcome
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.execution import Execution
from qrlsuite.engine.terminal import command, table_console
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import speed
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import write_atomically
from qrlsuite.results.text import counted, hours_text
from qrlsuite.statistics.planning import runs_at_difference
from qrlsuite.statistics.sequential import Decision, PairDecision, Spending
from qrlsuite.studies import decisions
from qrlsuite.studies.decisions import DecisionStudy

app = typer.Typer(
    no_args_is_help=True,
    help="Compare entries with as many seeds as it takes: write a plan, run it, see what is decided.",
)

PlanArgument = Annotated[
    Path, typer.Argument(metavar="PLAN.toml", help="A plan that `qrlsuite decide new` wrote.")
]


@app.command()
def new(
    path: Annotated[Path, typer.Argument(metavar="PLAN.toml", help="The file to write.")],
    entries: Annotated[
        list[str],
        typer.Argument(metavar="ENTRY ENTRY ...", help="Two or more: 'mlp width=64' 'vqc-native qubits=10'."),
    ],
    task: Annotated[
        str, typer.Option("--task", help="A task (see `qrlsuite list tasks`) or a task file's path.")
    ],
    algorithm: Annotated[
        str | None, typer.Option("--algorithm", help="Of entries that name none; default: the task's.")
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
        float, typer.Option("--margin", help="A smaller difference counts as none: 0.1 is 10 percent.")
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

    Example: qrlsuite decide new width.toml "mlp width=64" "mlp width=32" --task beam6g
    """
    if path.suffix != ".toml":
        raise OptionError(f"{path}: a plan's name ends in .toml")
    if path.exists():
        raise OptionError(f"{path} is there already: choose another name, or delete it")
    study = decisions.write(
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
    write_atomically(path, decisions.dumps(study.file).encode())
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
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train seeds look by look, until every pair is decided or the last look was taken.

    An entry stops when all its pairs are closed. Stop with Ctrl-C at any time; the same command continues.

    Example: qrlsuite decide run width.toml --workers 8
    """
    study = _study(path, runs)
    chosen_execution = execution_of(engine, workers, partition, time, engine_options, device)
    study.begin()
    console = Console(stderr=True, quiet=json_output, highlight=False)
    submitted: list[str] = []
    try:
        decision = study.look()
        while wanted := study.wanted(decision):
            for name, seeds in wanted.items():
                outcome = _train(study, study.entries[name], seeds, chosen_execution, json_output)
                submitted += [outcome.submitted] if outcome.submitted is not None else []
            decision = study.look()
            if study.missing(decision) and study.wanted(decision) == wanted:
                break  # a queue or another process has the seeds
            _say_look(study, decision, console)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    if json_output:
        typer.echo(json.dumps({**_as_dict(study, decision), "submitted": submitted}))
        return
    for line in submitted:
        typer.echo(line)
    _show_status(study, decision)
    if missing := study.missing(decision):
        lacking = ", ".join(f"{counted(count, 'seed')} of {name}" for name, count in missing.items())
        typer.echo(f"others train {lacking}: repeat this command when they have finished")


def _train(
    study: DecisionStudy, entry: Entry, seeds: Sequence[int], chosen_execution: Execution, quiet: bool
) -> EngineOutcome:
    """Train what is missing of an entry's seeds."""
    work = execution.plan(study.folder, entry, chosen_execution, seeds, study.file.epochs)
    if not work.groups and not work.busy:
        return EngineOutcome()
    return execution.train(work, chosen_execution, RunDisplay(work, chosen_execution.workers, quiet=quiet))


@app.command()
def status(path: PlanArgument, runs: RunsOption = Path("runs"), json_output: JsonOption = False) -> None:
    """Show what is decided so far, what each open pair needs, and what was saved. Trains and writes nothing.

    Example: qrlsuite decide status width.toml
    """
    study = _study(path, runs)
    decision = study.decision()
    if json_output:
        typer.echo(json.dumps(_as_dict(study, decision)))
    else:
        _show_status(study, decision)


@app.command()
def end(path: PlanArgument, runs: RunsOption = Path("runs")) -> None:
    """End a plan before all is decided: open pairs stay open, and the plan cannot go on.

    Example: qrlsuite decide end width.toml
    """
    study = _study(path, runs)
    study.end()
    typer.echo(f"ended; what was decided stays: {command('decide', 'status', str(path), runs=runs)}")


def _study(path: Path, runs: Path) -> DecisionStudy:
    study = DecisionStudy(decisions.load(path), str(path), runs)
    study.check()
    return study


def _numbers(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise OptionError(f"--looks {text}: write numbers of seeds, for example --looks 20,40,60") from None


def _plan_as_dict(study: DecisionStudy) -> dict[str, Any]:
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
        "core_hours_at_most": {name: _hours(study, name, plan.looks[-1]) for name in study.entries},
    }


def _hours(study: DecisionStudy, name: str, seeds: int) -> float | None:
    """Return the core-hours of so many seeds of an entry: measured on its own, else estimated; None where unknown."""
    done = len(study.seeds(name))
    if done:
        return seeds * study.hours(name) / done
    found = speed.known(study.folder, study.runs).estimate(study.entries[name], None)
    return None if found.seconds is None else seeds * study.file.epochs * found.seconds / 3600


def _sum(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if len(known) == len(values) else None


def _as_dict(study: DecisionStudy, decision: Decision) -> dict[str, Any]:
    """Return what `status` says, as plain values."""
    missing = study.missing(decision)
    protocol = {name: entry.task.file.protocol.seeds for name, entry in study.entries.items()}
    used = {name: len(study.seeds(name)) for name in study.entries}
    closed = [name for name in study.entries if name not in decision.wanted]
    saved = {name: protocol[name] - used[name] for name in closed if used[name]}
    return {
        "plan": study.file.name,
        "hash": study.file.hash,
        "finished": decision.finished,
        "ended": study.ended,
        "looks_taken": study.taken,
        "reason": study.file.reason or None,
        "pairs": [_pair_as_dict(decision, pair) for pair in decision.pairs],
        "entries": [
            {
                "name": name,
                "entry": entry.name,
                "seeds": used[name],
                "core_hours": study.hours(name),
                "wanted": decision.wanted.get(name),
                "missing": missing.get(name, 0),
            }
            for name, entry in study.entries.items()
        ],
        "next_core_hours": _sum([_hours(study, name, count) for name, count in missing.items()]),
        "protocol_seeds": sum(protocol.values()),
        "seeds_saved": sum(saved.values()),
        "core_hours_saved": _sum([_hours(study, name, count) for name, count in saved.items()]),
    }


def _pair_as_dict(decision: Decision, pair: PairDecision) -> dict[str, Any]:
    plan = decision.plan
    needs = None
    if pair.decided is None:
        look = len(pair.p)
        undecided = sum(not each.differs for each in decision.pairs)
        needs = {
            "seeds": plan.looks[look],
            "level": plan.level(look, undecided),
            "seeds_at_this_difference": runs_at_difference(decision, pair),
        }
    seen = bool(pair.p)
    finite = seen and all(abs(end) < float("inf") for end in (pair.difference, *pair.interval))
    return {
        "first": pair.first,
        "second": pair.second,
        "verdict": pair.verdict,
        "decided": None if pair.decided is None else str(pair.decided),
        "seeds": pair.n_runs,
        "p": list(pair.p),
        "levels": list(pair.levels),
        "difference": pair.difference if finite else None,
        "interval": list(pair.interval) if finite else None,
        "needs": needs,
    }


def _show_plan(study: DecisionStudy) -> None:
    file, plan, family = study.file, study.plan, len(study.plan.family)
    console = Console(highlight=False, soft_wrap=True, markup=False)
    state = f"ended {study.ended}" if study.ended else "begun" if study.begun else "not begun"
    console.print(Text(f"{file.name}: {_question(study)}", style="bold"))
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
    for look, seeds in enumerate(plan.looks):
        equal = plan.equal_level(look)
        words = "" if equal is None else f"; equal at p <= {equal:.4f} on both sides"
        console.print(
            f"  look at {seeds} seeds: different at p <= {plan.level(look, family):.4f}"
            + (" while all pairs are open" if family > 1 else "")
            + words
        )
    _say_reason(study, console)
    hours = [_hours(study, name, plan.looks[-1]) for name in study.entries]
    total = _sum(hours)
    cost = "unknown before a first epoch is trained" if total is None else f"{hours_text(total)} core-hours"
    console.print(f"at most {len(hours) * plan.looks[-1]} seeds: {cost}")


def _question(study: DecisionStudy) -> str:
    names = list(study.entries)
    return f"which needs fewer steps, {', '.join(names[:-1])} or {names[-1]}?"


def _say_reason(study: DecisionStudy, console: Console) -> None:
    if study.plan.looks[0] < 20:
        console.print(
            f"NOTE: it looks below 20 seeds, where rare failures that have not occurred yet decide too much. Reason "
            f"given: {study.file.reason}"
        )


def _say_look(study: DecisionStudy, decision: Decision, console: Console) -> None:
    """Say what the newest look decided, while more is trained."""
    looks = max((len(pair.p) for pair in decision.pairs), default=0)
    if not looks:
        return
    console.print(f"\n[bold]look at {decision.plan.looks[looks - 1]} seeds[/bold]")
    for pair in decision.pairs:
        if len(pair.p) == looks:
            console.print(
                f"{_versus(pair)}: {pair.verdict} (p = {pair.p[-1]:.2g}, level {pair.levels[-1]:.2g})",
                markup=False,
                soft_wrap=True,
            )


def _versus(pair: PairDecision) -> str:
    return f"{pair.first} / {pair.second}"


def _percent(value: float) -> str:
    return f"{100 * value:+.0f}%" if abs(value) < 100 else ("+inf" if value > 0 else "-100%")


def _show_status(study: DecisionStudy, decision: Decision) -> None:
    facts = _as_dict(study, decision)
    console = Console(highlight=False, soft_wrap=True, markup=False)
    console.print(Text(f"{study.file.name}: {_question(study)}", style="bold"))
    if not study.begun:
        console.print("not begun")
    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in ("pair: A / B", "verdict", "seeds", "B against A", "interval", "p", "needs"):
        table.add_column(column, overflow="fold")
    for pair, plain in zip(decision.pairs, facts["pairs"]):
        known = plain["interval"] is not None
        cells = (
            _versus(pair),
            pair.verdict,
            str(pair.n_runs),
            _percent(pair.difference) if known else "",
            f"{_percent(pair.interval[0])} to {_percent(pair.interval[1])}" if known else "",
            f"{pair.p[-1]:.2g}" if pair.p else "",
            _needs(study, plain["needs"]),
        )
        table.add_row(*(Text(cell) for cell in cells))
    table_console().print(table)
    if any(pair.p for pair in decision.pairs):
        console.print(
            "B against A: how much longer B is below the thresholds, with a repeated confidence interval that holds at "
            f"every look ({100 * (1 - study.file.alpha):g} percent for all pairs together). An early stop overstates "
            "the difference."
        )
    for seeds, when in facts["looks_taken"].items():
        console.print(f"look at {seeds} seeds taken {when}")
    _say_reason(study, console)
    if study.ended:
        console.print(f"ended {study.ended}: open pairs stay open")
    elif not decision.finished:
        hours = facts["next_core_hours"]
        cost = "" if hours is None else f", about {hours_text(hours)} core-hours"
        lacking = sum(each["missing"] for each in facts["entries"])
        console.print(f"next look: {counted(lacking, 'seed')} missing{cost}")
    used, spent = (sum(each[key] for each in facts["entries"]) for key in ("seeds", "core_hours"))
    saved, hours = facts["seeds_saved"], facts["core_hours_saved"]
    console.print(
        f"used {counted(used, 'seed')}, {hours_text(spent)} core-hours; the protocol has {facts['protocol_seeds']} "
        f"seeds: {abs(saved)} {'saved' if saved >= 0 else 'more than that'} on "
        "entries that are decided"
        + (f", about {hours_text(abs(hours))} core-hours" if hours and saved else "")
    )


def _needs(study: DecisionStudy, needs: dict[str, Any] | None) -> str:
    if needs is None or study.ended:
        return ""
    words = f"p <= {needs['level']:.2g} at {needs['seeds']} seeds"
    about = needs["seeds_at_this_difference"]
    if about is None:
        return words
    last = study.plan.looks[-1]
    return f"{words}; about {about if about <= 10 * last else f'over {10 * last}'} if the difference is as it looks"
