"""Simulates entries like given ones to measure how often a significance rule errs; estimates the time first.

The measures themselves are in `qrlsuite.statistics.calibration`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard.board import learning_curves, ranking_of
from qrlsuite.leaderboard.pictures.cells import choose_horizon
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.statistics import (
    Decided,
    DecisionPlan,
    Grid,
    LearningCurves,
    Rates,
    SignificanceRule,
    SmoothedRuns,
    TimesRule,
    board_false_winners,
    decision_rates,
    false_winners,
    power,
    slower,
    split_halves,
)

Part = Literal["halves", "pairs", "boards", "power", "decisions"]
PARTS: tuple[Part, ...] = ("halves", "pairs", "boards", "power", "decisions")
RULES = ("intervals", "times")
"""The rules that are measured by default."""
NUMBERS = ((100, 100), (20, 20), (30, 100))
"""Seeds of the two entries of a simulated pair."""
FACTORS = (1.1, 1.25, 1.5)
"""How much longer the worse entry takes, for power."""
BOARD = 5
"""Entries of a simulated board, and of the larger of two simulated decision plans."""
HALF_LEAST = 2
"""Seeds that a half must have."""


@dataclass(frozen=True)
class CalibrationResult:
    """One line of the result.

    Attributes
    ----------
    part:
        One of `PARTS`.
    entry, rule:
        What was judged, by which rule.
    n_runs:
        Seeds of the first and the second entry, of each entry of a board, or of each entry at a plan's last look.
    draws:
        Simulated pairs, boards or plans.
    winner:
        Between equals: fraction with a winner; in a plan, with a pair that differs. Else: fraction in which the
        better entry was found to be better.
    cell_mean, cell_worst, any_cell:
        Fraction of pairs with a significant difference in a cell (mean and largest over the cells), in any cell;
        None for boards and plans.
    factor:
        For an entry known to be worse: how much longer it takes.
    wrong:
        With a factor: fraction in which the worse entry was found to be better.
    entries, equal, mean_seeds:
        Of decision plans: number of entries, fraction of pairs found equal within the margin, and seeds of each
        entry of a pair when it was closed, on average.
    """

    part: Part
    entry: str
    rule: str
    n_runs: tuple[int, int]
    draws: int
    winner: float
    cell_mean: float | None = None
    cell_worst: float | None = None
    any_cell: float | None = None
    factor: float | None = None
    wrong: float | None = None
    entries: int | None = None
    equal: float | None = None
    mean_seeds: float | None = None

    @property
    def error(self) -> float:
        """Monte-Carlo standard error of `winner`, for independent draws; never below that of one in `draws`."""
        rate = min(max(self.winner, 1 / self.draws), 1 - 1 / self.draws) if self.draws > 1 else 0.5
        return float((rate * (1 - rate) / self.draws) ** 0.5)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "part": self.part,
            "entry": self.entry,
            "rule": self.rule,
            "seeds": list(self.n_runs),
            "draws": self.draws,
            "winner": self.winner,
            # splits of one entry share its runs
            "standard_error": None if self.part == "halves" else self.error,
            "cell_mean": self.cell_mean,
            "cell_worst": self.cell_worst,
            "any_cell": self.any_cell,
            "factor": self.factor,
            "wrong": self.wrong,
            "entries": self.entries,
            "equal": self.equal,
            "mean_seeds": self.mean_seeds,
        }


@dataclass(frozen=True)
class Job:
    """One line to be computed.

    Attributes
    ----------
    part, entry, rule:
        As in `CalibrationResult`.
    draws:
        Pairs or boards to be simulated.
    measure:
        Called with a number of draws and a function to be called after each.
    """

    part: Part
    entry: str
    rule: str
    draws: int
    measure: Callable[[int, Callable[[], object] | None], CalibrationResult]

    def run(self, tick: Callable[[], object] | None = None) -> CalibrationResult:
        """Compute the line."""
        return self.measure(self.draws, tick)


@dataclass(frozen=True)
class Setup:
    """What rules are calibrated on.

    Attributes
    ----------
    curves:
        The entries, cut to one horizon, by names that differ.
    grid:
        The task's ranking grid.
    horizon:
        Environment steps to which they are cut.
    """

    curves: tuple[LearningCurves, ...]
    grid: Grid
    horizon: int


def choose(
    runs: Path, names: Sequence[str] = (), task: str | None = None, published: bool = False
) -> tuple[list[EntryResults], list[str]]:
    """Return the entries to simulate from: of one task, with two seeds or more, and trained equally long.

    Parameters
    ----------
    names:
        The entries (see `qrlsuite.leaderboard.shelf.collect.find`); all of the task where empty.
    task, published:
        As for `qrlsuite.leaderboard.shelf.collect.collect`; None where the entries belong to one task.

    Returns
    -------
    tuple
        The entries, and one line for each that was left out and why.

    Raises
    ------
    UnknownNameError
        If there is no such entry.
    OptionError
        If the entries belong to several tasks.
    """
    tasks = [task] if task else []
    collect.check_tasks(runs, tasks, published)
    lines: list[str] = []
    if names:
        entries = [collect.find(runs, name, published, tasks) for name in dict.fromkeys(names)]
    else:
        entries, refused = collect.collect(runs, tasks, published=published)
        lines += refused
    lines += [f"{entry.label}: a single seed has no spread" for entry in entries if len(entry.seeds) < 2]
    entries = [entry for entry in entries if len(entry.seeds) >= 2]
    if not entries:
        of_task = f" of task {task}" if task else ""
        raise UnknownNameError(f"{runs} holds no entry{of_task} with two seeds or more: qrlsuite run")
    tasks = sorted({entry.task for entry in entries})
    if len({entry.task_hash for entry in entries}) > 1:
        raise OptionError(f"the entries belong to several tasks ({', '.join(tasks)}): choose one with --task")
    longest = max(entry.curves.shape[1] for entry in entries)
    lines += [
        f"{entry.label}: at epoch {entry.curves.shape[1]} of {longest}; repeat the `qrlsuite run` that made it"
        for entry in entries
        if entry.curves.shape[1] < longest
    ]
    entries = [entry for entry in entries if entry.curves.shape[1] == longest]
    return sorted(entries, key=lambda entry: (entry.model, sum(entry.parameters), entry.label)), lines


def prepare(entries: Sequence[EntryResults]) -> Setup:
    """Cut the entries of a task to one horizon, and name them without the algorithm where that tells them apart."""
    horizon = choose_horizon(entries)
    names = [entry.label.removeprefix(f"{entry.algorithm} ") for entry in entries]
    if len(set(names)) < len(names):
        names = [entry.name for entry in entries]
    cut = (learning_curves(entry).cut(horizon) for entry in entries)
    curves = tuple(replace(curve, name=name) for curve, name in zip(cut, names))
    return Setup(curves, ranking_of(entries).grid, horizon)


def plan(
    entries: Sequence[LearningCurves],
    grid: Grid,
    rules: Sequence[SignificanceRule],
    draws: int,
    parts: Sequence[Part] = PARTS,
    numbers: Sequence[tuple[int, int]] = NUMBERS,
    board: int = BOARD,
    jitter: float = 0.3,
) -> list[Job]:
    """Return what there is to compute, part by part.

    Parameters
    ----------
    entries:
        Entries of one task, cut to one horizon, with two runs or more.
    grid:
        The task's ranking grid.
    rules:
        The rules that judge.
    draws:
        Splits, simulated pairs and plans per line; a quarter of that for boards and plans of `board` entries.
    parts:
        Which parts. Decision plans are played if one of the rules is `times`, which is theirs.
    numbers:
        Seeds of the two entries of a pair.
    board:
        Entries of a board.
    jitter:
        Of `qrlsuite.statistics.SmoothedRuns`.
    """
    bounds = (0.0, 1.0) if grid.epsilons is not None else None
    models = [SmoothedRuns(entry, jitter, bounds) for entry in entries]
    seeds = numbers[0][0]
    jobs: list[Job] = []
    if "halves" in parts:
        real = [entry for entry in entries if entry.n_runs // 2 >= HALF_LEAST]
        jobs += [_halves(entry, grid, rule, draws) for entry in real for rule in rules]
    if "pairs" in parts:
        jobs += [
            _pairs(model, pair, grid, rule, draws) for model in models for pair in numbers for rule in rules
        ]
    if "boards" in parts:
        jobs += [
            _boards(model, board, seeds, grid, rule, max(1, draws // 4)) for model in models for rule in rules
        ]
    if "power" in parts:
        for model in models:
            for factor in FACTORS:
                other = SmoothedRuns(slower(model.entry, factor), jitter, bounds)
                jobs += [_power(model, other, factor, seeds, grid, rule, draws) for rule in rules]
    if "decisions" in parts and any(rule.name == TimesRule().name for rule in rules):
        for model in models:
            jobs.append(_decisions([model] * 2, grid, draws))
            if board > 2:
                jobs.append(_decisions([model] * board, grid, max(1, draws // 4)))
            for factor in FACTORS:
                other = SmoothedRuns(slower(model.entry, factor), jitter, bounds)
                jobs.append(_decisions([model, other], grid, draws, factor))
    return jobs


def estimate(jobs: Sequence[Job]) -> float:
    """Return the seconds that the jobs will take: three draws of one job of each part and rule are made, two timed."""
    seconds: dict[tuple[str, str], float] = {}
    for job in jobs:
        key = (job.part, job.rule)
        if key not in seconds:
            job.measure(1, None)  # what is prepared once is not multiplied
            begin = time.perf_counter()
            job.measure(2, None)
            seconds[key] = (time.perf_counter() - begin) / 2
    return sum(job.draws * seconds[job.part, job.rule] for job in jobs)


def _of_pairs(
    part: Part, entry: str, rates: Rates, winner: float, factor: float | None = None
) -> CalibrationResult:
    cells = rates.per_cell
    return CalibrationResult(
        part=part,
        entry=entry,
        rule=rates.rule,
        n_runs=rates.n_runs,
        draws=rates.n_pairs,
        winner=winner,
        cell_mean=float(cells.mean()),
        cell_worst=float(cells.max()),
        any_cell=rates.any_cell,
        factor=factor,
        wrong=None if factor is None else rates.second_wins,
    )


def _halves(entry: LearningCurves, grid: Grid, rule: SignificanceRule, draws: int) -> Job:
    def measure(count: int, tick: Callable[[], object] | None) -> CalibrationResult:
        rates = split_halves(entry, grid, rule, count, tick=tick)
        return _of_pairs("halves", entry.name, rates, rates.winner)

    return Job("halves", entry.name, rule.name, draws, measure)


def _pairs(
    model: SmoothedRuns, n_runs: tuple[int, int], grid: Grid, rule: SignificanceRule, draws: int
) -> Job:
    def measure(count: int, tick: Callable[[], object] | None) -> CalibrationResult:
        rates = false_winners(model, *n_runs, grid, rule, count, tick=tick)
        return _of_pairs("pairs", model.entry.name, rates, rates.winner)

    return Job("pairs", model.entry.name, rule.name, draws, measure)


def _boards(
    model: SmoothedRuns, size: int, n_runs: int, grid: Grid, rule: SignificanceRule, draws: int
) -> Job:
    def measure(count: int, tick: Callable[[], object] | None) -> CalibrationResult:
        rate = board_false_winners(model, [n_runs] * size, grid, rule, count, tick=tick)
        return CalibrationResult("boards", model.entry.name, rule.name, (n_runs, n_runs), count, rate)

    return Job("boards", model.entry.name, rule.name, draws, measure)


def _power(
    model: SmoothedRuns,
    other: SmoothedRuns,
    factor: float,
    n_runs: int,
    grid: Grid,
    rule: SignificanceRule,
    draws: int,
) -> Job:
    def measure(count: int, tick: Callable[[], object] | None) -> CalibrationResult:
        rates = power(model, other, n_runs, n_runs, grid, rule, count, tick=tick)
        return _of_pairs("power", model.entry.name, rates, rates.first_wins, factor)

    return Job("power", model.entry.name, rule.name, draws, measure)


def _decisions(models: Sequence[SmoothedRuns], grid: Grid, draws: int, factor: float | None = None) -> Job:
    """Play the plan that `qrlsuite decide new` writes, between equals or against an entry that is slower."""
    plan = DecisionPlan(tuple(f"{index}" for index in range(len(models))))
    entry = models[0].entry.name

    def measure(count: int, tick: Callable[[], object] | None) -> CalibrationResult:
        rates = decision_rates(models, plan, grid, count, tick=tick)
        shares = rates.verdicts[0]
        pairs = len(rates.verdicts)
        return CalibrationResult(
            "decisions",
            entry,
            TimesRule().name,
            (plan.looks[-1], plan.looks[-1]),
            count,
            rates.any_difference if factor is None else shares[Decided.FIRST],
            factor=factor,
            wrong=None if factor is None else shares[Decided.SECOND],
            entries=len(models),
            equal=sum(each[Decided.EQUAL] for each in rates.verdicts) / pairs,
            mean_seeds=sum(rates.mean_runs) / pairs,
        )

    return Job("decisions", entry, TimesRule().name, draws, measure)
