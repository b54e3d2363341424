"""The board by environment steps: ranks by steps below threshold, tiers by the paper's definition, horizon by horizon.

Everything is computed here from raw curves. Entries that are shorter than the task's shortest horizon stand in
a provisional section of their own length.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from qrlsuite.columns import Column, flat, record
from qrlsuite.errors import PluginError, QrlSuiteError
from qrlsuite.experiment.task import RankingSection, ScoreSection, digest
from qrlsuite.leaderboard.boards import columns, tables
from qrlsuite.leaderboard.boards.ranked import (
    Complexity,
    complexity_at,
    learning_curves,
    ranking_of,
    rule_of,
    unranked_since,
)
from qrlsuite.leaderboard.boards.times import TimeRanking, TimeRow, rank_by_time
from qrlsuite.leaderboard.rules import STEPS
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.statistics import Board, SignificanceRule, last_epochs, outperformance


@dataclass(frozen=True)
class Support:
    """The narrowest win in the chain that puts an entry into its tier.

    Attributes
    ----------
    cells:
        Cells in which the winner needs significantly fewer samples.
    at_cap:
        Cells that say nothing, because both are at the cap.
    """

    winner: str
    loser: str
    cells: int
    at_cap: int
    total: int

    @property
    def text(self) -> str:
        """`1 of 3`: won, of the cells in which not both are at the cap."""
        return f"{self.cells} of {self.total - self.at_cap}"

    @property
    def sentence(self) -> str:
        """The winner, and the number of cells that say nothing."""
        return f"{self.winner} against {self.loser}: {self.at_cap} of {self.total} cells at the cap for both"


@dataclass(frozen=True)
class Row:
    """One entry of a section.

    Attributes
    ----------
    time:
        Its rank, by steps below threshold.
    costs:
        The metrics that `[ranking] costs` names: means over seeds and the last tenth of the epochs.
    provisional:
        Whether it has fewer seeds than the task's protocol asks for.
    """

    entry: EntryResults
    time: TimeRow
    reference: Complexity
    costs: Mapping[str, float | None]
    provisional: bool
    horizon: int

    @cached_property
    def cut(self) -> EntryResults:
        """The entry with its curves up to the horizon."""
        return self.entry.cut(self.horizon // self.entry.steps_per_epoch) or self.entry


@dataclass(frozen=True)
class TieredRow(Row):
    """One entry of a section with its tier.

    Attributes
    ----------
    tier:
        None for an entry that is undecided, or reached the goal of no cell.
    wins, losses:
        Cells of the ranking grid, over all other entries, in which it needs significantly fewer samples, and more.
    not_reached:
        Whether it is at the cap in every cell: below those that outperform it, not ranked among others like it.
    rests_on:
        None in the first tier, and without a tier.
    """

    tier: int | None
    copeland: int
    wins: int
    losses: int
    outperforms: tuple[str, ...]
    outperformed_by: tuple[str, ...]
    not_reached: bool
    rests_on: Support | None

    @property
    def reason(self) -> str:
        """Why the entry has no tier; empty where it has one."""
        if self.tier is not None:
            return ""
        if self.not_reached:
            return "not reached: at the cap in every cell, and not ranked among each other"
        if self.time.ranks is None:
            return unranked_since(self.entry)
        return "undecided: nothing to compare with"


@dataclass(frozen=True)
class Section:
    """The ranking of a task's entries at one horizon.

    Attributes
    ----------
    provisional:
        Whether it is shorter than the task's own horizons.
    ranking, score:
        The task's thresholds, cells, costs and policies; and its score.
    rows:
        The shown entries, in the order of their steps below threshold.
    judge:
        The significance rule that the tiers rest on.
    by_tiers:
        Whether tables show tiers by that rule in the place of ranks: if the user or the task names it.
    """

    task: str
    horizon: int
    provisional: bool
    ranking: RankingSection
    score: ScoreSection
    entries: tuple[EntryResults, ...]
    rows: tuple[Row, ...]
    times: TimeRanking
    judge: SignificanceRule
    by_tiers: bool = False

    @property
    def rule(self) -> str:
        """Name of the significance rule that the tiers rest on."""
        return self.judge.name

    @property
    def promise(self) -> str:
        """The error that the rule controls."""
        return self.judge.promise

    @property
    def before(self) -> str:
        """The side of a threshold where a run has not reached it: `below`, or `above`."""
        return self.score.before

    @property
    def hash(self) -> str:
        """16 hexadecimal digits of the ranked entries with their tasks, seeds and scores, in any order."""
        return digest([self.horizon, sorted(map(_content, (row.entry for row in self.rows)))])

    @cached_property
    def pairs(self) -> Board:
        """The verdicts of all pairs, cell by cell, by the rule."""
        curves = [learning_curves(entry) for entry in self.entries]
        return outperformance(curves, self.ranking.grid, self.judge, horizon=self.horizon)

    @cached_property
    def tiers(self) -> tuple[TieredRow, ...]:
        """The rows with their tiers, in the order of these."""
        board, rows = self.pairs, {row.entry.name: row for row in self.rows}
        labels = {entry.name: entry.label for entry in self.entries}
        better = board.better_cells
        capped = {place.name for place in board.ranking.not_reached}
        return tuple(
            TieredRow(
                **{each.name: getattr(rows[place.name], each.name) for each in fields(Row)},
                tier=place.tier,
                copeland=place.copeland,
                wins=int(better[board.names.index(place.name)].sum()),
                losses=int(better[:, board.names.index(place.name)].sum()),
                outperforms=tuple(labels[name] for name in place.outperforms),
                outperformed_by=tuple(labels[name] for name in place.outperformed_by),
                not_reached=place.name in capped,
                rests_on=_support(board, place.rests_on, labels),
            )
            for place in board.ranking.entries
            if place.name in rows
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        of_ranks = columns.ranks(self)
        of_tiers: tuple[Column[TieredRow], ...] = (*columns.tiers(self), *columns.facts(self))
        return {
            "task": self.task,
            "horizon": self.horizon,
            "hash": self.hash,
            "provisional": self.provisional,
            "cell": self.ranking.cell,
            "rule": self.rule,
            **({"missing": lines} if (lines := tables.missing(self.entries)) else {}),
            **({"policies": dict(self.ranking.policies)} if self.ranking.policies else {}),
            "times": {**self.times.as_dict(), "entries": [record(of_ranks, row) for row in self.rows]},
            "rows": [record(of_tiers, row) for row in self.tiers],
        }

    def flat(self) -> list[dict[str, object]]:
        """Return one row of values per entry in the order of the table, for a spreadsheet."""
        order = {row.entry.name: place for place, row in enumerate(self.rows)}
        rows = self.tiers if self.by_tiers else sorted(self.tiers, key=lambda row: order[row.entry.name])
        shown = (*columns.ranks(self), *columns.facts(self))
        return [
            {
                "task": self.task,
                "horizon": self.horizon,
                **flat(shown, row),
                "cell": self.ranking.cell,
                "tuned": bool(row.entry.tuning),
                "tuned_on_protocol_seeds": row.entry.on_protocol_seeds,
                **self.times.against(row.time),
                "alpha": self.times.board.alpha,
                "rule": self.rule,
                **flat(columns.tiers(self), row),
            }
            for row in rows
        ]


def sections(
    task: str,
    entries: Sequence[EntryResults],
    rule: SignificanceRule | None = None,
    horizon: int | None = None,
    alpha: float = 0.05,
    shown: Callable[[EntryResults], bool] | None = None,
) -> tuple[list[Section], list[str]]:
    """Rank the entries of a task, horizon by horizon; arguments as for `qrlsuite.leaderboard.boards.board.build`.

    Returns
    -------
    tuple
        The sections, and one line for each that cannot be made.
    """
    made, problems = list[Section](), list[str]()
    for steps, provisional, group in _by_horizon(entries, horizon):
        if shown is not None and not any(map(shown, group)):
            continue
        try:
            chosen = rule or rule_of(group)
            named = rule is not None or ranking_of(group).rule is not None
            by_tiers = named and chosen.name != STEPS
            section = _section(task, steps, provisional, group, chosen, by_tiers, alpha, shown)
            if by_tiers:
                _ = section.tiers  # a rule that fails is reported here
            made.append(section)
        except PluginError:
            raise
        except QrlSuiteError as error:
            problems.append(f"task '{task}' at {steps} steps: {error}")
    return made, problems


def _by_horizon(
    entries: Sequence[EntryResults], requested: int | None
) -> list[tuple[int, bool, list[EntryResults]]]:
    """Divide entries of a task: (horizon, provisional, members); a long entry is in every section it reaches."""
    horizons = sorted(ranking_of(entries).horizons)
    groups = []
    for horizon in horizons if requested is None else [requested]:
        reached = [entry.reaching(horizon // entry.steps_per_epoch) for entry in entries]
        members = [entry for entry in reached if entry is not None]
        if members:
            groups.append((horizon, horizon < horizons[0], members))
    if requested is not None:
        return groups
    short = [entry for entry in entries if entry.longest * entry.steps_per_epoch < horizons[0]]
    lengths = sorted({entry.curves.shape[1] * entry.steps_per_epoch for entry in short}, reverse=True)
    for steps in lengths:
        reached = [entry.reaching(steps // entry.steps_per_epoch) for entry in short]
        groups.append((steps, True, [entry for entry in reached if entry is not None]))
    return groups


def _section(
    task: str,
    horizon: int,
    provisional: bool,
    entries: Sequence[EntryResults],
    rule: SignificanceRule,
    by_tiers: bool,
    alpha: float,
    shown: Callable[[EntryResults], bool] | None,
) -> Section:
    ranking, protocol_seeds = ranking_of(entries), entries[0].task_file.protocol.seeds
    times = rank_by_time(entries, ranking.grid, horizon, alpha, shown)
    rows = []
    for time in times.rows:
        entry = time.entry
        values = entry.curves[:, : horizon // entry.steps_per_epoch]
        rows.append(
            Row(
                entry=entry,
                time=time,
                reference=complexity_at(values, ranking, entry.steps_per_epoch, horizon),
                costs={name: _last(entry, name, values.shape[1]) for name in ranking.costs},
                provisional=len(entry.seeds) < protocol_seeds,
                horizon=horizon,
            )
        )
    score, compared = entries[0].task_file.score, tuple(entries)
    return Section(task, horizon, provisional, ranking, score, compared, tuple(rows), times, rule, by_tiers)


def _last(entry: EntryResults, name: str, epochs: int) -> float | None:
    """Return the mean over seeds and the last tenth of the epochs of a metric; None where one has none."""
    values = entry.metrics.get(name)
    if values is None:
        return None
    last = float(values[:, epochs - last_epochs(epochs) : epochs].mean())
    return None if math.isnan(last) else last


def _support(board: Board, pair: tuple[str, str] | None, labels: Mapping[str, str]) -> Support | None:
    if pair is None:
        return None
    won, lost = (board.names.index(name) for name in pair)
    return Support(
        winner=labels[pair[0]],
        loser=labels[pair[1]],
        cells=int((board.signs[won, lost] > 0).sum()),
        at_cap=int(board.capped[won, lost].sum()),
        total=board.signs[won, lost].size,
    )


def _content(entry: EntryResults) -> list[str]:
    scores = hashlib.sha256(np.array(entry.seeds, "<i8").tobytes() + entry.curves.astype("<f8").tobytes())
    return [entry.name, entry.task_hash, scores.hexdigest()]
