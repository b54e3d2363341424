"""Who wins where: the best entry of a board, its best circuit, and the network that has about as many parameters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from qrlsuite.leaderboard.boards.times import TimeRanking
from qrlsuite.leaderboard.report.rows import RowView
from qrlsuite.statistics import Direction

CIRCUIT, NETWORK = "quantum", "classical"


@dataclass(frozen=True)
class Winners:
    """Rows of one board; None where it ranks none such.

    Attributes
    ----------
    sized:
        The network whose number of parameters is nearest to the best circuit's, by ratio; of several the best.
    outcomes:
        The board's verdicts on the best network with the best circuit, and on the best circuit with `sized`; empty
        where one is missing.
    """

    best: RowView | None
    network: RowView | None
    circuit: RowView | None
    sized: RowView | None
    outcomes: tuple[Direction, ...]

    @property
    def cells(self) -> tuple[tuple[str, RowView | None], ...]:
        """Heads and rows of the table."""
        return (
            ("Best entry", self.best),
            ("Best circuit", self.circuit),
            ("Network nearest in size", self.sized),
        )

    def asked(self, rows: Sequence[RowView]) -> list[tuple[RowView, RowView]]:
        """Return the pairs to show first, the entry with fewer steps first.

        Up to three ranked entries make all pairs. More entries: the best circuit with the best network and with the
        network of its size, or the first and the last if there is only one kind. Where none is ranked, all count.
        """
        ranked = _ranked(rows) or list(rows)
        if len(ranked) <= 3:
            return list(itertools.combinations(ranked, 2))
        if self.circuit is None or self.network is None or self.sized is None:
            return [(ranked[0], ranked[-1])]
        return [
            (rows[min(pair)], rows[max(pair)])
            for pair in dict.fromkeys(
                (self.circuit.place, other.place) for other in (self.network, self.sized)
            )
        ]


def winners(rows: Sequence[RowView], ranking: TimeRanking) -> Winners:
    """Return who wins on a board; `rows` are in its order. Controls without entanglement are no circuits here."""
    ranked = _ranked(rows)
    networks = [row for row in ranked if row.kind == NETWORK]
    circuits = [row for row in ranked if row.kind == CIRCUIT and not row.entry.curves.control]
    circuit, sized = next(iter(circuits), None), None
    if circuit is not None:
        sized = min(networks, key=lambda row: _apart(row, circuit), default=None)
    pairs = [] if circuit is None or sized is None else [(networks[0], circuit), (circuit, sized)]
    return Winners(
        next(iter(ranked), None),
        next(iter(networks), None),
        circuit,
        sized,
        tuple(
            ranking.board.directions[ranking.order[one.place]][ranking.order[other.place]]
            for one, other in pairs
        ),
    )


def outcome(boards: Iterable[Winners]) -> list[str]:
    """Count the boards that each side wins, in two sentences; none where fewer than two have circuits and networks."""
    both = ("The best network", "the best circuit"), ("The best circuit", "the network nearest in size")
    decided = [board.outcomes for board in boards if board.outcomes]
    verdicts = zip(*decided) if len(decided) > 1 else ()
    return [_counted(*names, directions) for names, directions in zip(both, verdicts)]


def _counted(one: str, other: str, directions: Sequence[Direction]) -> str:
    fewer, more = (directions.count(each) for each in (Direction.FEWER, Direction.MORE))
    text = f"{one} needs fewer steps than {other} on {fewer} of {len(directions)} boards"
    text += f", more on {more}" * (more > 0)
    rest = len(directions) - fewer - more
    return f"{text}, and {rest} {'has' if rest == 1 else 'have'} no winner." if rest else f"{text}."


def _ranked(rows: Sequence[RowView]) -> list[RowView]:
    return [row for row in rows if row.time.ranks is not None]


def _apart(row: RowView, other: RowView) -> float:
    """Return how far two numbers of parameters are apart, as a ratio's logarithm."""
    one, two = (max(1, sum(each.entry.curves.parameters)) for each in (row, other))
    return abs(math.log(one / two))
