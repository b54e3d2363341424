"""All pairs of a board by their steps below threshold: who outperforms whom, by how much, and which ranks remain.

The verdicts by which boards rank; tiers by the paper's definition are in `qrlsuite.statistics.board`. The order is by
mean steps M. A pair is decided if Holm's procedure over all pairs of the board rejects its test by rule `steps`: for
entries of equal laws the probability of any false decision on the whole board is alpha at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from qrlsuite.errors import OptionError
from qrlsuite.statistics.compare import MIN_RUNS
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.grid import BoolArray, FloatArray, Grid, IntArray, whole
from qrlsuite.statistics.permutation import MaxT, with_half_epoch
from qrlsuite.statistics.steps import holm_levels, ratio_interval, settle
from qrlsuite.statistics.times import MeanTime, check_probability, mean_time, times_below

FEW_RUNS = 50
"""Unequal numbers are marked where the smaller is below this: the test then errs more often than alpha says."""


class Direction(StrEnum):
    """A pair of a board, from the first entry's side."""

    FEWER = "needs fewer"
    MORE = "needs more"
    NOT_TOLD_APART = "not told apart"
    UNDECIDED = "undecided"


@dataclass(frozen=True, eq=False, slots=True)
class TimesBoard:
    """The result of `times_board`, for M entries; matrices are from the row's side.

    Attributes
    ----------
    names, n_runs:
        The entries in the order given, and their numbers of runs.
    horizon:
        In environment steps.
    alpha:
        Probability of any false decision on a board of entries of equal laws.
    means:
        M of each, see `MeanTime`; intervals at level 1 - alpha, each by itself.
    p:
        Shape (M, M): p of each pair by itself; NaN where undecided, and on the diagonal.
    adjusted:
        Shape (M, M): p adjusted for all pairs of the board (Holm 1979).
    directions:
        M rows of M: the decisions.
    difference:
        Shape (M, M): M of the row's entry over M of the column's, minus 1, half an epoch's steps added to both.
    difference_interval:
        Shape (M, M, 2): at the level at which Holm's procedure tested the pair; NaN where undecided.
    p_error:
        Shape (M, M): Monte Carlo error of the adjusted p where 10 million relabelings leave the decision open, else 0.
    ranks:
        Shape (M, 2): best and worst rank that the decisions leave; 0 for entries that stand apart.
    failed, spreads:
        Of each: its runs that reach no threshold, and standard deviation over mean of its runs.
    few:
        Shape (M, M): whether the numbers of runs are unequal and the smaller is below 50.
    """

    names: tuple[str, ...]
    n_runs: tuple[int, ...]
    horizon: int
    alpha: float
    means: tuple[MeanTime, ...]
    p: FloatArray = field(repr=False)
    adjusted: FloatArray = field(repr=False)
    directions: tuple[tuple[Direction, ...], ...] = field(repr=False)
    difference: FloatArray = field(repr=False)
    difference_interval: FloatArray = field(repr=False)
    p_error: FloatArray = field(repr=False)
    ranks: IntArray = field(repr=False)
    failed: tuple[int, ...]
    spreads: tuple[float, ...]
    few: BoolArray = field(repr=False)

    @property
    def order(self) -> tuple[int, ...]:
        """Indices of the ranked entries by M, least first, equal ones by name; then the others."""
        return self._by([mean.mean for mean in self.means])

    @property
    def order_at_half(self) -> tuple[int, ...]:
        """The same by M at half the horizon: where it differs, the order depends on the horizon."""
        return self._by([mean.half for mean in self.means])

    @property
    def outperforms(self) -> BoolArray:
        """Shape (M, M): whether the row's entry outperforms the column's.

        The rank of an entry is 1 + the number of entries that outperform it: the first column of `ranks`.
        """
        rows = [[each is Direction.FEWER for each in row] for row in self.directions]
        matrix: BoolArray = np.array(rows, dtype=bool).reshape(len(rows), -1)
        return matrix

    def _by(self, values: Sequence[float]) -> tuple[int, ...]:
        def key(index: int) -> tuple[bool, float, str]:
            return not self.ranks[index, 0], values[index], self.names[index]

        return tuple(sorted(range(len(self.names)), key=key))


def times_board(
    entries: Sequence[LearningCurves],
    grid: Grid,
    alpha: float = 0.05,
    horizon: int | None = None,
    seed: int = 0,
) -> TimesBoard:
    """Compare all pairs of M entries by their mean steps below threshold.

    Entries with fewer than 20 runs stand apart, like incomplete ones: no pair with them is tested or counted.
    Numbers of runs may differ. Relabelings go on until no decision can turn.

    Parameters
    ----------
    entries:
        The entries; their names must differ.
    grid:
        Its E thresholds count; its deltas do not.
    alpha:
        In (0, 1).
    horizon:
        Environment steps beyond which no entry is looked at; None means the horizon that all have.

    Raises
    ------
    OptionError
        If names repeat, the horizons differ and none is given, or the horizon is not a whole number of epochs.

    References
    ----------
    Holm 1979, Scandinavian Journal of Statistics 6; Westfall and Young 1993; Mogstad, Romano, Shaikh and Wilhelm
    2024, Review of Economic Studies 91 (ranges of ranks from decided pairs).
    """
    check_probability(alpha, "alpha")
    names = tuple(entry.name for entry in entries)
    if len(set(names)) != len(names):
        raise OptionError(f"two entries are called '{next(n for n in names if names.count(n) > 1)}'")
    end = _common_end(entries, horizon)
    cut = [entry.cut(end) for entry in entries]
    times = [times_below(entry.values, grid, entry.steps_per_epoch) for entry in cut]
    size = len(entries)
    ranked = [place for place, entry in enumerate(entries) if entry.n_runs >= MIN_RUNS and entry.complete]
    pairs = [(i, j) for place, i in enumerate(ranked) for j in ranked[place + 1 :]]
    epoch = max(entry.steps_per_epoch for entry in entries)
    of_runs = [with_half_epoch(each, epoch).sum(axis=1) for each in times]
    test = MaxT([(of_runs[i][:, None], of_runs[j][:, None]) for i, j in pairs], seed=seed, ratio=True)
    turning = settle(test, alpha)
    p, adjusted = (np.full((size, size), np.nan) for _ in range(2))
    p_error = np.zeros((size, size))
    means = np.array([each.mean() for each in of_runs])
    difference = means[:, None] / means - 1
    interval = np.full((size, size, 2), np.nan)
    directions = [[Direction.UNDECIDED] * size for _ in range(size)]
    corrected, levels = holm(test.p), holm_levels(test.p, alpha)
    errors = turning * corrected * np.sqrt((1 - test.p) / test.p / test.n_relabelings)
    for index, (i, j) in enumerate(pairs):
        p[i, j] = p[j, i] = test.p[index]
        adjusted[i, j] = adjusted[j, i] = corrected[index]
        p_error[i, j] = p_error[j, i] = errors[index]
        sign = int(np.sign(test.t[index, 0])) if corrected[index] <= alpha else 0
        directions[i][j], directions[j][i] = named_direction(sign), named_direction(-sign)
        _, low, high = ratio_interval(of_runs[i], of_runs[j], float(levels[index]), sign != 0, seed)
        interval[i, j], interval[j, i] = (low, high), (1 / (1 + high) - 1, 1 / (1 + low) - 1)
    better = np.array([[each is Direction.FEWER for each in row] for row in directions], bool).reshape(
        size, -1
    )
    counts = np.array([entry.n_runs for entry in entries], dtype=np.int64)
    return TimesBoard(
        names=names,
        n_runs=tuple(counts.tolist()),
        horizon=end,
        alpha=alpha,
        means=tuple(mean_time(entry, grid, 1 - alpha) for entry in cut),
        p=p,
        adjusted=adjusted,
        directions=tuple(tuple(row) for row in directions),
        difference=difference,
        difference_interval=interval,
        p_error=p_error,
        ranks=rank_ranges(better, [place in ranked for place in range(size)]),
        failed=tuple(int((each == end).all(axis=1).sum()) for each in times),
        spreads=tuple(spread(each) for each in of_runs),
        few=(counts[:, None] != counts) & (np.minimum.outer(counts, counts) < FEW_RUNS),
    )


def _common_end(entries: Sequence[LearningCurves], horizon: int | None) -> int:
    if not entries:
        raise OptionError("a board needs an entry")
    if horizon is not None:
        return whole(horizon, "horizon", at_least=1)
    first = entries[0]
    for entry in entries:
        if entry.horizon != first.horizon:
            raise OptionError(
                f"'{first.name}' ends at {first.horizon} steps, '{entry.name}' at {entry.horizon}: "
                "give a horizon that both have"
            )
    return first.horizon


def spread(of_runs: IntArray) -> float:
    """Return standard deviation over mean of positive numbers, (N,); NaN of a single one."""
    return float(of_runs.std(ddof=1) / of_runs.mean()) if len(of_runs) > 1 else float("nan")


def named_direction(sign: int) -> Direction:
    """Return the direction of a pair: 1 needs fewer, -1 more, and 0 is not told apart."""
    return {1: Direction.FEWER, -1: Direction.MORE, 0: Direction.NOT_TOLD_APART}[sign]


def holm(p: ArrayLike) -> FloatArray:
    """Return p values adjusted for their number, shape (m,): at most alpha where Holm's procedure rejects.

    >>> holm([0.01, 0.04, 0.03]).tolist()
    [0.03, 0.06, 0.06]
    """
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    steps = values[order] * np.arange(len(values), 0, -1)
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1)
    return adjusted


def rank_ranges(better: ArrayLike, ranked: ArrayLike | None = None) -> IntArray:
    """Return best and worst rank that decided pairs leave, shape (M, 2).

    1 + the number of entries that are significantly better, to m - the number that are significantly worse. If
    no decision is false, every entry's true rank is in its range (Mogstad et al. 2024).

    Parameters
    ----------
    better:
        Shape (M, M): whether the row's entry is significantly better than the column's.
    ranked:
        Shape (M,): which m entries are ranked; the others get 0. None means all.
    """
    relation = np.asarray(better, dtype=bool)
    member = np.ones(len(relation), bool) if ranked is None else np.asarray(ranked, bool)
    ranges = np.stack([1 + relation.sum(axis=0), member.sum() - relation.sum(axis=1)], axis=1)
    ranges[~member] = 0
    return ranges.astype(np.int64)


def log_ratios(times: Sequence[IntArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return log(M_row / M_column), its standard error and degrees of freedom, each (M, M).

    Delta method with Welch's degrees of freedom. NaN where a mean is 0 and the ratio is not defined; the
    error is 0 and the freedom infinite where neither entry varies.
    """
    of_runs = [each.mean(axis=1) for each in times]
    counts = np.array([len(each) for each in of_runs])
    means = np.array([each.mean() for each in of_runs])
    variances = np.array([each.var(ddof=1) if len(each) > 1 else np.nan for each in of_runs])
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = variances / means**2 / counts
        logs = np.log(means)
        ratio = logs[:, None] - logs
        both = parts[:, None] + parts
        slack = parts**2 / (counts - 1)
        freedom = np.where(both == 0, np.inf, both**2 / (slack[:, None] + slack))
    undefined = (means == 0)[:, None] | (means == 0)
    ratio[undefined] = np.nan
    return ratio, np.sqrt(both), freedom
