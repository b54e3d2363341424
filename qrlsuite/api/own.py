"""Your own circuits, models, environments and algorithms from a notebook or script."""

from __future__ import annotations

import inspect
import os
import sys
from typing import TypeVar

from qrlsuite import own, specs
from qrlsuite.errors import OptionError, PluginError, QrlSuiteError
from qrlsuite.results import codes

Thing = TypeVar("Thing")
SIZE = 4, 2
"""Qubits and layers of a shown circuit."""
SHAPE = 3, 3
"""Inputs and outputs of a shown model."""


def register(thing: Thing) -> Thing:
    """Load a plugin's file or folder, and show its circuits and networks; in a plugin's file, register something of it.

    A notebook writes a cell to a file with `%%writefile mine.py`, and calls `qrlsuite.register("mine.py")`. After an
    edit, run both again: the file's things replace the ones of before. Seeds of the edited code are another entry.

    Parameters
    ----------
    thing:
        The path of a Python file or a package's folder. In a plugin's file, also as a decorator: a function
        (qubits, layers, ...) that returns a `Circuit`; a `torch.nn.Module` class built as (inputs, outputs, ...); a
        `gymnasium.Env` class; an algorithm's class; or a spec. Further parameters are options, by their annotations
        and defaults; see `qrlsuite.shortforms`.

    Returns
    -------
    object
        `thing` itself.

    Raises
    ------
    PluginError
        If it is none of these, a parameter cannot be an option, or another has its name.
    """
    caller = sys._getframe(1)
    if own.register(thing, f"{caller.f_code.co_filename}:{caller.f_lineno}"):
        return thing
    if not isinstance(thing, str | os.PathLike):
        raise PluginError(
            f"'{getattr(thing, '__name__', thing)}' is registered from its file: begin the notebook's cell with "
            "%%writefile mine.py, and call qrlsuite.register('mine.py')"
        )
    for each in codes.load_plugins(thing):
        _show(each)
    return thing


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

        qubits, layers = tuple(spec.size.values()) or SIZE
        return f"{qubits} qubits, {layers} layers:\n{draw_text(ansatz(spec.name, qubits, layers))}"
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
