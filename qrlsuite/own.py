"""Plugins by path: a Python file or a package's folder that is used as it lies there, without being installed.

A plugin is read, and copied to a folder that is named by its content. This copy runs, in every process; an entry's code
identity covers it, and the entry's folder gets it, even if the file changes meanwhile. A file brings with it the
modules beside it that it imports, and the data that it declares at its top level: `files = ["weights.npy"]`. In the
registry the name of the file or folder stands where an installed plugin has the name of its distribution.

A plugin registers by hooks, as an installed one does, or by `qrlsuite.register`. Where it has neither, whatever can be
recognized in its top-level module is registered: see `qrlsuite.shortforms`.
"""

from __future__ import annotations

import ast
import atexit
import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import keyword
import linecache
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib.machinery import (
    BYTECODE_SUFFIXES,
    EXTENSION_SUFFIXES,
    SOURCE_SUFFIXES,
    ExtensionFileLoader,
    FileFinder,
    ModuleSpec,
    SourceFileLoader,
    SourcelessFileLoader,
)
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import qrlsuite
from qrlsuite import hookspecs, registry, shortforms, specs
from qrlsuite.errors import FileError, OptionError, PluginError, QrlSuiteError, listed
from qrlsuite.files import read_bytes
from qrlsuite.registry import Plugin, Registered, Registry

MOST_BYTES, MOST_FILES = 16 << 20, 500
"""The largest size of a plugin."""
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
    def modules(self) -> set[str]:
        """The names of its top-level modules: its own, and of a file the modules beside it that it imports."""
        return {name.partition("/")[0].removesuffix(".py") for name in self.files if name.endswith(".py")}

    @cached_property
    def mark(self) -> str:
        """Sixteen hexadecimal digits that tell this content from other content."""
        content = hashlib.sha256()
        for name in sorted(self.files):
            content.update(f"{name}\0{len(self.files[name])}\0".encode() + self.files[name])
        return content.hexdigest()[:16]

    @cached_property
    def copy(self) -> Path:
        """The file or folder in this user's cache that runs."""
        return copy(self, _cache())

    def place(self, relative: str) -> str:
        """Return the whole path of one of the files, where it was read."""
        return str(self.path.parent / relative)


@dataclass
class Loaded:
    """A loaded plugin and its registered things."""

    source: Source
    plugin: Plugin
    registered: list[Registered[Any]]

    @property
    def sentence(self) -> str:
        """Its registered things, in a line: `ring.py: ansatz ring`."""
        things = [f"{each.spec.kind.replace('_', ' ')} {each.spec.name}" for each in self.registered]
        return f"{self.source.name}: {listed(things) or 'commands alone'}"


_importing: list[tuple[Source, list[tuple[Any, str]]]] = []
"""The plugins that are being imported, and what each has handed to `register`, with file and line."""


def loaded() -> list[Loaded]:
    """Return the plugins that were loaded by path in this process."""
    return list(registry.load().by_path.values())


def of_distribution(name: str) -> Loaded | None:
    """Return the plugin by path that the registry knows under a name in the place of a distribution's."""
    plugin: Loaded | None = registry.load().by_path.get(name)
    return plugin


def is_loading() -> bool:
    """Return whether a plugin by path is being imported at this moment."""
    return bool(_importing)


def modules() -> set[str]:
    """Return the names of the top-level modules of plugins by path."""
    return {name for each in loaded() for name in each.source.modules}


@cache
def _cache() -> Path:
    """Return the folder of copies: below `QRLSUITE_CACHE` or the user's cache folder, else a temporary one."""
    standard = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    for base in filter(None, (os.environ.get("QRLSUITE_CACHE"), standard)):
        with contextlib.suppress(OSError, RuntimeError):
            folder = Path(base).expanduser().absolute() / "qrlsuite" / "plugins"
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
    temporary = tempfile.TemporaryDirectory(prefix="qrlsuite-plugins-", ignore_cleanup_errors=True)
    atexit.register(temporary.cleanup)
    return Path(temporary.name)


def copy(source: Source, folder: Path) -> Path:
    """Write a plugin's content to a subfolder that is named by it, over any earlier content; return the plugin's path
    there.

    Raises
    ------
    PluginError
        If it cannot be written.
    """
    place = folder / source.mark

    def is_there() -> bool:
        found: dict[str, bytes | None] = {}
        for path in place.rglob("*"):
            name = path.relative_to(place)
            passed = any(part == "__pycache__" or part.startswith(".") for part in name.parts)
            if path.is_symlink() and not passed:
                found[name.as_posix()] = None
            elif path.is_file() and (name.as_posix() in source.files or not passed):
                found[name.as_posix()] = None if path.is_symlink() else path.read_bytes()
        return found == dict(source.files)

    try:
        if not is_there():
            shutil.rmtree(place, ignore_errors=True)
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=f".{source.mark}-", dir=folder) as draft:
                for name, content in source.files.items():
                    file = Path(draft, source.mark, name)
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_bytes(content)
                with contextlib.suppress(OSError):  # another process was first
                    Path(draft, source.mark).rename(place)
                if not is_there():
                    raise OSError("is not what was written")
    except OSError as error:
        raise PluginError(f"{place} cannot be written: {error.strerror or error}") from None
    return place / source.name


def read(path: str | os.PathLike[str]) -> Source:
    """Read a plugin's file with all that belongs to it, or all files of its package's folder; imports nothing.

    Raises
    ------
    PluginError
        If there is none, or it cannot be a module or package; the message names a usable name.
    """
    shown, place = os.fspath(path), Path(os.path.abspath(path))
    if place.is_dir():
        place = _package(shown, place)
        files = _folder(shown, place)
    elif place.suffix != ".py":
        raise PluginError(_no_plugin(shown, place))
    else:
        files = _file(shown, place)
    name = place.name.removesuffix(".py")
    if not name.isidentifier() or keyword.iskeyword(name):
        usable = "".join(c if c.isalnum() else "_" for c in name).strip("_") or "plugin"
        usable = f"my_{usable}" if usable[0].isdigit() or keyword.iskeyword(usable) else usable
        raise PluginError(
            f"plugin {shown}: Python cannot import a module '{name}': rename it, for example {usable}"
        )
    source = Source(place, files)
    if _is_copy(str(place)) and source.mark != place.parent.name:
        raise PluginError(f"plugin {shown} is a copy that was changed: give the plugin itself")
    return source


def _no_plugin(shown: str, place: Path) -> str:
    if not place.exists():
        near = place.with_name(f"{place.name}.py")
        return f"there is no plugin {shown}" + (f"; did you mean {near.name}?" if near.is_file() else "")
    if place.suffix == ".ipynb":
        return f"plugin {shown} is a notebook: begin the cell with %%writefile mine.py, and give that file"
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


def walk(folder: Path) -> Iterator[Path]:
    """Yield the files of a package in order, without caches, hidden files and links."""
    for path, folders, names in os.walk(folder):
        folders[:] = sorted(each for each in folders if each != "__pycache__" and not each.startswith("."))
        for file in (Path(path, name) for name in sorted(names) if not name.startswith(".")):
            if file.is_file() and not file.is_symlink():
                yield file


def _folder(shown: str, place: Path) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    for file in walk(place):
        files[file.relative_to(place.parent).as_posix()] = _bytes(shown, file)
        _require_small(shown, files)
    return files


def _require_small(shown: str, files: Mapping[str, bytes]) -> None:
    if len(files) > MOST_FILES or sum(map(len, files.values())) > MOST_BYTES:
        raise PluginError(
            f"plugin {shown} has more than {MOST_FILES} files or {MOST_BYTES >> 20} MB: give a folder of code"
        )


def _file(shown: str, place: Path) -> dict[str, bytes]:
    """Return a file, the modules and packages beside it that it imports, and the data that these declare."""
    files: dict[str, bytes] = {}
    left = {place.name: _bytes(shown, place)}
    while left:
        name, content = left.popitem()
        files[name] = content
        _require_small(shown, files)
        try:
            tree = ast.parse(content if name.endswith(".py") else b"")
        except (SyntaxError, ValueError):  # is said where it is imported
            continue
        found: dict[str, bytes] = {}
        for module in set(_imports(tree)) - sys.stdlib_module_names - _installed():
            file, folder = place.with_name(f"{module}.py"), place.with_name(module)
            if file.is_file():
                found[file.name] = _bytes(shown, file)
            elif (folder / "__init__.py").is_file():
                found |= _folder(f"{shown}, which imports {module},", folder)
        for data in _declared(tree):
            file = Path(os.path.normpath((place.parent / name).parent / data))
            try:
                inside = file.resolve().is_relative_to(place.parent.resolve())
                is_there = file.is_file()
            except (OSError, RuntimeError, ValueError):  # a loop of links, or what can be no path
                inside, is_there = True, False
            if not inside or not file.is_relative_to(place.parent):
                raise PluginError(f"plugin {shown}: files names {data}, which is not in {place.parent}")
            if not is_there:
                raise PluginError(f"plugin {shown}: files names {data}, and there is no such file")
            found[file.relative_to(place.parent).as_posix()] = _bytes(shown, file)
        left |= {file: content for file, content in found.items() if file not in files}
    return files


def _imports(tree: ast.Module) -> Iterator[str]:
    """Yield the names of the top-level modules that code imports anywhere."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def _declared(tree: ast.Module) -> Iterator[str]:
    """Yield the names in a list `files` at the top level of a module."""
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        value = getattr(node, "value", None)
        if any(getattr(each, "id", None) == "files" for each in targets) and isinstance(
            value, ast.List | ast.Tuple
        ):
            yield from (str(each.value) for each in value.elts if isinstance(each, ast.Constant))


def _installed() -> set[str]:
    """Return the top-level modules of installed plugins, the suite's own among them."""
    registered = registry.load()
    return {
        each.module.partition(":")[0].partition(".")[0]
        for each in registered.plugins
        if each.distribution not in registered.by_path
    }


def _is_copy(file: str) -> bool:
    return Path(file).is_relative_to(_cache())


def _bytes(shown: str, path: Path) -> bytes:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise PluginError(f"plugin {shown}: {path.name} is larger than {MOST_BYTES >> 20} MB")
        return read_bytes(path)
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
        elif of_distribution(_package_of(folder, path)) is None:
            raise FileError(
                f"{source}: plugins: no file in a results folder may load code from there; if you trust it, "
                f"add --plugin {os.path.join(folder or '', path)}"
            )


def load_source(source: Source) -> Loaded:
    """Like `load`, with content that was read before."""
    registered = registry.load()
    before: Loaded | None = next((each for each in loaded() if each.source.module == source.module), None)
    if before is None:
        _require_free(source)
    elif (before.source.mark, before.source.name) == (source.mark, source.name):
        return before
    elif before.source.path != source.path:
        raise PluginError(
            f"two plugins are called {source.module}: {before.source.path} and {source.path}; rename one of them"
        )
    _require_alike(source)
    if before is not None:
        unload(before)
    try:
        made = _load(registered, source)
    except BaseException:
        if before is not None:
            _load(registered, before.source)
        raise
    registered.announce(made.sentence)
    for note in shortforms.notes(sys.modules[source.module]):
        registered.announce(note)
    return made


def _load(known: Registry, source: Source) -> Loaded:
    """Import a plugin's copy, and register its things, or nothing of it."""
    handed: list[tuple[Any, str]] = []
    _importing.append((source, handed))
    _forget(source)  # what Python may have imported from elsewhere
    if _finder not in sys.path_hooks:
        sys.path_hooks.insert(0, _finder)
    sys.path.insert(0, str(source.copy.parent))
    try:
        module = importlib.import_module(source.module)
        registered = [_registered(thing, module, source, place) for thing, place in handed]
        if _has_hooks(module):
            registered += known.collect(module, source.name)
        elif not registered:
            registered = _recognized(module, source)
        registered = [replace(each, place=_shown(each.place)) for each in registered]
        _require_unique(known, registered)
    except BaseException as error:
        known.remove(source.name)
        _forget(source)
        if isinstance(error, Exception | SystemExit):
            raise PluginError(_failure(source, error)) from error
        raise
    finally:
        _importing.pop()
    made = Loaded(source, Plugin(source.module, str(source.path), source.name), registered)
    made.plugin.registered = known.add(registered)
    known.plugins.append(made.plugin)
    known.by_path[source.name] = made
    if "gymnasium" in sys.modules:
        qrlsuite._register(known)
    return made


class _Reader(SourceFileLoader):
    """Imports the text that was read, not a later file in its place, nor bytecode beside it."""

    def path_stats(self, path: Any) -> Any:
        raise OSError("bytecode is not used")

    def get_data(self, path: Any) -> bytes:
        for source in _sources():
            if Path(path).is_relative_to(source.copy.parent):
                content = source.files.get(Path(path).relative_to(source.copy.parent).as_posix())
                if content is not None:
                    return content
        return super().get_data(path)


def _finder(path: str) -> FileFinder:
    """Find the modules of copies, for Python's `sys.path_hooks`."""
    if not _is_copy(path):
        raise ImportError(path)
    return FileFinder(
        path,
        (ExtensionFileLoader, EXTENSION_SUFFIXES),
        (_Reader, SOURCE_SUFFIXES),
        (SourcelessFileLoader, BYTECODE_SUFFIXES),
    )


def _recognized(module: ModuleType, source: Source) -> list[Registered[Any]]:
    if short := shortforms.recognized(module):
        return [_registered(thing, module, source, _place(thing)) for thing in short]
    advice = f"write {shortforms.FORMS}, or call qrlsuite.register(...)"
    lacking = shortforms.lacking(shortforms.public(module))
    raise PluginError(f"{source.path} registers nothing: {lacking or advice}")


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


def _require_unique(registered: Registry, new: Sequence[Registered[Any]]) -> None:
    """Refuse a name that something else has, or that a plugin registers twice."""
    seen: dict[tuple[type[specs.Spec], str], Registered[Any]] = {}
    for each in new:
        key = type(each.spec), each.spec.name
        other = registered.of(key[0]).get(key[1]) or seen.get(key)
        if other is not None:
            raise PluginError(
                f"{each.place}: {each.spec.title} is registered already, by {other.distribution} ({other.place}): give "
                "it another name"
            )
        seen[key] = each


def _require_alike(source: Source) -> None:
    """Refuse a plugin that brings a module of the name of another plugin's, and of other content."""
    for other in (each.source for each in loaded()):
        for name in source.files.keys() & other.files.keys():
            places = source.place(name), other.place(name)
            if name.endswith(".py") and source.files[name] != other.files[name] and places[0] != places[1]:
                raise PluginError(
                    f"{places[0]} and {places[1]} are two modules of one name: rename one of them"
                )


def _require_free(source: Source) -> None:
    """Refuse a plugin whose module has the name of another module, or of an installed plugin."""
    known, name = registry.load(), source.module
    for each in known.plugins:
        if name == each.module.partition(":")[0] or source.name == each.distribution:
            raise PluginError(
                f"{source.path}: {name} is installed, as {each.distribution}: leave --plugin out, or rename this one"
            )
    origin = getattr(_found(name), "origin", None)
    if name in sys.stdlib_module_names:
        origin = "built-in"
    elif (
        origin is None or _is_copy(origin) or Path(origin).parent in (Path.cwd(), Path.cwd() / "__pycache__")
    ):
        return  # workers do not import from the folder where Python was started
    elif os.path.realpath(origin) in {os.path.realpath(source.place(file)) for file in source.files}:
        return
    raise PluginError(
        f"{source.path}: Python has another module '{name}' ({origin}): rename this one, for example my_{name}"
    )


def _found(module: str) -> ModuleSpec | None:
    """Return where Python finds a module; a folder without code is none."""
    try:
        spec = importlib.util.find_spec(module)
    except ValueError:  # `__main__`
        return None
    return None if spec is not None and spec.origin is None else spec


def _sources() -> list[Source]:
    """Return the plugins that are loaded, or are being imported."""
    return [*(source for source, _ in _importing), *(each.source for each in loaded())]


def _shown(text: str) -> str:
    """Return a text with the user's paths in place of the copies' paths."""
    for source in _sources():
        text = text.replace(f"{source.copy.parent}{os.sep}", f"{source.path.parent}{os.sep}")
    return text


def _words(error: BaseException) -> str:
    """Return an error of a plugin's code in words, in a line."""
    more = ""
    if isinstance(error, FileNotFoundError) and _is_copy(str(error.filename)):
        file = "/".join(Path(error.filename).relative_to(_cache()).parts[1:])
        more = f'; no such file belongs to the plugin: declare it at the top of the code, files = ["{file}"]'
    return _shown(" ".join(registry.words(error).split())[:_MOST_WORDS] + more)


def failure(error: BaseException) -> str:
    """Return the error of a plugin's code with its line, in words."""
    if not (where := place(error)):
        last = traceback.extract_tb(error.__traceback__)[-1:]
        where = "".join(f"{frame.filename}, line {frame.lineno}" for frame in last)
    return f"{_words(error)} ({where})" if where else _words(error)


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
    for source in _sources():
        if Path(file).is_relative_to(source.copy.parent):
            name = Path(file).relative_to(source.copy.parent).as_posix()
            text = source.files.get(name, b"").decode(errors="replace").splitlines()[line - 1 : line]
            return f"{name}, line {line}" + "".join(f": {each.strip()}" for each in text)
    if str(module).partition(".")[0] not in _installed() - {hookspecs.PROJECT}:
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
        raise PluginError(f"{failure(error)}: fix it and rerun the command") from error


def _failure(source: Source, error: BaseException) -> str:
    """Say where and why a plugin could not be imported, in one line."""
    if isinstance(error, PluginError):
        return _shown(str(error))
    if isinstance(error, SyntaxError) and _is_copy(str(error.filename)):
        return _shown(f"{error.filename}:{error.lineno}: {type(error).__name__}: {error.msg}")
    frames = [f for f in traceback.extract_tb(error.__traceback__) if _is_copy(f.filename)]
    place = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else str(source.path)
    return f"{_shown(place)}: {_words(error)}"


def _forget(source: Source) -> None:
    """Remove a plugin's modules from the imported ones."""
    for name in [name for name in sys.modules if name.partition(".")[0] in source.modules]:
        del sys.modules[name]
    if str(source.copy.parent) in sys.path:
        sys.path.remove(str(source.copy.parent))


def register(thing: Any, place: str) -> bool:
    """Note a registration of the plugin that is being imported; return whether there is one.

    Parameters
    ----------
    place:
        File and line of who asked for it.
    """
    if _importing:
        _importing[-1][1].append((thing, place))
    return bool(_importing)


Thing = TypeVar("Thing")


def note(thing: Thing) -> Thing:
    """Stand for `qrlsuite.register` in a plugin's file that is being imported."""
    caller = sys._getframe(1)
    register(thing, f"{caller.f_code.co_filename}:{caller.f_lineno}")
    return thing


def unload(each: Loaded) -> None:
    """Forget a plugin by path."""
    known = registry.load()
    known.remove(each.source.name)
    known.plugins.remove(each.plugin)
    del known.by_path[each.source.name]
    gymnasium, lanes = sys.modules.get("gymnasium"), sys.modules.get("qrlsuite.gymlanes")
    for spec in (one.spec for one in each.registered if isinstance(one.spec, specs.EnvironmentSpec)):
        if gymnasium is not None and spec.entry_point is not None:
            gymnasium.registry.pop(spec.gymnasium_id, None)
        if lanes is not None:
            lanes.random_returns.cache_clear()
    _forget(each.source)
