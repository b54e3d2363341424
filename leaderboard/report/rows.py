"""A line of a board as the page shows it."""

from __future__ import annotations

from dataclasses import dataclass

from qrlsuite.leaderboard.boards.steps import Row, Section
from qrlsuite.leaderboard.boards.times import TimeRow
from qrlsuite.leaderboard.report.entries import EntryView
from qrlsuite.results.text import steps_text


@dataclass(frozen=True)
class RowView:
    """A line of the leaderboard; `low`, `point` and `high` are the mean's, in percent of the horizon."""

    place: int
    entry: EntryView
    name: str
    """The label, without the algorithm if all entries of the board share it."""
    row: Row
    time: TimeRow
    mean: str
    mean_interval: str
    at_cap: str
    low: float
    point: float
    high: float
    steps: str
    interval: str
    reason: str

    @property
    def kind(self) -> str:
        """`quantum`, `classical`, or `external`: another program trained it, and its kind is unknown."""
        if self.entry.curves.external:
            return "external"
        return "quantum" if self.entry.quantum else "classical"


def row_view(place: int, row: Row, entry: EntryView, name: str, section: Section) -> RowView:
    """Return the line of a place from its row and its entry."""
    reference, horizon, time = row.reference, section.horizon, section.times.rows[place]
    mean, low, high = time.mean.mean, *time.mean.interval
    kind, levels = section.times.kind, section.times.levels
    shares = (f"{kind} {level}: {share:.0%}" for level, share in zip(levels, time.mean.at_cap))
    return RowView(
        place=place,
        entry=entry,
        name=name,
        row=row,
        time=time,
        mean=steps_text(mean, digits=3),
        mean_interval=f"{steps_text(low, digits=3)} to {steps_text(high, digits=3)}",
        at_cap=f"never there: {', '.join(shares)}; {steps_text(round(time.mean.half))} at half the horizon",
        low=100 * low / horizon,
        point=100 * mean / horizon,
        high=100 * high / horizon,
        steps=("≥ " if reference.unsettled else "") + steps_text(reference.steps),
        interval=f"{steps_text(reference.low)} to {steps_text(reference.high)}",
        reason=row.reason,
    )
