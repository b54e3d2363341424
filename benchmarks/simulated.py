"""Error rates and power of any rule: how often it declares a winner wrongly, and how often rightly.

A significance rule's promise is only worth what a simulation of it shows. Two ways are offered:

- `split_halves`: cut one entry's runs at random into two halves and compare them. Real curves, but only at
  N/2 runs, and the splits of one entry share its runs: quote the spread over entries, never over splits.
- `power` and `board_false_winners`: draw independent runs from smoothed models of entries' curves
  (`qrlsuite.statistics.SmoothedRuns`), at any numbers of runs. `judge` is behind all of these, and judges the same
  pairs by several rules.

Rates are reported per cell, per grid (any cell of a pair; and: a pair with an overall winner) and per board
(any pair among M entries).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from qrlsuite.errors import OptionError
from qrlsuite.statistics import (
    Evidence,
    Grid,
    IntervalRule,
    LearningCurves,
    Outcome,
    Resampling,
    SignificanceRule,
    SmoothedRuns,
    outperformance,
)
from qrlsuite.statistics.compare import overall
from qrlsuite.statistics.grid import FloatArray, IntArray, whole
from qrlsuite.statistics.significance import check_signs


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

    With one model twice every declared winner is false. Pairs are judged also below 20 runs, where `compare` would
    refuse: that is how the limit can be checked.

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
