"""Finds plugins, and looks up what they register.

`load()` reads the entry points of the group `qrlsuite`, built-ins and third parties alike. A plugin that does not
fit this version of the suite, cannot be imported, implements a hook that does not exist, or whose hook raises, is
reported by the name of its distribution and skipped as a whole; everything else works. A name registered twice is
an error that names both distributions when it is looked up. With `qrlsuite --strict`, or `QRLSUITE_STRICT=1`, the
first of these problems ends the command. `QRLSUITE_LOAD_PLUGINS=acme-qrl,other` loads the plugins of these
distributions only, and an empty value those of the suite only.
"""

from __future__ import annotations

import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, cast

import pluggy

import qrlsuite
from qrlsuite import hookspecs, specs
from qrlsuite.errors import PluginError, UnknownNameError, nearest

STRICT = "QRLSUITE_STRICT"
"""Environment variable: problems of plugins are fatal, in workers too."""

LOAD_PLUGINS = "QRLSUITE_LOAD_PLUGINS"
"""Environment variable: load the plugins of these distributions only, separated by commas, beside the suite's own."""

KINDS: dict[str, type[specs.Spec]] = {
    "environments": specs.EnvironmentSpec,
    "models": specs.ModelSpec,
    "algorithms": specs.AlgorithmSpec,
    "tasks": specs.TaskSpec,
    "ansatzes": specs.AnsatzSpec,
    "circuit_backends": specs.CircuitBackendSpec,
    "rules": specs.RuleSpec,
    "engines": specs.EngineSpec,
    "studies": specs.StudySpec,
    "trackers": specs.TrackerSpec,
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
class Plugin:
    """An entry point, and what loading it gave: specs or a problem.

    Attributes
    ----------
    name:
        Its name among the distribution's entry points.
    module:
        What it points at.
    version:
        The distribution's version; `""` where there is none.
    requires:
        The versions of the suite that the distribution requires; `""` for any.
    registered:
        Names by kind in the plural.
    problem:
        Why it was skipped; `""` where it works.
    """

    name: str
    module: str
    distribution: str
    version: str = ""
    requires: str = ""
    registered: dict[str, list[str]] = field(default_factory=dict)
    problem: str = ""


@dataclass(eq=False)
class Registry:
    """All registered specs by kind and name, all plugins, and the problems met while loading them."""

    manager: pluggy.PluginManager
    entries: dict[str, dict[str, Registered]] = field(default_factory=lambda: {kind: {} for kind in KINDS})
    duplicates: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    plugins: list[Plugin] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    strict: bool = False

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
            raise PluginError(_duplicate(kind, name, owners))
        try:
            return self.entries[kind][name]
        except KeyError:
            singular = SINGULAR[kind].replace("_", " ")
            raise UnknownNameError(
                f"unknown {singular} '{name}'{nearest(name, self.entries[kind])}"
            ) from None

    def add_plugin(self, plugin: Any, distribution: str) -> dict[str, list[str]]:
        """Register a plugin object with the manager, and all that it registers, or nothing of it.

        Returns
        -------
        dict
            Names that it registered, by kind.

        Raises
        ------
        PluginError
            If it implements a hook that does not exist, one of its hooks has a wrong signature, raises, or hands
            over something that is not a spec.
        """
        name = f"{distribution}:{getattr(plugin, '__name__', plugin)}"
        handed: list[tuple[str, specs.Spec]] = []
        try:
            self.manager.register(plugin, name=name)
            self._know_hooks(plugin)
            others = [p for p in self.manager.get_plugins() if p is not plugin]
            hooks = {"register": KINDS} | {f"register_{kind}": {kind: KINDS[kind]} for kind in KINDS}
            for hook, kinds in hooks.items():
                try:
                    self.manager.subset_hook_caller(hook, others)(
                        register=functools.partial(_collect, handed, kinds)
                    )
                except Exception as error:
                    reason = str(error) if isinstance(error, PluginError) else words(error)
                    raise PluginError(f"hook '{hook}': {reason}") from error
        except (pluggy.PluginValidationError, PluginError, ValueError) as error:
            if self.manager.get_plugin(name) is plugin:
                self.manager.unregister(plugin)
            raise PluginError(
                f"plugin '{name.partition(':')[2]}' of distribution '{distribution}': {error}"
            ) from error
        registered: dict[str, list[str]] = {}
        for kind, spec in handed:
            registered.setdefault(kind, []).append(spec.name)
            self._add(kind, spec, distribution)
        return registered

    def _know_hooks(self, plugin: Any) -> None:
        """Refuse implementations of hooks that do not exist (pluggy's `check_pending`, for one plugin)."""
        known = [
            name for name in vars(hookspecs) if hasattr(vars(hookspecs)[name], f"{hookspecs.PROJECT}_spec")
        ]
        for caller in self.manager.get_hookcallers(plugin) or []:
            optional = all(i.optionalhook for i in caller.get_hookimpls() if i.plugin is plugin)
            if not caller.has_spec() and not optional:
                raise PluginError(f"there is no hook '{caller.name}'{nearest(caller.name, known)}")

    def _add(self, kind: str, spec: specs.Spec, distribution: str) -> None:
        known = self.entries[kind].get(spec.name)
        if known is None:
            self.entries[kind][spec.name] = Registered(spec, distribution)
            return
        owners = self.duplicates.setdefault((kind, spec.name), [known.distribution])
        owners.append(distribution)
        self.report(_duplicate(kind, spec.name, owners))

    def report(self, problem: str) -> None:
        """Note a problem and warn of it.

        Raises
        ------
        PluginError
            If problems are fatal.
        """
        if self.strict:
            raise PluginError(problem)
        self.problems.append(problem)
        warnings.warn(problem, PluginWarning, stacklevel=3)


def _collect(handed: list[tuple[str, specs.Spec]], kinds: Mapping[str, type[specs.Spec]], spec: Any) -> None:
    """Collect a spec that a hook registers, under the kind that its type says."""
    for kind, expected in kinds.items():
        if type(spec) is expected:
            handed.append((kind, spec))
            return
    accepted = next(iter(kinds.values())).__name__ if len(kinds) == 1 else "spec of `qrlsuite.specs`"
    raise PluginError(f"register() needs a {accepted}, got {type(spec).__name__}")


def _duplicate(kind: str, name: str, owners: list[str]) -> str:
    subject = f"{SINGULAR[kind].replace('_', ' ')} '{name}' is registered"
    if len(set(owners)) == 1:
        return f"{subject} twice by {owners[0]}: give one of them another name"
    return f"{subject} by both {' and '.join(owners)}: uninstall one of them (pip uninstall {owners[-1]})"


def words(error: BaseException) -> str:
    """Return an error's type and message, also where the message cannot be made."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:  # a stranger's `__str__`
        return type(error).__name__


def _entry_points() -> list[tuple[str, metadata.EntryPoint]]:
    """Entry points of the group with their distribution's name, the suite's own first.

    Raises
    ------
    PluginError
        If `QRLSUITE_LOAD_PLUGINS` names a distribution that has none.
    """
    points: dict[tuple[str, str], metadata.EntryPoint] = {}
    for point in metadata.entry_points(group=hookspecs.PROJECT):
        owner = point.dist.name if point.dist is not None else "unknown"
        points.setdefault((owner, point.value), point)
    chosen = os.environ.get(LOAD_PLUGINS)
    if chosen is not None:
        allowed = [word.strip() for word in chosen.split(",") if word.strip()]
        owners = {_canonical(owner): owner for owner, _ in points}
        for word in allowed:
            if _canonical(word) not in owners:
                raise PluginError(
                    f"{LOAD_PLUGINS}: no installed distribution '{word}' has plugins{nearest(word, owners)}"
                )
        kept = {"qrlsuite", *(owners[_canonical(word)] for word in allowed)}
        points = {key: point for key, point in points.items() if key[0] in kept}
    return sorted(
        ((key[0], point) for key, point in points.items()),
        key=lambda p: (p[0] != "qrlsuite", p[0], p[1].name),
    )


def _canonical(distribution: str) -> str:
    """Return a distribution's name as package indexes compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


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

    Raises
    ------
    PluginError
        If strict, and a plugin is broken.
    """
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    registry = Registry(manager, strict=strict)
    for distribution, point in points():
        version = point.dist.version if point.dist is not None else ""
        plugin = Plugin(point.name, point.value, distribution, version)
        registry.plugins.append(plugin)
        try:
            plugin.requires = required_versions(point.dist)
            check_version(point.dist)
            plugin.registered = registry.add_plugin(_import(point, distribution), distribution)
        except PluginError as error:
            if strict:
                raise
            plugin.problem = str(error)
            registry.report(f"{error}; skipped")
    return registry


def _import(point: metadata.EntryPoint, distribution: str) -> Any:
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        raise PluginError(
            f"plugin '{point.name}' of distribution '{distribution}' cannot be imported: {words(error)}"
        ) from error


def is_strict() -> bool:
    """Return whether the environment asks for strictness: `QRLSUITE_STRICT` is set, and not to 0, false, no or off."""
    return os.environ.get(STRICT, "").strip().lower() not in ("", "0", "false", "no", "off")


_loading = False


def is_loading() -> bool:
    """Return whether `load` is discovering plugins at this moment, which may import anything."""
    return _loading


@functools.cache
def load() -> Registry:
    """Return the registry of this process, discovered once; an imported Gymnasium learns its environments."""
    global _loading
    _loading = True
    try:
        registry = create(is_strict())
    finally:
        _loading = False
    if "gymnasium" in sys.modules:
        qrlsuite._register(registry)
    return registry


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


def tracker(name: str) -> specs.TrackerSpec:
    """Look up a tracker by name."""
    return cast(specs.TrackerSpec, load().get("trackers", name).spec)


def ansatz(name: str) -> specs.AnsatzSpec:
    """Look up an ansatz by name."""
    return cast(specs.AnsatzSpec, load().get("ansatzes", name).spec)


def circuit_backend(name: str) -> specs.CircuitBackendSpec:
    """Look up a circuit backend by name."""
    return cast(specs.CircuitBackendSpec, load().get("circuit_backends", name).spec)


def required_versions(distribution: metadata.Distribution | None) -> str:
    """Return the versions of the suite that a distribution requires, such as `"<0.2,>=0.1"`; `""` for any.

    pip honors the requirement when the plugin is installed, and lets a later upgrade of the suite break it; so it
    is read again before the plugin is imported.

    Raises
    ------
    PluginError
        If what it requires cannot be read.
    """
    if distribution is None or distribution.name == "qrlsuite":
        return ""
    from packaging.requirements import InvalidRequirement, Requirement  # 50 ms: only where there are plugins

    stated = []
    for line in distribution.requires or []:
        try:
            requirement = Requirement(line)
            applies = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        except (InvalidRequirement, ValueError) as error:
            if line.lower().startswith("qrlsuite"):
                raise PluginError(
                    f"distribution '{distribution.name}' requires {line!r}, which cannot be read: {error}"
                ) from error
            continue
        if applies and requirement.name.lower().replace("_", "-") == "qrlsuite":
            stated += [str(specifier) for specifier in requirement.specifier]
    return ",".join(sorted(stated))


def check_version(distribution: metadata.Distribution | None, version: str | None = None) -> None:
    """Refuse a distribution that does not work with this version of the suite.

    Raises
    ------
    PluginError
        Naming the distribution, what it requires, what there is, and what to type.
    """
    needs = required_versions(distribution)
    if not needs or distribution is None:
        return
    from packaging.specifiers import SpecifierSet

    ours = qrlsuite.__version__ if version is None else version
    if not SpecifierSet(needs).contains(ours, prereleases=True):
        raise PluginError(
            f"distribution '{distribution.name}' {distribution.version} requires qrlsuite{needs}, and this is "
            f"qrlsuite {ours}: pip install --upgrade {distribution.name}, or pip install 'qrlsuite{needs}'"
        )
