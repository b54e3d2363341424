"""Runs a study: finds missing seeds, trains the cheapest entry first, keeps to a time budget, takes looks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite import registry, specs
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.missing import find, require_same_code, require_trainable, train
from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.engine.where import Where
from qrlsuite.engine.work import EngineOutcome, Missing
from qrlsuite.errors import OptionError
from qrlsuite.options import Setting
from qrlsuite.results.speed import BASES, Estimate, Speeds
from qrlsuite.results.text import counted, duration, duration_range, hours_range, hours_text
from qrlsuite.statistics.sequential import Decision
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome, versus
from qrlsuite.studies.study import Member, Study


@dataclass(frozen=True)
class PendingEntry:
    """An entry of a study with its missing seeds and their estimated cost.

    Attributes
    ----------
    groups:
        The study's groups that it belongs to.
    """

    missing: Missing
    groups: tuple[str, ...]
    estimate: Estimate

    @property
    def finished(self) -> int:
        """Number of finished seeds."""
        return len(self.missing.seeds) - len(self.missing.todo) - len(self.missing.busy)

    @property
    def seconds(self) -> float | None:
        """Core-seconds left, None where unknown."""
        if not self.missing.groups:
            return 0.0
        if self.estimate.seconds is None:
            return None
        return self.missing.left * self.estimate.seconds

    @property
    def complete(self) -> bool:
        """Whether all of its seeds are finished."""
        return self.finished == len(self.missing.seeds)

    @property
    def range(self) -> tuple[float, float] | None:
        """The least and the most core-seconds left, None where unknown."""
        return self.estimate.range(self.missing.left) if self.missing.groups else (0.0, 0.0)

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        entry = self.missing.entry
        return {
            "task": entry.task.name,
            "entry": entry.name,
            "label": entry.label,
            "groups": list(self.groups),
            "folder": str(self.missing.store.path),
            "seeds": len(self.missing.seeds),
            "finished": self.finished,
            "busy": len(self.missing.busy),
            "missing": len(self.missing.todo),
            "epochs": self.missing.epochs,
            "seconds_per_seed_epoch": self.estimate.seconds,
            "basis": self.estimate.basis,
            "core_seconds_left": self.seconds,
            "core_seconds_range": self.range,
        }


@dataclass(frozen=True, repr=False)
class Overview(Shown):
    """A table of a study's entries: finished seeds, missing seeds, and their estimated time.

    Attributes
    ----------
    pairs:
        Numbers of decided pairs, and of pairs that can be tested yet.
    published:
        Numbers of published seeds by entry; None leaves them out.
    """

    study: Study
    items: Sequence[PendingEntry]
    workers: int
    pairs: tuple[int, int] = (0, 0)
    published: Mapping[str, int] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        costs = [item.seconds for item in self.items]
        known = [cost for cost in costs if cost is not None]
        return {
            **self.study.file.model_dump(
                mode="json", exclude={"format_version", "entries", "pictures", "looks"}
            ),
            "entries": [
                item.as_dict()
                | ({} if self.published is None else {"published": self.published[item.missing.entry.name]})
                for item in self.items
            ],
            "decided": self.pairs[0],
            "pairs": self.pairs[1],
            "workers": self.workers,
            "core_hours_left": sum(known) / 3600,
            "core_hours_range": [seconds / 3600 for seconds in _total(self.items)],
            "hours_left": sum(known) / 3600 / self.workers,
            "complete_estimate": len(known) == len(costs),
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show the study's question, a row per entry, and the remaining work."""
        file = self.study.file
        yield Text(file.summary, style="bold")
        if file.source:
            yield Text(file.source)
        if file.reports:
            yield Text(f"Reported there: {file.reports}")
        yield self._sheet() if self.items else Text("nothing to train")
        lacking = [item for item in self.items if item.missing.groups]
        if self.items and not lacking:
            yield Text("everything is there")
        elif self.items:
            yield Text(f"left: {_left(lacking, self.workers)}")
            for basis in dict.fromkeys(item.estimate.basis for item in lacking):
                yield Text(f"  {basis}: {BASES[basis]}")
        if self.pairs[1]:
            yield Text(
                f"{self.pairs[0]} of {counted(self.pairs[1], 'pair')} decided: of entries with 20 seeds or more, by "
                "mean time below threshold at an error of 5%"
            )
        if file.core_hours is not None:
            yield Text(
                f"the paper's software needed about {hours_text(file.core_hours)} core-hours for all of it"
            )
        yield Text(f"pictures: {', '.join(f'{p.name} ({p.kind})' for p in file.pictures)}")

    def _sheet(self) -> Sheet:
        with_published = ("published",) if self.published is not None else ()
        heads = ("task", "entry", "seeds", *with_published, "epochs", "core time left", "because")
        rows = []
        for item in self.items:
            cost = item.seconds
            busy = f" (+{len(item.missing.busy)} at work)" if item.missing.busy else ""
            cells = (
                item.missing.entry.task.name,
                item.missing.entry.label,
                f"{item.finished}/{len(item.missing.seeds)}{busy}",
                *([] if self.published is None else [str(self.published[item.missing.entry.name] or "-")]),
                str(item.missing.epochs),
                "-" if cost == 0 else "?" if item.range is None else duration_range(*item.range),
                "" if cost == 0 else item.estimate.basis,
            )
            rows.append(cells)
        return Sheet.of("", heads, rows, words=("task", "entry", "core time left", "because"))


def _total(items: Sequence[PendingEntry]) -> tuple[float, float]:
    """Return the least and the most core-seconds left, of items with known cost."""
    ranges = [item.range or (0.0, 0.0) for item in items]
    return sum(low for low, _ in ranges), sum(high for _, high in ranges)


def _left(items: Sequence[PendingEntry], workers: int) -> str:
    """Write the cost of items: time with a number of workers, core-hours, and the number of items of unknown cost."""
    low, high = _total(items)
    unknown = sum(item.seconds is None for item in items)
    more = f", and {counted(unknown, 'entry')} of unknown cost" if unknown else ""
    return (
        f"{duration_range(low / workers, high / workers)} with {counted(workers, 'worker')} "
        f"({hours_range(low / 3600, high / 3600)} core-hours{more})"
    )


def select(
    study: Study,
    settings: Sequence[Setting] = (),
    models: Mapping[str, str] | None = None,
    only: Sequence[str] = (),
) -> list[Member]:
    """Return the entries of a study that are wanted.

    Parameters
    ----------
    settings, models:
        As for `Study.members`; every model that takes the place of another has to be registered.
    only:
        Words that occur in an entry's group, label or task; or names of entries. Empty takes all.
    """
    for new in (models or {}).values():
        registry.get(specs.ModelSpec, new)
    members = study.members(settings, models)
    if not only:
        return members
    kept = [member for member in members if any(_mentions(member, word) for word in only)]
    if not kept:
        raise OptionError(f"{' or '.join(only)}: study '{study.name}' has no such entry")
    return kept


def _mentions(member: Member, word: str) -> bool:
    entry = member.entry
    return word == entry.name or any(word in text for text in (member.group, entry.label, entry.task.name))


def find_pending(
    members: Sequence[Member],
    runs: Path,
    where: Where,
    speeds: Speeds,
    seeds: Sequence[int] | None,
    epochs: int | None,
) -> list[PendingEntry]:
    """Look at every entry of a study, in its order, each once; writes nothing.

    Parameters
    ----------
    seeds, epochs:
        None takes each task's protocol.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for member in members:
        groups.setdefault((member.entry.task.name, member.entry.name), []).append(member.group)
    items = []
    unique = {(m.entry.task.name, m.entry.name): m.entry for m in members}
    for key, entry in unique.items():
        work = find(runs, entry, where, seeds, epochs)
        estimate = speeds.estimate(entry, work.together)
        items.append(PendingEntry(work, tuple(dict.fromkeys(groups[key])), estimate))
    return items


def work_left(items: Sequence[PendingEntry]) -> tuple[int, float]:
    """Return a sort key of studies: how many entries are of unknown cost, and the core-seconds left of the others."""
    costs = [item.seconds for item in items]
    return costs.count(None), sum(cost or 0.0 for cost in costs)


def cheapest_first(items: Sequence[PendingEntry]) -> list[PendingEntry]:
    """Return the items with missing seeds: the least core-seconds first, items of unknown cost last."""
    lacking = [item for item in items if item.missing.groups]
    return sorted(lacking, key=lambda item: (item.seconds is None, item.seconds or 0.0))


def fitting(item: PendingEntry, seconds: float, workers: int) -> list[int]:
    """Return the missing seeds that can be trained within a time, the seeds with the fewest epochs left first.

    If nothing of this entry was measured yet, at most half of the time is planned: the next plan will rest on a
    measurement. If nothing is known at all, one seed per worker.
    """
    if item.estimate.seconds is None:
        return item.missing.todo[:workers]
    useful = seconds if item.estimate.basis == "measured" else seconds / 2
    to_go = sorted(
        ((item.missing.epochs - group.epoch) * item.estimate.seconds, seed)
        for group in item.missing.groups
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


def dry_run(items: Sequence[PendingEntry], budget: float | None, workers: int) -> list[dict[str, Any]]:
    """Return the planned training, in order: `PendingEntry.as_dict` with the number of seeds, `would_train`.

    Parameters
    ----------
    budget:
        Seconds; None for all.
    """
    steps, left = [], budget
    for item in cheapest_first(items):
        chosen = item.missing.todo if left is None else fitting(item, left, workers)
        steps.append({**item.as_dict(), "would_train": len(chosen)})
        if left is not None and item.seconds is not None:
            left -= item.seconds * len(chosen) / len(item.missing.todo) / workers
    return steps


def check_budget(items: Sequence[PendingEntry], budget: float, workers: int) -> None:
    """Refuse a budget into which not even one seed of the cheapest entry fits."""
    order = cheapest_first(items)
    if not order or any(fitting(item, budget, workers) for item in order):
        return
    costs = [
        ((item.missing.epochs - group.epoch) * item.estimate.seconds, item.missing.epochs - group.epoch, item)
        for item in order
        for group in item.missing.groups
        if item.estimate.seconds is not None
    ]
    least, epochs, item = min(costs, key=lambda cost: cost[0])
    span = duration_range(*(item.estimate.range(epochs) or (least, least)))
    raise OptionError(
        f"--budget of {duration(budget)} cannot hold one group: a seed of '{item.missing.entry.label}' to epoch "
        f"{item.missing.epochs} takes about {duration(least)} ({span}; {BASES[item.estimate.basis]}); "
        "give a longer budget, or fewer --epochs"
    )


@dataclass
class Session:
    """One run of a study: entries trained one after another, until nothing is missing or the budget is used up."""

    runs: Path
    where: Where
    speeds: Speeds
    budget: float | None = None
    quiet: bool = False
    submitted: list[str] = field(default_factory=list)
    trained: int = 0
    clock: Callable[[], float] = time.monotonic
    _planned: float = 0.0
    _began: float | None = None

    def run(self, items: Sequence[PendingEntry]) -> list[PendingEntry]:
        """Train missing seeds, cheapest items first; return the items that did not fit into the budget.

        The budget counts from the first call: several studies share one.
        """
        if self._began is None:
            self._began = self.clock()
        require_trainable([item.missing.entry for item in items if item.missing.groups], self.where)
        left_over = []
        order = cheapest_first(items)
        for number, first in enumerate(order, start=1):
            item = first
            while item.missing.groups:
                chosen = item.missing.todo
                if self.budget is not None:
                    left = self.budget - (self.clock() - self._began) - self._planned
                    chosen = fitting(item, left, self.where.workers) if left > 0 else []
                if not chosen:
                    left_over.append(item)
                    break
                item = self._batch(item, chosen, f"{number} of {len(order)}")
        return left_over

    def _batch(self, item: PendingEntry, chosen: list[int], title: str) -> PendingEntry:
        """Train some seeds of an item; return the rest of the item."""
        work = item.missing
        complete = sorted(set(work.seeds) - set(work.todo) - set(work.busy))
        part = find(self.runs, work.entry, self.where, sorted([*complete, *chosen]), work.epochs)
        display = RunDisplay(part, self.where.workers, self.quiet)
        display.console.print(f"\n[bold]{title}[/bold]", end="  ")
        outcome = train(part, self.where, display)
        return self._after(item, part, outcome)

    def _after(self, item: PendingEntry, part: Missing, outcome: EngineOutcome) -> PendingEntry:
        work = item.missing
        store = part.store
        if outcome.submitted is not None:
            self.submitted.append(outcome.submitted)
            if item.estimate.seconds is not None:
                todo = sum(len(group.seeds) * (work.epochs - group.epoch) for group in part.groups)
                self._planned += todo * item.estimate.seconds / self.where.workers
            untouched = sorted(set(work.todo) - set(part.todo))
            rest = find(self.runs, work.entry, self.where, untouched, work.epochs)
        else:
            self.speeds.note(store)
            done = store.finished(part.todo, work.epochs)
            self.trained += len(done)
            stuck = set(part.todo) - done  # another process has them
            remaining = [seed for seed in work.seeds if seed not in stuck]
            rest = find(self.runs, work.entry, self.where, remaining, work.epochs)
        return PendingEntry(rest, item.groups, self.speeds.estimate(work.entry, rest.together))


def take_looks(study: StudyWithLooks, session: Session) -> StudyOutcome:
    """Train the seeds of each look and take it, until every pair is closed, or others have the seeds.

    Parameters
    ----------
    session:
        A session in the study's folder. Unless it is quiet, it prints the decisions of every look.
    """
    require_same_code(study.folder, list(study.entries.values()), session.where, session.quiet)
    study.begin()
    state = study.look()
    while wanted := state.decision.wanted:
        seeds = range(study.looks.first_seed, study.looks.first_seed + max(wanted.values()))
        members = [
            Member(name, study.entries[name], table) for name, table in zip(study.entries, study.file.entries)
        ]
        open_ = [member for member in members if member.group in wanted]
        session.run(find_pending(open_, study.folder, session.where, session.speeds, seeds, study.epochs))
        state = study.look()
        if state.missing and state.decision.wanted == wanted:
            break  # a queue or another process has the seeds, or the budget is used up
        _say_look(state.decision, Console(stderr=True, quiet=session.quiet, highlight=False))
    return StudyOutcome(study, state, tuple(session.submitted))


def _say_look(decision: Decision, console: Console) -> None:
    """Print the decisions of the newest look, while more is trained."""
    looks = max((len(pair.p) for pair in decision.pairs), default=0)
    if not looks:
        return
    console.print(f"\n[bold]look at {decision.design.looks[looks - 1]} seeds[/bold]")
    for pair in decision.pairs:
        if len(pair.p) == looks:
            console.print(
                f"{versus(pair)}: {pair.verdict} (p = {pair.p[-1]:.2g}, level {pair.levels[-1]:.2g})",
                markup=False,
                soft_wrap=True,
            )
