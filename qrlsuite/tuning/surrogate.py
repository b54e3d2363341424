"""Which settings to try next, and how much better than the best of them others may be.

Settings are places: numbers near [0, 1] that say where in its range each option lies. A Gaussian process (Rasmussen &
Williams 2006, chapter 2; by scikit-learn) describes the logarithm of the mean steps over places x:

    log mean steps at x = m + f(x),      f ~ GP(0, s^2 Matern_5/2(|x - x'| / l)),
    measured with n runs: that + error of variance v / n.

Prior: m is normal around the median of the measurements, with standard deviation 1; log s is normal around log 0.5
with 0.5, and the logarithm of each length l around log 0.7 with 0.7. s and l take their most probable posterior values.
Draws of f from the posterior answer two questions:

- *Regret*: exp(f(chosen) - min f) - 1 of a draw, the minimum over tried places and some hundred other places. Its
  mean over draws is the expected regret.
- *Next places*: the minima of draws (Thompson 1933), whether they were tried before or not. If places that train
  together must share some options, the first draws choose a few values of these options, and further draws have their
  minima among places with these values.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BATCH = 12
"""Places that are proposed at once."""

DESIGN = 4
"""Places for each varied option that are spread over the ranges before the surrogate proposes any."""

OUTER = 0.15
"""Share of a range at each end: it is extended where the best place lies there and none was tried beyond it."""

STEP = 0.25
"""A range is extended by this share of itself."""

NEAR = 0.03
"""A regret up to this share counts as none; its probability is stated."""

SPREAD = 0.28
"""Standard deviation of a run's steps in units of their mean, before runs show another: typical of beam6g."""

SPREAD_WEIGHT = 10
"""The runs that `SPREAD`, and then the spread of all settings, counts as for each setting."""

_LENGTH, _LENGTH_SPREAD, _SCALE, _SCALE_SPREAD = 0.7, 0.7, 0.5, 0.5
_DRAWS = 400
_ELSEWHERE = 256  # candidates anywhere in the ranges, and as many near the best places
_NEARBY = 8
_STEPS = (0.05, 0.15)


@dataclass(frozen=True)
class Regret:
    """How much longer than at the best settings learning takes at the chosen ones, as a share.

    Attributes
    ----------
    expected:
        0.05 for 5 percent more steps below threshold.
    low, high:
        Its 5th and 95th percentile.
    near:
        Probability that it is at most `NEAR`.
    """

    expected: float
    low: float
    high: float
    near: float


def regret_of(draws: Floats) -> Regret:
    """Return the mean and the percentiles of draws of a regret, as shares."""
    low, high = np.quantile(draws, (0.05, 0.95))
    return Regret(float(draws.mean()), float(low), float(high), float((draws <= NEAR).mean()))


def regret_among(means: Floats, spreads: Floats, counts: Floats) -> Regret:
    """Return the regret of the settings with the least mean among a few that were trained on seeds of their own.

    The logarithms of the means are normal, each with its standard error; see `variances` for the parameters, (K,).
    """
    generator = np.random.Generator(np.random.Philox(key=0))
    noise = generator.standard_normal((10_000, len(means))) * spreads / np.sqrt(counts)
    logs = np.log(means) + noise
    return regret_of(np.exp(logs[:, means.argmin()] - logs.min(axis=1)) - 1)


def variances(means: Floats, spreads: Floats, counts: Floats) -> Floats:
    """Return the variance of a run at each place, in units of the squared mean.

    The spread measured at a place is shrunk to the spread of the better half of all places, and that to `SPREAD`: at
    poor places all runs may end at the horizon, and show no spread.

    Parameters
    ----------
    means, spreads, counts:
        (P,): mean steps, standard deviation of a run in units of the mean, and number of runs.
    """
    better = means <= np.median(means)
    own, freedom = spreads**2 * (counts - 1), counts - 1
    pooled = (own[better].sum() + SPREAD_WEIGHT * SPREAD**2) / (freedom[better].sum() + SPREAD_WEIGHT)
    result: Floats = (own + SPREAD_WEIGHT * pooled) / (freedom + SPREAD_WEIGHT)
    return result


class Climb:
    """A search over places, whatever they stand for.

    Parameters
    ----------
    given:
        Places that are tried first, each (D,).
    snap:
        Returns the nearest place that can be tried.
    encode:
        Returns a place's coordinates for the surrogate: numbers that are near for options with like effects.
    extends:
        Tells whether option d may go on beyond its range, `low` and `high` in places.
    seed:
        Seed of all draws.
    shared:
        Options that make places cheaper to train together if they are equal: each `DESIGN` first places share them, and
        later batches have at most `BATCH` / `DESIGN` different values of them.

    Attributes
    ----------
    tried:
        Places in the order in which they were proposed.
    low, high:
        (D,): the searched range, at first 0 and 1.
    best:
        The chosen place: the one where the surrogate's mean is least.
    order:
        The measured places from best to worst.
    moved:
        Whether a range was extended after the last look.
    """

    def __init__(
        self,
        given: Sequence[Floats],
        snap: Callable[[Floats], Floats] = lambda place: place,
        encode: Callable[[Floats], Floats] = lambda place: place,
        extends: Callable[[int, float, float], bool] = lambda d, low, high: True,
        seed: int = 0,
        shared: Sequence[int] = (),
    ) -> None:
        self._snap, self._encode, self._extends, self._seed = snap, encode, extends, seed
        self.low, self.high = np.zeros(len(given[0])), np.ones(len(given[0]))
        self.tried: list[Floats] = []
        self.best, self.order, self.moved = 0, [0], False
        self.regret: Regret | None = None
        self._known: set[bytes] = set()
        self._rounds = 0
        self._wanted: list[int] = []
        spread = self._halton(DESIGN * len(self.low))
        self._shared = [*shared]
        spread[:, self._shared] = spread[np.arange(len(spread)) // DESIGN * DESIGN][:, self._shared]
        self._first = [place for place in (*given, *spread) if self._add(place) is not None]
        self._first_left = list(range(len(self.tried)))

    def _halton(self, count: int) -> Floats:
        from scipy.stats import qmc  # takes half a second to import

        sequence = qmc.Halton(len(self.low), scramble=False)
        sequence.fast_forward(1)  # the first place is a corner
        places: Floats = sequence.random(count)
        return places

    def _add(self, place: Floats) -> int | None:
        """Add a place to try and return its number; None if it is not new."""
        place = np.asarray(self._snap(place), np.float64)
        if place.tobytes() in self._known:
            return None
        self._known.add(place.tobytes())
        self.tried.append(place)
        return len(self.tried) - 1

    def next(self) -> list[int]:
        """Return the numbers of the places to be measured next, with more runs if they were before."""
        if self._first_left:
            self._wanted, self._first_left = self._first_left[:BATCH], self._first_left[BATCH:]
        return self._wanted

    def tell(self, numbers: Sequence[int], means: Floats, spreads: Floats, counts: Floats) -> None:
        """Take all that was measured, and look where to go.

        Parameters
        ----------
        numbers:
            Of the places, P of them.
        means, spreads, counts:
            As in `variances`.
        """
        from threadpoolctl import threadpool_limits  # comes with scikit-learn

        self._rounds += 1
        self.moved = False
        generator = np.random.Generator(np.random.Philox(key=self._seed * 2**32 + self._rounds))
        noise = variances(means, spreads, counts) / counts
        with threadpool_limits(1):  # matrices are small, and sums do not depend on a machine's cores
            surrogate = Surrogate(self._coordinates(numbers), np.log(means) + noise / 2, noise)
            self._look(numbers, surrogate, generator)
            if not self._first_left and self._extend(numbers):
                self.moved = True
                self._look(numbers, surrogate, generator)

    def _coordinates(self, numbers: Sequence[int]) -> Floats:
        return np.array([self._encode(self.tried[number]) for number in numbers])

    def _look(self, numbers: Sequence[int], surrogate: Surrogate, generator: np.random.Generator) -> None:
        """Choose, state the regret, and see which places come next."""
        at_tried = surrogate.means(self._coordinates(numbers))
        ranked = [numbers[i] for i in np.argsort(at_tried, kind="stable")]
        self.order, self.best = ranked, ranked[0]
        places, draws = self._draws(ranked, self._others(generator), surrogate, generator)
        self.regret = regret_of(np.exp(draws[0] - draws.min(axis=0)) - 1)
        self._wanted = []
        if self._first_left:
            return
        if self._shared:
            asked = (self._values(places[i]) for i in (0, *draws.argmin(axis=0)))
            values = [*dict.fromkeys(asked)][: BATCH // DESIGN]
            ranked = [number for number in ranked if self._values(self.tried[number]) in values]
            places, draws = self._draws(ranked, self._others(generator, values), surrogate, generator)
        for i in dict.fromkeys([0, *map(int, draws.argmin(axis=0)), *range(len(ranked))]):
            number = ranked[i] if i < len(ranked) else self._add(places[i])
            if number is not None and number not in self._wanted:
                self._wanted.append(number)
            if len(self._wanted) == BATCH:
                break

    def _draws(
        self,
        numbers: Sequence[int],
        others: Sequence[Floats],
        surrogate: Surrogate,
        generator: np.random.Generator,
    ) -> tuple[list[Floats], Floats]:
        """Return places, the numbered ones first, and the log steps at each in each draw."""
        places = [*(self.tried[number] for number in numbers), *others]
        return places, surrogate.draws(np.array([self._encode(place) for place in places]), generator)

    def _values(self, place: Floats) -> tuple[float, ...]:
        """Return the values that a place shares with others that are trained with it."""
        return tuple(np.round(place[self._shared], 9))

    def _others(
        self, generator: np.random.Generator, values: Sequence[tuple[float, ...]] = ()
    ) -> list[Floats]:
        """Return places that were not tried, anywhere in the ranges and near the best ones; with shared values."""
        size = len(self.low)
        anywhere = self.low + (self.high - self.low) * generator.random((_ELSEWHERE, size))
        centers = np.array([self.tried[number] for number in self.order[:_NEARBY]])
        near = centers[np.arange(_ELSEWHERE) % len(centers)]
        widths = np.array(_STEPS)[generator.integers(len(_STEPS), size=(_ELSEWHERE, 1))]
        near = np.clip(near + widths * generator.standard_normal((_ELSEWHERE, size)), self.low, self.high)
        both = np.concatenate([anywhere, near])
        if values:
            both[:, self._shared] = np.array(values)[generator.integers(len(values), size=len(both))]
        snapped = [np.asarray(self._snap(place), np.float64) for place in both]
        distinct = {place.tobytes(): place for place in snapped if place.tobytes() not in self._known}
        return list(distinct.values())

    def edges(self, numbers: Sequence[int]) -> list[tuple[int, int]]:
        """Return the options whose best value is the lowest (-1) or highest (1) that was tried."""
        measured = np.array([self.tried[number] for number in numbers])
        best = self.tried[self.best]
        least, most = best <= measured.min(axis=0), best >= measured.max(axis=0)
        return [(d, 1 if most[d] else -1) for d in range(len(best)) if least[d] != most[d]]

    def _extend(self, numbers: Sequence[int]) -> bool:
        """Extend the ranges at whose ends the best place lies; returns whether there are any."""
        extended = False
        for d, side in self.edges(numbers):
            low, high, at = self.low[d], self.high[d], self.tried[self.best][d]
            further = (low - STEP, high) if side < 0 else (low, high + STEP)
            if (at < low + OUTER if side < 0 else at > high - OUTER) and self._extends(d, *further):
                self.low[d], self.high[d] = further
                extended = True
        return extended


class Surrogate:
    """The process of the module after log steps (P,) at places (P, K), measured with variances (P,)."""

    def __init__(self, places: Floats, values: Floats, noise: Floats) -> None:
        from sklearn.gaussian_process import GaussianProcessRegressor  # takes a second to import
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern

        size, bounds = places.shape[1], (1e-5, 1e5)
        kernel = ConstantKernel(_SCALE**2, bounds) * Matern([_LENGTH] * size, bounds, nu=2.5)
        kernel += ConstantKernel(1.0, "fixed")
        center = np.array([2 * math.log(_SCALE), *[math.log(_LENGTH)] * size])
        width = np.array([2 * _SCALE_SPREAD, *[_LENGTH_SPREAD] * size])
        optimizer = functools.partial(_most_probable, center=center, width=width)
        process = GaussianProcessRegressor(kernel, alpha=noise + 1e-8, optimizer=optimizer)
        self._middle = float(np.median(values))
        self._process = process.fit(places, values - self._middle)

    def means(self, places: Floats) -> Floats:
        """Return the mean of the log steps at places (P, K), (P,)."""
        return np.asarray(self._process.predict(places), np.float64) + self._middle

    def draws(self, places: Floats, generator: np.random.Generator) -> Floats:
        """Return draws of the log steps from the posterior, (P, draws)."""
        from scipy import linalg

        mean, covariance = self._process.predict(places, return_cov=True)
        factor = linalg.cholesky(covariance + 1e-6 * np.eye(len(places)), lower=True)
        noise = factor @ generator.standard_normal((len(places), _DRAWS))
        result: Floats = mean[:, None] + noise + self._middle
        return result


def _most_probable(
    objective: Callable[[Floats], tuple[float, Floats]],
    start: Floats,
    bounds: Floats,
    center: Floats,
    width: Floats,
) -> tuple[Floats, float]:
    """Return the logarithms of scale and lengths at which likelihood times prior is largest; for scikit-learn."""
    from scipy import optimize

    def penalized(theta: Any) -> tuple[float, Floats]:
        value, gradient = objective(theta)
        away = (theta - center) / width
        return value + 0.5 * float(away @ away), gradient + away / width

    limits = [(float(low), float(high)) for low, high in bounds]
    found = optimize.minimize(
        penalized, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 60}
    )
    return found.x, float(found.fun)
