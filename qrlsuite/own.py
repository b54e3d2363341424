"""Plugins by path: a Python file or a package's folder that is used as it lies there, without being installed.

The content of a file or folder is read once, when it is loaded. This content runs, is covered by an entry's code
identity, and is copied into the entry's folder, even if the file changes meanwhile. Its top-level module is imported
under its own name. In the registry the name of the file or folder stands where an installed plugin has the name of its
distribution.

A plugin registers by hooks, as an installed one does, or by `qrlsuite.register`. Where it has neither, whatever can be
recognized in its top-level module is registered: see `qrlsuite.shortforms`.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.abc
import importlib.util
import inspect
import keyword
import linecache
import os
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any, TypeVar

import qrlsuite
from qrlsuite import hookspecs, registry, shortforms, specs
from qrlsuite.errors import FileError, OptionError, PluginError, QrlSuiteError, listed
from qrlsuite.registry import Plugin, Registered, Registry

MOST_BYTES, MOST_FILES = 16 << 20, 500
"""What a plugin may hold at most."""
_MOST_WORDS = 300
"""Shown characters of an error's message."""


@dataclass(frozen=True)
class Source:
    """The content of a plugin's file or folder when it was read.

    Attributes
    ----------
    path:
        Where it was read.
    files:
        Content by path, relative to the folder that `path` is in: `ring.py`, or `acme/__init__.py`.
    """

    path: Path
    files: Mapping[str, bytes] = field(repr=False)

    @property
    def name(self) -> str:
        """The name of the file or folder: `ring.py`, `acme`."""
        return self.path.name

    @property
    def module(self) -> str:
        """The name of the top-level module."""
        return self.path.name.removesuffix(".py")

    @property
    def mark(self) -> str:
        """Sixteen hexadecimal digits that tell this content from other content."""
        content = hashlib.sha256()
        for name in sorted(self.files):
            content.update(f"{name}\0{len(self.files[name])}\0".encode() + self.files[name])
        return content.hexdigest()[:16]

    def place(self, relative: str) -> str:
        """Return the whole path of one of the files."""
        return str(self.path.parent / relative)


@dataclass
class Loaded:
    """A loaded plugin and its registered things.

    Attributes
    ----------
    cell:
        Whether it was made of code in a notebook or script, which may register the same name again.
    """

    source: Source
    plugin: Plugin
    registered: list[Registered[Any]]
    cell: bool = False

    @property
    def sentence(self) -> str:
        """Its registered things, in a line: `ring.py: ansatz ring`."""
        things = [f"{each.spec.kind.replace('_', ' ')} {each.spec.name}" for each in self.registered]
        return f"{self.source.name}: {listed(things) or 'commands alone'}"


@dataclass
class _Own:
    """The plugins by path of a registry.

    Attributes
    ----------
    handed:
        Arguments of `register` while a plugin is imported, with file and line; None at other times.
    """

    loaded: dict[str, Loaded] = field(default_factory=dict)
    handed: list[tuple[Any, str]] | None = None


def _own() -> _Own:
    known = registry.load()
    if known.own is None:
        known.own = _Own()
    own: _Own = known.own
    return own


def loaded() -> list[Loaded]:
    """Return the plugins that were loaded by path in this process."""
    return list(_own().loaded.values())


def of_distribution(name: str) -> Loaded | None:
    """Return the plugin by path that the registry knows under a name in the place of a distribution's."""
    return _own().loaded.get(name)


def is_loading() -> bool:
    """Return whether a plugin by path is being imported at this moment."""
    return _own().handed is not None


def modules() -> set[str]:
    """Return the names of the top-level modules of plugins by path."""
    return {each.source.module for each in loaded()}


def read(path: str | os.PathLike[str]) -> Source:
    """Read a plugin's file, or all files of its package's folder; imports nothing.

    Raises
    ------
    PluginError
        If there is none, or it cannot be a module or package; the message says what to type.
    """
    shown, place = os.fspath(path), Path(os.path.abspath(path))
    if place.is_dir():
        place = _package(shown, place)
        files = _folder(shown, place)
    elif place.suffix != ".py":
        raise PluginError(_no_plugin(shown, place))
    else:
        files = {place.name: _bytes(shown, place)}
    name = place.name.removesuffix(".py")
    if not name.isidentifier() or keyword.iskeyword(name):
        usable = "".join(c if c.isalnum() else "_" for c in name).strip("_") or "plugin"
        usable = f"my_{usable}" if usable[0].isdigit() or keyword.iskeyword(usable) else usable
        raise PluginError(
            f"plugin {shown}: Python cannot import a module '{name}': rename it, for example {usable}"
        )
    return Source(place, files)


def _no_plugin(shown: str, place: Path) -> str:
    if not place.exists():
        near = place.with_name(f"{place.name}.py")
        return f"there is no plugin {shown}" + (f"; did you mean {near.name}?" if near.is_file() else "")
    if place.suffix == ".ipynb":
        return f"plugin {shown} is a notebook: call qrlsuite.register in a cell of it, or save the cell as a .py file"
    return (
        f"plugin {shown}: give a Python file, or the folder of a package (the one with __init__.py) or of a project "
        "with one package in src"
    )


def _package(shown: str, place: Path) -> Path:
    """Return the folder of the package: the given folder, or the only package in `src` of a project's folder."""
    if (place / "__init__.py").is_file():
        return place
    inner = sorted(path.parent for path in place.glob("src/*/__init__.py"))
    if len(inner) == 1:
        return inner[0]
    inner += sorted(path.parent for path in place.glob("*/__init__.py"))
    near = f"; did you mean {os.path.join(shown, inner[0].relative_to(place))}?" if inner else ""
    raise PluginError(f"plugin {shown} is no package: it has no __init__.py{near}")


def _package_of(folder: Path | None, path: str) -> str:
    """Return the name of the package in a project's folder; the path's name if it is no project."""
    place = (folder or Path()) / path
    try:
        return _package(path, place).name if place.is_dir() else place.name
    except PluginError:
        return place.name


def _folder(shown: str, place: Path) -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    for folder, folders, names in os.walk(place):
        folders[:] = sorted(each for each in folders if each != "__pycache__" and not each.startswith("."))
        for name in sorted(names):
            file = Path(folder) / name
            if name.startswith(".") or not file.is_file() or file.is_symlink():
                continue
            found[file.relative_to(place.parent).as_posix()] = _bytes(shown, file)
            if len(found) > MOST_FILES or sum(map(len, found.values())) > MOST_BYTES:
                raise PluginError(
                    f"plugin {shown} has more than {MOST_FILES} files or {MOST_BYTES >> 20} MB: give a folder of code"
                )
    return found


def _bytes(shown: str, path: Path) -> bytes:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise PluginError(f"plugin {shown}: {path.name} is larger than {MOST_BYTES >> 20} MB")
        return path.read_bytes()
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise PluginError(
            f"there is no plugin {shown}"
            if missing
            else f"plugin {shown} cannot be read: {error.strerror or error}"
        ) from None


def load(path: str | os.PathLike[str]) -> Loaded:
    """Import a plugin's file or folder, and register its things; loading equal content again does nothing.

    A plugin of the same path whose content has changed takes the place of the earlier one.

    Raises
    ------
    PluginError
        If there is none, it raises when it is imported, it registers nothing, or a name that another plugin has
        registered. Nothing of it is registered then.
    """
    return load_source(read(path))


def load_named(paths: Any, folder: Path | None, source: str) -> None:
    """Load the plugins that a TOML file names under `plugins`.

    Parameters
    ----------
    folder:
        Folder of the file: the paths are relative to it.
    source:
        The file, for messages.

    Raises
    ------
    FileError
        If it is no list of paths; or if one is to be loaded from a folder with results, which may be a stranger's.
    PluginError
        As `load`.
    """
    if not isinstance(paths, list) or not all(isinstance(path, str) and path for path in paths):
        raise FileError(f'{source}: plugins = {paths!r}: name files and folders, as in plugins = ["ring.py"]')
    beside_results = folder is None or any(folder.glob("*/*/entry.json"))
    for path in paths:
        if not beside_results:
            load(os.path.relpath(folder / path) if folder is not None else path)
        elif _package_of(folder, path) not in _own().loaded:
            raise FileError(
                f"{source}: plugins: what lies beside results is not imported on the word of a file there; if you "
                f"trust it, add --plugin {os.path.join(folder or '', path)}"
            )


def load_source(source: Source, cell: bool = False, things: Sequence[tuple[Any, str]] = ()) -> Loaded:
    """Like `load`, with content that was read before.

    Parameters
    ----------
    cell:
        See `Loaded`.
    things:
        Things to register, each with the caller's file and line: specs, or names in the module. If empty, the module
        registers them itself.
    """
    own, known = _own(), registry.load()
    before = next((each for each in own.loaded.values() if each.source.module == source.module), None)
    if before is not None:
        if (before.source.mark, before.source.name) == (source.mark, source.name):
            return before
        if before.source.path != source.path and not (cell and before.cell):
            raise PluginError(
                f"two plugins are called {source.module}: {before.source.path} and {source.path}; rename one of them"
            )
        _leave(own, known, before)
    else:
        _require_free(source)
    kept = {name: sys.modules.pop(name) for name in _names(source)}
    try:
        return _load(own, known, source, cell, things)
    except BaseException:
        known.remove(source.name)
        _forget(source)
        sys.modules.update(kept)
        if before is not None:
            _sources[before.source.module] = before.source
            if before.source.module in kept:
                known.collect(kept[before.source.module], before.source.name)
            _enter(own, known, before)
        raise


def _load(
    own: _Own, known: Registry, source: Source, cell: bool, things: Sequence[tuple[Any, str]]
) -> Loaded:
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
    _sources[source.module] = source
    outer, own.handed = own.handed, []
    try:
        module = importlib.import_module(source.module)
        given = own.handed
    except (Exception, SystemExit) as error:
        raise PluginError(_failure(source, error)) from error
    finally:
        own.handed = outer
    named = [(getattr(module, t) if isinstance(t, str) else t, place) for t, place in things]
    registered = [_registered(thing, module, source, place) for thing, place in named or given]
    if _has_hooks(module):
        registered += known.collect(module, source.name)
    elif not registered:
        registered = [
            _registered(thing, module, source, _place(thing)) for thing in shortforms.recognized(module)
        ]
        if not registered:
            lacking = shortforms.lacking(shortforms.public(module))
            advice = (
                "write a function (qubits, layers) that returns a Circuit, a torch.nn.Module, gymnasium.Env or "
                "algorithm class, or call qrlsuite.register(...)"
            )
            raise PluginError(f"{source.path} registers nothing: {lacking or advice}")
    _require_unique(known, registered)
    made = Loaded(source, Plugin(source.module, str(source.path), source.name), registered, cell)
    _enter(own, known, made)
    known.announce(made.sentence)
    return made


def _enter(own: _Own, known: Registry, each: Loaded) -> None:
    each.plugin.registered = known.add(each.registered)
    known.plugins.append(each.plugin)
    own.loaded[each.source.name] = each
    if "gymnasium" in sys.modules:
        qrlsuite._register(known)


def _registered(thing: Any, module: ModuleType, source: Source, place: str) -> Registered[Any]:
    try:
        spec = thing if isinstance(thing, specs.Spec) else shortforms.spec_of(thing, module, source.name)
    except PluginError as error:
        raise PluginError(f"{place}: {error}") from None
    return Registered(spec, source.name, place)


def _has_hooks(module: ModuleType) -> bool:
    return any(
        inspect.isroutine(value) and hasattr(value, f"{hookspecs.PROJECT}_impl")
        for value in vars(module).values()
    )


def _place(thing: Any) -> str:
    """Return file and line of a function or class."""
    line = shortforms.line_of(thing)
    return f"{sys.modules[thing.__module__].__file__}" + (f":{line}" if line else "")


def _require_unique(known: Registry, new: Sequence[Registered[Any]]) -> None:
    """Refuse a name that something else has, or that a plugin registers twice."""
    seen: dict[tuple[type[specs.Spec], str], Registered[Any]] = {}
    for each in new:
        key = type(each.spec), each.spec.name
        other = known.of(key[0]).get(key[1]) or seen.get(key)
        if other is not None:
            raise PluginError(
                f"{each.place}: {each.spec.title} is registered already, by {other.distribution} ({other.place}): give "
                "it another name"
            )
        seen[key] = each


def _require_free(source: Source) -> None:
    """Refuse a plugin whose module has the name of another module."""
    name = source.module
    if source.name in {each.distribution for each in registry.load().plugins}:
        raise PluginError(f"{source.path}: there is an installed plugin {source.name}: rename this one")
    there = sys.modules.get(name)
    spec = getattr(there, "__spec__", None) if there is not None else _found(name)
    origin = getattr(spec, "origin", None)
    if spec is None and name not in sys.stdlib_module_names:
        return
    if origin is not None and os.path.realpath(origin) in {
        os.path.realpath(source.place(f)) for f in source.files
    }:
        distributions = {
            each.distribution for each in registry.load().plugins if each.module.partition(":")[0] == name
        }
        if distributions:
            raise PluginError(
                f"{source.path} is installed already, as {min(distributions)}: leave --plugin out"
            )
        return
    if _beside(origin):
        return
    raise PluginError(
        f"{source.path}: Python has another module '{name}' ({origin or 'built-in'}): rename this one, for example "
        f"my_{name}"
    )


def _beside(origin: str | None) -> bool:
    """Return whether a module is one of the folder where Python was started, which workers do not import from."""
    return origin is not None and Path(origin).parent in (Path.cwd(), Path.cwd() / "__pycache__")


def _found(module: str) -> ModuleSpec | None:
    """Return where Python finds a module; a folder without code is none."""
    spec = importlib.util.find_spec(module)
    return None if spec is not None and spec.origin is None else spec


def is_free(module: str) -> bool:
    """Return whether a plugin's module may have a name: one that no module has which is not a plugin's by path."""
    if module in modules():
        return True
    return module not in {*sys.stdlib_module_names, *sys.modules} and _found(module) is None


def failure(error: BaseException) -> str:
    """Return the error of a plugin's code with its line, in words."""
    what = " ".join(registry.words(error).split())
    if not (where := place(error)):
        last = traceback.extract_tb(error.__traceback__)[-1:]
        where = "".join(f"{frame.filename}, line {frame.lineno}" for frame in last)
    return f"{what[:_MOST_WORDS]} ({where})" if where else what[:_MOST_WORDS]


def place(error: BaseException) -> str:
    """Return the innermost line of a plugin's code in an error's traceback; `""` without one."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        if where := _line(frame.f_code.co_filename, frame.f_globals.get("__name__"), line):
            return where
    return ""


def place_of(function: Any) -> str:
    """Return file and line where a function of a plugin's code begins; `""` for another one."""
    code = getattr(function, "__code__", None)
    return _line(code.co_filename, function.__module__, code.co_firstlineno) if code is not None else ""


def _line(file: str, module: Any, line: int) -> str:
    """Return a line of a plugin by path or an installed one: `ring.py, line 9: return x`; `""` where it is of none."""
    for source in (each.source for each in loaded()):
        for name in source.files:
            if source.place(name) == file:
                text = source.files[name].decode(errors="replace").splitlines()[line - 1 : line]
                return f"{name}, line {line}" + "".join(f": {each.strip()}" for each in text)
    installed = {
        each.module.partition(":")[0].partition(".")[0]
        for each in registry.load().plugins
        if each.distribution != hookspecs.PROJECT
    }
    if str(module).partition(".")[0] not in installed:
        return ""
    return f"{file}, line {line}: {linecache.getline(file, line).strip()}"


def placed(error: OptionError) -> OptionError:
    """Return an error of the suite with the line of a plugin's code that caused it; a plugin's own is unchanged."""
    *_, (last, _) = traceback.walk_tb(error.__traceback__)
    where = place(error)
    if not where or where in str(error) or not str(last.f_globals.get("__name__")).startswith("qrlsuite."):
        return error
    return type(error)(f"{error} ({where})").with_traceback(error.__traceback__)


@contextlib.contextmanager
def blamed() -> Iterator[None]:
    """Turn errors of a plugin's code into one message with its line; errors of the suite's own code stay.

    Raises
    ------
    PluginError
        With the line, and the remedy.
    """
    try:
        yield
    except Exception as error:
        if not place(error) or (isinstance(error, QrlSuiteError) and not isinstance(error, OptionError)):
            raise
        if isinstance(error, OptionError):
            raise PluginError(str(placed(error))) from error
        raise PluginError(f"{failure(error)}: mend it, and repeat the command") from error


def _failure(source: Source, error: BaseException) -> str:
    """Say where and why a plugin could not be imported, in one line."""
    if isinstance(error, PluginError):
        return str(error)
    names = {source.place(file) for file in source.files}
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in names]
    place = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else str(source.path)
    if isinstance(error, SyntaxError) and error.filename in names:
        return f"{error.filename}:{error.lineno}: {type(error).__name__}: {error.msg}"
    more = ""
    if isinstance(error, ModuleNotFoundError) and (name := (error.name or "").partition(".")[0]):
        beside = source.path.with_name(f"{name}.py")
        if beside.is_file():
            more = f": {beside.name} is another plugin: name it before this one, or make a package's folder of both"
    return f"{place}: {' '.join(registry.words(error).split())}{more}"


def _leave(own: _Own, known: Registry, each: Loaded) -> None:
    known.remove(each.source.name)
    known.plugins.remove(each.plugin)
    del own.loaded[each.source.name]
    gymnasium, lanes = sys.modules.get("gymnasium"), sys.modules.get("qrlsuite.gymlanes")
    for spec in (one.spec for one in each.registered if isinstance(one.spec, specs.EnvironmentSpec)):
        if gymnasium is not None and spec.entry_point is not None:
            gymnasium.registry.pop(spec.gymnasium_id, None)
        if lanes is not None:
            lanes.random_returns.cache_clear()
    _sources.pop(each.source.module, None)


def _names(source: Source) -> list[str]:
    """Return the names of a plugin's modules that are imported."""
    return [name for name in sys.modules if name.partition(".")[0] == source.module]


def _forget(source: Source) -> None:
    """Have a plugin's modules be imported no more."""
    _sources.pop(source.module, None)
    for name in _names(source):
        del sys.modules[name]


def register(thing: Any, place: str) -> bool:
    """Note a registration of the plugin that is being imported; return whether there is one.

    Parameters
    ----------
    place:
        File and line of who asked for it.
    """
    own = _own()
    if own.handed is None:
        return False
    own.handed.append((thing, place))
    return True


Thing = TypeVar("Thing")


def note(thing: Thing) -> Thing:
    """Be `qrlsuite.register` in a plugin's file that is being imported."""
    caller = sys._getframe(1)
    register(thing, f"{caller.f_code.co_filename}:{caller.f_lineno}")
    return thing


def unload(each: Loaded) -> None:
    """Forget a plugin by path."""
    _leave(_own(), registry.load(), each)
    _forget(each.source)


_sources: dict[str, Source] = {}


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the modules of plugins by path."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module that a plugin has, None for any other."""
        source = _sources.get(name.partition(".")[0])
        if source is None:
            return None
        place = name.replace(".", "/")
        for file, package in ((f"{place}/__init__.py", True), (f"{place}.py", False)):
            if file in source.files:
                origin = source.place(file)
                folders = [str(PurePosixPath(origin).parent)] if package else None
                return importlib.util.spec_from_file_location(
                    name, origin, loader=_Loader(name, origin, source), submodule_search_locations=folders
                )
        return None


class _Loader(SourceFileLoader):
    """Imports the content that was read; leaves no compiled files."""

    def __init__(self, name: str, path: str, source: Source) -> None:
        super().__init__(name, path)
        self._files = {source.place(file): content for file, content in source.files.items()}

    def get_data(self, path: str) -> bytes:
        """Return a file's content when the plugin was read."""
        known = self._files.get(os.fspath(path))
        return super().get_data(path) if known is None else known

    def path_stats(self, path: str) -> Any:
        """Say that there is no time of change, so that nothing compiled is looked for or written."""
        raise OSError(f"{path} was read before")


def write(source: Source, folder: Path) -> Path:
    """Write a plugin's content into a folder; return the path of the plugin there."""
    for name, content in source.files.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    return folder / source.name
