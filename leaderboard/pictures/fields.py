"""Any field of the results against any other: options, scores and costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import pyarrow
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import notation, options
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import cells, style
from qrlsuite.leaderboard.shelf import fields
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.options import Setting, parse_setting
from qrlsuite.results.text import counted, steps_text
from qrlsuite.statistics.times import student_quantile

MANY = 25
"""Of more points on a line, intervals are a band."""


@dataclass(frozen=True)
class FieldsOptions:
    """Settings of the picture."""

    x: Annotated[
        str,
        Field(description="the field to the right: a column of `api.table`, or an option"),
    ] = "parameters"
    y: Annotated[str, Field(description="the field upward, a number; its mean over seeds is drawn")] = (
        "steps_below_threshold"
    )
    by: Annotated[
        list[str] | str | None,
        Field(description="one field or several, a line for each of their values; by default `model`"),
    ] = None
    where: Annotated[str | None, Field(description="only rows with these: 'model=mlp layers=2'")] = None
    horizon: Annotated[
        int | None,
        Field(ge=1, description="environment steps to which all entries are cut; by default the task's"),
    ] = None


Groups = dict[tuple[str, ...], dict[Any, NDArray[np.float64]]]
"""Values of y by line and x."""


def draw(entries: Sequence[EntryResults], **settings: Any) -> Figure:
    """Draw the mean of a field over seeds, with its interval, against another field."""
    chosen: FieldsOptions = options.build(FieldsOptions, settings, "picture 'fields'")
    if not entries:
        raise OptionError("picture 'fields' needs at least one entry")
    shown, notes = _cut(entries, chosen.horizon)
    by = [chosen.by] if isinstance(chosen.by, str) else chosen.by or ["model"]
    where = [parse_setting(word, "where: ") for word in notation.split(chosen.where or "")]
    table, names = _table(shown, [chosen.x, chosen.y, *by, *map(_name, where)])
    x, y, *rest = names
    lines, rows = rest[: len(by)], rest[len(by) :]
    kept = [row for row in table.to_pylist() if all(map(_has, (row[name] for name in rows), where))]
    groups, remarks = _groups(kept, x, y, lines)
    if not groups:
        raise OptionError(
            f"picture 'fields': nothing has {x}, {y}{f' and {chosen.where}' if chosen.where else ''}"
        )
    figure = Figure(figsize=(7.2, 4.3), layout="constrained")
    axes = figure.subplots()
    places = _axis(axes, x, sorted({at for line in groups.values() for at in line}, key=_order))
    for index, line in enumerate(groups.values()):
        _draw_line(axes, style.style(index), places, line)
    axes.set_ylabel(_label(y))
    if _unit(y) == "environment steps":
        axes.yaxis.set_major_formatter(steps_text)
    axes.margins(x=0.06)
    style.tidy(axes)
    title = f"{style.heading(entries)}: {_short(y)} against {_short(x)}"
    handles = [_handle(index, lines, key) for index, key in enumerate(groups)] if len(groups) > 1 else []
    if handles:
        style.legend(figure, title, handles)
    else:
        figure.suptitle(title, x=0.01, ha="left", fontsize="medium")
    style.footnotes(
        figure,
        f"means over seeds, with 95% intervals, each by itself; entries of {_seeds(shown)}",
        style.plain(f"where {chosen.where}") if chosen.where else "",
        remarks,
        *notes,
        style.note(entries),
    )
    return figure


def _cut(entries: Sequence[EntryResults], requested: int | None) -> tuple[list[EntryResults], list[str]]:
    """Cut the entries of each task to one length; return them with notes."""
    shown, notes = list[EntryResults](), list[str]()
    for task in dict.fromkeys(entry.task_hash for entry in entries):
        members = [entry for entry in entries if entry.task_hash == task]
        horizon = cells.choose_horizon(members, requested)
        cut = [entry.cut(horizon // entry.steps_per_epoch) for entry in members]
        shown += [entry for entry in cut if entry is not None]
        notes.append(cells.cut_note(members, horizon))
    return shown, list(dict.fromkeys(notes))


def _name(setting: Setting) -> str:
    return f"{setting.side}.{setting.name}" if setting.side else setting.name


def _table(entries: Sequence[EntryResults], wanted: Sequence[str]) -> tuple[pyarrow.Table, list[str]]:
    """Return the table with fewest rows that has all fields, seeds where entries would do; and their columns."""
    of_entries = fields.table(entries, "entries")
    rows: fields.Rows = "epochs" if any(fields.of_epochs(name) for name in wanted) else "seeds"
    own = fields.table(entries, rows)
    names = [fields.find(name, [*own.column_names, *of_entries.column_names]) for name in wanted]
    lacking = [name for name in dict.fromkeys(names) if name not in own.column_names]
    if lacking:  # of an entry: the same in all its rows
        place = {key: index for index, key in enumerate(zip(*(of_entries[k].to_pylist() for k in _KEY)))}
        at = pyarrow.array([place[key] for key in zip(*(own[k].to_pylist() for k in _KEY))])
        for name in lacking:
            own = own.append_column(name, of_entries[name].take(at))
    return own, names


_KEY = ("task", "name", "source")


def _has(value: Any, setting: Setting) -> bool:
    return fields.same(value, setting.value)


def _groups(rows: Sequence[Mapping[str, Any]], x: str, y: str, by: Sequence[str]) -> tuple[Groups, str]:
    """Return the values of y by line and x, and notes on entries that lack a field or share a point."""
    found: dict[tuple[str, ...], dict[Any, list[float]]] = {}
    behind: dict[Any, set[Any]] = {}
    lacking = set()
    for row in rows:
        value, entry = row[y], tuple(row[name] for name in _KEY)
        if isinstance(value, bool | str):
            raise OptionError(f"picture 'fields': y = {y} is {value!r}: choose a field of numbers")
        if value is None or row[x] is None:
            lacking.add(entry)
            continue
        line = tuple(_text(row[name]) for name in by)
        found.setdefault(line, {}).setdefault(row[x], []).append(float(value))
        behind.setdefault((line, row[x]), set()).add(entry)
    groups = {
        line: {at: np.array(values) for at, values in found[line].items()}
        for line in sorted(found, key=_natural)
    }
    notes = [f"without {counted(len(lacking), 'entry')} without one of these fields"] * bool(lacking)
    several = sum(len(entries) > 1 for entries in behind.values())
    notes += [f"{several} of {counted(len(behind), 'point')} from several entries"] * bool(several)
    return groups, ";  ".join(notes)


def _text(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _natural(line: tuple[str, ...]) -> list[tuple[int, float, str]]:
    """Order lines by their values, numbers by size."""
    keys = []
    for text in line:
        try:
            keys.append((0, float(text), ""))
        except ValueError:
            keys.append((1, 0.0, text))
    return keys


def _order(value: Any) -> tuple[int, float, str]:
    number = isinstance(value, int | float)
    return (0, float(value), "") if number else (1, 0.0, str(value))


def _axis(axes: Axes, x: str, values: Sequence[Any]) -> dict[Any, float]:
    """Label the x axis; returns where each value stands on it."""
    axes.set_xlabel(_label(x))
    if any(isinstance(value, bool | str) for value in values):
        axes.set_xticks(range(len(values)), [style.plain(str(value), 24) for value in values])
        return {value: float(place) for place, value in enumerate(values)}
    low, high = float(values[0]), float(values[-1])
    if len(values) > 2 and low > 0 and high / low >= 6 and not _unit(x):
        axes.set_xscale("log")
        axes.minorticks_off()
    if len(values) <= 8:
        axes.set_xticks([float(value) for value in values], [f"{value:g}" for value in values])
    elif _unit(x) == "environment steps":
        axes.xaxis.set_major_formatter(steps_text)
    return {value: float(value) for value in values}


def _draw_line(
    axes: Axes, look: style.Style, places: Mapping[Any, float], line: Mapping[Any, NDArray[np.float64]]
) -> None:
    """Draw the means of a line with their intervals."""
    at = sorted(line, key=lambda value: places[value])
    x = np.array([places[value] for value in at])
    means = np.array([line[value].mean() for value in at])
    reach = np.array([_reach(line[value]) for value in at])
    if len(at) > MANY:
        axes.plot(x, means, look.line, color=look.color, lw=1.8)
        axes.fill_between(x, means - reach, means + reach, color=look.color, alpha=0.15, lw=0)
        return
    axes.plot(x, means, look.line, color=look.color, lw=1.3)
    axes.errorbar(
        x, means, yerr=reach, fmt=look.marker, color=look.color, ms=6, mec="white", capsize=3, ls="none"
    )


def _reach(values: NDArray[np.float64]) -> float:
    """Return half of the interval of a mean by Student's t; 0 where there is one value."""
    count = len(values)
    if count < 2:
        return 0.0
    return float(student_quantile(0.975, count - 1)) * float(values.std(ddof=1) / np.sqrt(count))


def _handle(index: int, names: Sequence[str], values: Sequence[str]) -> Line2D:
    look = style.style(index)
    words = [value if name in _SAY_ALL else f"{_short(name)}={value}" for name, value in zip(names, values)]
    label = style.plain(", ".join(words))
    return Line2D([], [], color=look.color, ls=look.line, marker=look.marker, mec="white", label=label)


_SAY_ALL = ("task", "entry", "name", "algorithm", "model")
"""Fields whose values need no name beside them."""


def _seeds(entries: Sequence[EntryResults]) -> str:
    """Write how many seeds entries have."""
    counts = sorted({len(entry.seeds) for entry in entries})
    low = f"{counts[0]} to " if len(counts) > 1 else ""
    star = "*" if any(map(style.provisional, entries)) else ""
    return f"{low}{counts[-1]} seed{'s' * (counts[-1] != 1)}{star}"


def _short(name: str) -> str:
    return style.plain(name.partition(".")[2] or name.replace("_", " "))


def _unit(name: str) -> str:
    return next(
        (each.unit for own in fields.FIELDS.values() for each in own if each.name == name and each.unit), ""
    )


def _label(name: str) -> str:
    unit = _unit(name)
    return f"{_short(name)} ({unit})" if unit and unit.replace("-", " ") != _short(name) else _short(name)
