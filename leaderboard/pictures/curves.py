"""Learning curves: the median over runs, their 5th to 95th percentile, and single runs where they are few."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text

MANY = 5
"""Of more entries the percentiles would hide each other, and the legend the curves."""


@dataclass(frozen=True)
class CurvesOptions:
    """Settings of the learning curves."""

    runs: Annotated[
        bool | None, Field(description="draw single runs; by default where there are at most 40 in all")
    ] = None


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw the validation score of each entry against environment steps."""
    chosen: CurvesOptions = options.build(CurvesOptions, settings, "picture 'curves'")
    cells.one_task(entries, "curves")
    many = len(entries) > MANY
    texts = style.in_legend(entries)
    beside = 0.7 + 0.07 * max(map(len, texts))
    size = (7.2 + beside, max(4.3, 0.6 + 0.19 * len(entries))) if many else (7.2, 4.3 + 0.19 * len(entries))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    few = sum(len(entry.seeds) for entry in entries) <= 40  # more lines than that hide each other
    single = few if chosen.runs is None else chosen.runs
    lines = []
    for i, entry in enumerate(entries):
        look = style.of(entry, i)
        steps = np.arange(1, entry.curves.shape[1] + 1) * entry.steps_per_epoch
        low, middle, high = np.percentile(entry.curves, (5, 50, 95), axis=0)
        if single:
            axes.plot(steps, entry.curves.T, color=look.color, linewidth=0.5, alpha=0.25)
        if not many:
            axes.fill_between(steps, low, high, color=look.color, alpha=0.15 if single else 0.1, linewidth=0)
        (line,) = axes.plot(steps, middle, color=look.color, linestyle=look.line, linewidth=2, label=texts[i])
        lines.append((float(middle.mean()), line))
        if len(steps) == 1:  # a line of one point is nothing to see
            line.set(marker="o", markersize=9)
            axes.errorbar(steps, middle, [middle - low, high - middle], color=look.color, linewidth=2)
    relative = style.relative(entries)
    axes.set_xlabel("environment steps")
    axes.set_ylabel(style.score_name(entries))
    axes.xaxis.set_major_formatter(steps_text)
    axes.set_xlim(left=0)
    if relative:
        axes.set_ylim(0, 1)
    _policies(axes, ranking_of(entries).policies)
    style.tidy(axes)
    title = f"{entries[0].task}: median of the runs{'' if many else ', 5th to 95th percentile'}"
    axes.set_title(title, fontsize="medium", loc="left")
    legend = {"frameon": False, "title": style.note(entries) or None, "title_fontsize": "small"}
    # beside or below the curves, never on them, in the order in which they lie one above the other
    handles = [line for _, line in sorted(lines, key=lambda each: -each[0])]
    if many:
        figure.legend(handles=handles, loc="outside right upper", fontsize=8, alignment="left", **legend)
    else:
        figure.legend(handles=handles, loc="outside lower left", fontsize=8, alignment="left", **legend)
    return figure


def _policies(axes: Axes, scores: Mapping[str, float]) -> None:
    """Draw a line at the score of each other policy, with its name beside the curves."""
    for score in scores.values():
        axes.axhline(score, color="#808080", linewidth=0.8, linestyle=":", zorder=1)
    low, high = axes.get_ylim()
    above = math.inf
    for name, score in sorted(scores.items(), key=lambda each: -each[1]):
        place = above = min((score - low) / (high - low), above - 0.04)  # names do not lie on each other
        axes.text(1.01, place, name, color="#606060", fontsize=8, va="center", transform=axes.transAxes)
