"""`qrlsuite import`: take over seeds trained elsewhere, and learning curves of other programs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import api
from qrlsuite.cli.arguments import JsonOption, RunsOption
from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError
from qrlsuite.experiment.task import EXTERNAL
from qrlsuite.leaderboard.shelf import import_curves, import_seeds, published_studies
from qrlsuite.leaderboard.shelf.import_seeds import Imported
from qrlsuite.options import field_names
from qrlsuite.results import run_files
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import entries
from qrlsuite.results.text import counted


def import_entries(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="PATH|OPTION=VALUE",
            help="Results folders, folders that `export` wrote, or entries' folders in them. Or files with "
            "the curves of other programs: csv (entry,seed,step,score), evaluations.npz, monitor.csv "
            "or progress.csv of Stable-Baselines3, event files of TensorBoard. Options of files: "
            "maximum=BEST, the best possible score: scores become fractions of it; metric=NAME, the "
            "column or scalar that is the score; for a new task thresholds=A,B,..., scores that count "
            "as reached, goal=below where less is better, and every=STEPS between grid points. Where "
            "`import` asks for it: early=solved, early=failed or early=cut for runs that end before "
            "the others; units=same where scales differ tenfold.",
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(
            "--task", help="For files: a task of the suite, or the name of a new one; default: external."
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Take over seeds that were trained elsewhere: they count as trained here, and `run` trains only missing seeds.

    From a results folder, agents and checkpoints are copied too; from an export, its agents. Your copy of a seed stays,
    unless the other one has more epochs. Stop with Ctrl-C at any time; the same command continues.

    Curves of other programs become external entries, which can be compared and drawn as any. At every grid point
    stands the last score at or before it. A path names a run: logs/small/seed-3/evaluations.npz is seed 3 of `small`.

    Examples: qrlsuite import /mnt/cluster/runs; qrlsuite import curves.csv maximum=500
    """
    names, options = divide(words)
    paths = [Path(name) for name in names]
    if not paths:
        raise OptionError("name a folder or files to import: qrlsuite import curves.csv maximum=500")
    files = [path for path in paths if not path.is_dir()]
    given = [*(["--task"] if task is not None else []), *options]
    if files and len(files) < len(paths):
        raise OptionError("import folders and files with separate commands")
    if not files and given:
        raise OptionError(
            next((hint for path in paths if not entries(path) and (hint := run_files.below(path))), "")
            or f"{given[0]} is for files with curves: leave it out for a folder of this suite"
        )
    taken = api.import_curves(files, task=task, runs=runs, **options) if files else None
    done = []
    for each in taken or (each for path in paths for each in _taken(path, runs)):
        done.append(each)
        if json_output:
            continue
        new = f"imported seeds {format_seeds(each.new)}" if each.new else "nothing new"
        known = f", {counted(len(each.known), 'seed')} here already" if each.known else ""
        typer.echo(f"{each.label} on {each.task}: {new}{known}")
        for note in each.notes:
            typer.echo(f"  note: {note}", err=True)
    if json_output:
        typer.echo(json.dumps({"entries": [each.as_dict() for each in done]}))
    elif files:
        for line in import_curves.told(done):
            typer.echo(line)
        names = [each.label.removeprefix(f"{EXTERNAL} ") for each in done]
        words = ["compare", *names] if len(names) == 2 else ["leaderboard"]
        typer.echo(f"next: {command(*words, '--task', done[0].task, runs=runs)}")
    else:
        typer.echo(f"next: {command('runs', runs=runs)}")


def _taken(folder: Path, runs: Path) -> Iterator[Imported]:
    if published_studies.is_published(folder):
        yield from published_studies.import_study(folder, runs)
    else:
        yield from (import_seeds.import_seeds(source, runs) for source in import_seeds.sources(folder))


def divide(words: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Divide words into names and options; a path or an entry may have a `=` in it, too."""
    pairs = {word: word.partition("=") for word in words}
    given = [
        word for word, pair in pairs.items() if pair[1] and pair[0] in field_names(import_curves.Options)
    ]
    return [word for word in words if word not in given], {pairs[word][0]: pairs[word][2] for word in given}
