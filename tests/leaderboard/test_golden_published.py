"""What the published results say is what `tests/golden/published/` holds."""

from __future__ import annotations

from typing import Any

import pytest

from tests.golden import published

WHOLE = ("boards", "rows", "studies", "page", "tables")
PART = tuple(group for group in published.GROUPS if group not in WHOLE)
"""Groups of which `make test` asks every tenth question, and `make test-long` all."""


def expect_none(changed: list[str], group: str) -> None:
    shown = "\n".join(changed[:40])
    assert not changed, (
        f"{len(changed)} values of the published results are not those of tests/golden/published/{group}.json.xz:\n"
        f"{shown}\nIf every one is meant: `{published.MAKE} {group}`, a commit of its own that lists them"
    )


@pytest.mark.parametrize("group", WHOLE)
def test_published_results_say_what_they_said(group: str) -> None:
    expect_none(published.differences(group), group)


@pytest.mark.parametrize("group", PART)
def test_a_part_of_them_does(group: str) -> None:
    expect_none(published.differences(group, every=10), group)


@pytest.mark.long
@pytest.mark.parametrize("group", PART)
def test_all_of_them_do(group: str) -> None:
    expect_none(published.differences(group), group)


@pytest.mark.parametrize("group", published.GROUPS)
def test_nearly_all_questions_have_an_answer(group: str) -> None:
    answers = published.read(group)
    refused = [question for question, found in answers.items() if "error" in found]
    assert len(answers) > 4 * len(refused)


STORED: Any = {
    "p": 0.012,
    "ranks": [1, 2],
    "tied": False,
    "text": 60 * "a b" + "c",
    "rows": [{"entry": "mlp", "time": 40114.25}],
}


@pytest.mark.parametrize(
    ("now", "said"),
    [
        ({**STORED, "p": 0.012 * (1 + 1e-12)}, []),
        ({**STORED, "p": 0.0121}, ["p: 0.012 -> 0.0121"]),
        ({**STORED, "p": None}, ["p: 0.012 -> null"]),
        ({**STORED, "ranks": [1, 3]}, ["ranks[1]: 2 -> 3"]),
        ({**STORED, "ranks": [1]}, ["ranks: 2 values -> 1"]),
        ({**STORED, "tied": 0}, ["tied: false -> 0"]),
        ({**STORED, "rows": [{"entry": "mlp"}]}, ["rows[mlp].time: 40114.25 -> gone"]),
        ({**STORED, "tier": 1}, ["tier: new -> 1"]),
        (
            {**STORED, "text": 60 * "a b" + "d"},
            ['text: …a ba ba ba ba ba ba bc" -> …a ba ba ba ba ba ba bd"'],
        ),
    ],
)
def test_a_change_is_said_with_its_place(now: Any, said: list[str]) -> None:
    assert list(published.changes(STORED, now)) == said
