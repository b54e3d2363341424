"""Engine `command`: workers started by real shell lines, followed in the results folder."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from qrlsuite.engine import api
from qrlsuite.errors import OptionError
from qrlsuite.notation import write_setting
from qrlsuite.options import build as build_options
from qrlsuite.plugins.engines.command import CommandEngine, CommandOptions, shell_line
from qrlsuite.results import claims
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore
from tests.commands import qrlsuite, start
from tests.conftest import Hold, Train, results

QUEUE = "({command} >/dev/null 2>&1 &)"
"""Returns at once, as `qsub` does."""


def words(task: str, runs: Path, template: str, *more: str) -> list[str]:
    given = ["run", "--task", task, "--model", "mlp", "--set", "width=16", "--seeds", "2", "--epochs", "3"]
    return [*given, "--runs", str(runs), "--engine", f"command {write_setting('template', template)}", *more]


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ("qsub job.sh", r"no worker is started: write \{command\} where its command belongs"),
        ("ssh node{n} {command}", r"there is no \{n\}; known: command, group, i, quoted"),
        ("ssh node{} {command}", r"there is no \{\}"),
        ("awk '{print}' {comand}", r"there is no \{print\}.* double a brace that the shell must see"),
        ("ssh {command", r"expected '\}' before end of string; double a brace that the shell must see"),
    ],
)
def test_a_template_that_starts_no_worker(template: str, message: str) -> None:
    with pytest.raises(OptionError, match=rf"engine 'command': template = .*{message}"):
        build_options(CommandOptions, {"template": template}, "engine 'command'")


STAND_INS = {
    "ssh": 'shift 3; sh -c "$*"',
    "qsub": "sh -s",
    "bsub": 'shift 8; sh -c "$*"',
    "condor_submit": """
while IFS== read -r name value; do
    case $name in executable) program=$value ;; arguments) words=$value ;; queue) "$program" "$words" ;; esac
done""",
    "kubectl": 'while [ "$1" != -- ]; do shift; done; shift; "$@"',
}
"""What the programs of these names do with the command that they are given."""


def documented() -> dict[str, str]:
    """The templates of the page, by the program that they call."""
    text = (Path(__file__).parents[2] / "docs" / "scaling.md").read_text()
    templates = re.findall(r"^\| [\w]+ \| `(.*{(?:command|quoted)}.*)` \|$", text, re.MULTILINE)
    named = {re.search("|".join(STAND_INS), each): each.replace("\\|", "|") for each in templates}
    return {match.group(): template for match, template in named.items() if match is not None}


@pytest.mark.parametrize("program", STAND_INS)
def test_the_documented_templates_hand_the_command_on(program: str, tmp_path: Path) -> None:
    """Words with blanks, quotes and dollars arrive as they are."""
    script = tmp_path / "bin" / program
    script.parent.mkdir()
    script.write_text(f"#!/bin/sh\n{STAND_INS[program]}\n")
    script.chmod(0o755)
    (tmp_path / "pod.json").write_text("{}")
    words = ["a b", "it's $HOME", '"x"', "two\nlines"]
    template = documented()[program]
    build_options(CommandOptions, {"template": template}, "engine 'command'")
    recorder = [sys.executable, "-c", "import json, sys; json.dump(sys.argv[1:], open('got', 'w'))", *words]
    line = shell_line(template, recorder, 1, "0000-0009-abcdef")
    environment = {**os.environ, "PATH": f"{script.parent}:{os.environ['PATH']}"}
    subprocess.run(line, shell=True, check=True, cwd=tmp_path, env=environment)
    assert json.loads((tmp_path / "got").read_text()) == words


@pytest.mark.long
def test_a_killed_worker_is_started_again_and_ctrl_c_reaches_one_that_no_process_leads_to(
    train: Train, tiny_task: str, tmp_path: Path, hold: Hold
) -> None:
    """In a folder whose name has a blank; what is left is trained by another engine."""
    queue = f'echo "{{i}} {{group}}" >> "{tmp_path}/started"; {QUEUE}'
    command = words(tiny_task, tmp_path / "my runs", queue, "--workers", "1")
    first = start(*command, env=hold.environment)
    hold.wait(first)
    (entry,) = (tmp_path / "my runs" / "tiny").iterdir()
    (claim,) = claims.living(EntryStore(entry))
    os.kill(claim.pid, signal.SIGKILL)
    hold.wait(first)
    first.send_signal(signal.SIGINT)
    assert first.wait() == 130
    assert claims.claims(EntryStore(entry)) == [], "the worker has saved and ended before the command does"
    assert list(EntryStore(entry).claims.glob("*.stop")) == []
    first_start, second_start = (tmp_path / "started").read_text().splitlines()
    assert first_start == second_start
    assert first_start.startswith("1 0000-0001-")
    (saved,) = {path.parent.name for path in entry.glob("groups/*/checkpoint.safetensors")}
    assert saved.startswith("0000-0000-"), (
        "killed before an epoch ended, a group begins again at half its size"
    )
    hold.release()
    assert qrlsuite(*command[: command.index("--engine")]).returncode == 0
    straight = train("straight", [0, 1])
    assert [results(entry, seed) for seed in (0, 1)] == [results(straight, seed) for seed in (0, 1)]


def run(store: EntryStore, template: str, seeds: tuple[int, ...] = (5,)) -> api.EngineOutcome:
    work = api.Work(store, [SeedGroup(seeds, 0)], 2, 1)
    return CommandEngine(CommandOptions(template)).run([work], lambda snapshot: None)


def test_a_command_that_fails_is_named_by_what_it_says(kept: Train) -> None:
    outcome = run(EntryStore(kept("runs", [0], 1)), "echo 'no such queue: fast' >&2; exit 7 # {command}")
    (message,) = outcome.failed.values()
    assert (
        message.splitlines()[0] == "its worker died 3 times (exit code 7 of its command): no such queue: fast"
    )


def test_seeds_of_another_worker_are_left_to_it(kept: Train) -> None:
    store = EntryStore(kept("runs", [0], 1))
    claim = claims.acquire(store, [5])
    (message,) = run(store, "{command}").taken.values()
    claim.release()
    assert f"being trained by process {os.getpid()}" in message


def test_a_command_that_never_begins_a_worker_ends_with_ctrl_c(
    kept: Train, caplog: pytest.LogCaptureFixture
) -> None:
    """One waits for a machine that does not answer, one has handed the worker to a queue."""
    store = EntryStore(kept("runs", [0], 1))

    def show(snapshot: object) -> None:
        raise KeyboardInterrupt

    work = api.Work(store, [SeedGroup((5,), 0), SeedGroup((6,), 0)], 2, 2)
    template = "test {i} = 2 || sleep 1000 # {command}"
    with pytest.raises(KeyboardInterrupt):
        CommandEngine(CommandOptions(template)).run([work], show)
    assert "1 worker may still wait in a queue" in caplog.text
