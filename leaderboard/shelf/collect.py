"""Reading entries for ranking: every number of a leaderboard is computed from raw curves."""

from __future__ import annotations

import functools
import operator
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from qrlsuite.engine.terminal import printable
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, UnknownNameError
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.experiment.task import TaskFile
from qrlsuite.leaderboard.shelf import published as published_entries
from qrlsuite.leaderboard.shelf.curves import (
    BESIDE,
    DifferentCurvesError,
    EntryResults,
    current,
    require_scores,
)
from qrlsuite.results import codes, genuine, lookup, probes, requests
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import ANOTHER_FOLDER, EntryStore, SeedRun, entries
from qrlsuite.results.text import counted
from qrlsuite.statistics.compare import MIN_RUNS

Key = tuple[str, str]
"""An entry's task and name."""


@dataclass(frozen=True)
class Selection:
    """The entries to read, and their source.

    Attributes
    ----------
    published:
        Whether to read the published entries that come with the suite, too. `runs` need not exist then.
    tasks:
        The tasks whose entries are read, all if empty: their names, or before `named` the user's words.
    only:
        The only entries to read, of studies or not, whatever their task; None for the entries that boards rank.
    all_codes:
        Whether to read each entry of every code, and not only of the newest code with enough seeds to rank.
    labels:
        The reader's names for entries, `ENTRY=TEXT` each.
    """

    runs: Path
    published: bool = False
    tasks: tuple[str, ...] = ()
    only: Collection[Key] | None = None
    all_codes: bool = False
    labels: tuple[str, ...] = ()

    @classmethod
    def create(
        cls,
        runs: str | PathLike[str],
        task: str | Sequence[str] | None = None,
        published: bool = False,
        labels: Mapping[str, str] | Sequence[str] | None = None,
    ) -> Selection:
        """Make a selection from the arguments of a command or of `qrlsuite.api`; tasks stay in the user's words."""
        words = (
            [f"{entry}={text}" for entry, text in labels.items()] if isinstance(labels, Mapping) else labels
        )
        tasks = (task,) if isinstance(task, str) else tuple(task or ())
        return cls(Path(runs), published, tasks, labels=tuple(words or ()))

    def of(self, *tasks: str) -> Selection:
        """Return the selection of other tasks."""
        return replace(self, tasks=tasks)

    def named(self) -> Selection:
        """Return the selection with the names of its tasks, see `qrlsuite.results.lookup.task_names`."""
        return self.of(*lookup.task_names(self.runs, self.tasks, also=self.folders[1:]))

    @property
    def folders(self) -> list[Path]:
        """The results folder, and the folders of published entries."""
        return [self.runs, *(published_entries.folders() if self.published else ())]

    @functools.cached_property
    def stored(self) -> list[lookup.Stored]:
        """Names and labels of the entries, of boards and of studies; read once for all names that are looked up."""
        tasks = self.tasks
        stores = _stores(self, of_studies=True)
        found = lookup.stored(store for store in stores if not tasks or _task(store) in tasks)
        return [entry for entry in found if not tasks or entry.task in tasks]

    @functools.cached_property
    def _own_labels(self) -> dict[tuple[str, str, str], str]:
        """The reader's names by the keys of entries, of which the longest that fits begins a word of `labels`."""
        found: dict[tuple[str, str, str], str] = {}
        for word in self.labels:
            parts = word.split("=")
            splits = [("=".join(parts[:k]), "=".join(parts[k:])) for k in range(len(parts) - 1, 0, -1)]
            name, text = next(
                (split for split in splits if lookup.fitting(self.stored, split[0])), (word, "")
            )
            fitting = lookup.fitting(self.stored, name)
            if len({entry.name for entry in fitting}) != 1:
                lookup.choose(self.stored, parts[0] if not fitting else name, self.runs)
            taken = {(key[0], used) for key, used in found.items()}
            if not text.strip() or any((entry.task, text) in taken for entry in fitting):
                raise OptionError(
                    f"--label {printable(word)}: write ENTRY=TEXT, and another text for each entry"
                )
            found |= {entry.key: text for entry in fitting}
        return found

    def shown(self, entry: EntryResults) -> EntryResults:
        """Return an entry under the reader's name for it."""
        text = self._own_labels.get((entry.task, entry.task_hash, entry.name)) if self.labels else None
        return entry.labeled(text) if text else entry

    @property
    def of_tasks(self) -> str:
        """Name the tasks: ` of task beam6g or cartpole`, empty for all."""
        return f" of task {' or '.join(sorted(self.tasks))}" if self.tasks else ""


def collect(selection: Selection) -> tuple[list[EntryResults], list[str]]:
    """Read every selected entry.

    An entry that is in the results folder and published is shown once, with the seeds of both, see `united`. Where the
    own seeds get less far towards the task's shortest horizon, both are shown.

    Returns
    -------
    tuple
        The entries that have at least one epoch, and one line with the reason for each refused folder.
    """
    tasks, only = selection.tasks, selection.only
    good: dict[tuple[str, str, str], list[EntryResults]] = {}
    refused = []
    if only is None:
        stores = [store for store in _stores(selection) if not tasks or _task(store) in tasks]
    else:
        stores = _stores(selection, of_studies=True)
        stores = [store for store in stores if (_task(store), store.name) in only]
        absent = len(only) - len({(_task(store), store.name) for store in stores})
        if absent:
            refused.append(f"{absent} of the study's {len(only)} entries: nothing is trained yet")
    for store in stores:
        try:
            entry = read(store)
        except QrlSuiteError as error:
            refused.append(printable(error))  # names of folders are strangers' words
            continue
        if entry is not None:
            refused += entry.refused
            entry = selection.shown(entry)
            good.setdefault((entry.task, entry.task_hash, entry.record.name), []).append(entry)
    collected = []
    for kinds in map(by_code, good.values()):
        for copies in kinds if selection.all_codes else kinds[:1]:
            shown, problem = _shown(copies)
            beside = len(kinds) > 1 and shown[0].source == "published"
            collected += [replace(entry, mark=BESIDE) for entry in shown] if beside else shown
            refused += [problem] if problem else []
        if len(kinds) > 1 and not selection.all_codes:
            others = counted(len(kinds) - 1, "entry")
            refused.append(
                f"{others} of other code than '{shown[0].label}': `qrlsuite leaderboard --all-codes` shows all"
            )
    return collected, refused


def by_code(copies: Iterable[EntryResults]) -> list[list[EntryResults]]:
    """Return copies of an entry in lists, one for each code: first the newest code with enough seeds to rank."""
    kinds: list[list[EntryResults]] = []
    for entry in copies:
        same = next((kind for kind in kinds if kind[0].has_code_of(entry)), None)
        if same is None:
            kinds.append([entry])
        else:
            same.append(entry)
    return sorted(kinds, key=_newness, reverse=True) if len(kinds) > 1 else kinds


def _newness(kind: Sequence[EntryResults]) -> tuple[bool, str, int]:
    seeds = {seed for entry in kind for seed in entry.seeds}
    return len(seeds) >= MIN_RUNS, max(EntryStore(entry.folder).trained for entry in kind), len(seeds)


def select(
    selection: Selection, names: Sequence[str | EntryResults] = (), horizon: int | None = None
) -> tuple[list[EntryResults], list[str]]:
    """Read the entries for a board or a picture.

    Parameters
    ----------
    names:
        The entries (see `find`); the whole selection if empty. Entries that were read before are taken unchanged.
    horizon:
        Environment steps: longer curves are cut to it, shorter entries left out. None cuts nothing.

    Returns
    -------
    tuple
        The entries, in the order named; and one line with the reason for each entry that was left out.
    """
    entries, left_out = list[EntryResults](), list[str]()
    for name in names:
        shown, problem = (
            ([name], "") if isinstance(name, EntryResults) else _shown(read_copies(selection, name))
        )
        entries += shown
        left_out += [*(line for entry in shown for line in entry.refused), *([problem] if problem else [])]
    if not names:
        entries, left_out = collect(selection)
        entries = [entry for entry in entries if not selection.tasks or entry.task in selection.tasks]
    entries = list({(entry.task_hash, entry.name): entry for entry in entries}.values())
    if horizon is not None:
        entries, uneven = _at_whole_epochs(entries, horizon)
        left_out += uneven
    n_read = len(entries)
    kept = []
    for entry in entries:
        reached = entry if horizon is None else entry.cut(horizon // entry.steps_per_epoch)
        if reached is None:
            left_out.append(
                f"{entry.label}: ends at {entry.longest * entry.steps_per_epoch} of {horizon} steps"
            )
        else:
            kept.append(reached)
    if n_read and not kept:
        raise UnknownNameError(f"no entry is left: {'; '.join(left_out[-n_read:])}")
    return kept, left_out


def _at_whole_epochs(entries: Sequence[EntryResults], horizon: int) -> tuple[list[EntryResults], list[str]]:
    """Leave out tasks in which a horizon is no whole number of epochs; an error if none is left."""
    whole, lines = [], dict[str, str]()
    for entry in entries:
        steps = entry.steps_per_epoch
        if horizon >= 1 and horizon % steps == 0:
            whole.append(entry)
            continue
        epochs = max(1, round(horizon / steps))
        lines[entry.task] = (
            f"--horizon {horizon}: an epoch of task '{entry.task}' has {steps} steps; write a multiple of it, such as "
            f"--horizon {epochs * steps}"
        )
    if lines and not whole:
        raise OptionError(next(iter(lines.values())))
    return whole, list(lines.values())


def equally_long(entries: Sequence[EntryResults]) -> tuple[list[EntryResults], list[str]]:
    """Leave out entries that would cut a picture: entries shorter than half of the others, task by task.

    If some entries reach the task's shortest horizon, all shorter entries are left out first.

    Returns
    -------
    tuple
        The entries that stay, in their order; and one line for each entry that was left out.
    """
    enough: dict[str, int] = {}
    for task in {entry.task_hash for entry in entries}:
        members = [entry for entry in entries if entry.task_hash == task]
        lengths = sorted((int(entry.curves.shape[1]) for entry in members), reverse=True)
        least = min(members[0].task_file.ranking.horizons) // members[0].steps_per_epoch
        reaching = [length for length in lengths if length >= least] or lengths
        enough[task] = reaching[(len(reaching) - 1) // 2]
    kept, lines = [], []
    for entry in entries:
        if entry.curves.shape[1] >= enough[entry.task_hash]:
            kept.append(entry)
            continue
        steps = int(entry.curves.shape[1]) * entry.steps_per_epoch
        lines.append(f"{entry.label}: ends at {steps} steps; --horizon {steps} shows it")
    return kept, lines


def find(selection: Selection, name: str) -> EntryResults:
    """Read the entry that has a name (see `qrlsuite.results.lookup`), or whose folder it is."""
    return united(read_copies(selection, name))[0]


def best(copies: Iterable[EntryResults]) -> EntryResults:
    """Return the copy of an entry that gets furthest towards the task's shortest horizon, then that with more seeds."""
    return max(copies, key=_weight)


def united(copies: Sequence[EntryResults]) -> tuple[EntryResults, str]:
    """Return the union of an entry's copies, or the best copy if they differ; and the reason why some are left out.

    Shorter copies within the task's shortest horizon are left out.
    """
    further = best(copies)
    far = _weight(further)[0]
    shown = f"{_size(further)} of the same entry, from {further.folder}"
    try:
        whole = functools.reduce(operator.add, [copy for copy in copies if _weight(copy)[0] == far])
    except DifferentCurvesError as error:
        return further, f"{error}; shown are {shown}"
    shorter = [copy for copy in copies if copy.source == "published" and _weight(copy)[0] < far]
    return whole, "; ".join(f"{copy.folder}: {_size(copy)}; shown are {shown}" for copy in shorter)


def _size(entry: EntryResults) -> str:
    return f"{len(entry.seeds)} seeds of {entry.epochs} epochs"


def read_copies(selection: Selection, name: str) -> list[EntryResults]:
    """Read the copies of the entry that has a name, see `find`; of several codes, the first of `by_code` counts."""
    return by_code(_every_copy(selection, name))[0]


def _every_copy(selection: Selection, name: str) -> list[EntryResults]:
    tasks = selection.tasks
    if (Path(name) / "entry.json").exists():
        folders = [EntryStore(Path(name))]
    else:
        everything = selection.stored
        on_boards = {store.path for store in _stores(selection)}
        fitting = lookup.fitting(everything, name)
        # where entries of boards and of studies fit, those of boards are meant
        meant = [entry for entry in fitting if entry.store.path in on_boards] or fitting or everything
        place = f"{selection.runs}, {selection.of_tasks.removeprefix(' of ')}" if tasks else selection.runs
        key = lookup.choose(list({e.key: e for e in meant}.values()), name, place).key
        folders = [entry.store for entry in everything if entry.key == key]
    copies = [selection.shown(entry) for store in folders if (entry := read(store)) is not None]
    if not copies:
        if any(min(store.seeds(), default=0) >= TUNING_SEEDS for store in folders):
            raise UnknownNameError(
                f"entry '{name}' has seeds from {TUNING_SEEDS:,} up alone, which are for trying settings; "
                "train others: --seeds 20"
            )
        raise UnknownNameError(f"entry '{name}' has no finished epoch yet")
    if tasks and copies[0].task not in tasks:
        raise UnknownNameError(
            f"{name} is an entry of task {copies[0].task}, not of {' or '.join(sorted(tasks))}"
        )
    return copies


def _shown(copies: Sequence[EntryResults]) -> tuple[list[EntryResults], str]:
    """Return the shown copies of an entry, see `united`; and shorter own copies beside them."""
    whole, problem = united(copies)
    shorter = [copy for copy in copies if copy.source == "runs" and _weight(copy)[0] < _weight(whole)[0]]
    return [*shorter, replace(whole, mark=BESIDE) if shorter else whole], problem


def _weight(entry: EntryResults) -> tuple[int, int, int]:
    """Return the sort key of copies of an entry: epochs within the horizon, seeds, all epochs."""
    epochs = int(entry.curves.shape[1])
    enough = min(entry.task_file.ranking.horizons) // entry.steps_per_epoch
    return min(epochs, enough), len(entry.seeds), epochs


def _stores(selection: Selection, of_studies: bool = False) -> list[EntryStore]:
    """Return the folders of the entries that boards rank, in the results folder and published.

    Entries of studies are among them if `of_studies` is true, or if their task has no other published entries and is
    selected by name or has entries in the results folder.
    """
    runs = selection.runs
    if not runs.is_dir() and not selection.published:
        raise StoreError(
            f"there is no results folder {runs}: {ANOTHER_FOLDER}; `qrlsuite leaderboard --published` shows "
            "the entries that come with the suite"
        )
    stores = entries(runs) if runs.is_dir() else []
    if selection.published:
        on_boards = entries(published_entries.PUBLISHED)
        asked = {*selection.tasks, *map(_task, stores)} - set(map(_task, on_boards))
        others = entries(published_entries.OF_STUDIES)
        stores += on_boards + [store for store in others if of_studies or _task(store) in asked]
    return stores


def _task(store: EntryStore) -> str:
    return store.path.parent.name


def read(store: EntryStore) -> EntryResults | None:
    """Read one entry, from runs or published; None where no run has finished an epoch."""
    if published_entries.is_published(store.path):
        known = published_entries.comes_with_suite(store.path)
        return published_entries.read(store.path, label=not known).entry_results()
    return read_entry(store)


def read_entry(store: EntryStore, tuning: bool = False) -> EntryResults | None:
    """Read one entry from its runs; None if no run has finished an epoch. Seeds of tuning count alone, or not at all.

    A seed with a damaged file, in the wrong folder, or of other code is left out; other seeds are read.
    """
    record = store.record()
    runs, refused = _readable(store, current(record), tuning)
    if not runs:
        if refused:
            raise StoreError("; ".join(refused))
        return None
    for probe in probes.of_records(run.record for run in runs):
        if probe.result == probes.DIFFERS:
            raise StoreError(
                f"{store.path}: not ranked, because its seeds are not independent: trained again, seed "
                f"{probe.seed} differs in {probe.difference}; `qrlsuite check` looks for the cause"
            )
    asked, withdrawn = requests.read(store)
    facts = {"mark": store.mark, "refused": tuple(refused), "asked": asked, "withdrawn": withdrawn}
    found = EntryResults.of(record, store.path, {run.seed: run for run in runs}, **facts)
    for other in {*store.path.parent.glob(f"{store.name}*")} - {store.path} if found.missing else ():
        if EntryStore(other).finished(asked, found.epochs) == asked.keys():
            moved = dict.fromkeys(found.missing, f"trained anew, by another code ({other.name})")
            return replace(found, asked={}, withdrawn={**withdrawn, **moved})
    return found


def _readable(
    store: EntryStore, task_file: TaskFile, tuning: bool = False
) -> tuple[list[SeedRun], list[str]]:
    """Return the runs with an epoch or more, and one line for each seed that does not count and why."""
    runs: dict[int, SeedRun] = {}
    refused, held = [], codes.of(store)
    for seed in store.seeds():
        if (seed >= TUNING_SEEDS) != tuning:
            continue
        try:
            run = store.seed(seed).read()
            if len(run.scores):
                require_scores(run.curve, task_file, store.seed(seed).path)
                if held is not None and run.record is not None and run.record.code_identity not in held:
                    raise StoreError(f"{run.folder} has it of another code than that of its first seed")
        except StoreError as error:
            refused.append(f"seed {seed}: {printable(error)}")
            continue
        if len(run.scores):
            runs[seed] = run
    for seeds in genuine.copies(store, list(runs.values())):
        refused.append(
            f"{printable(store.path)}: seeds {format_seeds(seeds)} are copies of each other (they have equal scores), "
            "and none of them counts; delete the folders of the copies"
        )
        for seed in seeds:
            del runs[seed]
    return list(runs.values()), refused
