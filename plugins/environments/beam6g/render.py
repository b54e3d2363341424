"""Pictures of BeamManagement6G: a moment as image, text or window, and the map of the best antenna.

The background is the ground truth: each place has the color of its best antenna, the stronger the higher
that antenna's intensity (on a logarithmic scale, because it falls with a power of the distance). Two shaded
colors can look alike to the color-blind, so the map of the best antenna names its larger regions, too.
Matplotlib's global state is not touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from qrlsuite.plugins.environments.beam6g import physics
from qrlsuite.plugins.environments.beam6g.options import BeamOptions
from qrlsuite.plugins.environments.beam6g.physics import FIELD, Antenna, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e0cc00", "#000000", "#56b4e9", "#e69f00")
"""Colors of the antennas, in their order: Okabe and Ito's for the color-blind, with a darker yellow."""
_DARK = ("#0072b2", "#d55e00", "#009e73", "#000000")
"""Colors on which white text can be read."""
_INK = "#202428"
_FAINT, _STRONG = 10**-4.5, 10**-0.5
"""Intensities drawn in the palest and in the fullest color."""


@dataclass(frozen=True, eq=False)
class Moment:
    """A moment of an episode, as a picture shows it.

    Attributes
    ----------
    path:
        The user's positions at steps 0..K, (K + 1, 2).
    received:
        Sum of the intensities received so far.
    """

    path: FloatArray
    step: int
    antenna: int
    beam: int
    intensity: float
    best: int
    received: float


class GroundTruth(NamedTuple):
    """The best antenna and beam at every place of a grid over the field.

    All (resolution, resolution), rows from y = 0 up, columns from x = 0 right, at the centers of the cells.
    """

    antenna: NDArray[np.intp]
    """Index of the best antenna, the first of equals."""
    beam: NDArray[np.int8]
    """Index of that antenna's best beam in the codebook, the first of equals."""
    intensity: FloatArray
    """The intensity of both, in [0, 1], which an agent would receive if it knew the user's position."""


def ground_truth(options: BeamOptions, resolution: int = 300) -> GroundTruth:
    """Return the best antenna, its best beam and their intensity on a grid of `resolution` x `resolution` places."""
    places = (np.arange(resolution) + 0.5) * (FIELD / resolution)
    x, y = np.meshgrid(places, places)
    model = physics.physics(options.physics)
    per_antenna = [physics.best_intensity(model, x, y, antenna) for antenna in options.antennas]
    intensities, beams = (np.stack(part) for part in zip(*per_antenna))
    antenna = intensities.argmax(axis=0)
    at_best = antenna[None]
    return GroundTruth(
        antenna,
        np.take_along_axis(beams, at_best, 0)[0],
        np.take_along_axis(intensities, at_best, 0)[0],
    )


def ground_truth_figure(options: BeamOptions, resolution: int = 500) -> Figure:
    """Draw the map of the best antenna, as the paper's figure of the ground truth does (appendix on the environment).

    Each place has the color of its best antenna, deeper where the intensity of that antenna's best beam is higher:
    the bands along which it is low lie between beams. A region of more than two percent of the field carries its
    antenna's number. Antennas are disks with their number and a bar along the axis of their array.

    Parameters
    ----------
    options:
        Options of the environment, of which antennas and physics matter here.
    resolution:
        Places along each side at which the best antenna is sought.

    Returns
    -------
    matplotlib.figure.Figure
        Its axes are the field in units of the model, and the scale of the intensity.
    """
    figure, axes = _figure(5.6, below=0.55)
    truth = ground_truth(options, resolution)
    draw_field(axes, options, truth)
    cell = FIELD / resolution
    for x, y, antenna in _regions(truth.antenna, cell, 0.02):
        if min(np.hypot(x - position[0], y - position[1]) for position, _ in options.antennas) > 0.45:
            axes.text(x, y, str(antenna), color=_INK, ha="center", va="center_baseline", fontsize=9, zorder=5)
    axes.set_title("Best antenna, and the intensity of its best beam", fontsize=11, color=_INK, loc="left")
    scale = figure.add_axes((0.06, 0.058, 0.4, 0.02))
    levels = np.geomspace(1e-5, 1.0, 256)
    scale.imshow(_shaded(np.zeros(3), levels)[None], extent=(-5.0, 0.0, 0.0, 1.0), aspect="auto")
    scale.set_xticks(range(-5, 1), [f"$10^{{{power}}}$" for power in range(-5, 0)] + ["1"])
    scale.set_yticks([])
    _quiet(scale)
    scale.text(0.35, 0.4, "intensity, in the color of the antenna", fontsize=8, color=_INK, va="center")
    return figure


class FrameRenderer:
    """Draws moments of episodes in one field; the background is drawn once."""

    def __init__(self, options: BeamOptions) -> None:
        self.options = options
        self.figure, self.axes = _figure(6.0)
        draw_field(self.axes, options, ground_truth(options, 240))
        self._title = self.axes.set_title("", fontsize=10, color=_INK, loc="left", family="monospace")
        (self._ahead,) = self.axes.plot([], [], color="white", lw=2.2, ls=(0, (1.2, 1.2)), zorder=4)
        (self._behind,) = self.axes.plot([], [], color=_INK, lw=2.2, zorder=4, solid_capstyle="round")
        (self._link,) = self.axes.plot([], [], color=_INK, lw=1.0, ls=(0, (4, 3)), zorder=5)
        (self._lobe,) = self.axes.fill([0], [0], fc="white", ec=_INK, alpha=0.55, lw=1.2, zorder=3)
        (self._user,) = self.axes.plot([], [], "o", ms=11, mfc="#ffd500", mec=_INK, mew=1.6, zorder=8)

    def draw(self, moment: Moment) -> NDArray[np.uint8]:
        """Return a moment as an image (height, width, 3) uint8."""
        path, step = moment.path, moment.step
        antenna = self.options.antennas[moment.antenna]
        phase = float(physics.physics(self.options.physics).phases[moment.beam])
        self._ahead.set_data(path[step:, 0], path[step:, 1])
        self._behind.set_data(path[: step + 1, 0], path[: step + 1, 1])
        self._user.set_data([path[step, 0]], [path[step, 1]])
        self._link.set_data([antenna[0][0], path[step, 0]], [antenna[0][1], path[step, 1]])
        self._lobe.set_xy(_lobes(antenna, phase))
        self._title.set_text(
            f"step {step:>3}/{len(path) - 1}   antenna {moment.antenna} (best {moment.best})   "
            f"beam {moment.beam}   I {moment.intensity:.4f}   sum {moment.received:.3f}"
        )
        canvas: Any = self.figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def as_text(options: BeamOptions, moment: Moment, columns: int = 49, rows: int = 17) -> str:
    """Return a moment as text: a line of numbers and the field.

    Antennas are digits, `*` the path walked, `.` the path to walk, `@` the user.
    """
    field = [[" "] * columns for _ in range(rows)]

    def put(x: float, y: float, mark: str) -> None:
        column = min(max(round(x / FIELD * (columns - 1)), 0), columns - 1)
        row = min(max(round((1.0 - y / FIELD) * (rows - 1)), 0), rows - 1)
        field[row][column] = mark

    for k in range(len(moment.path) - 1, -1, -1):
        put(float(moment.path[k, 0]), float(moment.path[k, 1]), "*" if k <= moment.step else ".")
    for i, (position, _) in enumerate(options.antennas):
        put(position[0], position[1], str(i % 10))
    put(float(moment.path[moment.step, 0]), float(moment.path[moment.step, 1]), "@")
    edge = "+" + "-" * columns + "+"
    lines = [
        f"step {moment.step}/{len(moment.path) - 1}  antenna {moment.antenna} (best {moment.best})  "
        f"beam {moment.beam}  intensity {moment.intensity:.4f}  sum {moment.received:.3f}",
        edge,
        *("|" + "".join(row) + "|" for row in field),
        edge,
    ]
    return "\n".join(lines) + "\n"


class Window:
    """A pygame window that shows images.

    Parameters
    ----------
    fps:
        Images per second at most.
    """

    def __init__(self, fps: int) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(
                'render_mode="human" needs pygame: pip install pygame (or use render_mode="rgb_array")'
            ) from error
        self._pygame: Any = pygame
        self._fps = fps
        pygame.display.init()
        self._clock: Any = pygame.time.Clock()
        self._screen: Any = None

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show an image (height, width, 3)."""
        if self._screen is None:
            self._screen = self._pygame.display.set_mode(image.shape[1::-1])
            self._pygame.display.set_caption("BeamManagement6G")
        self._pygame.surfarray.blit_array(self._screen, image.transpose(1, 0, 2))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()


def _figure(size: float, below: float = 0.0) -> tuple[Figure, Axes]:
    """Return a figure `size` inches wide with axes for the field, and `below` inches of room under them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height = size + 0.3 + below
    figure = Figure(figsize=(size, height), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    bottom = (0.06 * (size + 0.3) + below) / height
    axes = figure.add_axes((0.06, bottom, 0.91, 0.91 * size / height))
    return figure, axes


def _regions(antenna: NDArray[np.intp], cell: float, least: float) -> list[tuple[float, float, int]]:
    """Return place (x, y) and antenna of every connected region above a share `least` of the field.

    The place is the one farthest from the region's border, so that a label has room there.
    """
    from scipy import ndimage

    regions = []
    for i in np.unique(antenna).tolist():
        labels, count = ndimage.label(antenna == i)
        for region in range(1, count + 1):
            inside = labels == region
            if inside.mean() > least:
                room = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
                row, column = np.unravel_index(int(room.argmax()), room.shape)
                regions.append(((float(column) + 0.5) * cell, (float(row) + 0.5) * cell, i))
    return regions


def _shaded(color: NDArray[np.float64], intensity: FloatArray) -> FloatArray:
    """Return colors (..., 3) that are the deeper the higher `intensity` (...) is."""
    strength = np.log(intensity / _FAINT) / np.log(_STRONG / _FAINT)
    share = (0.08 + 0.80 * np.clip(strength, 0.0, 1.0))[..., None]
    shaded: FloatArray = 1.0 - share * (1.0 - color)
    return shaded


def draw_field(axes: Axes, options: BeamOptions, truth: GroundTruth) -> None:
    """Draw the ground truth and the antennas, each with the axis of its array as a bar."""
    from matplotlib.colors import to_rgb

    palette = np.array([to_rgb(COLORS[i % len(COLORS)]) for i in range(len(options.antennas))])
    axes.imshow(
        _shaded(palette[truth.antenna], truth.intensity),
        origin="lower",
        extent=(0.0, FIELD, 0.0, FIELD),
        interpolation="bilinear",
        zorder=0,
    )
    for i, ((x, y), (d_x, d_y)) in enumerate(options.antennas):
        bar = np.array([-0.34, 0.34])
        color = COLORS[i % len(COLORS)]
        for width, ink in ((6.5, "white"), (3.5, _INK)):
            axes.plot(
                x + bar * d_x,
                y + bar * d_y,
                color=ink,
                lw=width,
                zorder=6,
                solid_capstyle="round",
                clip_on=False,
            )
        axes.plot(x, y, "o", ms=15, mfc=color, mec="white", mew=1.8, zorder=7, clip_on=False)
        ink = "white" if color in _DARK else _INK
        axes.text(x, y, str(i), color=ink, ha="center", va="center_baseline", weight="bold", zorder=9)
    axes.set_xlim(0.0, FIELD)
    axes.set_ylim(0.0, FIELD)
    axes.set_xticks(range(int(FIELD) + 1))
    axes.set_yticks(range(int(FIELD) + 1))
    _quiet(axes)


def _quiet(axes: Axes) -> None:
    """Draw ticks and frame in gray."""
    axes.tick_params(length=0, labelsize=8, colors="#606468")
    for spine in axes.spines.values():
        spine.set_edgecolor("#a0a4a8")


def _lobes(antenna: Antenna, phase: float, reach: float = 2.6) -> FloatArray:
    """Return the outline (721, 2) of a beam's pattern; the radius is proportional to the field strength."""
    (x, y), (d_x, d_y) = antenna
    angle = np.linspace(-np.pi, np.pi, 721)
    ones = np.ones_like(angle)
    radius = reach * np.sqrt(physics.physics("text").intensity(np.pi * np.cos(angle), ones, phase))
    along, across = radius * np.cos(angle), radius * np.sin(angle)
    return np.stack([x + along * d_x - across * d_y, y + along * d_y + across * d_x], axis=1)
