"""The estimator's smoothed step: how likely P_hat falls below delta, against the true P.

With N runs, N P_hat is binomial, so P(P_hat < delta) is exact: the probability of fewer than ceil(delta N)
successes. The central-limit curve is Phi((delta - P) sqrt(N) / sqrt(P (1 - P))) (paper, appendix "Sample
complexity estimator", theorem on the bias and the figure after it).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.leaderboard.pictures import style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.statistics import Grid


@dataclass(frozen=True)
class EstimatorOptions:
    """Settings of the estimator's step."""

    runs: Annotated[int, Field(ge=1, le=100_000, description="number of runs N")] = 100
    deltas: Annotated[
        list[Annotated[float, Field(gt=0, le=1)]], Field(min_length=1, description="one curve for each delta")
    ] = Field(default_factory=lambda: [0.3, 0.5, 0.75, 0.9])


def draw(entries: Sequence[EntryResults] = (), **settings: Any) -> Figure:
    """Draw P(P_hat < delta) against P; no entries are needed, and any are ignored."""
    from scipy.stats import binom, norm

    chosen: EstimatorOptions = options.build(EstimatorOptions, settings, "picture 'estimator'")
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    truth = np.linspace(0, 1, 1001)
    inner = truth[1:-1]
    grid = Grid.absolute([0], chosen.deltas)
    for i, (delta, needed) in enumerate(zip(grid.deltas, grid.required_counts(chosen.runs))):
        look = style.style(i)
        exact = binom.cdf(needed - 1, chosen.runs, truth)
        limit = norm.cdf((float(delta) - inner) * np.sqrt(chosen.runs) / np.sqrt(inner * (1 - inner)))
        axes.vlines(float(delta), 0, 1, color=look.color, lw=0.8, alpha=0.5)
        axes.plot(truth, exact, color=look.color, lw=2.2, label=f"δ = {float(delta):g}")
        axes.plot(inner, limit, color="black", lw=1.1, ls="--", label="central limit" if i == 0 else None)
        axes.plot(float(delta), 0.5, look.marker, color=look.color, mec="white", ms=8, zorder=4)
    handles, names = axes.get_legend_handles_labels()
    last = names.index("central limit")
    axes.legend(
        [*handles[:last], *handles[last + 1 :], handles[last]],
        [*names[:last], *names[last + 1 :], names[last]],
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(1, 1),
    )
    axes.set_xlabel("P, the probability that a run reaches the threshold")
    axes.set_ylabel("probability that  P̂ < δ")
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.02, 1.02)
    style.tidy(axes)
    axes.set_title(
        f"How likely an epoch counts towards Ŝ, with N = {chosen.runs} runs", fontsize="medium", loc="left"
    )
    return figure
