"""Every pair of a section, cell by cell, as the board judged it, with the estimates that each verdict rests on."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from qrlsuite.leaderboard.boards.ranked import learning_curves, ranking_of
from qrlsuite.leaderboard.boards.steps import Section
from qrlsuite.statistics import Board, Evidence, Grid, LearningCurves, Outcome
from qrlsuite.statistics.compare import in_words, overall

SYMBOLS = {1: "+", -1: "-", 0: ".", 2: "^", 3: "?"}
"""A cell's verdict from the first entry's side: fewer samples, more, no difference, both at cap, undecided."""


@dataclass(frozen=True)
class Pair:
    """Two entries of a section, by their place on the board (first < second).

    Attributes
    ----------
    cells:
        One character of `SYMBOLS` per cell, row by row of the (E, D) grid, from the first entry's side.
    n_runs:
        Number of runs at which both were compared.
    """

    first: int
    second: int
    n_runs: int
    cells: str
    neither_reached: bool = False
    """Both are at the cap in every cell, with all their runs."""

    def counts(self, by: int) -> tuple[int, int]:
        """Return in how many cells an entry of the pair needs significantly fewer, and more, samples."""
        wins, losses = self.cells.count("+"), self.cells.count("-")
        return (wins, losses) if by == self.first else (losses, wins)

    def outcome(self, by: int) -> Outcome:
        """Return the result from an entry's side."""
        return Outcome.UNDECIDED if "?" in self.cells else overall(*self.counts(by), self.neither_reached)

    def words(self, by: int) -> str:
        """Return the result from an entry's side in words."""
        return in_words(self.outcome(by), *self.counts(by), self.cells.count("^"), len(self.cells))


@dataclass(frozen=True)
class Judgement:
    """All pairs of a section.

    Attributes
    ----------
    evidence:
        The evidence of each verdict, by (entry's place, number of runs). The entry's own number is always a key.
    """

    grid: Grid
    horizon: int
    entries: tuple[LearningCurves, ...]
    pairs: tuple[Pair, ...]
    evidence: dict[tuple[int, int], Evidence]

    def own(self, place: int) -> Evidence:
        """Return an entry's evidence at all its runs."""
        return self.evidence[place, self.entries[place].n_runs]

    def pair(self, one: int, other: int) -> Pair:
        """Return the pair of two places on the board, in either order."""
        key = (min(one, other), max(one, other))
        return next(pair for pair in self.pairs if (pair.first, pair.second) == key)


def judge(section: Section) -> Judgement:
    """Return the pairs of a section, in the order of its rows, with the evidence of each verdict."""
    entries, horizon, board = [row.entry for row in section.rows], section.horizon, section.pairs
    grid = ranking_of(entries).grid
    curves = tuple(learning_curves(entry).cut(horizon) for entry in entries)
    places = [board.names.index(entry.name) for entry in entries]
    evidence: dict[tuple[int, int], Evidence] = {}

    def rest_on(place: int, n_runs: int) -> None:
        if (place, n_runs) not in evidence:
            known = board.evidence.get((places[place], n_runs))
            evidence[place, n_runs] = known or Evidence(curves[place], grid, n_runs)

    for place, curve in enumerate(curves):
        rest_on(place, curve.n_runs)
    pairs = []
    for i, j in itertools.combinations(range(len(curves)), 2):
        n_runs = min(curves[i].n_runs, curves[j].n_runs)
        for place in (i, j):
            rest_on(place, n_runs)
        nothing = bool(board.not_reached[[places[i], places[j]]].all())
        pairs.append(Pair(i, j, n_runs, _cells(board, places[i], places[j]), nothing))
    return Judgement(grid, horizon, curves, tuple(pairs), evidence)


def _cells(board: Board, first: int, second: int) -> str:
    signs = board.signs[first, second].astype(np.int64)
    if not board.decided[first, second]:
        return SYMBOLS[3] * int(signs.size)
    return "".join(SYMBOLS[int(code)] for code in np.where(board.capped[first, second], 2, signs).ravel())
