"""Imports learning curves of other programs as *external* entries.

An external entry has curves alone: nobody here can train it again, evaluate its agents, or check that its seeds are
genuine. Its algorithm is called `external`, so every label shows it, and `imported` in its `entry.json` names the
source.

Curves are brought to a grid of equal steps: the score at a grid point is the last observation at or before it. Nothing
is interpolated, nothing is carried backward, and no curve goes on beyond its last observation.
"""

from __future__ import annotations

import contextlib
import functools
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
from numpy.typing import NDArray

from qrlsuite import files, notation, registry, specs
from qrlsuite.engine.terminal import printable
from qrlsuite.errors import FileError, OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import task as tasks
from qrlsuite.experiment.entry import EXTERNAL
from qrlsuite.experiment.task import TaskFile, digest
from qrlsuite.leaderboard.shelf.curves import require_scores
from qrlsuite.leaderboard.shelf.import_seeds import Imported, unite
from qrlsuite.options import parse_setting
from qrlsuite.results import provenance
from qrlsuite.results.claims import acquire
from qrlsuite.results.genuine import require_no_link
from qrlsuite.results.points import Points, Run
from qrlsuite.results.records import EntryRecord, RunRecord
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import (
    EntryStore,
    SeedStore,
    entries,
    round_means,
    table_bytes,
    write_atomically,
)
from qrlsuite.results.text import counted
from qrlsuite.statistics import MIN_RUNS
from qrlsuite.statistics.grid import Goal

GRID_POINTS = 100
"""Points of a grid that is chosen here, at most, up to the end of the longest run."""

_MOST_GRID_POINTS = 100_000
_ALIKE = 0.9
"""Runs that reach this share of the longest are cut to one length."""
_EPSILONS, _REFERENCE = [0.1, 0.2, 0.3, 0.4], 0.2
_DELTAS, _DELTA = [0.5, 0.75], 0.5


def import_points(
    points: Mapping[Run, Points],
    runs: Path,
    task: str | None = None,
    maximum: float | None = None,
    thresholds: Sequence[float] = (),
    every: int | None = None,
    goal: Goal | None = None,
    metric: str | None = None,
) -> list[Imported]:
    """Write curves to a results folder as the seeds of external entries.

    Parameters
    ----------
    points:
        Steps and scores of each run.
    task:
        A task of the suite or of the results folder, which fixes the grid and the thresholds; or a new name.
    maximum:
        The best possible score: scores become fractions of it.
    thresholds:
        Thresholds of a new task; by default .6, .7, .8 and .9 of the maximum.
    every:
        Environment steps between two grid points of a new task.
    goal:
        `below` if less is better, for a new task with thresholds; None is `above`.
    metric:
        Name of the score if less is better.

    Returns
    -------
    list
        The imported seeds of each entry.
    """
    given = _require_options(maximum, thresholds, every, goal)
    name = task or EXTERNAL
    known = _known_task(name, runs)
    if known is None:
        step = every or _grid_of(points.values())
        curves = _cut(
            {run: _on_grid(own, step, run, f"every={_first(points)}") for run, own in points.items()}
        )
        _require_reachable(curves, given, goal == "below")
        file = _new_task(name, step, curves, maximum, given, _score_of(goal, metric, maximum))
        definition = _definition(file)
    else:
        file, definition, name = known
        _require_same_options(file, maximum, given, every)
        if goal not in (None, file.score.goal):
            raise OptionError(f"goal={goal}: task '{file.name}' has {file.score.goal}; leave it out")
        step = file.protocol.interactions
        curves = _cut({run: _on_grid(own, step, run, "another --task") for run, own in points.items()})
    best = file.score.max_return if maximum is None else maximum
    scores = {run: _scores(curve, best, file, run, points[run].source) for run, curve in curves.items()}
    by_entry: dict[str, dict[int, NDArray[np.float64]]] = defaultdict(dict)
    for (entry, seed), curve in sorted(scores.items()):
        by_entry[entry][seed] = curve
    told = {
        "grid": f"every {step} steps, the last score at or before; nothing interpolated",
        "maximum": best,
    }
    stores = {}
    for entry, of_seeds in by_entry.items():
        record = _record(entry, name, file, definition, told)
        stores[entry] = EntryStore(runs / name / record.name), record
        _require_no_copies(
            entry, {seed: curves[entry, seed] for seed in of_seeds}, of_seeds, stores[entry][0]
        )
    return [_write(entry, of_seeds, *stores[entry], points) for entry, of_seeds in by_entry.items()]


def _score_of(goal: Goal | None, metric: str | None, maximum: float | None) -> dict[str, Any]:
    """Return the section `[score]` of a new task."""
    if goal != "below":
        return {"source": "return", "max_return": maximum}
    plain = re.sub(r"[^a-z0-9]+", "-", (metric or "score").lower()).strip("-")[:64].rstrip("-")
    return {"metric": plain if specs.NAME.fullmatch(plain) else "score", "goal": "below"}


def _require_options(
    maximum: float | None, thresholds: Sequence[float], every: int | None, goal: Goal | None
) -> list[float]:
    """Return the thresholds, sorted."""
    if maximum is not None and not (math.isfinite(maximum) and maximum > 0):
        raise OptionError(f"maximum={maximum}: give the best possible score, a number above 0")
    if goal not in (None, "above", "below"):
        raise OptionError(f"goal={ascii(goal)[1:-1]}: write above, or below where less is better")
    if goal == "below" and maximum is not None:
        raise OptionError(
            "goal=below: give thresholds=A,B,... in place of maximum, which is the best high score"
        )
    levels = sorted(float(level) for level in thresholds)
    if not all(map(math.isfinite, levels)) or len(set(levels)) < len(levels):
        raise OptionError(f"thresholds={','.join(f'{level:g}' for level in levels)}: give numbers, each once")
    if maximum is not None and levels and not 0 < levels[0] <= levels[-1] <= maximum:
        raise OptionError(f"thresholds: give scores above 0, up to maximum={maximum:g}")
    if every is not None and every < 1:
        raise OptionError(f"every={every}: give a number of environment steps, 1 or more")
    return levels


def _known_task(name: str, runs: Path) -> tuple[TaskFile, dict[str, Any], str] | None:
    """Return a task's file, its definition and its name: of the suite, or of an entry in the results folder."""
    if name.endswith(".toml") or name.startswith("gym:") or name in registry.load().of(specs.TaskSpec):
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
    own = int(each[0].steps[0])
    if all(np.array_equal(one.steps, own * np.arange(1, len(one.steps) + 1)) for one in each):
        return own
    least = max(
        *(int(one.steps[0]) for one in each),
        math.ceil(max(int(one.steps[-1]) for one in each) / GRID_POINTS),
        1,
    )
    power = int(10 ** (len(str(least)) - 1))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least)


def _first(points: Mapping[Run, Points]) -> int:
    """Return the step at which every run has begun."""
    return max(int(own.steps[0]) for own in points.values())


def _on_grid(own: Points, every: int, run: Run, instead: str) -> NDArray[np.float64]:
    """Return the scores at every grid point up to the last observation (T,): each the last at or before it."""
    of_run, last = f"{own.source}: '{run[0]}', seed {run[1]}", int(own.steps[-1])
    if own.steps[0] > every:
        raise FileError(
            f"{of_run} begins at step {own.steps[0]}, after the first grid point at {every}; scores are not carried "
            f"backward: {instead}"
        )
    if last < every:
        raise FileError(f"{of_run} ends at step {last}, before the first grid point at {every}")
    if last // every > _MOST_GRID_POINTS:
        raise FileError(f"{of_run} has {last // every:,} grid points: every={math.ceil(last / GRID_POINTS)}")
    grid = every * np.arange(1, last // every + 1)
    return own.scores[np.searchsorted(own.steps, grid, side="right") - 1]


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


def _cut(curves: Mapping[Run, NDArray[np.float64]]) -> dict[Run, NDArray[np.float64]]:
    """Cut the curves of each entry to the shortest, without curves that end long before the longest.

    Runs that end with an episode differ a little in length, and none should be left out for that.
    """
    ends: dict[str, list[int]] = defaultdict(list)
    for (entry, _), curve in curves.items():
        ends[entry].append(len(curve))
    common = {entry: min(end for end in own if end >= _ALIKE * max(own)) for entry, own in ends.items()}
    return {run: curve[: common[run[0]]] for run, curve in curves.items()}


def _new_task(
    name: str,
    every: int,
    curves: Mapping[Run, NDArray[np.float64]],
    maximum: float | None,
    thresholds: list[float],
    score: Mapping[str, Any],
) -> TaskFile:
    """Return the file of a task that these curves are the first of."""
    if maximum is None and not thresholds:
        raise OptionError(
            f"'{printable(name)}' is a new task: say what a good score is with maximum=BEST (the best possible), "
            "thresholds=A,B,... (scores that count as reached; with goal=below less is better), or --task TASK of the "
            "suite"
        )
    hardest = 0 if score.get("goal") == "below" else -1
    ranking: dict[str, Any] = {
        "thresholds": thresholds,
        "reference": {"threshold": (thresholds or [0])[hardest]},
    }
    if maximum is not None:
        epsilons = [round(1 - level / maximum, 12) for level in reversed(thresholds)] or _EPSILONS
        reference = _REFERENCE if not thresholds else epsilons[0]
        ranking = {"epsilons": epsilons, "reference": {"epsilon": reference}}
    lengths: dict[str, list[int]] = defaultdict(list)
    for (entry, _), curve in curves.items():
        lengths[entry].append(len(curve))
    common = min(sorted(own, reverse=True)[(len(own) - 1) // 2] for own in lengths.values())
    content = {
        "format_version": 1,
        "name": name,
        "summary": "Learning curves that other programs made",
        "environment": {"name": EXTERNAL},
        "protocol": {
            "seeds": MIN_RUNS,
            "epochs": max(map(len, curves.values())),
            "environments": 1,
            "interactions": every,
            "validation_episodes": 1,
        },
        "score": score,
        "ranking": {
            **ranking,
            "reference": {**ranking["reference"], "delta": _DELTA},
            "deltas": _DELTAS,
            "horizons": [common * every],
        },
    }
    try:
        return TaskFile.model_validate(content)
    except pydantic.ValidationError as error:
        raise OptionError(f"--task {printable(name)}: {'; '.join(files.problems(error, TaskFile))}") from None


def _definition(file: TaskFile) -> dict[str, Any]:
    """Return the content of a new task's hash."""
    return {
        "environment": file.environment.name,
        "environment_options": {},
        "environments": file.protocol.environments,
        "interactions": file.protocol.interactions,
        "validation_episodes": file.protocol.validation_episodes,
        "score": file.score.model_dump(mode="json"),
    }


def _require_same_options(
    file: TaskFile, maximum: float | None, thresholds: list[float], every: int | None
) -> None:
    """Refuse options that contradict a task."""
    step, ranking = file.protocol.interactions, file.ranking
    if every not in (None, step):
        raise OptionError(f"every={every}: task '{file.name}' has a grid of {step} steps; leave it out")
    best = file.score.max_return if file.environment.name == EXTERNAL else None
    if best is not None and maximum not in (None, best):
        raise OptionError(
            f"maximum={maximum:g}: task '{file.name}' has {best:g}; give this one another --task NAME"
        )
    if maximum is not None and ranking.thresholds is not None:
        raise OptionError(
            f"maximum={maximum:g}: task '{file.name}' has thresholds on the score itself; leave it out"
        )
    scale = 1.0 if ranking.epsilons is None else file.score.max_return or maximum or 1.0
    own = sorted(scale * level for level in ranking.grid.thresholds)
    if thresholds and not (len(own) == len(thresholds) and np.allclose(own, thresholds)):
        raise OptionError(
            f"thresholds: task '{file.name}' has {', '.join(f'{level:g}' for level in own)}; leave them out"
        )


def _scores(
    curve: NDArray[np.float64], best: float | None, file: TaskFile, run: Run, source: str
) -> NDArray[np.float64]:
    """Return scores in the unit of a task: fractions of the best one where there is one."""
    scores = round_means(curve if best is None or file.ranking.thresholds is not None else curve / best)
    try:
        require_scores(scores, file, Path(source))
    except StoreError:
        low, high = float(curve.min()), float(curve.max())
        of_best = (
            "1, as the task has it (maximum is what counts as 1)"
            if best is None
            else f"{best:g}, the maximum"
        )
        levels = "thresholds=" + ",".join(f"{part * (best or high):g}" for part in (0.6, 0.75, 0.9))
        raise FileError(
            f"{source}: '{run[0]}', seed {run[1]}: scores from {low:g} to {high:g} are not between 0 and {of_best}: "
            f"give a new --task thresholds in place of the maximum, which takes any scores: {levels}"
        ) from None
    return scores


def _require_no_copies(
    entry: str,
    curves: Mapping[int, NDArray[np.float64]],
    scores: Mapping[int, NDArray[np.float64]],
    store: EntryStore,
) -> None:
    """Refuse two seeds with one curve. Curves of one or two values are allowed: runs that learn nothing share them.

    Curves that were imported before count, too; they are stored as scores, in the unit of the task.
    """
    before: dict[bytes, int] = {}
    for seed in store.seeds() if store.path.is_dir() else []:
        with contextlib.suppress(StoreError):  # a damaged seed is said where it is read
            run = store.seed(seed).read()
            if seed not in curves and len(run.scores):
                before[run.curve.tobytes()] = seed
    first: dict[bytes, int] = {}
    for seed, curve in curves.items():
        other = before.get(scores[seed].tobytes(), first.setdefault(curve.tobytes(), seed))
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
) -> Imported:
    """Write the seeds of an entry that are not there yet."""
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
                seed: (curve, functools.partial(_write_seed, curve, record, points[entry, seed]))
                for seed, curve in curves.items()
            },
        )
    finally:
        claim.release()
    lasts = [int(points[entry, seed].steps[-1]) for seed in curves]
    notes += _notes(entry, curves, lasts, store.seeds(), record.task_file.protocol.interactions)
    return Imported(
        store, record.name, record.label, record.task_name, tuple(new), tuple(known), tuple(notes)
    )


def _write_seed(curve: NDArray[np.float64], record: EntryRecord, own: Points, made: SeedStore) -> None:
    made.path.mkdir(parents=True)
    rows = [{"epoch": epoch, "score": float(score)} for epoch, score in enumerate(curve, start=1)]
    write_atomically(made.table, table_bytes(rows))
    made.write_record(
        RunRecord.model_validate(
            {
                "task": record.task_name,
                "task_hash": record.task_hash,
                "entry": record.name,
                "label": record.label,
                "algorithm": EXTERNAL,
                "model": record.identity.model,
                "parameters": {},
                "seed": made.seed,
                "interactions_per_epoch": record.task_file.protocol.interactions,
                "status": "finished",
                "epochs": len(rows),
                "imported": {
                    "file": printable(own.source),
                    "points": len(own.steps),
                    "first_step": int(own.steps[0]),
                    "last_step": int(own.steps[-1]),
                },
                "provenance": [{"imported_with": provenance.collect([]).versions}],
            }
        )
    )


def _notation_of(entry: str) -> tuple[str, dict[str, Any]]:
    """Return the model and the options that an entry's name states, as `mlp width=64` does."""
    try:
        words = [word for word in notation.split(entry) if "=" not in word]
        found = {
            setting.name: setting.value
            for word in notation.split(entry)
            if "=" in word
            for setting in [parse_setting(word)]
        }
    except QrlSuiteError:
        words, found = [entry], {}
    plain = re.sub(r"[^a-z0-9]+", "-", " ".join(words).lower()).strip("-")[:40].rstrip("-")
    kept = {
        name: value for name, value in found.items() if isinstance(value, bool | int | str) or _finite(value)
    }
    return plain or "curves", kept


def _finite(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _notes(
    entry: str,
    curves: Mapping[int, NDArray[np.float64]],
    lasts: Sequence[int],
    seeds: Sequence[int],
    every: int,
) -> list[str]:
    """Return notes for the reader: too few seeds, and runs that end before the others."""
    notes = []
    ends = [last // every for last in lasts]
    if max(ends) > max(map(len, curves.values())):
        end = max(map(len, curves.values())) * every
        notes.append(f"'{entry}': all cut to step {end}; the longest goes on to {max(ends) * every}")
    if len(seeds) < MIN_RUNS:
        notes.append(f"'{entry}' has {counted(len(seeds), 'seed')}: a verdict needs {MIN_RUNS} of each entry")
    longest = max(map(len, curves.values()))
    short = [seed for seed, curve in curves.items() if len(curve) < longest]
    if short:
        least = min(map(len, curves.values()))
        notes.append(
            f"'{entry}': seeds {format_seeds(short)} end before the others, from step {least * every} on (others at "
            f"{longest * every}): a board leaves them out where it goes further"
        )
    return notes


def told(done: Sequence[Imported]) -> list[str]:
    """Return the grid and the thresholds of imported entries, in words."""
    record = done[0].store.record()
    file, best = record.task_file, record.maximum
    grid = "" if record.imported is None else record.imported.grid
    scale = f"scores over {best:g}; " if best is not None else ""
    levels = ", ".join(f"{level:g}" for level in sorted(file.ranking.grid.thresholds))
    less = f" on {file.score.called}, less is better" if file.score.goal == "below" else ""
    return [
        f"grid: {grid}",
        f"{scale}thresholds {levels}{less}; horizon {file.ranking.horizons[0]} steps",
    ]
