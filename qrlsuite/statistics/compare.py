"""Two entries on one task: the verdict of every cell, and who outperforms whom.

A outperforms B if it needs significantly fewer samples in at least one cell of the grid and significantly
more in none (paper, definition "Significant Outperformance"). The entries are compared at equal numbers of
runs, n = min(N_A, N_B), because S_hat depends systematically on the number of runs; below 20 runs every
verdict is `undecided`. They are cut to the shorter horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from qrlsuite.statistics.bootstrap import PERCENTILES
from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.estimator import at_cap, complexity
from qrlsuite.statistics.grid import BoolArray, FloatArray, Grid
from qrlsuite.statistics.significance import (
    Evidence,
    IntervalRule,
    Resampling,
    SignificanceRule,
    Signs,
    check_signs,
)

MIN_RUNS = 20
"""Below this number of runs every verdict is undecided."""
TOO_FEW = f"undecided: fewer than {MIN_RUNS} seeds"


class Verdict(StrEnum):
    """One cell, from the first entry's side."""

    WIN = "win"
    LOSS = "loss"
    TIE = "tie"
    BOTH_AT_CAP = "both-at-cap"
    UNDECIDED = "undecided"


class Outcome(StrEnum):
    """All cells together, from the first entry's side."""

    OUTPERFORMS = "outperforms"
    OUTPERFORMED = "is outperformed"
    TRADE_OFF = "trade-off"
    NOT_REACHED = "not reached"
    NO_DIFFERENCE = "no significant difference"
    UNDECIDED = "undecided"


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """The result of `compare`.

    Attributes
    ----------
    names:
        The first and the second entry.
    grid:
        The E x D cells.
    horizon:
        Environment steps to which both were cut.
    n_runs:
        Number of runs at which both were compared.
    verdicts:
        E rows of D verdicts, from the first entry's side.
    points:
        Shape (2, E, D): the estimates in steps at `n_runs` runs and this horizon.
    intervals:
        Shape (2, E, D, 2): 5th and 95th percentiles at `n_runs` runs (the rule's own where it has any).
    not_reached:
        Whether each entry's S_hat, of all its runs, is the horizon in every cell.
    """

    names: tuple[str, str]
    rule: str
    grid: Grid
    horizon: int
    n_runs: int
    verdicts: tuple[tuple[Verdict, ...], ...]
    points: FloatArray = field(repr=False)
    intervals: FloatArray = field(repr=False)
    not_reached: tuple[bool, bool] = (False, False)

    def count(self, verdict: Verdict) -> int:
        """Return the number of cells with a verdict."""
        return sum(row.count(verdict) for row in self.verdicts)

    @property
    def outcome(self) -> Outcome:
        """The overall result."""
        if self.count(Verdict.UNDECIDED):
            return Outcome.UNDECIDED
        return overall(
            self.count(Verdict.WIN), self.count(Verdict.LOSS), neither_reached=all(self.not_reached)
        )

    @property
    def sentence(self) -> str:
        """The overall result in words, with the first entry as its subject."""
        wins, losses = self.count(Verdict.WIN), self.count(Verdict.LOSS)
        return in_words(self.outcome, wins, losses, self.count(Verdict.BOTH_AT_CAP), self.grid.size)

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison as plain values, for JSON."""
        return {
            "names": list(self.names),
            "rule": self.rule,
            "horizon": self.horizon,
            "n_runs": self.n_runs,
            "epsilons": None if self.grid.epsilons is None else list(self.grid.epsilons),
            "thresholds": list(self.grid.thresholds),
            "deltas": [float(delta) for delta in self.grid.deltas],
            "outcome": str(self.outcome),
            "sentence": self.sentence,
            "not_reached": list(self.not_reached),
            "verdicts": [[str(verdict) for verdict in row] for row in self.verdicts],
            "points": self.points.tolist(),
            "intervals": self.intervals.tolist(),
        }


def overall(wins: int, losses: int, neither_reached: bool = False) -> Outcome:
    """Return the outcome for an entry with so many significantly better and worse cells.

    Parameters
    ----------
    neither_reached:
        Whether both entries reached the goal of no cell: the outcome is then `NOT_REACHED` in place of "no difference".
    """
    if wins and losses:
        return Outcome.TRADE_OFF
    if wins:
        return Outcome.OUTPERFORMS
    if losses:
        return Outcome.OUTPERFORMED
    return Outcome.NOT_REACHED if neither_reached else Outcome.NO_DIFFERENCE


def in_words(outcome: Outcome, wins: int, losses: int, capped: int, cells: int) -> str:
    """Return an outcome and the cells it rests on, as `outperforms: significantly fewer samples in 4 of 6 cells`.

    Parameters
    ----------
    wins, losses:
        Cells with significantly fewer, and more, samples.
    capped:
        Cells without a significant difference in which both are at the cap.
    """
    fewer, more = "significantly fewer", "significantly more"
    match outcome:
        case Outcome.UNDECIDED:
            return TOO_FEW
        case Outcome.NOT_REACHED:
            return f"{outcome}: both are at the cap in all {cells} cells"
        case Outcome.OUTPERFORMS:
            explanation = f"{fewer} samples in {wins} of {cells} cells, {more} in none"
        case Outcome.OUTPERFORMED:
            explanation = f"{more} samples in {losses} of {cells} cells, {fewer} in none"
        case Outcome.TRADE_OFF:
            explanation = f"{fewer} samples in {wins} of {cells} cells, {more} in {losses}"
        case Outcome.NO_DIFFERENCE:
            explanation = f"in none of {cells} cells"
    return f"{outcome}: {explanation}" + (f"; both at the cap in {capped}" if capped else "")


def never_reached(entry: LearningCurves, grid: Grid) -> bool:
    """Return whether S_hat of all an entry's runs is its horizon in every cell."""
    return bool((complexity(entry.values, grid, entry.steps_per_epoch) == entry.horizon).all())


def shown_percentiles(rule: SignificanceRule) -> tuple[float, float]:
    """Return the percentiles of the intervals beside a rule's verdicts."""
    return rule.percentiles if isinstance(rule, IntervalRule) else PERCENTILES


def compare(
    first: LearningCurves,
    second: LearningCurves,
    grid: Grid,
    rule: SignificanceRule | None = None,
    resampling: Resampling | None = None,
    horizon: int | None = None,
) -> Comparison:
    """Compare two entries at equal numbers of runs and equal horizons.

    Parameters
    ----------
    grid:
        The cells, for instance `Grid.relative(epsilons, deltas)`.
    rule:
        None means `IntervalRule()`, the paper's.
    resampling:
        None means 1000 resamples from seed 0.
    horizon:
        Environment steps after which scores do not count; None means the shorter horizon.

    Raises
    ------
    OptionError
        If the common horizon is not a whole number of epochs for both entries, a relative score lies outside
        [0, 1], or the rule answers something else than signs.
    """
    chosen = rule or IntervalRule()
    steps = common_horizon(first, second, horizon)
    n_runs = min(first.n_runs, second.n_runs)
    pair = [Evidence(entry.cut(steps), grid, n_runs, resampling) for entry in (first, second)]
    intervals = np.stack([evidence.interval(shown_percentiles(chosen)) for evidence in pair])
    judgement = judge_cells(chosen, pair[0], [pair[1]], steps) if n_runs >= MIN_RUNS else None
    return Comparison(
        names=(first.name, second.name),
        rule=chosen.name,
        grid=grid,
        horizon=steps,
        n_runs=n_runs,
        verdicts=_verdicts(judgement, grid),
        points=np.stack([evidence.point for evidence in pair]),
        intervals=intervals,
        not_reached=(never_reached(first.cut(steps), grid), never_reached(second.cut(steps), grid)),
    )


def judge_cells(
    rule: SignificanceRule, first: Evidence, others: Sequence[Evidence], horizon: int
) -> tuple[Signs, BoolArray]:
    """Judge one entry against M others, cell by cell; verdicts of pairs follow from these signs.

    Returns
    -------
    tuple
        Signs (M, E, D), +1 where `first` needs significantly fewer samples; and (M, E, D) where neither does and both
        intervals end at the horizon: too few steps to tell.

    Raises
    ------
    OptionError
        If the rule answers something else than signs.
    """
    shape, against = first.grid.shape, getattr(rule, "against", None)
    if against is not None:
        answered = check_signs(against(first, others), (len(others), *shape), rule)
    else:
        answered = np.stack([check_signs(rule(first, other), shape, rule) for other in others])
    signs: Signs = answered.astype(np.int8)
    percentiles = shown_percentiles(rule)
    ends = np.stack([at_cap(evidence.interval(percentiles), horizon) for evidence in (first, *others)])
    capped: BoolArray = ends[0] & ends[1:] & (signs == 0)
    return signs, capped


def _verdicts(judgement: tuple[Signs, BoolArray] | None, grid: Grid) -> tuple[tuple[Verdict, ...], ...]:
    n_thresholds, n_deltas = grid.shape
    if judgement is None:
        return ((Verdict.UNDECIDED,) * n_deltas,) * n_thresholds
    signs, capped = (cells[0] for cells in judgement)
    named = {1: Verdict.WIN, -1: Verdict.LOSS}
    return tuple(
        tuple(
            named.get(int(signs[i, j]), Verdict.BOTH_AT_CAP if capped[i, j] else Verdict.TIE)
            for j in range(n_deltas)
        )
        for i in range(n_thresholds)
    )
