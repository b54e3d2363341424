"""Studies from Python: write, read and run them."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

from rich.console import Console

from qrlsuite import registry, specs
from qrlsuite.api.arguments import Seeds, check_positive, several, where_of
from qrlsuite.engine import missing
from qrlsuite.engine.budget import seconds
from qrlsuite.engine.terminal import command
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError
from qrlsuite.experiment import identity
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.options import from_mapping
from qrlsuite.results.seeds import read_seeds
from qrlsuite.results.store import write_atomically
from qrlsuite.studies import looks as with_looks
from qrlsuite.studies import runner as study_runner
from qrlsuite.studies import study as study_files
from qrlsuite.studies.looks import Study
from qrlsuite.studies.runner import Overview
from qrlsuite.studies.state import State
from qrlsuite.studies.study import Member, StudyFile
from qrlsuite.studies.together import StudiesTogether, together

ALL = "all"
"""In the place of a study's name: every registered one."""


def new_study(
    path: str | PathLike[str],
    entries: Sequence[str],
    *,
    task: str,
    epochs: int | None = None,
    looks: Sequence[int] = (20, 40, 60, 80, 100),
    alpha: float = ALPHA,
    spending: str = "pocock",
    margin: float = 0.1,
    first_seed: int | None = None,
    reason: str = "",
    runs: str | PathLike[str] = "runs",
) -> State:
    """Write a study with looks, which compares entries with as many seeds as it takes. Trains nothing.

    Parameters
    ----------
    path:
        The file, NAME.toml. It names the plugins by path of its entries, and can be edited until its first seed begins.
    entries:
        Two or more: `"mlp width=64"`, `"vqc-native qubits=10"`; tuned: `"mlp preset=FILE.toml"`; with a name:
        `"wide: mlp width=64"`.
    task, epochs:
        As for `train`.
    looks:
        Seeds of each entry at each look.
    alpha, spending:
        Probability of any false difference over all pairs and looks, and how it is spent over the looks.
    margin:
        Entries that differ by less count as equal: 0.1 is 10 percent.
    first_seed:
        Where the study's seeds begin; None takes the first block from 10,000 that is unused in `runs`.
    reason:
        Why the first look comes before 20 seeds, if it does.

    Raises
    ------
    OptionError, UnknownNameError
        If the file is there already, or a name or number cannot be used.
    """
    file = Path(path)
    if file.suffix != ".toml":
        raise OptionError(f"{file}: a study file's name ends in .toml")
    if file.exists():
        raise OptionError(f"{file} is there already: choose another name, or delete it")
    study = with_looks.new(
        file.stem,
        task,
        entries,
        Path(runs),
        first_seed=first_seed,
        folder=file.parent,
        epochs=epochs,
        looks=list(looks),
        alpha=alpha,
        spending=spending,
        margin=margin,
        reason=reason,
    )
    outcome = study.read()
    write_atomically(file, (_plugins_of(study, file) + study_files.dumps(study.file)).encode())
    return outcome


def _plugins_of(study: Study, file: Path) -> str:
    """Return the line that names the plugins by path of a study's entries, relative to its file; `""` without any."""
    used = {source.path for entry in study.entries.values() for source in identity.plugins(entry)}
    paths = [Path(os.path.relpath(path, file.absolute().parent)).as_posix() for path in sorted(used)]
    return f"plugins = {json.dumps(paths)}\n\n" if paths else ""


def read_study(
    name: str, *more: str, runs: str | PathLike[str] = "runs", published: bool = False
) -> Overview | State | StudiesTogether:
    """Read a study's progress: its trained and missing seeds, or the verdicts of its looks. Trains nothing.

    Parameters
    ----------
    name:
        A study (`qrlsuite list studies`), a study file's path, or a folder with a published study.
    more:
        Further studies with looks, each of another task. The pairs that all studies compare are then read together, on
        average over the tasks.
    runs:
        The results folder. A study with looks that has not begun there is read in its published form.
    published:
        Count the published seeds and pairs of entries, too.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        If there is no such study, or it is malformed, or several cannot be read together.
    StoreError
        If its results are damaged, or were changed after a look.
    """
    if more:
        return together([_outcome(each, Path(runs)) for each in (name, *more)])
    study, folder = studies.find(name), Path(runs)
    if study.looks is not None:
        return studies.read_outcome(name, folder)
    members = study.members()
    shown = overview(study, members, folder, Where.create())
    pairs = studies.decided_pairs(studies.read(Selection(folder, published), members).values())
    counts = studies.published_seeds(shown.works) if published else None
    return replace(shown, pairs=pairs, published=counts)


def overview(
    study: StudyFile,
    members: Sequence[Member],
    runs: Path,
    where: Where,
    seeds: Seeds | None = None,
    epochs: int | None = None,
) -> Overview:
    """Return the trained and the missing seeds of a study's entries; arguments as for `run_study`."""
    numbers = None if seeds is None else read_seeds(seeds)
    works = study_runner.find_missing(members, runs, where, numbers, epochs)
    return Overview(study, members, works, where.workers)


def _outcome(name: str, runs: Path) -> State:
    """Read a study that must have looks."""
    if studies.find(name).looks is None:
        raise OptionError(f"study '{name}' has no looks: only studies with looks are read together")
    return studies.read_outcome(name, runs)


def run_study(
    name: str,
    *,
    options: Mapping[str, Any] | None = None,
    models: Mapping[str, str] | None = None,
    only: str | Sequence[str] = (),
    seeds: Seeds | None = None,
    epochs: int | None = None,
    budget: str | None = None,
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    same: str | None = None,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> Overview | State:
    """Train a study's missing seeds, the entry that lacks least first.

    `train` uses the same entries and folders: nothing is trained twice. A study with looks has seeds of its own,
    which are trained look by look, until every pair is decided or the last look was taken. Interrupt it at any time:
    the same call continues, and ends with the same verdicts.

    Parameters
    ----------
    name:
        A study (`qrlsuite list studies`), or a study file's path.
    options:
        Options for every entry that has them; they replace the study's own.
    models:
        Models that replace others: `{"vqc-pennylane": "vqc-native"}`.
    only:
        Words that select entries by group, label or task; or names of entries. Like `options`, `models`, `seeds` and
        `epochs`, only for a study without looks.
    seeds, epochs:
        As for `train`; None takes each task's protocol.
    budget, engine, workers, device, same, runs, progress:
        As for `train`.

    Returns
    -------
    Overview, or State of a study with looks
        The entries with their trained and missing seeds; `submitted`; and `as_dict()`. With looks: `pairs`, each with
        its `verdict`, `difference` (the second's mean steps below threshold over the first's, minus 1), `interval`, `p`
        and `levels` of each look; `finished`; `submitted`; and `as_dict()`.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        For an unknown name, or an option or argument that cannot be used.
    QrlSuiteError
        If training failed; finished epochs are kept.
    KeyboardInterrupt
        When it was interrupted and every worker has saved and ended.

    Examples
    --------
    >>> run_study("fig6", seeds=20, budget="30min")  # doctest: +SKIP
    """
    check_positive("epochs", epochs)
    where = where_of(engine, workers, device, same)
    study = studies.find(name)
    chosen = {"options": options, "models": models, "only": only, "--seeds": seeds, "--epochs": epochs}
    if study.looks is not None:
        require_unchanged(name, chosen)
        return take_looks(study, where, budget, runs, progress)
    [found], _ = find_studies(name, options, models, several(only), seeds, epochs, where, runs)
    [done] = train_studies([found], where, budget, progress)
    return done


def find_studies(
    name: str,
    options: Mapping[str, Any] | None,
    models: Mapping[str, str] | None,
    only: Sequence[str],
    seeds: Seeds | None,
    epochs: int | None,
    where: Where,
    runs: str | PathLike[str],
) -> tuple[list[Overview], list[str]]:
    """Find the missing seeds of a study, or of `all` registered studies; arguments as for `run_study`.

    Returns
    -------
    tuple
        The studies with a wanted entry, the study that lacks least first; and one line for each other one of `all`.
    """
    changes = from_mapping(options)
    found, refusals = list[Overview](), list[OptionError]()
    for study in map(studies.find, registry.load().names(specs.StudySpec) if name == ALL else [name]):
        try:
            members = study_runner.select(study, changes, models, only, each=name != ALL)
        except OptionError as error:
            refusals.append(error)
        else:
            found.append(overview(study, members, Path(runs), where, seeds, epochs))
    if not found:
        raise refusals[0]
    found.sort(key=lambda each: sum(work.left for work in each.works))
    return found, [str(error) for error in refusals]


def train_studies(
    every: Sequence[Overview], where: Where, budget: str | None, progress: bool
) -> Iterator[Overview]:
    """Train study after study until the budget ends; yield what each has and lacks then."""
    console = Console(stderr=True, quiet=not progress, highlight=False, soft_wrap=True, markup=False)
    missing.check_budget(budget, where)
    began = time.monotonic()
    if works := [work for each in every for work in each.works]:
        missing.settle_codes(works[0].runs, [work.entry for work in works], where, quiet=not progress)
    limit = seconds(budget, where.workers)
    for place, each in enumerate(every):
        if place and limit is not None and time.monotonic() - began >= limit:
            return
        if len(every) > 1:
            console.print(f"\nstudy {each.study.name}: {each.study.summary}")
        now = each.now(where)
        submitted = study_runner.train_missing(now.works, where, budget, began, not progress)
        yield replace(now.now(where), submitted=submitted)


def end_study(name: str, *, runs: str | PathLike[str] = "runs") -> None:
    """End a study with looks before all is decided: open pairs stay open, and it cannot go on."""
    Study(studies.find(name), Path(runs)).end()


def take_looks(
    study: StudyFile, where: Where, budget: str | None, runs: str | PathLike[str], progress: bool
) -> State:
    """Train a study with looks until all pairs are decided; print the verdicts of every look."""
    missing.check_budget(budget, where)
    return published_studies.noted(
        study_runner.take_looks(Study(study, Path(runs)), where, budget, not progress)
    )


def require_unchanged(name: str, given: Mapping[str, object]) -> None:
    """Refuse arguments that would change a study with looks."""
    if words := [word for word, value in given.items() if value]:
        raise OptionError(
            f"study '{name}' has looks, which fix what is trained: leave {', '.join(words)} out; "
            f"{command('show', name)} says what it needs"
        )
