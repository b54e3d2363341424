"""Plugins that break one of the rules that all kinds share."""

from __future__ import annotations

import importlib
import re
import sys
import types
from collections.abc import Iterator
from typing import Any

import pytest

from qrlsuite import registry
from qrlsuite.specs import AlgorithmSpec, EngineSpec, EnvironmentSpec, ModelSpec, PictureSpec, Spec
from qrlsuite.testing import common
from qrlsuite.testing.common import check_common, subject
from qrlsuite.testing.fresh import fresh_process
from tests.core.test_hooks import install
from tests.testing.broken import Broken, ids

STRANGE = "tests.testing.strange"
PLUGIN = """
from qrlsuite import hookimpl
from qrlsuite.specs import ModelSpec
{top}

@hookimpl
def register_models(register):
    {hook}
    register(
        ModelSpec(
            name="{name}", summary="Strange", family="classical",
            options="tests.testing.strange:Good", build="tests.testing.strange:build",
            memory="tests.testing.strange:memory",
        )
    )
"""
IN_A_WORKER = "if sys.argv[0].endswith('fresh.py'):"


def plugin(name: str, top: str = "", hook: str = "pass") -> str:
    return PLUGIN.format(name=name, top=top, hook=hook)


DISTRIBUTIONS = {
    "tidy": plugin("tidy", "print('good day')"),
    "heavy": plugin("heavy", "import gymnasium"),
    "heavy_hook": plugin("heavy-hook", hook="import scipy"),
    "twins_a": plugin("twin"),
    "twins_b": plugin("twin"),
    "shy": plugin("shy", f"import sys\n{IN_A_WORKER}\n    raise RuntimeError('not in a worker')"),
    "fatal": plugin("fatal", f"import os, sys\n{IN_A_WORKER}\n    os._exit(3)"),
}


@pytest.fixture(scope="module", autouse=True)
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Distributions as pip leaves them, and a module that no file holds."""
    folder = tmp_path_factory.mktemp("site")
    for name, code in DISTRIBUTIONS.items():
        install(folder, name, code)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv(registry.LOAD_PLUGINS, ",".join(DISTRIBUTIONS))
        notebook = types.ModuleType("notebook_of_mine")
        notebook.build = print  # type: ignore[attr-defined]
        patch.setitem(sys.modules, "notebook_of_mine", notebook)
        registry.load.cache_clear()
        with pytest.warns(registry.PluginWarning, match="'twin' is registered by both twins_a and twins_b"):
            registry.load()
        yield
    registry.load.cache_clear()
    for name in DISTRIBUTIONS:
        sys.modules.pop(name, None)
    importlib.invalidate_caches()


def model(
    options: str = "Good",
    build: str = f"{STRANGE}:build",
    name: str = "",
    memory: str = f"{STRANGE}:memory",
) -> ModelSpec:
    return ModelSpec(
        name=name or re.sub(r"\W+", "-", f"{options} {build}".lower()),
        summary="Strange",
        family="classical",
        options=f"{STRANGE}:{options}",
        build=build,
        memory=memory,
    )


def environment(**more: Any) -> EnvironmentSpec:
    return EnvironmentSpec("world", "Strange", f"{STRANGE}:Good", "World-v0", f"{STRANGE}:build", **more)


def picture(options: str) -> dict[str, Any]:
    return {
        "pictures": (PictureSpec("map", "Strange", draw=f"{STRANGE}:build", options=f"{STRANGE}:{options}"),)
    }


def engine(factory: str = f"{STRANGE}:build", **extras: Any) -> EngineSpec:
    return EngineSpec("cloud", "Strange", factory, extras=extras)


def registered(name: str) -> ModelSpec:
    """What a distribution of the site registers under a name."""
    return model(name=name)


SPAWN, OPTIONS = frozenset({"spawn"}), frozenset({"options"})
POLICIES = {"policies": {"best": f"{STRANGE}:bild"}}
BROKEN = [
    ("name", Broken(model(name="mlp"), r"^model 'mlp' is already registered by 'qrlsuite': give yours another name")),
    ("name", Broken(registered("twin"), r"^model 'twin' is registered by both twins_a and twins_b: give")),
    ("references", Broken(model(build=f"{STRANGE}:bild"), r"^build = .* has no 'bild'; is the name spelled as", SPAWN)),
    ("references", Broken(model(build="strage:build"), r"No module named 'strage'; .* the package installed", SPAWN)),
    ("references", Broken(engine("no_cloud:E", no_cloud="pip install no-cloud"), r"; pip install no-cloud$", SPAWN)),
    ("references", Broken(environment(**POLICIES), r"^policies.best = .* has no 'bild'; is the name", SPAWN)),
    ("references", Broken(model(build=f"{STRANGE}:NUMBER"), r"^build = .* is int, and it must be callable")),
    ("references", Broken(model("NoDataclass"), r"is not a dataclass: write a class under @pydantic.dataclasses")),
    ("references", Broken(environment(**picture("NoDataclass")), r"^pictures.map.options = .* is not a dataclass")),
    ("lazy imports", Broken(registered("heavy"), r"^registering imports gymnasium: move that import .* top of heavy")),
    ("lazy imports", Broken(registered("heavy-hook"), r"^registering imports scipy: move that import .* heavy_hook")),
    ("spawn", Broken(model(build="notebook_of_mine:build"), r"as workers are: .* not in __main__, a note")),
    ("spawn", Broken(registered("shy"), r"^plugin module 'shy' fails in a fresh .*: RuntimeError: not in a worker")),
    ("spawn", Broken(registered("fatal"), r"ends when it imports the plugin: exit code 3, and no message")),
    ("spawn", Broken(engine(numpy=lambda: "pip install numpy"), r"spec cannot be pickled: .* specs hold text")),
    ("spawn", Broken(model("Local"), r"options cannot be pickled: .*Options'; .* at the top of its file")),
    ("options documented", Broken(model("Silent"), r"^Silent has no description of depth; write name: Annotated\[int")),
    ("options documented", Broken(environment(**picture("Silent")), r"^Silent has no description of depth")),
    ("options", Broken(model("Required"), r"^the defaults are not valid: .*width.*; every option needs a default")),
    ("options", Broken(model("OutOfBounds"), r"width = 0: .* greater than or equal to 1; defaults are not validated")),
    ("options", Broken(model("Undefined"), r"^options cannot be stored as JSON: .* nan, infinity and objects have no")),
    ("options", Broken(model("Objects"), r"^options cannot be stored as JSON: .*Spline.*; keep plain values")),
    ("options", Broken(model("Doubling"), r"differ: .*width=8\) became .*width=16\); is a value changed when it is")),
    ("options", Broken(model("Unordered"), r"^option 'names' holds a set, whose order is another one in every")),
    ("options", Broken(model("Assigned"), r"^option 'width' can be assigned to: write @dataclass\(frozen=True\)")),
    ("memory", Broken(model(memory=f"{STRANGE}:build"), r":build' fails: AssertionError: no rule that all")),
    ("memory", Broken(model(memory=f"{STRANGE}:Good"), r"Good' fails: .*")),
    ("memory", Broken(AlgorithmSpec("learner", "Strange", f"{STRANGE}:Good", f"{STRANGE}:build", f"{STRANGE}:memory"),
     r"^'learner': memory = '.*:memory' returned 1000, and must return a Memory of whole numbers")),
]  # fmt: skip

KINDS = {
    AlgorithmSpec: "algorithms",
    ModelSpec: "models",
    EngineSpec: "engines",
    EnvironmentSpec: "environments",
}


@pytest.fixture(scope="module", autouse=True)
def one_process(site: None) -> Iterator[None]:
    """One process resolves the references of all specs that nothing registered, instead of one for each."""
    subjects = [subject(KINDS[type(case.spec)], case.spec) for _, case in BROKEN]
    references = {r for each in subjects if not each.modules for r in each.references().values()}
    result = fresh_process((), tuple(sorted(references)))

    def shared(modules: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, Any]:
        return result if not modules and references.issuperset(needed) else fresh_process(modules, needed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(common, "fresh_process", shared)
        yield


def broken_rules(spec: Spec) -> dict[str, str]:
    findings, _ = check_common(subject(KINDS[type(spec)], spec))
    return {finding.rule: finding.message for finding in findings if not finding.ok}


@pytest.mark.parametrize(("rule", "case"), BROKEN, ids=ids(BROKEN))
def test_one_rule_is_broken(rule: str, case: Broken) -> None:
    broken = broken_rules(case.spec)
    assert broken.keys() == {rule} | case.also, broken
    assert re.search(case.message, broken[rule]), broken[rule]


def test_every_rule_has_a_plugin_that_breaks_it() -> None:
    """The good one prints when it is imported, which disturbs nothing."""
    findings, usable = check_common(subject("models", "tidy"))
    assert usable
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in BROKEN}


def test_what_nothing_registered_is_not_said_to_import_nothing() -> None:
    findings, usable = check_common(subject("models", model()))
    assert usable
    assert all(finding.ok for finding in findings), findings
    assert "lazy imports" not in {finding.rule for finding in findings}


@pytest.mark.parametrize("name", ["NoDataclass", "Required"])
def test_without_options_the_rest_is_not_checked(name: str) -> None:
    assert not check_common(subject("models", model(name)))[1]
