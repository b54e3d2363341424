"""Rules that decide, cell by cell, whether one entry needs significantly fewer samples than another.

A rule is called with two `Evidence` objects, which are already cut to a common horizon and resampled at a
common number of runs, and returns +1 where the first entry needs significantly fewer samples, -1 where it
needs significantly more and 0 elsewhere. Outperformance and ranking follow from the cells in one way for every
rule, see `qrlsuite.statistics.compare`.

Here is the paper's, `IntervalRule`: the 5th to 95th percentile intervals do not overlap. Rules for steps below
threshold are in `qrlsuite.statistics.permutation`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.bootstrap import (
    PERCENTILES,
    RESAMPLES,
    central_epochs,
    check_percentiles,
    draw_epochs,
    widened_percentiles,
)
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.estimator import complexity
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, whole

Signs = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Resampling:
    """How runs are redrawn.

    Attributes
    ----------
    n_resamples:
        Number of resamples R behind an interval.
    seed:
        Every entry is resampled from this seed, so its interval does not depend on whom it is compared with.

    Raises
    ------
    OptionError
        If one of them is not an integer in its range.
    """

    n_resamples: int = RESAMPLES
    seed: int = 0

    def __post_init__(self) -> None:
        whole(self.n_resamples, "n_resamples", at_least=1)
        whole(self.seed, "seed", at_least=0)


class Evidence:
    """The facts that a rule may use about one entry of a pair; computed at the first use.

    Parameters
    ----------
    entry:
        The entry, already cut to the common horizon.
    grid:
        The E x D cells.
    n_runs:
        Runs per resample: the smaller number of runs of the pair.
    resampling:
        Number of resamples and seed.

    Raises
    ------
    OptionError
        If the entry has fewer than `n_runs` runs, or the grid is relative and a score lies outside [0, 1].
    """

    def __init__(
        self, entry: LearningCurves, grid: Grid, n_runs: int, resampling: Resampling | None = None
    ) -> None:
        self.entry = entry
        self.grid = grid
        self.n_runs = whole(n_runs, "n_runs", at_least=1)
        self.resampling = resampling or Resampling()
        self._intervals: dict[tuple[float, float], FloatArray] = {}
        self._center: FloatArray | None = None
        if grid.epsilons is not None:
            entry.require_unit_interval()
        if n_runs > entry.n_runs:
            raise OptionError(f"'{entry.name}' has {entry.n_runs} runs, not {n_runs}")

    @property
    def steps_per_epoch(self) -> int:
        """Environment steps per epoch: the resolution of every number below."""
        return self.entry.steps_per_epoch

    @functools.cached_property
    def epoch_draws(self) -> NDArray[np.int32]:
        """S_hat of every resample in epochs, shape (E, D, R)."""
        return self._draw()

    @property
    def point(self) -> FloatArray:
        """The estimate in environment steps, shape (E, D).

        S_hat where `n_runs` is all the entry has; else the median of `epoch_draws`, because S_hat at another
        number of runs is another quantity.
        """
        if self._center is None and self.n_runs == self.entry.n_runs:
            return complexity(self.entry.values, self.grid, self.steps_per_epoch).astype(np.float64)
        if self._center is None:
            self.interval()
        assert self._center is not None
        return self._center * self.steps_per_epoch

    def interval(self, percentiles: tuple[float, float] = PERCENTILES) -> FloatArray:
        """Return the percentile interval in steps, widened to contain `point`, shape (E, D, 2)."""
        key = check_percentiles(percentiles)
        if key not in self._intervals:
            # on a board of hundreds the draws of an entry are not kept unless a rule asks for them
            drawn = self.epoch_draws if "epoch_draws" in self.__dict__ else self._draw()
            self._center = central_epochs(self.entry.values, self.grid, drawn, self.n_runs)
            self._intervals[key] = widened_percentiles(drawn, self._center, key, self.steps_per_epoch)
        return self._intervals[key]

    def _draw(self) -> NDArray[np.int32]:
        chosen = self.resampling
        return draw_epochs(self.entry.values, self.grid, chosen.n_resamples, chosen.seed, self.n_runs)


@runtime_checkable
class SignificanceRule(Protocol):
    """A rule for one pair of entries; register one with the hook `register_rules`.

    A rule must be antisymmetric: `rule(a, b) == -rule(b, a)`. A rule that can judge one entry against many
    at once may also have a method `against(first, others) -> (M, E, D)`; boards use it where it exists.

    >>> class HalfRule:
    ...     name = "half"
    ...     promise = "none: an entry that needs less than half is the winner"
    ...
    ...     def __call__(self, first, second):
    ...         fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
    ...         return fewer.astype("int8") - more.astype("int8")
    >>> isinstance(HalfRule(), SignificanceRule)
    True
    """

    @property
    def name(self) -> str:
        """A short name, for options and tables."""

    @property
    def promise(self) -> str:
        """One sentence: which error probability the rule controls, and which it does not."""

    def __call__(self, first: Evidence, second: Evidence) -> Signs:
        """Return, shape (E, D), +1 where `first` needs significantly fewer samples, -1 where more, else 0."""


@dataclass(frozen=True, slots=True)
class IntervalRule:
    """The paper's rule: significant where the two percentile intervals do not overlap; touching overlaps.

    Source: paper, definition "Significant Outperformance" and the paragraph below it.

    Attributes
    ----------
    percentiles:
        Lower and upper percentile of both intervals.
    """

    percentiles: tuple[float, float] = PERCENTILES

    def __post_init__(self) -> None:
        check_percentiles(self.percentiles)

    @property
    def name(self) -> str:
        """The rule's name."""
        return "intervals"

    @property
    def promise(self) -> str:
        """The error probability that the rule controls."""
        return (
            "each cell by itself: two equal entries rarely have disjoint intervals in a given cell; "
            "the chance of a false difference somewhere on the grid grows with the number of cells"
        )

    def __call__(self, first: Evidence, second: Evidence) -> Signs:
        """Return the sign of every cell, shape (E, D)."""
        signs: Signs = self.against(first, [second])[0]
        return signs

    def against(self, first: Evidence, others: Sequence[Evidence]) -> Signs:
        """Return the signs of one entry against M others, shape (M, E, D)."""
        own = first.interval(self.percentiles)
        theirs = np.stack([other.interval(self.percentiles) for other in others])
        fewer = own[..., 1] < theirs[..., 0]
        more = own[..., 0] > theirs[..., 1]
        return fewer.astype(np.int8) - more.astype(np.int8)


def check_signs(signs: object, shape: tuple[int, ...], rule: SignificanceRule) -> IntArray:
    """Return a rule's answer as integers, or raise OptionError if it is not -1, 0 or 1 in every cell."""
    array = np.asarray(signs)
    if array.shape != shape or not np.isin(array, (-1, 0, 1)).all():
        raise OptionError(
            f"rule '{rule.name}' must answer -1, 0 or 1 in an array of shape {shape}; "
            f"it answered {array.dtype} of shape {array.shape}"
        )
    return array.astype(np.int64)
