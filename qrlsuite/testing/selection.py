"""Finds the targets of `qrlsuite check` by name, kind and name, distribution or module."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import dataclass

from qrlsuite import registry
from qrlsuite.errors import QrlSuiteError, UnknownNameError, nearest
from qrlsuite.testing import plural
from qrlsuite.training import trackers


@dataclass(frozen=True, slots=True)
class CheckTarget:
    """One thing to check: its kind in the plural, and its name, or for a hook-only tracker its module's."""

    kind: str
    name: str

    @property
    def title(self) -> str:
        """In words: `model mlp`."""
        return f"{registry.SINGULAR[self.kind].replace('_', ' ')} {self.name}"


def select(word: str) -> list[CheckTarget]:
    """Return what a word stands for: `NAME`, `KIND:NAME`, a distribution, a task's file, or the module of a tracker.

    A name that is also a distribution's stands for the distribution where all that has the name is the distribution's
    own; `distribution:NAME` says so where it is not.

    Raises
    ------
    QrlSuiteError
        If it stands for things of several kinds, or for nothing; the message says what to type.
    """
    known = registry.load()
    if word.endswith(".toml"):
        return [CheckTarget("tasks", word)]
    kind, colon, name = word.partition(":")
    if colon:
        return _of_kind(kind, name)
    owners = {kind: _owners(kind, word) for kind in registry.KINDS if word in known.entries[kind]}
    kinds, distribution = list(owners), _distribution(word)
    if word == distribution and {
        owner for registered_names in owners.values() for owner in registered_names
    } <= {word}:
        return of_distribution(word)
    if len(kinds) > 1 or (kinds and word == distribution):
        ways = [f"{registry.SINGULAR[kind].replace('_', '-')}:{word}" for kind in kinds]
        ways += [f"distribution:{word}"] * (word == distribution)
        raise QrlSuiteError(
            f"'{word}' is several things; write qrlsuite check {' or qrlsuite check '.join(ways)}"
        )
    if kinds:
        return _of_kind(kinds[0], word)
    if _is_module(word) and (word in _watching() or "." in word):
        return [CheckTarget("trackers", word)]
    if distribution is not None:
        return of_distribution(distribution)
    names = {name for kind in registry.KINDS for name in known.entries[kind]} | _distributions()
    raise UnknownNameError(f"nothing called '{word}' is registered{nearest(word, names)}")


def of_distribution(distribution: str) -> list[CheckTarget]:
    """Return everything that a distribution registers, and its plugins that watch runs.

    Raises
    ------
    QrlSuiteError
        If one of its plugins was skipped: why. If it brings nothing that there are rules for.
    """
    known = registry.load()
    problems = [p.problem for p in known.plugins if p.distribution == distribution and p.problem]
    if problems:
        raise QrlSuiteError("; ".join(problems))
    targets = [
        CheckTarget(kind, entry.spec.name)
        for kind, entry in known
        if distribution in _owners(kind, entry.spec.name)
    ]
    targets += [
        CheckTarget("trackers", module) for module, owner in _watching().items() if owner == distribution
    ]
    if not targets:
        raise QrlSuiteError(
            f"'{distribution}' registers nothing by name and watches no run; commands have no rules. Nothing to check: "
            "if there should be, is every hook under @hookimpl, in the module that the entry point names?"
        )
    return targets


def _of_kind(kind: str, name: str) -> list[CheckTarget]:
    """Return what `KIND:NAME` stands for."""
    if kind == "distribution":
        distribution = _distribution(name)
        if distribution is None:
            raise UnknownNameError(
                f"no plugin is of a distribution '{name}'{nearest(name, _distributions())}"
            )
        return of_distribution(distribution)
    known, plural_kind = registry.load(), plural(kind)
    if plural_kind != "trackers" or (plural_kind, name) in known.duplicates:
        known.get(plural_kind, name)
    elif name not in known.entries[plural_kind] and not _is_module(name):
        raise UnknownNameError(f"unknown tracker '{name}'{nearest(name, known.entries[plural_kind])}")
    return [CheckTarget(plural_kind, name)]


def _owners(kind: str, name: str) -> list[str]:
    """Return the distributions that registered a name: more than one where it is a duplicate."""
    known = registry.load()
    return known.duplicates.get((kind, name)) or [known.entries[kind][name].distribution]


def _distributions() -> set[str]:
    return {plugin.distribution for plugin in registry.load().plugins}


def _distribution(name: str) -> str | None:
    """Return the distribution of that name, spelled as it is; `_`, `-`, `.` and case are alike, as they are to pip."""
    names = _distributions()
    return name if name in names else next((d for d in sorted(names) if _folded(d) == _folded(name)), None)


def _folded(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _watching() -> dict[str, str]:
    """Return the plugins that implement a run event, by module: their distributions."""
    hooks = registry.load().manager.hook
    names = [i.plugin_name for event in trackers.EVENTS for i in getattr(hooks, event).get_hookimpls()]
    return {name.partition(":")[2]: name.partition(":")[0] for name in sorted(set(names))}


def _is_module(name: str) -> bool:
    """Tell whether there is a module of that name; its packages are imported, and may fail."""
    try:
        return importlib.util.find_spec(name) is not None
    except (Exception, SystemExit):
        return False
