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
from qrlsuite.results.records import EntryRecord

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


FREE = {
    "format_version", "identity.task", "identity.algorithm_options", "identity.model_options", "task_file",
    "tuning.space", "published.provenance.0", "published.agents.provenance.0",
}  # fmt: skip
"""What is read by others, or has keys that nobody here knows."""


def keys(value: Any, *path: str) -> Iterator[tuple[str, ...]]:
    """Every key of a table, and of tables and lists in it."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        if (own := (*path, str(key))) and ".".join(own) not in FREE:
            yield own
            yield from keys(inner, *own)


ENTRY = whole()


def test_a_whole_record_is_read() -> None:
    path, content = ENTRY
    assert EntryRecord.read(content, path).content == content
    later = {**content, "later": [1], "published": {**content["published"], "later": {"a": 1}}}
    record = EntryRecord.read(later, path).changed(preset=None)
    assert record.content == {**later, "preset": None}, "keys of later versions stay"


@pytest.mark.parametrize("key", list(keys(ENTRY[1])), ids=".".join)
def test_a_damaged_key_is_named(key: tuple[str, ...]) -> None:
    path, content = ENTRY
    content = copy.deepcopy(content)
    table: Any = content
    for name in key[:-1]:
        table = table[int(name) if isinstance(table, list) else name]
    last: Any = int(key[-1]) if isinstance(table, list) else key[-1]
    table[last] = [[]] if isinstance(table[last], str | None) else "x"
    with pytest.raises(StoreError) as error:
        EntryRecord.read(content, path)
    assert str(error.value).startswith(f"{path} is not an entry's record: ")
    assert ".".join(key) in str(error.value)
