"""Discovery: third parties enter by the same door, broken ones are named and skipped, duplicates are errors."""

from __future__ import annotations

import subprocess
import sys
import types
from collections.abc import Callable
from importlib import metadata
from typing import Any

import pytest

from qrlsuite import registry, specs
from qrlsuite.errors import PluginError, UnknownNameError
from qrlsuite.hookspecs import hookimpl

MODEL: dict[str, Any] = {"summary": "One", "family": "classical", "options": "a:B", "build": "a:C"}


def plugin(name: str, **functions: Callable[..., None]) -> types.ModuleType:
    module = types.ModuleType(name)
    for hook, function in functions.items():
        setattr(module, hook, hookimpl(function))
    sys.modules[name] = module
    return module


def points(*pairs: tuple[str, str]) -> Callable[[], list[tuple[str, metadata.EntryPoint]]]:
    return lambda: [(owner, metadata.EntryPoint("x", module, "qrlsuite")) for owner, module in pairs]


def test_a_third_partys_model_is_found() -> None:
    plugin("tp_good", register_models=lambda register: register(specs.ModelSpec(name="tp", **MODEL)))
    found = registry.create(points=points(("third-party", "tp_good")))
    assert found.names("models") == ["tp"]
    assert found.get("models", "tp").distribution == "third-party"


def test_an_unknown_name_gets_the_nearest_match() -> None:
    with pytest.raises(UnknownNameError, match="unknown model 'mpl'; did you mean 'mlp'"):
        registry.load().get("models", "mpl")


def test_a_name_registered_twice_names_both_distributions() -> None:
    for name in ("tp_one", "tp_two"):
        plugin(name, register_models=lambda register: register(specs.ModelSpec(name="twin", **MODEL)))
    with pytest.warns(registry.PluginWarning, match="'twin' is registered by both one and two"):
        found = registry.create(points=points(("one", "tp_one"), ("two", "tp_two")))
    with pytest.raises(PluginError, match="by both one and two: uninstall one of them"):
        found.get("models", "twin")


@pytest.mark.parametrize(
    ("functions", "message"),
    [
        ({"register_models": lambda register: 1 / 0}, "hook 'register_models': division by zero"),
        ({"register_models": lambda register: register("mlp")}, "needs a ModelSpec, got str"),
        ({"register_models": lambda registre: None}, "registre"),
        ({"register_modles": lambda register: None}, "register_modles"),
    ],
)
def test_a_broken_plugin_is_named_and_skipped(functions: dict[str, Any], message: str) -> None:
    plugin("tp_broken", **functions)
    plugin("tp_fine", register_models=lambda register: register(specs.ModelSpec(name="fine", **MODEL)))
    both = points(("broken-dist", "tp_broken"), ("fine-dist", "tp_fine"))
    with pytest.warns(registry.PluginWarning, match=message):
        found = registry.create(points=both)
    assert found.names("models") == ["fine"]
    with pytest.raises(PluginError, match=message):
        registry.create(strict=True, points=both)


def test_a_plugin_that_cannot_be_imported_is_named_and_skipped() -> None:
    with pytest.warns(
        registry.PluginWarning, match="distribution 'gone' cannot be imported: ModuleNotFoundError"
    ):
        registry.create(points=points(("gone", "no_such_module_anywhere")))


@pytest.mark.parametrize("name", ["", "UPPER", "a/b", "../x", "a b", "-a", "a--b", "x" * 65, 3])
def test_unusable_names_are_refused(name: Any) -> None:
    with pytest.raises(PluginError, match="is not usable"):
        specs.ModelSpec(name=name, **MODEL)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("json", "should read"),
        ("no_such_module:x", "cannot be imported"),
        ("json:nothing", "has no 'nothing'"),
    ],
)
def test_references_that_do_not_resolve(reference: str, message: str) -> None:
    with pytest.raises(PluginError, match=message):
        specs.resolve(reference)


@pytest.mark.parametrize(("kind", "name"), [(k, r.spec.name) for k, r in registry.load()])
def test_every_registered_reference_resolves(kind: str, name: str) -> None:
    spec = registry.load().get(kind, name).spec
    for field in ("options", "build", "factory", "population", "vector", "entry_point"):
        reference = getattr(spec, field, None)
        if reference is not None:
            assert callable(specs.resolve(reference))


@pytest.mark.parametrize(
    "order", ["import gymnasium, qrlsuite", "import qrlsuite, gymnasium; qrlsuite.register_environments()"]
)
def test_environments_are_known_to_gymnasium(order: str) -> None:
    program = f"{order}; env = gymnasium.make('qrlsuite/BeamManagement6G-v1', degree=4); env.reset(seed=0)"
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)
