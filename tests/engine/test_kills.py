"""`qrlsuite run` with three workers, killed at random: nothing lost, nothing doubled, the same bytes."""

from __future__ import annotations

import random
import subprocess
from pathlib import Path

from tests.conftest import TINY
from tests.engine.stress import compare, disturbed, finished, words


def test_killed_again_and_again(tmp_path: Path) -> None:
    task = tmp_path / "tiny.toml"
    task.write_text(TINY)
    seeds, epochs = 3, 40
    subprocess.run(
        words(task, tmp_path / "straight", seeds, epochs, 3), check=True, stdout=subprocess.DEVNULL
    )
    straight = finished(tmp_path / "straight", seeds, epochs)
    assert straight is not None
    entry, killed = disturbed(task, tmp_path / "killed", 4, random.Random(4), seeds, epochs, 3, pause=1.2)
    assert killed["at work"] + killed["supervisor"] >= 2, "it finished before it was killed often enough"
    compare(straight, entry, seeds, epochs)
