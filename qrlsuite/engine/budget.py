"""The budget of a command: `30min` of time, or `2core-hours`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from qrlsuite.errors import OptionError

_PIECE = re.compile(r"(\d+(?:\.\d+)?|\.\d+)\s*(core-hours?|seconds?|sec|s|minutes?|min|m|hours?|h|days?|d)")
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


@dataclass(frozen=True)
class Budget:
    """Seconds of time, or core-hours; the other one is None."""

    time: float | None = None
    core_hours: float | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Read `90s`, `30min`, `8h`, `1h30min` or `2core-hours`."""
        pieces = _PIECE.findall(text.strip().lower())
        rest = _PIECE.sub("", text.strip().lower()).strip()
        cores = [float(number) for number, unit in pieces if unit.startswith("core")]
        amount = sum(
            float(number) * _SECONDS[unit[0]] for number, unit in pieces if not unit.startswith("core")
        )
        if rest or len(cores) + bool(amount) != 1 or not amount + sum(cores) > 0:
            raise OptionError(f"--budget {text}: write 90s, 30min, 8h, 1h30min or 2core-hours")
        return cls(None, cores[0]) if cores else cls(amount)

    def seconds(self, workers: int) -> float:
        """Return the time that so many workers may take."""
        return (self.core_hours or 0.0) * 3600 / workers if self.time is None else self.time


def seconds(text: str | None, workers: int) -> float | None:
    """Return the time that a budget gives so many workers; None for none."""
    return None if text is None else Budget.parse(text).seconds(workers)
