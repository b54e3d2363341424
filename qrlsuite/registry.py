"""Finds plugins, and looks up their registered things.

`load()` reads the entry points of the group `qrlsuite`, built-ins and third parties alike. A plugin that does not fit
this version of the suite, cannot be imported, implements a hook that does not exist, or whose hook raises, is reported
by the name of its distribution and skipped as a whole; everything else goes on working. A name registered twice is an
error that names both places when it is looked up. With `qrlsuite --strict`, or `QRLSUITE_STRICT=1`, the first of these
problems ends the command. `QRLSUITE_LOAD_PLUGINS=acme-qrl,other` loads the plugins of these distributions only, and an
empty value the suite's plugins only.
"""

from __future__ import annotations

import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from types import SimpleNamespace
from typing import Any, Generic, TypeVar

import pluggy

import qrlsuite
from qrlsuite import hookspecs, specs
from qrlsuite.errors import PluginError, UnknownNameError, nearest

STRICT = "QRLSUITE_STRICT"
"""Environment variable: problems of plugins are fatal, in workers too."""

LOAD_PLUGINS = "QRLSUITE_LOAD_PLUGINS"
"""Environment variable: load the plugins of these distributions only, separated by commas, beside the suite's own."""

S_co = TypeVar("S_co", bound=specs.Spec, covariant=True)
S = TypeVar("S", bound=specs.Spec)


class PluginWarning(UserWarning):
    """A plugin was skipped, wholly or in part."""


@dataclass(frozen=True)
class Registered(Generic[S_co]):
    """A spec, the distribution that registered it, and the file and line where."""

    spec: S_co
    distribution: str
    place: str = ""


@dataclass
class Plugin:
    """An entry point, and the result of loading it: specs or a problem.

    Attributes
    ----------
    name:
        Its name among the distribution's entry points.
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
    entries: dict[type[specs.Spec], dict[str, Registered[Any]]] = field(
        default_factory=lambda: {kind: {} for kind in specs.KINDS.values()}
    )
    duplicates: dict[tuple[type[specs.Spec], str], list[Registered[Any]]] = field(default_factory=dict)
    plugins: list[Plugin] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    strict: bool = False
    by_path: dict[str, Any] = field(default_factory=dict)
    """The plugins that `qrlsuite.own` has loaded by path, by the name that stands for their distribution."""
    announce: Callable[[str], None] = lambda line: None
    """Called with a line for the user when a plugin has been loaded by path."""
    on_backends: list[Registered[specs.ModelSpec]] = field(default_factory=list)
    """The models for every circuit backend."""

    def of(self, kind: type[S]) -> Mapping[str, Registered[S]]:
        """Return the registered things of a kind, by name."""
        return self.entries[kind]

    def names(self, kind: type[specs.Spec]) -> list[str]:
        """Return the sorted names of a kind."""
        return sorted(self.entries[kind])

    def __iter__(self) -> Iterator[Registered[specs.Spec]]:
        for entries in self.entries.values():
            for name in sorted(entries):
                yield entries[name]

    def get(self, kind: type[S], name: str) -> Registered[S]:
        """Look up a spec."""
        owners = self.duplicates.get((kind, name))
        if owners:
            raise PluginError(_duplicate(owners))
        try:
            return self.of(kind)[name]
        except KeyError:
            hint = nearest(name, self.entries[kind])
            if kind is specs.ModelSpec and name in self.entries[specs.AnsatzSpec]:
                hint = f": it is an ansatz, which a circuit takes: --model vqc-native --set ansatz={name}"
            raise UnknownNameError(f"unknown {specs.title(kind, name)}{hint}") from None

    def add_plugin(self, plugin: Any, distribution: str) -> dict[str, list[str]]:
        """Register a plugin object with the manager, and all that it registers, or nothing of it.

        Returns
        -------
        dict
            Names that it registered, by kind in the plural.
        """
        return self.add(self.collect(plugin, distribution))

    def collect(self, plugin: Any, distribution: str) -> list[Registered[Any]]:
        """Register a plugin object with the manager; return the specs from its hooks, not yet added."""
        name = f"{distribution}:{getattr(plugin, '__name__', plugin)}"
        handed: list[Registered[Any]] = []
        try:
            self.manager.register(plugin, name=name)
            self._know_hooks(plugin)
            others = [p for p in self.manager.get_plugins() if p is not plugin]
            for hook, kind in hookspecs.REGISTER.items():
                try:
                    self.manager.subset_hook_caller(hook, others)(
                        register=functools.partial(_collect, handed, kind, distribution)
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
        return handed

    def add(self, new: Iterable[Registered[Any]]) -> dict[str, list[str]]:
        """Add registered things; return their names by kind in the plural."""
        registered: dict[str, list[str]] = {}
        for each in new:
            for one in self._with_models(each):
                registered.setdefault(one.spec.kinds, []).append(one.spec.name)
                self._add(one)
        return registered

    def _with_models(self, new: Registered[Any]) -> list[Registered[Any]]:
        """Return a spec, and with a circuit backend the models on it; a model for each backend is one on each."""
        backends = self.of(specs.CircuitBackendSpec)
        if isinstance(new.spec, specs.CircuitBackendSpec):
            made = [replace(each, spec=each.spec.on(new.spec)) for each in self.on_backends]
            return [new, *(each for each in made if each.spec.name not in self.of(specs.ModelSpec))]
        if not isinstance(new.spec, specs.ModelSpec) or not new.spec.backends:
            return [new]
        self.on_backends.append(new)
        return [replace(new, spec=new.spec.on(each.spec)) for each in backends.values()]

    def remove(self, distribution: str) -> None:
        """Forget all that a distribution has registered, the models on its circuit backends, and its hooks."""
        backends = [
            each.spec
            for each in self.of(specs.CircuitBackendSpec).values()
            if each.distribution == distribution
        ]
        lost = [each.spec.on(backend) for each in self.on_backends for backend in backends]
        self.on_backends = [each for each in self.on_backends if each.distribution != distribution]
        for entries in self.entries.values():
            for name, each in list(entries.items()):
                if each.distribution == distribution or each.spec in lost:
                    del entries[name]
        for name, plugin in self.manager.list_name_plugin():
            if plugin is not None and name.startswith(f"{distribution}:"):
                self.manager.unregister(plugin)

    def _know_hooks(self, plugin: Any) -> None:
        """Refuse implementations of hooks that do not exist (pluggy's `check_pending`, for one plugin)."""
        for caller in self.manager.get_hookcallers(plugin) or []:
            optional = all(i.optionalhook for i in caller.get_hookimpls() if i.plugin is plugin)
            if not caller.has_spec() and not optional:
                raise PluginError(f"there is no hook '{caller.name}'{nearest(caller.name, hookspecs.HOOKS)}")

    def _add(self, new: Registered[specs.Spec]) -> None:
        kind, name = type(new.spec), new.spec.name
        first = self.entries[kind].setdefault(name, new)
        if first is not new:
            owners = self.duplicates.setdefault((kind, name), [first])
            owners.append(new)
            self.report(_duplicate(owners))

    def report(self, problem: str) -> None:
        """Note a problem and warn of it."""
        if self.strict:
            raise PluginError(problem)
        self.problems.append(problem)
        warnings.warn(problem, PluginWarning, stacklevel=3)


def _collect(
    handed: list[Registered[Any]], kind: type[specs.Spec], distribution: str, spec: specs.Spec
) -> None:
    if type(spec) is not kind:
        raise PluginError(f"register() needs a {kind.__name__}, got {type(spec).__name__}")
    caller = sys._getframe(1)
    handed.append(Registered(spec, distribution, f"{caller.f_code.co_filename}:{caller.f_lineno}"))


def _duplicate(owners: list[Registered[specs.Spec]]) -> str:
    subject = f"{owners[0].spec.title} is registered"
    distributions, places = [each.distribution for each in owners], [each.place for each in owners]
    if len(set(distributions)) == 1:
        return f"{subject} twice by {distributions[0]}, {' and '.join(places)}: give one of them another name"
    both = " and ".join(f"{each.distribution} ({each.place})" for each in owners)
    return f"{subject} by both {both}: uninstall one of them (pip uninstall {distributions[-1]})"


def words(error: BaseException) -> str:
    """Return an error's type and message, also where the message cannot be made."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:  # a stranger's `__str__`
        return type(error).__name__


def _entry_points() -> list[tuple[str, metadata.EntryPoint]]:
    """Entry points of the group with their distribution's name, the suite's own first."""
    points: dict[tuple[str, str], metadata.EntryPoint] = {}
    for point in metadata.entry_points(group=hookspecs.PROJECT):
        owner = point.dist.name if point.dist is not None else "unknown"
        points.setdefault((owner, point.value), point)
    chosen = os.environ.get(LOAD_PLUGINS)
    if chosen is not None:
        allowed = [word.strip() for word in chosen.split(",") if word.strip()]
        owners = {canonical(owner): owner for owner, _ in points}
        for word in allowed:
            if canonical(word) not in owners:
                raise PluginError(
                    f"{LOAD_PLUGINS}: no installed distribution '{word}' has plugins{nearest(word, owners)}"
                )
        kept = {"qrlsuite", *(owners[canonical(word)] for word in allowed)}
        points = {key: point for key, point in points.items() if key[0] in kept}
    return sorted(
        ((key[0], point) for key, point in points.items()),
        key=lambda p: (p[0] != "qrlsuite", p[0], p[1].name),
    )


def canonical(distribution: str) -> str:
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
    """
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    hooks: Any = SimpleNamespace(**hookspecs.HOOKS)
    manager.add_hookspecs(hooks)
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


def get(kind: type[S], name: str) -> S:
    """Look up a spec in this process's registry: `get(ModelSpec, "mlp")`."""
    return load().get(kind, name).spec


def required_versions(distribution: metadata.Distribution | None) -> str:
    """Return the versions of the suite that a distribution requires, such as `"<0.2,>=0.1"`; `""` for any.

    pip honors the requirement when the plugin is installed, and lets a later upgrade of the suite break it; so it
    is read again before the plugin is imported.
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
    """Refuse a distribution that does not work with this version of the suite."""
    needs = required_versions(distribution)
    if not needs or distribution is None:
        return
    from packaging.specifiers import SpecifierSet

    ours = qrlsuite.__version__ if version is None else version
    if not SpecifierSet(needs).contains(ours, prereleases=True):
        raise PluginError(
            f"distribution '{distribution.name}' {distribution.version} requires qrlsuite{needs}, and this is "
            f"qrlsuite {ours}: upgrade {distribution.name}, or install a version of qrlsuite that fits"
        )
