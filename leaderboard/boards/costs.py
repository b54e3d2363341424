"""Boards by the costs of learning: circuit executions, shots or core-hours instead of environment steps.

The price of an entry's step is the total cost of its seeds, as recorded, divided by all their steps. With that price,
learning curves are read along the cost instead of the steps. All entries are compared within one budget, the total
cost of the cheapest: a step limit would give an entry with cheap steps a lower cap than the others, and an entry that
never learns could be first. An entry whose record lacks a needed number has no rank, and the board says why.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from qrlsuite.columns import Column, flat, record
from qrlsuite.engine.sheet import Sheet
from qrlsuite.errors import listed
from qrlsuite.leaderboard.boards import tables
from qrlsuite.leaderboard.boards.columns import estimate, names_text, ranks_column, ranks_text
from qrlsuite.leaderboard.boards.ranked import Complexity, complexity_at, ranking_of
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import hours_text, interval_text, mean_text
from qrlsuite.statistics import MIN_RUNS, Direction, LearningCurves, MeanTime, TimesBoard, times_board
from qrlsuite.statistics.compare import TOO_FEW

CELLS = 1000
"""Parts of the budget at which curves are read where the epochs of entries cost differently."""
UNEVEN = 1.05
"""The board reports that seeds differ in price if the ratio of two prices is larger than this."""


@dataclass(frozen=True)
class Unit:
    """A unit that is counted instead of environment steps.

    Attributes
    ----------
    step_text:
        Writes the price of one step.
    """

    name: str
    text: Callable[[float], str]
    step_text: Callable[[float], str]
    meaning: str


UNITS = {
    unit.name: unit
    for unit in (
        Unit(
            "executions",
            mean_text,
            mean_text,
            "executions: circuits of training, gradients and validation, each with all its shots; where a simulator "
            "differentiates exactly, as many as the parameter-shift rule would execute on hardware",
        ),
        Unit("shots", mean_text, mean_text, "shots: circuit executions times the shots of each"),
        Unit(
            "core-hours",
            hours_text,
            lambda hours: f"{3.6e6 * hours:.2g} ms",
            "core-hours: processor time of training and validation, per step in milliseconds; seeds take "
            "less in larger groups and on idle cores",
        ),
    )
}


@dataclass(frozen=True)
class Price:
    """The price of an entry's environment step.

    Attributes
    ----------
    per_step:
        Mean over its seeds; NaN where its record does not say.
    problem:
        Why the entry cannot be compared by this price; empty if it can.
    spread:
        The highest price of a seed's step over the lowest; 1 if all are equal.
    """

    per_step: float
    problem: str = ""
    spread: float = 1.0


def price(entry: EntryResults, unit: str) -> Price:
    """Return the price of an entry's environment step, by its record.

    Parameters
    ----------
    unit:
        A key of `UNITS`, or `steps` (a price of 1).
    """
    if unit == "steps":
        return Price(1.0)
    records = [record for record in entry.records.values() if record.epochs]
    kind = "hours" if unit == "core-hours" else "executions"
    of_seeds = [getattr(record, kind) / (record.epochs * entry.steps_per_epoch) for record in records]
    steps = sum(record.epochs for record in records) * entry.steps_per_epoch
    total = sum(getattr(record, kind) for record in records)
    if not total:
        if kind == "hours":
            return Price(math.nan, "no times in its record")
        if not entry.has_circuit:
            return Price(math.nan, "executes no circuits")
        return Price(math.nan, "no circuit executions in its record: its model counts none, or executes none")
    found = Price(total / steps, spread=max(of_seeds) / min(of_seeds) if min(of_seeds) else math.inf)
    if math.isinf(found.spread):
        return replace(found, problem=f"the records of some of its seeds hold no {unit}")
    if unit == "shots":
        shots = entry.options.get("model", {}).get("shots")
        if shots is None:
            return Price(math.nan, "exact values, without shots")
        return replace(found, per_step=found.per_step * shots)
    if unit == "core-hours":
        return replace(found, problem=_untimed(entry))
    return found


def _untimed(entry: EntryResults) -> str:
    """Return why an entry's hours are not processor time of one kind of processor; empty if they are."""
    if entry.clocked is None:
        return "its record does not say whether its hours are processor time or by the clock"
    if entry.clocked:
        return "hours by the clock, which other work on the cores stretches"
    if len(entry.processors) != 1:
        return f"made on {listed(entry.processors)}" if entry.processors else "its processor is not recorded"
    return ""


@dataclass(frozen=True, eq=False)
class CostRow:
    """One entry.

    Attributes
    ----------
    complexity:
        S_hat at the task's reference cell over all its epochs, in steps.
    index:
        Its place in the section's comparison; None where it is not compared.
    """

    entry: EntryResults
    price: Price
    complexity: Complexity
    index: int | None

    @property
    def shots(self) -> int | None:
        """Shots of each circuit execution; None where it computes exactly, or has no circuit."""
        shots: int | None = self.entry.options.get("model", {}).get("shots")
        return shots


@dataclass(frozen=True, eq=False)
class CostSection:
    """A task's entries by cost.

    Attributes
    ----------
    rows:
        In the order of M; entries without a rank last.
    compared:
        All pairs of ranked entries, along the cost in parts of the budget; None if there are none.
    budget:
        The total cost of the cheapest ranked entry.
    exact:
        Whether curves are read at the ends of epochs, which cost the same for all.
    """

    task: str
    cell: str
    unit: Unit
    rows: tuple[CostRow, ...]
    compared: TimesBoard | None
    budget: float
    part: float
    exact: bool
    alpha: float
    before: str = "below"
    """The side of a threshold where a run has not reached it: `below`, or `above`."""

    @property
    def title(self) -> str:
        """The title: task, unit, budget and cell."""
        within = f", within {self.unit.text(self.budget)}" if self.compared is not None else ""
        return f"{self.task} by {self.unit.name}{within}, sample complexity at {self.cell}"

    @property
    def level(self) -> str:
        """The level of every interval: `95%`."""
        return f"{100 * (1 - self.alpha):g}%"

    def columns(self) -> list[Column[CostRow]]:
        """Return the columns, costs in the unit."""

        def spent(row: CostRow) -> list[float] | None:
            mean = self.mean(row)
            return None if mean is None else [each * self.part for each in (mean.mean, *mean.interval)]

        def complexity(row: CostRow) -> list[float] | None:
            found = row.complexity
            steps = (found.steps, found.low, found.high)
            return [each * row.price.per_step for each in steps] if self.priced(row) else None

        def complexity_text(row: CostRow) -> str:
            if (costs := complexity(row)) is None:
                return "-"
            begin = "~" * self.marked(row) + ">= " * row.complexity.unsettled
            return f"{begin}{interval_text(text, *costs)[:-1]}{', at cap' * row.complexity.at_cap})"

        def per_step(row: CostRow) -> str:
            return (
                "~" * self.marked(row) + self.unit.step_text(row.price.per_step) if self.priced(row) else "-"
            )

        def at_cap(row: CostRow) -> float | None:
            return None if (mean := self.mean(row)) is None else float(mean.at_cap.mean())

        def shots(row: CostRow) -> str:
            return f"{row.shots:,}" if row.shots else "exact" if row.entry.has_circuit else "-"

        text, head = self.unit.text, f"{self.unit.name} {self.before} threshold ({self.level})"
        complexity_head = "sample complexity (5%-95%)"
        return [
            ranks_column(
                lambda row: None if (ranks := self.ranks(row)) is None else list(ranks), cell=self.rank_text
            ),
            Column("entry", lambda row: row.entry.name, cell=lambda row: row.entry.label, words=True),
            Column("label", lambda row: row.entry.label),
            *estimate("mean_cost", "mean_cost_interval", spent, text, head=head),
            Column("per_step", lambda row: row.price.per_step if self.priced(row) else None, cell=per_step),
            *estimate(
                "sample_complexity", "interval", complexity, text, head=complexity_head, cell=complexity_text
            ),
            Column("at_cap", lambda row: row.complexity.at_cap),
            Column("unsettled", lambda row: row.complexity.unsettled),
            Column("mean_at_cap", at_cap, "{:.0%}".format, head="at cap"),
            Column("shots", lambda row: row.shots, cell=shots),
            Column("seeds", lambda row: len(row.entry.seeds), str),
            Column("needs_less_than", lambda row: self.against(row, Direction.FEWER), names_text, words=True),
            Column("needs_more_than", lambda row: self.against(row, Direction.MORE), names_text, words=True),
            Column("comparable", lambda row: not row.price.problem),
            Column("problem", lambda row: row.price.problem or None),
        ]

    def sheet(self, explain: bool = False) -> Sheet:
        """Return the section as a table; `explain` adds all its notes."""
        label, name = f"{self.task}-{self.unit.name}", f"{self.task} by {self.unit.name}"
        return Sheet(
            self.title, tuple(self.columns()), self.rows, tuple(self.notes()), explain, label=label, name=name
        )

    def priced(self, row: CostRow) -> bool:
        """Whether the record has the price of a step."""
        return not math.isnan(row.price.per_step)

    def marked(self, row: CostRow) -> bool:
        """Whether it says so in numbers that cannot be compared."""
        return self.priced(row) and bool(row.price.problem)

    def ranks(self, row: CostRow) -> tuple[int, int] | None:
        """Return best and worst rank that the decided pairs leave; None for an entry without a rank."""
        if self.compared is None or row.index is None or not self.compared.ranks[row.index].all():
            return None
        best, worst = self.compared.ranks[row.index].tolist()
        return best, worst

    def rank_text(self, row: CostRow) -> str:
        """Return `3`, `3-5`, `undecided`, or `-` where the entry is not compared."""
        ranks = self.ranks(row)
        if ranks is None:
            return "-" if row.index is None else "undecided"
        return ranks_text(ranks)

    def mean(self, row: CostRow) -> MeanTime | None:
        """Return the mean cost below threshold, in parts of the budget; None where the entry is not compared."""
        return None if self.compared is None or row.index is None else self.compared.means[row.index]

    def against(self, row: CostRow, direction: Direction) -> list[str]:
        """Return the labels of the entries than which this one needs less (or more), by decided pairs."""
        if self.compared is None or row.index is None:
            return []
        directions = self.compared.directions[row.index]
        return [
            other.entry.label
            for other in self.rows
            if other.index is not None and other is not row and directions[other.index] is direction
        ]

    def notes(self) -> list[str]:
        """Explain the columns, and the marks that occur."""
        lines = tables.doubts([row.entry for row in self.rows])
        if self.compared is not None:
            lines.append(
                f"rank: by significant outperformance, within {self.unit.text(self.budget)} "
                f"{self.unit.name}, the cheapest entry's total; error {self.alpha:g} for all pairs together"
            )
        by_problem: dict[str, list[str]] = {}
        for row in self.rows:
            if row.price.problem:
                by_problem.setdefault(row.price.problem, []).append(row.entry.label)
        lines += [f"not ranked: {', '.join(labels)}: {problem}" for problem, labels in by_problem.items()]
        lines += [
            self.unit.meaning,
            "per step: the total of the entry's seeds, divided by all their environment steps; other "
            "columns: of one run; sample complexity: over all its epochs",
            f"{self.before} threshold: mean over seeds and thresholds; a run that does not get there counts with all "
            "of the budget (at cap)",
        ]
        if self.compared is not None and not self.exact:
            lines.append(f"curves are read at {CELLS} equal parts of the budget")
        if any(self.marked(row) for row in self.rows):
            lines.append("~ : not comparable with the others")
        shots = {row.shots for row in self.rows if row.index is not None}
        if self.unit.name == "executions" and len(shots) > 1:
            lines.append("executions of different shots count alike here; --by shots counts shots")
        uneven = [row for row in self.rows if UNEVEN < row.price.spread < math.inf]
        lines += [
            f"{row.entry.label}: a step costs up to {row.price.spread:.2g} times as much in one seed as in another; "
            "the mean is used for all"
            for row in uneven
        ]
        if any(row.complexity.unsettled for row in self.rows if self.priced(row)):
            lines.append(">= : still below delta at the last epoch; the sample complexity is at least this")
        if any(row.index is not None and len(row.entry.seeds) < MIN_RUNS for row in self.rows):
            lines.append(TOO_FEW)
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "task": self.task,
            "by": self.unit.name,
            "budget": self.budget if self.compared is not None else None,
            "alpha": self.alpha,
            "cell": self.cell,
            "rows": [record(self.columns(), row) for row in self.rows],
            "notes": self.notes(),
        }

    def flat(self) -> list[dict[str, object]]:
        """Return one row of values per entry, for a spreadsheet."""
        budget = self.budget if self.compared is not None else None
        facts = {"by": self.unit.name, "budget": budget}
        return [{"task": self.task, **flat(self.columns(), row), **facts} for row in self.rows]


def sections(
    task: str,
    entries: Sequence[EntryResults],
    by: str,
    alpha: float = ALPHA,
) -> tuple[list[CostSection], list[str]]:
    """Rank the entries of a task by their costs of learning; arguments as for `boards.board.build`.

    Returns
    -------
    tuple
        The section; and one line for each entry that was left out: if some entries reach the task's shortest horizon,
        the shorter ones are left out.
    """
    paid = {id(entry): price for entry, price in zip(entries, prices(entries, UNITS[by].name))}
    payable = [entry for entry in entries if not paid[id(entry)].problem]
    members, short = collect.equally_long(payable or entries)  # who pays nothing sets no horizon
    others = [entry for entry in entries if payable and paid[id(entry)].problem]
    shown = [*members, *others]
    return [_section(task, shown, [paid[id(entry)] for entry in shown], UNITS[by], alpha)], short


def _section(
    task: str, entries: Sequence[EntryResults], paid: Sequence[Price], unit: Unit, alpha: float
) -> CostSection:
    ranking = ranking_of(entries)
    places = [place for place, found in enumerate(paid) if not found.problem]
    budget, part, exact, compared = math.nan, math.nan, True, None
    if places:
        budget, part, exact, curves = along([entries[p] for p in places], [paid[p].per_step for p in places])
        compared = times_board(curves, ranking.grid, alpha)
    order = [places[index] for index in compared.order] if compared is not None else []
    order += sorted(set(range(len(entries))) - set(order), key=lambda place: entries[place].label)
    rows = []
    for place in order:
        entry = entries[place]
        horizon = int(entry.curves.shape[1]) * entry.steps_per_epoch
        complexity = complexity_at(entry.curves, ranking, entry.steps_per_epoch, horizon)
        rows.append(CostRow(entry, paid[place], complexity, places.index(place) if place in places else None))
    return CostSection(
        task, ranking.cell, unit, tuple(rows), compared, budget, part, exact, alpha, ranking.before
    )


def prices(entries: Sequence[EntryResults], unit: str) -> list[Price]:
    """Return every entry's price; core-hours of a processor that most of the others were not made on are no price."""
    paid = [price(entry, unit) for entry in entries]
    if unit != "core-hours":
        return paid
    made_on = Counter(e.processors[0] for e, found in zip(entries, paid) if not found.problem)
    usual = min(made_on, key=lambda name: (-made_on[name], name), default="")
    return [
        found
        if found.problem or entry.processors[0] == usual
        else replace(found, problem=f"made on {entry.processors[0]}, the others on {usual}")
        for entry, found in zip(entries, paid)
    ]


def along(
    entries: Sequence[EntryResults], per_step: Sequence[float]
) -> tuple[float, float, bool, list[LearningCurves]]:
    """Return the entries' curves along the cost, given the prices of their steps.

    Returns
    -------
    tuple
        The budget (the total cost of the cheapest entry); the cost of one of its equal parts; whether the parts are the
        epochs, at one price for all; and the curves, an epoch for each part.
    """
    costs = [price * entry.steps_per_epoch for price, entry in zip(per_step, entries)]
    budget = min(cost * entry.curves.shape[1] for cost, entry in zip(costs, entries))
    exact = bool(np.allclose(costs, costs[0], rtol=1e-9, atol=0))
    parts = round(budget / min(costs)) if exact else CELLS
    curves = [_along(entry, cost, budget / parts, parts) for entry, cost in zip(entries, costs)]
    return budget, budget / parts, exact, curves


def _along(entry: EntryResults, cost: float, part: float, parts: int) -> LearningCurves:
    """Return curves along the cost: of every part of the budget, the epoch that is being paid for at its end."""
    ends = part * np.arange(1, parts + 1) / cost
    epochs = np.clip(np.ceil(ends - 1e-9).astype(np.int64) - 1, 0, entry.curves.shape[1] - 1)
    return LearningCurves(entry.curves[:, epochs], 1, entry.name, not entry.missing)
