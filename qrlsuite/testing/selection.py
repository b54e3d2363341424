"""What `qrlsuite check` is asked to check: a name, a kind and a name, a distribution, or a module."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from qrlsuite import events, registry
from qrlsuite.errors import QrlSuiteError, UnknownNameError, nearest
from qrlsuite.testing import plural


@dataclass(frozen=True, slots=True)
class Item:
    """One thing to check: its kind in the plural, and its name, or for a hook-only tracker its module's."""

    kind: str
    name: str

    @property
    def title(self) -> str:
        """In words: `model mlp`."""
        return f"{registry.SINGULAR[self.kind].replace('_', ' ')} {self.name}"


def select(word: str) -> list[Item]:
    """Return what a word stands for: `NAME`, `KIND:NAME`, a distribution, or the module of a tracker.

    Raises
    ------
    QrlSuiteError
        If it stands for things of several kinds, or for nothing; the message says what to type.
    """
    known = registry.load()
    kind, colon, name = word.partition(":")
    if colon:
        wanted = plural(kind)
        if wanted != "trackers":
            known.get(wanted, name)
        elif name not in known.entries[wanted] and not _is_module(name):
            raise UnknownNameError(f"unknown tracker '{name}'{nearest(name, known.entries[wanted])}")
        return [Item(wanted, name)]
    kinds = [kind for kind in registry.KINDS if word in known.entries[kind]]
    distributions = {plugin.distribution for plugin in known.plugins}
    if len(kinds) > 1 or (kinds and word in distributions):
        ways = [f"{registry.SINGULAR[kind].replace('_', '-')}:{word}" for kind in kinds]
        raise QrlSuiteError(
            f"'{word}' is several things; write qrlsuite check {' or qrlsuite check '.join(ways)}"
        )
    if kinds:
        return [Item(kinds[0], word)]
    if word in distributions:
        return of_distribution(word)
    if _is_module(word) and (word in _watching() or "." in word):
        return [Item("trackers", word)]
    names = {name for kind in registry.KINDS for name in known.entries[kind]} | distributions
    raise UnknownNameError(f"nothing called '{word}' is registered{nearest(word, names)}")


def of_distribution(distribution: str) -> list[Item]:
    """Return everything that a distribution registers, and its plugins that watch runs.

    Raises
    ------
    QrlSuiteError
        If one of its plugins was skipped: why.
    """
    known = registry.load()
    problems = [p.problem for p in known.plugins if p.distribution == distribution and p.problem]
    if problems:
        raise QrlSuiteError("; ".join(problems))
    found = [Item(kind, entry.spec.name) for kind, entry in known if entry.distribution == distribution]
    found += [Item("trackers", module) for module, owner in _watching().items() if owner == distribution]
    return found


def _watching() -> dict[str, str]:
    """Return the plugins that implement a run event, by module: their distributions."""
    hooks = registry.load().manager.hook
    names = [i.plugin_name for event in events.EVENTS for i in getattr(hooks, event).get_hookimpls()]
    return {name.partition(":")[2]: name.partition(":")[0] for name in sorted(set(names))}


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False
