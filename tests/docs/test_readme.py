"""The numbers of the README's first screen are those that the published entries give."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from qrlsuite import api
from qrlsuite.cli.app import build
from qrlsuite.leaderboard.published import PUBLISHED, read
from qrlsuite.statistics import LearningCurves, Verdict, compare
from tests.statistics.conftest import SURFACE

README = (Path(__file__).parents[2] / "README.md").read_text()
FIRST_SCREEN = README.partition("\n## ")[0]


@pytest.fixture(scope="module")
def board() -> list[dict[str, str]]:
    """The rows that `qrlsuite leaderboard --published --task beam6g` prints, by column."""
    words = ["leaderboard", "--published", "--task", "beam6g", "--format", "markdown", "--runs", "none"]
    return rows(CliRunner().invoke(build(), words).stdout.partition("\n\n###")[0])


def rows(text: str) -> list[dict[str, str]]:
    """Return the rows of the first table of a page, by column."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    header, _, *body = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return [dict(zip(header, cells)) for cells in body if len(cells) == len(header)]


def test_the_table_is_the_boards(board: list[dict[str, str]]) -> None:
    shown = rows(FIRST_SCREEN.replace(" (†)", ""))
    assert len(shown) == 9
    assert shown == [{name: row[name] for name in shown[0]} for row in board]


def test_the_core_hours_are_the_boards(board: list[dict[str, str]]) -> None:
    assert f"{sum(float(row['hours']) for row in board):.1f} core-hours for the nine" in FIRST_SCREEN


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
    assert text in FIRST_SCREEN.replace("\n", " ")


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
    assert sentence in FIRST_SCREEN.replace("\n", " ")
