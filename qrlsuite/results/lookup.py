"""Finds entries by name, label or hash, or by the beginning of a name, label or hash."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from qrlsuite import notation, options, registry, specs
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, UnknownNameError, listed, nearest
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.experiment.task import in_a_file, load
from qrlsuite.results.store import EntryStore


class Named(Protocol):
    """Anything with a name (`ddqn-mlp-90e7f8d4`), a label (`ddqn mlp width=64`) and a task."""

    @property
    def name(self) -> str:
        """Algorithm, model and hash."""

    @property
    def label(self) -> str:
        """Algorithm, model and the options that are not defaults."""

    @property
    def task(self) -> str:
        """The task's name."""


N = TypeVar("N", bound=Named)


@dataclass(frozen=True)
class Stored:
    """An entry's folder, name and label; its curves are not read.

    Attributes
    ----------
    key:
        Equal for folders of the same entry.
    """

    store: EntryStore
    name: str
    label: str
    task: str
    key: tuple[str, str, str]


def stored(stores: Iterable[EntryStore]) -> list[Stored]:
    """Return names and labels of entries' folders; a damaged entry is named by its folder."""
    entries = []
    for store in stores:
        name, task = store.path.name, store.path.parent.name
        try:
            record = store.record()
        except StoreError:  # is said where it is the one that was asked for
            entries.append(Stored(store, name, name, task, (task, "", str(store.path))))
        else:
            name, label = record.name + store.mark, " ".join([record.label, store.mark]).rstrip()
            key = (record.task_name, record.task_hash, name)
            entries.append(Stored(store, name, label, record.task_name, key))
    return entries


def task_name(runs: Path, task: str | None) -> str | None:
    """Return the name of a task as `task_names` does; None is no task."""
    return None if task is None else task_names(runs, [task])[0]


def task_names(runs: Path, tasks: Iterable[str], also: Iterable[Path] = ()) -> list[str]:
    """Return the names of tasks that are given by name, as `gym:ID`, or by the path of a task file.

    Parameters
    ----------
    also:
        Further folders of results.
    """
    folders = [folder for folder in (runs, *also) if folder.is_dir()]
    held = {path.name for folder in folders for path in folder.iterdir() if path.is_dir()}
    names = []
    for name in tasks:
        registered = registry.load().of(specs.TaskSpec)
        if name.startswith("gym:"):
            from qrlsuite.gymlanes import quick_name  # Gymnasium is slow to import

            names.append(quick_name(name.removeprefix("gym:")))
        elif name.endswith(".toml"):
            names.append(load(name).name)
        elif name in held or name in registered:
            names.append(name)
        else:
            unknown = f"unknown task '{name}'{nearest(name, {*registered, *held})}"
            raise UnknownNameError(in_a_file(name) or unknown)
    return names


def definitions(tasks: Iterable[str]) -> dict[str, str]:
    """Return the hashes of the tasks whose file's path is written, by name."""
    written = [load(name) for name in tasks if name.endswith(".toml")]
    return {task.name: task.hash for task in written}


def choose(among: Sequence[N], name: str, searched: object) -> N:
    """Return the entry whose name, label, label without the algorithm, or hash is `name` or begins with it.

    If several tasks have such an entry, `TASK/NAME` selects one. A whole name goes before a beginning, and of several
    that begin with it the entry that `run` would train.
    """
    found = fitting(among, name)
    if not found:
        alike = [e for e in among if mentions(e, name)]
        if not alike:
            labels = {_short(e) for e in among}
            raise UnknownNameError(f"no entry '{name}' in {searched}{nearest(name, labels)}")
        raise UnknownNameError(f"no entry begins with '{name}'; did you mean {_choices(alike, among)}?")
    if len(found) > 1:
        found = _written(found, name, bare=True) or found
    if len(found) > 1:
        raise UnknownNameError(f"'{name}' may be any of {_choices(found, among)}: write one of these")
    return found[0]


def fitting(among: Sequence[N], name: str) -> list[N]:
    """Return the entries that a name may mean, as `choose` does."""
    whole = [e for e in among if name in _names(e)] or _written(among, name)
    return whole or [e for e in among if any(known.startswith(name) for known in _names(e))]


def _written(among: Sequence[N], text: str, bare: bool = False) -> list[N]:
    """Return the entries that a text in the notation of entries means.

    It is compared with labels, its options in any order, and then read as `run` reads it, with presets of tasks. A mark
    of code may stand behind it: ` @1a2b3c4d`, or the beginning of one. A model alone means none of its
    entries, or `bare` the entry of its defaults.
    """
    text, at, mark = text.partition(" @")
    among = [e for e in among if not at or (mark and _mark(e).startswith(mark))]
    task, slash, rest = text.partition("/")
    if not slash or "=" in task:
        task, rest = "", text
    try:
        written = notation.parse_entry(rest)
        same_task = [e for e in among if task in ("", e.task)]
    except QrlSuiteError:
        return []
    if written.preset is None:
        same = [e for e in same_task if _same(written, e.label)]
        if same or written.start or not (written.settings or bare):
            return same if written.settings or written.start or bare else []
    names = {task: _name(task, written) for task in {e.task for e in same_task}}
    return [e for e in same_task if e.name.partition("@")[0] == names[e.task]]


def _mark(entry: Named) -> str:
    return entry.name.partition("@")[2]


def _name(task: str, written: notation.Written) -> str | None:
    """Return the name of the entry that `run` would train on a task; None where it would refuse to."""
    try:
        return resolve(task, written).name
    except QrlSuiteError:
        return None


def _same(written: notation.Written, label: str) -> bool:
    """Return whether a label means the written entry; the algorithm may be left out."""
    try:
        known = notation.parse_entry(label.partition(" @")[0])
    except OptionError:  # of a folder that is damaged
        return False
    typed, shown = ({each.full_name: each.value for each in one.settings} for one in (written, known))
    if written.model == known.model and known.settings and _first_is_default(known):
        typed = {known.settings[0].full_name: known.settings[0].value, **typed}
    return (
        written.algorithm in (None, known.algorithm)
        and written.model == known.model
        and written.start == known.start
        and typed == shown
    )


def _first_is_default(known: notation.Written) -> bool:
    """Return whether a label's first option, which it always has, may have been left out where it was typed."""
    models, first = registry.load().of(specs.ModelSpec), known.settings[0]
    if known.model not in models:
        return True
    usual = options.plain(specs.resolve(models[known.model].spec.options)())
    return bool(usual.get(first.name) == first.value)


def mentions(entry: Named, word: str) -> bool:
    """Return whether a word occurs in an entry's task or label; hexadecimal hashes hold too many words."""
    return word in f"{entry.task}/{entry.label}"


def _short(entry: Named) -> str:
    return entry.label.partition(" ")[2] or entry.label


def _names(entry: Named) -> tuple[str, ...]:
    """Return every name by which an entry can be found."""
    plain = [entry.name, entry.label, _short(entry), entry.name.rpartition("-")[2]]
    if entry.label.startswith(f"{SCRIPT} "):  # its name was typed, and perhaps no steps
        plain.append(entry.label.split(" ")[1])
    return (*plain, *(f"{entry.task}/{name}" for name in plain))


def _choices(entries: Sequence[Named], among: Sequence[Named]) -> str:
    """List unique names of some entries: the label, with task or hash if several entries have that label."""
    labels = Counter(e.label for e in among)
    places = Counter((e.task, e.label) for e in among)
    choices = []
    for entry in entries:
        if labels[entry.label] == 1:
            choices.append(entry.label)
        else:
            unique = places[entry.task, entry.label] == 1
            choices.append(f"{entry.task}/{entry.label if unique else entry.name}")
    return listed([f"'{word}'" for word in sorted(choices)])
