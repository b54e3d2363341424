"""Rules that decide, cell by cell, whether one entry needs significantly fewer samples than another.

A rule is called with two `Evidence` objects, which are already cut to a common horizon and resampled at a
common number of runs, and returns +1 where the first entry needs significantly fewer samples, -1 where it
needs significantly more and 0 elsewhere. What follows from the cells (outperformance, ranking) is the same
for every rule, see `qrlsuite.statistics.compare`.

Two rules are built in:

- `IntervalRule`, the paper's: the 5th to 95th percentile intervals do not overlap. A promise per cell only.
- `DifferenceRule`: a bootstrap of the difference of both sample complexities with one critical value for
  the whole grid (the maximum over the cells of the studentized deviation), which controls the probability
  that *any* cell of two equal entries is declared different.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

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
from qrlsuite.statistics.grid import BoolArray, FloatArray, Grid, IntArray, whole

Signs = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Resampling:
    """How runs are redrawn.

    Attributes
    ----------
    n_resamples:
        Number of resamples R behind an interval; a rule may draw more, see `Evidence.draws`.
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


@dataclass(frozen=True, eq=False, slots=True)
class Draws:
    """S_hat of R resamples of an entry.

    Attributes
    ----------
    epochs:
        Shape (E, D, R), unsigned whole epochs.
    mean, variance:
        Shape (E, D), over the resamples, in epochs and epochs squared.
    """

    epochs: NDArray[np.unsignedinteger[Any]]
    mean: FloatArray
    variance: FloatArray


class Evidence:
    """What a rule may know about one entry of a pair; computed when first asked for.

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
        self._draws: dict[int, Draws] = {}
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
        return self._draw(self.resampling.n_resamples)

    def draws(self, n_resamples: int) -> Draws:
        """Return S_hat of so many resamples, for a rule that needs another number than an interval; kept.

        Parameters
        ----------
        n_resamples:
            Number of resamples R, drawn from the same seed as those of the interval.

        Raises
        ------
        OptionError
            If it is not a positive integer.
        """
        if n_resamples not in self._draws:
            drawn = (
                self.epoch_draws if n_resamples == self.resampling.n_resamples else self._draw(n_resamples)
            )
            # in whole epochs of a small type: a board of 500 entries keeps 10,000 draws of each
            small = drawn.astype(np.min_scalar_type(self.entry.values.shape[1]))
            mean, variance = drawn.mean(axis=2, dtype=np.float64), drawn.var(axis=2, dtype=np.float64)
            self._draws[n_resamples] = Draws(small, mean, variance)
        return self._draws[n_resamples]

    @functools.cached_property
    def point(self) -> FloatArray:
        """The estimate in environment steps, shape (E, D).

        S_hat where `n_runs` is all the entry has; else the median of `epoch_draws`, because S_hat at another
        number of runs is another quantity.
        """
        if self.n_runs == self.entry.n_runs:
            return complexity(self.entry.values, self.grid, self.steps_per_epoch).astype(np.float64)
        return (
            central_epochs(self.entry.values, self.grid, self.epoch_draws, self.n_runs) * self.steps_per_epoch
        )

    def interval(self, percentiles: tuple[float, float] = PERCENTILES) -> FloatArray:
        """Return the percentile interval in steps, widened to contain `point`, shape (E, D, 2)."""
        key = check_percentiles(percentiles)
        if key not in self._intervals:
            # on a board of hundreds the draws of an entry are not kept unless a rule asks for them
            drawn = (
                self.epoch_draws
                if "epoch_draws" in self.__dict__
                else self._draw(self.resampling.n_resamples)
            )
            center = central_epochs(self.entry.values, self.grid, drawn, self.n_runs)
            self._intervals[key] = widened_percentiles(drawn, center, key, self.steps_per_epoch)
        return self._intervals[key]

    def _draw(self, n_resamples: int) -> NDArray[np.int32]:
        return draw_epochs(self.entry.values, self.grid, n_resamples, self.resampling.seed, self.n_runs)


@runtime_checkable
class SignificanceRule(Protocol):
    """A rule for one pair of entries; register one with the hook `register_rules`.

    A rule must be antisymmetric: `rule(a, b) == -rule(b, a)`. A rule that can judge one entry against many
    at once may also have a method `against(first, others) -> (M, E, D)`; boards use it where it exists. A rule
    whose attribute `paired` is true takes run i of both entries to belong together.

    >>> class HalfRule:
    ...     name = "half"
    ...     promise = "none: whoever needs less than half is declared the winner"
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
        """What the rule controls."""
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


@dataclass(frozen=True, slots=True)
class DifferenceRule:
    """Significant where the difference of sample complexities exceeds one critical value for the whole grid.

    With D the difference of both estimates in a cell, D* its bootstrap draws, m their mean and s their standard
    deviation, the critical value q is the (1 - alpha) quantile over the draws of max over cells |D* - m| / s,
    and a cell is significant where |D| / s > q (single-step max-T; Westfall and Young 1993; studentized
    simultaneous bands). One critical value accounts for the number of cells and for their strong dependence.

    The draws are centered on their own mean, and not on D: resampling shifts S_hat (it is biased at few runs),
    and between equal entries that shift cancels. Centered on D, the simulated error rate was 1 to 2 percent
    for alpha = 5 percent, at the cost of power; centered on m it is about alpha (docs/statistics.md).

    S_hat is a whole number of epochs: s includes that rounding (1/12 of the coarser epoch squared), so it is
    never zero, and a difference of less than one epoch of the coarser entry is never significant.

    Attributes
    ----------
    alpha:
        Probability, for two equal entries, that any cell of the grid is declared different (approximate: the
        bootstrap is valid for many runs).
    paired:
        Whether run i of both entries belongs together (same seed, same validation episodes): both are then
        resampled by the same runs. The entries must have the same number of runs, in the same order.
    n_resamples:
        Number of resamples R. With 1000 the critical value, and with it a narrow verdict, depends on the seed of
        the resampling; with 10,000 hardly.
    """

    alpha: float = 0.05
    paired: bool = False
    n_resamples: int = 10_000

    def __post_init__(self) -> None:
        whole(self.n_resamples, "n_resamples", at_least=2)
        if not 0 < self.alpha < 1:
            raise OptionError(f"alpha = {self.alpha!r} is outside (0, 1)")

    @property
    def name(self) -> str:
        """The rule's name."""
        return "difference-paired" if self.paired else "difference"

    @property
    def promise(self) -> str:
        """What the rule controls."""
        return (
            f"the whole grid of one pair: two equal entries differ significantly in any cell with "
            f"probability about {self.alpha:g}; not the whole board of many pairs"
        )

    def __call__(self, first: Evidence, second: Evidence) -> Signs:
        """Return the sign of every cell, shape (E, D).

        Raises
        ------
        OptionError
            If `paired` and the entries differ in their number of runs or their resampling.
        """
        own, theirs = first.draws(self.n_resamples), second.draws(self.n_resamples)
        others = theirs.epochs
        mine, yours = first.steps_per_epoch, second.steps_per_epoch
        if self.paired:
            same = first.entry.n_runs == second.entry.n_runs and first.resampling == second.resampling
            if not same:
                names = " and ".join(f"'{e.entry.name}' ({e.entry.n_runs} runs)" for e in (first, second))
                raise OptionError(f"{names} cannot be paired: run i of both must belong together")
        else:
            # One seed resamples both entries, so draw r of one goes with draw R-1-r of the other, which is
            # independent of it (but for the middle one of an odd number). The order is an involution: swapping
            # the entries changes the signs and nothing else.
            others = others[..., ::-1]
        resolution = max(mine, yours)
        observed = first.point - second.point
        center = own.mean * mine - theirs.mean * yours
        variance = own.variance * mine**2 + theirs.variance * yours**2
        largest = np.zeros(self.n_resamples, dtype=np.float32)
        spread = np.empty(first.grid.shape)
        for cell in np.ndindex(*first.grid.shape):  # one cell's draws at a time stay in the cache
            # float32 halves the time; steps are whole numbers, exact up to 2^24 and good to 1e-7 beyond
            difference = own.epochs[cell].astype(np.float32) * np.float32(mine)
            difference -= others[cell].astype(np.float32) * np.float32(yours)
            total = difference.var(dtype=np.float64) if self.paired else variance[cell]
            spread[cell] = np.sqrt(total + resolution**2 / 12)
            if not variance[cell]:
                continue  # every draw of both is its mean, as where both are at the cap
            difference -= np.float32(center[cell])
            np.abs(difference, out=difference)
            difference /= np.float32(spread[cell])
            np.maximum(largest, difference, out=largest)
        critical = float(np.quantile(largest, 1 - self.alpha))
        significant: BoolArray = (np.abs(observed) / spread > critical) & (np.abs(observed) >= resolution)
        signs: Signs = np.where(significant, -np.sign(observed), 0).astype(np.int8)
        return signs


def paired_difference_rule() -> DifferenceRule:
    """Return `DifferenceRule(paired=True)`, as a factory that a registration can refer to by name."""
    return DifferenceRule(paired=True)


def check_signs(signs: object, shape: tuple[int, ...], rule: SignificanceRule) -> IntArray:
    """Return what a rule answered as integers, or raise OptionError if it is not -1, 0 or 1 in every cell."""
    array = np.asarray(signs)
    if array.shape != shape or not np.isin(array, (-1, 0, 1)).all():
        raise OptionError(
            f"rule '{rule.name}' must answer -1, 0 or 1 in an array of shape {shape}; "
            f"it answered {array.dtype} of shape {array.shape}"
        )
    return array.astype(np.int64)
