"""How many seeds, and core-hours, it takes to find a difference; simulated from the seeds of one or two entries."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.api.entries import load
from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard.boards import ranked
from qrlsuite.leaderboard.shelf.collect import Selection, collect, read, read_entry
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.store import EntryStore
from qrlsuite.results.text import hours_text
from qrlsuite.statistics import MIN_RUNS, LearningCurves, SmoothedRuns
from qrlsuite.statistics.curves import common_horizon
from qrlsuite.statistics.permutation import with_half_epoch
from qrlsuite.statistics.planning import LADDER, Need, chances, claim_chances, runs_needed, runs_to_detect
from qrlsuite.statistics.times import mean_time, times_below
from qrlsuite.studies.looks import Study
from qrlsuite.tuning.search import FOLDER

SLOWER = (0.10, 0.25, 0.50)
PILOT = 10
"""Seeds that tell the spread of a study's entries."""
POWERS = (0.8, 0.9)


@dataclass(frozen=True, repr=False)
class SeedsNeeded(Shown):
    """How many seeds find differences.

    Attributes
    ----------
    entries:
        The one or two from whose seeds pairs were simulated.
    horizon:
        Environment steps.
    needs:
        For each difference and power one row of plain values.
    draws:
        Simulated pairs of each row.
    """

    entries: tuple[EntryResults, ...]
    horizon: int
    needs: tuple[dict[str, Any], ...]
    draws: int

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "task": self.entries[0].task,
            "entries": [
                {"entry": entry.name, "label": entry.label, "seeds": len(entry.seeds)}
                for entry in self.entries
            ],
            "horizon": self.horizon,
            "draws": self.draws,
            "needs": list(self.needs),
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show a row for each difference and power."""
        heads = ("difference", "power", "seeds, all at once", "seeds with looks: mean (most)", "its looks")
        rows, before = [], None
        for need in self.needs:
            shown = "" if need["difference"] == before else need["difference"]
            before = need["difference"]
            rows.append((shown, f"{need['power']:g}", *_cells(need)))
        yield Sheet.of("", heads, rows, words=("difference", "its looks"))
        pilots = " and ".join(f"{len(entry.seeds)} seeds of {entry.label}" for entry in self.entries)
        error = 100 * (0.8 * 0.2 / self.draws) ** 0.5
        yield Text(
            f"Seeds of each of the two entries, with the core-hours of both. Simulated from {pilots},\n"
            f"{self.horizon} steps, {self.draws} pairs per line (power to within {error:.0f} points or so)."
        )
        if min(len(entry.seeds) for entry in self.entries) < MIN_RUNS:
            yield Text(f"Fewer than {MIN_RUNS} seeds are a weak pilot: rare failures may be missing from it.")


def power(
    first: str | EntryResults,
    second: str | EntryResults | None = None,
    *,
    task: str | None = None,
    draws: int = 200,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    progress: bool = True,
) -> SeedsNeeded:
    """Simulate how many seeds find that another entry is 10, 25 or 50 percent slower than this one.

    Of two entries, also how many find the difference between them. Pairs are judged by rule `steps` at alpha = .05:
    all seeds at once, and with looks.

    Parameters
    ----------
    first, second:
        Entries with two seeds or more: arguments of `load`, or its results.
    task, runs, published:
        As for `load`.
    draws:
        Simulated pairs of each row.

    Raises
    ------
    UnknownNameError
        If an entry is unknown.
    OptionError
        If an entry has a single seed, no seed of the first reached a threshold, or they are of different tasks.
    """
    given = (first,) if second is None else (first, second)
    entries = [
        each if isinstance(each, EntryResults) else load(each, task=task, runs=runs, published=published)
        for each in given
    ]
    for entry in entries:
        if len(entry.seeds) < 2:
            raise OptionError(f"'{entry.label}' has a single seed, which has no spread: train two or more")
    if len({entry.task_hash for entry in entries}) > 1:
        raise OptionError(
            f"'{entries[0].label}' is of task {entries[0].task}, '{entries[1].label}' of {entries[1].task}"
        )
    curves = [ranked.learning_curves(entry) for entry in entries]
    horizon = common_horizon(curves[0], curves[-1])
    curves = [each.cut(horizon) for each in curves]
    grid = ranked.ranking_of(entries).grid
    if mean_time(curves[0], grid).at_cap.min() == 1:
        raise OptionError(
            f"no seed of '{entries[0].label}' reached a threshold within {horizon} steps, so no slower entry can be "
            "simulated: train longer, change the task's thresholds, or name another entry first"
        )
    per_pair = _core_hours(entries, horizon // curves[0].steps_per_epoch)
    console = Console(stderr=True, quiet=not progress, highlight=False)
    rows = []
    for title, job in _jobs(entries, curves, draws):
        with console.status(Text(f"simulating: {title}")):
            rows += [_row(title, need, per_pair) for need in job()]
    return SeedsNeeded(tuple(entries), horizon, tuple(rows), draws)


@dataclass(frozen=True)
class StudyPower:
    """How often a study with looks tells an entry with a true lead apart from all others, before it begins.

    Attributes
    ----------
    found:
        For each lead (0.1: needs 10 percent fewer steps than each other entry) the share of studies, by look.
    spread:
        Standard deviation of a run's steps over their mean, as `pilot` has it.
    pilot:
        The study's entry with the middle spread, trained or searched; an entry of its task where none has `PILOT`
        seeds.
    seeds:
        The pilot's number of seeds.
    claims:
        For each claim and true lead of its entry the share of studies that establish it, by look.
    """

    found: dict[float, tuple[float, ...]]
    spread: float
    pilot: str
    seeds: int
    claims: dict[str, tuple[float, ...]]

    @property
    def sentences(self) -> list[str]:
        """Say the power of the pairs at the last look, and the power of each claim at every look."""
        shares = ", ".join(f"{lead:.0%} fewer in {100 * each[-1]:.0f}" for lead, each in self.found.items())
        pairs = (
            "power: how many of 100 such studies find an entry that needs fewer steps than all others: "
            f"{shares}; if seeds differ as the {self.seeds} of {self.pilot} do"
        )
        claims = [
            f"power at each look: of 100 such studies, this many establish: {claim}: "
            + ", ".join(f"{100 * share:.0f}" for share in shares)
            for claim, shares in self.claims.items()
        ]
        return [pairs, *claims]


def study_power(study: Study) -> StudyPower | None:
    """Return a study's power, from seeds that are searched, stored or published; None where its task has too few."""
    published = Selection(study.runs, published=True, tasks=(study.task,))
    pilots = _spreads(_own(study), study) or _spreads(collect(published)[0], study)
    if not pilots:
        return None
    spread, pilot = pilots[len(pilots) // 2]
    design = study.design
    found = {lead: chances(design, spread, lead) for lead in SLOWER}
    claims = {
        f"{claim.sentence}, if "
        + (f"it needs {lead:.0%} fewer than each" if lead else "all need the same"): claim_chances(
            design, claim, spread, lead
        )
        for claim in design.claims
        for lead in (SLOWER if claim.at_most is None else (0.0,))
    }
    return StudyPower(found, spread, pilot.label, len(pilot.seeds), claims)


def _own(study: Study) -> Iterator[EntryResults]:
    """Return the readable results of a study's entries: in its own folder, in searches, and on boards."""
    keys = {(entry.task.name, entry.name) for entry in study.entries.values()}
    for folder, reading in (
        (study.folder, read),
        (study.runs / FOLDER, functools.partial(read_entry, tuning=True)),
    ):
        for store in (EntryStore(folder / task / name) for task, name in sorted(keys)):
            with contextlib.suppress(QrlSuiteError):  # a damaged entry has no spread
                if store.path.is_dir() and (found := reading(store)) is not None:
                    yield found
    yield from collect(Selection(study.runs, published=True, only=keys))[0]


def _spreads(entries: Iterable[EntryResults], study: Study) -> list[tuple[float, EntryResults]]:
    """Return how much the seeds of entries with `PILOT` or more differ on the study's task, the smallest first."""
    task_hash = next(iter(study.entries.values())).task.hash
    spreads = []
    for entry in entries:
        long = entry.task_hash == task_hash and entry.curves.shape[1] >= study.epochs
        if len(entry.seeds) >= PILOT and long and np.isfinite(entry.curves).all():
            curves = ranked.learning_curves(entry).cut(study.epochs * entry.steps_per_epoch)
            times = times_below(curves.values, study.grid, curves.steps_per_epoch)
            numbers = with_half_epoch(times, curves.steps_per_epoch).sum(axis=-1)
            spreads.append((float(numbers.std(ddof=1) / numbers.mean()), entry))
    return sorted((each for each in spreads if each[0]), key=lambda each: each[0])


def power_lines(power: StudyPower | None) -> list[str]:
    """Return the sentences of a study's power, or one that names the missing seeds."""
    if power is None:
        return [f"power: unknown until {PILOT} seeds of an entry of this task are trained to the end"]
    return power.sentences


def _jobs(
    entries: Sequence[EntryResults], curves: Sequence[LearningCurves], draws: int
) -> list[tuple[str, Callable[[], tuple[Need, ...]]]]:
    """Return the simulations: the difference between two entries, then fixed differences."""
    ranking = ranked.ranking_of(entries)
    grid = ranking.grid
    bounds = (0.0, 1.0) if ranking.thresholds is None else None
    pilots = [SmoothedRuns(each, bounds=bounds) for each in curves]
    jobs: list[tuple[str, Callable[[], tuple[Need, ...]]]] = []
    if len(entries) == 2:
        order = sorted((0, 1), key=lambda index: mean_time(curves[index], grid).mean)
        better, worse = (pilots[index] for index in order)
        ratio = mean_time(worse.entry, grid).mean / max(1e-9, mean_time(better.entry, grid).mean) - 1
        title = f"{entries[order[1]].label} against {entries[order[0]].label}: {100 * ratio:.0f}% slower"
        jobs.append((title, functools.partial(runs_needed, better, worse, grid, POWERS, n_pairs=draws)))
    for share in SLOWER:
        detect = functools.partial(runs_to_detect, pilots[0], grid, share, powers=POWERS, n_pairs=draws)
        jobs.append((f"{100 * share:.0f}% slower than {entries[0].label}", detect))
    return jobs


def _core_hours(entries: Sequence[EntryResults], epochs: int) -> float | None:
    """Return the core-hours of a pair of seeds, one from each entry; None where an entry has curves without times."""
    each = [
        epochs * entry.hours / sum(len(run.scores) for run in entry.records.values())
        for entry in (entries[0], entries[-1])
    ]
    return sum(each) if all(each) else None


def _row(title: str, need: Need, per_pair: float | None) -> dict[str, Any]:
    """Return a need with its cost as plain values."""

    def hours(seeds: float | None) -> float | None:
        return None if seeds is None or per_pair is None else seeds * per_pair

    mean, most = (need.mean_runs, need.looks[-1]) if need.looks else (None, None)
    return {
        "difference": title,
        "power": need.power,
        "fixed_seeds": need.fixed,
        "fixed_core_hours": hours(need.fixed),
        "looks": list(need.looks) or None,
        "mean_seeds": mean,
        "mean_core_hours": hours(mean),
        "most_seeds": most,
        "most_core_hours": hours(most),
    }


def _cells(need: dict[str, Any]) -> tuple[str, str, str]:
    """Write seeds all at once and with looks, each with its core-hours; and the looks."""
    fixed, mean = (
        "" if need[key] is None else f", {hours_text(need[key])} h"
        for key in ("fixed_core_hours", "mean_core_hours")
    )
    over = f"over {LADDER[-1]}"
    at_once = over if need["fixed_seeds"] is None else f"{need['fixed_seeds']}{fixed}"
    if not need["looks"]:
        return at_once, over, ""
    with_looks = f"{need['mean_seeds']:.0f} ({need['most_seeds']}){mean}"
    return at_once, with_looks, ", ".join(map(str, need["looks"]))
