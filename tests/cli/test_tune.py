"""`qrlsuite tune` as a user meets it: killed, interrupted, continued, and its preset used."""

from __future__ import annotations

import os
import re
import shlex
import signal
import tomllib
from pathlib import Path

import pytest

from tests.commands import qrlsuite, say, start
from tests.conftest import HANGS, Hold

pytestmark = pytest.mark.usefixtures("forked_workers")


def stop(words: list[str], hold: Hold, sign: signal.Signals) -> tuple[int, str]:
    """Start a command and send it a signal once some seed has begun to learn."""
    process = start(*words, env=hold.environment)
    hold.wait(process)
    os.kill(process.pid, sign)
    _, message = process.communicate(timeout=HANGS)
    return process.wait(), message


def test_a_search_that_is_stopped_leaves_the_best_settings_so_far(
    tiny_task: str, tmp_path: Path, hold: Hold
) -> None:
    words = ["tune", "mlp", "--task", tiny_task, "--vary", "width=3,4,5", "--seeds", "1", "--epochs", "8"]
    words += ["--workers", "1", "--runs", str(tmp_path / "runs"), "--budget"]
    say(*words, "0.01s")  # one trial
    words += ["1h"]  # without a pace, one trial at a time
    (path,) = (tmp_path / "runs" / "tuning").glob("*.toml")
    path.unlink()
    code, message = stop(words, hold, signal.SIGTERM)
    assert code == 130, message
    assert f"the best settings so far: {path}" in message.replace("\n", "")
    record = tomllib.loads(path.read_text())["tuning"]
    assert (record["trials"], record["planned"]) == (1, 3)

    better = path.read_text().replace("runs = 1\n", "runs = 2\n")
    path.write_text(better)
    stop(words, hold, signal.SIGINT)
    assert path.read_text() == better, "a file with more runs behind it stays"
    path.write_text(better.replace("runs = 2\n", "runs = 1\n").replace("trials = 1\n", "trials = 2\n"))
    stop(words, hold, signal.SIGINT)
    assert tomllib.loads(path.read_text())["tuning"]["trials"] == 1


def test_a_budget_is_kept_and_the_rest_continues(tiny_task: str, tmp_path: Path) -> None:
    words = ["tune", "mlp width=4", "--task", tiny_task, "--vary", "lr=1e-2,1e-3,1e-4"]
    words += ["--seeds", "1", "--epochs", "1", "--workers", "1", "--runs", str(tmp_path / "runs")]
    first = say(*words, "--budget", "0.01s").stdout
    assert "the budget is spent, 2 trials left" in first, "after the first trial, no other fits"
    again = say(*words, "--budget", "0.01s").stdout
    assert "the budget is spent, 1 trial left" in again, (
        "the finished trial costs nothing, and one more is trained"
    )
    rest = say(*words, "--budget", "1h").stdout
    assert "the budget is spent" not in rest
    assert "wrote " in rest
    repeated = say(*words, "--budget", "0.01s").stdout
    assert "the budget is spent" not in repeated, "no finished trial is left out of the preset"
    whole = say(*words[:-1], str(tmp_path / "whole"), "--budget", "10min").stdout
    assert "the budget is spent" not in whole, "three trials take seconds"


def test_what_trials_keep_is_said_and_can_be_freed(
    tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("qrlsuite.cli.commands.tune.MUCH", 1)
    words = ["tune", "mlp width=4", "--task", tiny_task, "--vary", "lr=1e-2,1e-3"]
    words += ["--seeds", "1", "--epochs", "1", "--workers", "1", "--runs", str(tmp_path / "runs")]
    line = say(*words).stdout.splitlines()[-1]
    assert re.match(r"trials keep [\d.]+ kB so that they can be extended by more epochs; to free it: ", line)
    freed = say(*shlex.split(line.partition("to free it: ")[2])[1:]).stdout
    assert freed.count("  (seeds 1000000:1000001)") == 2
    assert "freed" in freed
    again = say(*words).stdout
    assert "wrote " in again, "the trials' curves are still there"
    assert "trials keep" not in again


def test_the_size_is_estimated_as_everywhere_whatever_else_is_damaged(tiny_task: str, tmp_path: Path) -> None:
    """By the one estimator: what was measured here, past an entry that cannot be read."""
    runs = tmp_path / "runs"
    trained = qrlsuite("run", "--task", tiny_task, "--model", "mlp", "--seeds", "1", "--runs", str(runs))
    assert trained.returncode == 0, trained.stderr
    (runs / "tiny" / "damaged").mkdir()
    (runs / "tiny" / "damaged" / "entry.json").write_text("{")
    words = ["tune", "mlp", "--task", tiny_task, "--vary", "lr=[1e-2, 1e-3]", "--dry-run"]
    done = qrlsuite(*words, "--seeds", "1", "--runs", str(runs))
    assert done.returncode == 0, done.stderr
    assert re.search(
        r" to .* core-hours, .* with .* process.*\(measured on its own epochs\)",
        " ".join(done.stderr.split()),
    )
