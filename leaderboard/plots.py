"""Pictures for papers and talks, with matplotlib: color-blind safe, no LaTeX, png, pdf or svg."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from qrlsuite.leaderboard.collect import EntryCurves

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's palette: distinguishable with color-deficient sight."""
STYLES = ("-", "--", "-.", ":")


def curves(entries: Sequence[EntryCurves]) -> Figure:
    """Draw learning curves: the median over runs, their 5th to 95th percentile, and single runs where they are few.

    Parameters
    ----------
    entries:
        Entries of one task.

    Returns
    -------
    Figure
        Validation score against environment steps.
    """
    figure = Figure(figsize=(7.2, 4.3), layout="constrained")
    axes = figure.subplots()
    few = sum(len(entry.seeds) for entry in entries) <= 40  # more lines than that hide each other
    for i, entry in enumerate(entries):
        color, style = COLORS[i % len(COLORS)], STYLES[(i // len(COLORS)) % len(STYLES)]
        epochs = entry.curves.shape[1]
        steps = np.arange(1, epochs + 1) * entry.steps_per_epoch
        low, middle, high = np.percentile(entry.curves, (5, 50, 95), axis=0)
        if few:
            axes.plot(steps, entry.curves.T, color=color, linewidth=0.5, alpha=0.25)
        axes.fill_between(steps, low, high, color=color, alpha=0.15 if few else 0.1, linewidth=0)
        seeds = f"{len(entry.seeds)} seed" + "s" * (len(entry.seeds) != 1)
        axes.plot(steps, middle, color=color, linestyle=style, linewidth=2, label=f"{entry.label}  ({seeds})")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("validation score (received / optimal)" if _relative(entries) else "validation score")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
    axes.set_xlim(left=0)
    if _relative(entries):
        axes.set_ylim(0, 1)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="lower right", frameon=False)
    axes.set_title(
        f"{entries[0].task}: median of the runs, 5th to 95th percentile", fontsize="medium", loc="left"
    )
    return figure


def _relative(entries: Sequence[EntryCurves]) -> bool:
    return all(entry.task_file.score.source == "info" for entry in entries)


KINDS: dict[str, Any] = {"curves": curves}
"""Pictures by name, each a function of a task's entries."""
