"""Each hook by the example in its own manual; and a stranger's distribution, as pip leaves it, on the command line."""

from __future__ import annotations

import inspect
import subprocess
import sys
import textwrap
import types
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from qrlsuite import hookspecs, registry
from qrlsuite.cli.extensions import add_commands
from qrlsuite.experiment.catalog import hooks
from qrlsuite.testing.tracker import RECORD, RUN
from qrlsuite.training import trackers
from tests.commands import qrlsuite
from tests.conftest import install, installed

NAMES = [row["name"] for row in hooks()]


def example(hook: str, folder: Path) -> types.ModuleType:
    """The module that the hook's manual shows."""
    manual = inspect.getdoc(getattr(hookspecs, hook)) or ""
    code = manual.partition(":\n\n    ")[2]
    lines = [line for line in f"    {code}".splitlines() if not line.strip() or line.startswith("    ")]
    module = types.ModuleType(f"example_{hook}")
    module.__file__ = str(folder / "plugin.py")
    names = {"hookimpl": hookspecs.hookimpl, "RuleSpec": registry.specs.RuleSpec}
    module.__dict__.update(names)
    exec(compile(textwrap.dedent("\n".join(lines)), f"<manual of {hook}>", "exec"), module.__dict__)
    return module


def load(module: types.ModuleType) -> registry.Registry:
    sys.modules[module.__name__] = module
    point = metadata.EntryPoint("example", module.__name__, "qrlsuite")
    return registry.create(strict=True, points=lambda: [("example-dist", point)])


@pytest.mark.parametrize("hook", NAMES)
def test_the_example_in_the_manual_works(hook: str, tmp_path: Path) -> None:
    found = load(example(hook, tmp_path))
    kind = hook.removeprefix("register_")
    if hook == "register":
        assert found.plugins[0].registered == {"ansatzes": ["ring"], "tasks": ["short"]}
    elif kind in registry.KINDS:
        [plugin] = found.plugins
        [name] = plugin.registered[kind]
        assert found.get(kind, name).distribution == "example-dist"
    elif hook == "register_commands":
        app = typer.Typer()
        app.callback()(lambda: None)
        add_commands(app, found)
        assert "Hello, you." in CliRunner().invoke(app, ["hello"]).output
    else:
        content: dict[str, Any] = {"run": {**RUN, "folder": str(tmp_path), "epochs": 0}}
        if hook == "epoch_finished":
            content["record"] = RECORD
        sink = trackers.EventSink(found)
        sink.send(hook, **content)
        assert not sink.problems
        assert (tmp_path / "notes.txt").read_text().strip()


def test_one_hook_takes_every_kind_of_spec_and_nothing_else() -> None:
    module = types.ModuleType("example_one_hook")
    module.register = registry.hookspecs.hookimpl(lambda register: register("ring"))  # type: ignore[attr-defined]
    with pytest.raises(registry.PluginError, match=r"hook 'register': register\(\) needs a spec of"):
        load(module)


def test_every_kind_and_event_has_a_hook() -> None:
    expected = {f"register_{kind}" for kind in registry.KINDS} | {
        "register",
        "register_commands",
        *trackers.EVENTS,
    }
    assert set(NAMES) == expected


COMMANDS = """
import typer
from qrlsuite import hookimpl

@hookimpl
def register_commands(app):
    {body}
"""


def suite(site: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return qrlsuite(*words, env=installed(site) | environment)


def test_broken_distributions_are_named_and_the_rest_works(tmp_path: Path) -> None:
    install(tmp_path, "acme_ok", COMMANDS.format(body="app.command('greet')(lambda: typer.echo('good day'))"))
    install(tmp_path, "acme_old", "raise RuntimeError('must not be imported')", "qrlsuite<0.1")
    install(tmp_path, "acme_import", "import no_such_package")
    install(tmp_path, "acme_raises", COMMANDS.format(body="1 / 0"))
    install(tmp_path, "acme_takes", COMMANDS.format(body="app.command('list')(lambda: None)"))
    done = suite(tmp_path, "greet")
    assert (done.returncode, done.stdout) == (0, "good day\n"), done.stderr
    for expected in (
        "distribution 'acme_old' 1.0 requires qrlsuite<0.1, and this is qrlsuite",
        "of distribution 'acme_import' cannot be imported: ModuleNotFoundError",
        "of distribution 'acme_raises': hook 'register_commands': ZeroDivisionError",
        "of distribution 'acme_takes': hook 'register_commands': there is a command 'list' already",
    ):
        assert expected in done.stderr
    listed = suite(tmp_path, "list", "plugins").stdout
    assert "acme_ok 1.0, for qrlsuite>=0.1" in listed
    assert "SKIPPED: distribution 'acme_old'" in listed
    for done in (suite(tmp_path, "--strict", "greet"), suite(tmp_path, "greet", QRLSUITE_STRICT="1")):
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1, done.stderr


def test_only_the_plugins_that_are_named_are_loaded(tmp_path: Path) -> None:
    install(tmp_path, "acme_ok", COMMANDS.format(body="app.command('greet')(lambda: typer.echo('good day'))"))
    install(tmp_path, "acme_import", "import no_such_package")
    chosen = suite(tmp_path, "greet", QRLSUITE_LOAD_PLUGINS="Acme-OK")
    assert (chosen.stdout, chosen.stderr) == ("good day\n", "")
    none = suite(tmp_path, "list", "plugins", QRLSUITE_LOAD_PLUGINS="")
    assert "acme" not in none.stdout + none.stderr
    assert "mlp" in none.stdout
    slip = suite(tmp_path, "list", QRLSUITE_LOAD_PLUGINS="acme-okay")
    assert (slip.returncode, slip.stdout) == (2, "")
    assert slip.stderr == (
        "qrlsuite: QRLSUITE_LOAD_PLUGINS: no installed distribution 'acme-okay' has plugins; "
        "did you mean 'acme-ok'?\n"
    )
