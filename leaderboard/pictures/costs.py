"""Sample complexity of entries in environment steps, circuit executions and shots, side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.leaderboard.boards.costs import price
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text

Unit = Literal["steps", "executions", "shots"]
AXES: dict[Unit, str] = {"steps": "environment steps", "executions": "circuit executions", "shots": "shots"}


@dataclass(frozen=True)
class CostsOptions:
    """Settings of the picture."""

    units: Annotated[
        list[Unit],
        Field(min_length=1, description="units of sample complexity, a panel each"),
    ] = Field(default_factory=lambda: list(AXES))
    epsilons: Annotated[
        list[float] | None,
        Field(min_length=1, max_length=1, description="one; by default the reference cell's"),
    ] = None
    deltas: Annotated[
        list[float] | None,
        Field(min_length=1, max_length=1, description="one; by default the reference cell's"),
    ] = None
    horizon: cells.Horizon = None


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw S_hat of each entry at one cell, with its 5th to 95th percentile, in each unit on a logarithmic axis.

    An entry's steps are converted by the price of its step, see `qrlsuite.leaderboard.boards.costs.price`. An entry
    without a price (networks execute no circuits, exact values take no shots) has no point there.
    """
    chosen: CostsOptions = options.build(CostsOptions, settings, "picture 'costs'")
    cells.one_task(entries, "costs")
    reference = entries[0].task_file.ranking.reference_grid
    grid = reference
    if chosen.epsilons or chosen.deltas:
        epsilons = chosen.epsilons or (
            None if reference.epsilons is None else list(map(float, reference.levels))
        )
        grid = cells.choose_grid(entries[0], epsilons, chosen.deltas or list(map(float, reference.deltas)))
    horizon = cells.choose_horizon(entries, chosen.horizon)
    measured = [cells.measure(entry, grid, horizon) for entry in entries]
    figure = Figure(figsize=(2.2 + 2.9 * len(chosen.units), 1.6 + 0.36 * len(entries)), layout="constrained")
    panels = figure.subplots(1, len(chosen.units), squeeze=False, sharey=True)[0]
    heights = np.arange(len(entries))[::-1]
    for axes, unit in zip(panels, chosen.units):
        for k, (entry, found) in enumerate(zip(entries, measured)):
            per_step = price(entry, unit).per_step
            if math.isnan(per_step):
                axes.text(
                    0.02, heights[k], "none", transform=axes.get_yaxis_transform(), va="center", fontsize=8
                )
                continue
            look = style.of(entry, k)
            point, (low, high) = found.points[0, 0] * per_step, found.intervals[0, 0] * per_step
            axes.plot([max(low, per_step), high], [heights[k]] * 2, color=look.color, lw=1.6)
            axes.plot(max(point, per_step), heights[k], look.marker, color=look.color, ms=7, mec="white")
            if found.unsettled[0, 0]:
                at = (high, heights[k])
                axes.annotate("≥", at, (6, 0), textcoords="offset points", va="center", fontsize=9)
        axes.set_xscale("log")
        axes.margins(x=0.2)
        axes.set_xlabel(f"Ŝ ({AXES[unit]})")
        axes.xaxis.set_major_formatter(_tick)
        axes.xaxis.set_minor_formatter(_between_decades(*axes.get_xlim()))
        axes.tick_params(axis="x", which="both", labelsize=7.5)
        style.tidy(axes)
    panels[0].set_yticks(
        heights, [f"{name}: {style.seeds_text(e)}" for name, e in zip(style.labels(entries), entries)]
    )
    panels[0].set_ylim(-0.6, len(entries) - 0.4)
    cell = f"{cells.level_name(entries[0])} = {cells.levels(grid)[0]}, δ = {cells.probabilities(grid)[0]}"
    figure.suptitle(
        f"{style.heading(entries)}: sample complexity Ŝ at {cell}", x=0.01, ha="left", fontsize="medium"
    )
    style.footnotes(
        figure,
        "lines: 5th to 95th percentile",
        "≥: a lower bound" if any(found.unsettled.any() for found in measured) else "",
        "executions and shots: of training, gradients and validation",
        cells.cut_note(entries, horizon),
        style.note(entries),
    )
    return figure


def _tick(value: float, position: object) -> str:
    """Return a tick's label: `500k`, `2B` for two billion."""
    return steps_text(value).replace(" billion", "B")


def _between_decades(low: float, high: float) -> Callable[[float, object], str]:
    """Return a formatter of ticks between powers of ten: all on a short axis, 2 and 5 on a longer one, else none."""
    decades = math.log10(high / low)
    labeled = range(2, 10) if decades < 0.4 else (2, 5) if decades < 1.2 else ()

    def text(value: float, position: object) -> str:
        digit = round(value / 10 ** math.floor(math.log10(value) + 1e-9))
        return _tick(value, position) if digit in labeled else ""

    return text
