"""Records: every published one is read and written again to its bytes, and a damaged key is named with its file."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.errors import StoreError
from qrlsuite.experiment.task import digest
from qrlsuite.leaderboard.shelf import PLANS
from qrlsuite.leaderboard.shelf.published import OF_STUDIES, PUBLISHED, encode_record
from qrlsuite.results.records import (
    EntryRecord,
    EpochLine,
    LookLine,
    Provenance,
    Record,
    RoundLine,
    RunRecord,
    TimingLine,
)
from qrlsuite.results.store import json_line

GOLDEN = Path(__file__).parents[1] / "golden"
ENTRIES = sorted(
    path for folder in (PUBLISHED, OF_STUDIES, PLANS, GOLDEN) for path in folder.glob("**/entry.json")
)


def test_every_stored_entry_is_written_again_to_its_bytes() -> None:
    samplers = set()
    for path in ENTRIES:
        record = EntryRecord.read(json.loads(path.read_bytes()), path)
        assert encode_record(record.content) == path.read_bytes(), path
        assert encode_record(record.changed(preset=record.preset).content) == path.read_bytes(), path
        samplers.add(record.tuning and record.tuning.sampler)
    assert len(ENTRIES) > 390
    assert {"halving", "bayesian", None} <= samplers, "records of older searches are among them"


def test_every_stored_run_is_written_again_to_its_bytes() -> None:
    runs = sorted(GOLDEN.glob("**/run.json"))
    for path in runs:
        record = RunRecord.read(json.loads(path.read_bytes()), path)
        assert encode_record(record.content) == path.read_bytes(), path
        assert encode_record(record.changed(status=record.status).content) == path.read_bytes(), path
    assert len(runs) > 20
    lines = [
        (path, line) for path in GOLDEN.glob("**/epochs.jsonl") for line in path.read_bytes().splitlines(True)
    ]
    for path, line in lines:
        assert json_line(EpochLine.read(json.loads(line), path).content) == line
    logs = [
        (path, line) for path in PLANS.glob("*/looks.jsonl") for line in path.read_bytes().splitlines(True)
    ]
    for path, line in logs:
        assert json_line(LookLine.read(json.loads(line), path).content) == line
    assert len(lines) > 100
    assert len(logs) > 80


def whole() -> tuple[Path, dict[str, Any]]:
    """An entry's record with every key that there is."""
    path = PUBLISHED / "pulse" / sorted(os.listdir(PUBLISHED / "pulse"))[0] / "entry.json"
    content: dict[str, Any] = json.loads(path.read_bytes())
    parts = [{"role": "file", "name": "model.path", "sha256": "0"}]
    content |= {
        "preset": "default",
        "plan": "0" * 16,
        "code": {"digest": digest(parts), "parts": parts},
        "imported": {"grid": "every 5 steps", "maximum": 2.0},
        "same": [{"codes": ["0", "1"], "reason": "renamed", "time": "now"}],
        "plugins": {"0" * 16: [f"plugins/{'0' * 16}/mine.py"]},
    }
    content["published"] |= {
        "diverged": {"3": 1},
        "probe": {"result": "equal", "seed": 3, "epochs": 2, "seconds": 0.5, "cpu": 0.5},
        "agents": {"sha256": "0" * 64, "seeds": [0, 1], "provenance": [{}]},
        "measured": ["length", "violations"],
    }
    return path, content


ENTRY, ENTRY_CONTENT = whole()
RUN = GOLDEN / "run.json"
RUN_CONTENT = {
    "plan": "0" * 16, "task": "tiny", "task_hash": "1", "entry": "ddqn-mlp-2", "label": "ddqn mlp",
    "algorithm": "ddqn", "algorithm_options": {}, "model": "mlp", "family": "classical", "model_options": {},
    "parameters": {"classical": 3, "quantum": 0, "networks": 1}, "seed": 3, "interactions_per_epoch": 60,
    "code": ENTRY_CONTENT["code"], "probe": {"result": "differs", "difference": "scores"}, "status": "finished",
    "epochs": 2, "diverged": 1, "imported": {}, "agent": False,
    "provenance": [ENTRY_CONTENT["published"]["provenance"][0] | {"host": "node", "before": [{"python": "3.11"}]}],
}  # fmt: skip
LINES = GOLDEN / "epochs.jsonl"
LINE_CONTENT = {
    "epoch": 1, "scores": [0.5, 1.0], "score": 0.75, "loss": 0.5, "train_return": 0.5, "measured.violations": 1.0,
    "measured": {"length": 2.0}, "executions": {"forward": 3, "shots": 100}, "diverged": True,
}  # fmt: skip
TIME_CONTENT = {
    "epoch": 1,
    "train": 0.5,
    "validate": 0.25,
    "cpu": 0.7,
    "group": 3,
    "host": "node",
    "time": "now",
}
LOOK_CONTENT = {
    "begun": "now", "ended": "now", "time": "now", "plan": "0", "look": 20,
    "pairs": [{"pair": ["a", "b"], "p": 0.5, "decided": "equal"}],
}  # fmt: skip
ROUND_CONTENT = {"round": 0, "lanes": 2, "steps": 9, "returns": [[1.0, 2.0]], "scores": [[0.5, 0.5]]}
FREE = {
    "format_version", "identity.task", "identity.algorithm_options", "identity.model_options", "task_file",
    "tuning.space", "provenance.0.device.numba-cuda",
}  # fmt: skip
"""What is read by others, or has keys that nobody here knows."""


def keys(value: Any, *path: str) -> Iterator[tuple[str, ...]]:
    """Every key of a table, and of tables and lists in it."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        if (own := (*path, str(key))) and ".".join(own) not in FREE:
            yield own
            yield from keys(inner, *own)


@pytest.mark.parametrize(
    ("kind", "path", "content"), [(EntryRecord, ENTRY, ENTRY_CONTENT), (RunRecord, RUN, RUN_CONTENT)]
)
def test_a_whole_record_is_read_and_keys_of_later_versions_stay(
    kind: type[Record], path: Path, content: dict[str, Any]
) -> None:
    assert kind.read(content, path).content == content
    later = {**content, "later": [1], "code": {**content["code"], "later": 1}}
    assert kind.read(later, path).changed(plan="2").content == {**later, "plan": "2"}


def test_what_older_records_lack_has_a_meaning() -> None:
    run = RunRecord(task="tiny", task_hash="1", entry="ddqn-mlp-2", seed=3, status="finished", epochs=2)
    assert (run.code_identity, run.probe, run.provenance, run.parameters) == (None, None, [], {})
    assert run.agent
    assert Provenance().device.kind == "cpu"
    assert EpochLine.read({"epoch": 1, "scores": [0.5], "loss": 1e300}, LINES).scores == [0.5], (
        "diverging is no damage"
    )
    with pytest.raises(
        StoreError, match="is not a run's record: missing key 'seed'; restore the file or delete"
    ):
        RunRecord.read({name: value for name, value in RUN_CONTENT.items() if name != "seed"}, RUN)


CASES = [
    *((EntryRecord, ENTRY, ENTRY_CONTENT, key) for key in keys(ENTRY_CONTENT)),
    *((RunRecord, RUN, RUN_CONTENT, key) for key in keys(RUN_CONTENT)),
    *((EpochLine, LINES, LINE_CONTENT, key) for key in keys(LINE_CONTENT)),
    *((TimingLine, LINES, TIME_CONTENT, key) for key in keys(TIME_CONTENT)),
    *((LookLine, LINES, LOOK_CONTENT, key) for key in keys(LOOK_CONTENT)),
    *((RoundLine, LINES, ROUND_CONTENT, key) for key in keys(ROUND_CONTENT)),
]


@pytest.mark.parametrize(
    ("kind", "path", "content", "key"), CASES, ids=[".".join(case[-1]) for case in CASES]
)
def test_a_damaged_key_is_named(
    kind: type[Record], path: Path, content: dict[str, Any], key: tuple[str, ...]
) -> None:
    content = copy.deepcopy(content)
    table: Any = content
    for name in key[:-1]:
        table = table[int(name) if isinstance(table, list) else name]
    last: Any = int(key[-1]) if isinstance(table, list) else key[-1]
    table[last] = [[]] if isinstance(table[last], str | None) else "x"
    with pytest.raises(StoreError) as error:
        kind.read(content, path)
    assert str(error.value).startswith(f"{path} is not {kind.what}: ")
    assert ".".join(key) in str(error.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("parameters", {"classical": -1, "quantum": 0}),
        ("parameters", {"quantum": 1}),
        ("provenance", []),
        ("seeds", 0),
    ],
)
def test_what_no_entry_can_have_published(name: str, value: Any) -> None:
    content = {**ENTRY_CONTENT, "published": {**ENTRY_CONTENT["published"], name: value}}
    with pytest.raises(StoreError, match=f"published.{name}"):
        EntryRecord.read(content, ENTRY)


@pytest.mark.parametrize(
    "damage", [{"lanes": 3}, {"scores": [[0.5, 0.5]] * 2}, {"returns": [[1.0, float("nan")]]}]
)
def test_a_round_has_a_number_for_every_agent_and_lane(damage: dict[str, Any]) -> None:
    with pytest.raises(StoreError, match="is not a round of an evaluation"):
        RoundLine.read({**ROUND_CONTENT, **damage}, LINES)


@pytest.mark.parametrize("damage", [{"diverged": "true"}, {"score": "0.5"}, {"executions": {"a b": 1}}])
def test_a_text_is_no_other_value_and_executions_are_named_by_words(damage: dict[str, Any]) -> None:
    with pytest.raises(StoreError, match="is not an epoch's record"):
        EpochLine.read({**LINE_CONTENT, **damage}, LINES)
