"""What SECURITY.md says is held by tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "SECURITY.md").read_text()
PROMISES = re.findall(r"^- .*(?:\n  .*)*", TEXT.partition("## Remaining risks")[0], re.MULTILINE)
TEST = re.compile(r"`([\w/]+\.py)::(test_\w+)`")


def test_every_promise_names_the_tests_that_hold_it() -> None:
    assert len(PROMISES) > 20
    assert not [promise for promise in PROMISES if not TEST.search(promise)]


def test_the_named_tests_exist() -> None:
    named = [(ROOT / "tests" / file, name) for file, name in TEST.findall(TEXT)]
    assert [(path, name) for path, name in named if f"\ndef {name}(" not in path.read_text()] == []


def test_every_door_has_its_promises() -> None:
    doors = ("Plugins", "Task, study", "Entries", "Published studies", "Results folders")
    for door in (*doors, "Trackers", "Dask clusters", "The leaderboard's page"):
        (section,) = re.findall(rf"^\*\*{door}.*?(?=^\*\*|^## )", TEXT, re.MULTILINE | re.DOTALL)
        assert re.search(r"\b(?:is|are) (?:not )?trusted|are plugins", section), door
        assert TEST.search(section), door
