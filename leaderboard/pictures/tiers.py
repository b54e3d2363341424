"""Who outperforms whom, tier by tier: a table with one row and one column per entry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.leaderboard.boards.ranked import learning_curves, ranking_of
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Board, outperformance
from qrlsuite.statistics.compare import TOO_FEW

LOOKS: dict[str, dict[str, Any]] = {
    "win": {"facecolor": style.COLORS[0], "edgecolor": "white"},
    "loss": {"facecolor": "#f3c9a8", "edgecolor": "white", "hatch": "////"},
    "neither": {"facecolor": "#f2f2f2", "edgecolor": "white"},
    "undecided": {"facecolor": "white", "edgecolor": "#b0b0b0", "hatch": "...."},
    "self": {"facecolor": "#b8b8b8", "edgecolor": "white"},
}


@dataclass(frozen=True)
class TiersOptions:
    """Settings of the tiers."""

    horizon: cells.Horizon = None


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw the ranking of a task's entries on its ranking grid."""
    chosen: TiersOptions = options.build(TiersOptions, settings, "picture 'tiers'")
    cells.one_task(entries, "tiers")
    horizon = cells.choose_horizon(entries, chosen.horizon)
    grid = ranking_of(entries).grid
    board = outperformance([learning_curves(entry) for entry in entries], grid, horizon=horizon)
    shown = style.labels(entries)
    longest = max(map(len, shown))
    size = len(entries)
    side = 0.42 if size <= 20 else 0.3
    width, height = 1.6 + 0.075 * longest + side * size, 1.5 + side * size + 0.055 * longest
    figure = Figure(figsize=(max(5.0, width), height), layout="constrained")
    axes = figure.subplots()
    states = _table(axes, board)
    _name_rows_and_columns(axes, entries, board, shown)
    texts = {
        "win": "the row outperforms the column",
        "loss": "the reverse",
        "neither": "neither",
        "undecided": TOO_FEW,
    }
    handles = [Patch(**LOOKS[state], lw=0, label=text) for state, text in texts.items() if state in states]
    title = f"{style.heading(entries)}: significant outperformance, up to {steps_text(horizon)} steps"
    style.legend(figure, title, handles)
    style.footnotes(
        figure,
        f"number: cells, of {grid.size}, in which the row needs significantly fewer samples than the column",
        cells.cut_note(entries, horizon),
        style.note(entries),
    )
    return figure


def _table(axes: Axes, board: Board) -> set[str]:
    """Draw the cells in the order of the ranking; return which states occur."""
    order = [board.names.index(ranked.name) for ranked in board.ranking.entries]
    states = set()
    for (i, row), (j, column) in ((a, b) for a in enumerate(order) for b in enumerate(order)):
        state = "neither"
        if i == j:
            state = "self"
        elif not board.decided[row, column]:
            state = "undecided"
        elif board.outperforms[row, column]:
            state = "win"
        elif board.outperforms[column, row]:
            state = "loss"
        states.add(state)
        axes.add_patch(Rectangle((j, i), 1, 1, lw=0, **LOOKS[state]))
        axes.add_patch(Rectangle((j, i), 1, 1, lw=1.2, fill=False, edgecolor="white"))
        count = int(board.better_cells[row, column])
        if count or state == "neither":
            ink = "white" if state == "win" else "#303030"
            axes.text(j + 0.5, i + 0.5, str(count), ha="center", va="center", fontsize=8, color=ink)
    axes.set_xlim(0, len(order))
    axes.set_ylim(len(order), 0)
    axes.set_aspect("equal")
    axes.spines[:].set_visible(False)
    return states


def _name_rows_and_columns(
    axes: Axes, entries: Sequence[EntryResults], board: Board, shown: Sequence[str]
) -> None:
    """Write entries beside rows and below columns, and set the tiers apart."""
    ranks = board.ranking.entries
    order = [board.names.index(ranked.name) for ranked in ranks]
    capped = {ranked.name for ranked in board.ranking.not_reached}
    for k, (ranked, before) in enumerate(zip(ranks, [None, *ranks[:-1]])):
        if before is not None and (ranked.tier, ranked.name in capped) == (
            before.tier,
            before.name in capped,
        ):
            continue
        if k:
            axes.axhline(k, color="#303030", lw=1)
            axes.axvline(k, color="#303030", lw=1)
    tiers = [
        f"tier {ranked.tier}"
        if ranked.tier is not None
        else ("not reached" if ranked.name in capped else "undecided")
        for ranked in ranks
    ]
    texts = []
    for k, (tier, index) in enumerate(zip(tiers, order)):
        shown_tier = tier if k == 0 or tiers[k - 1] != tier else " " * len(tier)
        texts.append(f"{shown[index]}, {style.seeds_text(entries[index])}   {shown_tier}")
    axes.set_yticks(np.arange(len(order)) + 0.5, texts, fontsize=8)
    axes.set_xticks(
        np.arange(len(order)) + 0.5,
        [shown[index] for index in order],
        fontsize=8,
        rotation=35,
        ha="right",
        rotation_mode="anchor",
    )
    axes.tick_params(length=0)
