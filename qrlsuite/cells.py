"""Makes a module of a function or class that was written in a notebook's cell or a script, as workers can import it.

The module holds the source of the registered things and of all names that they use: imports, constants, functions and
classes from earlier cells. A name assigned in the same cell is taken with its assignment.
"""

from __future__ import annotations

import ast
import builtins
import linecache
import symtable
import sys
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

from qrlsuite.errors import PluginError

MAIN = "__main__"


def module_of(things: list[Any], name: str) -> str:
    """Return the source of a module with some functions and classes of `__main__`, and all that they name.

    Parameters
    ----------
    name:
        Name of the registered thing, for messages.

    Raises
    ------
    PluginError
        If a source cannot be read, or names something that workers cannot have.
    """
    gathered = _Gathered(name)
    for thing in things:
        gathered.define(thing)
    return gathered.text()


class _Gathered:
    """What a module consists of: imports, then everything else in the order in which it needs each other."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.future = False
        self._imports: list[str] = []
        self._pieces: list[str] = []
        self._known: set[str] = set()

    def text(self) -> str:
        """Return the module's source."""
        first = ["from __future__ import annotations\n"] if self.future else []
        imports = "".join(f"{line}\n" for line in self._imports)
        return "\n".join([*first, *([imports] if imports else []), "\n\n".join(self._pieces)])

    def define(self, thing: Any) -> None:
        """Add a function or class of `__main__` with the names that it uses."""
        if thing.__name__ in self._known:
            return
        self._known.add(thing.__name__)
        tree, lines, code = _cell(thing, self.name)
        node = _definition(tree, thing)
        if node is None:
            raise PluginError(_no_source(self.name, "its cell has no such definition"))
        self.future |= bool(code.co_flags & 0x1000000)  # annotations are not evaluated
        source = "".join(_without_register(node, lines))
        self._needs(source, tree, lines)
        self._pieces.append(source)

    def _needs(self, source: str, tree: ast.Module, lines: list[str]) -> None:
        """Add the names that a piece of source uses."""
        scope = vars(sys.modules[MAIN])
        for word in dict.fromkeys(_globals(symtable.symtable(source, "<cell>", "exec"))):
            if word in self._known or (word not in scope and hasattr(builtins, word)):
                continue
            if word in scope:
                self._add(word, scope[word], tree, lines)
            elif not _later(tree, word):
                continue  # Python says so where it is run
            else:
                raise PluginError(
                    f"'{self.name}' uses '{word}', which is defined after it: write it above, and run the cell again"
                )

    def _add(self, word: str, value: Any, tree: ast.Module, lines: list[str]) -> None:
        if isinstance(value, ModuleType):
            self._import(word, value.__name__, None)
            return
        home, own = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
        if isinstance(value, FunctionType | type) and home == MAIN:
            self.define(value)
            if value.__name__ != word:
                self._pieces.append(f"{word} = {value.__name__}\n")
                self._known.add(word)
            return
        if isinstance(home, str) and home != MAIN and own and "." not in own and "<" not in own:
            module = sys.modules.get(home)
            if module is not None and getattr(module, own, None) is value:
                self._import(word, home, own)
                return
        imported = _import_of(tree, word)
        if imported is not None:
            self._known.add(word)
            self._imports.append(imported)
            return
        self._known.add(word)
        if _is_plain(value):
            self._pieces.append(f"{word} = {value!r}\n")
            return
        assigned = _assignment(tree, word)
        if assigned is None:
            raise PluginError(
                f"'{self.name}' uses '{word}', a {type(value).__name__}, which workers cannot have: define it in the "
                "same cell, or write all of it to a file and register that: qrlsuite.register('FILE.py')"
            )
        source = "".join(lines[assigned.lineno - 1 : assigned.end_lineno])
        self._needs(source, tree, lines)
        self._pieces.append(source if source.endswith("\n") else f"{source}\n")

    def _import(self, word: str, module: str, attribute: str | None) -> None:
        if module == MAIN:
            raise PluginError(f"'{self.name}' uses '{word}', the notebook or script itself")
        self._known.add(word)
        if attribute is not None:
            self._imports.append(
                f"from {module} import {attribute}" + (f" as {word}" if word != attribute else "")
            )
        elif "." in module and word == module.partition(".")[0]:
            self._imports.append(f"import {module}")
        else:
            self._imports.append(f"import {module}" + (f" as {word}" if word != module else ""))


def _cell(thing: Any, name: str) -> tuple[ast.Module, list[str], CodeType]:
    """Return the cell or file that a function or class was written in: as a tree, and as lines."""
    code = next(_codes(thing), None)
    if code is None:
        raise PluginError(_no_source(name, "it has no function of its own"))
    lines = linecache.getlines(code.co_filename)
    try:
        return ast.parse("".join(lines)), lines, code
    except SyntaxError:
        return ast.Module([], []), lines, code


def _no_source(name: str, why: str) -> str:
    return (
        f"the source of '{name}' cannot be read here ({why}), and workers need it: write it to a file, and register "
        f"that: qrlsuite.register('{name}.py')"
    )


def _codes(thing: Any) -> Iterator[CodeType]:
    """Yield the code of a function, or of the functions of a class."""
    if isinstance(thing, FunctionType):
        yield thing.__code__
    elif isinstance(thing, type):
        for value in vars(thing).values():
            inner = getattr(value, "__func__", getattr(value, "fget", value))
            if isinstance(inner, FunctionType) and inner.__module__ == thing.__module__:
                yield inner.__code__


def _definition(tree: ast.Module, thing: Any) -> ast.FunctionDef | ast.ClassDef | None:
    """Return the statement that made a function or class."""
    lines = {code.co_firstlineno for code in _codes(thing)}
    kind = ast.ClassDef if isinstance(thing, type) else ast.FunctionDef
    for node in ast.walk(tree):
        if isinstance(node, kind) and node.name == thing.__name__:
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            if any(first <= line <= (node.end_lineno or 0) for line in lines):
                return node
    return None


def _without_register(node: ast.FunctionDef | ast.ClassDef, lines: list[str]) -> list[str]:
    """Return a definition's lines without the decorator `register`."""
    left = set(
        range(min([node.lineno, *(each.lineno for each in node.decorator_list)]), (node.end_lineno or 0) + 1)
    )
    for each in node.decorator_list:
        if (each.attr if isinstance(each, ast.Attribute) else getattr(each, "id", "")) == "register":
            left -= set(range(each.lineno, (each.end_lineno or each.lineno) + 1))
    kept = [lines[number - 1] for number in sorted(left)]
    margin = len(kept[0]) - len(kept[0].lstrip())
    kept = [line[margin:] if not line[:margin].strip() else line for line in kept]
    return [line if line.endswith("\n") else f"{line}\n" for line in kept]


def _globals(table: symtable.SymbolTable) -> Iterator[str]:
    """Yield the names that a piece of source takes from its module, in all its scopes."""
    for symbol in table.get_symbols():
        if symbol.is_referenced() and (symbol.is_global() or table.get_type() == "module"):
            yield symbol.get_name()
    for child in table.get_children():
        yield from _globals(child)


def _later(tree: ast.Module, word: str) -> bool:
    """Return whether a cell defines a name."""
    return (
        any(getattr(node, "name", None) == word for node in tree.body) or _assignment(tree, word) is not None
    )


def _import_of(tree: ast.Module, word: str) -> str | None:
    """Return the import statement of a cell that gives a name."""
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            for alias in node.names:
                if (alias.asname or alias.name) == word:
                    alone = (
                        ast.Import([alias])
                        if isinstance(node, ast.Import)
                        else ast.ImportFrom(node.module, [alias], 0)
                    )
                    return ast.unparse(alone)
    return None


def _assignment(tree: ast.Module, word: str) -> ast.Assign | ast.AnnAssign | None:
    """Return the last statement at a cell's top level that assigns a name."""
    found = None
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if isinstance(node, ast.Assign | ast.AnnAssign) and any(
            getattr(t, "id", None) == word for t in targets
        ):
            found = node
    return found


def _is_plain(value: Any) -> bool:
    """Return whether a value is written as Python reads it again."""
    if isinstance(value, tuple | list | set | frozenset):
        return type(value) in (tuple, list, set, frozenset) and all(map(_is_plain, value))
    if type(value) is dict:
        return all(_is_plain(key) and _is_plain(inner) for key, inner in value.items())
    return (
        value is None or (type(value) in (bool, int, str, bytes)) or (type(value) is float and value == value)
    )
