"""Sample complexity over a grid of cells: the surface of an entry, and the few cells with intervals in sight."""

from __future__ import annotations

from dataclasses import dataclass

from qrlsuite.experiment.task import RankingSection
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Evidence, Grid, at_cap, unsettled

LEVELS = 10
"""Shades of a surface."""
BARS = ((0.2, 0.15, 0.1), (0.5, 0.75))
"""The cells of the paper's bars: epsilons and deltas (its figure 6)."""


@dataclass(frozen=True)
class CellView:
    """A cell of a surface: its text, its shade and its tooltip; `interval` is in percent of the horizon."""

    text: str
    level: int
    capped: bool
    unsettled: bool
    reference: bool
    title: str
    interval: tuple[float, float, float]
    """Low end, S_hat, high end."""


def surface(evidence: Evidence, ranking: RankingSection) -> tuple[tuple[CellView, ...], ...]:
    """Return E lines of D cells: S_hat of an entry at all its runs."""
    grid, horizon = evidence.grid, evidence.entry.horizon
    point, interval = evidence.point, evidence.interval()
    capped = at_cap(interval, horizon)
    open_end = unsettled(evidence.entry.values, grid)
    reference_level = ranking.reference.epsilon if grid.epsilons else ranking.reference.threshold
    lines = []
    for i, value in enumerate(grid.levels):
        cells = []
        for j, delta in enumerate(grid.deltas):
            sign = "≥ " if open_end[i, j] else ""
            low, high = (steps_text(float(v)) for v in interval[i, j])
            mark = ", at cap" if capped[i, j] else ""
            share = float(point[i, j]) / horizon
            cells.append(
                CellView(
                    text=steps_text(float(point[i, j]), digits=3),
                    level=min(LEVELS - 1, int(LEVELS * share)),
                    capped=bool(capped[i, j]),
                    unsettled=bool(open_end[i, j]),
                    reference=value == reference_level and float(delta) == ranking.reference.delta,
                    title=f"{sign}{steps_text(float(point[i, j]))} ({low} to {high}{mark})",
                    interval=(
                        100 * float(interval[i, j, 0]) / horizon,
                        100 * share,
                        100 * float(interval[i, j, 1]) / horizon,
                    ),
                )
            )
        lines.append(tuple(cells))
    return tuple(lines)


def bar_grid(ranking: RankingSection) -> Grid:
    """Return the cells of the bars: the paper's where the task's grid has its epsilons, else like them."""
    levels = ranking.epsilons or ranking.thresholds or []
    if ranking.epsilons and set(BARS[0]) <= set(ranking.epsilons):
        return Grid.relative(BARS[0], BARS[1])
    chosen = sorted(
        {levels[i] for i in (0, len(levels) // 2, -1)},
        reverse=bool(ranking.epsilons) or ranking.goal == "below",
    )
    if ranking.epsilons:
        return Grid.relative(chosen, BARS[1])
    return Grid.absolute(chosen, BARS[1], ranking.goal)


def symbol(grid: Grid) -> str:
    """Return the sign of a grid's thresholds."""
    return "ε" if grid.epsilons else "V*"
