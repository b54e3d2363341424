"""Several tasks at once: entries of one configuration, by mean steps below threshold as a share of the horizon.

A configuration is an algorithm and a model with all their options. The statistics are in
`qrlsuite.statistics.across`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrlsuite.columns import Column, flat, record
from qrlsuite.engine.sheet import Sheet
from qrlsuite.errors import OptionError, UnknownNameError, listed
from qrlsuite.experiment.task import digest
from qrlsuite.leaderboard.boards import costs, tables
from qrlsuite.leaderboard.boards.columns import names_text
from qrlsuite.leaderboard.boards.ranked import learning_curves, of_one_definition, ranking_of
from qrlsuite.leaderboard.boards.scores import means
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import counted, steps_text
from qrlsuite.statistics import (
    MIN_RUNS,
    AcrossTasks,
    LearningCurves,
    across_tasks,
    horizon_shares,
    rliable_arrays,
)
from qrlsuite.statistics.grid import FloatArray


@dataclass(frozen=True, eq=False)
class Shares:
    """Entries of one configuration with a result on every task.

    Attributes
    ----------
    tasks, horizons:
        K tasks, and the environment steps at which each is cut.
    values:
        By the entry's label, per task: each run's mean steps below the task's thresholds as a share of the horizon,
        shape (runs,), in [0, 1]; less is better.
    refused:
        Lines about entries that were left out, and why.
    """

    tasks: tuple[str, ...]
    horizons: tuple[int, ...]
    values: Mapping[str, tuple[FloatArray, ...]]
    refused: tuple[str, ...]
    before: str = "below"
    """The side of every task's thresholds where runs have not reached them; `short of` where tasks differ."""

    def rliable(self) -> dict[str, FloatArray]:
        """Return {entry: (runs, tasks)} as rliable takes it: 1 minus the shares, for there more is better."""
        return {name: 1 - values for name, values in rliable_arrays(self.values).items()}


@dataclass(frozen=True, eq=False)
class AcrossSection:
    """The result of `section`."""

    shares: Shares
    results: AcrossTasks
    alpha: float
    by: str = "steps"

    @property
    def title(self) -> str:
        """The title: tasks with their horizons, and the unit."""
        parts = (
            f"{task} ({steps_text(horizon)} steps)"
            for task, horizon in zip(self.shares.tasks, self.shares.horizons)
        )
        what = f"steps {self.shares.before} threshold as a share of the horizon"
        if self.by != "steps":
            what = f"{self.by} {self.shares.before} threshold as a share of the cheapest entry's total"
        return f"across {', '.join(parts)}: {what}"

    @property
    def order(self) -> tuple[int, ...]:
        """Indices in `results` by mean, least first."""
        return self.results.order

    def columns(self) -> tuple[Column[int], ...]:
        """Return the columns; a row is a place of the order."""
        order, results = self.order, self.results

        def name(place: int) -> str:
            return results.names[order[place]]

        def seeds(place: int) -> list[int]:
            return [len(each) for each in self.shares.values[name(place)]]

        def less(place: int) -> float | None:
            pair = order[place : place + 2]
            return float(results.improvement[pair]) if len(pair) > 1 else None

        return (
            Column("label", name, str, head="entry", words=True, flat=("entry",)),
            Column("seeds", seeds, lambda counts: ", ".join(map(str, counts))),
            *means(results, order, f"{100 * (1 - self.alpha):g}%"),
            Column("", less, "{:.2f}".format, head="P(less than next)"),
            Column(
                "",
                lambda place: self._against(order[place], 1),
                names_text,
                head="needs less than",
                words=True,
            ),
            Column(
                "",
                lambda place: self._against(order[place], -1),
                names_text,
                head="needs more than",
                words=True,
            ),
        )

    def sheet(self, explain: bool = False) -> Sheet:
        """Return the comparison as a table; `explain` adds all its notes."""
        rows, notes = range(len(self.order)), tuple(self.notes())
        return Sheet(self.title, self.columns(), rows, notes, explain, label="across", name="Across tasks")

    def notes(self) -> list[str]:
        """Explain the columns."""
        return [
            "mean: mean over tasks of the mean over seeds, less is better; IQM: mean of the middle half of all runs; "
            "intervals: bootstrap of runs within tasks, of each entry by itself",
            "P: probability that a run needs less than a run of the next entry, mean over tasks, ties one half",
            "needs less, needs more: runs permuted within tasks, Holm over all pairs: error probability "
            f"{self.alpha:g} for all together",
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON. Matrices are in the order of `entries`, from the row's side."""
        order, results = list(self.order), self.results
        return {
            "tasks": [
                {"task": task, "horizon": horizon}
                for task, horizon in zip(self.shares.tasks, self.shares.horizons)
            ],
            "alpha": self.alpha,
            "entries": [record(self.columns(), place) for place in range(len(order))],
            "improvement": results.improvement[np.ix_(order, order)].tolist(),
            "adjusted_p": [
                [None if math.isnan(p) else float(p) for p in row]
                for row in results.adjusted[np.ix_(order, order)]
            ],
            "better": results.better[np.ix_(order, order)].tolist(),
        }

    def flat(self) -> list[dict[str, object]]:
        """Return one row of columns per entry, for a spreadsheet."""
        results = self.results

        def beside(index: int) -> dict[str, object]:
            others = [other for other in self.order if other != index]
            return {
                "tasks": list(self.shares.tasks),
                "horizons": [str(horizon) for horizon in self.shares.horizons],
                "improvement": [f"{results.names[j]}: {results.improvement[index, j]:.4g}" for j in others],
                "adjusted_p": [f"{results.names[j]}: {results.adjusted[index, j]:.6g}" for j in others],
                "needs_less_than": self._against(index, 1),
                "needs_more_than": self._against(index, -1),
                "alpha": self.alpha,
            }

        rows = [{**flat(self.columns(), place), **beside(index)} for place, index in enumerate(self.order)]
        short = {f"interquartile_{end}": f"iqm_{end}" for end in ("low", "high")} | {
            "interquartile_mean": "iqm"
        }
        return [{short.get(name, name): value for name, value in row.items()} for row in rows]

    def _against(self, index: int, sign: int) -> list[str]:
        return [
            self.results.names[other] for other in self.order if self.results.better[index, other] == sign
        ]


def collected(
    tasks: Sequence[str], select: Callable[[str], tuple[list[EntryResults], list[str]]]
) -> tuple[list[EntryResults], list[str]]:
    """Read the entries of several tasks with `select`, one task at a time; a task without entries is an error."""
    if len(set(tasks)) < len(tasks):
        twice = next(task for task in tasks if tasks.count(task) > 1)
        raise OptionError(f"--task: {twice} is named twice")
    selected, refused = list[EntryResults](), list[str]()
    for task in tasks:
        of_task, left_out = select(task)
        if not of_task:
            raise UnknownNameError(f"there are no results of task {task}: qrlsuite run --task {task}")
        selected += of_task
        refused += [f"{task}: {line}" for line in left_out]
    return selected, refused


def shares(
    entries: Sequence[EntryResults],
    tasks: Sequence[str],
    horizon: int | None = None,
    refused: Sequence[str] = (),
    least: int = 2,
    by: str = "steps",
    definitions: Mapping[str, str] | None = None,
) -> Shares:
    """Return the entries of one configuration that have a result on every task.

    Parameters
    ----------
    entries:
        Entries of these tasks. An entry that its task's board leaves out has no row.
    tasks:
        In the order of the result.
    horizon:
        Environment steps at which all tasks are cut; None means each task's shortest horizon.
    refused:
        Lines about entries that were left out already.
    least:
        Seeds that an entry needs on every task.
    by:
        `steps`, or a key of `qrlsuite.leaderboard.boards.costs.UNITS`.
    definitions:
        See `qrlsuite.leaderboard.boards.ranked.of_one_definition`.
    """
    lines = list(refused)
    reached: dict[str, dict[str, EntryResults]] = {}
    horizons = []
    for task in tasks:
        members = [each for each in entries if each.task == task]
        end, of_task, left_out = _reaching(task, members, horizon, definitions)
        horizons.append(end)
        lines += left_out
        for key, entry in of_task.items():
            reached.setdefault(key, {})[task] = entry
    whole, left_out = _on_every_task(reached, tasks, least)
    if by != "steps":
        whole, unpriced = _priced(whole, by)
        left_out += unpriced
    lines += left_out
    if not whole:
        raise OptionError(
            f"--task {' --task '.join(tasks)}: no entry has {least} seeds or more with the same algorithm, model and "
            f"options on every task; left out: {listed(lines, 3)}"
        )
    by_task = []
    for task, end in zip(tasks, horizons):
        members = [of_entry[task] for of_entry in whole.values()]
        curves = (
            [learning_curves(entry).cut(end) for entry in members] if by == "steps" else _along(members, by)
        )
        by_task.append([horizon_shares(each, ranking_of([e]).grid) for e, each in zip(members, curves)])
    sides = {entry.task_file.ranking.before for of_entry in whole.values() for entry in of_entry.values()}
    return Shares(
        tuple(tasks),
        tuple(horizons),
        dict(zip(whole, zip(*by_task))),
        tuple(lines),
        sides.pop() if len(sides) == 1 else "short of",
    )


def _reaching(
    task: str, members: Sequence[EntryResults], horizon: int | None, definitions: Mapping[str, str] | None
) -> tuple[int, dict[str, EntryResults], list[str]]:
    """Return the horizon of a task, the entries that reach it by configuration, and lines about the others."""
    found = dict[str, EntryResults]()
    ranked, lines = of_one_definition(members, definitions)
    end = horizon or min(ranking_of(ranked or members).horizons)
    for entry in ranked:
        reached = entry.reaching(end // entry.steps_per_epoch)
        if reached is None:
            steps = entry.longest * entry.steps_per_epoch
            lines.append(f"{task}: {entry.label}: ends at {steps} of {end} steps")
            continue
        key = configuration(entry)
        if key not in found or len(found[key].seeds) < len(reached.seeds):
            found[key] = reached
    return end, found, lines


def _on_every_task(
    reached: Mapping[str, Mapping[str, EntryResults]], tasks: Sequence[str], least: int
) -> tuple[dict[str, Mapping[str, EntryResults]], list[str]]:
    """Return by name the entries with so many seeds on every task, and lines about the others."""
    labels = {key: next(iter(by_task.values())).label for key, by_task in reached.items()}
    seen = Counter(labels.values())
    whole, lines = dict[str, Mapping[str, EntryResults]](), list[str]()
    for key, by_task in reached.items():
        provisional = tables.missing([entry for entry in by_task.values() if entry.missing])
        name = labels[key] if seen[labels[key]] == 1 else f"{labels[key]} {key[:8]}"
        missing = [task for task in tasks if task not in by_task]
        few = [task for task in tasks if task in by_task and len(by_task[task].seeds) < least]
        if provisional:
            lines += provisional
        elif missing:
            lines.append(f"{name}: no result with these options on {listed(missing)}")
        elif few:
            count = len(by_task[few[0]].seeds)
            lines.append(f"{name}: {counted(count, 'seed')} on {few[0]}, fewer than {least}: undecided")
        else:
            whole[name] = by_task
    return whole, lines


def _priced(
    whole: Mapping[str, Mapping[str, EntryResults]], by: str
) -> tuple[dict[str, Mapping[str, EntryResults]], list[str]]:
    """Return the entries whose steps have a cost on every task, and lines about the others."""
    problems = dict[str, str]()
    for task in next(iter(whole.values()), {}):
        for name, found in zip(whole, costs.prices([of_entry[task] for of_entry in whole.values()], by)):
            if found.problem:
                problems.setdefault(name, f"{name}: not ranked: {found.problem} ({task})")
    return {name: entry for name, entry in whole.items() if name not in problems}, list(problems.values())


def _along(members: Sequence[EntryResults], by: str) -> list[LearningCurves]:
    return costs.along(members, [found.per_step for found in costs.prices(members, by)])[3]


def section(
    entries: Sequence[EntryResults],
    tasks: Sequence[str],
    horizon: int | None = None,
    alpha: float = ALPHA,
    refused: Sequence[str] = (),
    by: str = "steps",
    definitions: Mapping[str, str] | None = None,
) -> AcrossSection:
    """Compare all configurations that have 20 seeds or more on every task; arguments as for `shares`.

    Parameters
    ----------
    alpha:
        In (0, 1): probability of any false decision; intervals have level 1 - alpha.
    """
    configurations = shares(entries, tasks, horizon, refused, MIN_RUNS, by, definitions)
    return AcrossSection(configurations, across_tasks(configurations.values, alpha), alpha, by)


def configuration(entry: EntryResults) -> str:
    """Return 16 hexadecimal digits for an entry's algorithm and model with all their options, whatever the task."""
    names = ("algorithm", "algorithm_options", "model", "model_options")
    parts = {name: entry.identity.get(name) for name in names}
    return digest({**parts, "algorithm": entry.algorithm, "model": entry.model})
