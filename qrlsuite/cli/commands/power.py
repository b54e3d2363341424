"""`qrlsuite power`: how many seeds, and core-hours, it takes to find a difference."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.arguments import AmongOption, JsonOption, PublishedOption, RunsOption
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.leaderboard.boards import ranked
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results import speed
from qrlsuite.results.speed import BASES
from qrlsuite.results.store import EntryStore
from qrlsuite.results.text import hours_text
from qrlsuite.statistics import LearningCurves, SmoothedRuns
from qrlsuite.statistics.curves import common_horizon
from qrlsuite.statistics.planning import LADDER, Need, runs_needed, runs_to_detect
from qrlsuite.statistics.times import mean_time

SLOWER = (0.10, 0.25, 0.50)
POWERS = (0.8, 0.9)


def power(
    first: Annotated[
        str,
        typer.Argument(metavar="ENTRY", help="An entry like those to compare, with two seeds or more."),
    ],
    second: Annotated[
        str | None, typer.Argument(metavar="[ENTRY]", help="Another one, to be told apart from the first.")
    ] = None,
    task: AmongOption = None,
    draws: Annotated[
        int, typer.Option("--draws", min=20, help="Simulated pairs per line; more take longer.")
    ] = 200,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Say how many seeds it takes to find that another entry is 10, 25 or 50 percent slower than this one.

    For two entries, also say how many it takes to find the difference between them. Pairs are simulated from the
    curves and judged by rule `times` at alpha = .05: all seeds at once, and with looks, as
    `qrlsuite study new` writes them.

    Example: qrlsuite power "mlp width=64" --task beam6g --published
    """
    collect.check_tasks(runs, [task] if task else [], published)
    entries = [
        collect.find(runs, name, published, [task] if task else [])
        for name in (first, second)
        if name is not None
    ]
    for entry in entries:
        if len(entry.seeds) < 2:
            raise OptionError(f"'{entry.label}' has a single seed, which has no spread: train two or more")
    if len({entry.task_hash for entry in entries}) > 1:
        raise OptionError(
            f"'{entries[0].label}' is of task {entries[0].task}, '{entries[1].label}' of {entries[1].task}"
        )
    curves = [ranked.learning_curves(entry) for entry in entries]
    horizon = common_horizon(curves[0], curves[-1])
    curves = [each.cut(horizon) for each in curves]
    ranking = ranked.ranking_of(entries)
    grid = ranking.grid
    bounds = (0.0, 1.0) if ranking.thresholds is None else None
    pilots = [SmoothedRuns(each, bounds=bounds) for each in curves]

    jobs: list[tuple[str, Callable[[], tuple[Need, ...]]]] = []
    if len(entries) == 2:
        order = sorted((0, 1), key=lambda index: mean_time(curves[index], grid).mean)
        better, worse = (pilots[index] for index in order)
        ratio = mean_time(worse.entry, grid).mean / max(1e-9, mean_time(better.entry, grid).mean) - 1
        title = f"{entries[order[1]].label} against {entries[order[0]].label}: {100 * ratio:.0f}% slower"
        jobs.append((title, functools.partial(runs_needed, better, worse, grid, POWERS, n_pairs=draws)))
    for share in SLOWER:
        detect = functools.partial(runs_to_detect, pilots[0], grid, share, powers=POWERS, n_pairs=draws)
        jobs += [(f"{100 * share:.0f}% slower than {entries[0].label}", detect)]
    per_seed, basis = _core_hours(entries, curves, runs)
    console = Console(stderr=True, quiet=json_output, highlight=False)
    rows = []
    for title, job in jobs:
        with console.status(Text(f"simulating: {title}")):
            rows += [_row(title, need, per_seed) for need in job()]
    if json_output:
        typer.echo(json.dumps(_as_dict(entries, horizon, rows, basis, draws)))
        return
    _show(entries, horizon, rows, per_seed, basis, draws)


def _core_hours(
    entries: list[EntryResults], curves: list[LearningCurves], runs: Path
) -> tuple[float | None, str]:
    """Return the core-hours of a seed of each of two entries together, None where unknown; and what that rests on."""
    speeds = speed.known(runs)
    total, bases = 0.0, []
    for entry, learned in ((entries[0], curves[0]), (entries[-1], curves[-1])):
        try:
            estimate = speeds.estimate(EntryStore(entry.folder).entry(), None)
        except StoreError:  # imported curves, or an entry of another version
            return None, BASES["unknown"]
        if estimate.seconds is None:
            return None, BASES["unknown"]
        total += estimate.seconds * learned.values.shape[1] / 3600
        bases.append(f"{BASES[estimate.basis]}, to within a factor of {estimate.within:.3g}")
    return total, "; ".join(dict.fromkeys(bases))


def _row(title: str, need: Need, per_pair: float | None) -> dict[str, Any]:
    def hours(seeds: float | None) -> float | None:
        return None if seeds is None or per_pair is None else seeds * per_pair

    mean = need.mean_runs if need.looks else None
    most = need.looks[-1] if need.looks else None
    return {
        "difference": title,
        "power": need.power,
        "fixed_seeds": need.fixed,
        "fixed_core_hours": hours(need.fixed),
        "looks": list(need.looks) or None,
        "mean_seeds": mean,
        "mean_core_hours": hours(mean),
        "most_seeds": most,
        "most_core_hours": hours(most),
    }


def _as_dict(
    entries: list[EntryResults], horizon: int, rows: list[dict[str, Any]], basis: str, draws: int
) -> dict[str, Any]:
    return {
        "task": entries[0].task,
        "entries": [
            {"entry": entry.name, "label": entry.label, "seeds": len(entry.seeds)} for entry in entries
        ],
        "horizon": horizon,
        "draws": draws,
        "core_hours_basis": basis,
        "needs": rows,
    }


def _show(
    entries: list[EntryResults],
    horizon: int,
    rows: list[dict[str, Any]],
    per_pair: float | None,
    basis: str,
    draws: int,
) -> None:
    table = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in ("difference", "power", "seeds, all at once", "seeds with looks: mean (most)", "its looks"):
        table.add_column(column, justify="left" if column in ("difference", "its looks") else "right")
    before = None
    for row in rows:
        fixed = f"over {LADDER[-1]}" if row["fixed_seeds"] is None else _cost(row, "fixed")
        mean, looks = f"over {LADDER[-1]}", ""
        if row["looks"]:
            mean = f"{row['mean_seeds']:.0f} ({row['most_seeds']}){_hours(row['mean_core_hours'])}"
            looks = ", ".join(str(look) for look in row["looks"])
        shown = "" if row["difference"] == before else row["difference"]
        before = row["difference"]
        table.add_row(*(Text(cell) for cell in (shown, f"{row['power']:g}", fixed, mean, looks)))
    table_console().print(table)
    pilots = " and ".join(f"{len(entry.seeds)} seeds of {entry.label}" for entry in entries)
    typer.echo(f"Seeds of each of the two entries, with the core-hours of both. Simulated from {pilots},")
    error = (0.8 * 0.2 / draws) ** 0.5
    typer.echo(f"{horizon} steps, {draws} pairs per line (power to within {100 * error:.0f} points or so).")
    if min(len(entry.seeds) for entry in entries) < 20:
        typer.echo("Fewer than 20 seeds are a weak pilot: rare failures may be missing from it.")
    typer.echo(f"Core-hours: {basis}." if per_pair is not None else f"Core-hours are {basis}.")


def _cost(row: dict[str, Any], which: str) -> str:
    return f"{row[f'{which}_seeds']}{_hours(row[f'{which}_core_hours'])}"


def _hours(hours: float | None) -> str:
    return "" if hours is None else f", {hours_text(hours)} h"
