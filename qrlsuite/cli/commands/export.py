"""`qrlsuite export`: write entries as published files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.api.publishing import export as export_each
from qrlsuite.api.publishing import export_rliable
from qrlsuite.cli.arguments import JsonOption, RunsOption, TasksOption, entries_here
from qrlsuite.engine.terminal import command
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import counted
from qrlsuite.statistics import MIN_RUNS


def export(
    entries: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENTRY]...",
            help="Its name or label, or the beginning of one, after [TASK/]; or a study, by its name or file; or `all` "
            "complete entries of the folder.",
            autocompletion=entries_here,
        ),
    ] = None,
    task: TasksOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR|FILE.npz",
            help="Write to DIR/TASK/ENTRY/, a study with looks to DIR/NAME/; default: below leaderboard/. To FILE.npz: "
            "the scores of the entries of several --task for rliable, {entry: (runs, tasks)}.",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an entry with other seeds or more epochs.")
    ] = False,
    without_agents: Annotated[
        bool, typer.Option("--no-agents", help="Write curves alone, without the trained agents.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Write entries for a leaderboard: curves and trained agents of every seed, and how they were made.

    Only finished seeds are written. `qrlsuite verify` checks the files, and can train some seeds again. A study
    is written as its entries; one with looks with the curves of its seeds, so that others can compute its verdicts
    (`qrlsuite show DIR/NAME`) and go on with it (`qrlsuite import DIR/NAME`); it may be written again while it goes on.

    FILE.npz holds the share of the horizon that each run spends at or above threshold, mean over the task's thresholds
    (in [0, 1], more is better), for every entry that was trained on all these --task with the same options. Read the
    file for rliable by `dict(numpy.load("FILE.npz"))`.

    Example: qrlsuite export "mlp width=64" --out leaderboard/entries
    """
    if out is not None and out.suffix == ".npz":
        _rliable(out, task or [], entries or [], runs, json_output)
        return
    written = []
    for each in export_each(entries or [], task or [], out, force, not without_agents, runs):
        if each.folder is None:
            typer.echo(f"left out: {each.problem}", err=True)
            continue
        written.append(each)
        if not json_output:
            seeds = "" if each.entry is None else f"{counted(len(each.entry.seeds), 'seed')}, "
            typer.echo(f"wrote {each.folder} ({seeds}{each.size / 1000:.0f} kB)")
            for line in () if each.entry is None else shortfalls(each.entry):
                typer.echo(f"  {line}")
    if json_output:
        typer.echo(json.dumps([each.as_dict() for each in written]))
    elif written[-1].entry is None:
        typer.echo(f"next: {command('show', str(written[-1].folder))}")
    else:
        last = Path(str(written[-1].folder))
        target = last if len(written) == 1 else last.parents[1]
        typer.echo(f"next: {command('verify', str(target), '--rerun', '2')}")


def shortfalls(entry: EntryResults) -> Iterator[str]:
    """Return the reasons why a public board would not rank an entry, or could not check it."""
    protocol, epochs = entry.task_file.protocol, entry.curves.shape[1]
    whole = protocol.algorithm_epochs.get(entry.algorithm, protocol.epochs)
    if len(entry.seeds) < protocol.seeds or epochs < whole:
        yield (
            f"{len(entry.seeds)} of {protocol.seeds} seeds, {epochs} of {whole} epochs of the protocol: boards rank "
            f"entries with {MIN_RUNS} seeds or more"
        )
    if entry.plugins:
        yield (
            f"made with {', '.join(sorted(entry.plugins))}, which the export does not contain: `verify` "
            "needs --plugin PATH, and a public board needs an issue first (docs/publish.md)"
        )


def _rliable(file: Path, tasks: list[str], names: list[str], runs: Path, json_output: bool) -> None:
    shares = export_rliable(file, tasks, names, runs)
    arrays = shares.rliable()
    if json_output:
        shapes = {name: list(values.shape) for name, values in arrays.items()}
        typer.echo(json.dumps({"file": str(file), "tasks": list(shares.tasks), "shapes": shapes}))
        return
    for line in shares.refused:
        typer.echo(f"left out: {line}", err=True)
    for name, values in arrays.items():
        typer.echo(f"{name}: {values.shape[0]} runs, {values.shape[1]} tasks")
    typer.echo(f"wrote {file}; in Python: scores = dict(numpy.load({str(file)!r}))")
