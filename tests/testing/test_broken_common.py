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
from qrlsuite.errors import OptionError
from qrlsuite.specs import EngineSpec, EnvironmentSpec, ModelSpec, PictureSpec, Spec
from qrlsuite.testing import common
from qrlsuite.testing.common import check_common, subject
from qrlsuite.testing.fresh import fresh_process
from tests.core.test_hooks import install
from tests.testing.broken import Edit, edit, ids

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
        with pytest.warns(
            registry.PluginWarning, match="'twin' is registered by both twins_a .* and twins_b"
        ):
            registry.load()
        yield
    registry.load.cache_clear()
    for name in DISTRIBUTIONS:
        sys.modules.pop(name, None)
    importlib.invalidate_caches()


def model(options: str = "Good", build: str = f"{STRANGE}:build", name: str = "") -> ModelSpec:
    return ModelSpec(
        name=name or re.sub(r"\W+", "-", f"{options} {build}".lower()),
        summary="Strange",
        family="classical",
        options=f"{STRANGE}:{options}",
        build=build,
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


POLICIES = {"policies": {"best": f"{STRANGE}:bild"}}
EDITS = [
    edit("name", r"^model 'mlp' is already registered by 'qrlsuite': give yours another name",
         subject=model(name="mlp")),
    edit("name", r"^model 'twin' is registered by both twins_a .* and twins_b .*: give", subject=registered("twin")),
    edit("references", r"^build = .* has no 'bild'; is the name spelled as",
         subject=model(build=f"{STRANGE}:bild"), also=["spawn"]),
    edit("references", r"No module named 'strage'; .* the package installed",
         subject=model(build="strage:build"), also=["spawn"]),
    edit("references", r"; pip install no-cloud$",
         subject=engine("no_cloud:E", no_cloud="pip install no-cloud"), also=["spawn"]),
    edit("references", r"^policies.best = .* has no 'bild'; is the name",
         subject=environment(**POLICIES), also=["spawn"]),
    edit("references", r"^build = .* is int, and it must be callable", subject=model(build=f"{STRANGE}:NUMBER")),
    edit("references", r"is not a dataclass: write a class under @pydantic.dataclasses", subject=model("NoDataclass")),
    edit("references", r"^pictures.map.options = .* is not a dataclass", subject=environment(**picture("NoDataclass"))),
    edit("lazy imports", r"^registering imports gymnasium: move that import .* top of heavy",
         subject=registered("heavy")),
    edit("lazy imports", r"^registering imports scipy: move that import .* heavy_hook",
         subject=registered("heavy-hook")),
    edit("spawn", r"as workers are: .* not in __main__, a note", subject=model(build="notebook_of_mine:build")),
    edit("spawn", r"^plugin module 'shy' fails in a fresh .*: RuntimeError: not in a worker",
         subject=registered("shy")),
    edit("spawn", r"ends when it imports the plugin: exit code 3, and no message", subject=registered("fatal")),
    edit("spawn", r"spec cannot be pickled: .* specs hold text", subject=engine(numpy=lambda: "pip install numpy")),
    edit("spawn", r"options cannot be pickled: .*Options'; .* at the top of its file", subject=model("Local")),
    edit("options documented", r"^Silent has no description of depth; write name: Annotated\[int",
         subject=model("Silent")),
    edit("options documented", r"^Silent has no description of depth", subject=environment(**picture("Silent"))),
    edit("options", r"^the defaults are not valid: .*width.*; every option needs a default", subject=model("Required")),
    edit("options", r"width = 0: .* greater than or equal to 1; defaults are not validated",
         subject=model("OutOfBounds")),
    edit("options", r"^options cannot be stored as JSON: .* nan, infinity and objects have no",
         subject=model("Undefined")),
    edit("options", r"^options cannot be stored as JSON: .*Spline.*; keep plain values", subject=model("Objects")),
    edit("options", r"differ: .*width=8\) became .*width=16\); is a value changed when it is",
         subject=model("Doubling")),
    edit("options", r"^option 'names' holds a set, whose order is another one in every", subject=model("Unordered")),
    edit("options", r"^option 'width' can be assigned to: write @dataclass\(frozen=True\)", subject=model("Assigned")),
]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def one_process(site: None) -> Iterator[None]:
    """One process resolves the references of all specs that nothing registered, instead of one for each."""
    subjects = [subject(type(spec), spec) for spec in (edit.spec["subject"] for edit in EDITS)]
    references = {r for each in subjects if not each.modules for r in each.references().values()}
    result = fresh_process((), tuple(sorted(references)))

    def shared(modules: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, Any]:
        return result if not modules and references.issuperset(needed) else fresh_process(modules, needed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(common, "fresh_process", shared)
        yield


def broken_rules(spec: Spec) -> dict[str, str]:
    findings, _ = check_common(subject(type(spec), spec))
    return {finding.rule: finding.message for finding in findings if not finding.ok}


@pytest.mark.parametrize("edit", EDITS, ids=ids(EDITS))
def test_one_rule_is_broken(edit: Edit) -> None:
    broken = broken_rules(edit.spec["subject"])
    assert broken.keys() == {edit.rule} | edit.also, broken
    assert re.search(edit.message, broken[edit.rule]), broken[edit.rule]


def test_every_rule_has_a_plugin_that_breaks_it() -> None:
    """The good one prints when it is imported, which disturbs nothing."""
    findings, usable = check_common(subject(ModelSpec, "tidy"))
    assert usable
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {edit.rule for edit in EDITS}


def test_what_nothing_registered_is_not_said_to_import_nothing() -> None:
    findings, usable = check_common(subject(ModelSpec, model()))
    assert usable
    assert all(finding.ok for finding in findings), findings
    assert "lazy imports" not in {finding.rule for finding in findings}


def test_options_of_what_has_none_are_refused() -> None:
    with pytest.raises(OptionError, match="engine 'local' has no options: leave seats out"):
        subject(EngineSpec, "local", {"seats": 2})


@pytest.mark.parametrize("name", ["NoDataclass", "Required"])
def test_without_options_the_rest_is_not_checked(name: str) -> None:
    assert not check_common(subject(ModelSpec, model(name)))[1]
