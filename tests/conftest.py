"""A tiny task, and training on it in this process: what most tests of the core need."""

from __future__ import annotations

import gzip
import json
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job begins with it ignored,
# and so would every command that a test interrupts

LONGEST = (
    "third_party/test_stranger.py",
    "cli/test_cli.py",
    "testing/test_builtins.py",
    "cli/test_study.py",
    "engine/test_trouble.py",
    "cli/test_tune.py",
    "cli/test_new.py",
    "circuits/test_native.py",
    "engine/test_kills.py",
)
"""Begun first, for a file is one process's: the last one would be waited for by an idle core."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ranks = {Path(__file__).parent / name: rank for rank, name in enumerate(LONGEST)}
    assert all(path.exists() for path in ranks), "LONGEST names a file that is no longer there"
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


TINY = """
format_version = 1
name = "tiny"
summary = "A beam management task of seconds, for tests"
default_algorithm = "ddqn"

[environment]
name = "beam6g"
[environment.options]
antennas = [[[1.5, 1.0], [1.0, 0.0]], [[1.5, 5.0], [-1.0, 0.0]], [[4.5, 3.0], [0.0, 1.0]]]
degree = 3
steps = 20

[protocol]
seeds = 4
epochs = 3
environments = 4
interactions = 60
validation_episodes = 5

[ranking]
epsilons = [0.6, 0.8]
deltas = [0.5, 0.75]
reference = { epsilon = 0.6, delta = 0.5 }
horizons = [180]
"""


POLE = """
format_version = 1
name = "pole"
summary = "CartPole of 30 steps"
[environment]
name = "cartpole"
[environment.options]
steps = 30
[protocol]
environments = 4
interactions = 60
validation_episodes = 5
[score]
source = "return"
max_return = 30
[ranking]
epsilons = [0.5]
deltas = [0.5]
reference = { epsilon = 0.5, delta = 0.5 }
horizons = [180]
"""
"""Episodes that end at different times."""


@pytest.fixture
def tiny_task(tmp_path: Path) -> str:
    """The path of a task file whose episodes (20 steps) do not end with its epochs (15 steps per environment)."""
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return str(path)


@pytest.fixture
def train(tiny_task: str, tmp_path: Path) -> Callable[..., Path]:
    """Train seeds as one group in this process; returns the entry's folder."""

    def run(
        folder: str,
        seeds: Sequence[int],
        epochs: int = 3,
        model: str = "mlp",
        settings: Sequence[str] = ("width=16",),
    ) -> Path:
        from qrlsuite.engine.worker import train_group
        from qrlsuite.experiment.entry import resolve
        from qrlsuite.options import parse_setting
        from qrlsuite.results.store import EntryStore

        entry = resolve(tiny_task, model, settings=[parse_setting(word) for word in settings])
        store = EntryStore.create(tmp_path / folder, entry)
        train_group(store.path, seeds, epochs)
        return store.path

    return run


def results(entry: Path, seed: int) -> tuple[bytes, bytes]:
    """The bytes that must not depend on anything but the seed: its curve and its trained agent."""
    folder = entry / f"seed-{seed:04d}"
    return (folder / "epochs.parquet").read_bytes(), (folder / "final.safetensors").read_bytes()


def golden(name: str) -> Any:
    """Numbers that the paper's released code printed."""
    with gzip.open(Path(__file__).parent / "golden" / f"{name}.json.gz") as file:
        return json.load(file)
