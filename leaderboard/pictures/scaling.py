"""Sample complexity against size: width, depth, qubits, layers, or an option of the task (the paper's figure 7)."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.errors import OptionError, listed, nearest
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import steps_text


@dataclass(frozen=True)
class ScalingOptions:
    """Settings of the scaling picture."""

    by: Annotated[
        list[str] | str | None,
        Field(
            description="the size: `parameters`, an option of the model such as `width`, or of the task, "
            "such as `environment.degree` or `environment.antennas` (a list counts by its length); several make "
            "several panels; by default the options in which entries of one model differ"
        ),
    ] = None
    epsilons: Annotated[
        list[float] | None, Field(description="by default the reference cell's; several make several panels")
    ] = None
    deltas: Annotated[list[float] | None, Field(description="by default the reference cell's")] = None
    horizon: cells.Horizon = None


@plain_dataclass(frozen=True)
class _Line:
    """Entries that differ in size only, by size; several of one size are instances, shown with their mean."""

    label: str
    members: tuple[tuple[float, EntryResults], ...]

    @property
    def sizes(self) -> list[float]:
        return sorted({size for size, _ in self.members})


@plain_dataclass(frozen=True)
class _Panel:
    """The varied option, and the lines."""

    by: str
    lines: tuple[_Line, ...]


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw S_hat with its percentiles against size; the numbers at the markers are parameters."""
    chosen: ScalingOptions = options.build(ScalingOptions, settings, "picture 'scaling'")
    if not entries:
        raise OptionError("picture 'scaling' needs at least two entries of different size")
    panels = _panels(entries, [chosen.by] if isinstance(chosen.by, str) else chosen.by)
    reference = entries[0].task_file.ranking.reference
    epsilons = chosen.epsilons or ([reference.epsilon] if reference.epsilon is not None else None)
    thresholds = [reference.threshold] if reference.threshold is not None else None
    grid = cells.choose_grid(entries[0], epsilons, chosen.deltas or [reference.delta], thresholds)
    horizon = cells.choose_horizon(entries, chosen.horizon)
    n_levels, n_deltas = grid.shape
    columns = n_levels if n_levels > 1 else n_deltas
    rows = len(panels) * grid.size // columns
    figure = Figure(figsize=(max(5.6, 2.7 * columns), 0.8 + 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    measured = {entry.name: cells.measure(entry, grid, horizon) for entry in entries}
    place, colors = 0, 0
    for panel in panels:
        for j, i in np.ndindex(n_deltas, n_levels):
            cell_title = f"{cells.level_name(entries[0])} = {cells.levels(grid)[i]}, δ = {cells.probabilities(grid)[j]}"
            _draw_panel(axes[place], panel, measured, (i, j), horizon, cell_title, grid.size == 1, colors)
            place += 1
        colors = (colors + 2) % 6 if len(panels) > 1 else 0
    for each in axes[::columns]:
        each.set_ylabel("Ŝ (environment steps)")
    title = f"{_heading(entries)}: sample complexity against {_sizes(panels)}"
    if len(panels) == 1:  # all cells have its lines: one legend outside covers none of them
        style.legend(figure, title, [_handle(k, line) for k, line in enumerate(panels[0].lines)])
    else:
        figure.suptitle(title, x=0.01, ha="left", fontsize="medium")
        for each in axes[:: grid.size]:
            each.legend(facecolor="white", edgecolor="none", framealpha=0.9, fontsize=7.5)
    repeated = any(len(line.members) > len(line.sizes) for panel in panels for line in panel.lines)
    style.footnotes(
        figure,
        "bars: 5th to 95th percentile",
        "faded: the 95th percentile is at the cap" if any(m.at_cap.any() for m in measured.values()) else "",
        "lines: mean over instances" if repeated else "",
        _not_shown(entries, panels),
        cells.cut_note(entries, horizon),
        style.note(entries),
    )
    return figure


def _draw_panel(
    axes: Axes,
    panel: _Panel,
    measured: Mapping[str, cells.Cells],
    cell: tuple[int, int],
    horizon: int,
    title: str,
    annotate: bool,
    colors: int,
) -> None:
    sizes = sorted({size for line in panel.lines for size in line.sizes})
    doubling = len(sizes) > 2 and sizes[0] > 0 and sizes[-1] / sizes[0] >= 6
    counts = {len(entry.seeds) for line in panel.lines for _, entry in line.members}
    for k, line in enumerate(panel.lines):
        look = style.style(k + colors)
        means = [
            float(np.mean([measured[entry.name].points[cell] for size, entry in line.members if size == at]))
            for at in line.sizes
        ]
        shift = (
            1.0
            if len(panel.lines) == 1
            else 1 + (0.012 if doubling else 0.006) * (k - (len(panel.lines) - 1) / 2)
        )
        axes.plot(
            [x * shift for x in line.sizes],
            means,
            look.line,
            color=look.color,
            lw=1.4,
            label=style.plain(line.label),
        )
        for size, entry in line.members:
            complexities = measured[entry.name]
            point, (low, high) = complexities.points[cell], complexities.intervals[cell]
            alpha = 0.4 if complexities.at_cap[cell] else 1.0
            axes.errorbar(
                size * shift,
                point,
                yerr=[[point - low], [high - point]],
                fmt=look.marker,
                color=look.color,
                ecolor=look.color,
                ms=6,
                mec="white",
                capsize=3,
                alpha=alpha,
            )
            if annotate:
                note = entry.parameters_text()
                if len(counts) > 1:
                    note += f"\n({style.seeds_text(entry)})"
                axes.annotate(
                    note,
                    (size * shift, float(point)),
                    xytext=(7, -5 if k % 2 else 5),  # above one line and below the next
                    va="top" if k % 2 else "bottom",
                    textcoords="offset points",
                    fontsize=7,
                    color=look.color,
                )
    if doubling:
        axes.set_xscale("log")
    apart = [b / a if doubling else (b - a) / (sizes[-1] - sizes[0]) for a, b in itertools.pairwise(sizes)]
    enough = 1.2 if doubling else 0.08  # of closer ones the numbers would lie over one another
    if min(apart, default=enough) >= enough:
        axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axes.minorticks_off()
    axes.margins(x=0.12)
    axes.set_xlabel(panel.by.removeprefix("environment."))
    axes.axhline(horizon, color="#505050", lw=0.9, ls=":")
    axes.set_ylim(0, horizon * 1.08)
    axes.yaxis.set_major_formatter(steps_text)
    style.tidy(axes)
    axes.set_title(f"{title}: {_seeds(panel)}", fontsize=9, loc="left")


def _handle(k: int, line: _Line) -> Line2D:
    look = style.style(k)
    return Line2D(
        [], [], color=look.color, ls=look.line, marker=look.marker, mec="white", label=style.plain(line.label)
    )


def _seeds(panel: _Panel) -> str:
    """Write on how many seeds the points of a panel rest."""
    entries = [entry for line in panel.lines for _, entry in line.members]
    counts = sorted({len(entry.seeds) for entry in entries})
    star = "*" * any(style.provisional(entry) for entry in entries)
    return f"{counts[0]} to {counts[-1]} seeds{star}" if len(counts) > 1 else style.seeds_text(entries[0])


def _not_shown(entries: Sequence[EntryResults], panels: Sequence[_Panel]) -> str:
    """Name the entries that are on no line, for lack of others of their kind."""
    shown = {id(entry) for panel in panels for line in panel.lines for _, entry in line.members}
    missing = [style.plain(entry.label) for entry in entries if id(entry) not in shown]
    return f"not shown, too few of a kind for a line: {listed(missing, 3)}" if missing else ""


def _sizes(panels: Sequence[_Panel]) -> str:
    names = list(dict.fromkeys(panel.by.removeprefix("environment.") for panel in panels))
    return names[0] if len(names) == 1 else "size"


def _heading(entries: Sequence[EntryResults]) -> str:
    tasks = sorted({entry.task for entry in entries})
    if len(tasks) == 1:
        return style.heading(entries)
    return style.plain(f"{len(tasks)} tasks, {tasks[0]} to {tasks[-1]}")


def _panels(entries: Sequence[EntryResults], by: Sequence[str] | None) -> list[_Panel]:
    """Arrange entries into panels: one for each varied option of each model, or for each that was asked for."""
    if by is not None:
        groups = [(name, list(entries)) for name in by]
    else:
        models = list(dict.fromkeys(entry.model for entry in entries))
        members = {model: [entry for entry in entries if entry.model == model] for model in models}
        groups = [(name, members[model]) for model in models for name in _varied(members[model])]
    panels = []
    for name, members_ in groups:
        lines: dict[str, list[tuple[float, EntryResults]]] = {}
        for entry in members_:
            lines.setdefault(_rest(entry, name), []).append((_size(entry, name), entry))
        made = [_Line("", tuple(sorted(line, key=lambda pair: pair[0]))) for line in lines.values()]
        longest = max(len(line.sizes) for line in made)
        if longest < 2 and by is None:
            continue
        fewest = min(3 if by is None else 2, longest)
        kept = [line for line in made if len(line.sizes) >= fewest]
        labels = _line_labels([line.members[0][1] for line in kept], name)
        panels.append(_Panel(name, tuple(_Line(text, line.members) for text, line in zip(labels, kept))))
    if not panels:
        raise OptionError("picture 'scaling': no two entries differ in one option of their model only")
    return panels


def _varied(entries: Sequence[EntryResults]) -> list[str]:
    """Return the numeric model options in which entries differ."""
    names = list(dict.fromkeys(name for entry in entries for name in _model_options(entry)))
    return [
        name
        for name in names
        if len({json.dumps(_model_options(entry).get(name)) for entry in entries}) > 1
        and all(isinstance(_model_options(entry).get(name), int | float) for entry in entries)
    ]


def _model_options(entry: EntryResults) -> Mapping[str, Any]:
    values: Mapping[str, Any] = entry.identity.get("model_options", {})
    return values


def _environment_options(entry: EntryResults) -> Mapping[str, Any]:
    values: Mapping[str, Any] = entry.identity.get("task", {}).get("environment_options", {})
    return values


def _size(entry: EntryResults, by: str) -> float:
    if by == "parameters":
        return float(sum(entry.parameters))
    side, dot, name = by.partition(".")
    source = _environment_options(entry) if dot and side == "environment" else _model_options(entry)
    name = name if dot else by
    if name not in source:
        known = [
            *_model_options(entry),
            *(f"environment.{key}" for key in _environment_options(entry)),
            "parameters",
        ]
        raise OptionError(
            f"picture 'scaling', by = '{by}': '{entry.label}' has no such option{nearest(by, known)}"
        )
    value = source[name]
    if isinstance(value, list):
        return float(len(value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise OptionError(f"picture 'scaling', by = '{by}': {value!r} of '{entry.label}' is not a number")
    return float(value)


def _rest(entry: EntryResults, by: str) -> str:
    """Return everything about an entry but its size: entries with the same rest are on one line."""
    model, world = dict(_model_options(entry)), dict(_environment_options(entry))
    if by == "parameters":
        model = {key: value for key, value in model.items() if not isinstance(value, int | float)}
    elif by.startswith("environment."):
        world.pop(by.removeprefix("environment."), None)
    else:
        model.pop(by.removeprefix("model."), None)
    algorithm = entry.identity.get("algorithm_options", {})
    return json.dumps([entry.algorithm, algorithm, entry.model, model, world], sort_keys=True)


def _line_labels(entries: Sequence[EntryResults], by: str) -> list[str]:
    """Name lines by their model and the options in which the lines differ."""
    varied = [name for name in dict.fromkeys(n for e in entries for n in _model_options(e)) if name != by]
    labels = []
    for entry in entries:
        same = [other for other in entries if other.model == entry.model]
        own = _model_options(entry)
        parts = [
            f"{name}={own[name]}"
            for name in varied
            if name in own and len({json.dumps(_model_options(other).get(name)) for other in same}) > 1
        ]
        labels.append(" ".join([entry.model, *([] if by == "parameters" else parts)]))
    return labels
