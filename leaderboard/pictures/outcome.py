"""A study with looks: its pairs, with intervals and verdicts, or its entries by mean steps; several: pairs by task."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from qrlsuite.errors import OptionError, listed
from qrlsuite.leaderboard.pictures import style
from qrlsuite.results.text import steps_text
from qrlsuite.statistics.sequential import Decided, PairDecision
from qrlsuite.studies import state as outcomes
from qrlsuite.studies.state import State
from qrlsuite.studies.together import OVER_SUCH, StudiesTogether

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TICKS = (0.1, 0.2, 0.333, 0.5, 0.667, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
"""Ratios of mean steps that the axis may name."""
WIDEST = (TICKS[0], TICKS[-1])
TUNED = ", tuned"
"""End of a tuned entry's name, which the untuned model's name lacks."""
GRAY = "#8c8c8c"
LOOKS: dict[Decided | None, tuple[str, str, str]] = {
    Decided.FIRST: ("A needs fewer steps", style.COLORS[0], "o"),
    Decided.SECOND: ("B needs fewer steps", style.COLORS[1], "s"),
    Decided.TRADE_OFF: ("trade-off", style.COLORS[3], "D"),
    Decided.EQUAL: ("equal within the margin", style.COLORS[2], "^"),
    Decided.NOT_TOLD_APART: ("not told apart", GRAY, "v"),
    None: ("open", GRAY, "x"),
}
"""Text of the legend, color and marker, by how a pair was closed."""


def draw(outcome: State) -> Figure:
    """Draw a row for each pair, below the question that it answers.

    The axis is B's mean steps below threshold over A's, in logarithms: twice as long is as far to the right as half as
    long is to the left. Lines are repeated confidence intervals. Both are cut at a factor of 10.
    """
    study, decision = outcome.study, outcome.decision
    if not any(pair.p for pair in decision.pairs):
        raise OptionError(f"{study.name} has taken no look yet: there is nothing to draw")
    groups = outcomes.by_question(study, decision.pairs)
    rows: list[str | PairDecision] = []
    for question, pairs in groups:
        rows += [question] * bool(question) + list(pairs)
    names = [outcomes.versus(row) if isinstance(row, PairDecision) else row for row in rows]
    figure = Figure(figsize=(9.5, 1.4 + 0.25 * len(rows)), layout="constrained")
    axes = figure.subplots()
    ends = [1.0]
    for height, row in enumerate(rows):
        if isinstance(row, PairDecision):
            ends += _row(axes, height, row)
    margin = study.looks.margin
    _ratios(axes, ends, margin)
    axes.set_xlabel(f"pair A / B: how much longer B is {study.grid.before} the thresholds than A")
    _name_rows(axes, names)
    for tick, row in zip(axes.get_yticklabels(), rows):
        if not isinstance(row, PairDecision):
            tick.set_fontweight("bold")
    _legend(axes, decision.pairs)
    confidence = 100 * (1 - study.looks.alpha)
    _finish(
        figure,
        f"{study.task}: {study.name}",
        f"repeated confidence intervals: they hold at every look, {confidence:g} percent for all "
        f"{len(decision.pairs)} pairs together",
        _open_markers(decision.pairs),
        f"shaded: equal within {100 * margin:g} percent",
        "right: seeds of each entry at the pair's last look",
        "an early stop overstates the difference",
        f"cut at a factor of {WIDEST[1]:g}" if any(map(_cut, decision.pairs)) else "",
    )
    return figure


def draw_entries(outcome: State) -> Figure:
    """Draw each entry that a look has reached by its mean steps below threshold M, the shortest first.

    An entry called `X, tuned` shares the row of the entry X.
    """
    study, times, looked = outcome.study, outcome.mean_times(), outcome.looked
    if not times:
        raise OptionError(f"{study.name} has taken no look yet: there is nothing to draw")
    rows: dict[str, list[str]] = {}
    for name in sorted(times, key=lambda name: times[name].mean):
        base = name.removesuffix(TUNED)
        rows.setdefault(base if base in times else name, []).append(name)
    figure = Figure(figsize=(8.0, 1.5 + 0.26 * len(rows)), layout="constrained")
    axes = figure.subplots()
    models = list(dict.fromkeys(entry.model.name for entry in study.entries.values()))
    tuned = {name for name, table in zip(study.entries, study.file.entries) if table.tuning is not None}
    for height, (row, names) in enumerate(rows.items()):
        for name in names:
            look = style.style(models.index(study.entries[name].model.name))
            place = height + (0.0 if len(names) == 1 else -0.14 if name == row else 0.14)
            axes.plot(times[name].interval, [place, place], color=look.color, lw=1.4)
            face = look.color if name in tuned or not tuned else "white"
            axes.plot(times[name].mean, place, look.marker, color=look.color, mfc=face, ms=5)
        seeds = dict.fromkeys(f"{looked[name]}" for name in sorted(names, key=len))
        _at_right(axes, height, ", ".join(seeds))
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda steps, _: steps_text(steps)))
    axes.set_xlabel(f"M: environment steps of a run {study.grid.before} threshold")
    _name_rows(axes, list(rows))
    for model in models:
        look = style.style(models.index(model))
        axes.plot([], [], look.marker, color=look.color, label=style.plain(model), ls="none")
    _finish(
        figure,
        f"{study.task}: {study.name}",
        "M: mean over seeds and the task's thresholds, with 95 percent intervals of each entry alone",
        "filled: with settings that tuning found" if tuned else "",
        "right: seeds at the last look",
        "an early stop can over- or understate M; verdicts compare pairs at equal seeds",
    )
    return figure


def draw_together(together: StudiesTogether) -> Figure:
    """Draw a row for each task below each pair that all studies compare, and the mean over the tasks.

    The axis is as in `draw`. A task's row has the verdict, interval and seeds of its own study; `StudiesTogether`
    computes the mean.
    """
    if not together.pairs:
        raise OptionError(f"no pair has a mean over the tasks: {'; '.join(together.left_out)}")
    studies = (*together.studies, *together.controls)
    found = [{(pair.first, pair.second): pair for pair in each.pairs} for each in studies]
    height = 1.4 + 0.25 * len(together.pairs) * (len(studies) + 2 + together.over_such)
    figure = Figure(figsize=(9.5, height), layout="constrained")
    axes = figure.subplots()
    names: list[str] = []
    heads, ends, shown = [], [1.0], []
    for shared in together.pairs:
        heads.append(len(names))
        names.append(f"{shared.first} / {shared.second}")
        for each, pairs in zip(studies, found):
            pair = pairs.get((shared.first, shared.second))
            if pair is None and (shared.second, shared.first) in pairs:
                pair = _reversed(pairs[shared.second, shared.first])
            if pair is None:  # of a task that is not averaged
                continue
            ends += _row(axes, len(names), pair)
            shown.append(pair)
            made_for = each.study.made_for
            names.append(each.study.task + (f", made for {made_for} models" if made_for else ""))
        means = [(shared.ratio.interval, f"mean of {len(together.studies)} tasks: {shared.verdict}")]
        if together.over_such:
            means.append((shared.ratio.drawn_interval, f"over such tasks: {shared.drawn_verdict}"))
        for interval, name in means:
            ratio, low, high = (_within(1 + end) for end in (shared.ratio.difference, *interval))
            axes.plot([low, high], [len(names)] * 2, color="black", lw=1.6)
            axes.plot([ratio], [len(names)], "*", color="black", ms=9)
            ends += [low, high]
            names.append(name)
    margins = {each.study.looks.margin for each in studies}
    shade = margins.pop() if len(margins) == 1 else None
    _ratios(axes, ends, shade or 0.0)
    axes.set_xlabel("pair A / B: how many more steps B needs than A (on the right, A is ahead)")
    _name_rows(axes, names)
    for head in heads:
        axes.get_yticklabels()[head].set_fontweight("bold")
    _legend(axes, shown)
    axes.plot([], [], "*", color="black", ms=9, label="mean over the tasks")
    _finish(
        figure,
        f"{len(studies)} tasks: {listed([each.study.name for each in studies], 1)}",
        "tasks: each study's verdicts and repeated confidence intervals, which hold for all of its pairs and looks; "
        "right: seeds of each entry at the pair's last look",
        "equality is tested for each pair by itself; an early stop overstates the difference",
        _open_markers(shown),
        "mean: of the ratios, by the first look's seeds of each study, with a 95 percent interval by itself; the "
        "verdict holds for all pairs",
        OVER_SUCH * together.over_such,
        "" if shade is None else f"shaded: equal within {100 * shade:g} percent",
        *(f"left out: {line}" for line in together.left_out),
        f"cut at a factor of {WIDEST[1]:g}" if any(map(_cut, shown)) else "",
    )
    return figure


def _reversed(pair: PairDecision) -> PairDecision:
    """Return a pair with its entries exchanged, in all that a row shows."""
    decided = {Decided.FIRST: Decided.SECOND, Decided.SECOND: Decided.FIRST}
    (difference, high, low), (leading, leading_high, leading_low) = (
        [math.inf if end == -1 else 1 / (1 + end) - 1 for end in ends]
        for ends in (
            (pair.difference, *pair.interval),
            (pair.leading_difference, *pair.leading_interval),
        )
    )
    return dataclasses.replace(
        pair,
        first=pair.second,
        second=pair.first,
        difference=difference,
        interval=(low, high),
        leading_difference=leading,
        leading_interval=(leading_low, leading_high),
        decided=pair.decided and decided.get(pair.decided, pair.decided),
    )


def _ratios(axes: Axes, ends: Sequence[float], margin: float) -> None:
    """Make the axis one of ratios, wide enough for all that was drawn, with the margin shaded."""
    low, high = min(ends) / 1.1, max(ends) * 1.1
    axes.axvspan(1 / (1 + margin), 1 + margin, color="#000000", alpha=0.07, lw=0)
    axes.axvline(1, color="#404040", lw=0.8)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(_ticks(low, high)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda ratio, _: f"{ratio - 1:+.0%}" if ratio != 1 else "0"))


def _legend(axes: Axes, pairs: Sequence[PairDecision]) -> None:
    for each, (label, color, marker) in LOOKS.items():
        if any(pair.decided is each for pair in pairs):
            axes.plot([], [], marker, color=color, label=label, ls="none")


def _ticks(low: float, high: float) -> list[float]:
    """Return the `TICKS` in a range whose labels, from 1 outward, do not touch."""
    room = 0.09 * math.log(high / low)
    kept = [1.0]
    for tick in sorted(TICKS, key=lambda tick: abs(math.log(tick))):
        if low <= tick <= high and all(abs(math.log(tick / other)) > room for other in kept):
            kept.append(tick)
    return kept


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Write the rows' names, the first at the top."""
    axes.set_ylim(len(names) - 0.4, -0.7)
    axes.set_yticks(range(len(names)), [style.plain(name, 90) for name in names], fontsize=8.5)
    axes.tick_params(axis="y", length=0)
    style.tidy(axes)
    axes.grid(False, axis="y")


def _at_right(axes: Axes, height: int, text: str) -> None:
    axes.annotate(
        text, (1.005, height), xycoords=("axes fraction", "data"), fontsize=8, va="center", color="#505050"
    )


def _finish(figure: Figure, title: str, *footnotes: str) -> None:
    """Add legend, title and remarks."""
    figure.legend(loc="outside upper right", ncols=3, frameon=False, fontsize=8)
    figure.suptitle(style.plain(title), x=0.01, ha="left", fontsize="medium")
    style.footnotes(figure, *footnotes)


def _cut(pair: PairDecision) -> bool:
    return bool(pair.p) and not all(WIDEST[0] <= 1 + end <= WIDEST[1] for end in pair.shown[1:])


def _open_markers(pairs: Sequence[PairDecision]) -> str:
    return "open markers: at the threshold that decided" if any(pair.at_threshold for pair in pairs) else ""


def _within(ratio: float) -> float:
    """Return a ratio, cut at the axis' ends."""
    return min(max(ratio, WIDEST[0]), WIDEST[1])


def _row(axes: Axes, height: int, pair: PairDecision) -> list[float]:
    """Draw a pair and return the ends of its line, as ratios."""
    if not pair.p or math.isnan(pair.difference):
        text = "both entries spend no step below a threshold" if pair.p else "no look yet"
        axes.annotate(text, (1, height), fontsize=8, va="center")
        return []
    ratio, low, high = (_within(1 + end) for end in pair.shown)
    _, color, marker = LOOKS[pair.decided]
    axes.plot([low, high], [height, height], color=color, lw=1.6)
    inside = "white" if pair.at_threshold else color
    axes.plot([ratio], [height], marker, color=color, ms=5.5, markerfacecolor=inside)
    _at_right(axes, height, f"{pair.n_runs}")
    return [low, high]
