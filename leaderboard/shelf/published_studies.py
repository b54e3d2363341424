"""Published decision plans: the plan, its log of looks, and the learning curves of its entries.

    <name>/plan.toml                the plan as it was when its first seed began
           looks.jsonl              when the first seed was begun and each look taken, and what it found
           <task>/<entry>/...       as published entries, see `qrlsuite.leaderboard.shelf.published`

Verdicts are not stored: they are computed from the plan and the curves.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment.entry import Entry
from qrlsuite.leaderboard.shelf import collect, importing, published
from qrlsuite.leaderboard.shelf.export import export as export_entry
from qrlsuite.leaderboard.shelf.importing import Imported
from qrlsuite.leaderboard.shelf.published import PublishedEntry
from qrlsuite.results.store import EntryStore, write_atomically
from qrlsuite.statistics import LearningCurves
from qrlsuite.studies import looks
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome, in_folder

PUBLISHED = Path(__file__).parents[1] / "plans"
"""The plans that come with the suite."""

PLAN, LOG = "plan.toml", "looks.jsonl"


class PublishedStudy(StudyWithLooks):
    """A published plan with its results.

    Parameters
    ----------
    folder:
        The one that `export` wrote.

    Raises
    ------
    QrlSuiteError
        If the plan or an entry is damaged.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(looks.load(folder / PLAN), str(folder / PLAN), folder.parent)
        self.folder = folder
        self._published: dict[str, PublishedEntry] = {}
        for name, entry in self.entries.items():
            if (path := EntryStore.find(folder, entry).path).is_dir():
                self._published[name] = published.read(path)
                if (length := self._published[name].curves.shape[1]) < self.file.epochs:
                    raise StoreError(f"{path} has {length} epochs, and its plan {self.file.epochs}")

    @property
    def begun(self) -> bool:
        """A published plan has begun."""
        return True

    def _records(self, entry: Entry) -> Iterator[tuple[int, Mapping[str, Any]]]:
        for name, each in self._published.items():
            if self.entries[name] == entry:
                yield from ((seed, each.record) for seed in each.seeds if seed in self.file.block)

    def seeds(self, name: str) -> list[int]:
        """Return the seeds of an entry, from the block's first on without a gap."""
        held = set(self._published[name].seeds) if name in self._published else set()
        block = self.file.block
        return list(range(block.start, next((seed for seed in block if seed not in held), block.stop)))

    def hours(self, name: str) -> float:
        """Return the core-hours that an entry's seeds have taken."""
        return float(self._published[name].hours.sum()) if name in self._published else 0.0

    def executions(self, name: str) -> float:
        """Return the circuit executions of an entry's seeds, mean per seed; 0 where it has none."""
        return float(self._published[name].executions.mean()) if name in self._published else 0.0

    def curves(self) -> dict[str, LearningCurves]:
        """Return the learning curves of the published seeds; entries without any are absent."""
        curves = {}
        for name, each in self._published.items():
            rows = [each.seeds.index(seed) for seed in self.seeds(name)]
            if rows:
                values = each.curves[rows, : self.file.epochs]
                curves[name] = LearningCurves(values, each.task_file.protocol.interactions, name)
        return curves


def is_published(path: Path) -> bool:
    """Return whether a folder holds a published plan."""
    return (path / PLAN).is_file()


def read(folder: Path) -> StudyOutcome:
    """Return what a published plan has decided.

    Raises
    ------
    QrlSuiteError
        If it is damaged, or a look now finds something else than it did.
    """
    if not is_published(folder):
        raise StoreError(
            f"{folder} holds no {PLAN}: give a plan's file, or a folder that `decide export` wrote"
        )
    study = PublishedStudy(folder)
    return StudyOutcome(study, study.decision())


def collected(
    runs: Path, tasks: Sequence[str] = (), published: bool = False
) -> tuple[list[StudyOutcome], list[str]]:
    """Return what the plans of a results folder have decided, and a line for each that is unreadable.

    Parameters
    ----------
    tasks:
        Only plans of these tasks; all where empty.
    published:
        With the plans that come with the suite, but for those of which the folder has a copy of its own.
    """
    outcomes, refused = in_folder(runs, tasks)
    known = {outcome.study.file.hash for outcome in outcomes}
    for path in sorted(PUBLISHED.glob(f"*/{PLAN}")) if published else []:
        try:
            outcome = read(path.parent)
        except QrlSuiteError as error:
            refused.append(str(error))
            continue
        task = next(iter(outcome.study.entries.values())).task.name
        if outcome.study.file.hash not in known and (not tasks or task in tasks):
            outcomes.append(outcome)
    return outcomes, refused


def export(study: StudyWithLooks, out: Path) -> Path:
    """Write a plan and its finished seeds to `out/<name>`; returns that folder.

    Written again while the plan goes on, it holds more seeds. Nothing there is replaced by less, and the plan's own
    file stays as it is: it may have been published before its first seed.

    Raises
    ------
    QrlSuiteError
        If the plan has not begun, another plan is in its place, or files cannot be written.
    """
    study.check()
    if not study.begun:
        raise OptionError(f"{study.source}: the plan has not begun, so there is nothing to export")
    folder = out / study.file.name
    if not is_published(folder):
        write_atomically(folder / PLAN, looks.dumps(study.file).encode())
    elif (there := looks.load(folder / PLAN).hash) != study.file.hash:
        raise OptionError(
            f"{folder} holds another plan ({there}, this one is {study.file.hash}): choose another --out"
        )
    for name, entry in study.entries.items():
        held = collect.read_entry(EntryStore.find(study.folder, entry)) if study.seeds(name) else None
        finished = None if held is None else held.reaching(study.file.epochs)
        if finished is not None:
            export_entry(finished, folder)
    if (log := study.folder / LOG).exists():
        shutil.copyfile(log, folder / LOG)
    read(folder)
    return folder


def import_study(folder: Path, runs: Path) -> list[Imported]:
    """Copy the seeds of a published plan to a results folder, where `decide run` goes on with it.

    Raises
    ------
    QrlSuiteError
        If another plan of its name has begun there, or an entry is damaged.
    """
    source = PublishedStudy(folder)
    study = StudyWithLooks(source.file, source.source, runs)
    study.begin()
    done = [
        importing.import_seeds(store, study.folder, source.file.hash) for store in importing.sources(folder)
    ]
    if (folder / LOG).exists() and not study.taken:  # the seeds were begun where they were trained
        shutil.copyfile(folder / LOG, study.folder / LOG)
    return done
