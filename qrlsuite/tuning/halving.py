"""Successive halving over seeds: many settings on few seeds, the better third on three times as many, and so on.

Every trial is trained to the whole horizon: what is saved is seeds of settings that are poor, and never epochs, which
would favor settings that begin fast (Karnin, Koren & Somekh 2013; Jamieson & Talwalkar 2016, with seeds in the place of
iterations). The last three settings are trained on fresh seeds, and the best on these alone is chosen: the luck that
brought a setting into the last rung does not count there.

The first setting is the untuned one; the others are points of a Halton sequence, log-uniform in the ranges. They come
in three parts, a half and two quarters of all. Where the best so far lies in the outer third of a range and nothing
beyond it was tried, the next part is drawn from a range moved beyond that end by half its width: a search at an edge
has no more trials than another. The number of settings is proportional to the number of varied options.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator, Iterable, Sequence
from dataclasses import replace
from typing import Any

from qrlsuite.errors import OptionError
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import counted
from qrlsuite.tuning import samplers, space
from qrlsuite.tuning.search import Proposal, Search, Train, Trial
from qrlsuite.tuning.space import Dimension, Point, Range

PER_OPTION = 8
"""Settings for each varied option, unless told otherwise."""

FINALISTS = 3
"""Settings of the last rung."""

KEPT = 3
"""A rung keeps one setting in so many, and trains it on so many times the seeds."""

OUTER = 1 / 3
"""Share of a range at each end: the search moves on where the best value lies there and none was tried beyond it."""

PARTS = (0.5, 0.75, 1.0)
"""The ranges can move after these shares of all settings, but the last."""

_DRAWS = 1000
"""Points without a new combination after which there is none left."""


def ladder(settings: int, seeds: int) -> tuple[tuple[int, int], ...]:
    """Return the number of settings and of seeds of each rung; the last rung's seeds are fresh.

    >>> ladder(24, 20)
    ((24, 4), (8, 12), (3, 20))
    """
    rungs = [(settings, max(1, seeds // 5))]
    while (kept := math.ceil(rungs[-1][0] / KEPT)) > FINALISTS:
        rungs.append((kept, min(seeds, KEPT * rungs[-1][1])))
    return (*rungs, (min(FINALISTS, settings), seeds))


def runs(rungs: Sequence[tuple[int, int]]) -> int:
    """Return the runs, each of one seed, of a ladder: a rung trains only the seeds that the one before did not.

    >>> runs(((24, 4), (8, 12), (3, 20)))
    220
    """
    *halving, (finalists, fresh) = rungs
    before = [0, *(seeds for _, seeds in halving)]
    return sum(count * (seeds - known) for (count, seeds), known in zip(halving, before)) + finalists * fresh


def affordable(runs_allowed: float, seeds: int) -> int:
    """Return the most settings whose ladder takes no more runs; 0 where not even the smallest does."""
    settings = 0
    while runs(ladder(settings + 1, seeds)) <= runs_allowed:
        settings += 1
    return settings


class Halving(Search):
    """One search by successive halving; see the module.

    Attributes
    ----------
    settings:
        How many are tried; None while a budget in core-hours waits for the first trial, which shows what a run costs.
    """

    def _begin(self) -> None:
        request = self.request
        self.space = self._space(request.grid is None)
        self.searched = {d.name: d.range for d in self.space if d.range is not None}
        first, *_ = seeds = request.seeds
        if list(seeds) != list(range(first, first + len(seeds))):
            raise OptionError(
                f"--seeds {format_seeds(seeds)}: halving takes seeds one after the other, such as --seeds {len(seeds)}"
            )
        if request.core_hours is not None and request.trials is not None:
            raise OptionError(
                "--budget in core-hours and trials: give one of them, or no budget is equal in both"
            )
        self.settings: int | None = None
        if request.core_hours is None:
            self.settings = self._at_most((request.trials or PER_OPTION) * len(self.space))
        self._tried: list[Point] = [space.base(self.space, self.base)]
        self._climb = self._proposals()
        self._next = next(self._climb)
        self._tried_now: list[Trial | None] = []

    def _at_most(self, settings: int) -> int:
        """Return a number of settings, or of all combinations where there are fewer."""
        if self.searched:
            return settings
        untuned = space.base(self.space, self.base)
        return min(settings, samplers.size(self.space) + (untuned not in samplers.product(self.space)))

    @property
    def rungs(self) -> tuple[tuple[int, int], ...]:
        """Settings and seeds of each rung; of the smallest ladder while the number of settings is not known."""
        return ladder(self.settings or FINALISTS, len(self.request.seeds))

    @property
    def planned(self) -> int:
        """How many trials there are to be: settings that rise to the next rung count again."""
        return sum(count for count, _ in self.rungs)

    @property
    def runs_planned(self) -> int:
        """How many runs, each of one seed, all planned trials take."""
        return runs(self.rungs)

    @property
    def budget_text(self) -> str:
        """Say what the search is allowed, in words that are equal for models with equal budgets."""
        seeds = f"up to {len(self.request.seeds)} fresh seeds"
        if self.request.core_hours is not None:
            return f"{self.request.core_hours:g} core-hours, {seeds}"
        return f"{counted(self.request.trials or PER_OPTION, 'setting')} per option, {seeds}"

    @property
    def plan_text(self) -> str:
        """Say how many settings are tried on how many seeds."""
        if self.settings is None:
            return (
                f"as many settings as {self.request.core_hours:g} core-hours hold, which the first trial shows, by "
                "successive halving"
            )
        rungs = " -> ".join(f"{count} x {seeds}" for count, seeds in self.rungs)
        return (
            f"{counted(self.settings, 'setting')} ({self.budget_text}) by successive halving: {rungs} seeds, "
            f"{self.runs_planned} runs"
        )

    @property
    def over(self) -> bool:
        """Whether no further trial can be begun: all are, or the next ones need to know some that wait."""
        return not self._next

    @property
    def beside(self) -> int:
        """How many settings can be trained side by side in one population: those of the last rung, the most runs."""
        return FINALISTS if self._per_agent else 1

    @property
    def next_seeds(self) -> int:
        """How many seeds the next trial has."""
        return len(self._next[0].seeds) if self._next else 0

    @property
    def presentable(self) -> bool:
        """Whether the last rung is complete."""
        return self.over and not self.pending

    def step(self, train: Train, most: int = 1) -> list[Trial | None]:
        """Run the next trials, `most` at a time where they do not depend on each other, else fewer.

        Returns
        -------
        list
            A trial is None where some of its runs are left to another process or a queue.

        Raises
        ------
        KeyboardInterrupt
            After Ctrl-C, with everything saved.
        OptionError
            If the core-hours hold no ladder.
        QrlSuiteError
            If a trial cannot be run.
        """
        if not self._next:
            raise RuntimeError("the search is over")
        trials = self._try(self._next[:most], train)
        self._next = self._next[most:]
        self._tried_now += trials
        if not self._next:
            tried, self._tried_now = self._tried_now, []
            with contextlib.suppress(StopIteration):
                self._next = self._climb.send(tried)
        return trials

    def _proposals(self) -> Generator[list[Proposal], list[Trial | None], None]:
        """Propose trials that do not depend on each other; ends early where a choice needs one that is left to others.

        What is sent back are the trials of all that were proposed at once.
        """
        block, fresh_seeds = self.request.seeds[0], len(self.request.seeds)
        few = self.rungs[0][1]
        seeds = tuple(range(block, block + few))
        proposals = [Proposal(1, self._tried[0], seeds)]
        trials: list[Trial | None] = []
        if self.settings is None:
            trials = yield proposals
            if trials[0] is None:
                return
            self.settings = self._afforded(trials[0])
            proposals = []
        points = self._points()
        dimensions = self.space
        for share in PARTS:
            while len(trials) + len(proposals) < math.ceil(share * self.settings):
                point = _new_point(points, dimensions, self._tried)
                if point is None:
                    break
                self._tried.append(point)
                proposals.append(Proposal(len(self._tried), point, seeds))
            if proposals:
                trials += yield proposals
            proposals = []
            known = [trial for trial in trials if trial is not None]
            if len(known) < len(trials):
                return
            if share < 1:
                dimensions = self._moved(dimensions, _best(known, 1)[0].point)
        for rung, (count, each) in enumerate(self.rungs[1:], start=1):
            last = rung == len(self.rungs) - 1
            start = block + max(n for _, n in self.rungs[:-1]) if last else block
            seeds = tuple(range(start, start + (fresh_seeds if last else each)))
            rising = [Proposal(risen.number, risen.point, seeds, rung) for risen in _best(known, count)]
            risen_trials = yield rising
            known = [trial for trial in risen_trials if trial is not None]
            if len(known) < len(rising):
                return

    def _afforded(self, first: Trial) -> int:
        """Return how many settings the core-hours hold, by what a run of the first trial took."""
        hours = self.request.core_hours or 0.0
        a_run = first.core_seconds / len(first.seeds) / 3600
        seeds = len(self.request.seeds)
        settings = affordable(hours / a_run, seeds) if a_run else 0
        if settings <= FINALISTS:
            needed = runs(ladder(FINALISTS + 1, seeds)) * a_run
            raise OptionError(
                f"--budget {hours:g}core-hours: a run of {self.base.label} takes {a_run:.2g} of them, so that the "
                f"smallest search needs {needed:.2g}: give more, or fewer --seeds"
            )
        return self._at_most(settings)

    def _points(self) -> Iterable[Sequence[float]]:
        """Yield the points of a Halton sequence in (0, 1)^D, without end."""
        from scipy.stats import qmc  # takes half a second to import

        sequence = qmc.Halton(len(self.space), scramble=False)
        sequence.fast_forward(1)  # the first point is a corner
        while True:
            yield sequence.random(1)[0].tolist()

    def _moved(self, dimensions: space.Space, best: Point) -> space.Space:
        """Move the ranges at whose ends the best settings lie by half their width, where the options admit it."""
        moved = []
        for dimension in dimensions:
            ends = dimension.range
            side = 0 if ends is None else self._edge(dimension.name, best)
            if ends is not None and side * (_place(ends, best[dimension.name]) - 0.5) > 0.5 - OUTER:
                shift = side / 2
                further = Range(low=_value(ends, shift), high=_value(ends, 1 + shift), log=ends.log)
                if space.admits(self.base, replace(dimension, range=further)):
                    dimension = replace(dimension, range=further)
                    known = self.searched[dimension.name]
                    self.searched[dimension.name] = Range(
                        low=min(known.low, further.low), high=max(known.high, further.high), log=ends.log
                    )
            moved.append(dimension)
        return tuple(moved)

    def _edge(self, name: str, best: Point) -> int:
        """Return 1 or -1 where no larger or no smaller value of an option was tried than the best one, else 0."""
        values = [trial.point[name] for trial in self.trials]
        return int(best[name] == max(values)) - int(best[name] == min(values))

    @property
    def at_edge(self) -> list[str]:
        """Options of which nothing was tried beyond the best value."""
        best = self.best
        return [] if best is None else [name for name in self.searched if self._edge(name, best.point)]

    def _how(self) -> dict[str, Any]:
        """Return what the record says of how settings were chosen."""
        ranges = {d.name: replace(d, range=self.searched.get(d.name)).plain() for d in self.space}
        edges = ", ".join(name.partition(".")[2] for name in self.at_edge)
        return {
            "trials": len({trial.number for trial in self.trials}),
            "planned": self.settings,
            "space": ranges,
            "budget": self.budget_text,
            "rungs": self.rungs,
            "note": f"nothing was tried beyond the best {edges}" if edges else None,
        }

    def _sampler_key(self) -> list[Any]:
        return [self.request.sampler, self.request.trials or PER_OPTION, self.request.core_hours]

    @property
    def _warning(self) -> str:
        edges = self._how()["note"]
        return (
            "Trials of the last rung stand first, on seeds that no choice had seen before; an entry is judged on "
            f"protocol seeds all the same{f'. Beware: {edges}, more trials go on' if edges else ''}"
        )

    def _seeds_text(self, trial: Trial) -> str:
        return f"{len(trial.seeds)}{' fresh' if trial.rung == len(self.rungs) - 1 else ''}"


def _best(trials: Sequence[Trial], count: int) -> list[Trial]:
    return sorted(trials, key=lambda trial: (trial.merit.order, trial.number))[:count]


def _new_point(
    points: Iterable[Sequence[float]], dimensions: space.Space, known: Sequence[Point]
) -> Point | None:
    """Return the next combination that was not tried yet; None where there seems to be none."""
    for _, unit in zip(range(_DRAWS), points):
        point = {d.name: _at(d, place) for d, place in zip(dimensions, unit)}
        if point not in known:
            return point
    return None


def _at(dimension: Dimension, place: float) -> Any:
    """Return the value of a dimension at a place in (0, 1)."""
    if dimension.range is None:
        return dimension.values[int(place * len(dimension.values))]
    return _value(dimension.range, place)


def _value(ends: Range, place: float) -> float:
    """Return the number at a place of a range, 0 at its low end and 1 at its high one, with three digits."""
    low, high = (math.log(ends.low), math.log(ends.high)) if ends.log else (ends.low, ends.high)
    value = low + place * (high - low)
    value = math.exp(value) if ends.log else value
    return round(value) if ends.integer else float(f"{value:.3g}")


def _place(ends: Range, value: float) -> float:
    """Undo `_value`; outside of [0, 1] for numbers outside of the range."""
    if ends.log and value <= 0:
        return -math.inf
    low, high, at = (math.log(x) if ends.log else x for x in (ends.low, ends.high, value))
    return (at - low) / (high - low)
