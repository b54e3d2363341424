"""Reads code by its effect: canonical syntax trees, the modules that imports reach, and the files of a package.

A tree is written by a walk of our own: empty fields do not count, so that fields which later versions of Python added
change nothing. Only the standard library is imported here; a module that is read is not imported.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.machinery
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

_APART = re.compile(
    r"(^|/)((tests?|docs?)/|(test_[^/]*|[^/]*_test|conftest)\.py$|py\.typed$|[^/]*\.pyi$"
    r"|(readme|license|licence|changelog|notice|authors)(\.\w+)?$)",
    re.IGNORECASE,
)
"""Tests and documents of a package."""

_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def canonical(source: bytes) -> bytes:
    """Return a module's syntax tree as text, without docstrings, comments and places: equal on every Python."""
    return _walked(ast.parse(source))


def _walked(tree: ast.Module) -> bytes:
    pieces: list[str] = []
    left: list[ast.AST | str] = [tree]
    while left:  # not recursive: a long sum is a deep tree
        item = left.pop()
        if isinstance(item, str):
            pieces.append(item)
        else:
            left += reversed(list(_unfolded(item)))
    return "".join(pieces).encode(errors="surrogatepass")


def _unfolded(node: ast.AST) -> Iterator[ast.AST | str]:
    """Yield a node's name and its fields in order; nothing of an empty field."""
    yield f"({type(node).__name__}"
    for name in node._fields:
        if name in ("kind", "type_ignores", "type_comment"):
            continue
        value: Any = getattr(node, name, None)
        if name == "is_lazy":
            value = value or None  # Python 3.15 writes 0 at every import that is not
        if isinstance(node, _DOCUMENTED) and name == "body":
            value = _without_docstring(value)
        elif isinstance(node, ast.JoinedStr):
            value = _joined(value)
        if isinstance(value, list):
            if value:
                yield f" {name}["
                for part in value:
                    yield from (part,) if isinstance(part, ast.AST) else (_written(part),)
                yield "]"
        elif isinstance(value, ast.AST):
            yield f" {name}="
            yield value
        elif value is not None or isinstance(node, ast.Constant):
            yield f" {name}={_written(value)}"
    yield ")"


def _without_docstring(body: list[ast.stmt]) -> list[ast.stmt]:
    first = body[0] if body else None
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
        return body[1:] if isinstance(first.value.value, str) else body
    return body


def _joined(values: list[ast.expr]) -> list[ast.expr]:
    """Return the parts of a formatted string with neighboring texts as one, and without empty ones."""
    parts: list[ast.expr] = []
    for value in values:
        if isinstance(value, ast.Constant) and not value.value:
            continue
        before = parts[-1] if parts else None
        if isinstance(value, ast.Constant) and isinstance(before, ast.Constant):
            parts[-1] = ast.Constant(str(before.value) + str(value.value))
        else:
            parts.append(value)
    return parts


def _written(value: object) -> str:
    """Write a constant, exactly."""
    if isinstance(value, int) and not isinstance(value, bool):
        return hex(value)  # Python refuses to write long numbers in decimals
    return f"{type(value).__name__}:{value!a};"


Find = Callable[[str], ModuleSpec | None]


def find(name: str) -> ModuleSpec | None:
    """Return where a module is, None where there is none; neither it nor a package above it is imported."""
    known = getattr(sys.modules.get(name), "__spec__", None)
    if isinstance(known, ModuleSpec):
        return known
    above, path = None, None
    if "." in name:
        above = find(name.rpartition(".")[0])
        if above is None or above.submodule_search_locations is None:
            return None
    try:
        if above is not None:
            path = list(above.submodule_search_locations or ())
        for finder in sys.meta_path:
            spec = finder.find_spec(name, path)
            if spec is not None:
                return spec
    except (
        AttributeError,
        ImportError,
        KeyError,
        ValueError,
    ):  # a finder of another kind, or of another time
        return None
    return None


def below(folder: Path, name: str) -> ModuleSpec | None:
    """Return where a module of a script is, whatever this process has imported; packages may lack an `__init__.py`."""
    place = str(folder / name.replace(".", "/"))
    for file in (
        f"{place}/__init__.py",
        *(f"{place}{suffix}" for suffix in importlib.machinery.all_suffixes()),
    ):
        if os.path.isfile(file):
            return importlib.util.spec_from_file_location(name, file)
    return None


def reached(
    roots: Iterable[str], belongs: Callable[[str, ModuleSpec], bool] | None, find: Find = find
) -> dict[str, str]:
    """Return the SHA-256 of every module that the roots reach by imports, by file.

    An import of a name from a package counts for the module of that name, else for the package's own `__init__`; the
    packages above a module do not count. A module without source counts by its file's bytes, one without a file not at
    all. Nothing is imported.

    Parameters
    ----------
    belongs:
        Whether a module counts, by the name and the spec of its top-level package; None if each that is found does.
    """
    found: dict[str, str] = {}
    seen: set[str] = set()
    left = list(roots)
    while left:
        name = left.pop()
        if name in seen:
            continue
        seen.add(name)
        first = name.partition(".")[0]
        if belongs is not None and ((top := find(first)) is None or not belongs(first, top)):
            continue
        spec = find(name)
        content = None if spec is None else _content(spec)
        if spec is None or content is None:
            continue
        digest, imported = _read(content, spec, find)
        found[_file(spec)] = digest
        left += imported
    return dict(sorted(found.items()))


def _content(spec: ModuleSpec) -> bytes | None:
    if not spec.has_location or spec.origin is None:
        return None
    try:
        content: bytes = spec.loader.get_data(spec.origin)  # type: ignore[union-attr]
    except (AttributeError, OSError):
        return None
    return content


def _file(spec: ModuleSpec) -> str:
    """Return a module's file, relative to where its top-level package lies."""
    place = spec.name.replace(".", "/")
    suffix = "." + str(spec.origin).rpartition(".")[2]
    return f"{place}/__init__{suffix}" if spec.submodule_search_locations is not None else place + suffix


def _read(content: bytes, spec: ModuleSpec, find: Find) -> tuple[str, list[str]]:
    """Return a module's SHA-256, and the names of the modules that it imports anywhere."""
    tree = _tree(content, str(spec.origin))
    return _digest(content, tree), [] if tree is None else list(_imports(tree, spec, find))


def _tree(content: bytes, name: str) -> ast.Module | None:
    try:
        return ast.parse(content) if name.endswith(".py") else None
    except (SyntaxError, ValueError):  # what this Python cannot read, it does not run
        return None


def _digest(content: bytes, tree: ast.Module | None) -> str:
    return hashlib.sha256(content if tree is None else _walked(tree)).hexdigest()


def counts(name: str) -> bool:
    """Return whether something that is trained may depend on a file of a package: no test, no document."""
    return _APART.search(name) is None


def digest(name: str, content: bytes) -> str:
    """Return the SHA-256 of a file's bytes; of a Python file, of its syntax tree."""
    return _digest(content, _tree(content, name))


def _imports(tree: ast.Module, spec: ModuleSpec, find: Find) -> Iterator[str]:
    package = spec.submodule_search_locations is not None
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = spec.name.split(".")
            up = node.level - package
            around = ".".join(parts[: len(parts) - up]) if node.level else ""
            base = ".".join(part for part in (around, node.module) if part)
            for alias in node.names if base else ():
                own = f"{base}.{alias.name}"
                yield own if alias.name != "*" and find(own) is not None else base
