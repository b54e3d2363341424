"""`qrlsuite calibrate`: how often a significance rule declares a winner where there is none."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.text import Text

from qrlsuite.cli.arguments import JsonOption, PublishedOption, RunsOption
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import calibration, findings, rules
from qrlsuite.leaderboard.calibration import CalibrationResult, Job
from qrlsuite.leaderboard.tables import table
from qrlsuite.results.text import duration


class PartName(StrEnum):
    """What can be measured."""

    halves = "halves"
    pairs = "pairs"
    boards = "boards"
    power = "power"
    decisions = "decisions"


def calibrate(
    entries: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ENTRY]...", help="Entries of one task; default: all entries of the task."),
    ] = None,
    rule: Annotated[
        list[str] | None,
        typer.Option("--rule", metavar="NAME", help="The rules; by default the paper's and times."),
    ] = None,
    task: Annotated[str | None, typer.Option("--task", help="The task, if the folder holds several.")] = None,
    draws: Annotated[
        int,
        typer.Option(
            "--draws", min=4, help="Simulated pairs and plans per line; a quarter of it for boards."
        ),
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

    Five parts: `halves` compares random halves of an entry's real runs; `pairs` compares entries simulated from
    one entry's curves, at the seeds that you name; `boards` ranks several simulated equals; `power` simulates an
    entry that takes 10, 25 or 50 percent longer; `decisions` plays the plans of `qrlsuite decide`, between equals
    and against slower entries (with rule times). The rates hold for these curves on this task, and are no guarantee
    for others.

    Example: qrlsuite calibrate --task beam6g --rule paper --draws 1000
    """
    chosen, left_out = calibration.choose(runs, entries or [], task, published)
    for line in left_out:
        typer.echo(f"left out: {line}", err=True)
    judges = [rules.load(name) for name in dict.fromkeys(rule or calibration.RULES)]
    setup = calibration.prepare(chosen)
    jobs = calibration.plan(
        setup.curves,
        setup.grid,
        judges,
        draws,
        parts=[each.value for each in part] if part else calibration.PARTS,
        numbers=[_pair(word) for word in seeds] if seeds else calibration.NUMBERS,
        board=board,
    )
    results = _compute(jobs, json_output)
    if json_output:
        content = {
            "task": chosen[0].task,
            "horizon": setup.horizon,
            "cells": setup.grid.size,
            "board": board,
            "rules": {judge.name: judge.promise for judge in judges},
            "entries": {curves.name: curves.n_runs for curves in setup.curves},
            "rates": [finding.as_dict() for finding in results],
        }
        typer.echo(json.dumps(content))
        return
    for heading, lines in findings.tables(results, setup.grid.size, board):
        _show(heading, lines)
    for judge in judges:
        typer.echo(f"'{judge.name}' promises {judge.promise}")
    if summaries := [
        summary for judge in judges if (summary := findings.summary(results, judge.name, board))
    ]:
        typer.echo("\nOn these entries:")
        for summary in summaries:
            typer.echo(f"- {summary}")


def _pair(word: str) -> tuple[int, int]:

    first, comma, second = word.partition(",")
    try:
        pair = int(first), int(second if comma else first)
    except ValueError:
        raise OptionError(f"--seeds {word}: write two numbers, for example --seeds 30,100") from None
    if not all(2 <= number <= 10_000 for number in pair):
        raise OptionError(f"--seeds {word}: both numbers must be between 2 and 10000")
    return pair


def _compute(jobs: Sequence[Job], quiet: bool) -> list[CalibrationResult]:
    """Run all jobs behind one progress bar, having said how long that will take."""
    console = Console(stderr=True, quiet=quiet, highlight=False)
    seconds = calibration.estimate(jobs)
    total = sum(job.draws for job in jobs)
    console.print(
        f"{len(jobs)} lines, {total} simulated comparisons: about {duration(seconds)} here (three of each kind were "
        "timed); --draws and --part change that. Ctrl-C stops."
    )
    results = []
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
            results.append(job.run(lambda: live.advance(bar)))
    return results


def _show(heading: str, rows: Sequence[Sequence[str]]) -> None:
    """Print a table of findings; an entry is named in its first line only."""
    shown = table(rows[0], left=("entry", "rule"), fixed=[name for name in rows[0] if name != "entry"])
    shown.padding = (0, 1, 0, 0)
    before = None
    for row in rows[1:]:
        shown.add_row(*(Text(cell) for cell in ("" if row[0] == before else row[0], *row[1:])))
        before = row[0]
    console = Console(highlight=False)
    console.print(Text(heading))
    console.print(shown)
