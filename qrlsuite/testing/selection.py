"""Finds the targets of `qrlsuite check` by name, kind and name, or distribution."""

from __future__ import annotations

from dataclasses import dataclass

from qrlsuite import registry, specs
from qrlsuite.errors import QrlSuiteError, UnknownNameError, nearest
from qrlsuite.registry import canonical


@dataclass(frozen=True, slots=True)
class CheckTarget:
    """One thing to check: its kind and its name, or for a task its file."""

    kind: type[specs.Spec]
    name: str

    @property
    def title(self) -> str:
        """In words: `model 'mlp'`."""
        return specs.title(self.kind, self.name)


def select(word: str) -> list[CheckTarget]:
    """Return the targets of a word: `NAME`, `KIND:NAME`, a distribution, or a task's file.

    A name that is also a distribution's stands for the distribution where all that has the name is the distribution's
    own; `distribution:NAME` says so where it is not.
    """
    registered = registry.load()
    if word.endswith(".toml"):
        return [CheckTarget(specs.TaskSpec, word)]
    kind, colon, name = word.partition(":")
    if colon:
        return _of_kind(kind, name)
    kinds, distribution = [k for k in specs.KINDS.values() if word in registered.of(k)], _distribution(word)
    if word == distribution and {owner for k in kinds for owner in _owners(k, word)} <= {word}:
        return of_distribution(word)
    if len(kinds) > 1 or (kinds and word == distribution):
        ways = [f"{kind.kind.replace('_', '-')}:{word}" for kind in kinds]
        ways += [f"distribution:{word}"] * (word == distribution)
        raise QrlSuiteError(
            f"'{word}' is several things; write qrlsuite check {' or qrlsuite check '.join(ways)}"
        )
    if kinds:
        return _of_kind(kinds[0].kind, word)
    if distribution is not None:
        return of_distribution(distribution)
    names = {each.spec.name for each in registered} | _distributions()
    hint = f": --plugin {word} loads it" if word.endswith(".py") else nearest(word, names)
    raise UnknownNameError(f"nothing called '{word}' is registered{hint}")


def of_distribution(distribution: str) -> list[CheckTarget]:
    """Return everything that a distribution registers."""
    registered = registry.load()
    problems = [p.problem for p in registered.plugins if p.distribution == distribution and p.problem]
    if problems:
        raise QrlSuiteError("; ".join(problems))
    targets = [
        CheckTarget(type(each.spec), each.spec.name)
        for each in registered
        if distribution in _owners(type(each.spec), each.spec.name)
    ]
    if not targets:
        raise QrlSuiteError(
            f"'{distribution}' registers nothing by name; commands have no rules. Nothing to check: if there should "
            "be, is every hook under @hookimpl, in the module that the entry point names?"
        )
    return targets


def _of_kind(kind: str, name: str) -> list[CheckTarget]:
    """Return the targets of `KIND:NAME`."""
    if kind == "distribution":
        distribution = _distribution(name)
        if distribution is None:
            raise UnknownNameError(
                f"no plugin is of a distribution '{name}'{nearest(name, _distributions())}"
            )
        return of_distribution(distribution)
    target = CheckTarget(specs.kind(kind), name)
    registry.load().get(target.kind, name)
    return [target]


def _owners(kind: type[specs.Spec], name: str) -> list[str]:
    """Return the distributions that registered a name: more than one where it is a duplicate."""
    registered = registry.load()
    owners = registered.duplicates.get((kind, name)) or [registered.entries[kind][name]]
    return [each.distribution for each in owners]


def _distributions() -> set[str]:
    return {plugin.distribution for plugin in registry.load().plugins}


def _distribution(name: str) -> str | None:
    """Return the distribution of that name, in its own spelling; `_`, `-`, `.` and case do not matter, as in pip."""
    names = {canonical(each): each for each in sorted(_distributions(), reverse=True)}
    return name if name in _distributions() else names.get(canonical(name))
