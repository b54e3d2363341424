"""Samplers choose the order of settings. A sampler is fixed by its seed: a repeated search proposes equal settings.

`total` trials are proposed. A larger total begins with the same trials, except for a whole grid.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import pydantic

from qrlsuite import notation, options
from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.tuning.space import Dimension, Point, Space

NAMES = {
    "bayesian": "settings that may be the best by a smooth surrogate, until the expected regret is small",
    "grid": "every combination",
    "random": "combinations drawn at random, none twice",
}

REGRET = 0.05
"""The expected regret at which a `bayesian` search ends, unless told otherwise."""

LAST = 25
"""Seeds of each setting in the last round of a `bayesian` search, for each seed of a trial, unless told otherwise."""


@pydantic.dataclasses.dataclass(frozen=True)
class SamplerOptions:
    """Options of a sampler, written behind its name."""

    trials: Annotated[int | None, pydantic.Field(ge=1, le=100_000)] = None
    seed: Annotated[int, pydantic.Field(ge=0)] = 0
    regret: Annotated[float | None, pydantic.Field(gt=0, allow_inf_nan=False)] = None
    last: Annotated[int | None, pydantic.Field(ge=0, le=10_000)] = None


def read(text: str) -> tuple[str, SamplerOptions]:
    """Read a sampler with its options: `random trials=50 seed=1`; `bayesian`'s trials are per varied option."""
    name, values = notation.parse_named(text, "--sampler ")
    if name not in NAMES:
        raise UnknownNameError(f"unknown sampler '{name}'{nearest(name, NAMES)}")
    return name, options.build(SamplerOptions, values, f"sampler '{name}'")


def points(name: str, space: Space, trials: int | None, seed: int) -> list[Point]:
    """Return the settings to try, in their order, by `grid` or `random`.

    Parameters
    ----------
    trials:
        How many; None for a whole grid.
    """
    if name == "random":
        if trials is None:
            raise OptionError("--sampler random: write the number of settings to try, 'random trials=50'")
        return list(random_points(space, trials, seed))
    ranges = [dimension.name for dimension in space if dimension.range is not None]
    if ranges:
        raise OptionError(
            f"{ranges[0]} is a range, and sampler 'grid' needs a list: give a list, or use --sampler random"
        )
    if trials is not None and trials < size(space):
        raise OptionError(
            f"trials is for samplers that draw: --sampler 'random trials={trials}' takes as many of the {size(space)} "
            "combinations"
        )
    return list(product(space))


def size(space: Space) -> int:
    """Return the number of combinations; a range counts as one."""
    return math.prod(max(1, len(dimension.values)) for dimension in space)


def product(space: Space) -> Iterator[Point]:
    """Return every combination, the last option changing fastest."""
    for values in itertools.product(*(dimension.values for dimension in space)):
        yield {dimension.name: value for dimension, value in zip(space, values)}


def random_points(space: Space, trials: int, seed: int) -> Iterator[Point]:
    """Return distinct points drawn independently; fewer where a thousand draws in a row found no new one."""
    generator = np.random.Generator(np.random.Philox(key=seed))
    seen: dict[str, Point] = {}
    known = 0
    while len(seen) < trials and known < 1000:
        point = {dimension.name: _draw(dimension, generator) for dimension in space}
        known = known + 1 if repr(point) in seen else 0
        seen.setdefault(repr(point), point)
    yield from seen.values()


def _draw(dimension: Dimension, generator: np.random.Generator) -> Any:
    ends = dimension.range
    if ends is None:
        return dimension.values[int(generator.integers(len(dimension.values)))]
    if ends.integer and not ends.log:
        return int(generator.integers(int(ends.low), int(ends.high), endpoint=True))
    low, high = (math.log(ends.low), math.log(ends.high)) if ends.log else (ends.low, ends.high)
    value = float(generator.uniform(low, high))
    value = min(max(math.exp(value) if ends.log else value, ends.low), ends.high)
    return round(value) if ends.integer else _short(value)


def _short(value: float) -> float:
    """Round to four digits, so that a preset file can be read."""
    return float(f"{value:.4g}")
