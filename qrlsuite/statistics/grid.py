"""The (epsilon, delta) cells on which sample complexity is reported, in exact decimal arithmetic.

`1 - 0.85` is 0.15000000000000002 in floating point, and `0.7 * 100` rounds to a number above 70. A learning
curve that touches a threshold, or 70 of 100 runs, must not be lost to that. Epsilons, thresholds and deltas
are therefore read as the decimals that their author typed (12 significant digits) and only then rounded.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Context, Decimal, InvalidOperation
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_DIGITS = Context(prec=12)

Goal = Literal["above", "below"]
"""Which side of a threshold is the goal: `above` for scores and returns, `below` for regrets and costs."""


def whole(value: object, name: str, *, at_least: int) -> int:
    """Return an integer option as an `int`.

    Raises
    ------
    OptionError
        If it is not an integer, or smaller than `at_least`.
    """
    if isinstance(value, (bool, np.bool_)):
        raise OptionError(f"{name} = {value!r} is not an integer")
    try:
        number = operator.index(value)  # type: ignore[arg-type]  # anything may arrive here: that is the check
    except TypeError:
        raise OptionError(f"{name} = {value!r} is not an integer") from None
    if number < at_least:
        raise OptionError(f"{name} = {number} is smaller than {at_least}")
    return number


def exact(value: object, name: str) -> Decimal:
    """Return a number as the decimal its author typed, to 12 significant digits.

    A float32 is read by its own shortest form, so `numpy.float32(0.3)` means 0.3; the noise of
    `numpy.arange(0.3, 1, 0.1)` disappears in the rounding.

    Raises
    ------
    OptionError
        If it is not a finite number.
    """
    try:
        number = _DIGITS.create_decimal(str(value))
    except InvalidOperation:
        raise OptionError(f"{name} = {value!r} is not a number") from None
    if not number.is_finite():
        raise OptionError(f"{name} = {value!r} is not finite")
    return number


def settled(scores: ArrayLike) -> FloatArray:
    """Round scores to 7 decimals, and scores below 1e-4 to 7 digits: the noise of means of float32 scores disappears.

    A hundred float32 scores of 0.95 have the mean 0.949999988.

    >>> settled([0.949999988, 6 / 11, 2 / 3e9]).tolist()
    [0.95, 0.5454545, 6.666667e-10]
    """
    values = np.asarray(scores, dtype=np.float64)
    result: FloatArray = np.round(values, 7)
    small = (np.abs(values) < 1e-4) & (np.abs(values) > 1e-290)
    if small.any():
        # as text: powers of ten differ in the last bit from processor to processor
        result[small] = [float(f"{value:.6e}") for value in values[small].tolist()]
    return result


def _values(values: ArrayLike | Iterable[Any], name: str) -> list[Decimal]:
    """Read a non-empty one-dimensional list of numbers; a single number is a list of one."""
    if isinstance(values, np.ndarray) and values.ndim > 1:
        raise OptionError(f"{name}: expected a list of numbers, not an array of shape {values.shape}")
    if isinstance(values, np.ndarray) and values.ndim == 0:
        listed: list[Any] = [values[()]]
    elif isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        listed = [values]
    else:
        listed = list(values)
    if not listed:
        raise OptionError(f"{name}: the list is empty")
    numbers = [exact(value, f"{name}[{index}]") for index, value in enumerate(listed)]
    for index, number in enumerate(numbers):
        if len(set(numbers)) < len(numbers) and number in numbers[:index]:
            raise OptionError(f"{name}: {number} is there twice, and its cells would count twice")
    return numbers


@dataclass(frozen=True, slots=True)
class Grid:
    """E thresholds times D probabilities: the cells of a sample-complexity surface.

    Build it with `Grid.relative` (scores in [0, 1], known maximum) or `Grid.absolute` (any return).

    Attributes
    ----------
    thresholds:
        E values V*; a run has reached the goal at epoch t where V_t >= V*, or V_t <= V* if the goal is `below`. In the
        unit of the curves.
    deltas:
        D probabilities in (0, 1]: the fraction of runs that must have reached the goal.
    epsilons:
        E tolerances with V* = 1 - epsilon, or None in the general case.
    goal:
        The side of the thresholds where runs are to be.
    """

    thresholds: tuple[float, ...]
    deltas: tuple[Fraction, ...]
    epsilons: tuple[float, ...] | None = None
    goal: Goal = "above"

    @classmethod
    def relative(cls, epsilons: ArrayLike | Sequence[Any], deltas: ArrayLike | Sequence[Any]) -> Grid:
        """Return the grid of thresholds 1 - epsilon (paper, section "Sample Complexity Estimator").

        Raises
        ------
        OptionError
            If an epsilon is outside [0, 1) or a delta outside (0, 1], a number is there twice, or a list is empty.
        """
        tolerances = _values(epsilons, "epsilons")
        for epsilon in tolerances:
            if not 0 <= epsilon < 1:
                raise OptionError(f"epsilon = {epsilon} is outside [0, 1)")
        thresholds = tuple(float(1 - epsilon) for epsilon in tolerances)
        return cls(thresholds, _probabilities(deltas), tuple(float(epsilon) for epsilon in tolerances))

    @classmethod
    def absolute(
        cls,
        thresholds: ArrayLike | Sequence[Any],
        deltas: ArrayLike | Sequence[Any],
        goal: Goal = "above",
    ) -> Grid:
        """Return the grid of thresholds V* given directly (paper, appendix, "general case").

        Parameters
        ----------
        deltas:
            In (0, 1].
        goal:
            `above` if a run is there while V >= V*, `below` if it is while V <= V*.

        Raises
        ------
        OptionError
            If a threshold is not finite, a delta is outside (0, 1], a number is there twice, or a list is empty.
        """
        levels = tuple(float(level) for level in _values(thresholds, "thresholds"))
        return cls(levels, _probabilities(deltas), goal=goal)

    @property
    def before(self) -> str:
        """The side of a threshold on which a run has not reached it: `below`, or `above` if the goal is below."""
        return "below" if self.goal == "above" else "above"

    @property
    def is_relative(self) -> bool:
        """Whether thresholds are 1 - epsilon, and scores therefore in [0, 1]."""
        return self.epsilons is not None

    @property
    def levels(self) -> tuple[float, ...]:
        """The E epsilons of a relative grid, the E thresholds of an absolute one: how its rows are called."""
        return self.thresholds if self.epsilons is None else self.epsilons

    @property
    def level_name(self) -> str:
        """Kind of `levels`: `epsilon` or `threshold`."""
        return "threshold" if self.epsilons is None else "epsilon"

    @property
    def shape(self) -> tuple[int, int]:
        """(E, D)."""
        return len(self.thresholds), len(self.deltas)

    @property
    def size(self) -> int:
        """Number of cells, E x D."""
        return len(self.thresholds) * len(self.deltas)

    def required_counts(self, n_runs: int) -> IntArray:
        """Return, shape (D,), the count that a delta means: the smallest c with c / n_runs >= delta."""
        return np.array([math.ceil(delta * n_runs) for delta in self.deltas], dtype=np.int64)


def _probabilities(deltas: ArrayLike | Sequence[Any]) -> tuple[Fraction, ...]:
    values = _values(deltas, "deltas")
    for delta in values:
        if not 0 < delta <= 1:
            raise OptionError(f"delta = {delta} is outside (0, 1]")
    return tuple(Fraction(delta) for delta in values)
