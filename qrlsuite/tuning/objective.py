"""The merit of a trial: the steps that it takes to learn, on the tuning seeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from qrlsuite.experiment.task import RankingSection
from qrlsuite.statistics import sample_complexity, unsettled
from qrlsuite.statistics.times import times_below

Objective = Literal["time", "cell", "area"]


@dataclass(frozen=True)
class Merit:
    """A trial's worth; smaller steps are better.

    Attributes
    ----------
    objective:
        Which of the three is minimized.
    time:
        M: environment steps that a run spends short of a threshold up to the horizon, mean over runs and the
        thresholds of the task's ranking grid (`qrlsuite.statistics.times`).
    cell:
        S_hat at the task's reference cell, environment steps.
    area:
        Mean of S_hat over the task's ranking grid, environment steps.
    unsettled:
        Whether the reference cell's S_hat is only a lower bound.
    score:
        Mean validation score over all runs and epochs: settles ties, which are common where runs are too short
        to reach the threshold.
    better:
        1 where more of the score is better, -1 where less is.
    quantum:
        The smallest difference that the objective can show, environment steps.
    """

    objective: Objective
    time: float
    cell: int
    area: float
    unsettled: bool
    score: float
    quantum: float
    better: int = 1

    @property
    def value(self) -> float:
        """The objective, environment steps."""
        return {"time": self.time, "cell": float(self.cell), "area": self.area}[self.objective]

    @property
    def order(self) -> tuple[float, float, float]:
        """Sorts trials from best to worst."""
        second = float(self.cell) if self.objective == "area" else self.area
        return (self.value, second, -self.better * self.score)

    @property
    def signal(self) -> float:
        """The objective for samplers that learn: ties are settled by the score, below the smallest difference."""
        if self.better < 0:  # a regret or a cost, which may be any number
            return self.value + self.quantum * math.atan(self.score) / (2 * math.pi)
        return self.value + self.quantum * (0.5 - min(max(self.score, 0.0), 1.0)) / 2


def merit(
    curves: NDArray[np.float64], ranking: RankingSection, steps_per_epoch: int, objective: Objective
) -> Merit:
    """Return the worth of learning curves (N, T)."""
    at_cell = sample_complexity(curves, ranking.reference_grid, steps_per_epoch)
    everywhere = sample_complexity(curves, ranking.grid, steps_per_epoch)
    times = times_below(curves, ranking.grid, steps_per_epoch)
    parts = {"time": times.size, "cell": 1, "area": everywhere.size}
    return Merit(
        objective=objective,
        time=float(times.mean()),
        cell=int(at_cell[0, 0]),
        area=float(everywhere.mean()),
        unsettled=bool(unsettled(curves, ranking.reference_grid)[0, 0]),
        score=float(curves.mean()),
        quantum=float(steps_per_epoch) / parts[objective],
        better=1 if ranking.goal == "above" else -1,
    )


def cell_text(ranking: RankingSection, objective: Objective) -> str:
    """Return the objective in words."""
    if objective == "time":
        steps = f"M, the mean number of steps {ranking.before} threshold"
        return f"{steps} over the task's {len(ranking.grid.levels)} thresholds"
    if objective == "cell":
        return f"S_hat at {ranking.cell}"
    return f"mean of S_hat over the {ranking.grid.size} cells of the ranking grid"
