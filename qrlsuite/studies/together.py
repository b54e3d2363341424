"""Several studies with looks together: the pairs that all of them compare, on average over their tasks.

A study may stop a pair early, at a look where the difference happened to be large. So only the seeds of each study's
first look count here: every pair has them, whatever they showed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, listed
from qrlsuite.results.text import interval_text, p_text, percent
from qrlsuite.statistics import MeanRatio, mean_ratio, times_below
from qrlsuite.statistics.grid import IntArray
from qrlsuite.statistics.times_board import holm
from qrlsuite.studies.state import State, by_question

ALPHA = 0.05
"""Probability of any false difference, over all pairs."""


@dataclass(frozen=True, slots=True)
class SharedPair:
    """A pair that several studies compare.

    Attributes
    ----------
    question:
        The question that it answers in the first study; may be empty.
    ratio:
        How many more steps the second entry needs, on each task and on average.
    p:
        Adjusted for all pairs (Holm).
    """

    question: str
    first: str
    second: str
    ratio: MeanRatio
    p: float

    @property
    def verdict(self) -> str:
        """Which entry needs fewer steps on average over the tasks, if that is significant."""
        if self.p > ALPHA:
            return "not told apart"
        return f"{self.first if self.ratio.difference > 0 else self.second} needs fewer"


@dataclass(frozen=True, eq=False, repr=False)
class StudiesTogether(Shown):
    """Several studies with looks, each of a task of its own, which compare entries of the same names.

    Entries of one name may have other options on another task: for example, options that were tuned for it.
    """

    studies: tuple[State, ...]

    def __post_init__(self) -> None:
        if len(self.studies) < 2:
            raise OptionError("a mean over tasks needs two studies or more")
        for place, study in enumerate(self.studies):
            if study.study.task in self.tasks[:place]:
                raise OptionError(f"two studies are of task '{study.study.task}': give one of each task")
            if any(self._lacking(study)):
                raise OptionError(
                    f"study '{study.study.name}' has not taken its first look: qrlsuite study run {study.study.name}"
                )
        if not self._named:
            names = listed([each.study.name for each in self.studies])
            raise OptionError(
                f"{names} have no pair of entries in common: pairs are matched by the entries' names"
            )

    @property
    def name(self) -> str:
        """The words that are in all names of the studies, as the first has them, or the first study's name."""
        first, *others = (study.study.name.split("-") for study in self.studies)
        common = [word for word in first if all(word in other for other in others)]
        return "-".join(common or first)

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks, in the order of the studies."""
        return tuple(each.study.task for each in self.studies)

    @property
    def seeds(self) -> tuple[int, ...]:
        """Numbers of seeds that count on each task: the seeds of the study's first look."""
        return tuple(each.study.design.looks[0] for each in self.studies)

    @staticmethod
    def _lacking(outcome: State) -> Iterator[str]:
        """Yield the entries that lack seeds of the first look."""
        for name in outcome.study.entries:
            curves = outcome.curves.get(name)
            if curves is None or len(curves.values) < outcome.study.design.looks[0]:
                yield name

    @cached_property
    def _named(self) -> list[tuple[str, str, str]]:
        """Question, first and second entry of each pair that all studies have."""
        have = [{frozenset(pair) for pair in each.study.design.family} for each in self.studies]
        first = self.studies[0]
        return [
            (asked, pair.first, pair.second)
            for asked, pairs in by_question(first.study, first.pairs)
            for pair in pairs
            if all(frozenset((pair.first, pair.second)) in family for family in have)
        ]

    def _times(self, outcome: State, name: str) -> IntArray:
        """Return an entry's times below each threshold at the first look, (N, E)."""
        curves = outcome.curves[name]
        seeds = outcome.study.design.looks[0]
        return times_below(curves.values[:seeds], outcome.study.grid, curves.steps_per_epoch)

    @cached_property
    def _ratios(self) -> dict[tuple[str, str, str], MeanRatio | str]:
        """The mean ratio of each pair, or why it has none."""
        found: dict[tuple[str, str, str], MeanRatio | str] = {}
        for named in self._named:
            _, first, second = named
            times = [(self._times(each, first), self._times(each, second)) for each in self.studies]
            try:
                found[named] = mean_ratio(times)
            except OptionError as error:
                found[named] = f"{first} / {second}: {error}"
        return found

    @cached_property
    def pairs(self) -> tuple[SharedPair, ...]:
        """The pairs that all studies compare and that have a ratio, in the order of the first study."""
        known = {named: ratio for named, ratio in self._ratios.items() if not isinstance(ratio, str)}
        adjusted = holm(np.array([ratio.p for ratio in known.values()])).tolist()
        return tuple(SharedPair(*named, ratio, p) for (named, ratio), p in zip(known.items(), adjusted))

    @property
    def left_out(self) -> list[str]:
        """One line for each pair that has no ratio."""
        return [each for each in self._ratios.values() if isinstance(each, str)]

    @property
    def changed(self) -> list[str]:
        """The entries of shared pairs whose options are not the same on all tasks, in order."""
        names = dict.fromkeys(name for pair in self.pairs for name in (pair.first, pair.second))
        return [name for name in names if len({_configuration(each, name) for each in self.studies}) > 1]

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "studies": [each.study.name for each in self.studies],
            "tasks": list(self.tasks),
            "seeds": list(self.seeds),
            "alpha": ALPHA,
            "changed": self.changed,
            "left_out": self.left_out,
            "pairs": [
                {
                    "question": pair.question or None,
                    "first": pair.first,
                    "second": pair.second,
                    "verdict": pair.verdict,
                    "p": pair.p,
                    "difference": pair.ratio.difference,
                    "interval": list(pair.ratio.interval),
                    "left_out": list(pair.ratio.left_out),
                    "differences": dict(zip(self.tasks, pair.ratio.differences)),
                }
                for pair in self.pairs
            ],
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show `parts`."""
        yield from self.parts()

    def parts(self) -> Iterator[Text | Sheet]:
        """Return the parts of a screen: a table for each question, with explanations."""
        names = ", ".join(each.study.name for each in self.studies)
        yield Text(f"{names}: B against A, on each task and on average", style="bold")
        questions = list(dict.fromkeys(pair.question for pair in self.pairs))
        for asked in questions:
            if asked:
                yield Text(asked, style="bold")
            yield self._sheet([pair for pair in self.pairs if pair.question == asked])
        seeds = ", ".join(map(str, self.seeds))
        yield Text(
            "B against A: how many more steps B needs (+52% = B is slower), by the first look's seeds of each study "
            f"({seeds}), which no early stop can bias; mean: of the ratios, over these {len(self.tasks)} tasks, with a "
            "95% interval by itself; one left out: the least and the greatest mean without one of the tasks; verdict: "
            f"error {ALPHA:g} for the {len(self.pairs)} pairs together (Holm). Tasks are fixed, only seeds are drawn: "
            "nothing follows for other tasks."
        )
        yield from (Text(f"left out: {line}") for line in self.left_out)
        if self.changed:
            yield Text(f"entries with other options on another task: {', '.join(self.changed)}")

    def _sheet(self, pairs: Sequence[SharedPair]) -> Sheet:
        """Return the table of some pairs."""
        heads = ("pair: A / B", "verdict", "mean (95%)", "p", "one left out", *self.tasks)
        rows = [
            (
                f"{pair.first} / {pair.second}",
                pair.verdict,
                interval_text(percent, pair.ratio.difference, *pair.ratio.interval),
                p_text(pair.p),
                _span(pair.ratio.left_out),
                *map(percent, pair.ratio.differences),
            )
            for pair in pairs
        ]
        return Sheet.of("", heads, rows, words=heads[:2])


def _configuration(outcome: State, name: str) -> str:
    """Return an entry's algorithm and model with all their options as text, whatever the task."""
    identity = outcome.study.entries[name].identity
    return repr([identity.get(key) for key in ("algorithm", "algorithm_options", "model", "model_options")])


def _span(ends: tuple[float, float]) -> str:
    return " to ".join(map(percent, ends))
