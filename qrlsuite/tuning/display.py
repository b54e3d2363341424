"""Shows the progress of a search: its size and cost, a bar, a line per trial."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from qrlsuite import specs
from qrlsuite.engine.display import Bar, Clock
from qrlsuite.engine.terminal import again
from qrlsuite.engine.where import Where
from qrlsuite.engine.work import Missing
from qrlsuite.errors import listed
from qrlsuite.options import field_names, tuned
from qrlsuite.results import speed
from qrlsuite.results.seeds import LARGEST_GROUP
from qrlsuite.results.text import counted, duration, duration_range, hours_range, hours_text, steps_text
from qrlsuite.tuning.objective import cell_text
from qrlsuite.tuning.search import Search, Trial, merit_text
from qrlsuite.tuning.space import text


class TuneDisplay:
    """Shows searches: a live bar on a terminal or in a notebook, a line per trial, nothing when quiet.

    A call of a function shows no line per trial beside a bar.
    """

    def __init__(self, searches: Sequence[Search], where: Where, quiet: bool = False) -> None:
        self.searches, self.where, self.again = searches, where, again()
        self.console = Console(stderr=True, quiet=quiet, highlight=False)
        self.bar = Bar(self.console)
        self._works: Sequence[Missing] = ()
        self._clock = Clock(0)
        self._per_run: float | None = None
        """Seconds of one seed of a trial, by the pace of the trials that are trained now or were last."""
        self._done = 0
        """Number of trials before the ones in training."""
        self._said: set[str] = set()

    def begin(self) -> None:
        """Print the size of each search, and its cost if known."""
        costs = [self._cost(search) for search in self.searches]
        for search in self.searches:
            request, base = search.request, search.base
            lines = [
                f"{base.label} on {base.task.name}: {search.plan_text} x {search.epochs} epochs, "
                f"{steps_text(search.steps)} steps in all",
                *(f"  {dimension.name}: {_short(dimension.plain())}" for dimension in search.space),
                f"  minimized: {cell_text(base.task.file.ranking, request.objective)}",
            ]
            options_class = specs.resolve(base.algorithm.options)
            names = field_names(options_class)
            if names and request.grid is None and not request.varied and not tuned(options_class):
                lines.append(
                    f"  {base.algorithm.name} marks no option for tuning ({listed(names)}): write --vary "
                    "'NAME={low=1e-4, high=1e-2, log=true}', or mark it, NAME: Annotated[float, Tuned(1e-4, 1e-2)]"
                )
            self.console.print("\n".join(lines), markup=False)
        cores, known = self.where.workers, [cost for cost in costs if cost is not None]
        if len(known) < len(costs):
            self.console.print("the cost is known after the first trial; finished trials cost nothing again")
        else:
            low, high = map(sum, zip(*known))
            self.console.print(
                f"{hours_range(low / 3600, high / 3600)} core-hours, {duration_range(low / cores, high / cores)} with "
                f"{counted(cores, 'process', 'processes')} ({speed.MEASURED}); finished trials cost nothing again"
            )

    def _cost(self, search: Search) -> tuple[float, float] | None:
        """Return the least and the most core-seconds of a whole search; None if unknown."""
        runs = len(search.request.seeds) * (search.beside if self.where.room > 1 else 1)
        together = min(LARGEST_GROUP, math.ceil(runs / self.where.workers))
        measured = speed.find(search.base, together, search.runs, search.results)
        return None if measured is None else measured.range(search.runs_planned * search.epochs)

    def begin_trials(self, works: Sequence[Missing]) -> None:
        """Show that trials begin; some may have finished before."""
        self._works = ()
        self._done = sum(search.asked for search in self.searches) - sum(bool(work.groups) for work in works)
        for work in works:
            if work.busy:
                self.console.print(
                    f"{work.entry.label}: {len(work.busy)} runs are left to another process or a queue",
                    markup=False,
                )
        self.bar.start(sum(search.planned for search in self.searches), "tuning")

    def training(self, works: Sequence[Missing]) -> None:
        """Show that some of the trials are now trained side by side."""
        self._done += len(self._works)
        self._works = works
        self._clock = Clock(min(group.epoch for work in works for group in work.groups))
        self._clock.begun = time.monotonic()
        self.update({})

    def update(self, snapshot: dict[str, dict[str, Any]]) -> None:
        """Show where the trials at work stand."""
        if not self.bar.shown or not self._works:
            return
        count, last = len(self._works), self._works[0].epochs
        begun = min(group.epoch for work in self._works for group in work.groups)
        epochs = [int(state.get("epoch") or begun) for state in snapshot.values()] or [begun]
        numbers = f"trial {self._done + 1}" if count == 1 else f"trials {self._done + 1}-{self._done + count}"
        parts = [
            f"{numbers}/{sum(search.planned for search in self.searches)}",
            f"epoch {min(epochs)}/{last}",
        ]
        parts += [f"best {steps_text(s.best.merit.value)}" for s in self.searches if s.best is not None]
        left = self._left(min(epochs), last)
        if left is not None:
            parts.append(f"{duration(left)} left")
        part = sum(epochs) / (len(epochs) * last)
        self.bar.update(self._done + count * part, "tuning", "  ".join(parts))

    def _left(self, epoch: int, last: int) -> float | None:
        """Return the seconds left; None before a trial's second epoch has ended."""
        now = time.monotonic()
        self._clock.look({"epoch": epoch}, now)
        trained = sum(len(work.todo) for work in self._works)
        if self._clock.pace is not None:
            self._per_run = (self._clock.once + self._clock.pace * last) / trained
        if self._per_run is None:
            return None
        rest = sum(search.runs_planned - search.runs_done for search in self.searches) - trained
        current = self._clock.left(last, now)
        current = trained * self._per_run if current is None else current
        return current + max(0, rest) * self._per_run

    def told(self, search: Search, trial: Trial | None) -> None:
        """Show a trial's result."""
        if trial is None or (self.again == "call" and self.bar.shown):
            return
        best = "  best so far" if search.best is trial else ""
        several = f"{search.base.label}  " if len(self.searches) > 1 else ""
        self.console.print(
            f"{several}trial {search.trials.index(trial) + 1}/{search.planned}  {text(trial.point)}: "
            f"{merit_text(trial)}{best}",
            markup=False,
            soft_wrap=True,
        )

    def regret(self, search: Search) -> None:
        """Show the regret of the best settings and the cost so far, if the regret is known and has changed."""
        said = f"{search.base.label}: {search.regret_text}"
        if search.regret_text and said not in self._said:
            self._said.add(said)
            spent = f"{search.runs_done} runs, {hours_text(search.core_seconds / 3600)} core-hours"
            self.console.print(f"{said} ({spent})", markup=False, soft_wrap=True)

    def close(self) -> None:
        """Take the live bar away."""
        self.bar.stop()

    def interrupted(self) -> None:
        """Say that everything is safe."""
        self.close()
        done = sum(len(search.trials) for search in self.searches)
        self.console.print(
            f"stopped after {counted(done, 'trial')}; every finished epoch is saved. "
            f"The same {self.again} continues from there.",
            soft_wrap=True,
        )
        for search in self.searches:
            if search.written is not None:
                self.console.print(
                    f"the best settings so far: {search.written}", markup=False, soft_wrap=True
                )


def _short(values: Any) -> str:
    text = str(values)
    return text if len(text) <= 100 else f"{text[:97]}..."
