"""Published studies with looks: the study, its log of looks, and the learning curves of its entries.

    <name>/plan.toml                the study as it was when its first seed began
           looks.jsonl              times of the first seed and of each look, and the look's results
           <task>/<entry>/...       like published entries, see `qrlsuite.leaderboard.shelf.published`

Verdicts are not stored: they are computed from the study and the curves.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.leaderboard.boards import tables
from qrlsuite.leaderboard.shelf import PLANS, collect, import_seeds, published
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.export import export as export_entry
from qrlsuite.leaderboard.shelf.import_seeds import Imported
from qrlsuite.results.store import EntryStore, write_atomically
from qrlsuite.studies.looks import FILE, LOG, Curves, Study, in_folder
from qrlsuite.studies.state import State
from qrlsuite.studies.study import StudyFile, dumps, load_kept

PUBLISHED = PLANS
"""The studies with looks that come with the suite."""


def names(begun: bool = False) -> list[str]:
    """Return the names of the studies that come with the suite: all, or only the ones with a look."""
    return sorted(path.parent.name for path in PUBLISHED.glob(f"*/{LOG if begun else FILE}"))


def folder_of(name: str) -> Path | None:
    """Return the folder of a published study, given as that folder or by the name of one that comes with the suite."""
    known = [Path(name), *([PUBLISHED / name] if len(Path(name).parts) == 1 else [])]
    return next(filter(is_published, known), None)


def load(folder: Path) -> StudyFile:
    """Read the study that a folder holds, without its results."""
    return load_kept(folder / FILE).of(str(folder / FILE))


def is_published(path: Path) -> bool:
    """Return whether a folder holds a published study."""
    return (path / FILE).is_file()


def read(folder: Path, labels: bool = True) -> State:
    """Return the state of a published study.

    Parameters
    ----------
    folder:
        The one that `export` wrote.
    labels:
        Check the labels of its entries, see `published.read`.
    """
    if not is_published(folder):
        raise StoreError(
            f"{folder} holds no {FILE}: give a study's file, or a folder that `qrlsuite export` wrote"
        )
    study = Study(load(folder), folder.parent)
    study.folder = folder
    trained, hours = dict[str, Curves](), dict[str, float]()
    for name, entry in study.entries.items():
        path = folder / entry.task.name / entry.name
        trained[name], hours[name] = {}, 0.0
        if not path.is_dir():
            continue
        found = published.read(path, labels)
        if found.record.hash != entry.hash:
            raise StoreError(f"{path} is not the study's entry '{entry.label}' ({entry.hash})")
        if (length := found.curves.shape[1]) < study.epochs:
            raise StoreError(f"{path} has {length} epochs, and its study {study.epochs}")
        for seed in found.seeds:
            study.require_own(name, seed, found.record.plan)
        trained[name], hours[name] = dict(zip(found.seeds, found.curves)), float(sum(found.hours))
    return study.state(trained, hours, begun=any(trained.values()))


def noted(state: State) -> State:
    """Return a study's state with the notes on its entries that stand below every verdict."""
    entries, notes = list[EntryResults](), list[str]()
    for name, entry in state.study.entries.items():
        try:
            found = collect.read(EntryStore.find(state.study.folder, entry)) if state.seeds[name] else None
        except StoreError as error:
            notes.append(str(error))
        else:  # `lost` says what is missing
            entries += [replace(found, own_label=name, asked={})] if found is not None else []
    return replace(state, notes=(*notes, *tables.about(entries)))


def collected(selection: Selection) -> tuple[list[State], list[str]]:
    """Return the outcomes of the selection's studies with looks, and a line for each unreadable study.

    A study in both the results folder and the suite is read from the folder.
    """
    tasks = selection.tasks
    outcomes, refused = in_folder(selection.runs, tasks)
    known = {outcome.study.hash for outcome in outcomes}
    for name in names(begun=True) if selection.published else []:
        try:
            outcome = read(PUBLISHED / name, labels=False)
        except QrlSuiteError as error:
            refused.append(str(error))
            continue
        if outcome.study.hash not in known and (not tasks or outcome.study.task in tasks):
            outcomes.append(outcome)
    return [noted(outcome) for outcome in outcomes], refused


def export(study: Study, out: Path, agents: bool = True) -> Path:
    """Write a study and its finished seeds to `out/<name>`; returns that folder.

    Exported again while the study goes on, it holds more seeds. No file is replaced by a smaller one, and the study's
    own file stays unchanged: it may have been published before its first seed. `agents` writes the trained agents, too.
    """
    state = study.read()
    if not state.begun:
        raise OptionError(f"{study.source}: the study has not begun, so there is nothing to export")
    folder = out / study.name
    if not is_published(folder):
        write_atomically(folder / FILE, dumps(study.file).encode())
    elif (there := Study(load(folder), out).hash) != study.hash:
        raise OptionError(
            f"{folder} holds another study ({there}, this one is {study.hash}): choose another --out"
        )
    for name, entry in study.entries.items():
        held = collect.read_entry(EntryStore.find(study.folder, entry)) if state.seeds[name] else None
        finished = None if held is None else held.reaching(study.epochs)
        if finished is not None:
            export_entry(finished, folder, agents=agents)
    if (log := study.folder / LOG).exists():
        shutil.copyfile(log, folder / LOG)
    read(folder)
    return folder


def import_study(folder: Path, runs: Path) -> list[Imported]:
    """Copy the seeds of a published study to a results folder, where `study run` goes on with it."""
    source = read(folder).study
    study = Study(load(folder), runs)
    study.begin()
    done = [
        import_seeds.import_seeds(store, study.folder, source.hash) for store in import_seeds.sources(folder)
    ]
    log = study.folder / LOG
    if (
        folder / LOG
    ).exists() and b'"look"' not in log.read_bytes():  # the seeds were begun where they were trained
        shutil.copyfile(folder / LOG, log)
    return done
