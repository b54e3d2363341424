"""Discovery and look-up of everything that plugins register.

`load()` reads the entry points of the group `qrlsuite`, built-ins and third parties alike. A plugin that
cannot be imported, or whose hook raises, is reported by the name of its distribution and skipped; a name
registered twice is an error that names both distributions when it is looked up.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, cast

import pluggy

from qrlsuite import hookspecs, specs
from qrlsuite.errors import PluginError, UnknownNameError, nearest

KINDS: dict[str, type[specs.Spec]] = {
    "environments": specs.EnvironmentSpec,
    "models": specs.ModelSpec,
    "algorithms": specs.AlgorithmSpec,
    "tasks": specs.TaskSpec,
    "ansatzes": specs.AnsatzSpec,
    "circuit_backends": specs.CircuitBackendSpec,
    "significance_tests": specs.SignificanceTestSpec,
    "engines": specs.EngineSpec,
    "studies": specs.StudySpec,
}
"""Kinds of registered things, in the plural: hook `register_<kind>`, and the spec that it takes."""

SINGULAR = {kind: kind[:-1] for kind in KINDS} | {"ansatzes": "ansatz", "studies": "study"}


class PluginWarning(UserWarning):
    """A plugin was skipped, wholly or in part."""


@dataclass(frozen=True)
class Registered:
    """A spec and the distribution that registered it."""

    spec: specs.Spec
    distribution: str


@dataclass
class Registry:
    """All registered specs by kind and name, and what went wrong on the way."""

    manager: pluggy.PluginManager
    entries: dict[str, dict[str, Registered]] = field(default_factory=lambda: {kind: {} for kind in KINDS})
    duplicates: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def names(self, kind: str) -> list[str]:
        """Return the sorted names of a kind."""
        return sorted(self.entries[kind])

    def __iter__(self) -> Iterator[tuple[str, Registered]]:
        for kind, entries in self.entries.items():
            for name in sorted(entries):
                yield kind, entries[name]

    def get(self, kind: str, name: str) -> Registered:
        """Look up a spec.

        Raises
        ------
        UnknownNameError
            If nothing of that kind has the name; the message gives the nearest match.
        PluginError
            If two distributions registered it.
        """
        owners = self.duplicates.get((kind, name))
        if owners:
            raise PluginError(
                f"{SINGULAR[kind]} '{name}' is registered by both {' and '.join(owners)}: "
                f"uninstall one of them (pip uninstall {owners[-1]})"
            )
        try:
            return self.entries[kind][name]
        except KeyError:
            singular = SINGULAR[kind].replace("_", " ")
            raise UnknownNameError(
                f"unknown {singular} '{name}'{nearest(name, self.entries[kind])}"
            ) from None

    def add_plugin(self, plugin: Any, distribution: str) -> None:
        """Register a plugin object with the manager and collect its specs.

        Raises
        ------
        PluginError
            If one of its hooks has a wrong signature, raises, or hands over something that is not a spec.
        """
        try:
            self.manager.register(plugin, name=f"{distribution}:{getattr(plugin, '__name__', plugin)}")
        except (pluggy.PluginValidationError, ValueError) as error:
            raise PluginError(f"plugin of distribution '{distribution}': {error}") from error
        for kind, expected in KINDS.items():
            caller = getattr(self.manager.hook, f"register_{kind}")
            others = [p for p in self.manager.get_plugins() if p is not plugin]
            subset = self.manager.subset_hook_caller(caller.name, others)
            try:
                subset(register=functools.partial(self._add, kind, expected, distribution))
            except Exception as error:
                raise PluginError(f"distribution '{distribution}', hook '{caller.name}': {error}") from error

    def _add(self, kind: str, expected: type[specs.Spec], distribution: str, spec: specs.Spec) -> None:
        if type(spec) is not expected:
            raise PluginError(f"register() needs a {expected.__name__}, got {type(spec).__name__}")
        known = self.entries[kind].get(spec.name)
        if known is not None:
            owners = self.duplicates.setdefault((kind, spec.name), [known.distribution])
            owners.append(distribution)
            self.problems.append(
                f"{SINGULAR[kind]} '{spec.name}' is registered by both {' and '.join(owners)}"
            )
            return
        self.entries[kind][spec.name] = Registered(spec, distribution)


def _entry_points() -> list[tuple[str, metadata.EntryPoint]]:
    """Entry points of the group with their distribution's name, the suite's own first."""
    found: dict[tuple[str, str], metadata.EntryPoint] = {}
    for point in metadata.entry_points(group=hookspecs.PROJECT):
        owner = point.dist.name if point.dist is not None else "unknown"
        found.setdefault((owner, point.value), point)
    return sorted(
        ((key[0], point) for key, point in found.items()), key=lambda p: (p[0] != "qrlsuite", p[0], p[1].name)
    )


def create(
    strict: bool = False, points: Callable[[], list[tuple[str, metadata.EntryPoint]]] = _entry_points
) -> Registry:
    """Discover all plugins afresh.

    Parameters
    ----------
    strict:
        Raise at the first broken plugin instead of skipping it with a `PluginWarning`.
    points:
        Where entry points come from; tests hand in their own.
    """
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    registry = Registry(manager)
    for distribution, point in points():
        try:
            try:
                plugin = point.load()
            except Exception as error:
                raise PluginError(
                    f"plugin '{point.name}' of distribution '{distribution}' cannot be imported: "
                    f"{type(error).__name__}: {error}"
                ) from error
            registry.add_plugin(plugin, distribution)
        except PluginError as error:
            if strict:
                raise
            registry.problems.append(str(error))
    try:
        manager.check_pending()
    except pluggy.PluginValidationError as error:
        if strict:
            raise PluginError(str(error)) from error
        registry.problems.append(str(error))
    for problem in registry.problems:
        warnings.warn(f"{problem}; skipped", PluginWarning, stacklevel=2)
    return registry


@functools.cache
def load() -> Registry:
    """Return the registry of this process, discovered once."""
    return create()


def environment(name: str) -> specs.EnvironmentSpec:
    """Look up an environment by name."""
    return cast(specs.EnvironmentSpec, load().get("environments", name).spec)


def model(name: str) -> specs.ModelSpec:
    """Look up a model by name."""
    return cast(specs.ModelSpec, load().get("models", name).spec)


def algorithm(name: str) -> specs.AlgorithmSpec:
    """Look up an algorithm by name."""
    return cast(specs.AlgorithmSpec, load().get("algorithms", name).spec)


def task(name: str) -> specs.TaskSpec:
    """Look up a task by name."""
    return cast(specs.TaskSpec, load().get("tasks", name).spec)


def study(name: str) -> specs.StudySpec:
    """Look up a study by name."""
    return cast(specs.StudySpec, load().get("studies", name).spec)


def ansatz(name: str) -> specs.AnsatzSpec:
    """Look up an ansatz by name."""
    return cast(specs.AnsatzSpec, load().get("ansatzes", name).spec)


def circuit_backend(name: str) -> specs.CircuitBackendSpec:
    """Look up a circuit backend by name."""
    return cast(specs.CircuitBackendSpec, load().get("circuit_backends", name).spec)
