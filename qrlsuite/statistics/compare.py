"""Two entries on one task: the verdict of every cell, and who outperforms whom.

A outperforms B if it needs significantly fewer samples in at least one cell of the grid and significantly
more in none (paper, definition "Significant Outperformance"). The entries are compared at equal numbers of
runs, n = min(N_A, N_B), because S_hat depends systematically on the number of runs; below 20 runs every
verdict is `undecided`. They are cut to the shorter horizon.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.estimator import at_cap
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray
from qrlsuite.statistics.significance import (
    Evidence,
    IntervalRule,
    Resampling,
    SignificanceRule,
    check_signs,
)

MIN_RUNS = 20
"""Below this number of runs every verdict is undecided."""


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
    NO_DIFFERENCE = "no significant difference"
    UNDECIDED = "undecided"


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """The result of `compare`.

    Attributes
    ----------
    names:
        The first and the second entry.
    rule:
        Name of the rule that judged.
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
    """

    names: tuple[str, str]
    rule: str
    grid: Grid
    horizon: int
    n_runs: int
    verdicts: tuple[tuple[Verdict, ...], ...]
    points: FloatArray = field(repr=False)
    intervals: FloatArray = field(repr=False)

    def count(self, verdict: Verdict) -> int:
        """Return the number of cells with a verdict."""
        return sum(row.count(verdict) for row in self.verdicts)

    @property
    def outcome(self) -> Outcome:
        """The overall result."""
        if self.count(Verdict.UNDECIDED):
            return Outcome.UNDECIDED
        return overall(self.count(Verdict.WIN), self.count(Verdict.LOSS))

    @property
    def sentence(self) -> str:
        """The overall result in words, with the first entry as its subject."""
        wins, losses, cells = self.count(Verdict.WIN), self.count(Verdict.LOSS), self.grid.size
        fewer, more = "significantly fewer", "significantly more"
        match self.outcome:
            case Outcome.UNDECIDED:
                explanation = f"fewer than {MIN_RUNS} seeds"
            case Outcome.OUTPERFORMS:
                explanation = f"{fewer} samples in {wins} of {cells} cells, {more} in none"
            case Outcome.OUTPERFORMED:
                explanation = f"{more} samples in {losses} of {cells} cells, {fewer} in none"
            case Outcome.TRADE_OFF:
                explanation = f"{fewer} samples in {wins} of {cells} cells, {more} in {losses}"
            case Outcome.NO_DIFFERENCE:
                explanation = f"in none of {cells} cells"
        return f"{self.outcome}: {explanation}"

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
            "verdicts": [[str(verdict) for verdict in row] for row in self.verdicts],
            "points": self.points.tolist(),
            "intervals": self.intervals.tolist(),
        }


def overall(wins: int, losses: int) -> Outcome:
    """Return the outcome for an entry with so many significantly better and worse cells."""
    if wins and losses:
        return Outcome.TRADE_OFF
    if wins:
        return Outcome.OUTPERFORMS
    return Outcome.OUTPERFORMED if losses else Outcome.NO_DIFFERENCE


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
    first, second:
        The entries.
    grid:
        The cells, for instance `Grid.relative(epsilons, deltas)`.
    rule:
        None means `IntervalRule()`, the paper's.
    resampling:
        None means 1000 resamples from seed 0.
    horizon:
        Environment steps beyond which neither entry is looked at; None means the shorter horizon.

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
    percentiles = chosen.percentiles if isinstance(chosen, IntervalRule) else (5, 95)
    intervals = np.stack([evidence.interval(percentiles) for evidence in pair])
    signs = None
    if n_runs >= MIN_RUNS:
        signs = check_signs(chosen(*pair), grid.shape, chosen)
    return Comparison(
        names=(first.name, second.name),
        rule=chosen.name,
        grid=grid,
        horizon=steps,
        n_runs=n_runs,
        verdicts=_verdicts(signs, intervals, steps, grid),
        points=np.stack([evidence.point for evidence in pair]),
        intervals=intervals,
    )


def _verdicts(
    signs: IntArray | None, intervals: FloatArray, horizon: int, grid: Grid
) -> tuple[tuple[Verdict, ...], ...]:
    n_thresholds, n_deltas = grid.shape
    if signs is None:
        return ((Verdict.UNDECIDED,) * n_deltas,) * n_thresholds
    capped = at_cap(intervals[0], horizon) & at_cap(intervals[1], horizon)
    named = {1: Verdict.WIN, -1: Verdict.LOSS}
    return tuple(
        tuple(
            named.get(int(signs[i, j]), Verdict.BOTH_AT_CAP if capped[i, j] else Verdict.TIE)
            for j in range(n_deltas)
        )
        for i in range(n_thresholds)
    )
