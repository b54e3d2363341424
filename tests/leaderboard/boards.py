"""Boards from drawn learning curves: what a report looks like does not need training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment import task as tasks
from qrlsuite.experiment.preset import EntryTuning
from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.records import CodeRecord, EntryIdentity, EntryRecord, RunRecord
from qrlsuite.results.store import SeedRun
from tests.commands import say

Floats = NDArray[np.float64]
RUN = ("parameters", "provenance", "code", "probe", "agent")
"""Facts of the records of runs."""
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
    identity = {"algorithm_options": {"gamma": 0.95, "lr": 5e-4}, "model_options": {"name": label}}
    record = EntryRecord.model_construct(
        name=label,
        hash=label,
        label=label,
        task_name=task,
        task_hash="0123456789abcdef",
        task_file=file,
        identity=identity_of({"algorithm": "ddqn", "model": label.split()[0], **identity}),
    )
    run = RunRecord.model_construct(
        parameters={"classical": 387, "quantum": quantum}, status="finished", epochs=epochs
    )
    runs = {
        seed: SeedRun(seed, run, curve[:, None], 900 / seeds, 0, None, folder=Path(label))
        for seed, curve in enumerate(curves)
    }
    return EntryResults.of(record, Path(label), runs)


def identity_of(content: Mapping[str, Any]) -> EntryIdentity:
    return EntryIdentity.model_validate({"task": {}, "algorithm_options": {}, "model_options": {}, **content})


def changed(entry: EntryResults, *, curves: Floats | None = None, **facts: Any) -> EntryResults:
    """The entry with other facts, of its seeds' runs or records, or of its own record; with other curves (N, T)."""
    tables: dict[type, dict[str, Any]] = {SeedRun: {}, RunRecord: {}, EntryRecord: {}}
    names = {SeedRun: SeedRun.__dataclass_fields__, RunRecord: RUN, EntryRecord: EntryRecord.model_fields}
    for name, value in facts.items():
        tables[next(table for table in tables if name in names[table])][name] = value
    if "tuning" in facts:
        tables[EntryRecord]["tuning"] = EntryTuning.model_validate(facts["tuning"])
    if facts.get("code") is not None:
        tables[RunRecord]["code"] = CodeRecord.model_validate(facts["code"].record())
    if "identity" in facts:
        own = {"algorithm": entry.algorithm, "model": entry.model}
        tables[EntryRecord]["identity"] = identity_of({**own, **facts["identity"]})
    usual = next(iter(entry.records.values()))
    scores = {seed: run.scores for seed, run in entry.records.items()}
    if curves is not None:
        scores = dict(enumerate(curves[:, :, None]))
    runs = {}
    for seed, values in scores.items():
        run = entry.records.get(seed, usual)
        assert run.record is not None
        record = run.record.model_copy(update=tables[RunRecord])
        runs[seed] = replace(run, **{"seed": seed, "record": record, "scores": values, **tables[SeedRun]})
    epochs = entry.epochs if curves is None else curves.shape[1]
    record = entry.record.model_copy(update=tables[EntryRecord])
    return replace(entry, record=record, records=runs, epochs=epochs)


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
