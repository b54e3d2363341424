"""The progress display: what it says from what the groups report."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qrlsuite.cli.app import build
from qrlsuite.cli.commands.leaderboard import COLUMNS
from qrlsuite.cli.commands.run import summarize
from qrlsuite.cli.display import CostEstimate, RunDisplay
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import Group
from qrlsuite.results.store import EntryStore

PAIR = [Group((0, 1, 2), 0), Group((3, 4), 0)]


@pytest.fixture
def entry(tiny_task: str) -> Entry:
    return resolve(tiny_task, "mlp", settings=[parse_setting("width=16")])


@pytest.mark.parametrize(("columns", "left_out"), [(80, 5), (105, 2), (150, 0)])
def test_a_narrow_terminal_shows_fewer_columns_and_says_which(columns: int, left_out: int) -> None:
    words = ["leaderboard", "--task", "beam6g", "--published"]
    done = CliRunner().invoke(build(), words, env={"FORCE_COLOR": "1", "COLUMNS": str(columns)})
    lines = [re.sub("\x1b\\[[0-9;]*m", "", line).rstrip() for line in done.output.splitlines()]
    assert max(map(len, lines)) <= columns
    assert any("60k (56k to 66k)" in line for line in lines), "no number is broken over lines"
    told = " ".join(lines).partition("or --format markdown, shows ")[2]
    assert len([name for name in COLUMNS if name in told]) == left_out


def test_the_last_median_shown_is_the_summary_s(train, entry, tmp_path, capsys, monkeypatch) -> None:
    path: Path = train("runs", [0, 1, 2])
    train("runs", [3, 4])
    store = EntryStore(path)
    snapshot = {group.id: ProgressFile(store, group.id).read() for group in PAIR}
    monkeypatch.setattr("qrlsuite.cli.display.PLAIN_SECONDS", 0.0)
    RunDisplay(entry, store, range(5), 3, PAIR, 2, quiet=False).update(snapshot)
    shown = re.search(r"median score (\S+)", capsys.readouterr().err)
    expected = summarize(entry, store, list(range(5)), 3)["median_score"]
    assert shown is not None
    assert shown[1] == f"{expected:.3f}"
    assert len({state["median_score"] for state in snapshot.values()}) == 2, "the groups must differ"


def test_an_estimate_outlives_the_first_epoch_s_validation() -> None:
    estimate = CostEstimate(PAIR[:1], epochs=10, workers=1)
    name = PAIR[0].id
    training = {"phase": "training", "epoch": 0, "total": 100}
    assert estimate.remaining({name: {**training, "done": 10}}, now=0.0) is None
    # 20 rounds in 10 seconds: 50 seconds for an epoch's training, and a quarter more for its validation.
    assert estimate.remaining({name: {**training, "done": 30}}, now=10.0) == pytest.approx(62.5 * 9.76)
    validating = {"phase": "validation", "epoch": 0, "done": 1, "total": 20}
    assert estimate.remaining({name: validating}, now=60.0) == pytest.approx(62.5 * 10)


@pytest.mark.parametrize("submits", [False, True])
def test_what_is_submitted_cannot_be_stopped_by_ctrl_c(entry, tmp_path, capsys, submits) -> None:
    display = RunDisplay(entry, EntryStore(tmp_path), range(7), 3, PAIR, 2, quiet=False)
    display.begin({5, 6}, submits)
    display.close()
    shown = " ".join(capsys.readouterr().err.split())
    assert ("Ctrl-C saves" in shown) is not submits
    assert ("5 seeds to epoch 3, 2 tasks" in shown) is submits
    assert ("2 of the seeds wait in the queue" in shown) is submits
