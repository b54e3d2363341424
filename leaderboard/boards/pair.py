"""Two entries in words: which needs fewer steps, by how much and how surely, and their final scores."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from qrlsuite.leaderboard.boards import scores
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.boards.scores import ScoreSection
from qrlsuite.leaderboard.boards.times import TimeRanking, TimeRow
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import (
    counted,
    interval_text,
    mean_text,
    p_text,
    percent,
    said,
    share_text,
    steps_text,
)
from qrlsuite.statistics import (
    MIN_RUNS,
    Direction,
    Grid,
    LearningCurves,
    TimesPair,
    times_board,
    times_pair,
)
from qrlsuite.statistics.grid import FloatArray
from qrlsuite.statistics.steps import most_failures, runs_that_decide

_DECIDED = (Direction.FEWER, Direction.MORE)
_SECONDS = 10.0  # of relabeling
_UNSEEN = 50  # seeds below which failures that did not occur may turn a verdict
_SPREADS = ((3, 20), (10, 50))
"""How many times one entry's seeds vary as much as the other's, and up to how many seeds that misleads (see
docs/error-rates.md)."""


@dataclass(frozen=True)
class OnBoard:
    """The same pair among all entries of its task, where Holm's procedure goes over all pairs.

    Attributes
    ----------
    adjusted:
        p of the pair, adjusted for all of its pairs.
    """

    n_entries: int
    adjusted: float
    direction: Direction

    @property
    def text(self) -> str:
        """`on the board of 8 entries, which is stricter (28 pairs): not told apart, adjusted p = .074`."""
        pairs = self.n_entries * (self.n_entries - 1) // 2
        verdict = "told apart, too" if self.direction in _DECIDED else str(self.direction)
        return (
            f"on the board of {self.n_entries} entries, which is stricter ({pairs} pairs): {verdict}, "
            f"adjusted {said(self.adjusted)}"
        )


@dataclass(frozen=True, eq=False)
class PairVerdict:
    """The result of `judge_pair`, from the first entry's side.

    Attributes
    ----------
    labels:
        Labels of the two entries, without the algorithm if they share it.
    thresholds:
        Thresholds of the grid, in units of the score.
    scores:
        The comparison by final scores, or by another number of each seed; None if an entry has a single run.
    places:
        The two among its entries.
    by:
        Whether steps stand first in the sentence, or the axis of `scores`.
    adjusted:
        Whether verdict and p are a board's, adjusted for all of its pairs.
    whole:
        Environment steps at which the task's first board ranks.
    before:
        The side of a threshold where a run has not reached it: `below`, or `above`.
    incomplete:
        Whether seeds that were asked for are missing.
    """

    labels: tuple[str, str]
    times: TimesPair
    thresholds: tuple[str, ...]
    scores: ScoreSection | None
    places: tuple[int, int] = (0, 1)
    by: str = "steps"
    adjusted: bool = False
    whole: int = 0
    before: str = "below"
    incomplete: bool = False

    @property
    def sentence(self) -> str:
        """The verdict by steps, then by final score; if seeds are missing or runs shorter than asked, it begins so."""
        said = self.said
        if self.times.horizon < self.whole:
            said = f"after {steps_text(self.times.horizon)} of {steps_text(self.whole)} steps: {said}"
        return f"incomplete: {said}" if self.incomplete else said

    @property
    def said(self) -> str:
        """The same without its beginning, for a list that has said it."""
        clauses = [self._by_steps]
        if self.scores is not None and self.by == "steps":
            clauses.append(self.scores.clause(self.places, self.adjusted))
        elif self.scores is not None:
            clauses.insert(0, self.scores.verdict(self.labels))
        return "; ".join([*clauses, *self._cautions])

    @property
    def _by_steps(self) -> str:
        pair = self.times
        if (pair.at_cap == 1).all():
            return (
                f"neither reached {_any_of(len(self.thresholds))} within {steps_text(pair.horizon)} steps: "
                f"train longer, or {'lower' if self.before == 'below' else 'raise'} them"
            )
        match pair.direction:
            case Direction.UNDECIDED:
                could = f"{runs_that_decide(pair.alpha)} each could"
                return f"cannot be decided with so few seeds ({could}): so far {self._not_told_apart} ({self._seeds})"
            case Direction.NOT_TOLD_APART:
                return f"not told apart: {self._not_told_apart} ({self._seeds}, {self._p}){self._detectable}"
        return self._decided

    @property
    def _decided(self) -> str:
        """Say how many steps more or fewer the first entry needs."""
        first, second = self.labels
        value, low, high = fewer(self.times.difference)
        least, most = sorted((abs(low), abs(high)))
        ends = (
            f"{share_text(least)} or more"
            if math.isinf(most)
            else f"{share_text(least)} to {share_text(most)}"
        )
        return (
            f"{first} needs {_fewer_or_more(value)} steps than {second} ({ends}, {self._seeds}, {self._p})"
            f"{self._crossing}"
        )

    @property
    def _crossing(self) -> str:
        """Name the thresholds at which the other entry needs significantly fewer steps."""
        signs, mean = self.times.signs, 1 if self.times.direction is Direction.FEWER else -1
        against = [threshold for threshold, sign in zip(self.thresholds, signs) if sign == -mean]
        other = self.labels[1] if mean > 0 else self.labels[0]
        return f", but {other} needs fewer at {', '.join(against)}" if against else ""

    @property
    def _cautions(self) -> list[str]:
        """Say where the rule is measured to err in more than 7.5 percent."""
        pair, clauses = self.times, list[str]()
        if pair.direction not in _DECIDED:
            return clauses
        unseen = {
            label: n
            for label, n, failed in zip(self.labels, pair.n_runs, pair.failed)
            if not failed and n < _UNSEEN
        }
        if unseen:
            fewest = min(unseen.values())
            whose = "" if len(unseen) == len(self.labels) else f" of {next(iter(unseen))}"
            clauses.append(
                f"none of {fewest} seeds{whose} failed, but up to {share_text(most_failures(fewest))} of others may"
            )
        less, more = sorted(pair.spreads)
        if more and any(more >= factor * less and min(pair.n_runs) <= most for factor, most in _SPREADS):
            times = f" {more / less:.0f} times as much as the other's" if less else " and the other's do not"
            clauses.append(f"one entry's seeds vary{times}, which so few seeds can mistake for a difference")
        return clauses

    @property
    def _detectable(self) -> str:
        share = self.times.detectable
        if math.isnan(share) or not share or self.adjusted:
            return ""
        return f"; so many seeds would show {share_text(share)} fewer in 4 of 5 cases"

    @property
    def _not_told_apart(self) -> str:
        first, second = self.labels
        value, low, high = fewer(self.times.difference)
        if math.isnan(value):
            return f"{first} and {second}"
        text = f"{first} needs {_fewer_or_more(value)} steps than {second}"
        return text if math.isnan(low) else f"{text}, {_fewer_or_more(high)} to {_fewer_or_more(low)}"

    @property
    def _seeds(self) -> str:
        one, other = self.times.n_runs
        return f"{counted(one, 'seed')} each" if one == other else f"{one} and {other} seeds"

    @property
    def _p(self) -> str:
        error = f" +- {self.times.p_error:.1g}" if self.times.p_error else ""
        return "adjusted " * self.adjusted + said(self.times.p) + error

    def columns(self) -> tuple[str, ...]:
        """Return the heads of the table that `rows` fills."""
        level = f"{100 * (1 - self.times.alpha):g}%"
        return ("threshold", *self.labels, f"difference ({level})", "p", "first needs")

    def rows(self) -> list[tuple[str, ...]]:
        """Return one row of text per threshold: steps below it of both, and the difference with its own interval."""
        pair = self.times
        return [
            (
                threshold,
                *(_steps(pair, side, place) for side in (0, 1)),
                _difference(pair.differences[place]),
                p_text(float(pair.p_each[place])) or "-",
                self._verdict(place),
            )
            for place, threshold in enumerate(self.thresholds)
        ]

    def _verdict(self, place: int) -> str:
        if (self.times.at_cap[:, place] == 1).all():
            return "neither reached"
        if self.times.direction is Direction.UNDECIDED:
            return "undecided"
        return {1: "fewer", -1: "more", 0: "not told apart"}[int(self.times.signs[place])]

    @property
    def notes(self) -> list[str]:
        """The notes below the table."""
        notes = [
            f"steps {self.before} threshold: mean over seeds; a seed that never reaches it counts with "
            f"{steps_text(self.times.horizon)}",
            "difference: of the first entry against the second; p and intervals: for all thresholds together",
        ]
        if self.scores is not None:
            ends = interval_text(_signed, *self.scores.difference(self.places))
            notes.append(f"{self.scores.meaning}; difference {ends}")
        return notes

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        pair = self.times
        return {
            "n_runs": list(pair.n_runs),
            "verdict": str(pair.direction),
            "p": _number(pair.p),
            "p_error": pair.p_error,
            "difference": _number(pair.difference[0]),
            "difference_interval": [_number(end) for end in pair.difference[1:]],
            "by_threshold": [
                {
                    "threshold": float(threshold),
                    "mean_times": pair.means[:, place].tolist(),
                    "at_cap": pair.at_cap[:, place].tolist(),
                    "difference": _number(pair.differences[place, 0]),
                    "difference_interval": [_number(end) for end in pair.differences[place, 1:]],
                    "p": _number(float(pair.p_each[place])),
                    "sign": int(pair.signs[place]),
                }
                for place, threshold in enumerate(self.thresholds)
            ],
            "final_score" if self.by in ("steps", "score") else self.by: self._number_as_dict(),
        }

    def _number_as_dict(self) -> dict[str, Any] | None:
        if self.scores is None:
            return None
        value, *interval = self.scores.difference(self.places)
        return {
            "means": self.scores.results.mean[[*self.places]].tolist(),
            "difference": value,
            "difference_interval": interval,
            "p": float(self.scores.results.p[self.places]),
            "last_epochs": self.scores.n_last,
        }


def judge_pair(
    first: EntryResults,
    second: EntryResults,
    grid: Grid,
    alpha: float,
    by: str = "steps",
    horizon: int | None = None,
) -> PairVerdict:
    """Compare two entries of one task by steps below threshold and by one more number, with all their seeds.

    Parameters
    ----------
    by:
        As for a board: the number that stands first in the sentence. With `steps`, final scores follow.
    horizon:
        Environment steps at which both are cut; None means the shorter one's.
    """
    one, other = (LearningCurves(each.curves, each.steps_per_epoch, each.name) for each in (first, second))
    times = times_pair(one, other, grid, alpha, horizon, seconds=_SECONDS)
    number = "score" if by == "steps" else by
    several = min(times.n_runs) > 1
    return PairVerdict(
        labels=_short(first, second),
        times=times,
        thresholds=tuple(f"{threshold:g}" for threshold in grid.thresholds),
        scores=scores.compared([first, second], times.horizon, number, alpha) if several else None,
        by=by,
        whole=min(ranking_of([first, second]).horizons),
        before=grid.before,
        incomplete=bool(first.missing or second.missing),
    )


def _short(first: EntryResults, second: EntryResults) -> tuple[str, str]:
    """Return both labels, without the algorithm if they share it."""
    if first.algorithm != second.algorithm:
        return first.label, second.label
    return first.short, second.short


def on_board(
    first: EntryResults, second: EntryResults, entries: Sequence[EntryResults], alpha: float
) -> OnBoard | None:
    """Return the pair's verdict on its task's board, at the pair's horizon.

    Parameters
    ----------
    entries:
        Entries of the task. An entry of a study with looks, of another definition of the task, shorter than the pair
        or with fewer than 20 seeds is not ranked.

    Returns
    -------
    OnBoard or None
        None if one of the two is not ranked, or no other entry is.
    """
    end = min(each.curves.shape[1] * each.steps_per_epoch for each in (first, second))
    ranked = []
    for entry in entries:
        if entry.study or entry.task_hash != first.task_hash or end % entry.steps_per_epoch:
            continue
        reached = entry.reaching(end // entry.steps_per_epoch)
        if reached is not None and len(reached.seeds) >= MIN_RUNS and not reached.missing:
            ranked.append(reached)
    places = [entry.folder for entry in ranked]  # a board calls one of two copies another name
    pair = first.folder, second.folder
    if len(ranked) < 3 or not set(pair) <= set(places):
        return None
    curves = [LearningCurves(each.curves, each.steps_per_epoch, str(k)) for k, each in enumerate(ranked)]
    board = times_board(curves, ranking_of([first, second]).grid, alpha, end)
    i, j = map(places.index, pair)
    return OnBoard(len(ranked), float(board.adjusted[i, j]), board.directions[i][j])


def pair_on(
    ranking: TimeRanking,
    finals: ScoreSection | None,
    first: TimeRow,
    second: TimeRow,
    grid: Grid,
    labels: tuple[str, str],
) -> PairVerdict:
    """Return the board's verdict on two of its rows; of entries that it does not rank the pair's own.

    Parameters
    ----------
    finals:
        The board's ranked entries by final score; None if it ranks none.
    labels:
        Names of the two in the verdict.
    """
    board = ranking.board
    rows = first, second
    i, j = (ranking.order[ranking.rows.index(row)] for row in rows)
    if finals is None or board.directions[i][j] is Direction.UNDECIDED:
        alone = judge_pair(first.entry, second.entry, grid, board.alpha, horizon=board.horizon)
        return replace(alone, labels=labels)
    each = np.full(len(grid.levels), np.nan)
    names = [entry.name for entry in finals.entries]
    times = TimesPair(
        n_runs=(board.n_runs[i], board.n_runs[j]),
        horizon=board.horizon,
        alpha=board.alpha,
        direction=board.directions[i][j],
        p=float(board.adjusted[i, j]),
        p_error=float(board.p_error[i, j]),
        difference=np.array([board.difference[i, j], *board.difference_interval[i, j]]),
        detectable=math.nan,
        failed=(board.failed[i], board.failed[j]),
        spreads=(board.spreads[i], board.spreads[j]),
        signs=np.zeros(len(each), dtype=np.int64),
        p_each=each,
        means=np.stack([each, each]),
        differences=np.stack([each, each, each], axis=1),
        at_cap=np.stack([row.mean.at_cap for row in rows]),
    )
    return PairVerdict(
        labels,
        times,
        tuple(f"{threshold:g}" for threshold in grid.thresholds),
        finals,
        (names.index(first.entry.name), names.index(second.entry.name)),
        adjusted=True,
        whole=min(ranking_of([row.entry for row in rows]).horizons),
        before=grid.before,
    )


def fewer(difference: FloatArray) -> tuple[float, float, float]:
    """Return the share of steps that the first entry saves against the second, negative where it needs more.

    Parameters
    ----------
    difference:
        Shape (3,): the first entry's mean over the second's, minus 1, and the ends of its interval.

    >>> fewer(np.array([-0.5, -0.6, -0.25]))
    (0.5, 0.25, 0.6)
    """
    value, low, high = difference.tolist()
    return -value, -high, -low


def _fewer_or_more(value: float) -> str:
    return f"{share_text(abs(value))} {'fewer' if value >= 0 else 'more'}"


def _any_of(count: int) -> str:
    return "the threshold" if count == 1 else f"any of the {count} thresholds"


def _steps(pair: TimesPair, side: int, place: int) -> str:
    never = pair.at_cap[side, place] == 1
    return "never" if never else mean_text(float(pair.means[side, place]))


def _difference(values: FloatArray) -> str:
    if np.isnan(values[0]):
        return "-"
    if np.isnan(values[1]):
        return percent(values[0])
    return interval_text(percent, *values.tolist())


def _signed(value: float) -> str:
    """Write a difference of scores, from 10 up without a power of ten: `+0.012`, `-3.4`, `+12.5`, `+130`."""
    value = round(value, 12)  # rounding leaves no power of ten
    return f"{value:+.0f}" if abs(value) >= 100 else f"{value:+.1f}" if abs(value) >= 10 else f"{value:+.2g}"


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
