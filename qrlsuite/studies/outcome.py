"""What a decision plan has come to: run it, and show it on a screen, on a page and as plain values."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.terminal import Shown
from qrlsuite.engine.where import Where
from qrlsuite.errors import QrlSuiteError
from qrlsuite.results import speed
from qrlsuite.results.text import counted, hours_range, hours_text, steps_text
from qrlsuite.statistics.grid import Grid
from qrlsuite.statistics.planning import runs_at_difference
from qrlsuite.statistics.sequential import Decided, Decision, PairDecision
from qrlsuite.statistics.times import MeanTime, mean_time
from qrlsuite.studies import looks
from qrlsuite.studies.looks import StudyWithLooks

Pair = TypeVar("Pair")
"""What is known of a pair: its decision, or more."""

Hours = tuple[float, float]
"""Least and most core-hours to be expected; both the same where they were measured on the entry's own seeds."""


@dataclass(frozen=True, eq=False, repr=False)
class StudyOutcome(Shown):
    """A plan with what it has decided so far.

    Attributes
    ----------
    study:
        The plan in its results folder.
    decision:
        Every pair with its verdict, p at each look, difference and interval.
    submitted:
        One line for each entry whose seeds were handed to a queue.
    """

    study: StudyWithLooks
    decision: Decision
    submitted: tuple[str, ...] = ()

    @property
    def pairs(self) -> tuple[PairDecision, ...]:
        """The planned pairs; `verdict` says in words what was decided of each."""
        return self.decision.pairs

    @property
    def finished(self) -> bool:
        """Whether every pair is decided or its last look was taken."""
        return self.decision.finished

    @property
    def looked(self) -> dict[str, int]:
        """Seeds of each entry at its last look; 0 where no look has reached it."""
        seeds = dict.fromkeys(self.study.entries, 0)
        for pair in self.pairs:
            for name in (pair.first, pair.second):
                seeds[name] = max(seeds[name], pair.n_runs)
        return seeds

    def mean_times(self) -> dict[str, MeanTime]:
        """Return M of each entry, its mean time below threshold, over the seeds of its last look.

        Entries that no look has reached are absent.
        """
        looked = self.looked
        return {
            name: mean_time(replace(curves, values=curves.values[: looked[name]]), self.study.grid)
            for name, curves in self.study.curves().items()
            if looked[name]
        }

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        study, decision = self.study, self.decision
        missing = study.missing(decision)
        protocol = {name: entry.task.file.protocol.seeds for name, entry in study.entries.items()}
        used = {name: len(study.seeds(name)) for name in study.entries}
        closed = [name for name in study.entries if name not in decision.wanted]
        saved = {name: protocol[name] - used[name] for name in closed if used[name]}
        times = self.mean_times()
        return {
            "plan": study.file.name,
            "hash": study.file.hash,
            "finished": decision.finished,
            "begun_at": study.begun_at,
            "ended": study.ended,
            "looks_taken": study.taken,
            "reason": study.file.reason or None,
            "pairs": [
                {"question": asked or None, **_pair_as_dict(study, decision, pair)}
                for asked, pairs in by_question(study, decision.pairs)
                for pair in pairs
            ],
            "entries": [
                {
                    "name": name,
                    "entry": entry.name,
                    "seeds": used[name],
                    "core_hours": study.hours(name),
                    "mean_time": times[name].mean if name in times else None,
                    "mean_time_interval": list(times[name].interval) if name in times else None,
                    "wanted": decision.wanted.get(name),
                    "missing": missing.get(name, 0),
                }
                for name, entry in study.entries.items()
            ],
            "next_core_hours": total_hours(study, missing),
            "protocol_seeds": sum(protocol.values()),
            "seeds_saved": sum(saved.values()),
            "core_hours_saved": total_hours(study, saved),
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show `parts`."""
        yield from self.parts()

    def parts(self) -> Iterator[Text | Table]:
        """Return what a screen shows: a question, a table of pairs, and lines about looks, needs and cost."""
        study, decision, facts = self.study, self.decision, self.as_dict()
        yield Text(f"{study.file.name}: {question(study)}", style="bold")
        if not study.begun:
            yield Text("not begun")
        for asked, pairs in by_question(study, list(zip(decision.pairs, facts["pairs"]))):
            if asked:
                yield Text(asked, style="bold")
            yield _table(study, pairs)
        if any(pair.p for pair in decision.pairs):
            yield Text(
                "B against A: how many more steps B needs, on average over the thresholds (+52% = B is slower), with "
                f"a repeated confidence interval that holds at every look ({100 * (1 - study.file.alpha):g} percent "
                "for all pairs together). Each threshold is tested separately: where this interval contains 0, the "
                "threshold that decided follows with its own. An early stop overstates the difference."
            )
            yield _entries_table(facts["entries"])
            yield Text(
                "steps below threshold: of a run of the entry, mean over seeds and thresholds, at its last look"
            )
        if study.begun_at:
            yield Text(f"first seed begun {study.begun_at}")
        for seeds, when in facts["looks_taken"].items():
            yield Text(f"look at {seeds} seeds taken {when}")
        if note := reason_note(study):
            yield Text(note)
        if study.ended:
            yield Text(f"ended {study.ended}: open pairs stay open")
        elif not decision.finished:
            lacking = sum(each["missing"] for each in facts["entries"])
            cost = _about(facts["next_core_hours"])
            yield Text(f"next look: {counted(lacking, 'seed')} missing{cost}")
        used, spent = (sum(each[key] for each in facts["entries"]) for key in ("seeds", "core_hours"))
        saved, hours = facts["seeds_saved"], facts["core_hours_saved"]
        more = hours and (min(map(abs, hours)), max(map(abs, hours)))
        yield Text(
            f"used {counted(used, 'seed')}, {hours_text(spent)} core-hours; the protocol has "
            f"{facts['protocol_seeds']} seeds: {abs(saved)} {'saved' if saved >= 0 else 'more than that'} on "
            f"entries that are decided{_about(more) if saved else ''}"
        )


def run(
    study: StudyWithLooks,
    where: Where,
    quiet: bool = False,
    again: Literal["command", "call"] = "command",
    looked: Callable[[StudyOutcome], None] | None = None,
) -> StudyOutcome:
    """Train what each look needs and take it, until every pair is closed, or others have the seeds it needs.

    Parameters
    ----------
    where:
        The engine.
    quiet, again:
        As for `RunDisplay`.
    looked:
        Called after each look.

    Raises
    ------
    QrlSuiteError
        If the plan cannot be used or go on, or training failed; finished epochs are kept.
    KeyboardInterrupt
        When it was interrupted and every worker has saved and ended.
    """
    missing.require_same_code(study.folder, list(study.entries.values()), where)
    study.begin()
    submitted: list[str] = []
    decision = study.look()
    while wanted := study.wanted(decision):
        for name, seeds in wanted.items():
            work = missing.find(study.folder, study.entries[name], where, seeds, study.file.epochs)
            if not work.groups and not work.busy:
                continue
            outcome = missing.train(work, where, RunDisplay(work, where.workers, quiet, again))
            submitted += [outcome.submitted] if outcome.submitted is not None else []
        decision = study.look()
        if study.missing(decision) and study.wanted(decision) == wanted:
            break  # a queue or another process has the seeds
        if looked is not None:
            looked(StudyOutcome(study, decision))
    return StudyOutcome(study, decision, tuple(submitted))


def read(path: Path, runs: Path) -> StudyOutcome:
    """Return what a plan has decided so far; trains and writes nothing.

    Raises
    ------
    QrlSuiteError
        If the plan or its results cannot be used.
    """
    study = StudyWithLooks(looks.load(path), str(path), runs)
    return StudyOutcome(study, study.decision())


def in_folder(runs: Path, tasks: Sequence[str] = ()) -> tuple[list[StudyOutcome], list[str]]:
    """Return what the plans that have begun in a results folder have decided, and a line for each that is unreadable.

    Parameters
    ----------
    tasks:
        Only plans of these tasks; all where empty.
    """
    outcomes, refused = [], []
    for path in sorted((runs / looks.FOLDER).glob("*/plan.toml")):
        try:
            outcome = read(path, runs)
        except QrlSuiteError as error:
            refused.append(str(error))
            continue
        task = next(iter(outcome.study.entries.values())).task.name
        if outcome.study.begun and (not tasks or task in tasks):
            outcomes.append(outcome)
    return outcomes, refused


def hours(study: StudyWithLooks, name: str, seeds: int) -> Hours | None:
    """Return the core-hours of so many seeds of an entry: measured on its own, else estimated; None where unknown."""
    done = len(study.seeds(name))
    if done:
        own = seeds * study.hours(name) / done
        return own, own
    estimate = speed.known(study.folder, study.runs).estimate(study.entries[name], None)
    span = estimate.range(abs(seeds) * study.file.epochs)
    if span is None:
        return None
    low, high = (math.copysign(end / 3600, seeds) for end in span)
    return low, high


def total_hours(study: StudyWithLooks, seeds: Mapping[str, int]) -> Hours | None:
    """Return the core-hours of seeds of several entries together; None where one is unknown."""
    known = [each for name, count in seeds.items() if (each := hours(study, name, count)) is not None]
    if len(known) < len(seeds):
        return None
    return sum(low for low, _ in known), sum(high for _, high in known)


def question(study: StudyWithLooks) -> str:
    """Return what a plan asks: `which needs fewer steps, A, B or C?`, or the number of its questions."""
    if study.questions:
        return f"{counted(len(study.file.questions), 'question')}, {counted(len(study.plan.family), 'pair')}"
    names = list(study.entries)
    return f"which needs fewer steps, {', '.join(names[:-1])} or {names[-1]}?"


def by_question(study: StudyWithLooks, pairs: Sequence[Pair]) -> list[tuple[str, list[Pair]]]:
    """Return each question of a plan with what is known of its pairs, in order; an empty text where none is asked."""
    texts = study.questions or [""] * len(pairs)
    return [
        (text, [pair for _, pair in group])
        for text, group in itertools.groupby(zip(texts, pairs), key=lambda each: each[0])
    ]


def reason_note(study: StudyWithLooks) -> str:
    """Return a warning with the reason given where a plan looks below 20 seeds; else an empty text."""
    if study.plan.looks[0] >= 20:
        return ""
    return (
        "NOTE: it looks below 20 seeds, where rare failures that have not occurred yet decide too much. Reason "
        f"given: {study.file.reason}"
    )


def versus(pair: PairDecision) -> str:
    """Return `A / B`."""
    return f"{pair.first} / {pair.second}"


def percent(value: float) -> str:
    """Write a difference: `+12%`."""
    return f"{100 * value:+.0f}%" if abs(value) < 100 else ("+inf" if value > 0 else "-100%")


def difference_text(pair: PairDecision, grid: Grid) -> tuple[str, str]:
    """Return a pair's difference and its interval as text; empty where there is none.

    Where a pair was found to differ and the interval of the mean contains 0, the threshold that decided follows with
    the difference there and its own interval.
    """
    if not _finite(pair):
        return "", ""
    low, high = pair.interval
    return percent(pair.difference), f"{percent(low)} to {percent(high)}" + _leading_text(pair, grid)


def _leading_text(pair: PairDecision, grid: Grid) -> str:
    low, high = pair.interval
    one_sided = pair.decided in (Decided.FIRST, Decided.SECOND)
    if not (one_sided and low <= 0 <= high and math.isfinite(pair.leading_difference)):
        return ""
    ends = " to ".join(map(percent, pair.leading_interval))
    return f"; at {grid.thresholds[pair.leading]:g}: {percent(pair.leading_difference)}, {ends}"


def needs_text(study: StudyWithLooks, needs: Mapping[str, Any] | None) -> str:
    """Say what an open pair needs, as `as_dict` gives it."""
    if needs is None or study.ended:
        return ""
    requirement = f"p <= {needs['level']:.2g} at {needs['seeds']} seeds"
    about = needs["seeds_at_this_difference"]
    if about is None:
        return requirement
    last = study.plan.looks[-1]
    seeds = f"about {about}" if about <= 10 * last else f"over {10 * last}"
    return f"{requirement}; {seeds} if the difference stays as it is now"


def _about(span: Hours | None) -> str:
    return "" if span is None or not span[1] else f", about {hours_range(*span)} core-hours"


def _finite(pair: PairDecision) -> bool:
    return bool(pair.p) and all(math.isfinite(end) for end in (pair.difference, *pair.interval))


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pair_as_dict(study: StudyWithLooks, decision: Decision, pair: PairDecision) -> dict[str, Any]:
    plan = decision.plan
    needs = None
    if pair.decided is None:
        look = len(pair.p)
        undecided = sum(not each.differs for each in decision.pairs)
        needs = {
            "seeds": plan.looks[look],
            "level": plan.level(look, undecided),
            "seeds_at_this_difference": runs_at_difference(decision, pair),
        }
    finite = _finite(pair)
    return {
        "first": pair.first,
        "second": pair.second,
        "verdict": pair.verdict,
        "decided": None if pair.decided is None else str(pair.decided),
        "seeds": pair.n_runs,
        "p": list(pair.p),
        "levels": list(pair.levels),
        "difference": pair.difference if finite else None,
        "interval": list(pair.interval) if finite else None,
        "leading_threshold": study.grid.thresholds[pair.leading] if finite else None,
        "leading_difference": _number(pair.leading_difference) if finite else None,
        "leading_interval": [_number(end) for end in pair.leading_interval] if finite else None,
        "needs": needs,
    }


def _table(study: StudyWithLooks, pairs: Sequence[tuple[PairDecision, Mapping[str, Any]]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in ("pair: A / B", "verdict", "seeds", "B against A", "interval", "p", "needs"):
        table.add_column(column, overflow="fold")
    for pair, facts in pairs:
        cells = (
            versus(pair),
            pair.verdict,
            str(pair.n_runs),
            *difference_text(pair, study.grid),
            f"{pair.p[-1]:.2g}" if pair.p else "",
            needs_text(study, facts["needs"]),
        )
        table.add_row(*(Text(cell) for cell in cells))
    return table


def _entries_table(entries: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in ("entry", "seeds", "steps below threshold (95%)", "core-hours"):
        table.add_column(column, overflow="fold")
    for facts in entries:
        time = ""
        if facts["mean_time"] is not None:
            low, high = map(steps_text, facts["mean_time_interval"])
            time = f"{steps_text(facts['mean_time'])} ({low} to {high})"
        cells = (facts["name"], str(facts["seeds"]), time, hours_text(facts["core_hours"]))
        table.add_row(*(Text(cell) for cell in cells))
    return table
