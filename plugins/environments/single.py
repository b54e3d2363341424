"""Environments that are written in lanes, as `gymnasium.Env`s."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qrlsuite import options as option_words
from qrlsuite.environment import OneLane


class Single(OneLane):
    """One lane, whose arguments are the fields of a class of options."""

    def __init__(
        self,
        lanes: type[Any],
        options: type[Any],
        values: Mapping[str, Any],
        render_mode: str | None = None,
    ) -> None:
        super().__init__(lanes(option_words.build(options, values, f"environment '{lanes.name}'"), 1))
        self.render_mode = render_mode
