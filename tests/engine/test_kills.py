"""`qrlsuite run` with three workers, killed at random: nothing lost, nothing doubled, the same bytes."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.conftest import TINY, most_epochs
from tests.engine.stress import compare, disturbed, undisturbed

ENDLESS = 1_000_000


@pytest.mark.parametrize("kills", [3, pytest.param(100, marks=pytest.mark.long)])
def test_killed_again_and_again(kills: int, tmp_path: Path) -> None:
    """The epochs are as many as there was time for between the kills, on whatever machine."""
    task = tmp_path / "tiny.toml"
    task.write_text(TINY)
    runs, seeds = tmp_path / "killed", 3
    killed = disturbed(task, runs, kills, random.Random(4), seeds, ENDLESS, 3, 0.3)
    assert killed["supervisor"] + killed["worker"] == kills
    (entry,) = (runs / "tiny").iterdir()
    epochs = most_epochs(entry) + 1
    assert undisturbed(task, runs, seeds, epochs, 3) == entry
    compare(undisturbed(task, tmp_path / "straight", seeds, epochs, 3), entry, seeds, epochs)
