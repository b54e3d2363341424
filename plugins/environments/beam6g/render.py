"""Pictures of BeamManagement6G: a moment as image, text or window, and the map of the best antenna.

The background is the ground truth: each place has the color of its best antenna, the stronger the higher
that antenna's intensity (on a logarithmic scale, because it falls with a power of the distance).
Matplotlib's global state is not touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from qrlsuite.plugins.environments.beam6g import physics
from qrlsuite.plugins.environments.beam6g.options import Options
from qrlsuite.plugins.environments.beam6g.physics import FIELD, Antenna, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7f4fa0", "#4d4d4d")
"""Colors of the antennas, in their order; the first are safe for the color-blind (Okabe and Ito)."""
_INK = "#202428"
_FAINT, _STRONG = 10**-4.5, 10**-0.5
"""Intensities drawn in the palest and in the fullest color."""


@dataclass(frozen=True, eq=False)
class Moment:
    """What a picture shows of an episode.

    Attributes
    ----------
    path:
        The user's positions at steps 0..K, (K + 1, 2).
    step:
        The step that the user is at.
    antenna, beam, intensity:
        Which antenna serves, with which beam, at what intensity.
    best:
        The antenna that would be best.
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


def ground_truth(options: Options, resolution: int = 300) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the best antenna's index and its intensity on a grid over the field.

    Both (resolution, resolution), rows from y = 0 up, columns from x = 0 right, at the centers of the cells.
    """
    places = (np.arange(resolution) + 0.5) * (FIELD / resolution)
    x, y = np.meshgrid(places, places)
    model = physics.physics(options.physics)
    intensities = np.stack([physics.best_intensity(model, x, y, antenna)[0] for antenna in options.antennas])
    return intensities.argmax(axis=0), intensities.max(axis=0)


def ground_truth_figure(options: Options, resolution: int = 400) -> Figure:
    """Draw the map of the best antenna, as in the paper's figure of the ground truth."""
    figure, axes = _figure(5.6)
    _draw_field(axes, options, resolution)
    axes.set_title("Best antenna, and the intensity it gives", fontsize=11, color=_INK, loc="left")
    return figure


class Picture:
    """Draws moments of episodes in one field; the background is drawn once.

    Parameters
    ----------
    options:
        Options of the environment.
    """

    def __init__(self, options: Options) -> None:
        self.options = options
        self.figure, self.axes = _figure(6.0)
        _draw_field(self.axes, options, 240)
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


def as_text(options: Options, moment: Moment, columns: int = 49, rows: int = 17) -> str:
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

    Raises
    ------
    gymnasium.error.DependencyNotInstalled
        If pygame is not installed.
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


def _figure(size: float) -> tuple[Figure, Axes]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size, size + 0.3), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.06, 0.06, 0.91, 0.91 * size / (size + 0.3)))
    return figure, axes


def _draw_field(axes: Axes, options: Options, resolution: int) -> None:
    """Draw the ground truth and the antennas, each with the axis of its array as a bar."""
    from matplotlib.colors import to_rgb

    antenna, intensity = ground_truth(options, resolution)
    palette = np.array([to_rgb(COLORS[i % len(COLORS)]) for i in range(len(options.antennas))])
    strength = np.log(intensity / _FAINT) / np.log(_STRONG / _FAINT)
    share = (0.08 + 0.80 * np.clip(strength, 0.0, 1.0))[:, :, None]
    axes.imshow(
        1.0 - share * (1.0 - palette[antenna]),
        origin="lower",
        extent=(0.0, FIELD, 0.0, FIELD),
        interpolation="bilinear",
        zorder=0,
    )
    for i, ((x, y), (d_x, d_y)) in enumerate(options.antennas):
        bar = np.array([-0.34, 0.34])
        axes.plot(x + bar * d_x, y + bar * d_y, color="white", lw=6.5, zorder=6, solid_capstyle="round")
        axes.plot(x + bar * d_x, y + bar * d_y, color=_INK, lw=3.5, zorder=6, solid_capstyle="round")
        axes.plot(x, y, "o", ms=15, mfc=COLORS[i % len(COLORS)], mec="white", mew=1.8, zorder=7)
        axes.text(x, y, str(i), color="white", ha="center", va="center_baseline", weight="bold", zorder=9)
    axes.set_xlim(0.0, FIELD)
    axes.set_ylim(0.0, FIELD)
    axes.set_xticks(range(int(FIELD) + 1))
    axes.set_yticks(range(int(FIELD) + 1))
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
