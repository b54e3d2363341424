"""`--set`: values as TOML, sides found by themselves, mistakes answered with what to type."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.errors import OptionError


@dataclass(frozen=True)
class Left:
    width: int = 1
    gamma: float = 0.5


@dataclass(frozen=True)
class Right:
    gamma: float = 0.5
    antennas: list[int] | None = None


@dataclass(frozen=True)
class Anything:
    y: Any = None


SIDES = {"model": Left, "algorithm": Right}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("6", 6),
        (".9", 0.9),
        ("5e-4", 5e-4),
        ("true", True),
        ("[1, 2]", [1, 2]),
        ("relu", "relu"),
        ('"6"', "6"),
        ("", ""),
    ],
)
def test_values_are_read_as_toml_else_as_text(text: str, value: Any) -> None:
    assert options.parse_value(text) == value


def test_a_bare_key_goes_where_it_belongs() -> None:
    words = [options.parse_setting(w) for w in ("width=3", "model.gamma=.1", "antennas=[1]")]
    assert options.assign(words, SIDES) == {
        "model": {"width": 3, "gamma": 0.1},
        "algorithm": {"antennas": [1]},
    }


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("gamma=1", "write model.gamma=... or algorithm.gamma=..."),
        ("widht=1", "no option of that name; did you mean 'width'"),
        ("modle.width=1", "sides are model, algorithm"),
    ],
)
def test_keys_that_fit_nowhere_or_twice(word: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        options.assign([options.parse_setting(word)], SIDES)


@pytest.mark.parametrize("word", ["width", "=3"])
def test_words_without_name_or_value(word: str) -> None:
    with pytest.raises(OptionError, match="write name=value"):
        options.parse_setting(word)


def test_build_lists_every_problem() -> None:
    with pytest.raises(OptionError) as caught:
        options.build(Left, {"widht": 1, "gamma": "much"}, "model 'left'")
    assert "no option 'widht'; did you mean 'width'" in str(caught.value)
    assert "gamma = 'much'" in str(caught.value)


def test_plain_writes_every_default_out() -> None:
    assert options.plain(Left()) == {"width": 1, "gamma": 0.5}


def test_infinite_numbers_are_named_wherever_they_stand() -> None:
    """JSON has none, and an identity is written in it."""
    for value in (math.inf, [1.0, -math.inf], {"a": [math.inf]}):
        with pytest.raises(OptionError, match=r"model 'x': y = .*infinite numbers cannot be written to JSON"):
            options.build(Anything, {"y": value}, "model 'x'")
    assert options.build(Anything, {"y": [1.0, {}]}, "model 'x'").y == [1.0, {}]
