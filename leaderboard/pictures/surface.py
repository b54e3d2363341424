"""Sample complexity over epsilon and delta, one surface per entry (the paper's figure 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Grid


@dataclass(frozen=True)
class SurfaceOptions:
    """Settings of the surface."""

    style: Annotated[
        Literal["map", "3d"],
        Field(
            description="map: one heat map per entry, with numbers; 3d: all surfaces in one box, as the paper"
        ),
    ] = "map"
    epsilons: Annotated[
        list[float] | None, Field(description="rows; by default of the task's ranking grid")
    ] = None
    deltas: Annotated[
        list[float] | None, Field(description="columns; by default of the task's ranking grid")
    ] = None
    horizon: cells.Horizon = None
    elevation: Annotated[float, Field(description="3d: the viewer's height, degrees")] = 22
    azimuth: Annotated[float, Field(description="3d: the viewer's direction, degrees")] = -128


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw S_hat of every cell, for every entry."""
    chosen: SurfaceOptions = options.build(SurfaceOptions, settings, "picture 'surface'")
    if chosen.style == "map" and (unused := {"elevation", "azimuth"} & settings.keys()):
        raise OptionError(f"picture 'surface': {min(unused)} is for style=3d")
    cells.one_task(entries, "surface")
    horizon = cells.choose_horizon(entries, chosen.horizon)
    grid = cells.choose_grid(entries[0], chosen.epsilons, chosen.deltas)
    measured = [cells.measure(entry, grid, horizon) for entry in entries]
    drawing = _maps if chosen.style == "map" else _box
    title = f"{style.heading(entries)}: sample complexity Ŝ, up to {steps_text(horizon)} steps"
    return drawing(entries, measured, grid, title, horizon, chosen)


def _maps(
    entries: Sequence[EntryResults],
    measured: Sequence[cells.Cells],
    grid: Grid,
    title: str,
    horizon: int,
    chosen: SurfaceOptions,
) -> Figure:
    """Draw heat maps side by side, a number in each cell; hatched where the interval ends at the cap."""
    from matplotlib.patches import Rectangle

    n_levels, n_deltas = grid.shape
    columns = len(entries) if len(entries) <= 3 else 2 if len(entries) == 4 else 3
    rows = -(-len(entries) // columns)
    width, height = 0.3 + 0.29 * n_deltas, 0.55 + 0.24 * n_levels
    figure = Figure(figsize=(1.1 + columns * width, 0.75 + rows * height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize="medium")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in panels[len(entries) :]:
        axes.set_visible(False)
    for axes, entry, name, complexities in zip(panels, entries, style.labels(entries), measured):
        image = axes.imshow(complexities.points, cmap="cividis_r", vmin=0, vmax=horizon, aspect="auto")
        for i, j in np.ndindex(*grid.shape):
            value = float(complexities.points[i, j])
            ink = "white" if value > 0.55 * horizon else "black"
            sign = "≥" if complexities.unsettled[i, j] else ""
            axes.text(j, i, f"{sign}{value / 1000:.3g}", ha="center", va="center", fontsize=6.5, color=ink)
            if complexities.at_cap[i, j]:
                axes.add_patch(
                    Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, hatch="////", ec="#ffffff48", lw=0)
                )
        axes.set_title(
            f"{name}\n{style.facts(entry)}",
            fontsize=8,
            loc="left",
        )
        axes.set_xticks(range(n_deltas), cells.probabilities(grid), fontsize=7)
        axes.set_yticks(range(n_levels), cells.levels(grid), fontsize=7)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
    for axes in panels[max(0, len(entries) - columns) : len(entries)]:
        axes.set_xlabel("δ")
        axes.tick_params(labelbottom=True)
    for row in range(rows):
        panels[row * columns].set_ylabel(cells.level_name(entries[0]))
    bar = figure.colorbar(image, ax=panels[: len(entries)].tolist(), shrink=0.9, pad=0.02, aspect=30)
    bar.ax.yaxis.set_major_formatter(steps_text)
    bar.outline.set_visible(False)
    bar.set_label("environment steps", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    style.footnotes(
        figure,
        "Ŝ in thousands of steps",
        "≥: a lower bound" if any(complexities.unsettled.any() for complexities in measured) else "",
        "hatched: the 95th percentile is at the cap" if any(f.at_cap.any() for f in measured) else "",
        cells.cut_note(entries, horizon),
        style.note(entries),
    )
    return figure


def _box(
    entries: Sequence[EntryResults],
    measured: Sequence[cells.Cells],
    grid: Grid,
    title: str,
    horizon: int,
    chosen: SurfaceOptions,
) -> Figure:
    """Draw all surfaces in one box, as the paper does; every surface has its color and markers."""
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=True)
    levels = np.array(grid.levels)
    deltas = np.array([float(delta) for delta in grid.deltas])
    x, y = np.meshgrid(levels, deltas, indexing="ij")
    handles = []
    for i, (entry, name, complexities) in enumerate(zip(entries, style.labels(entries), measured)):
        look = style.style(i)
        axes.plot_surface(
            x, y, complexities.points, color=look.color, alpha=0.5, edgecolor="white", lw=0.7, shade=False
        )
        axes.plot(
            x.ravel(),
            y.ravel(),
            complexities.points.ravel(),
            look.marker,
            ls="",
            color=look.color,
            ms=3,
            mew=0,
        )
        text = f"{name}: {style.facts(entry)}"
        handles.append(Line2D([], [], color=look.color, marker=look.marker, lw=4, alpha=0.7, label=text))
    axes.set_xlabel(cells.level_name(entries[0]))
    axes.set_ylabel("δ")
    axes.set_zlabel("Ŝ (environment steps)", labelpad=8)
    axes.set_zlim(0, horizon)
    axes.zaxis.set_major_formatter(steps_text)
    axes.set_xticks(levels)
    axes.set_yticks(deltas)
    axes.tick_params(labelsize=8)
    axes.view_init(elev=chosen.elevation, azim=chosen.azimuth)
    axes.set_box_aspect((1, 1, 0.85), zoom=1.1)
    style.legend(figure, title, handles)
    style.footnotes(figure, cells.cut_note(entries, horizon), style.note(entries))
    return figure
