"""Several tasks at once: which entries are one configuration, what is printed of them, and rliable's arrays."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.boards import across
from qrlsuite.leaderboard.shelf.curves import EntryResults
from tests.commands import say
from tests.conftest import POLE, TINY, trainer
from tests.leaderboard import boards

TASKS = ("beam6g", "cartpole")


def runs_of(label: str, task: str, epochs_below: list[int], **identity: object) -> EntryResults:
    """Runs that score 0, and 1 from an epoch on."""
    entry = boards.entry(label, len(epochs_below), task=task)
    curves = np.ones(entry.curves.shape)
    for run, epoch in enumerate(epochs_below):
        curves[run, :epoch] = 0
    return boards.changed(entry, curves=curves, identity={**entry.identity, **identity})


def both(label: str, share: float, seeds: int = 20) -> list[EntryResults]:
    """Below threshold for a share of the horizon of both tasks; every second run a twentieth longer."""
    return [
        runs_of(label, "beam6g", [round(100 * share) + 5 * (i % 2) for i in range(seeds)]),
        runs_of(label, "cartpole", [round(100 * share) + 5 * (i % 2) for i in range(seeds)]),
    ]


def test_shares_means_and_decided_pairs_by_hand() -> None:
    board = across.section([*both("slow", 0.6, 30), *both("quick", 0.2)], TASKS)
    assert board.shares.horizons == (200_000, 100_000)
    assert [board.results.names[i] for i in board.order] == ["quick", "slow"]
    assert board.results.mean[list(board.order)] == pytest.approx([0.225, 0.625])
    assert board.results.interquartile_mean[list(board.order)] == pytest.approx([0.225, 0.625])
    cells = board.sheet().cells
    assert [row[4:] for row in cells] == [("1.00", "slow", "-"), ("-", "-", "quick")]
    assert cells[0][2].startswith("0.225 (0.2")
    told = json.loads(json.dumps(board.as_dict(), allow_nan=False))
    assert [row["label"] for row in told["entries"]] == ["quick", "slow"]
    assert told["better"] == [[0, 1], [-1, 0]]
    assert told["improvement"] == [[0.5, 1.0], [0.0, 0.5]]
    (first, _) = board.flat()
    assert (first["needs_less_than"], first["needs_more_than"]) == (["slow"], [])
    assert [line.count(" & ") for line in board.sheet().latex().splitlines() if line.endswith(r"\\")] == [
        6
    ] * 3
    arrays = board.shares.rliable()  # shares at or above threshold
    assert {name: values.shape for name, values in arrays.items()} == {"slow": (30, 2), "quick": (20, 2)}
    assert arrays["quick"][:2] == pytest.approx(np.array([[0.8, 0.8], [0.75, 0.75]]))


def test_a_configuration_is_algorithm_model_and_options() -> None:
    one, other = both("same", 0.2)
    assert across.configuration(one) == across.configuration(other)
    options = {"algorithm_options": {"gamma": 0.9}}
    assert across.configuration(runs_of("same", "beam6g", [1], **options)) != across.configuration(one)
    mixed = [one, runs_of("same", "cartpole", [1] * 20, **options)]
    board = across.section([*both("quick", 0.2), *mixed], TASKS)
    assert board.results.names == ("quick",)
    assert {line.partition(":")[2] for line in board.shares.refused} == {
        " no result with these options on cartpole",
        " no result with these options on beam6g",
    }
    with pytest.raises(OptionError, match="no entry has 20 seeds or more with the same algorithm, model and"):
        across.section(mixed, TASKS)


def test_what_is_left_out_says_why() -> None:
    short = boards.changed(runs_of("short", "cartpole", [1] * 20), curves=np.ones((20, 50)))
    entries = [*both("quick", 0.2), *both("few", 0.2, 19), runs_of("short", "beam6g", [1] * 20), short]
    board = across.section(entries, TASKS)
    assert "cartpole: short: ends at 50000 of 100000 steps" in board.shares.refused
    assert "few: 19 seeds on beam6g, fewer than 20: undecided" in board.shares.refused
    cut = across.section(entries, TASKS, horizon=50_000)
    assert set(cut.results.names) == {"quick", "short"}
    assert cut.shares.horizons == (50_000, 50_000)
    with pytest.raises(OptionError, match=r"alpha = 1.5 is outside \(0, 1\)"):
        across.section(entries, TASKS, alpha=1.5)


def test_rliable_says_the_same() -> None:
    metrics = pytest.importorskip("rliable.metrics", reason="needs rliable: pip install rliable")
    generator = np.random.default_rng(0)
    entries = []
    for label, shift in (("one", 10), ("two", 20)):
        entries.append(runs_of(label, "beam6g", (shift + generator.integers(0, 40, 25)).tolist()))
        entries.append(runs_of(label, "cartpole", (5 * shift + generator.integers(0, 200, 25)).tolist()))
    board = across.section(entries, TASKS)
    arrays = board.shares.rliable()
    for index, name in enumerate(board.results.names):
        assert 1 - metrics.aggregate_mean(arrays[name]) == pytest.approx(board.results.mean[index])
        iqm = metrics.aggregate_iqm(arrays[name])
        assert 1 - iqm == pytest.approx(board.results.interquartile_mean[index])
    one, two = (board.results.names.index(name) for name in ("one", "two"))
    improvement = metrics.probability_of_improvement(arrays["one"], arrays["two"])
    assert improvement == pytest.approx(board.results.improvement[one, two])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seeds of two epochs of two models on two tasks, and of a third model on one."""
    folder = tmp_path_factory.mktemp("several")
    for name, text in (("tiny", TINY), ("pole", POLE)):
        (folder / f"{name}.toml").write_text(text.replace("[180]", "[120]"))
    for name, width in (("tiny", 4), ("pole", 4), ("tiny", 8), ("pole", 8), ("tiny", 6)):
        trainer(str(folder / f"{name}.toml"), folder)("runs", range(20), 2, settings=[f"width={width}"])
    return folder / "runs"


def qrlsuite(runs: Path, *given: str) -> Result:
    return say(*given, "--runs", str(runs))


BOTH = ("leaderboard", "--task", "tiny", "--task", "pole")


def test_the_commands_on_stored_runs(trained: Path, tmp_path: Path) -> None:
    board = qrlsuite(trained, *BOTH, "--format", "json")
    (told,), refused = (json.loads(board.stdout)[name] for name in ("sections", "refused"))
    assert [each["task"] for each in told["tasks"]] == ["tiny", "pole"]
    assert {row["label"] for row in told["entries"]} == {"ddqn mlp width=4", "ddqn mlp width=8"}
    assert refused == ["ddqn mlp width=6: no result with these options on pole"]
    for format_, mark in (("table", "IQM (95%)"), ("markdown", "| entry | seeds |"), ("latex", r"\toprule")):
        result = qrlsuite(trained, *BOTH, "--format", format_)
        assert mark in result.stdout
        assert "left out: ddqn mlp width=6" in result.stderr
    written = qrlsuite(trained, *BOTH, "--format", "csv").stdout
    rows = list(csv.DictReader(io.StringIO(written)))
    assert [float(row["mean"]) for row in rows] == [row["mean"] for row in told["entries"]]

    page = tmp_path / "page.html"
    result = qrlsuite(trained, *BOTH, "--format", "html", "--out", str(page))
    assert result.exit_code == 0, result.output
    text = page.read_text()
    assert re.findall(r'<section class="board" id="([^"]*)"', text) == ["board-0", "board-1"]
    table = text.partition('<section id="beside-1"')[2].partition("</section>")[0]
    assert table.count('<th scope="row">ddqn mlp width=') == 2
    assert "No result with these options" not in table
    assert "ddqn mlp width=6: no result with these options on pole" in text

    file = tmp_path / "scores.npz"
    result = qrlsuite(trained, "export", "--out", str(file), "--task", "tiny", "--task", "pole")
    assert result.exit_code == 0, result.output
    with np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
    assert {values.shape for values in arrays.values()} == {(20, 2)}
    for row in told["entries"]:
        assert 1 - arrays[row["label"]].mean() == pytest.approx(row["mean"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["leaderboard", "--task", "tiny", "--task", "tiny"], "--task: tiny is named twice"),
        (["leaderboard", "--task", "tiny", "--task", "pola"], "unknown task 'pola'; did you mean 'pole'"),
        (["leaderboard", "--task", "tiny", "--task", "cartpole"], "no results of task cartpole"),
        ([*BOTH, "--rule", "times"], "judges cells of one task"),
        ([*BOTH, "--by", "area"], "--by area: scores of several tasks have no common scale"),
        ([*BOTH, "--alpha", "0"], "alpha = 0.0 is outside (0, 1)"),
        ([*BOTH, "--horizon", "60", "--entry", "mlp width=9"], "width=9"),
        (["export", "--out", "a.npz"], "--out a.npz: name two tasks or more"),
    ],
)
def test_wrong_input_says_what_to_type(given: list[str], message: str, trained: Path) -> None:
    assert message in boards.refused(*given, "--runs", trained)
