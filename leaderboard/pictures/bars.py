"""Sample complexity as bars with percentile whiskers, cell by cell (the paper's figure 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text

WIDEST = 12.0
"""Inches; on a page, the text of a wider picture would be too small."""


@dataclass(frozen=True)
class BarsOptions:
    """Settings of the bars."""

    epsilons: Annotated[
        list[float] | None,
        Field(
            description="by default .2, .15, .1; on a task without a maximum the ranking grid's thresholds"
        ),
    ] = None
    deltas: Annotated[list[float], Field(min_length=1, description="the threshold probabilities")] = Field(
        default_factory=lambda: [0.5, 0.75]
    )
    horizon: cells.Horizon = None


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw a bar per entry and cell, from the 5th to the 95th percentile a whisker.

    A bar whose upper percentile is the horizon is faded, as in the paper: some runs did not get there.
    """
    chosen: BarsOptions = options.build(BarsOptions, settings, "picture 'bars'")
    cells.one_task(entries, "bars")
    relative = entries[0].task_file.ranking.epsilons is not None
    epsilons = chosen.epsilons or ([0.2, 0.15, 0.1] if relative else None)
    grid = cells.choose_grid(entries[0], epsilons, chosen.deltas)
    horizon = cells.choose_horizon(entries, chosen.horizon)
    measured = [cells.measure(entry, grid, horizon) for entry in entries]
    n_levels, n_deltas = grid.shape
    width = 0.84 / len(entries)
    wide = 1.2 + n_levels * n_deltas * (0.35 + 0.2 * len(entries))
    figure = Figure(figsize=(min(max(6.0, wide), WIDEST), 4.0), layout="constrained")
    axes = figure.subplots()
    centers = np.arange(n_levels)[:, None] + np.arange(n_deltas)[None, :] * (n_levels + 0.35)
    handles: list[Patch] = []
    for k, (name, entry, complexities) in enumerate(zip(style.labels(entries), entries, measured)):
        look = style.of(entry, k)
        places = centers + (k - (len(entries) - 1) / 2) * width
        text = f"{name}: {style.facts(entry)}"
        handles.append(Patch(facecolor=look.color, edgecolor="white", hatch=look.hatch, lw=0, label=text))
        for i, j in np.ndindex(*grid.shape):
            alpha = 0.3 if complexities.at_cap[i, j] else 1.0
            axes.bar(
                places[i, j],
                complexities.points[i, j],
                width * 0.94,
                color=look.color,
                hatch=look.hatch,
                edgecolor="white",
                lw=0,
                alpha=alpha,
            )
            low, high = complexities.intervals[i, j]
            axes.plot([places[i, j]] * 2, [low, high], color="black", lw=1, alpha=max(alpha, 0.55))
            for end in (low, high):
                axes.plot(
                    places[i, j] + np.array([-0.2, 0.2]) * width,
                    [end, end],
                    color="black",
                    lw=1,
                    alpha=max(alpha, 0.55),
                )
            if complexities.unsettled[i, j]:
                axes.text(float(places[i, j]), high + 0.012 * horizon, "≥", ha="center", fontsize=9, zorder=5)
    axes.axhline(horizon, color="#505050", lw=0.9, ls=":")
    axes.set_xticks(
        centers.T.ravel(), [f"{cells.level_name(entries[0])} = {v}" for v in cells.levels(grid)] * n_deltas
    )
    axes.tick_params(axis="x", length=0)
    for j, delta in enumerate(cells.probabilities(grid)):
        axes.text(
            float(centers[:, j].mean()),
            -0.11,
            f"δ = {delta}",
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="top",
            fontsize="medium",
        )
    axes.set_ylabel("Ŝ (environment steps)")
    axes.set_ylim(0, horizon * 1.06)
    axes.set_xlim(float(centers.min()) - 0.6, float(centers.max()) + 0.6)
    axes.yaxis.set_major_formatter(steps_text)
    style.tidy(axes)
    axes.grid(axis="x", visible=False)
    title = f"{style.heading(entries)}: sample complexity Ŝ, whiskers 5th to 95th percentile"
    style.legend(figure, title, handles)
    faded = any(complexities.at_cap.any() for complexities in measured)
    bounded = any(complexities.unsettled.any() for complexities in measured)
    style.footnotes(
        figure,
        "faded: the 95th percentile is at the cap" if faded else "",
        "≥: a lower bound" if bounded else "",
        cells.cut_note(entries, horizon),
        style.note(entries),
    )
    return figure
