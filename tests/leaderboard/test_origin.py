"""What an entry says of its origin is gathered over all its seeds."""

from __future__ import annotations

from pathlib import Path

import pytest

from qrlsuite.errors import StoreError
from qrlsuite.leaderboard import origin
from qrlsuite.results.store import SeedStore, json_line, table_bytes


def test_executions_are_summed_over_table_and_newer_lines(tmp_path: Path) -> None:
    rows = [
        {"epoch": e, "scores": [0.5], "executions": {"forward": 10, "shift": e, "shots": 999}}
        for e in (1, 2, 3)
    ]
    seed = SeedStore(tmp_path, 0)
    seed.lines.write_bytes(b"".join(json_line(row) for row in rows))
    assert seed.read().executions == 36
    seed.table.write_bytes(table_bytes(rows[:2]))
    assert seed.read().executions == 36
    seed.lines.unlink()
    assert seed.read().executions == 23


@pytest.mark.parametrize("count", [-1, 1.5, "many", True])
def test_counts_that_are_no_counts_are_refused(tmp_path: Path, count: object) -> None:
    seed = SeedStore(tmp_path, 0)
    seed.lines.write_bytes(json_line({"epoch": 1, "scores": [0.5], "executions": {"forward": count}}))
    with pytest.raises(StoreError, match="circuit executions"):
        _ = seed.read().executions


def test_every_version_is_told_once() -> None:
    made = [{"versions": {"numpy": v}, "python": "3.11", "commit": None} for v in ("2.4", "2.3", "2.4")]
    assert origin.versions(made) == {"numpy": ("2.3", "2.4"), "python": ("3.11",)}
    assert origin.texts(made, "commit") == ()
