"""Studies from Python: write, read and run them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite import own, registry, specs
from qrlsuite.api.arguments import Seeds, check_positive, several, where_of
from qrlsuite.engine import budget as budgets
from qrlsuite.engine import missing
from qrlsuite.engine.terminal import Shown, again, command
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, nearest
from qrlsuite.experiment import identity
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.pictures import FORMATS
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.studies import Drawn
from qrlsuite.options import from_mapping
from qrlsuite.results import speed
from qrlsuite.results.seeds import read_seeds
from qrlsuite.results.store import write_atomically
from qrlsuite.results.text import counted
from qrlsuite.studies import looks as with_looks
from qrlsuite.studies import runner as study_runner
from qrlsuite.studies import study as study_files
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome
from qrlsuite.studies.runner import PendingEntry
from qrlsuite.studies.study import Member, Study
from qrlsuite.studies.together import StudiesTogether

ALL = "all"
"""In the place of a study's name: every registered one."""


@dataclass(frozen=True, repr=False)
class StudyRun(Shown):
    """The state of a study after `run_study`.

    Attributes
    ----------
    overview:
        Every entry with its finished and its missing seeds.
    pictures:
        Every picture with its `figure` and file (`path`), or the `problem` why there is none yet.
    trained:
        Seeds that this run finished.
    submitted:
        One line for each entry that was handed to a queue.
    """

    overview: study_runner.Overview
    pictures: tuple[Drawn, ...]
    trained: int
    submitted: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            **self.overview.as_dict(),
            "trained": self.trained,
            "submitted": list(self.submitted),
            "pictures": [each.as_dict() for each in self.pictures],
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show the overview, the paths of pictures, and the seeds in a queue."""
        yield self.overview
        for line in (*(line for picture in self.pictures for line in picture.lines()), *self.submitted):
            yield Text(line)


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
) -> StudyOutcome:
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
        epochs=epochs,
        looks=list(looks),
        alpha=alpha,
        spending=spending,
        margin=margin,
        reason=reason,
    )
    outcome = StudyOutcome(study, study.read())
    write_atomically(file, (_plugins_of(study, file) + study_files.dumps(study.file)).encode())
    return outcome


def _plugins_of(study: StudyWithLooks, file: Path) -> str:
    """Return the line that names the plugins by path of a study's entries, relative to its file; `""` without any."""
    used = {
        source.path: source.name for entry in study.entries.values() for source in identity.plugins(entry)
    }
    paths = [
        Path(os.path.relpath(path, file.absolute().parent)).as_posix()
        for path, name in sorted(used.items())
        if (known := own.of_distribution(name)) is not None and not known.cell
    ]
    return f"plugins = {json.dumps(paths)}\n\n" if paths else ""


def read_study(
    name: str, *more: str, runs: str | PathLike[str] = "runs", published: bool = False
) -> study_runner.Overview | StudyOutcome | StudiesTogether:
    """Read a study's progress: its trained and missing seeds, or the decisions of its looks. Trains nothing.

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
        return StudiesTogether(tuple(_outcome(each, Path(runs)) for each in (name, *more)))
    study, folder = studies.find(name), Path(runs)
    if study.file.looks is not None:
        return studies.read_outcome(name, folder)
    where, members = Where.create(), study.members()
    items = study_runner.find_pending(members, folder, where, speed.known(folder), None, None)
    pairs = studies.decided_pairs(studies.read(Selection(folder, published), members).values())
    counts = studies.published_seeds(items) if published else None
    return study_runner.Overview(study, items, where.workers, pairs, counts)


def _outcome(name: str, runs: Path) -> StudyOutcome:
    """Read a study that must have looks."""
    if studies.find(name).file.looks is None:
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
    format: Literal["png", "pdf", "svg"] = "png",
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    fresh: bool = False,
    same: str | None = None,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> StudyRun | StudyOutcome:
    """Train a study's missing seeds, the cheapest entry first, and draw its pictures.

    Entries and their folders are those of `train`: nothing is trained twice. A study with looks has seeds of its own,
    which are trained look by look, until every pair is decided or the last look was taken. Interrupt it at any time:
    the same call continues, and ends with the same decisions.

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
    budget:
        As for `train`, but stop at a group's end. The same call continues.
    format:
        Format of the pictures, which are written into the results folder.
    engine, workers, device, fresh, same, runs, progress:
        As for `train`.

    Returns
    -------
    StudyRun, or StudyOutcome of a study with looks
        With `pictures`, each with a matplotlib `figure`; an `overview` of the entries; and `as_dict()`. With looks:
        `pairs`, each with its `verdict`, `difference` (the second's mean time below threshold over the first's, minus
        1), `interval`, `p` and `levels` of each look; `finished`; `submitted`; and `as_dict()`.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        For an unknown name, an option or argument that cannot be used, or a `budget` that holds not even one seed.
    QrlSuiteError
        If training failed; finished epochs are kept.
    KeyboardInterrupt
        When it was interrupted and every worker has saved and ended.

    Examples
    --------
    >>> run_study("fig6", seeds=20, budget="30min")  # doctest: +SKIP
    """
    check_format(format)
    check_positive("epochs", epochs)
    where = where_of(engine, workers, device, fresh, same)
    study = studies.find(name)
    chosen = {"options": options, "models": models, "only": only, "--seeds": seeds, "--epochs": epochs}
    if study.file.looks is not None:
        require_unchanged(name, chosen | {"--fresh": fresh})
        return take_looks(study, where, budget, runs, progress)
    work = find_work(name, options, models, several(only), seeds, epochs, budget, where, runs)
    [done] = work.train(format, progress)
    return done


def draw_study(
    name: str,
    *more: str,
    options: Mapping[str, Any] | None = None,
    models: Mapping[str, str] | None = None,
    only: str | Sequence[str] = (),
    seeds: str | None = None,
    format: str = "png",
    runs: str | PathLike[str] = "runs",
    published: bool = False,
) -> tuple[Study, list[Drawn]]:
    """Draw a study's pictures from finished seeds, into the results folder.

    Parameters
    ----------
    name, options, models, only, format, runs:
        As for `run_study`.
    more:
        Further studies with looks, each of another task. The pairs that all studies compare are then drawn together.
    seeds:
        The seeds of every entry to draw; None takes all finished seeds.
    published:
        Draw the published entries, too.

    Raises
    ------
    OptionError
        If there is no picture yet; the message says why.
    """
    check_format(format)
    study, folder = studies.find(name), Path(runs)
    if study.file.looks is not None or more:
        require_unchanged(name, {"options": options, "models": models, "only": only, "--seeds": seeds})
        outcomes = tuple(_outcome(each, folder) for each in (name, *more))
        together = StudiesTogether(outcomes) if more else None
        shown = study.name if together is None else together.name
        pictures = studies.draw_outcome(outcomes[0]) if together is None else studies.draw_together(together)
    else:
        shown = study.name
        members = study_runner.select(study, from_mapping(options), models, several(only))
        pictures = studies.draw(study, members, Selection(folder, published), seeds=seeds)
    drawn = studies.write(shown, pictures, folder, format)
    if not any(each.path for each in drawn):
        reasons = sorted({each.problem for each in drawn})
        hint = "" if published else "; --published draws the entries that come with the suite"
        raise OptionError(
            f"study '{study.name}' has no picture yet: {'; '.join(reasons)}: qrlsuite study run {name}{hint}"
        )
    return study, drawn


def end_study(name: str, *, runs: str | PathLike[str] = "runs") -> None:
    """End a study with looks before all is decided: open pairs stay open, and it cannot go on."""
    StudyWithLooks(studies.find(name), Path(runs)).end()


@dataclass(frozen=True)
class StudyWork:
    """The missing seeds of a study, or of all registered studies.

    Attributes
    ----------
    chosen:
        Studies with their wanted entries; the study that lacks least comes first.
    left_out:
        One line for each study without a wanted entry, if all studies are asked for.
    limit:
        Seconds for all of it; None for no limit.
    """

    chosen: Sequence[tuple[Study, list[Member]]]
    left_out: Sequence[str]
    runs: Path
    where: Where
    speeds: speed.Speeds
    seeds: Sequence[int] | None
    epochs: int | None
    limit: float | None

    def items(self, members: Sequence[Member] | None = None) -> list[PendingEntry]:
        """Return the pending work of entries, each once; None takes the entries of every study."""
        every = [member for _, each in self.chosen for member in each] if members is None else members
        return study_runner.find_pending(every, self.runs, self.where, self.speeds, self.seeds, self.epochs)

    def steps(self) -> list[dict[str, Any]]:
        """Return the planned training as plain values."""
        return study_runner.dry_run(self.items(), self.limit, self.where.workers)

    def train(self, format: str, progress: bool) -> Iterator[StudyRun]:
        """Train study after study, and draw the finished seeds of each; after Ctrl-C, too.

        Raises
        ------
        KeyboardInterrupt
            When the study that was interrupted has been returned.
        QrlSuiteError
            If training failed; finished epochs are kept.
        """
        console = Console(stderr=True, quiet=not progress, highlight=False, soft_wrap=True, markup=False)
        entries = [member.entry for _, members in self.chosen for member in members]
        missing.require_same_code(self.runs, entries, self.where, quiet=not progress)
        session = study_runner.Session(self.runs, self.where, self.speeds, self.limit, not progress)
        for study, members in self.chosen:
            if len(self.chosen) > 1:
                console.print(f"\nstudy {study.name}: {study.file.summary}")
            trained, submitted, interrupt = session.trained, len(session.submitted), None
            try:
                session.run(self.items(members))
            except KeyboardInterrupt as stopped:
                interrupt = stopped
            drawn = studies.write(
                study.name, studies.draw(study, members, Selection(self.runs)), self.runs, format
            )
            overview = study_runner.Overview(study, self.items(members), self.where.workers)
            handed = tuple(session.submitted[submitted:])
            yield StudyRun(overview, tuple(drawn), session.trained - trained, handed)
            if interrupt is not None:
                raise interrupt
        left_over = study_runner.cheapest_first(self.items()) if self.limit is not None else []
        if left_over and not session.submitted:
            names = ", ".join(
                f"{item.missing.entry.label} ({counted(len(item.missing.todo), 'seed')})"
                for item in left_over[:4]
            )
            more = f" and {len(left_over) - 4} more entries" if len(left_over) > 4 else ""
            console.print(f"the budget is used up; left: {names}{more}. The same {again()} continues.")


def find_work(
    name: str,
    options: Mapping[str, Any] | None,
    models: Mapping[str, str] | None,
    only: Sequence[str],
    seeds: Seeds | None,
    epochs: int | None,
    budget: str | None,
    where: Where,
    runs: str | PathLike[str],
) -> StudyWork:
    """Find the missing seeds of a study, or of `all` registered studies; arguments as for `run_study`.

    Raises
    ------
    QrlSuiteError
        If there is no such study or entry, one of all studies is broken by itself, or the budget holds not even one
        seed.
    """
    limit, changes = budgets.seconds(budget, where.workers), from_mapping(options)
    chosen, refusals = list[tuple[Study, list[Member]]](), list[OptionError]()
    for study in map(studies.find, registry.load().names(specs.StudySpec) if name == ALL else [name]):
        try:
            chosen.append((study, study_runner.select(study, changes, models, only)))
        except OptionError as error:
            refusals.append(error)
    if not chosen:
        raise refusals[0]
    folder = Path(runs)
    seed_numbers = None if seeds is None else read_seeds(seeds)
    lines = [str(error) for error in refusals]
    work = StudyWork(chosen, lines, folder, where, speed.known(folder), seed_numbers, epochs, limit)
    if len(chosen) > 1:
        chosen.sort(key=lambda pair: study_runner.work_left(work.items(pair[1])))
    if limit is not None:
        study_runner.check_budget(work.items(), limit, where.workers)
    return work


def take_looks(
    study: Study, where: Where, budget: str | None, runs: str | PathLike[str], progress: bool
) -> StudyOutcome:
    """Train a study with looks until all pairs are decided; print the decisions of every look."""
    subject = StudyWithLooks(study, Path(runs))
    limit, known = budgets.seconds(budget, where.workers), speed.known(subject.folder, Path(runs))
    session = study_runner.Session(subject.folder, where, known, limit, not progress)
    return study_runner.take_looks(subject, session)


def require_unchanged(name: str, given: Mapping[str, object]) -> None:
    """Refuse arguments that would change a study with looks."""
    if words := [word for word, value in given.items() if value]:
        raise OptionError(
            f"study '{name}' has looks, which fix what is trained: leave {', '.join(words)} out; "
            f"{command('show', name)} says what it needs"
        )


def check_format(format: str) -> None:
    """Refuse a picture format that does not exist."""
    if format not in FORMATS:
        raise OptionError(f"--format {format}{nearest(format, FORMATS)}")
