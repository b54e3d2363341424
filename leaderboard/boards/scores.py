"""A task's entries by one number per seed: final score, area under the curve, spread, or a metric at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.columns import Column, flat, record
from qrlsuite.engine.sheet import Sheet
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.boards import steps, tables
from qrlsuite.leaderboard.boards.columns import estimate, ranks_column
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import interval_text, mean_text, said, score_text, steps_text
from qrlsuite.statistics import (
    MIN_RUNS,
    AcrossTasks,
    Grid,
    LearningCurves,
    ScoreBoard,
    areas,
    compare_scores,
    deviations,
    final_scores,
    last_epochs,
    rank_ranges,
)
from qrlsuite.statistics.grid import FloatArray
from qrlsuite.statistics.pair import can_decide

Pair = tuple[int, int]
"""Places of two entries in a section."""
OF_RUNS: Mapping[str, Callable[[LearningCurves, Grid], FloatArray]] = {
    "score": lambda curves, _: final_scores(curves),
    "area": lambda curves, _: areas(curves),
    "spread": deviations,
}
"""Numbers of each run that rank entries. Metrics in a task's `[ranking] costs` rank, too, by their final value."""


@dataclass(frozen=True, eq=False)
class ScoreSection:
    """The result of `rank_by_score`.

    Attributes
    ----------
    task, horizon, by, alpha:
        The task; the environment steps at which all curves are cut; `score`, `area`, `spread` or a metric; and the
        error for all pairs together.
    entries:
        The ranked entries, in the order of `results`.
    n_last:
        Number of epochs in a final score, a mean.
    unranked:
        The entries with fewer than 20 seeds, or with missing seeds.
    of:
        Name of the numbers: `score`, or the metric's name.
    sign:
        1 where more is better, -1 where less is.
    shown:
        Names of the entries that have a row; None means all. A hidden row changes no rank.
    """

    task: str
    horizon: int
    by: str
    alpha: float
    entries: tuple[EntryResults, ...]
    results: ScoreBoard
    n_last: int
    unranked: tuple[EntryResults, ...]
    shown: frozenset[str] | None = None
    of: str = "score"
    sign: int = 1

    @property
    def called(self) -> str:
        """The number's name in sentences."""
        names = {"area": "area under the learning curve", "spread": "spread between seeds"}
        return names.get(self.by, f"final {self.of}")

    @property
    def meaning(self) -> str:
        """The meaning of the number."""
        match self.by:
            case "area":
                return f"area: mean {self.of} over all epochs"
            case "spread":
                return "spread: how far a seed's steps are from the median seed's, mean over seeds"
        return f"final {self.of}: mean over the last tenth of the epochs ({self.n_last})"

    @property
    def title(self) -> str:
        """The title: task, horizon and number."""
        return f"{self.task}, {steps_text(self.horizon)} steps, by {self.called}"

    @property
    def order(self) -> tuple[int, ...]:
        """Indices of the entries by mean, the best first."""
        names, mean = self.results.names, self.sign * self.results.mean
        return tuple(sorted(range(len(names)), key=lambda index: (-mean[index], names[index])))

    def columns(self) -> tuple[Column[int], ...]:
        """Return the columns; a row is a place of the order."""
        results, order, more = self.results, self.order, self.sign > 0
        level, write = f"{100 * (1 - self.alpha):g}%", mean_text if self.by == "spread" else score_text

        def ahead(place: int) -> str:
            first, index = order[0], order[place]
            difference = results.difference[first, index], *results.difference_interval[first, index]
            return interval_text(write, *self._turned(*difference)) if place else "-"

        def better(place: int) -> float | None:
            return self._better(*order[place : place + 2]) if place + 1 < len(order) else None

        return (
            ranks_column(lambda place: list(self.ranks[order[place]])),
            Column(
                "entry",
                lambda place: self.entries[order[place]].name,
                cell=lambda place: self.entries[order[place]].label,
                words=True,
            ),
            Column("label", lambda place: self.entries[order[place]].label),
            Column("seeds", lambda place: len(self.entries[order[place]].seeds), str),
            *means(results, order, level, write),
            Column("", ahead, head="below the first" if more else "above the first", cell=ahead),
            Column("", better, "{:.2f}".format, head=f"P({'more' if more else 'less'} than next)"),
        )

    def _turned(self, value: float, low: float, high: float) -> tuple[float, float, float]:
        """Return a difference with the sign turned so that more is better for the first."""
        return (value, low, high) if self.sign > 0 else (-value, -high, -low)

    def _better(self, index: int, other: int) -> float:
        """Return the probability that a seed of one entry is better than a seed of another."""
        more = float(self.results.improvement[index, other])
        return more if self.sign > 0 else 1 - more

    @property
    def ranks(self) -> list[tuple[int, int]]:
        """Best and worst rank of each entry that the significant pairs leave."""
        return [(best, worst) for best, worst in rank_ranges(self.results.better == self.sign).tolist()]

    def notes(self) -> list[str]:
        """Explain the columns."""
        size, better = len(self.entries), self.results.better
        lines = [
            self.meaning,
            f"rank: what the significant pairs leave ({int((better == 1).sum())} of {size * (size - 1) // 2}: "
            f"permutation test, Holm, error {self.alpha:g} for all pairs together)",
            "IQM: mean of the middle half of the seeds; intervals: bootstrap of the seeds, of each entry by itself",
            f"P: probability that a seed {'scores more' if self.sign > 0 else 'has less'} than a seed of "
            "the next entry, ties one half",
        ]
        few = [entry.label for entry in self.unranked if len(entry.seeds) < MIN_RUNS]
        return [
            *tables.doubts(self.entries),
            *tables.missing(self.unranked),
            *lines,
            *([f"fewer than {MIN_RUNS} seeds: {', '.join(few)}"] if few else []),
            *tables.remarks(self.entries),
        ]

    def difference(self, pair: Pair) -> tuple[float, float, float]:
        """Return the first's mean minus the second's, and its interval."""
        low, high = self.results.difference_interval[pair].tolist()
        return float(self.results.difference[pair]), low, high

    def clause(self, pair: Pair, adjusted: bool = False, named: bool = True) -> str:
        """Return `final score 0.942 against 0.791, p = .002`; without p where there are too few seeds for one."""
        one, other = self.results.mean[[*pair]].tolist()
        digits = ".3f" if max(abs(one), abs(other)) >= 0.001 else ".3g"
        write = mean_text if self.by == "spread" else f"{{:{digits}}}".format
        p = float((self.results.adjusted if adjusted else self.results.p)[pair])
        known = f", {'adjusted ' * adjusted}{said(p)}" * self._decidable(pair)
        return f"{f'{self.called} ' * named}{write(one)} against {write(other)}{known}"

    def verdict(self, labels: tuple[str, str]) -> str:
        """Say which of two entries has more; `labels` are their names in the sentence."""
        if not self._decidable((0, 1)):
            return f"cannot be decided with so few seeds: {self.clause((0, 1))}"
        if self.results.p[0, 1] > self.alpha:
            return f"not told apart: {self.clause((0, 1))}"
        more = "higher" if self.results.difference[0, 1] > 0 else "lower"
        return f"{labels[0]} has a {more} {self.called} than {labels[1]} ({self.clause((0, 1), named=False)})"

    def _decidable(self, pair: Pair) -> bool:
        """Tell whether a pair has enough seeds for its p: for spreads 20 each, see docs/error-rates.md."""
        one, other = (len(self.entries[place].seeds) for place in pair)
        enough = min(one, other) >= MIN_RUNS if self.by == "spread" else True
        return enough and can_decide(one, other, self.alpha)

    def sheet(self, explain: bool = False) -> Sheet:
        """Return the table; `explain` adds all its notes."""
        label, name = f"{self.task}-{self.by}", f"{self.task} by {self.by}"
        notes = tuple(self.notes())
        return Sheet(
            self.title, self.columns(), self._places(), notes, explain, label=label, name=name
        )  # fmt: skip

    def _places(self) -> list[int]:
        """Return the places in the order of the entries that have a row."""
        names = [self.entries[index].name for index in self.order]
        return [place for place, name in enumerate(names) if self.shown is None or name in self.shown]

    def flat(self) -> list[dict[str, object]]:
        """Return one row of values per entry, for a spreadsheet."""
        first, last = {"task": self.task, "horizon": self.horizon}, {"by": self.by, "alpha": self.alpha}
        return [{**first, **flat(self.columns(), place), **last} for place in self._places()]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON. Matrices are in the order of `entries`, from the row's side."""
        order, results = list(self.order), self.results
        square = np.ix_(order, order)
        return {
            "task": self.task,
            "horizon": self.horizon,
            "by": self.by,
            "last_epochs": None if self.by in ("area", "spread") else self.n_last,
            "alpha": self.alpha,
            "entries": [record(self.columns(), place) for place in range(len(order))],
            "improvement": results.improvement[square].tolist(),
            "difference": results.difference[square].tolist(),
            "adjusted_p": [
                [None if math.isnan(p) else float(p) for p in row] for row in results.adjusted[square]
            ],
            "better": results.better[square].tolist(),
            "unranked": [entry.label for entry in self.unranked],
            **({"missing": lines} if (lines := tables.missing([*self.entries, *self.unranked])) else {}),
        }


def means(
    results: ScoreBoard | AcrossTasks,
    order: Sequence[int],
    level: str,
    write: Callable[[float], str] = score_text,
) -> tuple[Column[int], ...]:
    """Return the columns of the mean and the interquartile mean; a row is a place of the order."""

    def read(values: Any, ends: Any) -> Callable[[int], Sequence[float]]:
        return lambda place: (values[order[place]], *ends[order[place]])

    mean = read(results.mean, results.mean_interval)
    middle = read(results.interquartile_mean, results.interquartile_interval)
    return (
        *estimate("mean", "mean_interval", mean, write, head=f"mean ({level})"),
        *estimate("interquartile_mean", "interquartile_interval", middle, write, head=f"IQM ({level})"),
    )


def rank_by_score(
    entries: Sequence[EntryResults], horizon: int, by: str = "score", alpha: float = 0.05
) -> ScoreSection:
    """Rank the entries of one task at one horizon by their scores, or by a metric of its `[ranking] costs`.

    Parameters
    ----------
    entries:
        All of one task, all reaching the horizon.
    horizon:
        Environment steps at which all are cut.
    by:
        `score`, the mean over the last tenth of the epochs; `area`, the mean over all; `spread`, see
        `qrlsuite.statistics.deviations`; or a cost. Of the last two, less is better.
    alpha:
        In (0, 1): probability of any false difference among entries of equal laws.
    """
    ranked = tuple(entry for entry in entries if len(entry.seeds) >= MIN_RUNS and not entry.missing)
    if not ranked:
        lines = tables.missing(entries) or [f"no entry has {MIN_RUNS} seeds"]
        raise OptionError(f"--by {by}: {'; '.join(lines)}")
    return replace(
        compared(ranked, horizon, by, alpha),
        unranked=tuple(entry for entry in entries if entry not in ranked),
    )


def compared(entries: Sequence[EntryResults], horizon: int, by: str, alpha: float) -> ScoreSection:
    """Compare all entries by one number per seed; arguments as for `rank_by_score`."""
    score, costs = entries[0].task_file.score, entries[0].task_file.ranking.costs
    if by not in OF_RUNS and by not in costs:
        raise OptionError(f"--by {by}: expected {' or '.join([*OF_RUNS, *costs])}")
    values = [each.curves if by in OF_RUNS else _measured(each, by) for each in entries]
    curves = [
        LearningCurves(of_runs, each.steps_per_epoch, each.label).cut(horizon)
        for of_runs, each in zip(values, entries)
    ]
    number, grid = OF_RUNS.get(by, OF_RUNS["score"]), ranking_of(entries).grid
    return ScoreSection(
        task=entries[0].task,
        horizon=horizon,
        by=by,
        alpha=alpha,
        entries=tuple(entries),
        results=compare_scores({str(k): number(each, grid) for k, each in enumerate(curves)}, alpha),
        n_last=last_epochs(curves[0].values.shape[1]),
        unranked=(),
        of=score.called if by in OF_RUNS else by,
        sign=score.sign if by in ("score", "area") else -1,
    )


def finals(section: steps.Section) -> ScoreSection | None:
    """Return all ranked entries of a board by final score, shown or not; None if it ranks none."""
    board = section.times.board
    ranked = [entry for entry, ranks in zip(section.entries, board.ranks, strict=True) if ranks[0]]
    return compared(ranked, section.horizon, "score", board.alpha) if ranked else None


def _measured(entry: EntryResults, name: str) -> NDArray[np.float64]:
    """Return a metric of an entry's environment, (N, T)."""
    values = entry.metrics.get(name)
    if values is None or np.isnan(values).any():
        raise OptionError(
            f"--by {name}: not every epoch of '{entry.label}' has it: it was trained or imported without"
        )
    return values


def sections(
    task: str,
    entries: Sequence[EntryResults],
    horizon: int | None,
    by: str,
    alpha: float = 0.05,
    shown: Callable[[EntryResults], bool] | None = None,
) -> tuple[list[ScoreSection], list[str]]:
    """Rank a task's entries by score at the horizon that most of them reach, see `boards.board.build`."""
    by_steps, problems = steps.sections(task, entries, None, horizon, alpha)
    if not by_steps or not (shown is None or any(map(shown, entries))):
        return [], problems
    main = tables.main_section(by_steps)
    members = [row.entry for row in main.tiers]  # in the order of tiers, from which the bootstrap draws
    section = rank_by_score(members, main.horizon, by, alpha)
    names = None if shown is None else frozenset(entry.name for entry in members if shown(entry))
    return [replace(section, shown=names)], problems
