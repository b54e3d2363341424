"""Imports learning curves of other programs as *external* entries.

An external entry has curves alone: nobody here can train it again, evaluate its agents, or check that its seeds are
genuine. Its algorithm is called `external`, so every label shows it, and `imported` in its `entry.json` names the
source.

Curves are brought to a grid of equal steps: the score at a grid point is the last observation at or before it. Nothing
is interpolated, nothing is carried backward, and a curve goes on beyond its last observation only where the user
explains its early end. Entries that were scored in different ways, or whose scales differ tenfold, are not imported.
"""

from __future__ import annotations

import contextlib
import functools
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from qrlsuite import notation
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import FileError, OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import task as tasks
from qrlsuite.experiment.task import EXTERNAL, Scale, Task, TaskFile, digest
from qrlsuite.leaderboard.shelf.curves import require_scores
from qrlsuite.leaderboard.shelf.import_seeds import Imported, unite
from qrlsuite.options import parse_setting
from qrlsuite.results import provenance, run_files
from qrlsuite.results.claims import acquire
from qrlsuite.results.genuine import require_no_link
from qrlsuite.results.points import Points, Run
from qrlsuite.results.records import EntryRecord, ImportedRecord
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import (
    EntryStore,
    SeedStore,
    entries,
)
from qrlsuite.results.text import counted
from qrlsuite.statistics import MIN_RUNS
from qrlsuite.statistics.grid import settled
from qrlsuite.statistics.steps import LEAST_RUNS

GRID_POINTS = 100
"""Points of a grid that is chosen here, at most, up to the end of the longest run."""

_MOST_GRID_POINTS = 100_000
_ALIKE = 0.9
"""Runs that reach this share of the longest are cut to one length."""
_LATE = 0.1
"""Share of the grid's step by which evaluations may be late, if a run has one for each grid point."""
EARLY = {
    "solved": "they stopped because they had learned, so their last score holds",
    "failed": "they crashed or never learned, so they never reach a threshold from there on",
    "cut": "every run is to be cut to the shortest",
}
"""Meanings of runs that end before the others of their entry."""


@dataclass(frozen=True, kw_only=True, config={"extra": "forbid"})
class Options(Scale):
    """Options of an import, see `qrlsuite.import_curves`."""

    early: Literal["solved", "failed", "cut"] | None = None
    units: Literal["same"] | None = None


def import_points(
    points: Mapping[Run, Points], runs: Path, task: str | None, options: Options
) -> list[Imported]:
    """Write curves to a results folder as the seeds of external entries.

    Parameters
    ----------
    points:
        Steps and scores of each run.
    """
    name, early = task or EXTERNAL, options.early
    known = _known_task(name, runs)
    held = entries(runs, known[2]) if known is not None and runs.is_dir() else []
    held = [store for store in held if store.record().imported is not None]
    scales = _scales(points)
    _require_comparable(scales, known[0] if known else None, held, options.units)
    step = known[0].protocol.interactions if known else options.every or _grid_of(points.values())
    points = {run: replace(own, steps=_punctual(own.steps, step)) for run, own in points.items()}
    lengths = _lengths(points, step, early, held)
    instead = "another --task" if known else f"every={max(int(own.steps[0]) for own in points.values())}"
    curves = {run: _on_grid(own, step, lengths[run[0]], run, instead) for run, own in points.items()}
    if known is None:
        _require_reachable(curves, options.thresholds or [], options.goal == "below")
        file = tasks.external(name, options, step, max(lengths.values()), min(lengths.values()))
        definition = Task(file, name).definition
    else:
        file, definition, name = known
        _require_same_options(file, options)
    if early == "failed":
        worst = _worst(curves.values(), file)
        for run, own in points.items():
            curves[run][int(own.steps[-1]) // step :] = worst
    best = options.maximum or file.score.max_return
    scores = {run: _scores(curve, best, file, run, points[run].source, step) for run, curve in curves.items()}
    by_entry: dict[str, dict[int, NDArray[np.float64]]] = defaultdict(dict)
    for (entry, seed), curve in sorted(scores.items()):
        by_entry[entry][seed] = curve
    grid = f"every {step} steps, the last score at or before; nothing interpolated"
    stores = {}
    for entry, of_seeds in by_entry.items():
        told = {"grid": grid, "maximum": best, **scales[entry].content}
        record = _record(entry, name, file, definition, told)
        stores[entry] = EntryStore(runs / name / record.name), record
        _require_no_copies(entry, of_seeds, stores[entry][0])
    return [_write(entry, of_seeds, *stores[entry], points, early) for entry, of_seeds in by_entry.items()]


def _scales(points: Mapping[Run, Points]) -> dict[str, ImportedRecord]:
    """Return how each entry was scored, and its largest score and last step."""
    found = {}
    for entry in sorted({entry for entry, _ in points}):
        runs = [own for (name, _), own in points.items() if name == entry]
        first, *others = sorted({own.metric for own in runs})
        if others:
            _refuse_metrics(f"'{entry}'", first, "in another file", others[0])
        largest = max(float(np.abs(own.scores).max()) for own in runs)
        last = max(int(own.steps[-1]) for own in runs)
        found[entry] = ImportedRecord(metric=first, largest=largest, last_step=last)
    return found


def _refuse_metrics(first: str, metric: str, second: str, other: str) -> NoReturn:
    raise FileError(
        f"the score of {first} is {metric}, {second} {other}: curves of different scores are not compared. Type "
        "metric=NAME with a score that all files have, or import them into another --task NAME"
    )


def _require_comparable(
    scales: Mapping[str, ImportedRecord], file: TaskFile | None, held: Sequence[EntryStore], units: str | None
) -> None:
    """Refuse entries that were scored in different ways, or whose scales differ tenfold."""
    records = [store.record() for store in held]
    before = [(f"'{each.label}', imported before,", each.imported) for each in records if each.imported]
    every = [*((f"'{entry}'", scale) for entry, scale in scales.items()), *before]
    named = [(entry, scale.metric) for entry, scale in every if scale.metric]
    for entry, metric in named:
        if metric != named[0][1]:
            _refuse_metrics(*named[0], f"that of {entry}", metric)
        if metric in run_files.WHILE_TRAINING and file is not None and file.environment.name != EXTERNAL:
            _refuse_metrics(entry, metric, f"that of task '{file.name}'", "a validation without exploration")
    for kind, name in (("score", "largest"), ("step", "last_step")):
        sizes = sorted((size, entry) for entry, scale in every if (size := getattr(scale, name)))
        told = sorted(size for _, scale in before if (size := getattr(scale, name)))
        if not (units or _tenfold(told)) and _tenfold([size for size, _ in sizes]):
            (low, small), (high, large) = sizes[0], sizes[-1]
            raise FileError(
                f"the largest {kind} of {large} is {high:g}, that of {small} {low:g}: if they are in one unit, type "
                "units=same; if not, write one unit in all files"
            )


def _tenfold(sizes: Sequence[float]) -> bool:
    return bool(sizes) and sizes[-1] > 10 * sizes[0]


def _punctual(steps: NDArray[np.int64], every: int) -> NDArray[np.int64]:
    """Return the grid points of a run that has one evaluation for each, some a little late; else its own steps."""
    grid = every * np.arange(1, len(steps) + 1)
    late = steps - grid
    return grid if late.min() >= 0 and late.max() <= _LATE * every else steps


def _lengths(
    points: Mapping[Run, Points], every: int, early: str | None, held: Sequence[EntryStore]
) -> dict[str, int]:
    """Return the grid points of each entry's curves.

    Runs that end with an episode differ a little in length, and are cut to the shortest of their entry. Runs that end
    long before the longest of their entry get its length, or every run is cut to the shortest, as the user says.
    """
    ends: dict[str, dict[int, int]] = defaultdict(dict)
    for (entry, seed), own in points.items():
        ends[entry][seed] = int(own.steps[-1]) // every
    lengths, texts, others = {}, [], {}
    for entry, of_entry in ends.items():
        stored = [store for store in held if store.record().label == f"{EXTERNAL} {entry}"]
        before = {seed: len(store.seed(seed).read().scores) for store in stored for seed in store.seeds()}
        together, least = {**before, **of_entry}, _ALIKE * max([*before.values(), *of_entry.values()])
        lengths[entry] = min(end for end in together.values() if end >= least)
        others[entry] = {end for seed, end in before.items() if seed not in of_entry}
        if short := {seed: end for seed, end in together.items() if end < least}:
            seeds, first = format_seeds(sorted(short)), every * min(short.values())
            texts.append(
                f"seeds {seeds} of '{entry}' from step {first} on, others at {every * lengths[entry]}"
            )
    if texts and early is None:
        choices = "; or ".join(f"early={word} if {meaning}" for word, meaning in EARLY.items())
        raise FileError(f"runs end before the others of their entry: {'; '.join(texts)}. Type {choices}")
    if early == "cut":
        lengths = dict.fromkeys(lengths, min(min(of_entry.values()) for of_entry in ends.values()))
    for entry, length in lengths.items():
        if early is not None and others[entry] - {length}:
            raise FileError(
                f"'{entry}' has runs of another length here: import all of them together, as another --task"
            )
        if length < 1:
            last = min(int(own.steps[-1]) for run, own in points.items() if run[0] == entry)
            raise FileError(
                f"a run of '{entry}' ends at step {last}, before the first grid point: type every={last}"
            )
    return lengths


def _worst(curves: Iterable[NDArray[np.float64]], file: TaskFile) -> float:
    """Return the score of a run that has failed: the worst that there is, which reaches no threshold."""
    if file.ranking.thresholds is None:
        return 0.0
    scores = np.concatenate(list(curves))
    return float(scores.max() if file.score.goal == "below" else scores.min())


def _known_task(name: str, runs: Path) -> tuple[TaskFile, dict[str, Any], str] | None:
    """Return a task's file, its definition and its name: of the suite, or of an entry in the results folder."""
    if tasks.is_known(name):
        loaded = tasks.load(name)
        return loaded.file, loaded.definition, loaded.name
    if runs.is_dir() and "/" not in name and (held := entries(runs, name)):
        record = held[0].record()
        return record.task_file, record.identity.task, record.task_name
    return None


def _grid_of(points: Iterable[Points]) -> int:
    """Return the steps of a grid: the runs' own where all have one, else a round number at which every run has begun.

    It has `GRID_POINTS` or fewer.
    """
    each = list(points)
    own = min(int(one.steps[0]) for one in each)
    if all(np.array_equal(_punctual(one.steps, own), own * np.arange(1, len(one.steps) + 1)) for one in each):
        return own
    least = max(
        *(int(one.steps[0]) for one in each),
        math.ceil(max(int(one.steps[-1]) for one in each) / GRID_POINTS),
        1,
    )
    power = int(10 ** (len(str(least)) - 1))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least)


def _on_grid(own: Points, every: int, length: int, run: Run, instead: str) -> NDArray[np.float64]:
    """Return the scores at the first grid points (T,): each the last at or before it."""
    if length > _MOST_GRID_POINTS:
        raise FileError(
            f"{own.source}: {length:,} grid points: every={math.ceil(length * every / GRID_POINTS)}"
        )
    return own.on_grid(every, length, f"{own.source}: '{run[0]}', seed {run[1]}", instead)


def _require_reachable(
    curves: Mapping[Run, NDArray[np.float64]], thresholds: list[float], below: bool
) -> None:
    """Refuse thresholds that every run has reached from its first point on, as fractions of a maximum of 500 are."""
    firsts = [float(curve[0]) for curve in curves.values()]
    if thresholds and (max(firsts) <= thresholds[0] if below else thresholds[-1] <= min(firsts)):
        low = min(float(curve.min()) if below else float(curve[0]) for curve in curves.values())
        high = max(float(curve.max()) for curve in curves.values())
        raise OptionError(
            f"thresholds={','.join(f'{level:g}' for level in thresholds)}: every run is "
            f"{'below' if below else 'above'} them from its first point on. Write scores as the files have them, which "
            f"lie between {low:g} and {high:g}"
        )


def _require_same_options(file: TaskFile, scale: Scale) -> None:
    ranking, best = file.ranking, file.score.max_return
    unit = 1.0 if ranking.epsilons is None else best or scale.maximum or 1.0
    levels = sorted(unit * level for level in ranking.grid.thresholds)
    given = scale.thresholds or levels
    alike = len(given) == len(levels) and np.allclose(given, levels)
    pairs: dict[str, tuple[object, object]] = {
        "goal": (scale.goal, file.score.goal),
        "every": (scale.every, file.protocol.interactions),
        "thresholds": (None if alike else given, ", ".join(f"{level:g}" for level in levels)),
    }
    if file.environment.name == EXTERNAL or ranking.thresholds is not None:
        pairs["maximum"] = scale.maximum, "none" if best is None else best
    for name, (asked, stands) in pairs.items():
        if asked not in (None, stands):
            value = f"{stands:g}" if isinstance(stands, float) else stands
            raise OptionError(
                f"{name}: task '{file.name}' has {value}; leave it out, or give another --task NAME"
            )


def _scores(
    curve: NDArray[np.float64], best: float | None, file: TaskFile, run: Run, source: str, every: int
) -> NDArray[np.float64]:
    """Return scores in the unit of a task: fractions of the best one where there is one."""
    scores = settled(curve if best is None or file.ranking.thresholds is not None else curve / best)
    try:
        require_scores(scores, file, Path(source))
    except StoreError:
        low, high = float(curve.min()), float(curve.max())
        worst = int(curve.argmin() if low < 0 else curve.argmax())
        top = (
            "1, as the task has it (maximum is what counts as 1)"
            if best is None
            else f"{best:g}, the maximum"
        )
        levels = "thresholds=" + ",".join(f"{part * (best or max(high, 1)):g}" for part in (0.6, 0.75, 0.9))
        raise FileError(
            f"{source}: '{run[0]}', seed {run[1]}: the score at step {every * (worst + 1)} is {curve[worst]:g}, and "
            f"scores are not between 0 and {top}. A new --task takes any scores: leave maximum out, and type {levels}"
        ) from None
    return scores


def _require_no_copies(entry: str, curves: Mapping[int, NDArray[np.float64]], store: EntryStore) -> None:
    """Refuse two seeds with one curve, also of imports before.

    Curves of one or two values are allowed: runs that learn nothing share them.
    """
    first: dict[bytes, int] = {}
    for seed in store.seeds():
        with contextlib.suppress(StoreError):  # a damaged seed is said where it is read
            run = store.seed(seed).read()
            if seed not in curves and len(run.scores):
                first[run.curve.tobytes()] = seed
    for seed, curve in curves.items():
        other = first.setdefault(curve.tobytes(), seed)
        if other != seed and len(np.unique(curve)) > 2:
            raise FileError(
                f"seeds {other} and {seed} of '{entry}' have the same curve: no two runs learn the same by chance; "
                "remove the copy"
            )


def _record(
    entry: str, task: str, file: TaskFile, definition: Mapping[str, Any], told: Mapping[str, Any]
) -> EntryRecord:
    """Return the `entry.json` of an entry."""
    words = _notation_of(entry)
    identity = {
        "task": dict(definition),
        "algorithm": EXTERNAL,
        "algorithm_options": {},
        "model": words[0],
        "model_options": {**words[1], "name": entry},
    }
    content = {
        "name": f"{EXTERNAL}-{words[0]}-{digest(identity)[:8]}",
        "hash": digest(identity),
        "label": f"{EXTERNAL} {entry}",
        "imported": dict(told),
        "preset": None,
        "task_name": task,
        "task_hash": digest(definition),
        "task_file": file.model_dump(mode="json", exclude={"tuning"}),
        "identity": identity,
    }
    return EntryRecord.read(content, f"'{printable(entry)}'")


def _write(
    entry: str,
    curves: Mapping[int, NDArray[np.float64]],
    store: EntryStore,
    record: EntryRecord,
    points: Mapping[Run, Points],
    early: str | None,
) -> Imported:
    require_no_link(store.path.parent, store.path)
    if (store.path / "entry.json").exists():
        before = store.record().maximum
        if before != record.maximum:
            raise OptionError(
                f"maximum: '{entry}' was imported with {before}: seeds of one entry have one scale"
            )
    else:
        store.write_record(record)
    claim = acquire(store, list(curves))
    try:
        new, known, _, notes = unite(
            store,
            printable(points[entry, min(curves)].source),
            {
                seed: (curve, functools.partial(_write_seed, curve, record, points[entry, seed], early))
                for seed, curve in curves.items()
            },
        )
    finally:
        claim.release()
    ends = {
        seed: int(points[entry, seed].steps[-1]) // record.task_file.protocol.interactions for seed in curves
    }
    notes += _notes(entry, len(next(iter(curves.values()))), ends, store.seeds(), record, early)
    return Imported(
        store, record.name, record.label, record.task_name, tuple(new), tuple(known), tuple(notes)
    )


def _write_seed(
    curve: NDArray[np.float64], record: EntryRecord, own: Points, early: str | None, made: SeedStore
) -> None:
    last = int(own.steps[-1])
    origin = {
        "file": printable(own.source),
        "points": len(own.steps),
        "first_step": int(own.steps[0]),
        "last_step": last,
        **({"early": early} if last // record.task_file.protocol.interactions < len(curve) else {}),
    }
    made_with = {"imported_with": provenance.collect([]).versions}
    made.write_curve(record, curve, imported=origin, provenance=[made_with])


def _notation_of(entry: str) -> tuple[str, dict[str, Any]]:
    """Return the model and the options that an entry's name states, as `mlp width=64` does."""
    try:
        words = [word for word in notation.split(entry) if "=" not in word]
        settings = map(parse_setting, (word for word in notation.split(entry) if "=" in word))
        found = {setting.name: setting.value for setting in settings}
    except QrlSuiteError:
        words, found = [entry], {}
    plain = re.sub(r"[^a-z0-9]+", "-", " ".join(words).lower()).strip("-")[:40].rstrip("-")
    finite = {
        name: value for name, value in found.items() if not isinstance(value, float) or math.isfinite(value)
    }
    options = {name: value for name, value in finite.items() if isinstance(value, bool | int | float | str)}
    return plain or "curves", options


def _notes(
    entry: str,
    length: int,
    ends: Mapping[int, int],
    seeds: Sequence[int],
    record: EntryRecord,
    early: str | None,
) -> list[str]:
    """Return notes for the reader: too few seeds, and curves that were cut or go on after their last score."""
    notes, every = [], record.task_file.protocol.interactions
    if max(ends.values()) > length:
        last = max(ends.values()) * every
        notes.append(f"'{entry}': all cut to step {length * every}; the longest goes on to {last}")
    held = [seed for seed, end in ends.items() if end < length]
    if early is not None and held:
        notes.append(f"'{entry}': seeds {format_seeds(held)} end early: {EARLY[early]}")
    if len(seeds) < LEAST_RUNS:
        needed = f"a verdict needs {LEAST_RUNS} of each entry, a rank on a board {MIN_RUNS}"
        notes.append(f"'{entry}' has {counted(len(seeds), 'seed')}: {needed}")
    return notes


def told(done: Sequence[Imported]) -> list[str]:
    """Return the grid and the thresholds of imported entries, in words."""
    record = done[0].store.record()
    file, best = record.task_file, record.maximum
    grid, metric = ("", "") if (own := record.imported) is None else (own.grid, own.metric)
    scale = f"scores over {best:g}; " if best is not None else ""
    levels = ", ".join(f"{level:g}" for level in sorted(file.ranking.grid.thresholds))
    less = f" on {file.score.called}, less is better" if file.score.goal == "below" else ""
    return [
        *([f"score: {printable(metric)}"] if metric not in ("", "score") else []),
        f"grid: {grid}",
        f"{scale}thresholds {levels}{less}; horizon {file.ranking.horizons[0]} steps",
    ]
