"""Circuit executions are counted over all of a seed's epochs."""

from __future__ import annotations

from pathlib import Path

import pytest

from qrlsuite.errors import StoreError
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
    with pytest.raises(StoreError, match=r"line 1 .*: executions\.forward = "):
        _ = seed.read().executions
