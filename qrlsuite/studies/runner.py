"""Trains studies: the entry that lacks least first, within a time budget; with looks, look by look."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite import registry, specs
from qrlsuite.engine.budget import seconds
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.missing import find, require_trainable, settle_codes, train
from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.engine.where import Where
from qrlsuite.engine.work import Missing
from qrlsuite.errors import OptionError, QrlSuiteError, listed
from qrlsuite.options import Setting
from qrlsuite.results import speed
from qrlsuite.results.speed import Speed
from qrlsuite.results.text import counted, duration_range, hours_range, hours_text
from qrlsuite.statistics.sequential import Decision
from qrlsuite.studies.looks import Study
from qrlsuite.studies.state import State, versus
from qrlsuite.studies.study import Member, StudyFile


@dataclass(frozen=True, repr=False)
class Overview(Shown):
    """A table of a study's entries: finished seeds, missing seeds, and their time where it was measured.

    Attributes
    ----------
    members:
        The entries in their groups; an entry may be in several.
    works:
        Each entry's seeds, once, in order.
    pairs:
        Numbers of decided pairs, and of pairs that can be tested yet.
    published:
        Numbers of published seeds by entry; None leaves them out.
    submitted:
        One line for each entry that was handed to a queue.
    """

    study: StudyFile
    members: Sequence[Member]
    works: Sequence[Missing]
    workers: int
    pairs: tuple[int, int] = (0, 0)
    published: Mapping[str, int] | None = None
    submitted: tuple[str, ...] = ()

    def now(self, where: Where) -> Overview:
        """Return the finished and the missing seeds now."""
        works = [find(work.runs, work.entry, where, work.seeds, work.epochs) for work in self.works]
        return replace(self, works=works)

    @functools.cached_property
    def _measured(self) -> list[tuple[Missing, Speed | None]]:
        """Each entry's seeds, and its speed in this results folder."""
        return [(work, speed.measure(work.store, work.together)) for work in self.works]

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        costs = [_cost(*each) for each in self._measured]
        known = [cost for cost in costs if cost is not None]
        return {
            **self.study.model_dump(mode="json", exclude={"format_version", "entries", "pictures", "looks"}),
            "entries": [
                self._entry(*each)
                | ({} if self.published is None else {"published": self.published[each[0].entry.name]})
                for each in self._measured
            ],
            "decided": self.pairs[0],
            "pairs": self.pairs[1],
            "workers": self.workers,
            "core_hours_left": sum(known) / 3600,
            "core_hours_range": [end / 3600 for end in _total(self._measured)],
            "hours_left": sum(known) / 3600 / self.workers,
            "complete_estimate": len(known) == len(costs),
            **({"submitted": list(self.submitted)} if self.submitted else {}),
        }

    def _entry(self, work: Missing, measured: Speed | None) -> dict[str, Any]:
        """Return an entry's seeds and their cost as plain values."""
        entry = work.entry
        key = (entry.task.name, entry.name)
        groups = [m.group for m in self.members if (m.entry.task.name, m.entry.name) == key]
        return {
            "task": entry.task.name,
            "entry": entry.name,
            "label": entry.label,
            "groups": list(dict.fromkeys(groups)),
            "folder": str(work.store.path),
            "seeds": len(work.seeds),
            "finished": _finished(work),
            "busy": len(work.busy),
            "missing": len(work.todo),
            "epochs": work.epochs,
            "seconds_per_seed_epoch": None if measured is None else measured.seconds,
            "core_seconds_left": _cost(work, measured),
            "core_seconds_range": _range(work, measured),
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show the study's question, a row per entry, and the remaining work."""
        file = self.study
        yield Text(file.summary, style="bold")
        if file.source:
            yield Text(file.source)
        if file.reports:
            yield Text(f"Reported there: {file.reports}")
        yield replace(self.sheets()[0], title="") if self.works else Text("nothing to train")
        lacking = [each for each in self._measured if each[0].groups]
        if self.works and not lacking:
            yield Text("everything is there")
        elif self.works:
            yield Text(f"left: {_left(lacking, self.workers)}")
        if self.pairs[1]:
            yield Text(
                f"{self.pairs[0]} of {counted(self.pairs[1], 'pair')} decided: of entries with 20 seeds or "
                "more, by steps below threshold at an error of 5%"
            )
        if file.core_hours is not None:
            yield Text(
                f"the paper's software needed about {hours_text(file.core_hours)} core-hours for all of it"
            )
        yield Text(f"pictures: {', '.join(f'{p.name} ({p.kind})' for p in file.pictures)}")
        yield from map(Text, self.submitted)

    def sheets(self) -> list[Sheet]:
        """Return the table of entries."""
        with_published = ("published",) if self.published is not None else ()
        heads = ("task", "entry", "seeds", *with_published, "epochs", "core time left")
        rows = []
        for work, measured in self._measured:
            cost, span = _cost(work, measured), _range(work, measured)
            busy = f" (+{len(work.busy)} at work)" if work.busy else ""
            cells = (
                work.entry.task.name,
                work.entry.label,
                f"{_finished(work)}/{len(work.seeds)}{busy}",
                *([] if self.published is None else [str(self.published[work.entry.name] or "-")]),
                str(work.epochs),
                "-" if cost == 0 else "?" if span is None else duration_range(*span),
            )
            rows.append(cells)
        words = ("task", "entry", "core time left")
        return [Sheet.of(self.study.summary, heads, rows, words=words, label=self.study.name)]


def _finished(work: Missing) -> int:
    return len(work.seeds) - len(work.todo) - len(work.busy)


def _cost(work: Missing, measured: Speed | None) -> float | None:
    """Return the core-seconds left, None where unknown."""
    if not work.groups:
        return 0.0
    return None if measured is None else work.left * measured.seconds


def _range(work: Missing, measured: Speed | None) -> tuple[float, float] | None:
    """Return the least and the most core-seconds left, None where unknown."""
    if not work.groups:
        return 0.0, 0.0
    return None if measured is None else measured.range(work.left)


def _total(costs: Sequence[tuple[Missing, Speed | None]]) -> tuple[float, float]:
    """Return the least and the most core-seconds left, of entries with known cost."""
    ranges = [_range(*each) or (0.0, 0.0) for each in costs]
    return sum(low for low, _ in ranges), sum(high for _, high in ranges)


def _left(costs: Sequence[tuple[Missing, Speed | None]], workers: int) -> str:
    """Write the cost of entries: time with a number of workers, core-hours, and the number of unknown costs."""
    low, high = _total(costs)
    unknown = sum(measured is None for _, measured in costs)
    more = f", and {counted(unknown, 'entry')} of unknown cost" if unknown else ""
    if unknown == len(costs):
        return f"{counted(unknown, 'entry')} of unknown cost, until a first epoch is trained"
    return (
        f"{duration_range(low / workers, high / workers)} with {counted(workers, 'worker')} "
        f"({hours_range(low / 3600, high / 3600)} core-hours{more})"
    )


def select(
    study: StudyFile,
    settings: Sequence[Setting] = (),
    models: Mapping[str, str] | None = None,
    only: Sequence[str] = (),
    each: bool = True,
) -> list[Member]:
    """Return the entries of a study that are wanted.

    Parameters
    ----------
    settings, models:
        As for `Study.members`; every model that takes the place of another has to be registered.
    only:
        Words that occur in an entry's group, label or task; or names of entries. Empty takes all.
    each:
        Whether every word has to fit an entry, and not one of them.
    """
    for new in (models or {}).values():
        registry.get(specs.ModelSpec, new)
    members = study.members(settings, models)
    if not only:
        return members
    unknown = [word for word in only if not any(_mentions(member, word) for member in members)]
    if unknown and (each or len(unknown) == len(only)):
        raise OptionError(f"{' or '.join(unknown)}: study '{study.name}' has no such entry")
    return [member for member in members if any(_mentions(member, word) for word in only)]


def _mentions(member: Member, word: str) -> bool:
    entry = member.entry
    return word == entry.name or any(word in text for text in (member.group, entry.label, entry.task.name))


def find_missing(
    members: Sequence[Member], runs: Path, where: Where, seeds: Sequence[int] | None, epochs: int | None
) -> list[Missing]:
    """Find the missing seeds of every entry of a study, in its order, each once; writes nothing.

    Parameters
    ----------
    seeds, epochs:
        None takes each task's protocol.
    """
    unique = {(member.entry.task.name, member.entry.name): member.entry for member in members}
    return [find(runs, entry, where, seeds, epochs) for entry in unique.values()]


def train_missing(
    works: Sequence[Missing], where: Where, budget: str | None, began: float, quiet: bool
) -> tuple[str, ...]:
    """Train missing seeds, the entry that lacks least first; return one line for each that was handed to a queue.

    Where an entry fails, the others go on, and the end says which.

    Parameters
    ----------
    budget, began:
        As for `qrlsuite.engine.missing.train`; several entries, looks and studies share one.
    """
    lacking = sorted((work for work in works if work.groups), key=lambda work: work.left)
    require_trainable([work.entry for work in lacking], where, quiet)
    limit, submitted, failed = seconds(budget, where.workers), list[str](), dict[str, QrlSuiteError]()
    for number, planned in enumerate(lacking, start=1):
        if limit is not None and time.monotonic() - began >= limit:
            break
        work = find(planned.runs, planned.entry, where, planned.seeds, planned.epochs)
        display = RunDisplay(work, where.workers, quiet)
        display.console.print(f"\n[bold]{number} of {len(lacking)}[/bold]", end="  ")
        try:
            outcome = train(work, where, display, budget, began=began)
        except QrlSuiteError as error:
            failed[planned.entry.label] = error
            display.console.print(f"failed: {error}", markup=False, soft_wrap=True)
            continue
        submitted += [] if outcome.submitted is None else [outcome.submitted]
    for label, first in failed.items():
        others = f"; likewise failed: {listed([*failed][1:])}" if len(failed) > 1 else ""
        raise type(first)(f"{label}: {first}{others}")
    return tuple(submitted)


def take_looks(study: Study, where: Where, budget: str | None, quiet: bool) -> State:
    """Train the seeds of each look and take it, until every pair is closed, or others have the seeds.

    Unless it is quiet, it prints the verdicts of every look.
    """
    settle_codes(study.folder, list(study.entries.values()), where, quiet)
    study.begin()
    state, began, submitted = study.look(), time.monotonic(), tuple[str, ...]()
    while wanted := state.decision.wanted:
        seeds = range(study.looks.first_seed, study.looks.first_seed + max(wanted.values()))
        entries = [entry for name, entry in study.entries.items() if name in wanted]
        works = [find(study.folder, entry, where, seeds, study.epochs) for entry in entries]
        submitted += train_missing(works, where, budget, began, quiet)
        state = study.look()
        if state.missing and state.decision.wanted == wanted:
            break  # a queue or another process has the seeds, or the budget is used up
        _say_look(state.decision, Console(stderr=True, quiet=quiet, highlight=False))
    return replace(state, submitted=submitted)


def _say_look(decision: Decision, console: Console) -> None:
    """Print the verdicts of the newest look, while more is trained."""
    looks = max([len(pair.p) for pair in decision.pairs] + [len(claim.p) for claim in decision.claims])
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
    for claim in decision.claims:
        if len(claim.p) == looks:
            console.print(f"{claim.claim.sentence}: {claim.verdict}", markup=False, soft_wrap=True)
