"""Numbers in README and docs/leaderboard.md are those that the published entries give."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qrlsuite import api
from qrlsuite.cli.app import build
from qrlsuite.leaderboard.published import PUBLISHED, read
from qrlsuite.statistics import LearningCurves, Verdict, compare
from tests.statistics.conftest import SURFACE

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BOARD = README.partition("\n## The paper's board\n")[2].partition("\n## ")[0]
PAGE = (ROOT / "docs" / "leaderboard.md").read_text()


def printed(*options: str) -> str:
    """Return what `qrlsuite leaderboard --published --task beam6g` prints."""
    words = ["leaderboard", "--published", "--task", "beam6g", "--runs", "none", *options]
    return CliRunner().invoke(build(), words).stdout


@pytest.fixture(scope="module")
def boards() -> list[list[dict[str, str]]]:
    """The rows by significant outperformance, and those by mean time, by column."""
    return [rows(section) for section in printed("--format", "markdown").split("\n\n###")]


@pytest.fixture(scope="module")
def board(boards: list[list[dict[str, str]]]) -> list[dict[str, str]]:
    return boards[0]


def rows(text: str) -> list[dict[str, str]]:
    """Return the rows of the first table of a page, by column."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    parts = [re.split(r"(?<!\\)\|", line.removeprefix("|").removesuffix("|")) for line in lines]
    header, _, *body = ([cell.strip() for cell in row] for row in parts)
    return [dict(zip(header, cells)) for cells in body if len(cells) == len(header)]


def test_the_table_is_the_boards(board: list[dict[str, str]]) -> None:
    shown = rows(BOARD.replace(" (†)", ""))
    assert len(shown) == 10
    assert shown == [{name: row[name] for name in shown[0]} for row in board]


def test_the_table_by_mean_time_is_the_boards(boards: list[list[dict[str, str]]]) -> None:
    tiers = {row["entry"]: row["tier"] for row in boards[0]}
    shown = rows(PAGE.partition("What the published board decides")[2].partition("\n\n**")[0])
    assert len(shown) == 10
    assert shown == [
        {
            **{name: row[name] for name in ("rank", "", "M (95%)", "above the first (95%)")},
            "entry": row["entry"].removeprefix("ddqn "),
            "tier": tiers[row["entry"]],
        }
        for row in boards[1]
    ]


def test_the_decided_pairs_are_the_boards(board: list[dict[str, str]]) -> None:
    [section] = json.loads(printed("--format", "json"))["sections"]
    labels = {row["entry"]: row["label"].removeprefix("ddqn ") for row in section["rows"]}
    times = section["times"]
    order = [labels[row["entry"]] for row in times["entries"]]
    pairs = times["adjusted_p"][order.index("mlp width=16 lr=0.002")]
    p = [f"{pairs[order.index(f'vqc-native qubits={n}')]:.3f}".removeprefix("0") for n in (10, 8)]
    [cells] = [row["rests on"] for row in board if row["entry"] == "ddqn mlp width=16 lr=0.002"]
    text = PAGE.replace("\n", " ")
    assert f"{times['decided']} of {times['pairs']} pairs are decided." in text
    assert f"separate by {cells} cells, are not told apart (adjusted p {p[0]})" in text
    assert f"nor are that network and 8 qubits ({p[1]})." in text


def test_the_table_by_executions_is_the_boards() -> None:
    text = printed("--by", "executions", "--format", "markdown")
    shown = rows(PAGE.partition("The published circuits of `beam6g`, within")[2])
    ranked = [row for row in rows(text) if row["rank"] != "-"]
    assert len(shown) == 4
    assert [{**row, "entry": f"ddqn {row['entry']}"} for row in shown] == [
        {name: row[name] for name in shown[0]} for row in ranked
    ]


def test_the_core_hours_are_the_boards(board: list[dict[str, str]]) -> None:
    assert f"{sum(float(row['hours']) for row in board):.1f} core-hours for the ten" in BOARD


@pytest.mark.parametrize(
    ("first", "second", "sentence"),
    [
        (
            "mlp width=16 lr=0.002",
            "vqc-native qubits=6",
            "outperforms the circuit of 6 qubits in {} of 49 cells",
        ),
        ("mlp width=16 lr=0.002", "vqc-native qubits=8", "and the one of 8 qubits in {}"),
        ("vqc-native qubits=10", "mlp width=16 lr=0.002", "the circuit of 10 qubits is ahead of it in {}"),
    ],
)
def test_the_cells_of_the_retuned_network(first: str, second: str, sentence: str) -> None:
    comparison = api.compare(first, second, task="beam6g", published=True)
    assert comparison.count(Verdict.LOSS) == 0
    text = sentence.format(comparison.count(Verdict.WIN)).replace(" in 1", " in one")
    assert text in BOARD.replace("\n", " ")


def test_the_two_halves_of_the_seeds() -> None:
    published = [read(folder).entry_curves() for folder in sorted((PUBLISHED / "beam6g").iterdir())]
    entries = {entry.label: entry for entry in published}
    circuit, network = entries["ddqn vqc-native qubits=10"], entries["ddqn mlp width=16 lr=0.002"]

    def ahead(seeds: slice) -> int:
        pair = [LearningCurves(entry.curves[seeds], 2000, entry.label) for entry in (circuit, network)]
        comparison = compare(*pair, SURFACE)
        assert comparison.count(Verdict.LOSS) == 0
        return comparison.count(Verdict.WIN)

    assert ahead(slice(0, 50)) == 0
    sentence = f"on seeds 50 to 99 the circuit is ahead in {ahead(slice(50, 100))} cells"
    assert sentence in BOARD.replace("\n", " ")
