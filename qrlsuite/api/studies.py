"""Studies from Python: write, read and run them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from rich.console import Console, ConsoleOptions, RenderResult

from qrlsuite.api.arguments import Seeds, check_positive, where_of
from qrlsuite.engine import budget as budgets
from qrlsuite.engine import missing
from qrlsuite.engine.terminal import Shown
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, nearest
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.studies import Drawn
from qrlsuite.options import from_mapping
from qrlsuite.results import speed
from qrlsuite.results.seeds import read_seeds
from qrlsuite.results.store import write_atomically
from qrlsuite.studies import looks as with_looks
from qrlsuite.studies import runner as study_runner
from qrlsuite.studies import study as study_files
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome


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
        """Show the overview, and where the pictures are."""
        yield self.overview
        for picture in self.pictures:
            yield (
                f"wrote {picture.path}" if picture.path else f"no picture '{picture.name}': {picture.problem}"
            )


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
        The file, NAME.toml. It can be edited until its first seed begins.
    entries:
        Two or more: `"mlp width=64"`, `"vqc-native qubits=10"`; tuned: `"mlp preset=FILE.toml"`.
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
    write_atomically(file, study_files.dumps(study.file).encode())
    return outcome


def read_study(
    name: str, *, runs: str | PathLike[str] = "runs", published: bool = False
) -> study_runner.Overview | StudyOutcome:
    """Read how far a study is: what is trained and missing of it, or what its looks have decided. Trains nothing.

    Parameters
    ----------
    name:
        A study (`qrlsuite list studies`), a study file's path, or a folder with a published study.
    runs:
        The results folder. A published study with looks that has not begun there is read as it was published.
    published:
        Count the published seeds and pairs of entries, too.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        If there is no such study, or it is malformed.
    StoreError
        If its results are damaged, or were changed after a look.
    """
    study, folder = studies.find(name), Path(runs)
    if study.file.looks is not None:
        return studies.read_outcome(name, folder)
    where, members = Where.create(), study.members()
    items = study_runner.find_pending(members, folder, where, speed.known(folder), None, None)
    pairs = studies.decided_pairs(studies.read(folder, members, published).values())
    counts = studies.published_seeds(items) if published else None
    return study_runner.Overview(study, items, where.workers, pairs, counts)


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

    Entries are those that `train` trains, in the same folders: nothing is trained twice. A study with looks has seeds
    of its own, which are trained look by look, until every pair is decided or the last look was taken. Interrupt it at
    any time: the same call continues, and ends with the same decisions.

    Parameters
    ----------
    name:
        A study (`qrlsuite list studies`), or a study file's path.
    options:
        Options for every entry that has them, in the place of the study's own.
    models:
        Models in the place of others: `{"vqc-pennylane": "vqc-native"}`.
    only:
        Only entries whose group, label or task has this word or one of these; or entries by name. Like `options`,
        `models`, `seeds` and `epochs`, only of a study without looks.
    seeds, epochs:
        As for `train`; None takes each task's protocol.
    budget:
        As for `train`, but stop at a group's end. The same call continues.
    format:
        Of the pictures, which are written into the results folder.
    engine, workers, device, fresh, same, runs, progress:
        As for `train`.

    Returns
    -------
    StudyRun, or StudyOutcome of a study with looks
        With `pictures`, each with a matplotlib `figure`; an `overview` of the entries; and `as_dict()`. With looks:
        `pairs`, each with its `verdict`, `difference` (mean time below threshold of the second over that of the first,
        minus 1), `interval`, `p` and `levels` of each look; `finished`; `submitted`; and `as_dict()`.

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
    if format not in ("png", "pdf", "svg"):
        raise OptionError(f"format = {format!r}{nearest(format, ['png', 'pdf', 'svg'])}")
    check_positive("epochs", epochs)
    where = where_of(engine, workers, device, fresh, same)
    limit = budgets.seconds(budget, where.workers)
    seed_numbers = None if seeds is None else read_seeds(seeds)
    study = studies.find(name)
    names = [only] if isinstance(only, str) else only
    folder = Path(runs)
    if study.file.looks is not None:
        chosen = {
            "options": options,
            "models": models,
            "only": names,
            "seeds": seeds,
            "epochs": epochs,
            "fresh": fresh,
        }
        if given := [option for option, value in chosen.items() if value]:
            raise OptionError(
                f"study '{name}' has looks, which fix what is trained: leave {', '.join(given)} out"
            )
        subject = StudyWithLooks(study, folder)
        known = speed.known(subject.folder, folder)
        return study_runner.take_looks(
            subject, study_runner.Session(subject.folder, where, known, limit, not progress, "call")
        )
    members = study_runner.select(study, from_mapping(options), models, names)
    speeds = speed.known(folder)
    missing.require_same_code(folder, [member.entry for member in members], where)
    items = study_runner.find_pending(members, folder, where, speeds, seed_numbers, epochs)
    if limit is not None:
        study_runner.check_budget(items, limit, where.workers)
    session = study_runner.Session(folder, where, speeds, limit, not progress, "call")
    session.run(items)
    drawn = studies.write(study.name, studies.draw(study, members, folder), folder, format)
    after = study_runner.find_pending(members, folder, where, speeds, seed_numbers, epochs)
    overview = study_runner.Overview(study, after, where.workers)
    return StudyRun(overview, tuple(drawn), session.trained, tuple(session.submitted))
