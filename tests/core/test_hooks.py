"""Each hook by the example in its manual; and a stranger's distribution, as pip leaves it, on the command line."""

from __future__ import annotations

import re
import subprocess
import sys
import types
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from qrlsuite import hookspecs, registry, specs
from qrlsuite.cli.extensions import add_commands
from qrlsuite.columns import Column
from qrlsuite.testing.tracker import RECORD, RUN
from qrlsuite.training import trackers
from tests.commands import qrlsuite
from tests.conftest import install, installed

MANUAL = (Path(__file__).parents[2] / "docs" / "api" / "hooks.md").read_text()
EXAMPLES = dict(re.findall(r"^## `(\w+)`\n.*?```python\n(.*?)```", MANUAL, re.MULTILINE | re.DOTALL))


def load(name: str, code: str) -> registry.Registry:
    """Load a plugin's code and nothing else."""
    module = types.ModuleType(name)
    module.__file__ = f"{name}.py"
    exec(compile(code, f"{name}.py", "exec"), module.__dict__)
    sys.modules[name] = module
    point = metadata.EntryPoint("example", name, "qrlsuite")
    return registry.create(strict=True, points=lambda: [("example-dist", point)])


def test_every_kind_has_a_hook_and_every_hook_a_manual() -> None:
    assert EXAMPLES.keys() == hookspecs.HOOKS.keys()
    kinds = {f"register_{kind}" for kind in specs.KINDS}
    assert kinds | {"register_commands", "register_columns"} == hookspecs.HOOKS.keys()


@pytest.mark.parametrize(("hook", "kind"), hookspecs.REGISTER.items())
def test_the_example_in_the_manual_works(hook: str, kind: type[specs.Spec]) -> None:
    found = load(f"example_{hook}", EXAMPLES[hook])
    [(name, registered)] = found.of(kind).items()
    assert found.plugins[0].registered == {kind.kinds: [name]}
    line = EXAMPLES[hook].splitlines()[int(registered.place.rpartition(":")[2]) - 1]
    assert "register(" in line, "where it was registered"


def test_the_example_of_a_column_works() -> None:
    handed: list[Column[Any]] = []
    load("example_columns", EXAMPLES["register_columns"]).manager.hook.register_columns(
        register=handed.append
    )
    assert handed[0].written(SimpleNamespace(curves=np.array([[0.2, 0.9], [0.8, 0.5]]))) == "0.500"


def test_the_example_of_a_command_works() -> None:
    app = typer.Typer()
    app.callback()(lambda: None)
    add_commands(app, load("example_commands", EXAMPLES["register_commands"]))
    assert "Hello, you." in CliRunner().invoke(app, ["hello"]).output


ALWAYS = """
from qrlsuite import hookimpl, specs

@hookimpl
def register_trackers(register):
    register(specs.TrackerSpec("notes", "Notes every run", f"{__name__}:Notes", always=True))

class Notes:
    heard = []
    def __init__(self, target):
        self.target = target
    def epoch_finished(self, run, record):
        self.heard.append((self.target, run["seed"], record["epoch"]))
"""


def test_a_tracker_that_always_watches_is_asked_by_no_one_and_may_be_given_a_target() -> None:
    known = load("always", ALWAYS)
    for requests in ([], ["notes=here"]):
        sink = trackers.EventSink(known, requests)
        assert sink.heard("epoch_finished")
        assert not sink.heard("run_started")
        sink.send("run_started", run=RUN)
        sink.send("epoch_finished", run=RUN, record=RECORD)
        assert not sink.problems
    assert sys.modules["always"].Notes.heard == [(None, 7, 1), ("here", 7, 1)]


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
