"""Entanglement of circuits' states along the episodes of trained agents, beside their initial parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import style
from qrlsuite.training.entanglement import MEASURES, PARAMETERS, Entanglement

LINES = {"trained": "-", "initial": "--"}
LEVELS = (25, 50, 75)


def draw(measured: Sequence[Entanglement], title: str = "") -> Figure:
    """Draw both measures against the step: medians over agents and episodes, and the middle half as a band.

    Parameters
    ----------
    measured:
        One or more entries, each in a color of its own; initial parameters are dashed.

    Raises
    ------
    OptionError
        If there is no entry.
    """
    if not measured:
        raise OptionError("picture 'entanglement' needs at least one entry")
    figure = Figure(figsize=(9.6, 3.8), layout="constrained")
    for axes, measure in zip(figure.subplots(1, 2), MEASURES):
        for number, each in enumerate(measured):
            color = style.style(number).color
            for which in PARAMETERS:
                values = each.values[measure][which].reshape(-1, len(each.steps))
                shown = ~np.isnan(values).all(axis=0)
                low, middle, high = np.nanpercentile(values[:, shown], LEVELS, axis=0)
                steps = each.steps[shown]
                label = style.plain(f"{each.name}, {which}")
                axes.plot(steps, middle, LINES[which], color=color, lw=1.5, label=label)
                axes.fill_between(steps, low, high, color=color, alpha=0.15, lw=0)
        axes.set(xlabel="step of the episode", title=measure, ylim=(0, None))
        if measure == MEASURES[0]:
            axes.set_ylim(0, 1.02)
            axes.legend(fontsize=7.5, frameon=False)
    if title:
        figure.suptitle(style.plain(title))
    style.footnotes(figure, "median and middle half over agents and episodes", "half-cut entropy in bits")
    return figure
