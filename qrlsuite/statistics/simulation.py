"""Simulated runs that resemble an entry's, to compute how often a comparison or a design finds a difference.

`SmoothedRuns` draws independent runs from a smoothed model of an entry's curves, at any number of runs. `judge_steps`
returns the findings of rule `steps` in many pairs, and `decision_rates` plays whole sequential designs. Error rates of
other rules are measured in `benchmarks/simulated.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from qrlsuite.errors import OptionError
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, whole
from qrlsuite.statistics.permutation import MaxT, relabelings_for, with_half_epoch
from qrlsuite.statistics.sequential import Decided, SequentialDesign, begin, judged_numbers, next_look
from qrlsuite.statistics.times import times_below

_DRAWN = 5_000  # runs that are drawn at a time


class SmoothedRuns:
    """Independent runs that resemble an entry's: a smoothed bootstrap of whole curves.

    A drawn run is V = mean + (V_i - mean + h Z) / sqrt(1 + h^2), with i one of the entry's N runs at random
    and Z a Gaussian curve with the entry's covariance between epochs, drawn as a random combination of the
    centered runs. Jitter is thus as smooth in time as the runs themselves, and mean and covariance do not
    change (Silverman and Young 1987: shrunken smoothed bootstrap). Clipped to `bounds`.

    Without jitter (h = 0) draws repeat the N runs, and tie far more often than new runs would. The Gaussian
    part fills gaps between distinct groups of runs (some learn, some do not) as h grows.

    Parameters
    ----------
    jitter:
        h, relative to the spread of the runs.
    bounds:
        Lowest and highest possible score; None for returns without known bounds.

    Raises
    ------
    OptionError
        If the entry has a single run or a value that is not finite, `jitter` is negative, or the bounds are
        not in order.
    """

    def __init__(
        self,
        entry: LearningCurves,
        jitter: float = 0.3,
        bounds: tuple[float, float] | None = (0.0, 1.0),
    ) -> None:
        if entry.n_runs < 2:
            raise OptionError(f"'{entry.name}' has a single run: there is no spread to draw from")
        if not np.isfinite(entry.values).all():
            raise OptionError(f"'{entry.name}' has infinite values: they cannot be smoothed")
        if not 0 <= jitter < np.inf:
            raise OptionError(f"jitter = {jitter!r} is not a finite number >= 0")
        if bounds is not None and not bounds[0] < bounds[1]:
            raise OptionError(f"bounds = {bounds!r} are not in order")
        self.entry = entry
        self.jitter = float(jitter)
        self.bounds = bounds
        self._mean: FloatArray = entry.values.mean(axis=0, dtype=np.float64)
        self._centered: FloatArray = entry.values.astype(np.float64) - self._mean

    def draw(self, n_runs: int, generator: np.random.Generator) -> LearningCurves:
        """Return `n_runs` independent runs under the entry's name."""
        count, available = whole(n_runs, "n_runs", at_least=1), self.entry.n_runs
        chosen = self._centered[generator.integers(0, available, size=count)]
        mixture = generator.standard_normal((count, available)) / np.sqrt(available)
        # einsum and not BLAS: the same sum on every machine and number of threads
        jitter = self.jitter * np.einsum("ij,jt->it", mixture, self._centered)
        curves = self._mean + (chosen + jitter) / np.hypot(1, self.jitter)
        if self.bounds is not None:
            curves = np.clip(curves, *self.bounds)
        return LearningCurves(curves, self.entry.steps_per_epoch, self.entry.name)


def slower(entry: LearningCurves, factor: float) -> LearningCurves:
    """Return runs that take `factor` >= 1 times as long to reach each score: an entry known to be worse, for `power`.

    A run's value after epoch t is the original's after epoch t / factor, between epochs interpolated linearly,
    before the first the first.

    Raises
    ------
    OptionError
        If the factor is below 1.
    """
    if not 1 <= factor < np.inf:
        raise OptionError(f"factor = {factor!r} is not a finite number >= 1")
    epochs = np.arange(1, entry.values.shape[1] + 1)
    values = np.array([np.interp(epochs / factor, epochs, run) for run in entry.values])
    return LearningCurves(values, entry.steps_per_epoch, f"{entry.name}, {factor:g} times slower")


def draw_times(
    model: SmoothedRuns, n_runs: int, n_entries: int, grid: Grid, generator: np.random.Generator
) -> IntArray:
    """Return the steps below threshold of independent entries, shape (n_entries, n_runs, E)."""
    entries, runs = whole(n_entries, "n_entries", at_least=1), whole(n_runs, "n_runs", at_least=1)
    drawn = []
    for done in range(0, entries * runs, _DRAWN):
        part = model.draw(min(_DRAWN, entries * runs - done), generator)
        drawn.append(times_below(part.values, grid, part.steps_per_epoch))
    return np.concatenate(drawn).reshape(entries, runs, -1)


def draw_steps(
    model: SmoothedRuns, n_runs: int, n_entries: int, grid: Grid, generator: np.random.Generator
) -> IntArray:
    """Return what rule `steps` judges of independent entries, shape (n_entries, n_runs, 1): one number per run."""
    times = draw_times(model, n_runs, n_entries, grid, generator)
    return np.asarray(with_half_epoch(times, model.entry.steps_per_epoch).sum(axis=2, keepdims=True))


@dataclass(frozen=True, slots=True)
class StepsRates:
    """Fractions of many simulated pairs in which rule `steps` finds that the first or the second needs fewer steps."""

    first: float
    second: float

    @property
    def found(self) -> float:
        """Fraction of pairs with a difference: the error between equals."""
        return self.first + self.second


def judge_steps(ours: IntArray, theirs: IntArray, alpha: float = 0.05) -> StepsRates:
    """Return the findings of rule `steps` in P pairs of one number per run, (P, N_A, 1) and (P, N_B, 1)."""
    test = MaxT(list(zip(ours, theirs)), ratio=True)
    test.extend(relabelings_for(alpha))
    signs = np.where(test.p <= alpha, np.sign(test.t[:, 0]), 0)
    return StepsRates(float((signs > 0).mean()), float((signs < 0).mean()))


@dataclass(frozen=True, slots=True)
class DecisionRates:
    """Rates of a sequential design's decisions, over many simulated studies.

    Attributes
    ----------
    verdicts:
        For each pair of the design: fraction of studies with each verdict.
    within_margin:
        For each pair: fraction of studies that found the difference within the margin, of either verdict.
    mean_runs:
        For each pair: mean number of runs per entry when it was closed.
    any_difference:
        Fraction of studies in which any pair was found to differ: the error between equals.
    """

    n_studies: int
    verdicts: tuple[dict[Decided, float], ...]
    within_margin: tuple[float, ...]
    mean_runs: tuple[float, ...]
    any_difference: float


def decision_rates(
    models: Sequence[SmoothedRuns],
    design: SequentialDesign,
    grid: Grid,
    n_studies: int = 200,
    seed: int = 0,
    tick: Callable[[], object] | None = None,
) -> DecisionRates:
    """Play a sequential design many times, its entries drawn from as many models, in the design's order.

    All studies are played together; `tick` is called for each of them at the end.

    Raises
    ------
    OptionError
        If there are not as many models as entries, or an argument is out of its range.
    """
    if len(models) != len(design.entries):
        raise OptionError(f"{len(models)} models for the {len(design.entries)} entries of the design")
    generator = np.random.default_rng(whole(seed, "seed", at_least=0))
    count = whole(n_studies, "n_studies", at_least=1)
    epoch = max(model.entry.steps_per_epoch for model in models)
    drawn = [
        judged_numbers(design, draw_times(model, design.looks[-1], count, grid, generator), epoch)
        for model in models
    ]
    rates = play(design, drawn)
    if tick is not None:
        for _ in range(count):
            tick()
    return rates


def play(design: SequentialDesign, drawn: Sequence[IntArray]) -> DecisionRates:
    """Return a design's rates on `judged_numbers` of each entry, (studies, N, E) with N the runs of the last look."""
    count = len(drawn[0])
    times = [{name: each[k] for name, each in zip(design.entries, drawn)} for k in range(count)]
    studies = [list(begin(design)) for _ in range(count)]
    for look in range(len(design.looks)):
        studies = next_look(design, look, studies, times)
    by_pair = list(zip(*studies))
    return DecisionRates(
        n_studies=count,
        verdicts=tuple(
            {kind: sum(pair.decided is kind for pair in pairs) / count for kind in Decided}
            for pairs in by_pair
        ),
        within_margin=tuple(sum(pair.within_margin for pair in pairs) / count for pairs in by_pair),
        mean_runs=tuple(sum(pair.n_runs for pair in pairs) / count for pairs in by_pair),
        any_difference=sum(any(pair.differs for pair in study) for study in studies) / count,
    )
