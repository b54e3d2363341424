"""Several studies with looks together: the pairs that all of them compare, on average over their tasks.

A study may stop a pair early, at a look where the difference happened to be large. So only the seeds of each study's
first look count here: every pair has them, whatever they showed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.columns import Column, record
from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, listed
from qrlsuite.results.text import interval_text, p_text, percent
from qrlsuite.statistics import MeanRatio, mean_ratio, times_below
from qrlsuite.statistics.across import DRAWN
from qrlsuite.statistics.grid import IntArray
from qrlsuite.statistics.sequential import holm_claims
from qrlsuite.statistics.times_board import holm
from qrlsuite.studies.state import State, by_question

ALPHA = 0.05
"""Probability of any false difference, over all pairs."""
SHOWN = 8
"""Studies that the title of a table names."""
OVER_SUCH = "over such tasks: the conclusion for all tasks, if these tasks were drawn from them at random"


@dataclass(frozen=True, slots=True)
class SharedPair:
    """A pair that several studies compare.

    Attributes
    ----------
    question:
        The question that it answers in the first study; may be empty.
    ratio:
        How many more steps the second entry needs, on each task and on average; each p is adjusted for all pairs
        (Holm).
    """

    question: str
    first: str
    second: str
    ratio: MeanRatio

    @property
    def verdict(self) -> str:
        """Which entry needs fewer steps on average over the tasks, if that is significant."""
        return self._verdict(self.ratio.p)

    @property
    def drawn_verdict(self) -> str:
        """Which entry needs fewer steps on average over tasks like these, if that is significant."""
        return self._verdict(self.ratio.drawn_p)

    def _verdict(self, p: float) -> str:
        if not p <= ALPHA:
            return "not told apart"
        return f"{self.first if self.ratio.difference > 0 else self.second} needs fewer"


@dataclass(frozen=True, eq=False, repr=False)
class StudiesTogether(Shown):
    """Several studies with looks, each of a task of its own, which compare entries of the same names.

    Entries of one name may have other options on another task: for example, options that were tuned for it.

    Attributes
    ----------
    studies:
        The studies that are averaged.
    controls:
        Studies of environments that were made for one kind of model: no mean and no claim counts them.
    pairs:
        The pairs that all studies compare and that have a ratio, in the order of the first study.
    left_out:
        One line for each pair that has no ratio.
    claims:
        The tasks on which each claim holds that all studies make, by Holm's procedure.
    """

    studies: tuple[State, ...]
    controls: tuple[State, ...]
    pairs: tuple[SharedPair, ...]
    left_out: tuple[str, ...]
    claims: Mapping[str, tuple[str, ...]]

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks, in the order of the studies."""
        return tuple(each.study.task for each in self.studies)

    @property
    def seeds(self) -> tuple[int, ...]:
        """Numbers of seeds that count on each task: the seeds of the study's first look."""
        return tuple(each.study.design.looks[0] for each in self.studies)

    @property
    def over_such(self) -> bool:
        """Whether the tasks are enough for a conclusion about further tasks like them."""
        return len(self.studies) >= DRAWN

    @property
    def changed(self) -> list[str]:
        """The entries of shared pairs whose options are not the same on all tasks, in order."""
        names = dict.fromkeys(name for pair in self.pairs for name in (pair.first, pair.second))
        keys = ("algorithm", "algorithm_options", "model", "model_options")
        identities = {name: [each.study.entries[name].identity for each in self.studies] for name in names}
        return [
            name for name in names if len({repr([i.get(key) for key in keys]) for i in identities[name]}) > 1
        ]

    def columns(self) -> tuple[Column[SharedPair], ...]:
        """Return the columns; a row is a pair."""

        def mean(pair: SharedPair) -> str:
            return interval_text(percent, pair.ratio.difference, *pair.ratio.interval)

        def drawn(pair: SharedPair) -> str:
            return interval_text(percent, pair.ratio.difference, *pair.ratio.drawn_interval)

        over_such: tuple[Column[SharedPair], ...] = (
            Column(
                "drawn_interval",
                lambda pair: list(pair.ratio.drawn_interval),
                head="over such tasks (95%)",
                cell=drawn,
            ),
            Column("drawn_p", lambda pair: pair.ratio.drawn_p, p_text, head="p over such tasks"),
            Column(
                "drawn_verdict",
                lambda pair: pair.drawn_verdict,
                str,
                head="verdict over such tasks",
                words=True,
            ),
        )

        def on(place: int, task: str) -> Column[SharedPair]:
            return Column("", lambda pair: pair.ratio.differences[place], percent, head=task)

        return (
            Column("question", lambda pair: pair.question or None),
            Column("first", lambda pair: pair.first),
            Column("second", lambda pair: pair.second),
            Column("", lambda pair: f"{pair.first} / {pair.second}", str, head="pair: A / B", words=True),
            Column("verdict", lambda pair: pair.verdict, str, words=True),
            Column("difference", lambda pair: pair.ratio.difference, head="mean (95%)", cell=mean),
            Column("interval", lambda pair: list(pair.ratio.interval)),
            Column("p", lambda pair: pair.ratio.p, p_text),
            *(over_such * self.over_such),
            Column("left_out", lambda pair: list(pair.ratio.left_out), _span, head="one left out"),
            Column("differences", lambda pair: dict(zip(self.tasks, pair.ratio.differences))),
            *(on(place, task) for place, task in enumerate(self.tasks)),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "studies": [each.study.name for each in self.studies],
            **({"controls": [each.study.name for each in self.controls]} if self.controls else {}),
            "tasks": list(self.tasks),
            "seeds": list(self.seeds),
            "alpha": ALPHA,
            "changed": self.changed,
            "left_out": list(self.left_out),
            "pairs": [record(self.columns(), pair) for pair in self.pairs],
            **(
                {"claims": {claim: list(tasks) for claim, tasks in self.claims.items()}}
                if self.claims
                else {}
            ),
        }

    @property
    def claim_lines(self) -> list[str]:
        """A sentence for each claim, with the tasks on which it holds."""
        alpha = max(each.study.looks.alpha for each in self.studies)
        return [
            f"claim: {claim}: established on {', '.join(tasks) or 'none'} (by all looks; error {alpha:g} over the "
            "tasks, Holm)"
            for claim, tasks in self.claims.items()
        ]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show a table for each question, with explanations."""
        counts = ", ".join(map(str, self.seeds if len({*self.seeds}) > 1 else self.seeds[:1]))
        names = listed([each.study.name for each in self.studies], SHOWN)
        yield Text(f"{names}: B against A, on each task and on average", style="bold")
        for sheet in self.sheets():
            yield from [Text(sheet.title, style="bold")] * bool(sheet.title)
            yield replace(sheet, title="")
        yield Text(
            "B against A: how many more steps B needs (+52% = B is slower), by the first look's seeds of each study "
            f"({counts}), which no early stop can bias; mean: of the ratios, over these "
            f"{len(self.tasks)} tasks, with a 95% interval by itself; one left out: the least and the greatest mean "
            f"without one of the tasks; verdict: error {ALPHA:g} for the {len(self.pairs)} pairs together (Holm). "
            "Tasks are fixed, only seeds are drawn: nothing follows for other tasks."
        )
        if self.over_such:
            yield Text(f"{OVER_SUCH}.")
        yield from map(Text, self.claim_lines)
        for each in self.controls:
            yield Text(
                f"not averaged: {each.study.name}, whose environment was made for {each.study.made_for} models"
            )
        yield from (Text(f"left out: {line}") for line in self.left_out)
        if self.changed:
            yield Text(f"entries with other options on another task: {', '.join(self.changed)}")

    def sheets(self) -> list[Sheet]:
        """Return a table of pairs for each question."""
        asked = dict.fromkeys(pair.question for pair in self.pairs)
        return [Sheet(text, self.columns(), [p for p in self.pairs if p.question == text]) for text in asked]


def together(studies: Sequence[State]) -> StudiesTogether:
    """Compare the pairs that several studies share, on average over their tasks.

    Tasks that were made for one kind of model are left out of means and claims.

    Raises
    ------
    OptionError
        If two studies have one task, one lacks its first look, they share no pair, or fewer than two are averaged.
    """
    seen: set[str] = set()
    for each in studies:
        if each.study.task in seen:
            raise OptionError(f"two studies are of task '{each.study.task}': give one of each task")
        seen.add(each.study.task)
        first_look = each.study.design.looks[0]
        if any(len(each.seeds[name]) < first_look for name in each.study.entries):
            name = each.study.name
            raise OptionError(f"study '{name}' has not taken its first look: qrlsuite study run {name}")
    counted = [each for each in studies if not each.study.made_for]
    if len(counted) < 2:
        raise OptionError(
            "a mean over tasks needs two tasks or more that were not made for one kind of model"
        )
    pairs, ratios, left_out = list(_shared(counted)), list[tuple[str, str, str, MeanRatio]](), list[str]()
    if not pairs:
        names = listed([each.study.name for each in studies])
        raise OptionError(
            f"{names} have no pair of entries in common: pairs are matched by the entries' names"
        )
    for asked, first, second in pairs:
        try:
            ratio = mean_ratio([(_times(each, first), _times(each, second)) for each in counted])
        except OptionError as error:
            left_out.append(f"{first} / {second}: {error}")
        else:
            ratios.append((asked, first, second, ratio))
    adjusted, drawn = (
        holm(np.array([getattr(ratio, name) for *_, ratio in ratios])).tolist() for name in ("p", "drawn_p")
    )
    found = tuple(
        SharedPair(asked, first, second, replace(ratio, p=p, drawn_p=other))
        for (asked, first, second, ratio), p, other in zip(ratios, adjusted, drawn)
    )
    controls = tuple(each for each in studies if each.study.made_for)
    return StudiesTogether(tuple(counted), controls, found, tuple(left_out), dict(_claims(counted)))


def _claims(studies: Sequence[State]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each claim that all studies make, and the tasks on which it holds."""
    by_study = [
        {
            (each.claim.entry, frozenset(each.claim.rivals), each.claim.at_most): each
            for each in state.decision.claims
        }
        for state in studies
    ]
    for key, first in by_study[0].items():
        if all(key in claims for claims in by_study):
            decided = [claims[key] for claims in by_study]
            count = max(len(studies), *(each.claim.tasks for each in decided))
            holds = holm_claims([(state.study.design, each) for state, each in zip(studies, decided)], count)
            tasks = tuple(state.study.task for state, held in zip(studies, holds) if held)
            yield f"on at least one of {count} tasks {first.claim.sentence}", tasks


def _shared(studies: Sequence[State]) -> Iterator[tuple[str, str, str]]:
    """Yield question, first and second entry of each pair that all studies have, in the order of the first study."""
    families = [{frozenset(pair) for pair in each.study.design.family} for each in studies]
    for asked, pairs in by_question(studies[0].study, studies[0].pairs):
        for pair in pairs:
            if all(frozenset((pair.first, pair.second)) in family for family in families):
                yield asked, pair.first, pair.second


def _times(state: State, name: str) -> IntArray:
    """Return an entry's steps below each threshold at the first look, (N, E)."""
    curves = state.curves[name]
    return times_below(curves.values[: state.study.design.looks[0]], state.study.grid, curves.steps_per_epoch)


def _span(ends: Sequence[float]) -> str:
    return " to ".join(map(percent, ends))
