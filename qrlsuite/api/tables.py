"""Results as Arrow tables, from Python."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import pyarrow

from qrlsuite.engine.status import EntryStatus
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.shelf import collect, fields
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.survey import STATUSES


def table(
    rows: fields.Rows = "entries",
    task: str | Sequence[str] | None = None,
    *,
    entries: Sequence[str | EntryResults] = (),
    horizon: int | None = None,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
) -> pyarrow.Table:
    """Return results as an Arrow table, with every option as a column.

    `table().to_pandas()` where pandas is installed; `polars.from_arrow(table())`.

    Parameters
    ----------
    rows:
        Kind of rows: `entries`, their `seeds`, or the `epochs` of seeds, which are the learning curves.
    task:
        The entries of this one, or of several; None means all.
    entries:
        The only entries: arguments of `load`, or its results.
    horizon:
        Environment steps to which all are cut; shorter ones are left out, and a warning names them. None cuts nothing:
        compare scores only where `steps` are equal.
    runs, published:
        As for `load`.

    Returns
    -------
    pyarrow.Table
        In all: `task`, `entry` (the label), `name`, `algorithm`, `model`, `source` (`runs`, `published`, or
        `runs and published`), `external`.

        Of entries: `preset`, `tuned`, `seeds`, `epochs`, `steps` (environment steps of each seed), `parameters`
        (trained numbers of an agent), `parameters_quantum`, `parameters_fixed`; means over seeds:
        `steps_below_threshold` (environment steps, mean over the task's thresholds), `steps_lost` (their part after a
        threshold was first reached), `final_score` (of the last tenth of the epochs) and `area` (of all epochs), in
        the unit of the task's scores; `spread_low` and `spread_high`, the 5th and 95th percentile over seeds of steps
        below threshold; sums over seeds: `core_hours`, `executions` (of circuits).

        Of seeds: `seed`, `epochs`, `finished`, `diverged` (the first epoch after which numbers of its agent were not
        finite), and these scores and costs of each. Seeds that are not complete have no scores.

        Of epochs: `seed`, `epoch` (from 1), `steps` (environment steps at its end), `score` (mean of the validation
        after it), and of entries in a results folder `training.NAME`: the algorithm's own metrics, such as
        `training.loss` and `training.return`.

        At last every option, such as `model.width`, `algorithm.lr` and `environment.degree`: null where an entry does
        not have it, or has the default of an option that came later; JSON where it is a list. The schema's metadata
        describe the columns.

    Raises
    ------
    UnknownNameError
        If a task or an entry is unknown, or no entry is left.
    OptionError
        If there are no such rows, or the horizon is no whole number of epochs.
    StoreError
        If there is no results folder, and `published` is false.

    Examples
    --------
    >>> names = ["mlp width=64", "mlp width=16"]
    >>> found = table("entries", "beam6g", entries=names, runs="none-yet", published=True)
    >>> found.select(["model.width", "parameters", "seeds"]).to_pylist()[1]
    {'model.width': 16, 'parameters': 387, 'seeds': 100}
    """
    if rows not in fields.FIELDS:
        raise OptionError(f"rows = {rows!r}: a row is one of the entries, seeds or epochs")
    found, left_out = collect.select(Selection.create(runs, task, published).named(), entries, horizon)
    for line in left_out:
        warnings.warn(f"left out: {line}", stacklevel=2)
    return fields.table(found, rows)


def progress_table(runs: Path, statuses: Sequence[EntryStatus]) -> list[dict[str, Any]]:
    """Return a row of values for each entry of a results folder: its progress, and its row of `table`."""
    results = {}
    if statuses:
        found, _ = collect.collect(Selection.create(runs, [status.entry.task for status in statuses]))
        results = {(row["task"], row["name"]): row for row in fields.table(found, "entries").to_pylist()}
    rows = []
    for status in statuses:
        entry = status.entry
        known = results.get(
            (entry.task, entry.name), {"task": entry.task, "entry": entry.label, "name": entry.name}
        )
        low, high = entry.epochs or (0, 0)
        far = {
            "epochs_least": low,
            "epochs_most": high,
            "bytes": entry.size,
            "last_activity": entry.last_activity,
        }
        rows.append({**{f"seeds_{each}": entry.seeds.get(each, 0) for each in STATUSES}, **far, **known})
    names = dict.fromkeys(name for row in [*results.values(), *rows] for name in row)
    return [{name: row.get(name) for name in names} for row in rows]
