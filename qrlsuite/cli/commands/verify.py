"""`qrlsuite verify`: check published entries."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from qrlsuite.api.publishing import find_published, read_rerun
from qrlsuite.cli.arguments import JsonOption
from qrlsuite.engine.terminal import printable
from qrlsuite.leaderboard.shelf import verify as checks
from qrlsuite.results.progress import Progress as RunProgress


def verify(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[PATH]...", help="Entries, or folders of entries; default: the suite's."),
    ] = None,
    rerun: Annotated[
        str,
        typer.Option(
            "--rerun",
            metavar="N|auto",
            help="Seeds of each entry to train again; auto: as many as find a tenth forged with "
            "probability .95. '2 choice=31' repeats the seeds of an earlier check, by the number that "
            "it printed; this is no new evidence.",
        ),
    ] = "0",
    base: Annotated[
        str | None,
        typer.Option(
            "--base",
            metavar="REV",
            help="In place of PATH: entries and studies in leaderboard/ that differ from this git commit.",
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Check published entries and studies, and train some of their seeds again.

    Files: hashes, names and labels are computed again; every seed must have every epoch, and scores in range.
    With --rerun, seeds of each entry are drawn after its files are read, and trained from nothing; the cost is printed
    first. An entry is `verified` if all curves come out bit for bit. A curve that differs is a failure on the same
    type of machine with the same versions. Elsewhere only its beginning is compared. Parameters and circuit
    executions are counted again. Reports of one digest belong together: one failure among them stands. Exit
    code 1 if an entry fails.

    With --base REV, the command checks the entries and studies of the repository around this folder, below
    leaderboard/, that differ from a commit or are not committed; a file with a name that no published file has is
    refused.

    Example: qrlsuite verify leaderboard/entries --rerun 2
    """
    wanted, choice = read_rerun(rerun)
    found = find_published(paths or [], base)
    checked_studies = found.read_studies()
    if not json_output:
        for study in checked_studies:
            _say(study["ok"], study["study"], study["message"])
    verdicts = []
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        whole = bar.add_task("", total=len(found.entries))
        for index, folder in enumerate(found.entries):

            def report(progress: RunProgress, index: int = index) -> None:
                bar.update(whole, completed=index + progress.epoch / max(1, progress.epochs))

            def announce(text: str) -> None:
                bar.console.print(Text(printable(text)), soft_wrap=True)

            bar.update(whole, description=Text(folder.name).plain, completed=index)
            verdicts.append(checks.verify(folder, wanted, choice, report, announce))
            if not json_output:
                _say(verdicts[-1].ok, verdicts[-1].name, _message(verdicts[-1]))
    if json_output:
        typer.echo(json.dumps({"entries": [v.as_dict() for v in verdicts], "studies": checked_studies}))
    elif base is not None and not found.entries:
        typer.echo(f"no entry differs from {printable(base)}")
    else:
        good = sum(verdict.ok for verdict in verdicts)
        typer.echo(f"{good} of {len(verdicts)} entries ok")
    if not all([*(verdict.ok for verdict in verdicts), *(study["ok"] for study in checked_studies)]):
        raise typer.Exit(1)


def _say(ok: bool, name: str, message: str) -> None:
    typer.echo(f"{'ok    ' if ok else 'FAILED'} {printable(f'{name}: {message}')}")


def _message(result: checks.VerificationResult) -> str:
    """Return an entry's message, with the passed check, and the choice that trains the same seeds again."""
    word = f"{result.check}: " if result.ok and result.seeds else ""
    again = "" if result.choice is None else f" [files {result.digest}; choice={result.choice}]"
    return f"{word}{result.message}{again}"
