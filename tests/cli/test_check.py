"""`qrlsuite check` as a plugin author meets it: names, distributions, exit codes; what hostile plugins can print."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from qrlsuite import registry, testing
from qrlsuite.cli import main
from qrlsuite.experiment.task import load
from tests.conftest import cases
from tests.core.test_hooks import COMMANDS, install, suite

ENGINES = """
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass
from qrlsuite import hookimpl
from qrlsuite.specs import EngineSpec, TaskSpec

@dataclass(frozen=True)
class Options:
    slots: Annotated[int, Field(ge=1, description="groups at a time")] = 2

class Engine:
    def __init__(self, options):
        raise AssertionError("a check builds no engine")

@hookimpl
def register_engines(register):
    for name in {names}:
        register(EngineSpec(name, "Where nothing runs", f"{{__name__}}:Engine", f"{{__name__}}:Options"))
"""
TWICE = """
@hookimpl
def register_tasks(register):
    register(TaskSpec("twice", "A task beside an engine", "missing.toml"))
"""

Command = Callable[..., tuple[int, str, str]]


def engines(*names: str) -> str:
    return ENGINES.format(names=names)


DISTRIBUTIONS = {
    "tidy": engines("tidy", "tidy-too"),  # its own name among what it registers
    "local": engines("elsewhere"),  # the name of an engine of the suite
    "twice": engines("twice") + TWICE,
    "some_more": engines("more"),
    "first": engines("shared"),
    "second": engines("shared"),
    "silent": "from qrlsuite import hookimpl\n\ndef register_engines(register):\n    pass\n",
    "failing": "raise RuntimeError('no license')",
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Distributions as pip leaves them, found by this process too."""
    folder = tmp_path_factory.mktemp("site")
    for name, code in DISTRIBUTIONS.items():
        install(folder, name, code)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv(registry.LOAD_PLUGINS, ",".join(DISTRIBUTIONS))
        registry.load.cache_clear()
        yield folder
    registry.load.cache_clear()
    for name in DISTRIBUTIONS:
        sys.modules.pop(name, None)
    importlib.invalidate_caches()


@pytest.fixture
def check(site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Type `qrlsuite check ...`; returns exit code, stdout and stderr without the warnings at start."""

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["qrlsuite", "check", *words])
        with pytest.raises(SystemExit) as stopped:
            main()
        printed = capsys.readouterr()
        lines = [line for line in printed.err.splitlines() if not line.startswith("qrlsuite: warning")]
        return int(stopped.value.code or 0), printed.out, "\n".join(lines)

    return run


def test_a_rule_is_printed_before_the_next_is_tried(check: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """A check that hangs has said how far it came; one that ends with the process, too."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("qrlsuite.testing.common._options", stop)
    out = check("tidy-too")[1]
    assert "  ✓ options documented: every option has a description" in out
    assert "options: defaults" not in out


def test_by_name_every_rule_is_shown_and_a_broken_one_is_exit_code_1(check: Command) -> None:
    code, out, err = check("tidy-too")
    lines = out.splitlines()
    assert (code, err) == (0, "")
    assert lines[0] == "engine 'tidy-too' (only loading and registering are checked)"
    assert "  ✓ options: defaults are valid, frozen, and survive being stored" in lines
    assert lines[-1] == f"all {len(lines) - 2} rules hold"
    assert check("engine:tidy-too") == check("engines:tidy-too") == (code, out, err)
    assert check("tidy-too", "slots=3")[0] == 0
    code, out, _ = check("tidy-too", "slots=0")
    assert code == 1
    assert "  ✗ options: " in out
    assert out.splitlines()[-1].startswith("1 of 6 rules broken; some are tried only after")
    code, out, _ = check("tidy-too", "slot=3")
    assert code == 1
    assert "did you mean 'slots'" in out
    code, out, err = check("tidy-too", "slots=0", "--json")
    rows = json.loads(out)
    assert (code, err) == (1, "")
    assert {(row["kind"], row["name"]) for row in rows} == {("engine", "tidy-too")}
    assert [row["rule"] for row in rows if not row["ok"]] == ["options"]
    assert all(row["message"] for row in rows)


def test_a_task_of_one_s_own_is_checked(check: Command, tiny_task: str) -> None:
    code, out, err = check(tiny_task)
    assert (code, err) == (1, "")
    assert "target_steps=2000 never copies the target network in 45 gradient steps" in out
    text = Path(tiny_task).read_text().replace("[environment]", 'default_preset = "short"\n[environment]', 1)
    Path(tiny_task).write_text(f"{text}\n[presets.short.ddqn.all]\ntarget_steps = 9\n")
    code, out, err = check(tiny_task)
    assert (code, err) == (0, "")
    assert "  ✓ scores: " in out


def test_an_environment_is_checked_as_a_task_has_it(
    check: Command, tiny_task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[object, ...]] = []
    monkeypatch.setattr(testing, "check", lambda *words, **more: [asked.append((*words, more))][1:])
    given = load(tiny_task).file.environment.options
    assert check("environment:beam6g", "--task", tiny_task, "degree=5")[0] == 0
    assert asked == [("environment", "beam6g", {**given, "degree": 5}, {})]
    assert (
        "its environment is 'beam6g', not 'cartpole'" in check("environment:cartpole", "--task", tiny_task)[2]
    )
    asked.clear()
    for word in ("algorithm:ddqn", "mlp"):
        assert check(word, "--task", tiny_task)[0] == 0
    assert asked == [(*words, {}, {"task": tiny_task}) for words in (("algorithm", "ddqn"), ("model", "mlp"))]
    assert "--task is for one environment, algorithm or model" in check("cz", "--task", tiny_task)[2]


def test_a_distribution_stands_for_all_that_it_registers(check: Command) -> None:
    code, out, _ = check("tidy", "--json")
    assert code == 0
    assert {row["name"] for row in json.loads(out)} == {"tidy", "tidy-too"}
    assert {row["name"] for row in json.loads(check("engine:tidy", "--json")[1])} == {"tidy"}
    assert {row["name"] for row in json.loads(check("some-more", "--json")[1])} == {"more"}, (
        "as pip spells it"
    )
    code, _, err = check("tidy", "slots=3")
    assert code == 2
    assert "options need a single name" in err


def test_a_name_that_two_distributions_registered_is_a_broken_rule_of_both(check: Command) -> None:
    for distribution in ("first", "second"):
        code, out, _ = check(distribution)
        assert code == 1
        assert "engine 'shared' is registered by both first (" in out
    assert check("shared")[0] == 2


WRONG = """
tidi => nothing called 'tidi' is registered; did you mean 'tidy'?
mine.py => nothing called 'mine.py' is registered: --plugin mine.py loads it
engine:tidi => unknown engine 'tidi'; did you mean 'tidy'?
engin:tidy => unknown kind 'engin'; did you mean 'engine'?
distribution:tidi => no plugin is of a distribution 'tidi'; did you mean 'tidy'?
cartpole => write qrlsuite check environment:cartpole or qrlsuite check task:cartpole or qrlsuite check study:cartpole
local => 'local' is several things; write qrlsuite check engine:local or qrlsuite check distribution:local
failing => 'failing' cannot be imported: RuntimeError: no license
silent => is every hook under @hookimpl
"""


@pytest.mark.parametrize(("word", "message"), cases(WRONG))
def test_wrong_names_are_one_clear_line(word: str, message: str, check: Command) -> None:
    code, out, err = check(word)
    assert (code, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1


def test_what_the_messages_tell_to_type_works(check: Command) -> None:
    assert {row["name"] for row in json.loads(check("distribution:local", "--json")[1])} == {"elsewhere"}
    assert check("twice", "--json")[0] == 1, "both things are the distribution's, and its task has no file"
    assert check("engine:twice")[0] == 0
    assert check("task:twice")[0] == 1


def test_without_a_name_it_says_what_can_be_checked(check: Command) -> None:
    code, out, _ = check()
    assert code == 0
    assert "Other installed plugins: failing, first, local" in out
    assert json.loads(check("--json")[1])["distributions"] == sorted(DISTRIBUTIONS)


DIRT = r"\x1b[2J[bold]red[/bold]:warning:\r\u202e\x85\udc9b"
CLEAN = r"\x1b[2J[bold]red[/bold]:warning: \u202e \udc9b"

HOSTILE = f'''
import typer
from qrlsuite import hookimpl
from qrlsuite.specs import AnsatzSpec, TrackerSpec

@hookimpl
def register_ansatzes(register):
    register(AnsatzSpec("evil", "{DIRT}", "qrlsuite.plugins.circuits.ansatz:NoOptions", "evil:ansatz"))

@hookimpl
def register_trackers(register):
    register(TrackerSpec("evil-eye", "Watches", "evil:ansatz"))

@hookimpl
def register_commands(app):
    app.command("ev\\x1bil")(lambda: None)

def ansatz(*given):
    raise RuntimeError("first\\n{DIRT}")
'''
UNSPEAKABLE = f'''
class Error(Exception):
    def __str__(self):
        raise ValueError

raise type("{DIRT}", (Error,), {{}})
'''
SHOUTING = f'raise RuntimeError("""first\nqrlsuite: {DIRT}""")'


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    install(folder, "evil", HOSTILE)
    install(folder, "shouting", SHOUTING)
    install(folder, "unspeakable", UNSPEAKABLE)
    info = folder / "evil-1.0.dist-info"
    (info / "METADATA").write_text("Name: e\x1b[31mvil\nVersion: 1\x1b[0m\nRequires-Dist: qrlsuite>=0.1\n")
    return folder


def assert_harmless(done: subprocess.CompletedProcess[str]) -> None:
    for stream in (done.stdout, done.stderr):
        bad = {character for character in stream if not character.isprintable()} - {"\n"}
        assert not bad, (bad, stream)


def test_names_and_messages_of_a_hostile_plugin_control_no_terminal(hostile: Path) -> None:
    listed = suite(hostile, "list", "ansatzes")
    assert_harmless(listed)
    assert CLEAN in listed.stdout
    assert r"[e\x1b[31mvil]" in listed.stdout
    warned = listed.stderr.splitlines()
    assert len(warned) == 3, "a line of one's own for each"
    assert all(line.startswith("qrlsuite: warning: plugin '") for line in warned), warned
    assert f"RuntimeError: first qrlsuite: {CLEAN}; skipped" in listed.stderr
    assert r"nobody can type the command name 'ev\x1bil'" in listed.stderr
    for words in (["list", "plugins"], ["show", "ansatz", "evil"], ["--strict", "list"], ["check"]):
        done = suite(hostile, *words)
        assert_harmless(done)
        assert "\\x1b" in done.stdout + done.stderr, words
        assert "Traceback" not in done.stderr
    done = suite(hostile, "check", "evil")
    assert done.returncode == 1
    assert "✗ builds: " in done.stdout
    assert f"RuntimeError: first {CLEAN}" in done.stdout
    terminal = suite(hostile, "check", "evil", FORCE_COLOR="1", TERM="xterm-256color")
    assert "\x1b[1m" in terminal.stdout, "it believes to write to a terminal"
    assert "\x1b[2J" not in terminal.stdout
    assert f"RuntimeError: first {CLEAN}" in terminal.stdout


def test_a_hostile_tracker_controls_no_terminal_during_a_run(
    hostile: Path, tiny_task: str, tmp_path: Path
) -> None:
    words = [
        "run",
        "mlp",
        "--task",
        tiny_task,
        "--seeds",
        "1",
        "--epochs",
        "1",
        "--runs",
        str(tmp_path / "runs"),
    ]
    done = suite(hostile, *words, "--track", "evil-eye")
    assert done.returncode == 0, done.stderr
    assert_harmless(done)
    assert f"'evil-eye' failed in its factory and is left out: RuntimeError: first {CLEAN}" in done.stderr


UNBUILDABLE = "call = lambda x: None; call.__annotations__ = {'x': 'nosuch'}; app.command('call')(call)"
SUB = "sub = typer.Typer(); sub.command('list')(lambda: None); app.add_typer(sub)"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (UNBUILDABLE, "hook 'register_commands': NameError: name 'nosuch'"),
        (SUB, "there is a command 'list' already"),
        ("[app.command('twin')(lambda: None) for _ in range(2)]", "there is a command 'twin' already"),
        ("app.callback()(lambda: None)", "may only add commands"),
        ("app.registered_commands.clear()", "may only add commands"),
        ("app.command('two words')(lambda: None)", "nobody can type the command name 'two words'"),
        ("app.command('--list')(lambda: None)", "nobody can type the command name '--list'"),
    ],
)
def test_commands_that_would_break_others_are_left_out(tmp_path: Path, body: str, message: str) -> None:
    install(tmp_path, "pushy", COMMANDS.format(body=body))
    done = suite(tmp_path, "--version")
    assert done.stdout.startswith("qrlsuite "), done.stderr
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
