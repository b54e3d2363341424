"""Descriptions of registered things and of hooks, as plain values for lists and scripts."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

from qrlsuite import hookspecs, options, registry, specs
from qrlsuite.experiment.task import load


def hooks() -> list[dict[str, str]]:
    """Return every hook: its name, its signature, the first line of its manual and the manual."""
    described = []
    for name, function in vars(hookspecs).items():
        if inspect.isfunction(function) and hasattr(function, f"{hookspecs.PROJECT}_spec"):
            manual = inspect.getdoc(function) or ""
            arguments = ", ".join(inspect.signature(function).parameters)
            summary = manual.partition("\n")[0]
            row = {"name": name, "summary": summary, "signature": f"{name}({arguments})", "manual": manual}
            described.append(row)
    return described


def describe(kind: str, name: str) -> dict[str, Any]:
    """Return a registered thing's options, protocol or file, as plain values.

    Parameters
    ----------
    kind:
        One of `qrlsuite.registry.KINDS`.
    name:
        Under which it is registered.

    Raises
    ------
    UnknownNameError
        If nothing of that kind has the name.
    """
    if kind == "tasks" and name.startswith("gym:"):
        return {"kind": "task", "name": name, "distribution": "gymnasium"} | _task(name)
    registered = registry.load().get(kind, name)
    spec = registered.spec
    content: dict[str, Any] = {
        "kind": registry.SINGULAR[kind],
        "name": spec.name,
        "summary": spec.summary,
        "distribution": registered.distribution,
    }
    if isinstance(spec, specs.TaskSpec):
        return content | {"path": spec.path} | _task(name)
    for field in dataclasses.fields(spec):
        if field.name == "family":
            content["family"] = getattr(spec, field.name)
    reference = getattr(spec, "options", None)
    if reference:
        content["options"] = options.describe(specs.resolve(reference))
        content["set_with"] = _set_with(kind, name)
    return content


def _task(name: str) -> dict[str, Any]:
    """Return a task's hash and file."""
    task = load(name)
    return {"hash": task.hash, **task.file.model_dump(mode="json", exclude={"name"})}


def _set_with(kind: str, name: str) -> str:
    """Return what to type to change an option of a thing."""
    if kind != "ansatzes":
        return "--set NAME=VALUE"
    for model, registered in registry.load().entries["models"].items():
        if isinstance(registered.spec, specs.ModelSpec):
            names = options.field_names(specs.resolve(registered.spec.options))
            if {"ansatz", "ansatz_options"} <= set(names):
                return f"qrlsuite run --model {model} --set ansatz={name} --set NAME=VALUE"
    return "no installed model takes an ansatz"
