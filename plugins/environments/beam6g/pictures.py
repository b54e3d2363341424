"""Pictures of BeamManagement6G for `qrlsuite plot`: sample trajectories, and the field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.plugins.environments.beam6g import physics, render, trajectory
from qrlsuite.plugins.environments.beam6g.options import BeamOptions

INK = "#202428"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TrajectoryOptions:
    """Settings of the trajectories."""

    degrees: Annotated[
        list[Annotated[int, Field(ge=2, le=32)]] | None,
        Field(description="these degrees side by side, as in the paper, for example [3, 4, 5, 6]"),
    ] = None
    paths: Annotated[int, Field(ge=1, le=1000, description="trajectories for each degree")] = 6
    seed: Annotated[int, Field(ge=0, description="the same seed draws the same trajectories")] = 0


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FieldOptions:
    """Settings of the field."""

    show: Annotated[
        Literal["best", "beam"],
        Field(
            description="best: the best antenna of every place and its intensity; beam: the intensity when every "
            "antenna sends one beam, without its fall with distance, as in the paper"
        ),
    ] = "best"
    beam: Annotated[
        int, Field(ge=0, lt=physics.BEAMS, description="for show=beam: the codebook element of every antenna")
    ] = 3
    resolution: Annotated[int, Field(ge=10, le=2000, description="places along each side")] = 400


def trajectories(worlds: Mapping[str, BeamOptions], options: TrajectoryOptions) -> Figure:
    """Draw random trajectories: one panel per environment, or per degree (the paper's figure of degrees).

    Dots are the support points of one of the paths, which is drawn thicker, and lie at even times, not at
    even distances.
    """
    panels = [
        (name if options.degrees is None else f"{name}, degree {degree}", degree, world)
        for name, world in worlds.items()
        for degree in (options.degrees or [world.degree])
    ]
    if options.degrees is None:
        panels = [(f"{name}, degree {degree}", degree, world) for name, degree, world in panels]
    figure, axes = _panels(len(panels), 2.9)
    for each, (title, degree, world) in zip(axes, panels):
        stream = np.random.default_rng(options.seed)
        support = trajectory.sample([stream], [options.paths], degree, world.rejection)
        x, y = trajectory.positions(support, 400)
        for k in range(options.paths):
            color = render.COLORS[k % len(render.COLORS)]
            each.plot(
                x[k], y[k], color=color, lw=2.4 if k == 0 else 1.1, alpha=1 if k == 0 else 0.75, zorder=3
            )
        each.plot(*support[0].T, "o", ms=6, mfc="white", mec=render.COLORS[0], mew=1.6, zorder=4)
        each.plot(x[0, 0], y[0, 0], ">", ms=8, color=render.COLORS[0], mec="white", zorder=5, clip_on=False)
        _frame(each, title)
        each.grid(alpha=0.25)
    _note(figure, f"{options.paths} random trajectories each; dots: support points of the thick one")
    return figure


def field(worlds: Mapping[str, BeamOptions], options: FieldOptions) -> Figure:
    """Draw the field of one or several environments (the paper's figures of the ground truth and of placements)."""
    if options.show == "best" and len(worlds) == 1:
        return render.ground_truth_figure(next(iter(worlds.values())), options.resolution)
    figure, axes = _panels(len(worlds), 3.1)
    for each, (name, world) in zip(axes, worlds.items()):
        if options.show == "best":
            render.draw_field(each, world, render.ground_truth(world, options.resolution))
        else:
            _beams(each, world, options)
        _frame(each, name)
    _note(
        figure,
        "color: the best antenna; deeper: a higher intensity of its best beam"
        if options.show == "best"
        else f"brighter: a higher intensity (square root) of beam {options.beam} of any antenna, its fall "
        "with distance removed",
    )
    return figure


def _beams(axes: Axes, world: BeamOptions, options: FieldOptions) -> None:
    """Draw the intensity where every antenna sends one beam, and the antennas with the axes of their arrays."""
    places = (np.arange(options.resolution) + 0.5) * (physics.FIELD / options.resolution)
    x, y = np.meshgrid(places, places)
    model = physics.physics(world.physics)
    lines = []
    for antenna in world.antennas:
        u, r2 = physics.offsets(x, y, antenna)
        lobes = model.intensity(u, r2, float(model.phases[options.beam]))
        lines.append(lobes * (r2 * r2 if model.fourth_power else r2))
    axes.imshow(
        np.sqrt(np.clip(np.max(lines, axis=0), 0, 1)),
        origin="lower",
        extent=(0.0, physics.FIELD, 0.0, physics.FIELD),
        cmap="cividis",
        vmin=0,
        vmax=1,
        interpolation="bilinear",
    )
    for i, ((at_x, at_y), (d_x, d_y)) in enumerate(world.antennas):
        bar = np.array([-0.34, 0.34])
        axes.plot(
            at_x + bar * d_x, at_y + bar * d_y, color="white", lw=3, solid_capstyle="round", clip_on=False
        )
        axes.plot(at_x, at_y, "o", ms=13, mfc=INK, mec="white", mew=1.5, clip_on=False)
        axes.text(
            at_x, at_y, str(i), color="white", ha="center", va="center_baseline", weight="bold", fontsize=9
        )


def _panels(count: int, side: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with square panels, at most four in a row."""
    columns = min(count, 4 if count != 6 and count != 9 else 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(side * columns, 0.3 + (side + 0.15) * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spare in axes[count:]:
        spare.set_visible(False)
    return figure, axes[:count]


def _frame(axes: Axes, title: str) -> None:
    axes.set_xlim(0, physics.FIELD)
    axes.set_ylim(0, physics.FIELD)
    axes.set_aspect("equal")
    axes.set_xticks(range(0, int(physics.FIELD) + 1, 2))
    axes.set_yticks(range(0, int(physics.FIELD) + 1, 2))
    axes.tick_params(length=0, labelsize=8, colors="#606468")
    axes.spines[:].set_edgecolor("#a0a4a8")
    axes.set_title(title.replace("$", r"\$"), fontsize=9.5, color=INK, loc="left")


def _note(figure: Figure, text: str) -> None:
    figure.supxlabel(text, x=0.01, ha="left", fontsize=8, color="#505050", wrap=True)
