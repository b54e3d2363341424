"""The board by environment steps: ranks by time below threshold, tiers by the paper's definition, horizon by horizon.

Everything is computed here from raw curves. Entries that are shorter than the task's shortest horizon stand in
a provisional section of their own length.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from qrlsuite.errors import PluginError, QrlSuiteError
from qrlsuite.experiment.task import ScoreSection, digest
from qrlsuite.leaderboard.boards.ranked import (
    Complexity,
    complexity_at,
    learning_curves,
    ranking_of,
    rule_of,
)
from qrlsuite.leaderboard.boards.times import TimeRanking, rank_by_time
from qrlsuite.leaderboard.rules import DEFAULT, TIMES
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.statistics import MIN_RUNS, Board, SignificanceRule, final_scores, last_epochs, outperformance
from qrlsuite.statistics.compare import TOO_FEW

SUPPORT = ("winner", "loser", "cells", "at_cap", "total")
"""Columns of a spreadsheet about the win that a tier rests on."""


@dataclass(frozen=True)
class Support:
    """The narrowest win in the chain that puts an entry into its tier.

    Attributes
    ----------
    winner, loser:
        Labels of the pair.
    cells:
        Cells in which the winner needs significantly fewer samples.
    at_cap:
        Cells that say nothing, because both are at the cap.
    total:
        Cells of the grid.
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


@dataclass(frozen=True)
class Row:
    """One entry of a section.

    Attributes
    ----------
    tier:
        None for an entry that is undecided, or reached the goal of no cell.
    wins, losses:
        Cells of the ranking grid, over all other entries, in which it needs significantly fewer samples, and more.
    """

    entry: EntryResults
    tier: int | None
    reference: Complexity
    final_score: float
    """Mean over seeds, of each its mean over the last tenth of the epochs."""
    copeland: int
    wins: int
    losses: int
    outperforms: tuple[str, ...]
    outperformed_by: tuple[str, ...]
    provisional: bool
    """Fewer seeds than the task's protocol asks for."""
    not_reached: bool = False
    """At the cap in every cell: below the entries that outperform it, not ranked among others like it."""
    costs: Mapping[str, float | None] = field(default_factory=dict)
    """Metrics of `[ranking] costs` by name: means over seeds and the last tenth of the epochs."""
    rests_on: Support | None = None
    """None in the first tier, and without a tier."""

    @property
    def depth(self) -> float:
        """The sort key on the board: the tier, infinity for an entry at the cap everywhere, 0 if undecided."""
        return float("inf") if self.not_reached else float(self.tier or 0)

    @property
    def reason(self) -> str:
        """Why the entry has no tier; empty where it has one."""
        return "" if self.tier is not None else untiered_reason(self)


@dataclass(frozen=True)
class Section:
    """The ranking of a task's entries at one horizon."""

    task: str
    summary: str
    horizon: int
    provisional: bool
    """Shorter than the task's own horizons."""
    cell: str
    rows: tuple[Row, ...]
    pairs: Board
    """The verdicts of all pairs, cell by cell."""
    times: TimeRanking
    """The same entries by steps below threshold, which ranks them."""
    rule: str = DEFAULT
    """Name of the significance rule that the tiers rest on."""
    promise: str = ""
    """The error that the rule controls."""
    by_tiers: bool = False
    """Whether tables show tiers by that rule in the place of ranks: where it was asked for, or the task names it."""
    score: ScoreSection = field(default_factory=ScoreSection)
    """The score that is ranked."""
    costs: tuple[str, ...] = ()
    """The metrics that stand beside the score."""
    policies: Mapping[str, float] = field(default_factory=dict)
    """Final scores of policies to compare with, by name, as the task's `[ranking.policies]` says."""

    @property
    def before(self) -> str:
        """The side of a threshold where a run has not reached it: `below`, or `above`."""
        return self.score.before

    @property
    def hash(self) -> str:
        """16 hexadecimal digits of the ranked entries with their tasks, seeds and scores, in any order."""
        return digest([self.horizon, sorted(map(_content, (row.entry for row in self.rows)))])

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "task": self.task,
            "horizon": self.horizon,
            "hash": self.hash,
            "provisional": self.provisional,
            "cell": self.cell,
            "rule": self.rule,
            **({"policies": dict(self.policies)} if self.policies else {}),
            "times": self.times.as_dict(),
            "rows": [_row_dict(row) for row in self.rows],
        }

    def flat(self) -> list[dict[str, object]]:
        """Return one row of values per entry in the order of the table, for a spreadsheet."""
        place = {id(row.entry): index for index, row in enumerate(self.times.rows)}
        rows = self.rows if self.by_tiers else sorted(self.rows, key=lambda row: place[id(row.entry)])
        return [self._flat_row(row) for row in rows]

    def _flat_row(self, row: Row) -> dict[str, object]:
        values = _row_dict(row)
        low, high = values.pop("interval")
        count = values.pop("parameters")
        tuning = values.pop("tuning") or {}
        support = values.pop("rests_on") or {}
        costs = values.pop("costs", {})
        times = self.times.flat(row.entry)
        tiers = {name: values.pop(name) for name in ("tier", "verdict")}
        return {
            "task": self.task,
            "horizon": self.horizon,
            "rank": times.pop("rank"),
            "rank_worst": times.pop("rank_worst"),
            **values,
            "interval_low": low,
            "interval_high": high,
            "cell": self.cell,
            "parameters_classical": count["classical"],
            "parameters_quantum": count["quantum"],
            "parameters_fixed": count["fixed"],
            "networks": count["networks"],
            "tuned": bool(tuning),
            "tuned_on_protocol_seeds": bool(tuning.get("on_protocol_seeds")),
            **times,
            "rule": self.rule,
            **tiers,
            **{f"rests_on_{name}": support.get(name) for name in SUPPORT},
            **{f"cost_{name}": value for name, value in costs.items()},
        }


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
            section = _section(task, steps, provisional, group, chosen, alpha, shown)
            made.append(replace(section, by_tiers=named and chosen.name != TIMES))
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
    lengths = sorted({_length(entry) for entry in short}, reverse=True)
    for steps in lengths:
        reached = [entry.reaching(steps // entry.steps_per_epoch) for entry in short]
        groups.append((steps, True, [entry for entry in reached if entry is not None]))
    return groups


def _length(entry: EntryResults) -> int:
    return int(entry.curves.shape[1]) * entry.steps_per_epoch


def _section(
    task: str,
    horizon: int,
    provisional: bool,
    entries: Sequence[EntryResults],
    rule: SignificanceRule,
    alpha: float,
    shown: Callable[[EntryResults], bool] | None,
) -> Section:
    ranking = ranking_of(entries)
    board = outperformance([learning_curves(entry) for entry in entries], ranking.grid, rule, horizon=horizon)
    by_name = {entry.name: entry for entry in entries}
    labels = {entry.name: entry.label for entry in entries}
    protocol_seeds = entries[0].task_file.protocol.seeds
    rows = []
    places, better = board.ranking, board.better_cells
    capped = {place.name for place in places.not_reached}
    for place in places.entries:
        entry = by_name[place.name]
        if shown is not None and not shown(entry):
            continue
        values = entry.curves[:, : horizon // entry.steps_per_epoch]
        rows.append(
            Row(
                entry=entry,
                tier=place.tier,
                reference=complexity_at(values, ranking, entry.steps_per_epoch, horizon),
                final_score=float(final_scores(learning_curves(entry).cut(horizon)).mean()),
                copeland=place.copeland,
                wins=int(better[board.names.index(place.name)].sum()),
                losses=int(better[:, board.names.index(place.name)].sum()),
                outperforms=tuple(labels[name] for name in place.outperforms),
                outperformed_by=tuple(labels[name] for name in place.outperformed_by),
                provisional=len(entry.seeds) < protocol_seeds,
                not_reached=place.name in capped,
                costs={name: _last(entry, name, values.shape[1]) for name in ranking.costs},
                rests_on=_support(board, place.rests_on, labels),
            )
        )
    return Section(
        task=task,
        summary=entries[0].task_file.summary,
        horizon=horizon,
        provisional=provisional,
        cell=ranking.cell,
        rows=tuple(rows),
        pairs=board,
        times=rank_by_time(entries, ranking.grid, horizon, alpha, shown),
        rule=rule.name,
        promise=rule.promise,
        score=entries[0].task_file.score,
        costs=tuple(ranking.costs),
        policies=ranking.policies,
    )


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


def untiered_reason(row: Row) -> str:
    """Return why an entry has no tier."""
    if row.not_reached:
        return "not reached: at the cap in every cell, and not ranked among each other"
    if len(row.entry.seeds) < MIN_RUNS:
        return TOO_FEW
    return "undecided: nothing to compare with"


def _content(entry: EntryResults) -> list[str]:
    scores = hashlib.sha256(np.array(entry.seeds, "<i8").tobytes() + entry.curves.astype("<f8").tobytes())
    return [entry.name, entry.task_hash, scores.hexdigest()]


def _row_dict(row: Row) -> dict[str, Any]:
    entry = row.entry
    return {
        "tier": row.tier,
        "verdict": "ranked" if row.tier is not None else untiered_reason(row),
        "rests_on": None if row.rests_on is None else asdict(row.rests_on),
        "entry": entry.name,
        "label": entry.label,
        "external": entry.external,
        "parameters": {
            "classical": entry.parameters[0],
            "quantum": entry.parameters[1],
            "fixed": entry.fixed,
            "networks": entry.networks,
        },
        "settings": entry.settings,
        "seeds": len(entry.seeds),
        "unfinished_seeds": len(entry.left_out),
        "diverged_seeds": list(entry.diverged),
        "provisional": row.provisional,
        "sample_complexity": row.reference.steps,
        "interval": [row.reference.low, row.reference.high],
        "at_cap": row.reference.at_cap,
        "unsettled": row.reference.unsettled,
        "final_score": row.final_score,
        **({"costs": dict(row.costs)} if row.costs else {}),
        "copeland": row.copeland,
        "wins": row.wins,
        "losses": row.losses,
        "outperforms": list(row.outperforms),
        "outperformed_by": list(row.outperformed_by),
        "core_hours": entry.hours,
        "tuning": entry.tuning,
    }
