"""Entries as the page shows them: a name that is unique, and everything an entry was made with."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrlsuite.errors import QrlSuiteError
from qrlsuite.leaderboard.report.encode import clean, pack, scale, thinned
from qrlsuite.leaderboard.shelf.curves import EntryResults, registered_task
from qrlsuite.notation import write_setting
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import counted, hours_text

LONGEST_COMMAND = 1000
SINGLE_RUNS = 100_000
"""Values of single runs that a page carries at most, all entries together: two bytes each."""


@dataclass(frozen=True)
class EntryView:
    """One entry of the page.

    Attributes
    ----------
    palette:
        Numbers of the colors of its task's entries by name, see `paint`.
    legend:
        The label, with the ansatz if there is one.
    facts:
        Code, machine and settings: (term, description).
    commands:
        Commands that repeat the entry or show more of it: (term, command line).
    options:
        (heading, lines), a line being (option, value).
    """

    index: int
    curves: EntryResults
    label: str
    palette: dict[str, int]
    legend: str
    facts: tuple[tuple[str, str], ...]
    commands: tuple[tuple[str, str], ...]
    options: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]

    @property
    def color(self) -> int:
        """Number of its color and pattern in every section and picture of the page."""
        return self.palette[self.curves.name]

    @property
    def quantum(self) -> bool:
        """Whether the entry has quantum parameters."""
        return self.curves.parameters[1] > 0


def views(entries: Sequence[EntryResults]) -> list[EntryView]:
    """Return the entries of a page, labels made harmless and unique within a task."""
    labels = [(entry.task, clean(entry.label)) for entry in entries]
    palettes: dict[str, dict[str, int]] = {entry.task: {} for entry in entries}
    return [
        EntryView(
            index=index,
            curves=entry,
            label=label if labels.count((task, label)) == 1 else clean(f"{label} ({entry.name})"),
            palette=palettes[task],
            legend=clean(
                entry.legend if labels.count((task, label)) == 1 else f"{entry.legend} ({entry.name})"
            ),
            facts=tuple((term, value) for term, value in _facts(entry) if value),
            commands=tuple((term, clean(line, LONGEST_COMMAND)) for term, line in _commands(entry)),
            options=tuple(_options(entry)),
        )
        for index, (entry, (task, label)) in enumerate(zip(entries, labels))
    ]


def paint(entries: Iterable[EntryView]) -> None:
    """Give entries without a color the next ones of their task; the first colors differ most."""
    for entry in entries:
        entry.palette.setdefault(entry.curves.name, len(entry.palette))


def _facts(entry: EntryResults) -> list[tuple[str, str]]:
    classical, quantum = entry.parameters
    tuning = (entry.tuning or {}).items()
    tuned = {name: value for name, value in tuning if value and isinstance(value, str | int | float)}
    counts = f"{classical:,} classical, {quantum:,} quantum{entry.fixed_text}{_networks(entry)}"
    return [
        ("Name", clean(entry.name)),
        ("Algorithm", clean(entry.algorithm)),
        ("Model", clean(entry.model)),
        ("Parameters", "" if entry.parameters_text() == "-" else counts),
        ("Agents", f"of {counted(len(entry.agents), 'seed')}" if entry.agents else ""),
        ("Seeds", f"{len(entry.seeds)} ({format_seeds(entry.seeds)})"),
        ("Unfinished seeds", format_seeds(entry.left_out)),
        ("Length", f"{counted(entry.curves.shape[1], 'epoch')} of {entry.steps_per_epoch:,} steps"),
        ("Core-hours", hours_text(entry.hours) if entry.hours else ""),
        ("Circuit executions", _told(entry.executions)),
        ("Preset", _told(entry.preset)),
        ("Versions", _told(entry.versions)),
        ("Code revision", _told(entry.commits)),
        ("Processor", _told(entry.processors)),
        ("Device", _told(entry.devices)),
        ("Settings", clean(entry.settings)),
        ("Tuned", _told(tuned)),
        ("Source", _told(entry.source)),
        ("Task definition", clean(entry.task_hash)),
    ]


def _commands(entry: EntryResults) -> list[tuple[str, str]]:
    """Return the command lines that train an entry, check it, draw its curves and play its agents.

    Curves of other programs, and tasks that are not installed, have none.
    """
    changed = changed_options(entry)
    if entry.external or entry.study or changed is None:
        return []
    task = [
        entry.task.partition("+")[0],
        *(word for each in changed for word in ("--set", f"environment.{each}")),
    ]
    published = ["--published"] * (entry.source != "runs")
    named, place = f"{entry.task}/{entry.name}", entry.folder.parts[-4:]
    lines = [("Train", ["run", entry.trained_as, "--task", *task, "--seeds", str(len(entry.seeds))])]
    if published and place[0] == "leaderboard":
        lines.append(("Check", ["verify", "/".join(place), "--rerun", "2"]))
    lines.append(("Curves", ["plot", "curves", "--task", entry.task, "--entry", entry.name, *published]))
    if entry.agents or not published:
        lines.append(("Play", ["play", named, *published]))
    return [(term, shlex.join(["qrlsuite", *words])) for term, words in lines]


def changed_options(entry: EntryResults) -> list[str] | None:
    """Return the options of the environment in which its task differs from the registered one; None if not known."""
    name, _, changed = entry.task.partition("+")
    task, options = registered_task(name), entry.task_file.environment.options
    if task is None:
        return None
    usual = task.file.environment.options
    values = {option: value for option, value in options.items() if usual.get(option) != value and changed}
    try:
        same = task.with_environment(values).name == entry.task
    except QrlSuiteError:
        return None
    return [write_setting(option, value) for option, value in values.items()] if same else None


def _networks(entry: EntryResults) -> str:
    """Return how many networks the parameters are summed over; empty for one."""
    if entry.first_network_alone:
        return " (first network alone)"
    return f" in {entry.networks} networks" if entry.networks is not None and entry.networks > 1 else ""


def _told(value: Any) -> str:
    """Write a piece of provenance on one line; nothing where it is not known."""
    if not value:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{clean(name)} {_told(part)}".strip() for name, part in value.items())
    if isinstance(value, (list, tuple, set, frozenset)):
        return ", ".join(_told(part) for part in value)
    return f"{value:,}" if isinstance(value, int) else clean(_plain(value))


def _options(entry: EntryResults) -> list[tuple[str, tuple[tuple[str, str], ...]]]:
    tables = []
    for part in ("algorithm", "model"):
        values = entry.identity.get(f"{part}_options", {})
        lines = tuple((clean(name), clean(_plain(value))) for name, value in values.items())
        if lines:
            tables.append((f"Options of the {part}", lines))
    return tables


def _plain(value: Any) -> str:
    """Write an option's value as a settings file does."""
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)


def curves_data(entries: Sequence[EntryView]) -> list[dict[str, Any]]:
    """Return the learning curves of all entries for the page's scripts.

    The median and the percentiles are computed from all runs; a page with many runs draws only some of them.
    """
    total = sum(view.curves.curves.size for view in entries)
    share = min(1.0, SINGLE_RUNS / max(total, 1))
    data = []
    for view in entries:
        curves = view.curves.curves
        low, high = scale(curves)
        kept = thinned(curves, max(1, int(share * curves.shape[0])))
        bands = np.percentile(curves, (5, 50, 95), axis=0)
        data.append(
            {
                "label": view.label,
                "legend": view.legend,
                "color": view.color,
                "steps": view.curves.steps_per_epoch,
                "epochs": curves.shape[1],
                "runs": curves.shape[0],
                "kept": kept.shape[0],
                "low": low,
                "high": high,
                "band": [pack(band, low, high) for band in bands],
                "single": pack(kept, low, high),
            }
        )
    return data
