"""Episode sums of trained policies against the optimal and the random policy (the paper's figure 8)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import style

REFERENCES = {"optimal": ("#E69F00", ""), "random": ("#8C6D46", "xxxx"), "nearest": ("#CC79A7", "....")}
"""Colors and hatches of the policies that are not trained."""


@dataclass(frozen=True)
class HistogramOptions:
    """Settings of the histogram."""

    bins: Annotated[int, Field(ge=2, le=1000, description="bins over the common range")] = 50
    quantity: Annotated[str, Field(description="quantity on the horizontal axis")] = "sum over an episode"
    title: Annotated[str, Field(description="a line above the picture")] = ""
    note: Annotated[str, Field(description="a line below it")] = ""


def draw(episodes: Mapping[str, ArrayLike], **settings: Any) -> Figure:
    """Draw one histogram per policy, one below the other, on a common axis.

    Parameters
    ----------
    episodes:
        For each policy, in the order of the picture, its value of every episode, any shape: (episodes,) or
        (instances, episodes). A name that begins with `optimal`, `random` or `nearest` has a fixed color.
    """
    chosen: HistogramOptions = options.build(HistogramOptions, settings, "picture 'histogram'")
    values = {name: _checked(name, scores) for name, scores in episodes.items()}
    if not values:
        raise OptionError("picture 'histogram' needs at least one policy")
    low = min(float(each.min()) for each in values.values())
    high = max(float(each.max()) for each in values.values())
    if low == high:
        low, high = low - 0.5, high + 0.5
    edges = np.linspace(low, high, chosen.bins + 1)
    figure = Figure(figsize=(6.4, 0.9 + 1.15 * len(values)), layout="constrained")
    panels = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    trained = 0
    for axes, (name, each) in zip(panels, values.items()):
        reference = next((look for word, look in REFERENCES.items() if name.startswith(word)), None)
        if reference is None:
            look = style.style((0, 2, 5, 1, 6)[trained % 5])
            color, hatch, trained = (
                look.color,
                ("////", "\\\\\\\\", "----", "", "++++")[trained % 5],
                trained + 1,
            )
        else:
            color, hatch = reference
        heights, _ = np.histogram(each, edges)
        axes.stairs(
            heights / each.size, edges, fill=True, facecolor=color + "59", edgecolor=color, hatch=hatch, lw=0
        )
        axes.stairs(heights / each.size, edges, color=color, lw=1.4)
        mean = float(each.mean())
        axes.axvline(mean, color="black", lw=1.2, ls="--")
        count = f"{each.shape[0]} x {each.shape[1]}" if each.ndim == 2 else f"{each.size}"
        axes.set_title(
            f"{style.plain(name)}   mean {mean:.4g}   ({count} episodes)", fontsize=9.5, loc="left", pad=3
        )
        axes.set_ylim(bottom=0)
        axes.set_yticks([])
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.grid(axis="x", alpha=0.25)
        axes.set_axisbelow(True)
    panels[-1].set_xlabel(style.plain(chosen.quantity))
    panels[-1].set_xlim(low, high)
    if chosen.title:
        figure.suptitle(style.plain(chosen.title, 200), x=0.01, ha="left", fontsize="medium")
    style.footnotes(figure, "dashed: mean", style.plain(chosen.note, 1000))
    return figure


def _checked(name: str, scores: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(scores, dtype=np.float64)
    if values.size == 0:
        raise OptionError(f"policy '{name}' has no episodes")
    if not np.isfinite(values).all():
        raise OptionError(f"policy '{name}' has a value that is not finite")
    return values
