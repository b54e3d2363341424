"""Discovery: third parties enter by the same door, broken ones are named and skipped, duplicates are errors."""

from __future__ import annotations

import importlib
import subprocess
import sys
import types
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

import qrlsuite
from qrlsuite import registry, specs
from qrlsuite.errors import PluginError
from qrlsuite.hookspecs import hookimpl
from tests.conftest import installed
from tests.core.test_dependencies import ALL

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
    assert found.names(specs.ModelSpec) == ["tp"]
    assert found.get(specs.ModelSpec, "tp").distribution == "third-party"


def test_a_model_for_every_circuit_backend_is_one_on_each_whichever_comes_first() -> None:
    """A backend's plugin registers no model; where it does, that one stands."""
    backend: dict[str, Any] = {"summary": "Exact; options: none", "options": "a:O", "factory": "a:F"}
    for name in ("first", "later", "own"):
        made = specs.CircuitBackendSpec(name=name, **backend)
        plugin(f"tp_{name}", register_circuit_backends=lambda register, made=made: register(made))
    waves, own = (
        specs.ModelSpec(name="waves", backends=True, **MODEL),
        specs.ModelSpec(name="waves-own", **MODEL),
    )
    plugin("tp_waves", register_models=lambda register: register(waves))
    sys.modules["tp_own"].register_models = hookimpl(lambda register: register(own))
    names = ("tp_first", "tp_waves", "tp_later", "tp_own")
    found = registry.create(strict=True, points=points(*((name[3:], name) for name in names)))
    models = found.of(specs.ModelSpec)
    assert sorted(models) == ["waves-first", "waves-later", "waves-own"]
    assert [models[name].distribution for name in sorted(models)] == ["waves", "waves", "own"]
    assert (models["waves-later"].spec.options, models["waves-own"].spec.options) == ("a:B[later]", "a:B")
    assert models["waves-later"].spec.summary == "One; backend: Exact"
    assert [each.registered.get("models") for each in found.plugins] == [
        None, ["waves-first"], ["waves-later"], ["waves-own"]
    ]  # fmt: skip
    found.remove("later")
    assert sorted(models) == ["waves-first", "waves-own"]


def test_a_name_registered_twice_names_both_distributions() -> None:
    for name in ("tp_one", "tp_two"):
        plugin(name, register_models=lambda register: register(specs.ModelSpec(name="twin", **MODEL)))
    both = points(("one", "tp_one"), ("two", "tp_two"))
    place = r"\(.*test_registry.py:\d+\)"
    message = rf"'twin' is registered by both one {place} and two {place}: uninstall one of them \(pip uninstall two\)"
    with pytest.warns(registry.PluginWarning, match=message):
        found = registry.create(points=both)
    with pytest.raises(PluginError, match=message):
        found.get(specs.ModelSpec, "twin")
    with pytest.raises(PluginError, match=message):
        registry.create(strict=True, points=both)


def test_a_name_registered_twice_by_one_distribution_is_its_own_affair() -> None:
    def twice(register: Callable[..., None]) -> None:
        register(specs.ModelSpec(name="twin", **MODEL))
        register(specs.ModelSpec(name="twin", **MODEL))

    plugin("tp_twice", register_models=twice)
    with pytest.warns(
        registry.PluginWarning, match="twice by one, .*:\\d+ and .*:\\d+: give one of them another name"
    ):
        registry.create(points=points(("one", "tp_twice")))


def one_then_fail(register: Callable[..., None]) -> None:
    register(specs.ModelSpec(name="half-registered", **MODEL))
    raise ValueError("no such file")


@pytest.mark.parametrize(
    ("functions", "message"),
    [
        (
            {"register_models": lambda register: 1 / 0},
            "hook 'register_models': ZeroDivisionError: division by zero",
        ),
        ({"register_models": one_then_fail}, "hook 'register_models': ValueError: no such file"),
        ({"register_models": lambda register: register("mlp")}, "needs a ModelSpec, got str"),
        ({"register_models": lambda registre: None}, "registre"),
        (
            {"register_modles": lambda register: None},
            "there is no hook 'register_modles'; did you mean 'register_models'",
        ),
    ],
)
def test_a_broken_plugin_is_named_and_skipped(functions: dict[str, Any], message: str) -> None:
    plugin("tp_broken", **functions)
    plugin("tp_fine", register_models=lambda register: register(specs.ModelSpec(name="fine", **MODEL)))
    both = points(("broken-dist", "tp_broken"), ("fine-dist", "tp_fine"))
    with pytest.warns(registry.PluginWarning, match=message) as caught:
        found = registry.create(points=both)
    assert str(caught[0].message).startswith("plugin 'tp_broken' of distribution 'broken-dist': ")
    assert found.names(specs.ModelSpec) == ["fine"]
    assert [bool(p.problem) for p in found.plugins] == [True, False]
    assert "tp_broken" not in str(found.manager.list_name_plugin())
    with pytest.raises(PluginError, match=message):
        registry.create(strict=True, points=both)


def test_a_plugin_that_ends_the_interpreter_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tp_exits.py").write_text("raise SystemExit('no license')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.warns(registry.PluginWarning, match="cannot be imported: SystemExit: no license"):
        registry.create(points=points(("rude", "tp_exits")))


@pytest.mark.parametrize(
    ("requires", "version", "fits"),
    [
        ([], "9.9", True),
        (["numpy>=1"], "0.1.0", True),
        (["qrlsuite"], "0.1.0", True),
        (["qrlsuite>=0.1,<0.2"], "0.1.0", True),
        (["qrlsuite>=0.1,<0.2"], "0.1.7.dev3", True),
        (["qrlsuite>=0.1,<0.2"], "0.2.0", False),
        (["QRLsuite[tune] >=0.3"], "0.1.0", False),
        (["qrlsuite>=0.3; extra == 'new'"], "0.1.0", True),
        (["qrlsuite>=0.3; python_version < '3'"], "0.1.0", True),
        (["not a requirement!"], "0.1.0", True),
    ],
)
def test_the_versions_that_a_distribution_requires(
    requires: list[str], version: str, fits: bool, tmp_path: Path
) -> None:
    found = distribution(tmp_path, requires)
    if fits:
        registry.check_version(found, version)
    else:
        with pytest.raises(
            PluginError, match=r"'acme' 2.5 requires qrlsuite.*, and this is qrlsuite 0\..*: upgrade acme"
        ):
            registry.check_version(found, version)


def test_a_requirement_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(PluginError, match="distribution 'acme' requires 'qrlsuite>>1', which cannot be read"):
        registry.required_versions(distribution(tmp_path, ["qrlsuite>>1"]))


def distribution(folder: Path, requires: list[str]) -> metadata.Distribution:
    info = folder / "acme-2.5.dist-info"
    info.mkdir()
    lines = [f"Requires-Dist: {r}\n" for r in requires]
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 2.5\n" + "".join(lines))
    return metadata.Distribution.at(info)


@pytest.mark.parametrize(
    ("value", "strict"), [("1", True), ("yes", True), ("0", False), ("", False), ("No", False)]
)
def test_the_variable_that_makes_problems_fatal(
    value: str, strict: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(registry.STRICT, value)
    assert registry.is_strict() is strict


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


def test_names_stay_what_they_are_once_every_module_is_imported() -> None:
    """A function of the same name as a submodule would be replaced by it, and be no function any longer."""
    for name in sorted(ALL):
        if ".templates." not in name and not name.endswith("__main__"):
            importlib.import_module(name)
    assert isinstance(qrlsuite.__version__, str)
    functions = set(qrlsuite.__all__) - {"__version__", "api"}
    assert not [name for name in functions if isinstance(getattr(qrlsuite, name), types.ModuleType)]
    assert all(callable(getattr(qrlsuite, name)) for name in functions)
    assert all(getattr(qrlsuite, name) is getattr(qrlsuite.api, name) for name in qrlsuite.api.__all__)
    assert isinstance(qrlsuite.training, types.ModuleType)
    assert isinstance(qrlsuite.tuning, types.ModuleType)


@pytest.mark.parametrize(
    "order",
    [
        "import gymnasium, qrlsuite",
        "import qrlsuite; from gymnasium.envs import registration; import gymnasium",
        "import qrlsuite, qrlsuite.registry; qrlsuite.registry.load(); import gymnasium",
    ],
)
def test_environments_are_known_to_gymnasium(order: str) -> None:
    program = (
        f"import sys; finders = list(sys.meta_path); {order}; assert sys.meta_path == finders, sys.meta_path; "
        "env = gymnasium.make('qrlsuite/BeamManagement6G-v1', degree=4); env.reset(seed=0)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


def test_a_plugin_may_import_gymnasium_while_it_is_loaded(tmp_path: Path) -> None:
    site = tmp_path / "site"
    (site / "heavy-1.dist-info").mkdir(parents=True)
    (site / "heavy-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: heavy\nVersion: 1\n")
    (site / "heavy-1.dist-info" / "entry_points.txt").write_text("[qrlsuite]\nheavy = heavy\n")
    (site / "heavy.py").write_text(
        "import gymnasium\nfrom qrlsuite import hookimpl, specs\n\n\n@hookimpl\n"
        "def register_environments(register):\n"
        "    register(specs.EnvironmentSpec('mine', 'a pole', 'qrlsuite.plugins.circuits.ansatz:NoOptions', "
        "gymnasium_id='heavy/Pole-v0', entry_point='gymnasium.envs.classic_control.cartpole:CartPoleEnv'))\n"
    )
    program = (
        "import qrlsuite.registry as registry; assert not registry.load().problems, registry.load().problems; "
        "import gymnasium; gymnasium.make('heavy/Pole-v0'); gymnasium.make('qrlsuite/BeamManagement6G-v1')"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True, env=installed(site))
