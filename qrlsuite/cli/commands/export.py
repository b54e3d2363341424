"""`qrlsuite export`: write entries as published files."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from qrlsuite import registry
from qrlsuite.cli.arguments import JsonOption, RunsOption, TasksOption
from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.boards import across as several
from qrlsuite.leaderboard.shelf import collect, published_studies
from qrlsuite.leaderboard.shelf.export import export as write
from qrlsuite.results import lookup
from qrlsuite.results.store import write_atomically
from qrlsuite.results.text import counted
from qrlsuite.specs import StudySpec
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.study import Study


def export(
    entries: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENTRY]...",
            help="Its name or label, or the beginning of one, after [TASK/]; or a study, by its name or file.",
        ),
    ] = None,
    task: TasksOption = None,
    everything: Annotated[bool, typer.Option("--all", help="Every complete entry of the folder.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Write to DIR/TASK/ENTRY/, a study with looks to DIR/NAME/; default: below leaderboard/.",
        ),
    ] = None,
    rliable: Annotated[
        Path | None,
        typer.Option(
            "--rliable",
            metavar="FILE",
            help="Instead, write the scores of the entries of several --task for rliable, {entry: (runs, tasks)}.",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an entry with more seeds or epochs.")
    ] = False,
    without_agents: Annotated[
        bool, typer.Option("--no-agents", help="Write curves alone, without the trained agents.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Write entries for a leaderboard: curves and trained agents of every seed, and how they were made.

    Only finished seeds are written. `qrlsuite verify` checks what was written, and can train some seeds again. A study
    is written as its entries; one with looks with the curves of its seeds, so that others can compute its verdicts
    (`qrlsuite show DIR/NAME`) and go on with it (`qrlsuite import DIR/NAME`); it may be written again while it goes on.

    With --rliable, the share of the horizon that each run spends at or above threshold, mean over the task's
    thresholds (in [0, 1], more is better), of every entry that was trained on all these --task with the same
    options. Read the file for rliable by `dict(numpy.load("FILE.npz"))`.

    Example: qrlsuite export "mlp width=64" --out leaderboard/entries
    """
    tasks = task or []
    if rliable is not None:
        _rliable(rliable, tasks, entries or [], runs, json_output)
        return
    if everything == bool(entries):
        raise OptionError("name the entries to export, or say --all: qrlsuite runs lists them")
    names = list(dict.fromkeys(entries or []))
    named = {name: studies.find(name) for name in names if _is_study(name)}
    with_looks = [study for study in named.values() if study.file.looks is not None]
    if len({*map(_is_study, names)}) > 1 or 0 < len(with_looks) < len(named):
        raise OptionError(
            "export entries, studies and studies with looks by commands of their own: they go to different folders"
        )
    if with_looks:
        _with_looks(with_looks, out or Path("leaderboard/plans"), runs, json_output)
        return
    out = out or Path("leaderboard/unranked" if named else "leaderboard/entries")
    lookup.check_tasks(runs, *tasks)
    if everything or named:
        chosen = [studies.select(name, runs, tasks) for name in named] or [collect.collect(runs, tasks)]
        selected = list({entry.folder: entry for entries, _ in chosen for entry in entries}.values())
        for line in (line for _, refused in chosen for line in refused):
            typer.echo(f"left out: {line}", err=True)
    else:
        selected = [collect.find(runs, name, tasks=tasks) for name in names]
    written = []
    for entry in selected:
        try:
            folder = write(entry, out, force, not without_agents)
        except QrlSuiteError as error:
            if not (everything or named):
                raise
            typer.echo(f"left out: {error}", err=True)
            continue
        size = sum(path.stat().st_size for path in folder.iterdir())
        written.append(
            {
                "task": entry.task,
                "entry": entry.name,
                "label": entry.label,
                "folder": str(folder),
                "seeds": len(entry.seeds),
                "bytes": size,
            }
        )
        if not json_output:
            typer.echo(f"wrote {folder} ({counted(len(entry.seeds), 'seed')}, {size / 1000:.0f} kB)")
    if not written:
        raise QrlSuiteError(
            f"{runs} holds no complete entry: qrlsuite runs --runs {runs} lists what it holds"
        )
    if json_output:
        typer.echo(json.dumps(written))
    else:
        typer.echo(f"next: {command('verify', str(out), '--rerun', '2')}")


def _is_study(name: str) -> bool:
    registered = registry.load().names(StudySpec)
    return name.endswith(".toml") or name in registered or published_studies.folder_of(name) is not None


def _with_looks(chosen: Sequence[Study], out: Path, runs: Path, json_output: bool) -> None:
    """Write studies with looks."""
    folders = [published_studies.export(StudyWithLooks(study, runs), out) for study in chosen]
    if json_output:
        typer.echo(json.dumps([{"folder": str(folder)} for folder in folders]))
        return
    for folder in folders:
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        typer.echo(f"wrote {folder} ({size / 1000:.0f} kB)")
    typer.echo(f"next: {command('show', str(folders[-1]))}")


def _rliable(
    file: Path,
    tasks: list[str],
    names: list[str],
    runs: Path,
    json_output: bool,
) -> None:
    """Write rliable's arrays."""
    if len(tasks) < 2:
        raise OptionError("--rliable: name two tasks or more, as --task A --task B")
    if file.suffix != ".npz":
        raise OptionError(f"--rliable {file}: the file's ending must be .npz")
    collect.check_tasks(runs, tasks)
    entries, refused = several.collected(tasks, lambda task: collect.select(runs, [task], names))
    shares = several.shares(entries, tasks, refused=refused)
    arrays: dict[str, Any] = shares.rliable()
    content = io.BytesIO()
    np.savez(content, **arrays)
    write_atomically(file, content.getvalue())
    if json_output:
        shapes = {name: list(values.shape) for name, values in arrays.items()}
        typer.echo(json.dumps({"file": str(file), "tasks": list(shares.tasks), "shapes": shapes}))
        return
    for line in shares.refused:
        typer.echo(f"left out: {line}", err=True)
    for name, values in arrays.items():
        typer.echo(f"{name}: {values.shape[0]} runs, {values.shape[1]} tasks")
    typer.echo(f"wrote {file}; in Python: scores = dict(numpy.load({str(file)!r}))")
