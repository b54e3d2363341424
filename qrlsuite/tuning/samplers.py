"""Samplers choose the order of settings. A sampler is fixed by its seed: a repeated search proposes equal settings.

`total` trials are proposed. A larger total begins with the same trials, except for a whole grid.
"""

from __future__ import annotations

import importlib.util
import itertools
import math
from collections.abc import Iterator
from typing import Annotated, Any, Protocol

import numpy as np
import pydantic

from qrlsuite import notation, options
from qrlsuite.errors import OptionError, QrlSuiteError, UnknownNameError, nearest
from qrlsuite.tuning.space import Dimension, Point, Space

NAMES = {
    "bayesian": "settings that may be the best by a smooth surrogate, until the expected regret is small",
    "grid": "every combination",
    "one-at-a-time": "each option through its values, the others untuned",
    "random": "combinations drawn at random, none twice",
    "tpe": "proposals of Optuna's tree-structured Parzen estimator, after earlier trials",
}

REGRET = 0.05
"""The expected regret at which a `bayesian` search ends, unless told otherwise."""


@pydantic.dataclasses.dataclass(frozen=True)
class SamplerOptions:
    """Options of a sampler, written behind its name."""

    trials: Annotated[int | None, pydantic.Field(ge=1, le=100_000)] = None
    seed: Annotated[int, pydantic.Field(ge=0)] = 0
    regret: Annotated[float | None, pydantic.Field(gt=0, allow_inf_nan=False)] = None


def read(text: str) -> tuple[str, SamplerOptions]:
    """Read a sampler with its options: `random trials=50 seed=1`; `bayesian`'s trials are per varied option."""
    name, values = notation.parse_named(text, "--sampler ")
    if name not in NAMES:
        raise UnknownNameError(f"unknown sampler '{name}'{nearest(name, NAMES)}")
    return name, options.build(SamplerOptions, values, f"sampler '{name}'")


class Sampler(Protocol):
    """Proposes points one by one."""

    total: int
    """How many points there will be."""
    adaptive: bool
    """Whether a proposal depends on the values of earlier trials."""

    def ask(self) -> Point:
        """Return the next point."""

    def tell(self, value: float) -> None:
        """Take the value, to be minimized, of the point asked for last."""


def create(name: str, space: Space, trials: int | None, seed: int, base: Point) -> Sampler:
    """Build a sampler.

    Parameters
    ----------
    trials:
        How many points to propose; None for all, which only a grid and `one-at-a-time` have.
    base:
        The point of settings without tuning, from which `one-at-a-time` starts.
    """
    if name not in NAMES or name == "bayesian":  # which is a search of its own, and goes back to known points
        raise UnknownNameError(f"unknown sampler '{name}'{nearest(name, NAMES)}")
    ranges = [dimension.name for dimension in space if dimension.range is not None]
    if name in ("grid", "one-at-a-time"):
        if ranges:
            raise OptionError(
                f"{ranges[0]} is a range, which sampler '{name}' cannot go through: give a list, or use "
                "--sampler random or tpe"
            )
        if trials is not None and not (name == "grid" and trials >= size(space)):
            raise OptionError(
                f"trials is for samplers that draw: --sampler 'random trials={trials}' takes as many of the "
                f"{size(space)} combinations"
            )
        return Listed(product(space) if name == "grid" else one_at_a_time(space, base))
    if trials is None:
        raise OptionError(f"--sampler {name}: write the number of settings to try, '{name} trials=50'")
    if name == "random":
        return Listed(random_points(space, trials, seed))
    return Tpe(space, trials, seed)


def size(space: Space) -> int:
    """Return the number of combinations; a range counts as one."""
    return math.prod(max(1, len(dimension.values)) for dimension in space)


def product(space: Space) -> Iterator[Point]:
    """Return every combination, the last option changing fastest."""
    for values in itertools.product(*(dimension.values for dimension in space)):
        yield {dimension.name: value for dimension, value in zip(space, values)}


def one_at_a_time(space: Space, base: Point) -> Iterator[Point]:
    """Return the base, then each option's other values in turn."""
    yield dict(base)
    for dimension in space:
        for value in dimension.values:
            if value != base[dimension.name]:
                yield {**base, dimension.name: value}


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


class Listed:
    """A list of points, fixed beforehand."""

    adaptive = False

    def __init__(self, points: Iterator[Point]) -> None:
        self._points = list(points)
        self._next = 0
        self.total = len(self._points)

    def ask(self) -> Point:
        """Return the next point."""
        self._next += 1
        return dict(self._points[self._next - 1])

    def tell(self, value: float) -> None:
        """Do nothing: the points do not depend on values."""


class Tpe:
    """Optuna's tree-structured Parzen estimator (Bergstra et al. 2011), with a fixed seed.

    The study lives in memory. A repeated search asks and tells in the same order, and so replays it: only the runs
    are stored.
    """

    adaptive = True

    def __init__(self, space: Space, trials: int, seed: int) -> None:
        if importlib.util.find_spec("optuna") is None:
            raise QrlSuiteError("--sampler tpe needs the package 'optuna': pip install 'qrlsuite[tune]'")
        import optuna  # an extra, which other samplers do without

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.space, self.total = space, trials
        self._study = optuna.create_study(
            direction="minimize", sampler=optuna.samplers.TPESampler(seed=seed % 2**32)
        )
        self._distributions = {dimension.name: self._distribution(dimension) for dimension in space}
        self._trial: Any = None

    def _distribution(self, dimension: Dimension) -> Any:
        from optuna import distributions  # as above

        ends = dimension.range
        if ends is None:  # by position: values may be lists, which Optuna does not take
            return distributions.CategoricalDistribution(tuple(range(len(dimension.values))))
        if ends.integer:
            return distributions.IntDistribution(int(ends.low), int(ends.high), log=ends.log)
        return distributions.FloatDistribution(float(ends.low), float(ends.high), log=ends.log)

    def ask(self) -> Point:
        """Return the next point."""
        self._trial = self._study.ask(self._distributions)
        point = {}
        for dimension in self.space:
            value = self._trial.params[dimension.name]
            if dimension.range is None:
                value = dimension.values[value]
            elif isinstance(value, float):
                value = min(max(_short(value), dimension.range.low), dimension.range.high)
            point[dimension.name] = value
        return point

    def tell(self, value: float) -> None:
        """Take the value of the point asked for last."""
        self._study.tell(self._trial, value)
