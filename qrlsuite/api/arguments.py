"""Arguments that several functions of the api take."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError

Seeds = int | str | Iterable[int]
"""100 (seeds 0 to 99), the seeds themselves, or text as on the command line: '0:20', '0,3,10:12'."""


def where_of(engine: str | Where, workers: int | None, device: str, same: str | None = None) -> Where:
    """Return where training is done."""
    if isinstance(engine, Where):
        if workers is not None or device != "cpu":
            raise OptionError("workers and device belong to an engine that is built already: give them there")
        return replace(engine, same=engine.same if same is None else same)
    check_positive("workers", workers)
    return replace(Where.create(engine, workers, device=device), same=same)


def check_positive(name: str, value: int | None) -> None:
    """Refuse all but whole numbers, 1 or more, and None."""
    if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
        raise OptionError(f"{name} = {value!r}: give a whole number, 1 or more")


def several(names: str | Sequence[str] | None) -> Sequence[str]:
    """Return names as a sequence."""
    return [names] if isinstance(names, str) else names or []
