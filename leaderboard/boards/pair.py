"""Two entries in words: which needs fewer steps, by how much and how surely; threshold by threshold; and at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.boards.times import TimeRanking, TimeRow
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import counted, interval_text, mean_text, p_text, percent, share_text, steps_text
from qrlsuite.statistics import (
    MIN_RUNS,
    Direction,
    Grid,
    LearningCurves,
    ScoreBoard,
    TimesPair,
    common_horizon,
    compare_scores,
    final_scores,
    last_epochs,
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
    n_entries:
        Ranked entries of the board.
    adjusted:
        p of the pair, adjusted for all of its pairs.
    direction:
        The verdict there.
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
    times:
        The verdict and every threshold.
    thresholds:
        Thresholds of the grid, in units of the score.
    scores:
        The comparison by final scores; None if an entry has a single run.
    n_last:
        Number of epochs in the first entry's final score, a mean.
    adjusted:
        Whether verdict and p are a board's, adjusted for all of its pairs.
    whole:
        Environment steps at which the task's first board ranks.
    score_name:
        Name of the final score: `score`, or the metric's name.
    before:
        The side of a threshold where a run has not reached it: `below`, or `above`.
    provisional:
        Whether seeds that were asked for are missing.
    """

    labels: tuple[str, str]
    times: TimesPair
    thresholds: tuple[str, ...]
    scores: ScoreBoard | None
    n_last: int
    adjusted: bool = False
    whole: int = 0
    score_name: str = "score"
    before: str = "below"
    provisional: bool = False

    @property
    def sentence(self) -> str:
        """The verdict, its size and how sure it is; if seeds are missing or runs shorter than asked, it begins so."""
        said = self.said
        if self.times.horizon < self.whole:
            said = f"after {steps_text(self.times.horizon)} of {steps_text(self.whole)} steps: {said}"
        return f"provisional: {said}" if self.provisional else said

    @property
    def said(self) -> str:
        """The same without its beginning, for a list that has said it."""
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
        """Say how many steps more or fewer the first entry needs, and what so few seeds cannot know."""
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
            f"{self._crossing}{self._caution}"
        )

    @property
    def _crossing(self) -> str:
        """Name the thresholds at which the other entry needs significantly fewer steps."""
        signs, mean = self.times.signs, 1 if self.times.direction is Direction.FEWER else -1
        against = [threshold for threshold, sign in zip(self.thresholds, signs) if sign == -mean]
        other = self.labels[1] if mean > 0 else self.labels[0]
        return f", but {other} needs fewer at {', '.join(against)}" if against else ""

    @property
    def _caution(self) -> str:
        """Say where the rule is measured to err in more than 7.5 percent."""
        pair, clauses = self.times, list[str]()
        unseen = [n for n, failed in zip(pair.n_runs, pair.failed) if not failed and n < _UNSEEN]
        if unseen:
            clauses.append(
                f"none of {min(unseen)} seeds failed, but up to {share_text(most_failures(min(unseen)))} of others may"
            )
        less, more = sorted(pair.spreads)
        if more and any(more >= factor * less and min(pair.n_runs) <= most for factor, most in _SPREADS):
            times = f" {more / less:.0f} times as much as the other's" if less else " and the other's do not"
            clauses.append(f"one entry's seeds vary{times}, which so few seeds can mistake for a difference")
        return "".join(f"; {clause}" for clause in clauses)

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
        return [
            f"steps {self.before} threshold: mean over seeds; a seed that never reaches it counts with "
            f"{steps_text(self.times.horizon)}",
            "difference: of the first entry against the second; p and intervals: for all thresholds together",
        ]

    @property
    def final(self) -> str:
        """Both final scores, and their difference; empty where one entry has a single run."""
        if self.scores is None:
            return ""
        low, high = self.scores.difference_interval[0, 1]
        one, other = self.scores.mean
        digits = ".3f" if max(abs(one), abs(other)) >= 0.001 else ".3g"
        means = f"{one:{digits}} against {other:{digits}}"
        p = "" if self.times.direction is Direction.UNDECIDED else f", {said(float(self.scores.p[0, 1]))}"
        return (
            f"final {self.score_name}: {means}, difference {_signed(self.scores.difference[0, 1])} "
            f"({_signed(low)} to {_signed(high)}{p}); mean over the last tenth of the epochs ({self.n_last})"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        pair = self.times
        scores = self.scores
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
            "final_score": None
            if scores is None
            else {
                "means": scores.mean.tolist(),
                "difference": float(scores.difference[0, 1]),
                "difference_interval": scores.difference_interval[0, 1].tolist(),
                "p": float(scores.p[0, 1]),
                "last_epochs": self.n_last,
            },
        }


def judge_pair(first: EntryResults, second: EntryResults, grid: Grid, alpha: float) -> PairVerdict:
    """Compare two entries of one task by times below threshold and by final scores, with all their seeds."""
    one, other = (LearningCurves(each.curves, each.steps_per_epoch, each.name) for each in (first, second))
    end = common_horizon(one, other)
    cut = [side.cut(end) for side in (one, other)]
    several = min(side.n_runs for side in cut) > 1
    return PairVerdict(
        labels=_short(first, second),
        times=times_pair(one, other, grid, alpha, seconds=_SECONDS),
        thresholds=tuple(f"{threshold:g}" for threshold in grid.thresholds),
        scores=compare_scores({str(k): final_scores(side) for k, side in enumerate(cut)}, alpha)
        if several
        else None,
        n_last=last_epochs(cut[0].values.shape[1]),
        whole=min(ranking_of([first, second]).horizons),
        score_name=first.task_file.score.called,
        before=grid.before,
        provisional=bool(first.missing or second.missing),
    )


def _short(first: EntryResults, second: EntryResults) -> tuple[str, str]:
    """Return both labels, without the algorithm if they share it."""
    if first.algorithm != second.algorithm:
        return first.label, second.label
    return first.short, second.short


def on_board(
    first: EntryResults, second: EntryResults, entries: Sequence[EntryResults], grid: Grid, alpha: float
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
    board = times_board(curves, grid, alpha, end)
    i, j = map(places.index, pair)
    return OnBoard(len(ranked), float(board.adjusted[i, j]), board.directions[i][j])


def pair_on(
    ranking: TimeRanking, first: TimeRow, second: TimeRow, grid: Grid, labels: tuple[str, str]
) -> PairVerdict:
    """Return the board's verdict on two of its rows; of entries that it does not rank the pair's own.

    Parameters
    ----------
    grid:
        The grid of the board.
    labels:
        Names of the two in the verdict.
    """
    board = ranking.board
    rows = first, second
    i, j = (ranking.order[ranking.rows.index(row)] for row in rows)
    each = np.full(len(grid.levels), np.nan)
    thresholds = tuple(f"{threshold:g}" for threshold in grid.thresholds)
    whole = min(ranking_of([row.entry for row in rows]).horizons)
    if board.directions[i][j] is Direction.UNDECIDED:
        one, other = (LearningCurves(r.entry.curves, r.entry.steps_per_epoch, r.entry.name) for r in rows)
        alone = times_pair(one, other, grid, board.alpha, board.horizon, seconds=_SECONDS)
        missing = any(row.entry.missing for row in rows)
        return PairVerdict(
            labels, alone, thresholds, None, 0, whole=whole, before=grid.before, provisional=missing
        )
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
    return PairVerdict(labels, times, thresholds, None, 0, adjusted=True, whole=whole, before=grid.before)


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
    return f"{value:+.0f}" if abs(value) >= 100 else f"{value:+.1f}" if abs(value) >= 10 else f"{value:+.2g}"


def said(p: float) -> str:
    """Write a p value in a sentence: `p = .021`, `p < .0001`; empty where there is none."""
    text = p_text(p)
    return text and (f"p < {text[1:]}" if text[0] == "<" else f"p = {text}")


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
