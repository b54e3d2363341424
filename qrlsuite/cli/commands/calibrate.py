"""`qrlsuite calibrate`: how often a significance rule declares a winner where there is none."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption, PublishedOption, RunsOption
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard import calibration, collect, rules
from qrlsuite.leaderboard.board import grid_of, learning_curves, ranking_of
from qrlsuite.leaderboard.calibration import Finding, Job
from qrlsuite.leaderboard.curves import EntryCurves
from qrlsuite.leaderboard.pictures.cells import choose_horizon
from qrlsuite.results import lookup
from qrlsuite.results.text import duration


class PartName(StrEnum):
    """What can be measured."""

    halves = "halves"
    pairs = "pairs"
    boards = "boards"
    power = "power"


def calibrate(
    entries: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ENTRY]...", help="Entries of one task; by default all of it."),
    ] = None,
    rule: Annotated[
        list[str] | None,
        typer.Option("--rule", metavar="NAME", help="The rules; by default intervals and difference."),
    ] = None,
    task: Annotated[str | None, typer.Option("--task", help="Which task, where there are several.")] = None,
    draws: Annotated[
        int, typer.Option("--draws", min=4, help="Simulated pairs per line; a quarter of it for boards.")
    ] = 200,
    part: Annotated[
        list[PartName] | None, typer.Option("--part", help="Only this part; may be repeated.")
    ] = None,
    seeds: Annotated[
        list[str] | None,
        typer.Option(
            "--seeds", metavar="N,M", help="Seeds of a simulated pair; default 100,100 20,20 30,100."
        ),
    ] = None,
    board: Annotated[int, typer.Option("--board", min=2, max=100, help="Entries of a simulated board.")] = 5,
    runs: RunsOption = Path("runs"),
    published: PublishedOption = False,
    json_output: JsonOption = False,
) -> None:
    """Measure how often each rule declares a winner where there is none, and how often it finds one that is there.

    Four parts: `halves` compares random halves of an entry's real runs; `pairs` compares entries simulated from
    one entry's curves, at the seeds that you name; `boards` ranks several simulated equals; `power` simulates an
    entry that takes 10, 25 or 50 percent longer. The rates hold for these curves on this task, and are no
    guarantee for others.

    Example: qrlsuite calibrate --task beam6g --rule difference --draws 1000
    """
    chosen = _entries(runs, published, entries or [], task)
    horizon = choose_horizon(chosen)
    judges = [rules.load(name) for name in dict.fromkeys(rule or ["intervals", "difference"])]
    names = [entry.label.removeprefix(f"{entry.algorithm} ") for entry in chosen]
    if len(set(names)) < len(names):
        names = [entry.name for entry in chosen]
    curves = [
        type(learned)(learned.values, learned.steps_per_epoch, name)
        for learned, name in zip((learning_curves(entry).cut(horizon) for entry in chosen), names)
    ]
    grid = grid_of(ranking_of(chosen))
    jobs = calibration.plan(
        curves,
        grid,
        judges,
        draws,
        parts=[each.value for each in part] if part else calibration.PARTS,
        numbers=[_pair(word) for word in seeds] if seeds else calibration.NUMBERS,
        board=board,
    )
    found = _compute(jobs, json_output)
    if json_output:
        content = {
            "task": chosen[0].task,
            "horizon": horizon,
            "cells": grid.size,
            "board": board,
            "rules": {judge.name: judge.promise for judge in judges},
            "entries": {name: len(entry.seeds) for name, entry in zip(names, chosen)},
            "rates": [finding.as_dict() for finding in found],
        }
        typer.echo(json.dumps(content))
        return
    for heading, lines in tables(found, grid.size, board):
        _show(heading, lines)
    for judge in judges:
        typer.echo(f"'{judge.name}' promises {judge.promise}")
    if said := [words for judge in judges if (words := summary(found, judge.name, board))]:
        typer.echo("\nOn these entries:")
        for words in said:
            typer.echo(f"- {words}")


def _entries(runs: Path, published: bool, names: Sequence[str], task: str | None) -> list[EntryCurves]:
    """Return the entries to simulate from: of one task, with two seeds or more, and trained equally long."""
    lookup.check_tasks(runs, task)
    if names:
        tasks = [task] if task else []
        found = [collect.find(runs, name, published, tasks) for name in dict.fromkeys(names)]
    else:
        found, refused = collect.collect(runs, task, shipped=published)
        for line in refused:
            typer.echo(f"left out: {line}", err=True)
    single = [entry.label for entry in found if len(entry.seeds) < 2]
    if single:
        typer.echo(f"left out, a single seed has no spread: {', '.join(single)}", err=True)
    found = [entry for entry in found if len(entry.seeds) >= 2]
    if not found:
        wanted = f" of task {task}" if task else ""
        raise UnknownNameError(f"{runs} holds no entry{wanted} with two seeds or more: qrlsuite run")
    tasks = sorted({entry.task for entry in found})
    if len({entry.task_hash for entry in found}) > 1:
        raise OptionError(f"the entries belong to several tasks ({', '.join(tasks)}): choose one with --task")
    longest = max(entry.curves.shape[1] for entry in found)
    for entry in found:
        if entry.curves.shape[1] < longest:
            reached = f"at epoch {entry.curves.shape[1]} of {longest}"
            typer.echo(
                f"left out, {reached}: {entry.label}; repeat the `qrlsuite run` that made it", err=True
            )
    found = [entry for entry in found if entry.curves.shape[1] == longest]
    return sorted(found, key=lambda entry: (entry.model, sum(entry.parameters), entry.label))


def _pair(word: str) -> tuple[int, int]:

    first, comma, second = word.partition(",")
    try:
        pair = int(first), int(second if comma else first)
    except ValueError:
        raise OptionError(f"--seeds {word}: write two numbers, for example --seeds 30,100") from None
    if not all(2 <= number <= 10_000 for number in pair):
        raise OptionError(f"--seeds {word}: both numbers must be between 2 and 10000")
    return pair


def _compute(jobs: Sequence[Job], quiet: bool) -> list[Finding]:
    """Run all jobs behind one progress bar, having said how long that will take."""
    console = Console(stderr=True, quiet=quiet, highlight=False)
    seconds = calibration.estimate(jobs)
    total = sum(job.draws for job in jobs)
    console.print(
        f"{len(jobs)} lines, {total} simulated comparisons: about {duration(seconds)} here (three of each kind were "
        "timed); --draws and --part change that. Ctrl-C stops."
    )
    found = []
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as live:
        bar = live.add_task("", total=total)
        for job in jobs:
            live.update(bar, description=f"{job.part}, {job.entry}, {job.rule}")
            found.append(job.run(lambda: live.advance(bar)))
    return found


HEAD = ["entry", "seeds", "rule", "cell, worst", "any cell", "a winner"]


def tables(found: Sequence[Finding], cells: int, board: int) -> list[tuple[str, list[list[str]]]]:
    """Return what was found as tables: a sentence, and rows of which the first is the head."""
    parts = {name: [each for each in found if each.part == name] for name in PartName}
    result = []
    if halves := parts[PartName.halves]:
        rows = [[each.entry, _seeds(each), each.rule, *_cells(each), f"{each.winner:.1%}"] for each in halves]
        for name in dict.fromkeys(each.rule for each in halves):
            rates = [each.winner for each in halves if each.rule == name]
            if len(rates) > 1:
                rows.append([f"over {len(rates)} entries", "", name, "", "", _range(rates)])
        sentence = (
            f"Real runs: random halves of one entry, {halves[0].draws} splits each. Every winner is false. Splits "
            "of an entry share its runs: only the spread over entries says how sure a rate is."
        )
        result.append((sentence, [HEAD, *rows]))
    if pairs := parts[PartName.pairs]:
        rows = [[each.entry, _seeds(each), each.rule, *_cells(each), _winner(each)] for each in pairs]
        sentence = (
            f"Simulated: two entries that are equal, {pairs[0].draws} pairs each. Every winner is false. `cell`: "
            f"different in a given one of the {cells} cells, on average and in the worst; `a winner`: one seems to "
            "outperform the other."
        )
        result.append((sentence, [HEAD, *rows]))
    if boards := parts[PartName.boards]:
        rows = [[each.entry, str(each.n_runs[0]), each.rule, _winner(each)] for each in boards]
        sentence = (
            f"Simulated: boards of {board} equal entries ({board * (board - 1) // 2} pairs), {boards[0].draws} "
            "boards each. How often any of them seems to outperform another:"
        )
        result.append((sentence, [["entry", "seeds", "rule", "boards with a winner"], *rows]))
    if strong := parts[PartName.power]:
        rows = [[each.entry, str(each.n_runs[0]), _slower(each), each.rule, _winner(each)] for each in strong]
        sentence = (
            f"Simulated: one entry takes longer to get as far, {strong[0].draws} pairs each. How often the other is "
            "found to outperform it (power):"
        )
        result.append((sentence, [["entry", "seeds", "slower by", "rule", "found"], *rows]))
    return result


def summary(found: Sequence[Finding], rule: str, board: int) -> str:
    """Return in one sentence what was found about a rule."""
    own = [each for each in found if each.rule == rule]
    equal = [each for each in own if each.part == "pairs" and each.n_runs[0] == each.n_runs[1]]
    parts = []
    if equal:
        seeds = max(each.n_runs[0] for each in equal)
        rates = [each.winner for each in equal if each.n_runs[0] == seeds]
        parts.append(
            f"declares a false winner between two equal entries of {seeds} seeds in {_range(rates)} of cases"
        )
    halves = [each.winner for each in own if each.part == "halves"]
    if halves and not equal:
        parts.append(f"declares a false winner between halves of one entry in {_range(halves)} of splits")
    boards = [each.winner for each in own if each.part == "boards"]
    if boards:
        parts.append(f"finds one somewhere on {_range(boards)} of boards of {board} equals")
    for factor in sorted({each.factor for each in own if each.factor is not None})[:2]:
        rates = [each.winner for each in own if each.factor == factor]
        parts.append(f"finds an entry that takes {factor - 1:.0%} longer to be worse in {_range(rates)}")
    return f"'{rule}' " + "; ".join(parts) if parts else ""


def _range(rates: Sequence[float]) -> str:
    """Write the spread of rates over entries."""
    low, high = f"{min(rates):.1%}", f"{max(rates):.1%}"
    return low if low == high else f"{low} to {high}"


def _seeds(finding: Finding) -> str:
    return f"{finding.n_runs[0]},{finding.n_runs[1]}"


def _slower(finding: Finding) -> str:
    return f"{(finding.factor or 1) - 1:.0%}"


def _winner(finding: Finding) -> str:
    return f"{100 * finding.winner:.1f} ± {finding.error:.1%}"


def _cells(finding: Finding) -> tuple[str, str]:
    mean, worst, anywhere = (
        f"{value or 0:{digits}%}"
        for value, digits in ((finding.cell_mean, ".2"), (finding.cell_worst, ".1"), (finding.any_cell, ".1"))
    )
    return f"{mean.removesuffix('%')}, {worst}", anywhere


def _show(heading: str, rows: Sequence[Sequence[str]]) -> None:

    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False, padding=(0, 1, 0, 0))
    for name in rows[0]:
        justify: Literal["left", "right"] = "left" if name in ("entry", "rule") else "right"
        table.add_column(Text(name), justify=justify, overflow="fold", no_wrap=name != "entry")
    before = None
    for row in rows[1:]:
        shown = ["" if row[0] == before else row[0], *row[1:]]
        before = row[0]
        table.add_row(*(Text(cell) for cell in shown))
    console = Console(highlight=False)
    console.print(Text(heading))
    console.print(table)
