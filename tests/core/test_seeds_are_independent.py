"""What a seed draws and does depends neither on its company nor on the simulator of its circuit."""

from __future__ import annotations

from pathlib import Path

import pytest

from qrlsuite.results.store import EntryStore
from tests.conftest import POLE, Train, results


def test_shots_do_not_depend_on_when_others_end_their_episodes(tiny_task: str, train: Train) -> None:
    """The group validates until its last episode has ended; the passes of those that wait must not count."""
    short = POLE.replace("interactions = 60", "interactions = 20").replace("episodes = 5", "episodes = 3")
    Path(tiny_task).write_text(short)
    circuit = {"epochs": 2, "model": "vqc-pennylane", "settings": ("qubits=2", "layers=1", "shots=20")}
    together = train("together", range(3), **circuit)
    longest = [max(EntryStore(together).seed(seed).epochs()[0].scores) for seed in range(3)]
    assert min(longest) < max(longest), "or nobody waits, and the test proves nothing"
    waits = longest.index(min(longest))
    assert results(together, waits) == results(train("alone", [waits], **circuit), waits)


def test_native_and_pennylane_agents_of_one_seed_act_alike(train: Train) -> None:
    """In float64 the two backends choose exactly the same actions in the first epoch."""
    settings = ("qubits=3", "layers=2", "dtype=float64")
    rows = []
    for model in ("vqc-native", "vqc-pennylane"):
        entry = train("runs", [0], 1, model=model, settings=settings)
        rows.append(EntryStore(entry).seed(0).epochs()[0].content)
    for name in ("train_return", "train_score", "scores", "executions"):
        assert rows[0][name] == rows[1][name], name
    assert rows[0]["loss"] == pytest.approx(rows[1]["loss"], rel=1e-9)
