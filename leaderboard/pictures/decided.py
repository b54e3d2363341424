"""Every pair of a decision plan: how much longer B is below the thresholds than A, with interval and verdict."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import style
from qrlsuite.statistics.sequential import Decided, PairDecision
from qrlsuite.studies import decided
from qrlsuite.studies.decided import DecisionOutcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TICKS = (0.1, 0.2, 0.333, 0.5, 0.667, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
"""Ratios of mean times that the axis may name."""
WIDEST = (TICKS[0], TICKS[-1])
GRAY = "#8c8c8c"
LOOKS: dict[Decided | None, tuple[str, str, str]] = {
    Decided.FIRST: ("A needs fewer steps", style.COLORS[0], "o"),
    Decided.SECOND: ("B needs fewer steps", style.COLORS[1], "s"),
    Decided.TRADE_OFF: ("trade-off", style.COLORS[3], "D"),
    Decided.EQUAL: ("equal within the margin", style.COLORS[2], "^"),
    Decided.NOT_TOLD_APART: ("not told apart", GRAY, "v"),
    None: ("open", GRAY, "x"),
}
"""What the legend says, color and marker, by what was decided of a pair."""


def draw(outcome: DecisionOutcome) -> Figure:
    """Draw a row for each pair, below the question that it answers.

    The axis is the mean time below threshold of B over that of A, in logarithms: twice as long is as far to the right
    as half as long is to the left. Lines are repeated confidence intervals. Both are cut at a factor of 10.

    Raises
    ------
    OptionError
        If the plan has taken no look yet.
    """
    study, decision = outcome.study, outcome.decision
    if not any(pair.p for pair in decision.pairs):
        raise OptionError(f"{study.file.name} has taken no look yet: there is nothing to draw")
    groups = decided.by_question(study, decision.pairs)
    rows: list[str | PairDecision] = []
    for question, pairs in groups:
        rows += [question] * bool(question) + list(pairs)
    names = [decided.versus(row) if isinstance(row, PairDecision) else row for row in rows]
    figure = Figure(figsize=(9.5, 1.4 + 0.25 * len(rows)), layout="constrained")
    axes = figure.subplots()
    ends = [1.0]
    for height, row in enumerate(rows):
        if isinstance(row, PairDecision):
            ends += _row(axes, height, row)
    low, high = min(ends) / 1.1, max(ends) * 1.1
    margin = study.file.margin
    axes.axvspan(1 / (1 + margin), 1 + margin, color="#000000", alpha=0.07, lw=0)
    axes.axvline(1, color="#404040", lw=0.8)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator([tick for tick in TICKS if low <= tick <= high]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda ratio, _: decided.percent(ratio - 1)))
    axes.set_xlabel("pair A / B: how much longer B is below the thresholds than A")
    axes.set_ylim(len(rows) - 0.4, -0.7)
    axes.set_yticks(range(len(rows)), [style.plain(name, 90) for name in names], fontsize=8.5)
    for tick, row in zip(axes.get_yticklabels(), rows):
        if not isinstance(row, PairDecision):
            tick.set_fontweight("bold")
    axes.tick_params(axis="y", length=0)
    style.tidy(axes)
    axes.grid(False, axis="y")
    for each, (label, color, marker) in LOOKS.items():
        if any(pair.decided is each for pair in decision.pairs):
            axes.plot([], [], marker, color=color, label=label, ls="none")
    figure.legend(loc="outside upper right", ncols=3, frameon=False, fontsize=8)
    task = next(iter(study.entries.values())).task.name
    figure.suptitle(style.plain(f"{task}: {study.file.name}"), x=0.01, ha="left", fontsize="medium")
    confidence = 100 * (1 - study.file.alpha)
    style.footnotes(
        figure,
        f"repeated confidence intervals: they hold at every look, {confidence:g} percent for all "
        f"{len(decision.pairs)} pairs together",
        f"gray: equal within {100 * margin:g} percent",
        "right: seeds of each entry at the pair's last look",
        "an early stop overstates the difference",
        f"cut at a factor of {WIDEST[1]:g}" if any(map(_cut, decision.pairs)) else "",
    )
    return figure


def _cut(pair: PairDecision) -> bool:
    return bool(pair.p) and not all(WIDEST[0] <= 1 + end <= WIDEST[1] for end in pair.interval)


def _row(axes: Axes, height: int, pair: PairDecision) -> list[float]:
    """Draw a pair and return the ends of what was drawn, as ratios."""
    if not pair.p or math.isnan(pair.difference):
        text = "both mean times are 0" if pair.p else "no look yet"
        axes.annotate(text, (1, height), fontsize=8, va="center")
        return []
    ratio, low, high = (min(max(1 + end, WIDEST[0]), WIDEST[1]) for end in (pair.difference, *pair.interval))
    _, color, marker = LOOKS[pair.decided]
    axes.plot([low, high], [height, height], color=color, lw=1.6)
    axes.plot([ratio], [height], marker, color=color, ms=5.5)
    axes.annotate(
        f"{pair.n_runs}",
        (1.005, height),
        xycoords=("axes fraction", "data"),
        fontsize=8,
        va="center",
        color="#505050",
    )
    return [low, high]
