"""Pictures for papers and talks, with matplotlib: color-blind safe, no LaTeX, png, pdf or svg.

One file per picture, each with a dataclass of its settings (`BarsOptions` in `bars.py`) and
`draw(entries, **settings) -> matplotlib.figure.Figure`. This module names them without importing matplotlib.
Pictures of an environment (a map, sample trajectories) come with the environment, see
`qrlsuite.specs.EnvironmentSpec`.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.specs import resolve

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Picture:
    """A kind of picture.

    Attributes
    ----------
    summary:
        One line for `qrlsuite plot --help`.
    module:
        The module with its dataclass of settings and its function `draw`.
    data:
        First argument of `draw`: entries, episode values by policy, or scores of trained agents on a circuit backend.
    """

    summary: str
    module: str
    data: Literal["entries", "episodes", "deployed"] = "entries"

    @property
    def options(self) -> str:
        """Reference to the dataclass of its settings."""
        stem = self.module.rpartition(".")[2].title().replace("_", "")
        return f"{self.module}:{stem}Options"


FORMATS = ("png", "pdf", "svg")
_HERE = "qrlsuite.leaderboard.pictures"
KINDS: dict[str, Picture] = {
    "curves": Picture("learning curves: median, 5th to 95th percentile", f"{_HERE}.curves"),
    "surface": Picture("sample complexity over epsilon and delta, a map per entry", f"{_HERE}.surface"),
    "bars": Picture("sample complexity per cell, with percentile whiskers", f"{_HERE}.bars"),
    "costs": Picture("sample complexity in steps, circuit executions and shots", f"{_HERE}.costs"),
    "scaling": Picture("sample complexity against width, qubits, degree, ...", f"{_HERE}.scaling"),
    "tiers": Picture("who outperforms whom by the paper's rule, in tiers", f"{_HERE}.tiers"),
    "histogram": Picture(
        "episode sums against optimal and random (qrlsuite evaluate)", f"{_HERE}.histogram", data="episodes"
    ),
    "deployed": Picture(
        "scores of trained agents with shots or noise (plot --study)", f"{_HERE}.deployed", data="deployed"
    ),
}
"""Pictures by name."""


def draw(kind: str, entries: Sequence[EntryResults] = (), **settings: Any) -> Figure:
    """Draw a picture by name.

    Parameters
    ----------
    kind:
        A key of `KINDS`.
    """
    if kind not in KINDS:
        raise UnknownNameError(f"unknown picture '{kind}'{nearest(kind, KINDS)}")
    figure: Figure = resolve(f"{KINDS[kind].module}:draw")(entries, **settings)
    return figure


def format_of(path: Path | None, option: str = "--out") -> str:
    """Return the format that a file's ending names; png without a file."""
    format_ = "png" if path is None else path.suffix.removeprefix(".").lower()
    if format_ not in FORMATS:
        raise OptionError(f"{option} {path}: the file's ending must be .png, .pdf or .svg")
    return format_


def encode(figure: Figure, format_: str) -> bytes:
    """Return a figure as the bytes of a png, pdf or svg file."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # a box stands for it
        figure.savefig(buffer, format=format_, dpi=160, bbox_inches="tight", pad_inches=0.08)
    return buffer.getvalue()
