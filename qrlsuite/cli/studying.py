"""What `qrlsuite study` plans: which entries lack what, in which order, and how much fits into a budget."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qrlsuite.cli.display import RunDisplay
from qrlsuite.cli.training import Place, Plan, plan, train
from qrlsuite.engine.api import Outcome
from qrlsuite.errors import OptionError
from qrlsuite.results.speed import BASES, Estimate, Speeds
from qrlsuite.results.text import duration
from qrlsuite.studies.study import Member


@dataclass(frozen=True)
class Item:
    """An entry of a study: what is missing of it, and what that costs.

    Attributes
    ----------
    groups:
        The study's groups that it belongs to.
    """

    plan: Plan
    groups: tuple[str, ...]
    estimate: Estimate

    @property
    def finished(self) -> int:
        """Number of seeds that are there."""
        return len(self.plan.seeds) - len(self.plan.missing) - len(self.plan.busy)

    @property
    def seconds(self) -> float | None:
        """Core-seconds left, None where unknown."""
        if not self.plan.groups:
            return 0.0
        if self.estimate.seconds is None:
            return None
        left = sum(len(group.seeds) * (self.plan.epochs - group.epoch) for group in self.plan.groups)
        return left * self.estimate.seconds

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        entry = self.plan.entry
        return {
            "task": entry.task.name,
            "entry": entry.name,
            "label": entry.label,
            "groups": list(self.groups),
            "folder": str(self.plan.store.path),
            "seeds": len(self.plan.seeds),
            "finished": self.finished,
            "busy": len(self.plan.busy),
            "missing": len(self.plan.missing),
            "epochs": self.plan.epochs,
            "seconds_per_seed_epoch": self.estimate.seconds,
            "basis": self.estimate.basis,
            "core_seconds_left": self.seconds,
        }


def survey(
    members: Sequence[Member],
    runs: Path,
    where: Place,
    speeds: Speeds,
    seeds: Sequence[int] | None,
    epochs: int | None,
) -> list[Item]:
    """Look at every entry of a study, in its order, each once; writes nothing.

    Parameters
    ----------
    seeds, epochs:
        None takes those of each task's protocol.

    Raises
    ------
    StoreError
        If an entry's folder is damaged.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for member in members:
        groups.setdefault((member.entry.task.name, member.entry.name), []).append(member.group)
    items = []
    unique = {(m.entry.task.name, m.entry.name): m.entry for m in members}
    for key, entry in unique.items():
        wanted = list(seeds) if seeds is not None else list(range(entry.task.file.protocol.seeds))
        last = epochs or entry.task.epochs(entry.algorithm.name)
        work = plan(runs, entry, wanted, last, where)
        items.append(Item(work, tuple(dict.fromkeys(groups[key])), speeds.estimate(entry)))
    return items


def cheapest_first(items: Sequence[Item]) -> list[Item]:
    """Return the items that lack something: the least core-seconds first, then those of unknown cost."""
    lacking = [item for item in items if item.plan.groups]
    return sorted(lacking, key=lambda item: (item.seconds is None, item.seconds or 0.0))


def fitting(item: Item, seconds: float, workers: int) -> list[int]:
    """Return the missing seeds that can be trained within a time: those that have least to go first.

    Where nothing of this very entry was measured yet, half of the time is planned for, at most: the next look will
    rest on a measurement. Where nothing is known at all, one seed per worker.
    """
    if item.estimate.seconds is None:
        return item.plan.missing[:workers]
    useful = seconds if item.estimate.basis == "measured" else seconds / 2
    to_go = sorted(
        ((item.plan.epochs - group.epoch) * item.estimate.seconds, seed)
        for group in item.plan.groups
        for seed in group.seeds
    )
    if to_go and to_go[0][0] <= seconds < 2 * to_go[0][0]:
        useful = seconds  # half would hold nothing
    chosen: list[int] = []
    total = 0.0
    for cost, seed in to_go:
        total += cost
        if max(cost, total / min(workers, len(chosen) + 1)) > useful:
            break
        chosen.append(seed)
    return sorted(chosen)


def check_budget(items: Sequence[Item], budget: float, workers: int) -> None:
    """Refuse a budget into which not even one seed of the cheapest entry fits.

    Raises
    ------
    OptionError
        Saying what the smallest piece of work would need.
    """
    order = cheapest_first(items)
    if not order or any(fitting(item, budget, workers) for item in order):
        return
    costs = [
        ((item.plan.epochs - group.epoch) * item.estimate.seconds, item)
        for item in order
        for group in item.plan.groups
        if item.estimate.seconds is not None
    ]
    least, item = min(costs, key=lambda pair: pair[0])
    raise OptionError(
        f"--budget of {duration(budget)} cannot hold one group: a seed of '{item.plan.entry.label}' to epoch "
        f"{item.plan.epochs} takes about {duration(least)} ({BASES[item.estimate.basis]}); "
        "give a longer budget, or fewer --epochs"
    )


@dataclass
class Session:
    """One `study run`: entries trained one after another, until nothing is missing or the budget is used up."""

    runs: Path
    where: Place
    speeds: Speeds
    budget: float | None = None
    quiet: bool = False
    submitted: list[str] = field(default_factory=list)
    trained: int = 0
    clock: Callable[[], float] = time.monotonic
    _planned: float = 0.0

    def run(self, items: Sequence[Item]) -> list[Item]:
        """Train what is missing, cheapest first; returns the items that did not fit into the budget.

        Raises
        ------
        typer.Exit
            With code 130 after Ctrl-C, with everything saved.
        QrlSuiteError
            If a group failed; finished epochs are kept.
        """
        began = self.clock()
        left_over = []
        order = cheapest_first(items)
        for number, first in enumerate(order, start=1):
            item = first
            while item.plan.groups:
                chosen = item.plan.missing
                if self.budget is not None:
                    left = self.budget - (self.clock() - began) - self._planned
                    chosen = fitting(item, left, self.where.workers) if left > 0 else []
                if not chosen:
                    left_over.append(item)
                    break
                item = self._batch(item, chosen, f"{number} of {len(order)}")
        return left_over

    def _batch(self, item: Item, chosen: list[int], title: str) -> Item:
        """Train some seeds of an item; returns what is left of it."""
        work = item.plan
        there = sorted(set(work.seeds) - set(work.missing) - set(work.busy))
        part = plan(self.runs, work.entry, sorted([*there, *chosen]), work.epochs, self.where)
        display = RunDisplay(
            work.entry, part.store, part.seeds, part.epochs, part.groups, self.where.workers, quiet=self.quiet
        )
        display.console.print(f"\n[bold]{title}[/bold]", end="  ")
        outcome = train(part, self.where, display)
        return self._after(item, part, outcome)

    def _after(self, item: Item, part: Plan, outcome: Outcome) -> Item:
        work = item.plan
        store = part.store
        if outcome.submitted is not None:
            self.submitted.append(outcome.submitted)
            if item.estimate.seconds is not None:
                todo = sum(len(group.seeds) * (work.epochs - group.epoch) for group in part.groups)
                self._planned += todo * item.estimate.seconds / self.where.workers
            untouched = sorted(set(work.missing) - set(part.missing))
            rest = plan(self.runs, work.entry, untouched, work.epochs, self.where)
        else:
            self.speeds.note(store)
            done = store.finished(part.missing, work.epochs)
            self.trained += len(done)
            stuck = set(part.missing) - done  # another process has them
            wanted = [seed for seed in work.seeds if seed not in stuck]
            rest = plan(self.runs, work.entry, wanted, work.epochs, self.where)
        return Item(rest, item.groups, self.speeds.estimate(work.entry))
