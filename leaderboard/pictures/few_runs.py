"""How a few seeds mislead: verdicts of random subsets of 5 seeds, beside the verdict of all.

Of two entries, or of two sets of seeds of one and the same entry (paper, figure "Inadequate reporting").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.boards.ranked import learning_curves
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Grid
from qrlsuite.statistics.estimator import complexity


@dataclass(frozen=True)
class FewRunsOptions:
    """Settings of the picture of few runs."""

    few: Annotated[int, Field(ge=1, le=1000, description="seeds of the small sample")] = 5
    draws: Annotated[int, Field(ge=10, le=100_000, description="random samples")] = 1000
    seed: Annotated[int, Field(ge=0, description="of the random samples")] = 0
    epsilon: Annotated[float | None, Field(description="by default the reference cell's")] = None
    delta: Annotated[float | None, Field(description="by default the reference cell's")] = None
    horizon: Annotated[
        int | None,
        Field(
            ge=1, description="environment steps at which sample complexity is capped; by default the task's"
        ),
    ] = None


@plain_dataclass(frozen=True, eq=False)
class _Draws:
    """Pairs of samples: the chosen runs (R, n) of each side and their S_hat (R,) in steps."""

    runs: tuple[NDArray[np.int64], NDArray[np.int64]]
    steps: tuple[NDArray[np.int64], NDArray[np.int64]]

    def words(self, first: str, second: str) -> str:
        ahead = float((self.steps[0] < self.steps[1]).mean())
        behind = float((self.steps[0] > self.steps[1]).mean())
        return f"{first} ahead: {ahead:.0%}\n{second} ahead: {behind:.0%}, neither: {1 - ahead - behind:.0%}"


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw two samples of few seeds that contradict each other, all seeds, and the distribution of S_hat.

    The two samples are no extremes: their difference is the 5th and the 95th percentile over the draws.
    """
    chosen: FewRunsOptions = options.build(FewRunsOptions, settings, "picture 'few-runs'")
    cells.one_task(entries, "few-runs")
    if len(entries) > 2:
        raise OptionError(
            f"picture 'few-runs' compares one or two entries, not {len(entries)}: choose with --entry"
        )
    need = 2 * chosen.few if len(entries) == 1 else chosen.few + 1
    for entry in entries:
        if len(entry.seeds) < need:
            raise OptionError(f"'{entry.label}' has {len(entry.seeds)} seeds; this picture needs {need}")
    ranking, horizon = entries[0].task_file.ranking, cells.choose_horizon(entries, chosen.horizon)
    reference = ranking.reference
    epsilon = reference.epsilon if chosen.epsilon is None else chosen.epsilon
    grid = cells.choose_grid(
        entries[0],
        None if epsilon is None else [epsilon],
        [reference.delta if chosen.delta is None else chosen.delta],
        [reference.threshold] if epsilon is None and reference.threshold is not None else None,
    )
    generator = np.random.default_rng(chosen.seed)
    few = _sample(entries, grid, horizon, chosen.few, chosen.draws, generator)
    most = min(len(entry.seeds) for entry in entries) // (2 if len(entries) == 1 else 1)
    many = _sample(entries, grid, horizon, most, chosen.draws, generator, resample=len(entries) == 2)
    names = style.labels(entries, 26) if len(entries) == 2 else ["set A", "set B"]
    return _figure(entries, names, grid, horizon, few, many, chosen.few, most)


def _sample(
    entries: Sequence[EntryResults],
    grid: Grid,
    horizon: int,
    size: int,
    draws: int,
    generator: np.random.Generator,
    resample: bool = False,
) -> _Draws:
    """Draw pairs of samples of `size` runs: distinct runs, or with replacement as the bootstrap does."""
    curves = [learning_curves(entry).cut(horizon) for entry in entries]
    sides = [curves[0], curves[-1]]
    chosen: tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]] = ([], [])
    for _ in range(draws):
        if len(curves) == 1:
            order = generator.permutation(curves[0].n_runs)
            chosen[0].append(order[:size])
            chosen[1].append(order[size : 2 * size])
        else:
            for side, into in zip(sides, chosen):
                into.append(generator.choice(side.n_runs, size, replace=resample))
    steps = tuple(
        np.array([int(complexity(side.values[runs], grid, side.steps_per_epoch)[0, 0]) for runs in each])
        for side, each in zip(sides, chosen)
    )
    return _Draws((np.array(chosen[0]), np.array(chosen[1])), (steps[0], steps[1]))


def _figure(
    entries: Sequence[EntryResults],
    names: Sequence[str],
    grid: Grid,
    horizon: int,
    few: _Draws,
    many: _Draws,
    n_few: int,
    n_many: int,
) -> Figure:
    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    panels = figure.subplot_mosaic([["a", "a", "b", "b", "c", "c"], ["d", "d", "d", "e", "e", "e"]])
    difference = few.steps[0] - few.steps[1]
    order = np.argsort(difference, kind="stable")
    low, high = order[round(0.05 * (len(order) - 1))], order[round(0.95 * (len(order) - 1))]
    sides = (entries[0], entries[-1])
    for key, index in (("a", low), ("b", high)):
        samples = [entry.curves[runs[index]] for entry, runs in zip(sides, few.runs)]
        complexities = [int(steps[index]) for steps in few.steps]
        title = "a sample of" if key == "a" else "another sample of"
        _learning(panels[key], sides, samples, grid, horizon, f"{title} {n_few} seeds", complexities)
    everything = [entry.curves for entry in sides]
    whole = [
        int(complexity(learning_curves(entry).cut(horizon).values, grid, entry.steps_per_epoch)[0, 0])
        for entry in sides
    ]
    counts = sorted({len(entry.seeds) for entry in sides})
    title = f"all seeds ({' and '.join(map(str, counts))})"
    if len(entries) == 1:
        _learning(panels["c"], sides[:1], everything[:1], grid, horizon, title, whole[:1], color=2)
    else:
        _learning(panels["c"], sides, everything, grid, horizon, title, whole)
    for key in ("b", "c"):
        panels[key].sharey(panels["a"])
        panels[key].tick_params(labelleft=False)
    ranked = style.plain(entries[0].task_file.score.called)
    panels["a"].set_ylabel(f"{ranked}: mean, standard deviation", fontsize=8.5)
    step = entries[0].steps_per_epoch
    for key, drawn, size in (("d", few, n_few), ("e", many, n_many)):
        _distribution(panels[key], drawn, horizon, step)
        panels[key].set_title(f"{size} seeds each\n{drawn.words(*names)}", fontsize=8, loc="left")
    panels["e"].set_yticks([])
    level, delta = cells.levels(grid)[0], cells.probabilities(grid)[0]
    subject = (
        " against ".join(names)
        if len(entries) == 2
        else f"{style.labels(entries)[0]} against itself, other seeds"
    )
    shown = [*names, "all seeds"] if len(entries) == 1 else names
    style.legend(figure, f"{style.heading(entries)}: {subject}", [_line(*each) for each in enumerate(shown)])
    many_words = "resampled from all" if len(entries) == 2 else "halves of all"
    style.footnotes(
        figure,
        f"Ŝ at {cells.level_name(entries[0])} = {level}, δ = {delta}, dotted: its threshold",
        f"below: Ŝ of {len(difference)} random samples of {n_few} seeds, and of {n_many} ({many_words})",
        "the two samples: 5th and 95th percentile of the difference of Ŝ",
        cells.cut_note(entries, horizon),
        *(
            f"* {style.plain(e.label)}: provisional, {len(e.seeds)} of {e.task_file.protocol.seeds} seeds"
            for e in entries
            if style.provisional(e)
        ),
    )
    return figure


def _learning(
    axes: Axes,
    entries: Sequence[EntryResults],
    samples: Sequence[NDArray[np.float64]],
    grid: Grid,
    horizon: int,
    title: str,
    complexities: Sequence[int],
    color: int = 0,
) -> None:
    """Draw mean and standard deviation of samples (n, T), as papers with few seeds do."""
    for k, (entry, values) in enumerate(zip(entries, samples)):
        look = style.style(k + color)
        shown = values[:, : horizon // entry.steps_per_epoch]
        at = np.arange(1, shown.shape[1] + 1) * entry.steps_per_epoch
        mean, spread = shown.mean(axis=0), shown.std(axis=0)
        axes.fill_between(at, mean - spread, mean + spread, color=look.color, alpha=0.15, lw=0)
        axes.plot(at, mean, color=look.color, ls=look.line, lw=1.5)
    axes.axhline(grid.thresholds[0], color="#505050", lw=0.9, ls=":")
    axes.set_title(f"{title}\nŜ = {' and '.join(map(steps_text, complexities))}", fontsize=8.5, loc="left")
    axes.xaxis.set_major_formatter(steps_text)
    axes.set_xlim(0, horizon)
    axes.tick_params(labelsize=8)
    style.tidy(axes)


def _line(place: int, name: str) -> Line2D:
    """Return the legend's line of the entry, or the set of seeds, at a place."""
    look = style.style(place)
    return Line2D([], [], color=look.color, ls=look.line, lw=1.5, label=name)


def _distribution(axes: Axes, drawn: _Draws, horizon: int, step: int) -> None:
    """Draw both distributions of S_hat over the samples."""
    width = step * max(1, round(horizon / step / 50))
    edges = np.arange(-0.5 * step, horizon + width + step, width)
    for k, steps in enumerate(drawn.steps):
        look = style.style(k)
        share = np.histogram(steps, edges)[0] / len(steps)
        axes.stairs(
            share,
            edges,
            fill=True,
            facecolor=look.color + "40",
            edgecolor=look.color,
            hatch=("", "////")[k],
            lw=0,
        )
        axes.stairs(share, edges, color=look.color, ls=look.line, lw=1.4)
    axes.set_xlabel("Ŝ (environment steps)", fontsize=8.5)
    axes.set_xlim(0, horizon + width)
    axes.set_ylim(bottom=0)
    axes.set_yticks([])
    axes.xaxis.set_major_formatter(steps_text)
    axes.tick_params(labelsize=8)
    style.tidy(axes)
    axes.spines["left"].set_visible(False)
