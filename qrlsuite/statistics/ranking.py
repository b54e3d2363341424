"""From pairwise outperformance to tiers.

Outperformance is not transitive, and can be cyclic: three entries can each beat the next at another cell.
So entries that outperform each other in a circle (a strongly connected component of the relation) share a
tier; tier = 1 + the length of the longest chain of components above. Adjacent tiers do not imply that a
member of the upper one outperforms a given member of the lower one.

A tier is as firm as the narrowest win in the chain above it: each place names that win. Entries that never
reached the goal of any cell have no tier: the steps that they would need are unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import OptionError
from qrlsuite.statistics.grid import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class Ranked:
    """One entry's place.

    Attributes
    ----------
    tier:
        1 is the best; None where no pair with this entry is decided, or it never reached a goal.
    copeland:
        Entries it outperforms minus entries that outperform it, on the whole board; orders a tier.
    cycle:
        The entries, itself included, that outperform each other in a circle with it; empty if there are none.
    rests_on:
        Winner and loser of the narrowest win (in cells) in the chain that puts it into its tier; of several such
        chains, the one whose narrowest win is widest. None in the first tier and without a tier.
    """

    name: str
    tier: int | None
    copeland: int
    outperforms: tuple[str, ...]
    outperformed_by: tuple[str, ...]
    cycle: tuple[str, ...] = ()
    rests_on: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Ranking:
    """The result of `rank`.

    Attributes
    ----------
    tiers:
        The ranked entries, best tier first; within a tier by Copeland score, then by name.
    not_reached:
        Entries that reached the goal of no cell within the horizon, by name. They are below the entries that outperform
        them, and not ranked among each other.
    undecided:
        Entries that stand apart: fewer than 20 runs, or no decided pair. By name.
    """

    tiers: tuple[tuple[Ranked, ...], ...]
    not_reached: tuple[Ranked, ...]
    undecided: tuple[Ranked, ...]

    @property
    def entries(self) -> tuple[Ranked, ...]:
        """All entries in the order of the board: tiers, then entries that reached no goal, then undecided ones."""
        return tuple(entry for tier in self.tiers for entry in tier) + self.not_reached + self.undecided


def rank(
    names: Sequence[str],
    outperforms: ArrayLike,
    decided: ArrayLike,
    cells: ArrayLike | None = None,
    not_reached: ArrayLike | None = None,
) -> Ranking:
    """Return the tiers of M entries.

    Parameters
    ----------
    outperforms:
        Shape (M, M), boolean: whether the row's entry outperforms the column's.
    decided:
        Shape (M, M), boolean, symmetric: whether the pair could be judged at all.
    cells:
        Shape (M, M): in how many cells the row's entry needs significantly fewer samples than the column's; None
        means one each.
    not_reached:
        Shape (M,), boolean: whether an entry reached the goal of no cell; None means that all reached one.

    Raises
    ------
    OptionError
        If names repeat, shapes disagree, `decided` is not symmetric, an entry outperforms itself, or two
        entries outperform each other or do so in a pair that is not decided.
    """
    beats, known = _relation(names, outperforms, decided)
    compared: BoolArray = np.count_nonzero(known, axis=1) > 0
    capped = np.zeros(len(names), dtype=bool) if not_reached is None else np.asarray(not_reached, dtype=bool)
    ranked = compared & ~capped
    same = _circles(beats)
    tiers = _tiers(beats, same, ranked)
    supports = _supports(beats, same, tiers, beats if cells is None else np.asarray(cells))
    copeland = beats.sum(axis=1, dtype=np.int64) - beats.sum(axis=0, dtype=np.int64)

    def named(members: BoolArray) -> tuple[str, ...]:
        return tuple(names[index] for index in np.flatnonzero(members).tolist())

    def entry(index: int) -> Ranked:
        circle = named(same[index])
        return Ranked(
            name=names[index],
            tier=int(tiers[index]) if ranked[index] else None,
            copeland=int(copeland[index]),
            outperforms=named(beats[index]),
            outperformed_by=named(beats[:, index]),
            cycle=circle if len(circle) > 1 and ranked[index] else (),
            rests_on=(names[supports[index][0]], names[supports[index][1]]) if index in supports else None,
        )

    entries = sorted((entry(index) for index in range(len(names))), key=lambda e: (-e.copeland, e.name))
    last = int(tiers[ranked].max(initial=0))
    unknown = named(~compared)
    apart = sorted((e for e in entries if e.tier is None), key=lambda e: e.name)
    return Ranking(
        tiers=tuple(tuple(e for e in entries if e.tier == tier) for tier in range(1, last + 1)),
        not_reached=tuple(e for e in apart if e.name not in unknown),
        undecided=tuple(e for e in apart if e.name in unknown),
    )


def _relation(
    names: Sequence[str], outperforms: ArrayLike, decided: ArrayLike
) -> tuple[BoolArray, BoolArray]:
    """Check the arguments of `rank`; return (outperforms, decided) without the diagonal of the second."""
    beats, known = np.asarray(outperforms, dtype=bool), np.array(decided, dtype=bool)
    size = len(names)
    if len(set(names)) != size:
        twice = next(name for name in names if list(names).count(name) > 1)
        raise OptionError(f"two entries are called '{twice}'")
    for name, matrix in (("outperforms", beats), ("decided", known)):
        if matrix.shape != (size, size):
            raise OptionError(f"{name}: expected shape ({size}, {size}) for {size} names, got {matrix.shape}")
    np.fill_diagonal(known, False)
    if (known != known.T).any():
        raise OptionError("decided: the matrix is not symmetric")
    for row, column in np.argwhere(beats & (beats.T | ~known)).tolist():
        claim = f"'{names[row]}' outperforms '{names[column]}'"
        if row == column:
            raise OptionError(f"{claim}: an entry cannot outperform itself")
        problem = "also the reverse" if beats[column, row] else "the pair is undecided"
        raise OptionError(f"{claim}, but {problem}")
    return beats, known


def _circles(beats: BoolArray) -> BoolArray:
    """Return, shape (M, M), whether two entries can each be reached from the other (reflexive)."""
    reach = reachable(beats) | np.eye(len(beats), dtype=bool)
    circles: BoolArray = reach & reach.T
    return circles


def reachable(relation: BoolArray) -> BoolArray:
    """Return, shape (M, M), whether a chain of one or more steps of a relation leads from row to column."""
    reach = relation.copy()
    for _ in range(max(len(reach), 1).bit_length()):  # chains of doubled length each time
        reach |= reach.astype(np.float32) @ reach.astype(np.float32) > 0
    return reach


def _tiers(beats: BoolArray, same: BoolArray, ranked: BoolArray) -> IntArray:
    """Peel the board: a tier is every entry whose circle nobody left outperforms. 0 where not ranked."""
    above = beats & ~same
    tiers = np.zeros(len(beats), dtype=np.int64)
    left, tier = ranked.copy(), 0
    while left.any():
        tier += 1
        beaten = np.count_nonzero(above[left], axis=0) > 0
        top = left & (np.count_nonzero(same & beaten, axis=1) == 0)
        tiers[top] = tier
        left &= ~top
    return tiers


def _supports(
    beats: BoolArray, same: BoolArray, tiers: IntArray, cells: NDArray[Any]
) -> dict[int, tuple[int, int]]:
    """Return, for every entry below the first tier, winner and loser of the win that its tier rests on."""
    supports: dict[int, tuple[int, int]] = {}
    narrowest: dict[int, int] = {}
    for index in np.argsort(tiers, kind="stable").tolist():
        if tiers[index] < 2:
            continue
        above = beats & same[index] & (tiers == tiers[index] - 1)[:, None]
        pairs = [(int(winner), int(loser)) for winner, loser in np.argwhere(above)]
        widths = [min(int(cells[pair]), narrowest.get(pair[0], int(cells[pair]))) for pair in pairs]
        best = int(np.argmax(widths))
        winner, narrowest[index] = pairs[best][0], widths[best]
        supports[index] = supports[winner] if widths[best] < cells[pairs[best]] else pairs[best]
    return supports
