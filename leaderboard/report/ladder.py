"""The tier graph: entries one below the other, and an arc from each to the entries that it outperforms.

A list with arcs stays readable from 3 to 30 entries, on a phone and on paper; boxes and arrows do not. Arcs that
follow from a chain of other arcs are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qrlsuite.statistics.ranking import reachable

ROW = 30
"""Height of a line in pixels."""
WIDTH = 150
"""Width of the arcs' drawing in pixels."""


@dataclass(frozen=True)
class Arc:
    """One arc: places on the board, the SVG path of its line and of its arrow head."""

    start: int
    end: int
    circle: bool
    """Both ends stand in one tier: they are part of a circle."""
    line: str
    head: str


@dataclass(frozen=True)
class Ladder:
    """The drawing, and how many arcs a chain of others stands for."""

    width: int
    height: int
    row: int
    arcs: tuple[Arc, ...]
    implied: int
    chains_without_win: int
    """Number of pairs that a chain of arcs joins although the upper does not outperform the lower."""


def draw(beats: NDArray[np.bool_], tiers: Sequence[float]) -> Ladder:
    """Draw the relation.

    Parameters
    ----------
    beats:
        Shape (M, M), whether the row's entry outperforms the column's, in the order of the board.
    tiers:
        The M tiers; 0 where undecided, infinite where no goal was reached.
    """
    kept = reduced(beats, tiers)
    pairs = [(int(i), int(j)) for i, j in np.argwhere(kept)]
    longest = max((abs(j - i) for i, j in pairs), default=1)
    arcs = tuple(_arc(i, j, longest, circle=tiers[i] == tiers[j]) for i, j in pairs)
    missing = reachable(kept) & ~beats & ~np.eye(len(beats), dtype=bool)
    across = np.array([[a != b for b in tiers] for a in tiers], dtype=bool).reshape(missing.shape)
    return Ladder(
        WIDTH,
        ROW * len(tiers),
        ROW,
        arcs,
        int(beats.sum() - kept.sum()),
        int(np.count_nonzero(missing & across)),
    )


def reduced(beats: NDArray[np.bool_], tiers: Sequence[float]) -> NDArray[np.bool_]:
    """Return the relation without the pairs that follow from a chain of other pairs, each a tier further down.

    Pairs inside a tier (a circle) all stay. The chains of the result are the chains of the relation.
    """
    order = np.array(tiers, dtype=np.float64)
    down = beats & (order[:, None] < order[None, :])
    through = down.astype(np.float32) @ reachable(down).astype(np.float32) > 0
    kept: NDArray[np.bool_] = beats & ~(down & through)
    return kept


def _arc(start: int, end: int, longest: int, *, circle: bool) -> Arc:
    y1, y2 = (ROW * (place + 0.5) for place in (start, end))
    reach = 16 + (WIDTH - 30) * (abs(end - start) / max(longest, 4)) ** 0.8
    bend = reach * 4 / 3  # a cubic curve's control points lie a third beyond its outermost point
    line = f"M6 {y1:g}C{bend:.1f} {y1:g} {bend:.1f} {y2:g} 8 {y2:g}"
    head = f"M4 {y2:g}l7 -3.5v7z"
    return Arc(start, end, circle, line, head)
