"""`qrlsuite runs rm` deletes what it was asked for, after a question, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import Result

from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, UnknownNameError
from qrlsuite.results.claims import acquire
from qrlsuite.results.store import EntryStore, write_json
from tests.commands import say
from tests.conftest import Train


def call(runs: Path, *words: str, typed: str | None = None) -> Result:
    return say("runs", *words, "--runs", str(runs), typed=typed)


@pytest.fixture
def two(kept: Train) -> tuple[Path, Path]:
    """Two entries of the folder `runs`."""
    first, second = (kept("runs", [0, 1], 1, settings=(f"width={width}",)) for width in (8, 16))
    return first, second


def test_it_asks_first(two: tuple[Path, Path], tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for typed in ("n\n", "\n", ""):
        said = call(runs, "rm", "mlp width=8", typed=typed)
        assert said.exit_code == 1
        assert f"tiny/{two[0].name} (ddqn mlp width=8, 2 seeds)" in said.output
        assert two[0].is_dir()
    said = call(runs, "rm", "mlp width=8", "--task", "tiny", typed="y\n")
    assert said.exit_code == 0, said.output
    assert "freed" in said.output
    assert [path.name for path in two[0].parent.iterdir()] == [two[1].name]
    assert call(runs, "rm", two[1].name, "--yes", "--json").exit_code == 0
    assert not two[1].exists()


def test_an_entry_that_is_trained_or_waits_in_a_queue_stays(two: tuple[Path, Path], tmp_path: Path) -> None:
    claim = acquire(EntryStore(two[0]), [7])  # a seed that has no folder yet
    with pytest.raises(StoreError, match="are being trained by process"):
        call(tmp_path / "runs", "rm", "mlp width=8", "--yes")
    claim.release()
    queue = two[0] / "slurm" / "submitted.json"  # of which no queue can be asked here
    write_json(queue, {"tasks": [{"job": "7", "seeds": [5], "epochs": 1}]})
    with pytest.raises(QrlSuiteError):
        call(tmp_path / "runs", "rm", "mlp width=8", "--yes")
    assert (two[0] / "entry.json").exists()
    queue.unlink()
    assert call(tmp_path / "runs", "rm", "mlp width=8", "--yes").exit_code == 0


def test_links_are_not_followed(two: tuple[Path, Path], tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    (tmp_path / "runs" / "tiny").rename(elsewhere)
    (tmp_path / "runs" / "tiny").symlink_to(elsewhere)
    with pytest.raises(StoreError, match="links are not followed"):
        call(tmp_path / "runs", "rm", f"tiny/{two[0].name}", "--yes")
    (tmp_path / "runs" / "tiny").unlink()
    (tmp_path / "runs" / "tiny").mkdir()
    link = tmp_path / "runs" / "tiny" / two[0].name
    link.symlink_to(elsewhere / two[0].name)
    with pytest.raises(StoreError):
        call(tmp_path / "runs", "rm", two[0].name, "--yes")
    link.unlink()
    (elsewhere / two[0].name).rename(link)
    (link / "data").symlink_to(elsewhere)
    assert call(tmp_path / "runs", "rm", "mlp width=8", "--yes").exit_code == 0
    assert (elsewhere / two[1].name / "entry.json").exists()


def test_mistakes_say_what_to_type(two: tuple[Path, Path], tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    with pytest.raises(UnknownNameError, match="may be any of"):
        call(runs, "rm", "mlp width=8", "mlp", "--yes")
    for words, message in (
        (("rm",), "Missing argument 'ENTRY...'"),
        (("gc", "mlp"), "unexpected extra argument"),
        (("mr",), "No such command 'mr'"),
    ):
        assert message in call(runs, *words).output
    with pytest.raises(OptionError, match="after the action: qrlsuite runs gc"):
        say("runs", "--task", "tiny", "gc")
    assert say("runs", "gc", QRLSUITE_RUNS=str(runs)).exit_code == 0, "a variable is not misplaced"
    assert all(path.exists() for path in two)
