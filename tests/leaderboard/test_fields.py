"""Results as tables."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import pytest

from qrlsuite import api
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.shelf import fields
from qrlsuite.results.store import table_bytes
from tests.commands import say
from tests.conftest import Train
from tests.leaderboard.test_external import ending


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """External entries: two seeds of three epochs at each of two widths, and an option of another type."""
    folder = tmp_path_factory.mktemp("runs")
    curves = {
        "net width=4 lr=1": ([0, 1], [[0, 2, 4], [2, 4, 6]]),
        "net width=8 lr=0.5": ([0, 1], [[4, 6, 8], [6, 8, 10]]),
        "tree width=wide lr=[1,2]": ([0], [[1, 1, 1]]),
    }
    api.import_curves(curves, steps=[10, 20, 30], maximum=10, runs=folder)
    return folder


def test_columns_say_what_they_are() -> None:
    found = fields.table([], "entries")
    assert found.num_rows == 0
    assert found.schema.field("steps").metadata == {
        b"meaning": b"environment steps of each seed",
        b"unit": b"environment steps",
    }
    documented = api.table.__doc__ or ""
    for rows in fields.FIELDS.values():
        for each in rows:
            assert f"`{each.name}`" in documented, each.name


def test_values_of_several_types_and_what_is_unknown(runs: Path) -> None:
    found = api.table(runs=runs)
    assert found["model.width"].to_pylist() == ["4", "8", "wide"]
    assert found["model.lr"].to_pylist() == [1.0, 0.5, None], (
        "what is no number or text is no option of a name"
    )
    assert found["parameters"].to_pylist() == [None] * 3
    assert found["core_hours"].to_pylist() == [None] * 3
    assert found["external"].to_pylist() == [True] * 3
    assert fields.column([1, 2.5, None]).to_pylist() == [1.0, 2.5, None]
    assert fields.column([True, 1]).to_pylist() == ["true", "1"]
    assert fields.column([[1, 2], "a"]).to_pylist() == ["[1, 2]", "a"]
    assert fields.column([2**70]).to_pylist() == [str(2**70)]


def test_seeds_that_are_not_complete_have_no_scores(tmp_path: Path) -> None:
    path = ending(tmp_path / "curves.csv", 30, 30, 30)
    [done] = api.import_curves(path, thresholds=[15], runs=tmp_path / "runs")
    shorter, record = done.store.seed(2), done.store.seed(2).record()
    assert record is not None
    shorter.write_record(record.changed(epochs=2))
    shorter.table.write_bytes(table_bytes([{"epoch": 1, "score": 12.0}, {"epoch": 2, "score": 22.0}]))
    found = api.table("seeds", runs=tmp_path / "runs").to_pylist()
    assert [(row["epochs"], row["area"]) for row in found] == [(3, 20), (3, 21), (2, None)]


def test_a_horizon_cuts_all(runs: Path) -> None:
    assert api.table(runs=runs, horizon=20)["steps"].to_pylist() == [20, 20, 20]
    with pytest.raises(OptionError, match="rows = 'runs': a row is one of the entries, seeds or epochs"):
        api.table("runs")  # type: ignore[arg-type]


def test_from_the_command_line(runs: Path) -> None:
    def run(*words: str) -> Any:
        return say(*words, "--runs", str(runs))

    rows = list(csv.DictReader(io.StringIO(run("runs", "--format", "csv").stdout)))
    assert [(row["entry"], row["model.width"], row["seeds_finished"]) for row in rows] == [
        ("external net width=4 lr=1", "4", "2"),
        ("external net width=8 lr=0.5", "8", "2"),
        ("external tree width=wide lr=[1,2]", "wide", "1"),
    ]
    assert float(rows[0]["area"]) == pytest.approx(0.3)
    assert run("runs", "--format", "csv", "--task", "beam6g").stdout == ""


def test_an_entry_without_a_finished_epoch_is_in_the_csv(train: Train) -> None:
    folder = train("runs", [0], 1)
    (folder / "seed-0000" / "epochs.parquet").unlink()
    result = say("runs", "--format", "csv", "--runs", str(folder.parents[1]))
    [row] = list(csv.DictReader(io.StringIO(result.stdout)))
    assert (row["name"], row["seeds_finished"]) == (folder.name, "1")
