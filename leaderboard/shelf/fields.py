"""Results as tables: a row for each entry, each seed or each epoch, with every option as a column.

Columns of options come from the entries' own records: `model.width`, `algorithm.lr`, `environment.degree`. So options
of plugins have columns, too. They cannot collide with other columns, whose names have no dot.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow
from numpy.typing import NDArray

from qrlsuite.columns import flat
from qrlsuite.engine.terminal import printable
from qrlsuite.leaderboard.boards.columns import of_entry, require_new
from qrlsuite.leaderboard.boards.ranked import learning_curves
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.records import MEASURED
from qrlsuite.statistics import areas, final_scores, last_epochs
from qrlsuite.statistics.times import times_below, times_lost

Rows = Literal["entries", "seeds", "epochs"]
"""Kinds of rows of a table."""

SIDES = ("model", "algorithm", "environment")
"""Parts of an entry with options; columns of options are called `SIDE.NAME`."""


@dataclass(frozen=True)
class Field:
    """A column that every table of a kind of rows has.

    Attributes
    ----------
    meaning:
        Explanation for readers of tables.
    unit:
        Unit of its numbers; empty for names, scores, and counts whose name is the unit.
    """

    name: str
    type: pyarrow.DataType
    meaning: str
    unit: str = ""


_TEXT, _WHOLE, _REAL, _TRUTH = pyarrow.string(), pyarrow.int64(), pyarrow.float64(), pyarrow.bool_()
_STEPS = "environment steps"

NAMES = (
    Field("task", _TEXT, "the task"),
    Field("entry", _TEXT, "the entry's label"),
    Field("name", _TEXT, "the entry's name, which ends with digits of its hash"),
    Field("algorithm", _TEXT, "`external` for curves that another program made"),
    Field("model", _TEXT, "the model"),
    Field("source", _TEXT, "where it was read: `runs`, `published`, or `runs and published`"),
    Field("external", _TRUTH, "whether another program made the curves"),
)
SCORES = (
    Field(
        "steps_below_threshold",
        _REAL,
        "mean over the task's thresholds (above them where less is better); what boards rank by",
        _STEPS,
    ),
    Field(
        "steps_lost", _REAL, "those of them after a threshold was first reached: what was forgotten", _STEPS
    ),
    Field("final_score", _REAL, "mean score of the last tenth of the epochs"),
    Field("area", _REAL, "mean score of all epochs"),
    Field("core_hours", _REAL, "of training and validation", "core-hours"),
    Field("executions", _WHOLE, "circuit executions"),
)
FIELDS: dict[Rows, tuple[Field, ...]] = {
    "entries": (
        *NAMES,
        Field("preset", _TEXT, "the preset that supplied defaults"),
        Field("tuned", _TRUTH, "whether its settings are known to come from tuning"),
        Field("seeds", _WHOLE, "complete seeds, over which scores are means and costs are sums"),
        Field("epochs", _WHOLE, "epochs of each"),
        Field("steps", _WHOLE, "environment steps of each seed", _STEPS),
        Field("parameters", _WHOLE, "trained numbers of an agent; null where they are not known"),
        Field("parameters_quantum", _WHOLE, "those of them that belong to circuits"),
        Field("parameters_fixed", _WHOLE, "numbers of an agent that stay as they were drawn"),
        *SCORES,
    ),
    "seeds": (
        *NAMES,
        Field("seed", _WHOLE, "the seed"),
        Field("epochs", _WHOLE, "epochs that it has finished"),
        Field("finished", _TRUTH, "whether these are all that were asked for"),
        Field("diverged", _WHOLE, "first epoch after which numbers of its agent were not finite; else null"),
        *SCORES,
    ),
    "epochs": (
        *NAMES,
        Field("seed", _WHOLE, "the seed"),
        Field("epoch", _WHOLE, "the epoch, from 1"),
        Field("steps", _WHOLE, "environment steps at its end", _STEPS),
        Field("score", _REAL, "mean score of the validation after it"),
    ),
}
"""Columns by the kind of rows; columns of options follow them."""


def table(entries: Sequence[EntryResults], rows: Rows) -> pyarrow.Table:
    """Return entries as a table.

    Returns
    -------
    pyarrow.Table
        The columns are `FIELDS[rows]`, for entries also the ones of `of_entry`, each option, and each metric
        (`measured.NAME`, averaged like the row's score; of epochs `training.NAME`, too); null if an entry lacks it. A
        column of whole and other numbers is float64, a column of numbers and texts is text; lists are JSON.
    """
    make: dict[Rows, Callable[[EntryResults], dict[str, Sequence[Any] | NDArray[Any]]]] = {
        "entries": _of_entry,
        "seeds": _of_seeds,
        "epochs": _of_epochs,
    }
    shared = _shared(entries) if rows == "entries" else {}
    options = {name: values for name, (values, _) in shared.items()} | _option_columns(entries)
    own_metrics = [_metrics(entry, rows) for entry in entries]
    metrics = sorted({name for own in own_metrics for name in own})
    fields = FIELDS[rows]
    schema = pyarrow.schema(
        [
            pyarrow.field(each.name, each.type, metadata={"meaning": each.meaning, "unit": each.unit})
            for each in fields
        ]
        + [pyarrow.field(name, values.type, metadata=meta) for name, (values, meta) in shared.items()]
        + [pyarrow.field(name, values.type) for name, values in options.items() if name not in shared]
        + [pyarrow.field(name, _REAL) for name in metrics]
    )
    parts = []
    for place, entry in enumerate(entries):
        own = make[rows](entry)
        count = max(map(len, own.values()))
        named = {name: pyarrow.repeat(pyarrow.scalar(value), count) for name, value in _names(entry).items()}
        columns = [
            named[each.name] if each.name in named else pyarrow.array(own[each.name], each.type)
            for each in fields
        ]
        columns += [pyarrow.repeat(column[place], count) for column in options.values()]
        columns += [_metric(entry, own_metrics[place].get(name), rows) for name in metrics]
        parts.append(pyarrow.table(columns, schema=schema))
    return pyarrow.concat_tables(parts) if parts else schema.empty_table()


def _shared(entries: Sequence[EntryResults]) -> dict[str, tuple[pyarrow.Array, dict[str, str]]]:
    """Return the columns that boards have, too, with a value for each entry, and what the schema says of them."""
    types = {float: _REAL, int: _WHOLE, str: _TEXT, bool: _TRUTH}
    found = {}
    beside = of_entry()[1:]
    require_new(beside, {field.name for field in FIELDS["entries"]})
    for each in beside:
        rows = [flat([each], entry) for entry in entries]
        for name in each.heads:
            values = [row[name] for row in rows]
            array = pyarrow.array(values, types[each.type]) if each.type else column(values)
            found[name] = array, {"meaning": each.meaning, "unit": each.unit}
    return found


def _metrics(entry: EntryResults, rows: Rows) -> dict[str, NDArray[np.float64]]:
    """Return metrics of the environment by column, and in rows of epochs the metrics of training."""
    training = entry.training if rows == "epochs" else {}
    of_training = {f"training.{name}": values for name, values in training.items()}
    return {**of_training, **{f"{MEASURED}.{name}": values for name, values in entry.metrics.items()}}


def _metric(entry: EntryResults, found: NDArray[np.float64] | None, rows: Rows) -> pyarrow.Array:
    """Return a metric of an entry: of every epoch, of every seed over its last tenth, or the mean over seeds."""
    values = np.full(entry.curves.shape, np.nan) if found is None else found
    if rows == "epochs":
        return pyarrow.array(values.ravel(), _REAL, from_pandas=True)
    last = values[:, -last_epochs(values.shape[1]) :].mean(axis=1)
    shown = [*last.tolist(), *[math.nan] * len(entry.left_out)] if rows == "seeds" else [float(last.mean())]
    return pyarrow.array(np.array(shown), _REAL, from_pandas=True)


def options_of(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return every option that an entry's identity states, by the name of its column."""
    task = identity.get("task")
    tables = {
        "model": identity.get("model_options"),
        "algorithm": identity.get("algorithm_options"),
        "environment": task.get("environment_options") if isinstance(task, Mapping) else None,
    }
    found: dict[str, Any] = {}
    for side in SIDES:
        _flatten(side, tables[side], found)
    return found


def _flatten(prefix: str, values: object, found: dict[str, Any]) -> None:
    for name, value in values.items() if isinstance(values, Mapping) else ():
        if isinstance(value, Mapping):
            _flatten(f"{prefix}.{name}", value, found)
        else:
            found[printable(f"{prefix}.{name}")] = value


def _option_columns(entries: Sequence[EntryResults]) -> dict[str, pyarrow.Array]:
    each = [options_of(entry.identity) for entry in entries]
    names = sorted(
        {name for own in each for name in own}, key=lambda name: (SIDES.index(name.partition(".")[0]), name)
    )
    return {name: column([own.get(name) for own in each]) for name in names}


def column(values: Sequence[Any]) -> pyarrow.Array:
    """Return plain values of any types as a column of one."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return pyarrow.array(values, _TRUTH)
    if kinds <= {int, float} and all(value is None or abs(value) < 2**63 for value in values):
        return pyarrow.array(values, _REAL if float in kinds else _WHOLE)
    texts = [
        None if value is None else printable(value) if isinstance(value, str) else json.dumps(value)
        for value in values
    ]
    return pyarrow.array(texts, _TEXT)


def _names(entry: EntryResults) -> dict[str, Any]:
    return {
        "task": printable(entry.task),
        "entry": printable(entry.label),
        "name": printable(entry.name),
        "algorithm": printable(entry.algorithm),
        "model": printable(entry.model),
        "source": entry.source,
        "external": entry.external,
    }


def _scores(entry: EntryResults) -> dict[str, NDArray[np.float64]]:
    """Return the scores of each seed, (N,)."""
    curves, grid = learning_curves(entry), entry.task_file.ranking.grid
    return {
        "steps_below_threshold": times_below(entry.curves, grid, entry.steps_per_epoch).mean(axis=1),
        "steps_lost": times_lost(entry.curves, grid, entry.steps_per_epoch).mean(axis=1),
        "final_score": final_scores(curves),
        "area": areas(curves),
    }


def _of_entry(entry: EntryResults) -> dict[str, Sequence[Any] | NDArray[Any]]:
    classical, quantum = entry.parameters
    known = entry.parameters_text() != "-"
    epochs = int(entry.curves.shape[1])
    row = {
        "preset": None if entry.preset is None else printable(entry.preset),
        "tuned": entry.tuning is not None,
        "seeds": len(entry.seeds),
        "epochs": epochs,
        "steps": epochs * entry.steps_per_epoch,
        "parameters": classical + quantum if known else None,
        "parameters_quantum": quantum if known else None,
        "parameters_fixed": entry.fixed if known else None,
        "core_hours": _cost(entry, entry.hours),
        "executions": _cost(entry, entry.executions),
        **{name: float(values.mean()) for name, values in _scores(entry).items()},
    }
    return {name: [value] for name, value in row.items()}


def _cost(entry: EntryResults, value: Any) -> Any:
    """Return a cost, None where the entry's record cannot say it."""
    return None if entry.external and not value else value


def _of_seeds(entry: EntryResults) -> dict[str, Sequence[Any] | NDArray[Any]]:
    """Return the complete seeds, and the left-out seeds without scores."""
    seeds = [*entry.seeds, *entry.left_out]
    records = [entry.records[seed] for seed in seeds]
    lacking = [None] * len(entry.left_out)
    return {
        "seed": seeds,
        "epochs": [record.epochs for record in records],
        "finished": [record.finished for record in records],
        "diverged": [record.diverged for record in records],
        "core_hours": [_cost(entry, record.hours) for record in records],
        "executions": [_cost(entry, record.executions) for record in records],
        **{name: [*values.tolist(), *lacking] for name, values in _scores(entry).items()},
    }


def _of_epochs(entry: EntryResults) -> dict[str, Sequence[Any] | NDArray[Any]]:
    count, epochs = entry.curves.shape
    epoch = np.tile(np.arange(1, epochs + 1), count)
    return {
        "seed": np.repeat(np.array(entry.seeds, np.int64), epochs),
        "epoch": epoch,
        "steps": epoch * entry.steps_per_epoch,
        "score": entry.curves.ravel(),
    }
