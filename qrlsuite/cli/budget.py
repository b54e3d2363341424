"""Time budgets as people write them."""

from __future__ import annotations

import re

from qrlsuite.errors import OptionError

_PIECE = re.compile(r"(\d+(?:\.\d+)?)\s*(seconds|sec|s|minutes|min|m|hours|h|days|d)")
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


def seconds(text: str) -> float:
    """Read `90s`, `30min`, `2h` or `1h 30min`.

    Raises
    ------
    OptionError
        If it is nothing of that kind.

    >>> seconds("1h 30min")
    5400.0
    """
    words = text.strip().lower()
    pieces = _PIECE.findall(words)
    if not pieces or _PIECE.sub("", words).strip():
        raise OptionError(f"--budget {text}: write a time, for example 90s, 30min, 2h or 1h30min")
    return sum(float(number) * _SECONDS[unit[0]] for number, unit in pieces)
