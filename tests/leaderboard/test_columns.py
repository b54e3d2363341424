"""A column in one list is seen in all formats: the spread between seeds, and what a plugin adds."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from qrlsuite import columns as writers
from qrlsuite.columns import Column
from qrlsuite.engine.sheet import Sheet, csv_rows
from qrlsuite.leaderboard.boards.columns import of_entry
from qrlsuite.leaderboard.report import render
from tests.commands import qrlsuite
from tests.leaderboard import boards
from tests.leaderboard.test_times import reaching


def everywhere(made: Any) -> list[str]:
    """A board in each format: terminal, Markdown, LaTeX, notebook, page."""
    (sheet,) = made.sheets()
    terminal = io.StringIO()
    Console(file=terminal, width=250).print(sheet)
    return [terminal.getvalue(), sheet.markdown(), sheet.latex(), sheet.html(), render(made)]


def test_the_spread_between_seeds_is_in_every_format() -> None:
    # 1 until epoch 10 + i of seed i, of 2000 steps: the 5th percentile of 10 to 29 epochs is 10.95, the 95th 28.05
    entry = reaching("one", (1, 10), spread=20)
    low, high = 2000 * np.array([10.95, 28.05])
    assert of_entry()[1].value(entry) == pytest.approx([low, high])
    assert ["21.9k to 56.1k" in text for text in everywhere(boards.of([entry]))] == [True] * 5
    cut = boards.board.build([entry], horizon=40_000).as_dict()["sections"][0]["rows"][0]["spread"]
    assert cut == pytest.approx([low, 40_000]), "the curves of a board end at its horizon"


def test_a_head_that_cannot_be_broken_costs_the_last_columns_not_the_first_ones() -> None:
    heads = ["pair", *(f"beam6g-a2-{place}-degree5" for place in range(9))]
    console = Console(width=80, file=io.StringIO())
    console.print(Sheet.of("", heads, [["circuit / network", *["+1.4%"] * 9]], words=["pair"]))
    head, _, row = console.file.getvalue().splitlines()
    assert head.split() == heads[:4]
    assert row.split() == ["circuit", "/", "network", *["+1.4%"] * 3]


def test_a_made_up_column_is_written_by_every_writer() -> None:
    rows: list[Any] = [["a|b", 0.25, 1, 2], ["c", None]]
    columns: list[Column[Any]] = [
        Column("name", lambda row: row[0], str, words=True),
        Column("share", lambda row: row[1], "{:.0%}".format, "how much", head="share of it"),
        Column("range_interval", lambda row: row[2:] or None),
        Column("", lambda row: row[0], cell=lambda row: row[0].upper(), head="loud"),
    ]
    sheet = Sheet("title", tuple(columns), rows, ("a note",), explained=True)
    assert sheet.cells == [("a|b", "25%", "A|B"), ("c", "-", "C")]
    assert "| a\\|b | 25% | A\\|B |" in sheet.markdown()
    assert r"a\textbar{}b & 25\% & A\textbar{}B \\" in sheet.latex()
    assert "<td style='text-align:right'>25%</td>" in sheet.html()
    assert sheet.remarks() == ["share of it: how much", "a note"]
    assert writers.record(columns, rows[0]) == {"name": "a|b", "share": 0.25, "range_interval": [1, 2]}
    assert writers.flat(columns, rows[1]) == {
        "name": "c", "share": None, "range_low": None, "range_high": None,
    }  # fmt: skip
    assert csv_rows([writers.flat(columns, row) for row in rows]).splitlines()[1:] == ["a|b,0.25,1,2", "c,,,"]
    assert columns[1].of(lambda row: row["row"]).written({"row": rows[0]}) == "25%"


WORST = """
from qrlsuite import hookimpl
from qrlsuite.columns import Column

@hookimpl
def register_columns(register):
    register(Column("worst", lambda entry: entry.curves[:, -1].min(), "{:.3f}".format, "least last score"))
"""


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (("", ""), ""),
        (('"worst"', '"seeds"'), "there is a column 'seeds' already"),
        ((".min()", ".nothing()"), "column 'worst' of distribution 'worst.py' fails: AttributeError"),
        (('[:, -1].min()', ""), "column 'worst' of distribution 'worst.py': ndarray is no number, text or truth value"),
        (("register(Column(", "nosuch(Column("), "hook 'register_columns' of distribution 'worst.py' fails: NameError"),
        (('"worst"', '""'), "is no Column with a usable name"),
    ],
)  # fmt: skip
def test_a_plugin_by_path_adds_a_column(tmp_path: Path, change: tuple[str, str], error: str) -> None:
    (tmp_path / "worst.py").write_text(WORST.replace(*change))
    words = ["leaderboard", "--published", "--task", "channel", "--plugin", "worst.py"]
    done = qrlsuite(*words, "--format", "json", cwd=tmp_path)
    if error:
        assert (done.returncode, error in done.stderr, "Traceback" in done.stderr) == (2, True, False), (
            done.stderr
        )
        return
    (section,) = json.loads(done.stdout[done.stdout.index("{") :])["sections"]
    assert all(0 <= row["worst"] <= 1 for row in section["rows"])
    assert "| worst |" in qrlsuite(*words, "--format", "markdown", cwd=tmp_path).stdout
