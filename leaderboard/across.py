"""Several tasks at once: entries of one configuration, by mean time below threshold as a share of the horizon.

A configuration is an algorithm and a model with all their options. The statistics are in
`qrlsuite.statistics.across`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite.errors import OptionError, UnknownNameError, listed
from qrlsuite.experiment.task import digest
from qrlsuite.leaderboard.board import learning_curves, ranking_of
from qrlsuite.leaderboard.sheet import Sheet
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.times import ALPHA
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import MIN_RUNS, AcrossTasks, across_tasks, horizon_shares, rliable_arrays
from qrlsuite.statistics.grid import FloatArray


@dataclass(frozen=True, eq=False)
class Shares:
    """Entries of one configuration with a result on every task.

    Attributes
    ----------
    tasks, horizons:
        K tasks, and the environment steps at which each is cut.
    values:
        By the entry's label, per task: each run's mean time below the task's thresholds as a share of the horizon,
        shape (runs,), in [0, 1]; less is better.
    refused:
        Lines about entries that were left out, and why.
    """

    tasks: tuple[str, ...]
    horizons: tuple[int, ...]
    values: Mapping[str, tuple[FloatArray, ...]]
    refused: tuple[str, ...]

    def rliable(self) -> dict[str, FloatArray]:
        """Return {entry: (runs, tasks)} as rliable takes it: 1 minus the shares, for there more is better."""
        return {name: 1 - values for name, values in rliable_arrays(self.values).items()}


@dataclass(frozen=True, eq=False)
class AcrossBoard:
    """The result of `compare`."""

    shares: Shares
    results: AcrossTasks
    alpha: float

    @property
    def title(self) -> str:
        """What is compared."""
        parts = (
            f"{task} ({steps_text(horizon)} steps)"
            for task, horizon in zip(self.shares.tasks, self.shares.horizons)
        )
        return f"across {', '.join(parts)}: time below threshold as a share of the horizon"

    @property
    def order(self) -> tuple[int, ...]:
        """Indices in `results` by mean, least first."""
        return self.results.order

    @property
    def refused(self) -> tuple[str, ...]:
        """Lines about entries that were left out, and why."""
        return self.shares.refused

    def columns(self) -> tuple[str, ...]:
        """Return the heads of the table that `cells` fills."""
        level = f"{100 * (1 - self.alpha):g}%"
        return (
            "entry",
            "seeds",
            f"mean ({level})",
            f"IQM ({level})",
            "P(less than next)",
            "needs less than",
            "needs more than",
        )

    def sheet(self, explain: bool = False) -> Sheet:
        """Return the comparison as a table; `explain` adds all its notes."""
        rows = [self.cells(place) for place in range(len(self.order))]
        words = ("entry", "needs less than", "needs more than")
        return Sheet.of(self.title, self.columns(), rows, self.notes(), words, "across", explain)

    def cells(self, place: int) -> tuple[str, ...]:
        """Return the row at a place of the order as text."""
        index, results = self.order[place], self.results
        after = self.order[place + 1] if place + 1 < len(self.order) else None
        return (
            results.names[index],
            ", ".join(str(len(each)) for each in self.shares.values[results.names[index]]),
            _interval(results.mean[index], results.mean_interval[index]),
            _interval(results.interquartile_mean[index], results.interquartile_interval[index]),
            "-" if after is None else f"{results.improvement[index, after]:.2f}",
            ", ".join(self._against(index, 1)) or "-",
            ", ".join(self._against(index, -1)) or "-",
        )

    def notes(self) -> list[str]:
        """Explain the columns."""
        return [
            "mean: mean over tasks of the mean over seeds, less is better; IQM: mean of the middle half of all runs; "
            "intervals: bootstrap of runs within tasks, of each entry by itself",
            "P: probability that a run needs less than one of the next entry, mean over tasks, ties one half",
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
            "entries": [
                {
                    "label": results.names[index],
                    "seeds": [len(each) for each in self.shares.values[results.names[index]]],
                    "mean": float(results.mean[index]),
                    "mean_interval": results.mean_interval[index].tolist(),
                    "interquartile_mean": float(results.interquartile_mean[index]),
                    "interquartile_interval": results.interquartile_interval[index].tolist(),
                }
                for index in order
            ],
            "improvement": results.improvement[np.ix_(order, order)].tolist(),
            "adjusted_p": [
                [None if math.isnan(p) else float(p) for p in row]
                for row in results.adjusted[np.ix_(order, order)]
            ],
            "better": results.better[np.ix_(order, order)].tolist(),
            "refused": list(self.refused),
        }

    def flat(self) -> list[dict[str, object]]:
        """Return one row of columns per entry, for a spreadsheet."""
        rows: list[dict[str, object]] = []
        for index in self.order:
            name, results = self.results.names[index], self.results
            others = [other for other in self.order if other != index]
            rows.append(
                {
                    "entry": name,
                    "tasks": list(self.shares.tasks),
                    "horizons": [str(horizon) for horizon in self.shares.horizons],
                    "seeds": [str(len(each)) for each in self.shares.values[name]],
                    "mean": float(results.mean[index]),
                    "mean_low": float(results.mean_interval[index, 0]),
                    "mean_high": float(results.mean_interval[index, 1]),
                    "iqm": float(results.interquartile_mean[index]),
                    "iqm_low": float(results.interquartile_interval[index, 0]),
                    "iqm_high": float(results.interquartile_interval[index, 1]),
                    "improvement": [
                        f"{results.names[other]}: {results.improvement[index, other]:.4g}" for other in others
                    ],
                    "adjusted_p": [
                        f"{results.names[other]}: {results.adjusted[index, other]:.6g}" for other in others
                    ],
                    "needs_less_than": self._against(index, 1),
                    "needs_more_than": self._against(index, -1),
                    "alpha": self.alpha,
                }
            )
        return rows

    def _against(self, index: int, sign: int) -> list[str]:
        return [
            self.results.names[other] for other in self.order if self.results.better[index, other] == sign
        ]


def collected(
    runs: Path,
    tasks: Sequence[str],
    names: Iterable[str] = (),
    published: bool = False,
    horizon: int | None = None,
    min_seeds: int = 1,
) -> tuple[list[EntryResults], list[str]]:
    """Read the entries of several tasks.

    Parameters
    ----------
    tasks:
        Two or more.
    names, published, horizon, min_seeds:
        As for `qrlsuite.leaderboard.shelf.collect.select`; every name must be found on every task.

    Raises
    ------
    OptionError
        If there are fewer than two tasks, or one is named twice.
    UnknownNameError
        If a task is unknown or without results, or a name is not found on one.
    """
    if len(set(tasks)) < len(tasks):
        twice = next(task for task in tasks if tasks.count(task) > 1)
        raise OptionError(f"--across: task {twice} is named twice")
    if len(tasks) < 2:
        raise OptionError(f"--across {' '.join(tasks)}: name two tasks or more; `qrlsuite runs` lists them")
    collect.check_tasks(runs, tasks, published)
    selected, refused = list[EntryResults](), list[str]()
    for task in tasks:
        of_task, left_out = collect.select(runs, [task], names, published, horizon, min_seeds)
        if not of_task:
            raise UnknownNameError(
                f"--across: {runs} holds no results of task {task}: qrlsuite run --task {task}"
            )
        selected += of_task
        refused += [f"{task}: {line}" for line in left_out]
    return selected, refused


def shares(
    entries: Sequence[EntryResults],
    tasks: Sequence[str],
    horizon: int | None = None,
    refused: Sequence[str] = (),
    least: int = 2,
) -> Shares:
    """Return the entries of one configuration that have a result on every task.

    Parameters
    ----------
    entries:
        Of these tasks; those of other definitions of a task than most are left out.
    tasks:
        In the order of the result.
    horizon:
        Environment steps at which all tasks are cut; None means each task's shortest horizon.
    refused:
        Lines about entries that were left out already.
    least:
        Seeds that an entry needs on every task.

    Raises
    ------
    OptionError
        If no configuration is left; the message says what stood against it.
    """
    lines = list(refused)
    by_configuration: dict[str, dict[str, EntryResults]] = {}
    horizons, labels = [], dict[str, str]()
    for task in tasks:
        members = [entry for entry in entries if entry.task == task]
        definition = Counter(entry.task_hash for entry in members).most_common(1)[0][0]
        end = horizon or min(ranking_of(members).horizons)
        horizons.append(end)
        for entry in members:
            if entry.task_hash != definition:
                lines.append(f"{task}: {entry.label}: made under another definition of the task")
                continue
            reached = entry.reaching(end // entry.steps_per_epoch)
            if reached is None:
                steps = entry.longest * entry.steps_per_epoch
                lines.append(f"{task}: {entry.label}: ends at {steps} of {end} steps")
                continue
            key = configuration(entry)
            labels.setdefault(key, entry.label)
            other = by_configuration.setdefault(key, {}).get(task)
            if other is None or len(other.seeds) < len(reached.seeds):
                by_configuration[key][task] = reached
    values: dict[str, tuple[FloatArray, ...]] = {}
    seen = Counter(labels.values())
    for key, by_task in by_configuration.items():
        name = labels[key] if seen[labels[key]] == 1 else f"{labels[key]} {key[:8]}"
        missing = [task for task in tasks if task not in by_task]
        few = [task for task in tasks if task in by_task and len(by_task[task].seeds) < least]
        if missing:
            lines.append(f"{name}: no result with these options on {listed(missing)}")
        elif few:
            count = len(by_task[few[0]].seeds)
            lines.append(
                f"{name}: {count} seed{'s' * (count != 1)} on {few[0]}, fewer than {least}: undecided"
            )
        else:
            values[name] = tuple(
                horizon_shares(learning_curves(by_task[task]).cut(end), ranking_of([by_task[task]]).grid)
                for task, end in zip(tasks, horizons)
            )
    if not values:
        raise OptionError(
            f"--across {' '.join(tasks)}: no entry has {least} seeds or more with the same algorithm, model and "
            f"options on every task; left out: {listed(lines, 3)}"
        )
    return Shares(tuple(tasks), tuple(horizons), values, tuple(lines))


def compare(
    entries: Sequence[EntryResults],
    tasks: Sequence[str],
    horizon: int | None = None,
    alpha: float = ALPHA,
    refused: Sequence[str] = (),
) -> AcrossBoard:
    """Compare all configurations that have 20 seeds or more on every task.

    Parameters
    ----------
    entries, tasks, horizon, refused:
        As for `shares`.
    alpha:
        In (0, 1): probability of any false decision; intervals have level 1 - alpha.

    Raises
    ------
    OptionError
        If no configuration is left, or `alpha` is not between 0 and 1.
    """
    configurations = shares(entries, tasks, horizon, refused, MIN_RUNS)
    return AcrossBoard(configurations, across_tasks(configurations.values, alpha), alpha)


def configuration(entry: EntryResults) -> str:
    """Return 16 hexadecimal digits for an entry's algorithm and model with all their options, whatever the task."""
    names = ("algorithm", "algorithm_options", "model", "model_options")
    parts = {name: entry.identity.get(name) for name in names}
    return digest({**parts, "algorithm": entry.algorithm, "model": entry.model})


def _interval(value: float, ends: FloatArray) -> str:
    return f"{value:.3f} ({ends[0]:.3f} to {ends[1]:.3f})"
