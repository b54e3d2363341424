"""Boards from drawn learning curves: what a report looks like does not need training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment import task as tasks
from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.shelf.curves import EntryResults
from tests.commands import say

HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror="document.title=1">',
    "</script><script>document.title='broken'</script><!--",
    "<b>bold</b> <a href='https://example.org'>link</a> &lt;i&gt; %{y} {{ 7 * 7 }}",
    "right\u202eto left \x00 \ud800 end",
)


def entry(
    label: str, seeds: int = 20, epochs: int = 100, speed: float = 1.0, quantum: int = 0, task: str = "beam6g"
) -> EntryResults:
    """An entry whose score rises to .93 within about 50 / speed epochs, with noise per run and epoch."""
    file = tasks.load(task).file
    generator = np.random.default_rng([len(label), seeds, int(100 * speed)])
    pace = speed * generator.lognormal(0, 0.25, (seeds, 1)) / 20
    rising = 0.93 - 0.6 * np.exp(-pace * np.arange(1, epochs + 1))
    curves = np.clip(rising + 0.02 * generator.standard_normal((seeds, epochs)), 0, 1)
    return EntryResults(
        name=label,
        label=label,
        task=task,
        task_hash="0123456789abcdef",
        task_file=file,
        algorithm="ddqn",
        model=label.split()[0],
        parameters=(387, quantum),
        curves=curves,
        seeds=tuple(range(seeds)),
        left_out=(),
        hours=0.25,
        folder=Path(label),
        identity={"algorithm_options": {"gamma": 0.95, "lr": 5e-4}, "model_options": {"name": label}},
    )


def of(entries: Sequence[EntryResults], refused: Sequence[str] = ()) -> board.Leaderboard:
    """The board of some entries."""
    return board.build(entries, refused)


def graded(count: int, seeds: int = 20, epochs: int = 100) -> list[EntryResults]:
    """`count` entries, each somewhat slower than the one before."""
    return [
        entry(f"model-{i} width={2**i % 1000}", seeds, epochs, 2.4 * 0.85**i, quantum=144 * (i % 3 == 1))
        for i in range(count)
    ]


def refused(*words: object) -> str:
    """Return the line with which `qrlsuite WORDS` is refused."""
    with pytest.raises(QrlSuiteError) as raised:
        say(*map(str, words))
    assert "\n" not in str(raised.value)
    return str(raised.value)
