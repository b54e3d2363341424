"""Boards by what learning costs: circuit executions, shots or core-hours in the place of environment steps.

Every entry's own record says what its steps cost: all that its seeds took, divided by all their steps. With it,
its learning curves are read along the cost instead of the steps. Entries are compared within one budget, what the
cheapest of them spent in all: a step limit would give an entry with cheap steps a lower cap than the others, and an
entry that never learns could be first. Where a record does not hold what a comparison needs, an entry has no rank,
and the board says why.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, listed, nearest
from qrlsuite.leaderboard.board import Complexity, cell_text, complexity_at, of_one_definition, ranking_of
from qrlsuite.leaderboard.sheet import Sheet
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.times import ALPHA
from qrlsuite.results.text import hours_text, steps_text
from qrlsuite.statistics import MIN_RUNS, Direction, LearningCurves, MeanTime, TimesBoard, times_board
from qrlsuite.statistics.compare import TOO_FEW
from qrlsuite.statistics.times import check_probability

CELLS = 1000
"""Parts of the budget at which curves are read where the epochs of entries cost differently."""
UNEVEN = 1.05
"""Ratio of the costs of a step of two seeds beyond which it is said that they differ."""


@dataclass(frozen=True)
class Unit:
    """What is counted in the place of environment steps.

    Attributes
    ----------
    text:
        Writes a number of them.
    step_text:
        Writes what one step costs.
    meaning:
        What is counted, in a sentence.
    """

    name: str
    text: Callable[[float], str]
    step_text: Callable[[float], str]
    meaning: str


def _count(number: float) -> str:
    return steps_text(number, digits=3)


UNITS = {
    unit.name: unit
    for unit in (
        Unit(
            "executions",
            _count,
            _count,
            "executions: circuits of training, gradients and validation, each with all its shots; where a simulator "
            "differentiates exactly, as many as the parameter-shift rule would execute on hardware",
        ),
        Unit("shots", _count, _count, "shots: circuit executions times the shots of each"),
        Unit(
            "core-hours",
            hours_text,
            lambda hours: f"{3.6e6 * hours:.2g} ms",
            "core-hours: processor time of training and validation, per step in milliseconds; seeds that train in "
            "larger groups take less, and so they do on idle cores",
        ),
    )
}


@dataclass(frozen=True)
class Price:
    """What an environment step of an entry costs.

    Attributes
    ----------
    per_step:
        Mean over its seeds; NaN where its record does not say.
    problem:
        Why the entry cannot be compared by it; empty where it can.
    spread:
        The largest of its seeds' costs of a step over the smallest; 1 where all are equal.
    """

    per_step: float
    problem: str = ""
    spread: float = 1.0


def price(entry: EntryResults, unit: str) -> Price:
    """Return what an entry's environment step costs, by its record.

    Parameters
    ----------
    unit:
        A key of `UNITS`, or `steps`, of which every step is one.
    """
    if unit == "steps":
        return Price(1.0)
    records = [record for record in entry.records.values() if record["epochs"]]
    kind = "hours" if unit == "core-hours" else "executions"
    of_seeds = [record[kind] / (record["epochs"] * entry.steps_per_epoch) for record in records]
    steps = sum(record["epochs"] for record in records) * entry.steps_per_epoch
    total = sum(record[kind] for record in records)
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
    """Say why an entry's hours are not processor time of one kind of processor; empty where they are."""
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


@dataclass(frozen=True, eq=False)
class CostSection:
    """A task's entries by cost.

    Attributes
    ----------
    rows:
        In the order of M, those that are not compared last.
    compared:
        All pairs of the others, along the cost in parts of the budget; None where there are none.
    budget:
        What all of these have spent in all, at least.
    part:
        Cost of one part.
    """

    task: str
    cell: str
    unit: Unit
    rows: tuple[CostRow, ...]
    compared: TimesBoard | None
    budget: float
    part: float
    alpha: float

    @property
    def title(self) -> str:
        """What is compared."""
        within = f", within {self.unit.text(self.budget)}" if self.compared is not None else ""
        return f"{self.task} by {self.unit.name}{within}, sample complexity at {self.cell}"

    @property
    def level(self) -> str:
        """The level of every interval: `95%`."""
        return f"{100 * (1 - self.alpha):g}%"

    def columns(self) -> tuple[str, ...]:
        """Return the heads of the table that `cells` fills."""
        below = f"{self.unit.name} below threshold ({self.level})"
        names = ("rank", "entry", below, "per step", "sample complexity (5%-95%)", "at cap", "shots", "seeds")
        return (*names, "needs less than", "needs more than")

    def sheet(self, explain: bool = False) -> Sheet:
        """Return the section as a table; `explain` adds all its notes."""
        rows = [self.cells(row) for row in self.rows]
        words = ("entry", "needs less than", "needs more than")
        label = f"{self.task}-{self.unit.name}"
        return Sheet.of(self.title, self.columns(), rows, self.notes(), words, label, explain)

    def cells(self, row: CostRow) -> tuple[str, ...]:
        """Return a row as text."""
        mean = self.mean(row)
        shots = row.entry.options.get("model", {}).get("shots")
        return (
            self.rank_text(row),
            row.entry.label,
            "-" if mean is None else self._mean_text(mean),
            ("~" * self.marked(row)) + self.unit.step_text(row.price.per_step) if self.priced(row) else "-",
            ("~" * self.marked(row)) + self._complexity_text(row) if self.priced(row) else "-",
            "-" if mean is None else f"{mean.at_cap.mean():.0%}",
            f"{shots:,}" if shots else "exact" if row.entry.has_circuit else "-",
            f"{len(row.entry.seeds)}",
            ", ".join(self.against(row, Direction.FEWER)) or "-",
            ", ".join(self.against(row, Direction.MORE)) or "-",
        )

    def priced(self, row: CostRow) -> bool:
        """Whether the record says what a step costs."""
        return not math.isnan(row.price.per_step)

    def marked(self, row: CostRow) -> bool:
        """Whether it says so in numbers that cannot be compared."""
        return self.priced(row) and bool(row.price.problem)

    def ranks(self, row: CostRow) -> tuple[int, int] | None:
        """Return best and worst rank that the decided pairs leave; None for an entry without a rank."""
        if self.compared is None or row.index is None or len(row.entry.seeds) < MIN_RUNS:
            return None
        best, worst = self.compared.ranks[row.index].tolist()
        return best, worst

    def rank_text(self, row: CostRow) -> str:
        """Return `3`, `3-5`, `undecided`, or `-` where the entry is not compared."""
        ranks = self.ranks(row)
        if ranks is None:
            return "-" if row.index is None else "undecided"
        return str(ranks[0]) if ranks[0] == ranks[1] else f"{ranks[0]}-{ranks[1]}"

    def mean(self, row: CostRow) -> MeanTime | None:
        """Return the mean cost below threshold, in parts of the budget; None where the entry is not compared."""
        return None if self.compared is None or row.index is None else self.compared.means[row.index]

    def against(self, row: CostRow, direction: Direction) -> list[str]:
        """Return the labels of the entries of which a decided pair says that this one needs less, or more."""
        if self.compared is None or row.index is None:
            return []
        directions = self.compared.directions[row.index]
        return [
            other.entry.label
            for other in self.rows
            if other.index is not None and other is not row and directions[other.index] is direction
        ]

    def _mean_text(self, mean: MeanTime) -> str:
        point, low, high = (self.unit.text(value * self.part) for value in (mean.mean, *mean.interval))
        return f"{point} ({low} to {high})"

    def _complexity_text(self, row: CostRow) -> str:
        found = row.complexity
        point, low, high = (
            self.unit.text(steps * row.price.per_step) for steps in (found.steps, found.low, found.high)
        )
        return f"{'>= ' * found.unsettled}{point} ({low} to {high}{', at cap' * found.at_cap})"

    def notes(self) -> list[str]:
        """Explain the columns, and the marks that occur."""
        lines = []
        if self.compared is not None:
            lines.append(
                f"rank: by significant outperformance, within {self.unit.text(self.budget)} {self.unit.name}, which is "
                f"what the cheapest spent in all; error {self.alpha:g} for all pairs together"
            )
        by_problem: dict[str, list[str]] = {}
        for row in self.rows:
            if row.price.problem:
                by_problem.setdefault(row.price.problem, []).append(row.entry.label)
        lines += [f"not ranked: {', '.join(labels)}: {problem}" for problem, labels in by_problem.items()]
        lines += [
            self.unit.meaning,
            "per step: what the entry's seeds took in all, divided by all their environment steps; the others: of one "
            "run; sample complexity: over all its epochs",
            "below threshold: mean over seeds and thresholds; a run that does not get there counts with all of the "
            "budget (at cap)",
        ]
        if self.compared is not None and not self.exact:
            lines.append(f"curves are read at {CELLS} equal parts of the budget")
        if any(self.marked(row) for row in self.rows):
            lines.append("~ : not to be compared with the others")
        shots = {
            row.entry.options.get("model", {}).get("shots") for row in self.rows if row.index is not None
        }
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

    @property
    def exact(self) -> bool:
        """Whether curves are read at the ends of epochs, which cost the same for all."""
        costs = [row.price.per_step * row.entry.steps_per_epoch for row in self.rows if row.index is not None]
        return _equal(costs)

    def row_dict(self, row: CostRow) -> dict[str, Any]:
        """Return one entry's plain values, costs in the unit."""
        mean, ranks, cost = self.mean(row), self.ranks(row), row.price.per_step
        known = self.priced(row)
        return {
            "entry": row.entry.name,
            "label": row.entry.label,
            "ranks": None if ranks is None else list(ranks),
            "seeds": len(row.entry.seeds),
            "shots": row.entry.options.get("model", {}).get("shots"),
            "per_step": cost if known else None,
            "comparable": not row.price.problem,
            "problem": row.price.problem or None,
            "sample_complexity": row.complexity.steps * cost if known else None,
            "interval": [row.complexity.low * cost, row.complexity.high * cost] if known else None,
            "at_cap": row.complexity.at_cap,
            "unsettled": row.complexity.unsettled,
            "mean_cost": None if mean is None else mean.mean * self.part,
            "mean_cost_interval": None if mean is None else [end * self.part for end in mean.interval],
            "mean_at_cap": None if mean is None else float(mean.at_cap.mean()),
            "needs_less_than": self.against(row, Direction.FEWER),
            "needs_more_than": self.against(row, Direction.MORE),
        }


@dataclass(frozen=True, eq=False, repr=False)
class CostBoard(Shown):
    """The result of `build`: a section for each task, and lines about entries that were left out.

    It shows itself as a table per section.
    """

    sections: tuple[CostSection, ...]
    refused: tuple[str, ...]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for section in self.sections:
            yield section.sheet()
        for line in self.refused:
            yield Text(f"left out: {line}")

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "sections": [
                {
                    "task": section.task,
                    "by": section.unit.name,
                    "budget": section.budget if section.compared is not None else None,
                    "alpha": section.alpha,
                    "cell": section.cell,
                    "rows": [section.row_dict(row) for row in section.rows],
                    "notes": section.notes(),
                }
                for section in self.sections
            ],
            "refused": list(self.refused),
        }

    def flat(self) -> list[dict[str, object]]:
        """Return one row of columns per entry, for a spreadsheet."""
        rows: list[dict[str, object]] = []
        for section in self.sections:
            for row in section.rows:
                values = section.row_dict(row)
                for name in ("ranks", "interval", "mean_cost_interval"):
                    first, last = values.pop(name) or (None, None)
                    low, high = ("best", "worst") if name == "ranks" else ("low", "high")
                    stem = "rank" if name == "ranks" else name
                    values |= {f"{stem}_{low}": first, f"{stem}_{high}": last}
                budget = section.budget if section.compared is not None else None
                rows.append({"task": section.task, "by": section.unit.name, "budget": budget, **values})
        return rows


def build(
    entries: Sequence[EntryResults], by: str, alpha: float = ALPHA, refused: Sequence[str] = ()
) -> CostBoard:
    """Rank entries by what learning costs, task by task.

    Parameters
    ----------
    entries:
        Of any tasks. Those that do not reach the task's shortest horizon, where others do, are left out.
    by:
        A key of `UNITS`.
    alpha:
        In (0, 1): probability of any false decision among entries of equal laws.
    refused:
        Lines about what could not be read, passed on.

    Raises
    ------
    OptionError
        If there is no such unit, or `alpha` is not between 0 and 1.
    """
    check_probability(alpha, "alpha")
    if by == "steps":
        raise OptionError("by = 'steps': the board of `api.board` is by steps")
    if by not in UNITS:
        raise OptionError(f"by = '{by}': choose among steps, {', '.join(UNITS)}{nearest(by, UNITS)}")
    good, problems = of_one_definition(entries)
    sections = []
    for task in sorted({entry.task for entry in good}):
        members, short = collect.equally_long([entry for entry in good if entry.task == task])
        problems += short
        sections.append(_section(task, members, UNITS[by], alpha))
    return CostBoard(tuple(sections), (*refused, *problems))


def _section(task: str, entries: Sequence[EntryResults], unit: Unit, alpha: float) -> CostSection:
    ranking = ranking_of(entries)
    prices = _prices(entries, unit.name)
    costs = {
        place: found.per_step * entries[place].steps_per_epoch
        for place, found in enumerate(prices)
        if not found.problem
    }
    budget, part, compared = math.nan, math.nan, None
    if costs:
        budget = min(cost * entries[place].curves.shape[1] for place, cost in costs.items())
        parts = round(budget / min(costs.values())) if _equal(list(costs.values())) else CELLS
        part = budget / parts
        compared = times_board(
            [_along(entries[place], cost, part, parts) for place, cost in costs.items()], ranking.grid, alpha
        )
    places = list(costs)
    order = [places[index] for index in compared.order] if compared is not None else []
    order += sorted(set(range(len(entries))) - set(order), key=lambda place: entries[place].label)
    rows = []
    for place in order:
        entry = entries[place]
        horizon = int(entry.curves.shape[1]) * entry.steps_per_epoch
        complexity = complexity_at(entry.curves, ranking, entry.steps_per_epoch, horizon)
        rows.append(
            CostRow(entry, prices[place], complexity, places.index(place) if place in costs else None)
        )
    return CostSection(task, cell_text(ranking), unit, tuple(rows), compared, budget, part, alpha)


def _prices(entries: Sequence[EntryResults], unit: str) -> list[Price]:
    """Return every entry's price; core-hours of a processor that most of the others were not made on are no price."""
    prices = [price(entry, unit) for entry in entries]
    if unit != "core-hours":
        return prices
    made_on = Counter(e.processors[0] for e, found in zip(entries, prices) if not found.problem)
    usual = min(made_on, key=lambda name: (-made_on[name], name), default="")
    return [
        found
        if found.problem or entry.processors[0] == usual
        else replace(found, problem=f"made on {entry.processors[0]}, the others on {usual}")
        for entry, found in zip(entries, prices)
    ]


def _equal(costs: Sequence[float]) -> bool:
    return bool(np.allclose(costs, costs[0], rtol=1e-9, atol=0)) if costs else True


def _along(entry: EntryResults, cost: float, part: float, parts: int) -> LearningCurves:
    """Return curves along the cost: of every part of the budget, the epoch that is being paid for at its end."""
    ends = part * np.arange(1, parts + 1) / cost
    epochs = np.clip(np.ceil(ends - 1e-9).astype(np.int64) - 1, 0, entry.curves.shape[1] - 1)
    return LearningCurves(entry.curves[:, epochs], 1, entry.name)
