"""Simulated error rates and power of a rule: how often it declares a winner wrongly, and how often rightly.

A significance rule's promise is only worth what a simulation of it shows. Two ways are offered:

- `split_halves`: cut one entry's runs at random into two halves and compare them. Real curves, but only at
  N/2 runs, and the splits of one entry share its runs: quote the spread over entries, never over splits.
- `false_winners` and `board_false_winners`: draw independent runs from a smoothed model of an entry's curves
  (`SmoothedRuns`), at any numbers of runs. `power` draws from two models. `judge` is behind all of these, and
  judges the same pairs by several rules. `decision_rates` plays whole sequential designs.

Rates are reported per cell, per grid (any cell of a pair; and: a pair with an overall winner) and per board
(any pair among M entries).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from qrlsuite.errors import OptionError
from qrlsuite.statistics.board import outperformance
from qrlsuite.statistics.compare import Outcome, overall
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, whole
from qrlsuite.statistics.permutation import MaxT, relabelings_for
from qrlsuite.statistics.sequential import Decided, SequentialDesign, begin, next_look
from qrlsuite.statistics.significance import (
    Evidence,
    IntervalRule,
    Resampling,
    SignificanceRule,
    check_signs,
)
from qrlsuite.statistics.times import times_below

_DRAWN = 5_000  # runs that are drawn at a time


class SmoothedRuns:
    """Independent runs that resemble an entry's: a smoothed bootstrap of whole curves.

    A drawn run is V = mean + (V_i - mean + h Z) / sqrt(1 + h^2), with i one of the entry's N runs at random
    and Z a Gaussian curve with the entry's covariance between epochs, drawn as a random combination of the
    centered runs. Jitter is thus as smooth in time as the runs themselves, and mean and covariance stay
    what they were (Silverman and Young 1987: shrunken smoothed bootstrap). Clipped to `bounds`.

    Without jitter (h = 0) draws repeat the N runs, and tie far more often than new runs would. The Gaussian
    part fills gaps between distinct groups of runs (some learn, some do not) as h grows.

    Parameters
    ----------
    entry:
        The entry; two runs or more.
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


@dataclass(frozen=True, eq=False, slots=True)
class Rates:
    """How often a rule found what, over many simulated pairs of the same first and second entry.

    Attributes
    ----------
    rule:
        Name of the rule.
    n_runs:
        Runs of the first and the second entry.
    n_pairs:
        Simulated pairs.
    fewer, more:
        Shape (E, D): fraction of pairs in which the first needs significantly fewer, more samples.
    any_cell:
        Fraction of pairs with a significant difference in any cell.
    first_wins, second_wins:
        Fraction of pairs in which the first outperforms the second, and the reverse.
    """

    rule: str
    n_runs: tuple[int, int]
    n_pairs: int
    fewer: FloatArray
    more: FloatArray
    any_cell: float
    first_wins: float
    second_wins: float

    @property
    def per_cell(self) -> FloatArray:
        """Shape (E, D): fraction of pairs with a significant difference in the cell, either way."""
        return self.fewer + self.more

    @property
    def winner(self) -> float:
        """Fraction of pairs in which either outperforms the other."""
        return self.first_wins + self.second_wins


def split_halves(
    entry: LearningCurves,
    grid: Grid,
    rule: SignificanceRule | None = None,
    n_splits: int = 100,
    seed: int = 0,
    resampling: Resampling | None = None,
    tick: Callable[[], object] | None = None,
) -> Rates:
    """Compare random halves of one entry's runs; every declared winner is false.

    Splits of one entry share its runs, so the pairs are not independent: run this on several entries and
    quote the spread over them. With an odd number of runs one is left out of each split. `tick` is called
    after every pair, here and below.

    Raises
    ------
    OptionError
        If the entry has fewer than 2 runs, or an argument is out of its range.
    """
    half = entry.n_runs // 2
    if half < 1:
        raise OptionError(f"'{entry.name}' has a single run: it has no halves")
    generator = np.random.default_rng(whole(seed, "seed", at_least=0))
    splits = whole(n_splits, "n_splits", at_least=1)

    def pairs() -> Iterator[Sequence[LearningCurves]]:
        for _ in range(splits):
            order = generator.permutation(entry.n_runs)
            sides = [entry.values[order[:half]], entry.values[order[half : 2 * half]]]
            yield [LearningCurves(side, entry.steps_per_epoch, entry.name) for side in sides]

    return judge(pairs(), grid, [rule or IntervalRule()], resampling, tick)[0]


def false_winners(
    model: SmoothedRuns,
    n_first: int,
    n_second: int,
    grid: Grid,
    rule: SignificanceRule | None = None,
    n_pairs: int = 200,
    seed: int = 0,
    resampling: Resampling | None = None,
    tick: Callable[[], object] | None = None,
) -> Rates:
    """Compare pairs of entries drawn from one model; every declared winner is false.

    Pairs are judged also below 20 runs, where `compare` would refuse: that is how the limit can be checked.

    Raises
    ------
    OptionError
        If an argument is out of its range.
    """
    return power(model, model, n_first, n_second, grid, rule, n_pairs, seed, resampling, tick)


def power(
    first: SmoothedRuns,
    second: SmoothedRuns,
    n_first: int,
    n_second: int,
    grid: Grid,
    rule: SignificanceRule | None = None,
    n_pairs: int = 200,
    seed: int = 0,
    resampling: Resampling | None = None,
    tick: Callable[[], object] | None = None,
) -> Rates:
    """Compare pairs drawn from two models: `Rates.first_wins` is the chance to find that the first is better.

    Raises
    ------
    OptionError
        If an argument is out of its range or the models have different horizons.
    """
    pairs = simulated_pairs(first, second, n_first, n_second, n_pairs, seed)
    return judge(pairs, grid, [rule or IntervalRule()], resampling, tick)[0]


def simulated_pairs(
    first: SmoothedRuns, second: SmoothedRuns, n_first: int, n_second: int, n_pairs: int, seed: int = 0
) -> Iterator[Sequence[LearningCurves]]:
    """Return independent pairs of entries, drawn one by one when they are asked for.

    Raises
    ------
    OptionError
        If an argument is out of its range or the models have different horizons.
    """
    if first.entry.horizon != second.entry.horizon:
        raise OptionError(
            f"'{first.entry.name}' ends at {first.entry.horizon} steps, '{second.entry.name}' at "
            f"{second.entry.horizon}: cut them to one horizon"
        )
    generator = np.random.default_rng(whole(seed, "seed", at_least=0))
    count = whole(n_pairs, "n_pairs", at_least=1)
    return ([first.draw(n_first, generator), second.draw(n_second, generator)] for _ in range(count))


def board_false_winners(
    model: SmoothedRuns,
    n_runs: Sequence[int],
    grid: Grid,
    rule: SignificanceRule | None = None,
    n_boards: int = 50,
    seed: int = 0,
    resampling: Resampling | None = None,
    tick: Callable[[], object] | None = None,
) -> float:
    """Return the fraction of boards on which any entry outperforms another, though all are equal.

    Parameters
    ----------
    model:
        What every entry of a board is drawn from.
    n_runs:
        Runs of each of the M entries; below 20 an entry is never judged.
    grid, rule, resampling:
        As in `qrlsuite.statistics.compare.compare`.
    n_boards:
        Simulated boards.
    seed:
        Of the simulation.
    tick:
        Called after every board.

    Raises
    ------
    OptionError
        If an argument is out of its range.
    """
    generator = np.random.default_rng(whole(seed, "seed", at_least=0))
    boards = whole(n_boards, "n_boards", at_least=1)
    boards_with_winners = 0
    for _ in range(boards):
        entries = [model.draw(count, generator) for count in n_runs]
        boards_with_winners += bool(outperformance(entries, grid, rule, resampling).outperforms.any())
        if tick is not None:
            tick()
    return boards_with_winners / boards


def slower(entry: LearningCurves, factor: float) -> LearningCurves:
    """Return runs that take `factor` >= 1 times as long to get as far: an entry known to be worse, for `power`.

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
    """Return the times below threshold in steps of independent entries, shape (n_entries, n_runs, E)."""
    entries, runs = whole(n_entries, "n_entries", at_least=1), whole(n_runs, "n_runs", at_least=1)
    drawn = []
    for done in range(0, entries * runs, _DRAWN):
        part = model.draw(min(_DRAWN, entries * runs - done), generator)
        drawn.append(times_below(part.values, grid, part.steps_per_epoch))
    return np.concatenate(drawn).reshape(entries, runs, -1)


@dataclass(frozen=True, slots=True)
class TimesRates:
    """How often rule `times` found what, over many simulated pairs.

    Attributes
    ----------
    n_runs:
        Runs of the first and the second entry.
    n_pairs:
        Simulated pairs.
    first, second, trade_off:
        Fraction of pairs in which the first, the second needs fewer, and with thresholds of both signs.
    """

    n_runs: tuple[int, int]
    n_pairs: int
    first: float
    second: float
    trade_off: float

    @property
    def found(self) -> float:
        """Fraction of pairs with a difference at any threshold: the error between equals."""
        return self.first + self.second + self.trade_off


def judge_times(ours: IntArray, theirs: IntArray, alpha: float = 0.05) -> TimesRates:
    """Return what rule `times` finds in P pairs of times, (P, N_A, E) and (P, N_B, E)."""
    test = MaxT(list(zip(ours, theirs)))
    test.extend(relabelings_for(alpha))
    signs = np.where(test.p_each <= alpha, np.sign(test.t), 0)
    fewer, more = (signs > 0).any(axis=1), (signs < 0).any(axis=1)
    return TimesRates(
        n_runs=(ours.shape[1], theirs.shape[1]),
        n_pairs=len(ours),
        first=float((fewer & ~more).mean()),
        second=float((more & ~fewer).mean()),
        trade_off=float((fewer & more).mean()),
    )


@dataclass(frozen=True, slots=True)
class DecisionRates:
    """What a sequential design comes to, over many simulated studies.

    Attributes
    ----------
    n_studies:
        Simulated studies.
    verdicts:
        For each pair of the design: fraction of studies with each verdict.
    within_margin:
        For each pair: fraction of studies that found the difference within the margin, of either verdict.
    mean_runs:
        For each pair: mean number of runs of each of its entries when it was closed.
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
    drawn = [draw_times(model, design.looks[-1], count, grid, generator) for model in models]
    rates = play(design, drawn)
    if tick is not None:
        for _ in range(count):
            tick()
    return rates


def play(design: SequentialDesign, drawn: Sequence[IntArray]) -> DecisionRates:
    """Return what a design comes to on times of each entry, (studies, N, E) with N the runs of the last look."""
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


def judge(
    pairs: Iterable[Sequence[LearningCurves]],
    grid: Grid,
    rules: Sequence[SignificanceRule],
    resampling: Resampling | None = None,
    tick: Callable[[], object] | None = None,
) -> tuple[Rates, ...]:
    """Judge the same pairs by several rules; the pairs are used up one by one.

    Parameters
    ----------
    pairs:
        One pair or more, all of the same numbers of runs.
    grid, resampling:
        As in `qrlsuite.statistics.compare.compare`.
    rules:
        The rules.
    tick:
        Called after every pair.

    Raises
    ------
    OptionError
        If a rule answers something else than signs of the grid's shape.
    """
    n_runs = (0, 0)
    signs_by_rule: list[list[IntArray]] = [[] for _ in rules]
    for pair in pairs:
        n_runs = pair[0].n_runs, pair[1].n_runs
        first, second = (Evidence(entry, grid, min(n_runs), resampling) for entry in pair)
        for rule, signs in zip(rules, signs_by_rule):
            signs.append(check_signs(rule(first, second), grid.shape, rule))
        if tick is not None:
            tick()
    return tuple(_rates(rule, n_runs, np.stack(signs)) for rule, signs in zip(rules, signs_by_rule))


def _rates(rule: SignificanceRule, n_runs: tuple[int, int], signs: IntArray) -> Rates:
    """Return the rates of a rule that gave the signs, (P, E, D)."""
    outcomes = [overall(int((each > 0).sum()), int((each < 0).sum())) for each in signs]
    return Rates(
        rule=rule.name,
        n_runs=n_runs,
        n_pairs=len(signs),
        fewer=(signs > 0).mean(axis=0),
        more=(signs < 0).mean(axis=0),
        any_cell=float((signs != 0).any(axis=(1, 2)).mean()),
        first_wins=outcomes.count(Outcome.OUTPERFORMS) / len(signs),
        second_wins=outcomes.count(Outcome.OUTPERFORMED) / len(signs),
    )
