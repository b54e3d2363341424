"""Entries and studies for others: written as published files, and checked."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite import registry
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.boards import across
from qrlsuite.leaderboard.boards.across import Shares
from qrlsuite.leaderboard.shelf import collect, published, published_studies
from qrlsuite.leaderboard.shelf import verify as checks
from qrlsuite.leaderboard.shelf.changed import changed
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.export import export as write
from qrlsuite.notation import parse_named
from qrlsuite.results.store import write_atomically
from qrlsuite.specs import StudySpec
from qrlsuite.studies.looks import Study

ALL = "all"
"""In the place of entries: every complete one."""


@dataclass(frozen=True)
class Exported:
    """An entry or a study with looks that was written, or why it was not.

    Attributes
    ----------
    entry:
        None for a study.
    folder:
        Where it was written; None where it was left out.
    problem:
        Then the reason.
    """

    entry: EntryResults | None = None
    folder: Path | None = None
    problem: str = ""

    @property
    def size(self) -> int:
        """Bytes of its files."""
        files = [] if self.folder is None else self.folder.rglob("*")
        return sum(file.stat().st_size for file in files if file.is_file())

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        place = {"folder": str(self.folder)}
        if self.entry is None:
            return place
        of_entry = {"task": self.entry.task, "entry": self.entry.name, "label": self.entry.label}
        return {**of_entry, **place, "seeds": len(self.entry.seeds), "bytes": self.size}


def export(
    names: Sequence[str],
    tasks: Sequence[str],
    out: Path | None,
    force: bool,
    agents: bool,
    runs: Path,
) -> Iterator[Exported]:
    """Write entries, studies' entries, or studies with looks as published files.

    Parameters
    ----------
    names:
        Entries or studies; or `all` complete entries.
    tasks:
        Only entries of these tasks; all where empty.
    out:
        The folder; None takes one below leaderboard/.
    force:
        Replace entries with more seeds or epochs.
    agents:
        Whether to write the trained agents, too.
    """
    everything, names = list(names) == [ALL], list(dict.fromkeys(names))
    if not names:
        raise OptionError("name the entries to export, or say `export all`: qrlsuite runs lists them")
    named = {name: studies.find(name) for name in names if not everything and _is_study(name)}
    with_looks = [study for study in named.values() if study.looks is not None]
    if 0 < len(named) < len(names) or 0 < len(with_looks) < len(named):
        raise OptionError(
            "export entries, studies and studies with looks with separate commands: they go to different folders"
        )
    if with_looks and (tasks or force):
        raise OptionError(
            "a study with looks is written whole, and again while it goes on: leave --task and --force out"
        )
    if with_looks:
        for study in with_looks:
            target = out or Path("leaderboard/plans")
            folder = published_studies.export(Study(study, runs), target, agents)
            yield Exported(folder=folder)
        return
    selection = Selection.create(runs, tasks).named()
    if everything or named:
        chosen = [studies.select(name, selection) for name in named] or [collect.collect(selection)]
        selected = list({entry.folder: entry for entries, _ in chosen for entry in entries}.values())
        yield from (Exported(problem=line) for _, refused in chosen for line in refused)
    else:
        selected = [collect.find(selection, name) for name in names]
    target, written = out or Path("leaderboard/unranked" if named else "leaderboard/entries"), 0
    for entry in selected:
        try:
            folder = write(entry, target, force, agents)
        except QrlSuiteError as error:
            if not (everything or named):
                raise
            yield Exported(entry, problem=str(error))
        else:
            written += 1
            yield Exported(entry, folder)
    if not written:
        raise QrlSuiteError(f"no entry was exported: qrlsuite runs --runs {runs} lists the entries of {runs}")


def _is_study(name: str) -> bool:
    registered = registry.load().names(StudySpec)
    return name.endswith(".toml") or name in registered or published_studies.folder_of(name) is not None


def export_rliable(file: Path, tasks: Sequence[str], names: Sequence[str], runs: Path) -> Shares:
    """Write the scores of entries over several tasks to a .npz file, as arrays that rliable reads."""
    if len(tasks) < 2:
        raise OptionError(f"--out {file}: name two tasks or more, as --task A --task B")
    selection = Selection.create(runs, tasks).named()
    entries, refused = across.collected(
        selection.tasks, lambda task: collect.select(selection.of(task), names)
    )
    shares = across.shares(entries, selection.tasks, refused=refused)
    arrays: dict[str, Any] = shares.rliable()
    content = io.BytesIO()
    np.savez(content, **arrays)
    write_atomically(file, content.getvalue())
    return shares


@dataclass(frozen=True)
class ToVerify:
    """Published entries and studies that are to be checked."""

    entries: Sequence[Path]
    studies: Sequence[Path]

    def read_studies(self) -> list[dict[str, Any]]:
        """Check the studies: of each its name, folder, whether it is `ok`, and a `message`."""
        return [_read_study(folder) for folder in self.studies]


def find_published(paths: Sequence[Path], base: str | None) -> ToVerify:
    """Find published entries and studies in folders, or the ones that differ from a git commit.

    Parameters
    ----------
    paths:
        Entries, or folders of entries; empty for the suite's.
    base:
        A git commit; None looks at `paths`.
    """
    if base is not None and paths:
        raise OptionError("give PATH or --base, not both")
    given = list(paths or published.folders())
    of_studies = [path for path in given if published_studies.is_published(path)]
    if base is not None:
        return ToVerify(*changed(base, Path.cwd()))
    return ToVerify([folder for path in given for folder in checks.find(path)], of_studies)


def read_rerun(text: str) -> tuple[checks.Wanted, int | None]:
    """Read how many seeds are trained again, and the number that chose them: `26`, `auto`, `2 choice=31`."""
    wanted, options = parse_named(text, "--rerun ")
    choice = options.pop("choice", None)
    if options or not (wanted == "auto" or wanted.isdecimal()):
        raise OptionError(
            f"--rerun {text}: write a number of seeds, such as --rerun 26, --rerun auto, or --rerun '2 choice=31'"
        )
    if choice is not None and (isinstance(choice, bool) or not isinstance(choice, int) or choice < 0):
        raise OptionError(f"--rerun {text}: choice is a whole number, which an earlier check printed")
    return "auto" if wanted == "auto" else int(wanted), choice


def _read_study(folder: Path) -> dict[str, Any]:
    """Read a published study, with an error message if it is damaged."""
    content = {"study": folder.name, "folder": str(folder)}
    try:
        outcome = published_studies.read(folder)
    except QrlSuiteError as error:
        return {**content, "ok": False, "message": str(error)}
    message = f"study sound: the verdicts of {len(outcome.pairs)} pairs computed again"
    return {**content, "ok": True, "message": message}
