"""Options shared by pictures of sample complexity: cells, horizon and certainty."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.boards.ranked import learning_curves
from qrlsuite.leaderboard.pictures import style
from qrlsuite.leaderboard.shelf.curves import EntryResults, edited_between
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Evidence, Grid, at_cap, unsettled
from qrlsuite.statistics.grid import BoolArray, FloatArray

Horizon = Annotated[
    int | None,
    Field(ge=1, description="environment steps at which sample complexity is capped; by default the task's"),
]


@dataclass(frozen=True, eq=False)
class Cells:
    """S_hat of one entry on E x D cells.

    Attributes
    ----------
    points:
        Shape (E, D), environment steps.
    intervals:
        Shape (E, D, 2), the 5th and 95th percentile.
    at_cap, unsettled:
        Shape (E, D), the two marks.
    """

    points: FloatArray
    intervals: FloatArray
    at_cap: BoolArray
    unsettled: BoolArray


def measure(entry: EntryResults, grid: Grid, horizon: int) -> Cells:
    """Return an entry's sample complexity, with its interval and marks, at all its seeds."""
    curves = learning_curves(entry).cut(horizon)
    evidence = Evidence(curves, grid, curves.n_runs)
    intervals = evidence.interval()
    marks = unsettled(curves.values, grid)
    return Cells(evidence.point, intervals, at_cap(intervals, horizon), marks)


def one_task(entries: Sequence[EntryResults], kind: str) -> None:
    """Raise OptionError unless there are entries, all of one task and of one code of its environment."""
    if not entries:
        raise OptionError(f"picture '{kind}' needs at least one entry")
    for entry in entries[1:]:
        if entry.task_hash != entries[0].task_hash:
            first = entries[0]
            raise OptionError(
                f"picture '{kind}' shows one task: '{first.label}' was run on {first.task} ({first.task_hash}) "
                f"and '{entry.label}' on {entry.task} ({entry.task_hash})"
            )
    for first, entry in itertools.combinations(entries, 2):
        if edited := edited_between(first, entry):
            raise OptionError(f"{edited}, or name the entries to draw")


def choose_grid(
    entry: EntryResults,
    epsilons: Sequence[float] | None,
    deltas: Sequence[float] | None,
    thresholds: Sequence[float] | None = None,
) -> Grid:
    """Return the requested cells, by default the cells of the task's ranking grid."""
    ranking = entry.task_file.ranking
    chosen_deltas = deltas if deltas is not None else ranking.deltas
    if epsilons is not None and thresholds is not None:
        raise OptionError("give epsilons or thresholds, not both")
    if thresholds is not None:
        return Grid.absolute(thresholds, chosen_deltas, ranking.goal)
    if epsilons is not None:
        if ranking.epsilons is None:
            raise OptionError(
                f"task '{entry.task}' has no known maximum: give thresholds instead of epsilons"
            )
        return Grid.relative(epsilons, chosen_deltas)
    own = ranking.grid
    if deltas is None:
        return own
    if ranking.epsilons is not None:
        return Grid.relative(ranking.epsilons, deltas)
    return Grid.absolute(own.thresholds, deltas, ranking.goal)


def choose_horizon(entries: Sequence[EntryResults], requested: int | None = None) -> int:
    """Return the steps to which all entries are cut: the task's longest horizon that all of them reach.

    Where one is shorter than all of the task's horizons, its length.
    """
    lengths = {entry.label: int(entry.curves.shape[1]) * entry.steps_per_epoch for entry in entries}
    shortest = min(lengths.values())
    if requested is not None:
        if requested > shortest:
            label = next(label for label, length in lengths.items() if length == shortest)
            raise OptionError(f"horizon = {requested}: '{label}' ends at {shortest} steps")
        return requested
    reached = [steps for steps in entries[0].task_file.ranking.horizons if steps <= shortest]
    return max(reached, default=shortest)


def level_name(entry: EntryResults) -> str:
    """Return the row title for the grid of an entry's task."""
    name = entry.task_file.ranking.level_name
    return "ε" if name == "epsilon" else style.plain(name)


def levels(grid: Grid) -> list[str]:
    """Return the titles of a grid's rows: epsilons, or thresholds on the return or a metric."""
    return [f"{value:g}" for value in (grid.levels)]


def probabilities(grid: Grid) -> list[str]:
    """Return the titles of a grid's columns."""
    return [f"{float(value):g}" for value in grid.deltas]


def cut_note(entries: Sequence[EntryResults], horizon: int) -> str:
    """Say that the picture ends before the task's horizon, where it does."""
    if horizon in entries[0].task_file.ranking.horizons:
        return ""
    lengths = {entry.label: int(entry.curves.shape[1]) * entry.steps_per_epoch for entry in entries}
    short = min(lengths, key=lambda label: lengths[label])
    why = f", the length of {style.plain(short)}" if len(set(lengths.values())) > 1 else ""
    return f"all cut to {steps_text(horizon)} steps{why}"
