"""`qrlsuite tune` as a user meets it: killed, interrupted, continued, and its preset used."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qrlsuite.cli.app import build
from qrlsuite.errors import QrlSuiteError
from qrlsuite.results.store import EntryStore
from tests.commands import qrlsuite, start
from tests.conftest import HANGS, TINY, Hold
from tests.core.test_tuning import SETTINGS, finish, varied, without_hours

pytestmark = pytest.mark.usefixtures("forked_workers")


@pytest.fixture
def task(tmp_path: Path) -> str:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return str(path)


def stop(words: list[str], hold: Hold, sign: signal.Signals) -> tuple[int, str]:
    """Start a command and send it a signal once some seed has begun to learn."""
    process = start(*words, env=hold.environment)
    hold.wait(process)
    os.kill(process.pid, sign)
    _, message = process.communicate(timeout=HANGS)
    return process.wait(), message


def test_killed_and_interrupted_it_ends_with_the_same_preset(task: str, tmp_path: Path, hold: Hold) -> None:
    from qrlsuite.tuning import search

    wanted = search.Request(
        task,
        "mlp",
        settings=SETTINGS,
        varied=varied("lr=1e-2,1e-3"),
        seeds=search.tuning_seeds("1"),
        epochs=8,
    )
    straight = search.Search(wanted, tmp_path / "straight")
    finish(straight)
    straight.write(straight.path)

    words = ["tune", "mlp width=4 depth=1", "--task", task]
    words += ["--vary", "lr=1e-2,1e-3", "--seeds", "1", "--epochs", "8", "--workers", "1"]
    words += ["--runs", str(tmp_path / "stopped")]
    trials = tmp_path / "stopped" / "tuning"
    code, _ = stop(words, hold, signal.SIGKILL)
    assert code == -signal.SIGKILL
    code, message = stop(words, hold, signal.SIGINT)
    assert code == 130, message
    assert "The same command continues from there" in " ".join(message.split())
    assert not list(trials.glob("*.toml")), "no preset before all trials have ended"

    done = qrlsuite(*words, "--json")
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    (found,) = content["searches"]
    assert content["complete"]
    assert len(found["trials"]) == 2
    path = Path(found["preset"])
    assert path.name == straight.path.name
    assert without_hours(path.read_text()) == without_hours(straight.path.read_text())

    used = qrlsuite(
        "run", "mlp", f"preset={path}", "--task", task, "--seeds", "1", "--epochs", "1",
        "--runs", str(tmp_path / "runs"), "--json",
    )  # fmt: skip
    assert used.returncode == 0, used.stderr
    store = EntryStore(Path(json.loads(used.stdout)["folder"]))
    assert store.record()["tuning"]["seeds"] == "1000000:1000001"
    shown = json.loads(qrlsuite("show", str(store.path), "--json").stdout)
    for name in (store.path.name, f"{store.path.parent.name}/{shown['label']}"):
        assert (
            json.loads(qrlsuite("show", name, "--runs", str(store.path.parents[1]), "--json").stdout) == shown
        )
    assert shown["tuning"]["trials"] == 2


def test_two_models_with_equal_budgets(task: str, tmp_path: Path) -> None:
    words = ["tune", "mlp width=4 lr=1e-2", "mlp width=5 depth=1 lr=1e-2", "--task", task]
    words += ["--vary", "lr=1e-2,1e-3,1e-4", "--vary", "gamma=.9,.99"]
    words += ["--seeds", "1", "--epochs", "1", "--workers", "1", "--runs", str(tmp_path / "runs")]
    done = qrlsuite(*words)
    assert done.returncode == 0, done.stderr
    assert re.search(
        r"trials of ddqn mlp width=4 .* and ddqn mlp width=5 depth=1 .*: 2 \(2 runs", done.stdout
    )
    assert done.stdout.count("next: qrlsuite run") == 2
    content = json.loads(CliRunner().invoke(build(), [*words, "--json"]).stdout)
    assert [len(each["trials"]) for each in content["searches"]] == [2, 2]
    assert {"algorithm.gamma"} == set(content["searches"][0]["space"]), (
        "an option that is written is not varied"
    )


def test_it_says_the_size_first_and_wants_large_searches_confirmed(task: str, tmp_path: Path) -> None:
    words = ["tune", "mlp", "--task", task, "--vary", "paper", "--runs", str(tmp_path / "runs")]
    planned = CliRunner().invoke(build(), [*words, "--dry-run"])
    assert planned.exit_code == 0
    assert "2160 trials" in planned.stderr
    refused = CliRunner().invoke(build(), words)
    assert isinstance(refused.exception, QrlSuiteError)
    assert "--yes starts them all" in str(refused.exception)
    assert not (tmp_path / "runs").exists()


def test_a_budget_is_kept_and_the_rest_continues(task: str, tmp_path: Path) -> None:
    words = ["tune", "mlp width=4", "--task", task, "--vary", "lr=1e-2,1e-3"]
    words += ["--seeds", "1", "--epochs", "1", "--workers", "1", "--runs", str(tmp_path / "runs")]
    first = CliRunner().invoke(build(), [*words, "--budget", "0.01s"])
    assert "the budget is spent, 1 trials are left" in first.stdout, "after the first trial, no other fits"
    rest = CliRunner().invoke(build(), words)
    assert rest.exit_code == 0
    assert "the budget is spent" not in rest.stdout
    assert "wrote " in rest.stdout


def test_the_size_is_estimated_as_everywhere_whatever_else_is_damaged(task: str, tmp_path: Path) -> None:
    """By the one estimator: what was measured here, past an entry that cannot be read."""
    runs = tmp_path / "runs"
    trained = qrlsuite("run", "--task", task, "--model", "mlp", "--seeds", "1", "--runs", str(runs))
    assert trained.returncode == 0, trained.stderr
    (runs / "tiny" / "damaged").mkdir()
    (runs / "tiny" / "damaged" / "entry.json").write_text("{")
    words = ["tune", "mlp", "--task", task, "--vary", "lr=[1e-2, 1e-3]", "--dry-run"]
    done = qrlsuite(*words, "--seeds", "1", "--runs", str(runs))
    assert done.returncode == 0, done.stderr
    assert re.search(
        r" to .* core-hours, .* with .* process.*\(measured on its own epochs\)",
        " ".join(done.stderr.split()),
    )
