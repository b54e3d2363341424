"""The search that says how good its settings are: it goes on until the expected regret is small, or the budget ends.

Settings are chosen by `qrlsuite.tuning.surrogate`. First come the untuned setting, settings given by hand, and a few
spread over the ranges (a Halton sequence); then, twelve at a time, settings that may be the best, new or tried before.
Each time they are trained on seeds that no setting had before, to the whole horizon: poor settings get fewer seeds, and
never fewer epochs, which would favor settings that begin fast. In a last round, the best three are trained on many
seeds that no setting had, and the best one there is chosen: the best of many trials of a few seeds had luck.

Regret is how much longer than at the best settings learning takes at the chosen ones. Several models that are searched
until the same regret are compared fairly, though one may need more trials than another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import replace
from typing import Any

import numpy as np

from qrlsuite import notation
from qrlsuite.errors import OptionError
from qrlsuite.experiment import preset
from qrlsuite.experiment.entry import resolve
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import counted
from qrlsuite.tuning import space, surrogate
from qrlsuite.tuning.objective import Merit
from qrlsuite.tuning.search import Proposal, Search, Train, Trial
from qrlsuite.tuning.space import Dimension, Point, Range

PER_OPTION = 40
"""Trials for each varied option, at most, unless told otherwise."""

FINALISTS = 3
"""Settings in the last round."""

LAST_SEEDS = 100_000
"""The seeds of the last round begin as many numbers after those of the first: no other trial has them."""


class Bayesian(Search):
    """One search; see the module.

    Attributes
    ----------
    searched:
        The ranges with their extensions, by option.
    taken:
        Settings given by hand that set only varied options.
    last:
        The trials of the last round from best to worst; empty before it has ended.
    """

    def _begin(self) -> None:
        request = self.request
        untuned = self._space(request.grid is None)
        own = space.base(untuned, self.base)
        self.space = tuple(
            d
            if d.range is not None or own[d.name] in d.values
            else replace(d, values=(own[d.name], *d.values))
            for d in untuned
        )
        self.searched = {d.name: d.range for d in self.space if d.range is not None}
        first, *_ = seeds = request.seeds
        if list(seeds) != list(range(first, first + len(seeds))):
            raise OptionError(
                f"--seeds {format_seeds(seeds)}: it takes seeds one after the other, such as --seeds {len(seeds)}"
            )
        free = self._free
        self._coarse = {d.name for d in self.space if not free.issuperset(d.name.split("+"))}
        self.taken = self._given()
        given = {self._place(point).tobytes(): point for point in (own, *self.taken.values())}
        self._exact = given
        self._climb = surrogate.Climb(
            [np.frombuffer(place) for place in given],
            snap=lambda place: self._place(self._point(place)),
            encode=self._encode,
            extends=self._extends,
            seed=request.sampler_seed,
            shared=[i for i, d in enumerate(self.space) if d.name in self._coarse],
        )
        self._latest: dict[int, Trial] = {}
        self.last: list[Trial] = []
        self._steps = self._proposals()
        self._next = next(self._steps)
        self._tried_now: list[Trial | None] = []

    def _given(self) -> dict[str, Point]:
        points = {}
        for row in self.request.rows:
            try:
                own = notation.parse_entry(f"{self.request.entry} {row}")
                entry = resolve(self.request.task, own.given(settings=self.request.settings))
                point = space.base(self.space, entry)
                self._place(point)
            except OptionError:
                continue
            if self._entry(point).hash == entry.hash:
                points[row] = point
        return points

    def _point(self, place: surrogate.Floats) -> Point:
        """Return the settings nearest to a place."""
        exact = self._exact.get(place.tobytes())
        return exact or {d.name: self._value(d, float(at)) for d, at in zip(self.space, place)}

    def _value(self, dimension: Dimension, place: float) -> Any:
        """Return an option's value: of a list the nearest, of a range a number of three digits.

        Options in which agents of one population cannot differ go in steps of a factor of two, so that settings often
        share a population.
        """
        ends = dimension.range
        if ends is None:
            count = len(dimension.values)
            return dimension.values[min(max(int(place * count), 0), count - 1)]
        if ends.log and dimension.name in self._coarse:
            octave = math.log(2) / math.log(ends.high / ends.low)
            place = round(place / octave) * octave
        return value(ends, place)

    def _place(self, point: Point) -> surrogate.Floats:
        places = []
        for d in self.space:
            if d.range is not None:
                places.append(place_of(d.range, point[d.name]))
            elif point[d.name] in d.values:
                places.append((d.values.index(point[d.name]) + 0.5) / len(d.values))
            else:
                raise OptionError(f"{d.name}: {point[d.name]!r} is missing in the list of values")
        return np.array(places)

    def _encode(self, place: surrogate.Floats) -> surrogate.Floats:
        """Return places; of lists of other things than numbers, a number for each value, far from all others."""
        numbers: list[float] = []
        for d, at in zip(self.space, place):
            if d.range is not None or all(isinstance(v, int | float) for v in d.values):
                numbers.append(float(at))
            else:
                numbers += [float(v == self._value(d, float(at))) for v in d.values]
        return np.array(numbers)

    def _extends(self, d: int, low: float, high: float) -> bool:
        """Extend a range, where the option admits it."""
        dimension = self.space[d]
        if dimension.range is None:
            return False
        further = Range(
            low=value(dimension.range, low), high=value(dimension.range, high), log=dimension.range.log
        )
        if not space.admits(self.base, replace(dimension, range=further)):
            return False
        self.searched[dimension.name] = further
        return True

    @property
    def planned(self) -> int:
        """How many trials there are to be, at most; settings that get more seeds count again."""
        return self._limit + FINALISTS * bool(self.request.last)

    @property
    def runs_planned(self) -> int:
        """How many runs, each of one seed, all planned trials take."""
        return self._limit * len(self.request.seeds) + FINALISTS * self.request.last

    @property
    def next_seeds(self) -> int:
        """How many seeds the next trial has."""
        return len(self._next[0].seeds) if self._next else len(self.request.seeds)

    @property
    def _limit(self) -> int:
        """How many trials there are before the last round, at most."""
        pace = self._pace
        if self.request.core_hours is not None and self.request.trials is None and pace:
            runs = 3600 * self.request.core_hours / pace - FINALISTS * self.request.last
            return max(self.asked, int(runs / len(self.request.seeds)))
        return (self.request.trials or PER_OPTION) * len(self.space)

    @property
    def _pace(self) -> float:
        """Mean core-seconds of a run so far; 0 before the first."""
        return self.core_seconds / self.runs_done if self.runs_done else 0.0

    @property
    def budget_text(self) -> str:
        """Return the search's budget, in words that are equal for models with equal budgets."""
        goal = f"expected regret {self.request.regret:.0%}"
        if self._climb.regret is not None and self.regret_reached:
            return goal
        if self.request.core_hours is not None:
            return f"{goal}, or {self.request.core_hours:g} core-hours"
        return f"{goal}, or {counted(self.request.trials or PER_OPTION, 'trial')} per option"

    @property
    def plan_text(self) -> str:
        """Say until when settings are tried."""
        count, seeds = len(self.space), counted(len(self.request.seeds), "seed")
        return (
            f"{counted(count, 'option')}, until {self.budget_text}: at most {self._limit} trials of {seeds}"
            + f", then the best {FINALISTS} on {counted(self.request.last, 'seed')}" * bool(self.request.last)
        )

    @property
    def regret_reached(self) -> bool:
        """Whether the expected regret is small enough, and nothing speaks against the chosen settings."""
        regret = self._climb.regret
        return (
            regret is not None
            and regret.expected <= self.request.regret
            and not (self._climb.moved or self.behind)
        )

    @property
    def behind(self) -> bool:
        """Whether the untuned settings were measured to be better than the chosen ones."""
        untuned, best = self._latest.get(0), next(iter(self._by_surrogate), None)
        return untuned is not None and best is not None and untuned.merit.signal < best.merit.signal

    @property
    def over(self) -> bool:
        """Whether no further trial is begun: the regret or the budget is reached, or some wait for others."""
        return not self._next

    @property
    def beside(self) -> int:
        """How many settings can be trained side by side in one population."""
        return 1 if self._coarse else surrogate.BATCH

    @property
    def presentable(self) -> bool:
        """Whether a regret is known, and no trial waits."""
        return self._climb.regret is not None and not self.pending

    def step(self, train: Train, most: int = 1) -> list[Trial | None]:
        """Run the next trials, `most` at a time where they do not depend on each other, else fewer.

        Returns
        -------
        list
            A trial is None where some of its runs are left to another process or a queue.
        """
        if not self._next:
            raise RuntimeError("the search is over")
        trials = self._try(self._next[:most], train)
        self._next = self._next[most:]
        self._tried_now += trials
        if not self._next:
            tried, self._tried_now = self._tried_now, []
            self._next = next(self._steps) if None not in tried else []
        return trials

    def _proposals(self) -> Generator[list[Proposal], None, None]:
        """Propose trials that do not depend on each other, until nothing more is to be tried."""
        first, each, last = self.request.seeds[0], len(self.request.seeds), 0
        while wanted := self._climb.next()[: self._room]:
            if self.behind and 0 not in wanted:  # untuned settings that had luck get further seeds
                wanted = [*wanted[:-1], 0]
            seeds = tuple(range(first + last * each, first + (last + 1) * each))
            yield [
                Proposal(number + 1, self._point(self._climb.tried[number]), seeds, last, self._seen(number))
                for number in wanted
            ]
            self._latest |= {trial.number - 1: trial for trial in self.trials}
            latest = [*self._latest.values()]
            self._climb.tell(
                [*self._latest],
                np.array([max(trial.merit.signal, 1.0) for trial in latest]),
                np.array([trial.spread for trial in latest]),
                np.array([len(trial.seeds) for trial in latest], np.float64),
            )
            last += 1
        if self.request.last:
            finalists = self._finalists(last)
            yield finalists
            self.last = sorted(self.trials[-len(finalists) :], key=lambda trial: trial.merit.order)
        yield []

    def _finalists(self, last: int) -> list[Proposal]:
        """Propose the last round: the settings that the surrogate has as the best, on seeds of their own."""
        first = self.request.seeds[0] + LAST_SEEDS
        seeds = tuple(range(first, first + self.request.last))
        best = [trial.number for trial in self._by_surrogate[:FINALISTS]]
        if self.behind and 1 not in best:
            best[-1] = 1
        return [Proposal(number, self._point(self._climb.tried[number - 1]), seeds, last) for number in best]

    def _seen(self, number: int) -> tuple[int, ...]:
        return self._latest[number].seeds if number in self._latest else ()

    @property
    def _room(self) -> int:
        """How many trials the budget holds; a first round at least, and none more where the regret is small enough."""
        if self.regret_reached:
            return 0
        hours, trials = self.request.core_hours, surrogate.BATCH
        if hours is not None and self.asked:
            left = 3600 * hours - self.core_seconds - self._pace * FINALISTS * self.request.last
            trials = int(left / (self._pace * len(self.request.seeds))) if self._pace else trials
        if (hours is None or self.request.trials is not None) and self.asked:
            trials = min(trials, self._limit - self.asked)
        return max(trials, 0)

    def _spread(self, curves: surrogate.Floats, worth: Callable[[surrogate.Floats], Merit]) -> float:
        """Return the jackknife's standard deviation of a run, in units of the mean."""
        count = len(curves)
        if count == 1:
            return 0.0
        without = np.array([worth(np.delete(curves, i, axis=0)).signal for i in range(count)])
        deviation = math.sqrt((count - 1) * float(np.square(without - without.mean()).sum()))
        return deviation / max(float(without.mean()), 1.0)

    @property
    def ordered(self) -> list[Trial]:
        """The settings from best to worst: by the last round, then by the surrogate, each on all its seeds."""
        again = {trial.number for trial in self.last}
        return [*self.last, *(trial for trial in self._by_surrogate if trial.number not in again)]

    @property
    def _by_surrogate(self) -> list[Trial]:
        known = [self._latest[number] for number in self._climb.order if number in self._latest]
        return known or sorted(self.trials, key=lambda trial: (trial.merit.order, trial.number))

    @property
    def at_edge(self) -> list[str]:
        """Options whose best value is the lowest or highest that was tried."""
        edges = self._climb.edges([*self._latest]) if self._latest else []
        return [self.space[d].name for d, _ in edges if self.space[d].range is not None]

    @property
    def regret_text(self) -> str:
        """Describe the regret of the chosen settings, with doubts; empty before it is known."""
        regret = self._climb.regret
        if regret is None:
            return ""
        edges = ", ".join(name.partition(".")[2] for name in self.at_edge)
        return "; ".join(
            [
                f"expected regret {regret.expected:.1%} (90 percent interval {regret.low:.1%} to {regret.high:.1%}), "
                f"within {surrogate.NEAR:.0%} of the best with probability {regret.near:.0%}",
                *([f"nothing was tried beyond the best {edges}"] if edges else []),
                *(["the untuned settings were measured to be better"] if self.behind else []),
                *([self._last_text] if self.last else []),
            ]
        )

    @property
    def _last_text(self) -> str:
        return (
            f"the best of {len(self.last)} on {self.request.last} seeds each, with an expected regret among them of "
            f"{self._regret_among.expected:.1%}"
        )

    @property
    def _regret_among(self) -> surrogate.Regret:
        """The regret of the chosen settings among the settings of the last round."""
        return surrogate.regret_among(
            np.array([max(trial.merit.signal, 1.0) for trial in self.last]),
            np.array([trial.spread for trial in self.last]),
            np.array([len(trial.seeds) for trial in self.last], np.float64),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values: settings from best to worst, and the regret."""
        regret = self._how()["regret"]
        return {**super().as_dict(), "regret": None if regret is None else regret.model_dump()}

    def _how(self) -> dict[str, Any]:
        """Return the record of the choice of settings."""
        regret = self._climb.regret
        return {
            "trials": len(self.trials) - len(self.last),
            "planned": self._limit if self.request.core_hours is None else None,
            "space": {d.name: replace(d, range=self.searched.get(d.name)).plain() for d in self.space},
            "budget": self.budget_text,
            "regret": None
            if regret is None
            else preset.RegretRecord(
                goal=self.request.regret,
                expected=regret.expected,
                low=regret.low,
                high=regret.high,
                near=regret.near,
            ),
            "last": self._last_record() if self.last else None,
            "note": "; ".join([self.regret_text, *["the last round is missing"] * self._lacks_last]),
        }

    def _last_record(self) -> preset.LastRoundRecord:
        regret = self._regret_among
        return preset.LastRoundRecord(
            seeds=format_seeds(self.last[0].seeds),
            values=tuple(trial.merit.value for trial in self.last),
            expected=regret.expected,
            low=regret.low,
            high=regret.high,
        )

    @property
    def _lacks_last(self) -> bool:
        return bool(self.request.last) and not self.last

    def _sampler_key(self) -> list[Any]:
        return [self.request.sampler, self.request.sampler_seed, list(self.request.rows)]

    @property
    def _warning(self) -> str:
        said = f"First row: {self.regret_text}" if self.regret_text else "No regret is known yet"
        rows = "The last round's rows come first, and others are" if self.last else "Rows are"
        return f"{said}. {rows} ordered by the surrogate, which knows all trials"


def value(ends: Range, place: float) -> float:
    """Return the number at a place of a range, 0 at its low end and 1 at its high one, with three digits."""
    low, high = (math.log(ends.low), math.log(ends.high)) if ends.log else (ends.low, ends.high)
    number = low + place * (high - low)
    number = math.exp(number) if ends.log else number
    return round(number) if ends.integer else float(f"{number:.3g}")


def place_of(ends: Range, number: float) -> float:
    """Undo `value`; outside of [0, 1] for numbers outside of the range."""
    if ends.log and number <= 0:
        return -math.inf
    low, high, at = (math.log(x) if ends.log else x for x in (ends.low, ends.high, number))
    return (at - low) / (high - low)
