"""What all pictures share: colors, line styles, hatches, labels, axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from qrlsuite.leaderboard.collect import EntryCurves

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's palette: distinguishable with color-deficient sight."""
LINES = ("-", "--", "-.", ":")
HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "----", "++++")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


@dataclass(frozen=True)
class Style:
    """How one entry is drawn; color and pattern each tell entries apart without the other."""

    color: str
    line: str
    hatch: str
    marker: str


def style(index: int) -> Style:
    """Return the style of the entry at a place in the legend."""
    turn, place = divmod(index, len(COLORS))
    return Style(
        color=COLORS[place],
        line=LINES[(place + turn) % len(LINES)],
        hatch=HATCHES[(place + turn) % len(HATCHES)],
        marker=MARKERS[(place + turn) % len(MARKERS)],
    )


def seeds_text(entry: EntryCurves) -> str:
    """Write the number of seeds of an entry, with a mark where the protocol asks for more: `50 seeds*`."""
    count = len(entry.seeds)
    return f"{count} seed{'s' * (count != 1)}{'*' * provisional(entry)}"


def provisional(entry: EntryCurves) -> bool:
    """Whether an entry has fewer seeds than its task's protocol asks for."""
    return len(entry.seeds) < entry.task_file.protocol.seeds


def label(entry: EntryCurves) -> str:
    """Return what a legend says of an entry: its label and its seeds."""
    return f"{plain(entry.label)}  ({seeds_text(entry)})"


def plain(text: str) -> str:
    """Return text that matplotlib draws as it is: without mathematics between dollar signs."""
    return text.replace("\\", "\\\\").replace("$", r"\$")


def note(entries: Sequence[EntryCurves]) -> str:
    """Return the sentence that explains the mark of provisional entries; empty where there is none."""
    wanted = sorted({entry.task_file.protocol.seeds for entry in entries if provisional(entry)})
    if not wanted:
        return ""
    return f"* provisional: the protocol asks for {' or '.join(map(str, wanted))} seeds"


def relative(entries: Sequence[EntryCurves]) -> bool:
    """Whether the scores of all entries are fractions of the optimum."""
    return all(entry.task_file.score.source == "info" for entry in entries)


def thousands(value: float, _: object = None) -> str:
    """Write steps as a tick label: 40000 as 40k, 1000000 as 1M."""
    if value == 0:
        return "0"
    return f"{value / 1e6:g}M" if abs(value) >= 1e6 else f"{value / 1e3:g}k"


def tidy(axes: Axes) -> None:
    """Give axes a light grid and no frame above and to the right."""
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
