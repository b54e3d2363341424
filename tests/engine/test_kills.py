"""`qrlsuite run` with three workers, killed at random: nothing lost, nothing doubled, the same bytes."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.conftest import TINY, most_epochs
from tests.engine.stress import ENTRY, compare, disturbed, undisturbed

ENDLESS = 1_000_000


PENDULUM = (
    TINY.partition("[environment]")[0]
    + """
[environment]
name = "gym"
[environment.options]
id = "Pendulum-v1"
[protocol]
seeds = 4
epochs = 3
environments = 1
interactions = 400
validation_episodes = 2
[score]
source = "return"
[ranking]
thresholds = [-1000]
deltas = [0.5]
reference = { threshold = -1000, delta = 0.5 }
horizons = [1200]
"""
)
DRQN = "drqn gru width=8 burn_in=2 length=4 batch=4"
TD3 = "td3 mlp width=8 warm_up=100 batch=16"


@pytest.mark.parametrize(
    ("kills", "text", "trained"),
    [
        (3, TINY, ENTRY),
        pytest.param(100, TINY, ENTRY, marks=pytest.mark.long),
        pytest.param(10, PENDULUM, TD3, marks=pytest.mark.long),
        pytest.param(10, TINY, DRQN, marks=pytest.mark.long),
    ],
    ids=["3", "100", "td3", "drqn"],
)
def test_killed_again_and_again(kills: int, text: str, trained: str, tmp_path: Path) -> None:
    """The epochs are as many as there was time for between the kills, on whatever machine."""
    task = tmp_path / "tiny.toml"
    task.write_text(text)
    runs, seeds = tmp_path / "killed", 3
    killed = disturbed(task, runs, kills, random.Random(4), seeds, ENDLESS, 3, 0.3, trained)
    assert killed["supervisor"] + killed["worker"] == kills
    (entry,) = (runs / "tiny").iterdir()
    epochs = most_epochs(entry) + 1
    assert undisturbed(task, runs, seeds, epochs, 3, trained) == entry
    compare(undisturbed(task, tmp_path / "straight", seeds, epochs, 3, trained), entry, seeds, epochs)
