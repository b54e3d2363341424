"""Descriptions of registered things, as plain values for lists and scripts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from qrlsuite import options, registry, specs
from qrlsuite.experiment.task import is_quick, load, starting_values


def describe(kind: type[specs.Spec], name: str) -> dict[str, Any]:
    """Return a registered thing's options, protocol or file, as plain values."""
    if kind is specs.TaskSpec and is_quick(name):
        source = "gymnasium" if name.startswith("gym:") else _source(name)
        return {"kind": "task", "name": name, "distribution": source} | _task(name)
    if kind is specs.TaskSpec and name.endswith(".toml"):
        return {"kind": "task", "name": load(name).name, "path": name} | _task(name)
    registered = registry.load().get(kind, name)
    spec = registered.spec
    content: dict[str, Any] = {
        "kind": spec.kind,
        "name": spec.name,
        "summary": spec.summary,
        "distribution": registered.distribution,
    }
    if isinstance(spec, specs.TaskSpec):
        return content | {"path": spec.path} | _task(name)
    if isinstance(spec, specs.ModelSpec):
        content["family"] = spec.family
    reference = getattr(spec, "options", None)
    if reference:
        content["options"] = options.describe(specs.resolve(reference))
        content["set_with"] = _set_with(spec)
    return content


def task_file(name: str) -> str:
    """Return a task as the text of its file; of one that no file has, as one that may be saved and changed."""
    if not is_quick(name):
        load(name)
        path = name if name.endswith(".toml") else registry.get(specs.TaskSpec, name).path
        return Path(path).read_text(encoding="utf-8")
    return tomli_w.dumps(load(name).file.model_dump(mode="json", exclude_unset=True))


def _source(environment: str) -> str:
    return registry.load().get(specs.EnvironmentSpec, environment).distribution


def _task(name: str) -> dict[str, Any]:
    task = load(name)
    left_out = {
        preset: {
            algorithm: values
            for algorithm, families in by_algorithm.items()
            if (values := _left_out(algorithm, families))
        }
        for preset, by_algorithm in task.file.presets.items()
    }
    added = {preset: values for preset, values in left_out.items() if values}
    return {
        "hash": task.hash,
        **task.file.model_dump(mode="json", exclude={"name"}),
        **({"starting_values": added} if added else {}),
    }


def _left_out(algorithm: str, families: Mapping[Any, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the algorithm's starting values that a preset does not set for all models."""
    return {
        option: value
        for option, value in starting_values(algorithm).items()
        if option not in families.get("all", {})
    }


def _set_with(spec: specs.Spec) -> str:
    """Return the words that change an option of a thing."""
    if not isinstance(spec, specs.AnsatzSpec):
        return "--set NAME=VALUE"
    for model, registered in registry.load().of(specs.ModelSpec).items():
        names = options.field_names(specs.resolve(registered.spec.options))
        if {"ansatz", "ansatz_options"} <= set(names):
            return f"qrlsuite run --model {model} --set ansatz={spec.name} --set NAME=VALUE"
    return "no installed model takes an ansatz"
