"""Your own circuits, models, environments and algorithms from a notebook or script."""

from __future__ import annotations

import dataclasses
import inspect
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, TypeVar

from qrlsuite import cells, own, shortforms, specs
from qrlsuite.errors import OptionError, PluginError, QrlSuiteError
from qrlsuite.results import codes

Thing = TypeVar("Thing")
SIZE = 4, 2
"""Qubits and layers of a shown circuit."""
SHAPE = 3, 3
"""Inputs and outputs of a shown model."""


def register(thing: Thing) -> Thing:
    """Register a function, a class, a spec, or a plugin's file or folder, under its name, and show its result.

    As a decorator it stands above a function or class in a cell. After an edit, run the cell again: its things replace
    the ones that the cell registered before. Results stay under the code that made them: `train` refuses to continue
    seeds of other code, unless `fresh=True` sets them aside.

    Parameters
    ----------
    thing:
        A function (qubits, layers, ...) that returns a `Circuit`; a `torch.nn.Module` class built as
        (inputs, outputs, ...); a `gymnasium.Env` class; an algorithm's class. Further parameters are options, by their
        annotations and defaults; see `qrlsuite.shortforms`. Or a spec, as a package registers it; or the path of a
        Python file or a package's folder.

    Returns
    -------
    object
        `thing` itself.

    Raises
    ------
    PluginError
        If it is none of these, a parameter cannot be an option, another has its name, or workers could not import it.

    Examples
    --------
    >>> @register  # doctest: +SKIP
    ... def ring(qubits: int, layers: int, depth: int = 1) -> Circuit: ...
    """
    caller = sys._getframe(1)
    place = f"{caller.f_code.co_filename}:{caller.f_lineno}"
    if own.register(thing, place):  # a plugin's file that is being imported
        return thing
    if isinstance(thing, str | os.PathLike):
        for each in codes.load_plugins(thing):
            _show(each)
        return thing
    _show(_of_cell(thing, place))
    return thing


def _of_cell(thing: Any, place: str) -> own.Loaded:
    """Load a module made of a cell's code."""
    if isinstance(thing, specs.Spec):
        name, things, registered = thing.name, _named(thing), thing
    elif shortforms.kind_of(thing) is not None:
        name, things, registered = shortforms.kebab(thing.__name__), [thing], thing.__name__
    else:
        shortforms.spec_of(thing, sys.modules[__name__], "")  # says what can be registered
        raise AssertionError
    for each in things:
        if each.__module__ != cells.MAIN:
            raise PluginError(
                f"'{name}' is defined in module {each.__module__}, not here: register its file, for example "
                f"qrlsuite.register({_file(each)!r})"
            )
    text = cells.module_of(things, name)
    module = _module(name)
    if isinstance(registered, specs.Spec):
        registered = _moved(registered, module)
    source = own.Source(_folder() / f"{module}.py", {f"{module}.py": text.encode()})
    before = own.of_distribution(source.name)
    if before is not None and not before.cell:
        raise PluginError(
            f"{place}: there is a plugin {before.source.path} already: give this one another name"
        )
    made = own.load_source(source, cell=True, things=[(registered, place)])
    own.write(source, source.path.parent)  # for tracebacks, and for processes that check it
    return made


def _module(name: str) -> str:
    """Return the name of a cell's module: the thing's name, unless Python has a module of that name."""
    word = name.replace("-", "_").replace(".", "_")
    return word if own.is_free(word) else f"own_{word}"


_folders: list[tempfile.TemporaryDirectory[str]] = []


def _folder() -> Path:
    """Return this process's folder of modules made of cells."""
    if not _folders:
        _folders.append(tempfile.TemporaryDirectory(prefix="qrlsuite-cells-"))
    return Path(_folders[0].name)


def _file(thing: Any) -> str:
    try:
        return os.path.relpath(inspect.getfile(thing))
    except (TypeError, OSError):
        return "FILE.py"


def _named(spec: specs.Spec) -> list[Any]:
    """Return the functions and classes of `__main__` that a spec refers to."""
    prefix, scope = f"{cells.MAIN}:", vars(sys.modules[cells.MAIN])
    words = [value for value in _texts(spec) if value.startswith(prefix)]
    missing = [word for word in words if word.removeprefix(prefix) not in scope]
    if missing:
        raise PluginError(f"{spec.title}: there is no '{missing[0]}'")
    if not words:
        raise PluginError(
            f"{spec.title} refers to nothing here: write references to what this notebook or script defines, such as "
            "'__main__:build', or register the file that they are in: qrlsuite.register('FILE.py')"
        )
    return [scope[word.removeprefix(prefix)] for word in words]


def _texts(spec: specs.Spec) -> list[str]:
    return [value for each in dataclasses.fields(spec) if isinstance(value := getattr(spec, each.name), str)]


def _moved(spec: specs.Spec, module: str) -> specs.Spec:
    """Return a spec that refers to a module in the place of `__main__`."""
    changed = {
        each.name: f"{module}:{value.partition(':')[2]}"
        for each in dataclasses.fields(spec)
        if isinstance(value := getattr(spec, each.name), str) and value.startswith(f"{cells.MAIN}:")
    }
    return dataclasses.replace(spec, **changed)


def _show(made: own.Loaded) -> None:
    """Print the registered things, and show their results."""
    print(made.sentence)
    for each in made.registered:
        try:
            picture = _picture(each.spec)
        except OptionError as error:  # not of this size
            picture = str(error)
        if picture:
            print(picture)


def _picture(spec: specs.Spec) -> str:
    if isinstance(spec, specs.AnsatzSpec):
        from qrlsuite.circuit import ansatz
        from qrlsuite.circuit.drawing import draw_text

        drawn = ansatz(spec.name, *SIZE)
        return f"{SIZE[0]} qubits, {SIZE[1]} layers:\n{draw_text(drawn)}"
    if isinstance(spec, specs.ModelSpec):
        import torch
        from gymnasium.spaces import Box

        from qrlsuite.training.fences import seeded
        from qrlsuite.training.trainer import build_agent

        build = specs.resolve(spec.build)
        if "space" in inspect.signature(build).parameters:  # of images, say: no size suits them all
            return ""
        try:
            with seeded(0):
                options, drawn_from = specs.resolve(spec.options)(), torch.Generator().manual_seed(0)
                module = build_agent(build, *SHAPE, options, drawn_from, Box(-1.0, 1.0, SHAPE[:1]))
        except QrlSuiteError:
            raise
        except Exception as error:
            raise PluginError(f"{spec.title} cannot be built: {own.failure(error)}") from error
        return f"{spec.family}, {SHAPE[0]} inputs, {SHAPE[1]} outputs:\n{module}"
    return ""
