"""Points of learning curves that other programs wrote: csv files, tables, arrays, and the files of `run_files`.

Points are the environment steps and scores of the runs of entries. A csv file or a table names entry and seed in every
row. Other files hold one run, named by the path: the run's number is the seed, and the words that differ between paths
are the entry. `logs/small/seed-3/evaluations.npz` is seed 3 of `small`.
"""

from __future__ import annotations

import array
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import ArrayLike, NDArray

from qrlsuite.errors import FileError, OptionError, listed
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results import run_files
from qrlsuite.results.genuine import require_plain
from qrlsuite.results.run_files import MOST_POINTS, table_of, whole

COLUMNS = ("entry", "seed", "step", "score")
"""Columns of a csv file or a table."""

EPISODES = ("episode", "episodes")

NAMES: dict[str, tuple[tuple[str, ...], ...]] = {
    "seed": (("seed",), ("run", "run_id", "trial")),
    "entry": (
        ("entry",),
        ("group",),
        ("exp_name",),
        ("model", "algorithm", "algo", "agent"),
        ("name", "run_name", "run"),
    ),
    "step": (
        ("step",),
        (
            "steps",
            "timestep",
            "timesteps",
            "total_timesteps",
            "time/total_timesteps",
            "env_step",
            "env_steps",
            "global_step",
        ),
        EPISODES,
    ),
    "score": (("score",), *((name,) for name in run_files.METRICS)),
}
"""Names of these columns in lower case, ours and other programs'. The first tuple of which a name is there counts."""

Run = tuple[str, int]
"""An entry's name and a seed."""

_LONGEST_NAME = 80


@dataclass(frozen=True)
class Points:
    """The observed points of one run.

    Attributes
    ----------
    steps:
        (K,) int64: environment steps since training began, increasing, 1 or more.
    scores:
        (K,) float64, finite.
    metric:
        Name of the score, such as `eval/mean_reward`; empty if unknown.
    """

    steps: NDArray[np.int64]
    scores: NDArray[np.float64]
    source: str
    metric: str = ""

    def on_grid(self, every: int, length: int, run: str, cure: str) -> NDArray[np.float64]:
        """Return the scores at the first grid points (length,): each the last at or before it."""
        if self.steps[0] > every:
            raise FileError(
                f"{run} begins at step {self.steps[0]}, after the first grid point at {every}; scores are not carried "
                f"backward: {cure}"
            )
        grid = every * np.arange(1, length + 1)
        return self.scores[np.searchsorted(self.steps, grid, side="right") - 1]


class _Rows:
    """Collects points of runs, and refuses points that make no curve."""

    def __init__(self) -> None:
        self._runs: dict[Run, tuple[array.array[int], array.array[float], str, str]] = {}
        self._count = 0

    def add(self, entry: str, seed: int, step: int, score: float, source: str, metric: str = "") -> None:
        if not math.isfinite(score):
            raise FileError(
                f"{source}: the score of '{ascii(entry)[1:-1]}', seed {seed}, at step {step} is {score}: every score "
                "is a finite number; where training failed, write the score that its agent had"
            )
        self._count += 1
        if self._count > MOST_POINTS:
            raise FileError(f"{source}: more than {MOST_POINTS:,} points: import fewer files at once")
        if (entry, seed) not in self._runs:
            _require_run(entry, seed, source)
            self._runs[entry, seed] = array.array("q"), array.array("d"), source, metric
        steps, scores, *_ = self._runs[entry, seed]
        steps.append(step)
        scores.append(score)

    def points(self) -> dict[Run, Points]:
        """Return the points of every run; one at step 0, before training, is left out."""
        found = {}
        for (entry, seed), (steps, scores, source, metric) in self._runs.items():
            at, values = np.array(steps, np.int64), np.array(scores, np.float64)
            _require_increasing(at, f"{source}: '{entry}', seed {seed}")
            if at[-1] > 0:
                found[entry, seed] = Points(at[at > 0], values[at > 0], source, metric)
        if not found:
            raise FileError("there is no score after step 0: nothing was imported")
        return found


def _require_increasing(steps: NDArray[np.int64], run: str) -> None:
    if steps[0] < 0:
        raise FileError(f"{run}: step {steps[0]} is negative")
    wrong = np.flatnonzero(np.diff(steps) <= 0)
    if not len(wrong):
        return
    before, after = steps[wrong[0]], steps[wrong[0] + 1]
    if after in steps[: wrong[0] + 1]:
        raise FileError(f"{run}: step {after} is there twice: give every run a seed of its own")
    raise FileError(
        f"{run}: step {after} follows step {before}: steps count from the beginning of training, so sort the rows"
    )


def _require_run(entry: str, seed: int, source: str) -> None:
    """Refuse names that cannot be an entry's, and numbers that cannot be a seed's."""
    if not entry or len(entry) > _LONGEST_NAME or not entry.isprintable() or {"/", "\\"} & set(entry):
        raise FileError(
            f"{source}: entry {ascii(entry)[:100]}: a name is one line of 1 to {_LONGEST_NAME} characters, without "
            "slashes"
        )
    require_plain(source, entry)
    if not 0 <= seed < TUNING_SEEDS:
        raise FileError(
            f"{source}: seed {seed} of '{entry}': number the runs of an entry 0, 1, 2, ..., below {TUNING_SEEDS:,}"
        )


def read_files(paths: Sequence[Path], metric: str | None = None) -> dict[Run, Points]:
    """Read files of one or several kinds.

    Parameters
    ----------
    metric:
        Name of the score: a column of csv files, or a scalar of TensorBoard; by default `score`, or the first of
        `run_files.METRICS` in the file.

    Returns
    -------
    dict
        The points of each run.
    """
    rows, of_runs = _Rows(), list[Path]()
    for path in dict.fromkeys(paths):
        if run_files.holds_one_run(path) or _names_no_run(path):
            of_runs.append(path)
        else:
            _read_csv(path, rows, metric)
    for (entry, seed), files in _named(_by_words(of_runs)).items():
        name, curve = _curve_of(files, metric)
        for step, score in curve:
            rows.add(entry, seed, step, score, str(files[0]), name)
    return rows.points()


def read_run(paths: Sequence[Path], metric: str | None = None) -> Points:
    """Read the files of one run, whose entry and seed are known."""
    rows = _Rows()
    name, curve = _curve_of(paths, metric)
    for step, score in curve:
        rows.add("run", 0, step, score, str(paths[0]), name)
    return next(iter(rows.points().values()))


def _curve_of(paths: Sequence[Path], metric: str | None) -> tuple[str, run_files.Curve]:
    """Return the score's name and the curve of the files of one run; of a csv file, the columns of step and score.

    Of several scores at one step, as lanes write them whose episodes end at once, the last counts. Rows of other
    metrics lack the score.
    """
    if run_files.holds_one_run(paths[0]):
        name, curve = run_files.read(paths, metric)
        return name, dict(curve).items()
    if len(paths) > 1:
        raise FileError(f"{paths[0]} and {paths[1]} are of one run by their paths: name one of them")
    names, content = table_of(paths[0])
    columns = _columns(names, metric, str(paths[0]), COLUMNS[2:])
    (time, value), at = map(names.index, columns), dict[int, float]()
    for line, cells in content:
        try:
            if cells[value].strip() or columns[1] == "score":
                at[whole(cells[time])] = float(cells[value])
        except (ValueError, IndexError, OverflowError):
            row = ",".join(cells)[:80]
            raise FileError(f"{paths[0]}, line {line}: no step and score: {row!a}") from None
    return _measure(columns), at.items()


def _names_no_run(path: Path) -> bool:
    """Return whether a csv file has steps, and no column of entries or seeds: its path names its run."""
    names, _ = table_of(path)
    named = _column("entry", names) or _column("seed", names) or _charts(names, None)
    return bool(_column("step", names)) and not named


def _read_csv(path: Path, rows: _Rows, metric: str | None) -> None:
    names, content = table_of(path)
    wide = _charts(names, metric)
    wanted = _columns(names, metric, str(path)) if not wide else [_column("step", names)[0]]
    places = [names.index(name) for name in wanted]
    for line, cells in content:
        if len(cells) != len(names):
            raise FileError(f"{path}, line {line}: {len(cells)} cells, and {len(names)} in the first line")
        values, where = [cells[place].strip() for place in places], f"line {line}"
        for place, (entry, seed, name) in wide.items():
            if score := cells[place].strip():
                _add_row(rows, [entry, seed, *values, score], str(path), where, name)
        if not wide and (values[3] or wanted[3] == "score"):  # rows of other metrics lack the score
            _add_row(rows, values, str(path), where, _measure(wanted))


_CHART = re.compile(r"(.+) - ([^ ]+)")


def _charts(names: Sequence[str], metric: str | None) -> dict[int, tuple[str, int, str]]:
    """Return the columns of a chart that W&B exports, `RUN - METRIC`: place -> (entry, seed, metric); else nothing."""
    found = {place: match for place, name in enumerate(names) if (match := _CHART.fullmatch(name))}
    wanted = (metric,) if metric is not None else run_files.METRICS
    charted = next((each for each in wanted if each in {match[2] for match in found.values()}), None)
    if charted is None or len(_column("step", names)) != 1:
        return {}
    runs: dict[tuple[str, ...], list[Path]] = {
        (match[1],): [Path(str(place))] for place, match in found.items() if match[2] == charted
    }
    return {int(str(place)): (*run, charted) for run, [place] in _named(runs).items()}


def read_table(table: Any, metric: str | None = None) -> dict[Run, Points]:
    """Read an Arrow table or a data frame with the columns entry, seed, step and score.

    Parameters
    ----------
    table:
        Anything that `pyarrow.table` takes: a table, a data frame of pandas or polars.
    """
    try:
        arrow = table if isinstance(table, pyarrow.Table) else pyarrow.table(table)
    except (TypeError, ValueError, pyarrow.ArrowException):
        raise OptionError(
            f"curves of type {type(table).__name__}: give files, {{entry: (seeds, points)}}, an Arrow table or a data "
            "frame"
        ) from None
    wanted, rows, number = _columns(arrow.column_names, metric, "the table"), _Rows(), 0
    for batch in arrow.select(wanted).to_batches(max_chunksize=100_000):
        for values in zip(*(column.to_pylist() for column in batch.columns)):
            number += 1
            _add_row(rows, values, "the table", f"row {number}", _measure(wanted))
    return rows.points()


def read_arrays(curves: Mapping[str, tuple[Iterable[int], ArrayLike]], steps: ArrayLike) -> dict[Run, Points]:
    """Read arrays: by entry (N,) seeds and (N, K) scores.

    Parameters
    ----------
    steps:
        (K,) environment steps of the scores.
    """
    at, rows = np.asarray(steps), _Rows()
    if at.ndim != 1 or at.dtype.kind not in "iu":
        raise OptionError(f"steps: give whole numbers of shape (points,), not {at.dtype} of shape {at.shape}")
    for entry, content in curves.items():
        try:
            numbers, points = content
            seeds, scores = (
                [whole(seed) for seed in np.asarray(numbers).tolist()],
                np.asarray(points, np.float64),
            )
        except (TypeError, ValueError) as error:
            raise OptionError(f"curves[{entry!r}]: give (seeds, points): {error}") from None
        if scores.shape != (len(seeds), len(at)):
            raise OptionError(
                f"curves[{entry!r}]: points of shape {scores.shape}, and {len(seeds)} seeds at {len(at)} steps have "
                f"({len(seeds)}, {len(at)})"
            )
        for seed, curve in zip(seeds, scores.tolist()):
            for step, score in zip(at.tolist(), curve):
                rows.add(str(entry), seed, step, score, f"curves[{entry!r}]")
    return rows.points()


def _column(column: str, names: Sequence[str], but: Sequence[str] = ()) -> list[str]:
    """Return the names that may be a column's: one, if it is clear which."""
    levels = (
        [name for name in names if name.lower() in level and name not in but] for level in NAMES[column]
    )
    return next(filter(None, levels), [])


def _columns(
    names: Sequence[str], metric: str | None, source: str, wanted: Sequence[str] = COLUMNS
) -> list[str]:
    found: dict[str, str] = {}
    wrong, several = list[str](), list[str]()
    for column in (column for column in NAMES if column in wanted):
        own = metric is not None and column == "score"
        alike = (
            [name for name in names if name == metric] if own else _column(column, names, [*found.values()])
        )
        if len(alike) != 1:
            wrong.append(column)
            several += alike
        if alike:
            found[column] = alike[0]
    if wrong:
        here = listed([ascii(name)[1:-1][:40] for name in names]) or "none"
        others = [ascii(name)[1:-1][:40] for name in names if name not in found.values()]
        other = (
            f"; type metric=NAME, where NAME is the score: {listed(others)}"
            if others and wrong == ["score"]
            else ""
        )
        which = f"; rename all of {', '.join(several)} but one" if len(set(several)) > 1 else ""
        expected = ", ".join((*wanted[:-1], metric or COLUMNS[3]))
        raise FileError(f"{source}: expected the columns {expected}, each once; found {here}{which}{other}")
    return [found[column] for column in wanted]


def _measure(columns: Sequence[str]) -> str:
    """Name what curves measure: the column of the score, and of steps where these are episodes."""
    *_, step, score = columns
    return f"{score} by {step}" if step.lower() in EPISODES else score


def _add_row(rows: _Rows, values: Sequence[Any], source: str, place: str, metric: str) -> None:
    for name, value in zip(COLUMNS, values):
        if value is None or value == "":
            raise FileError(
                f"{source}, {place}: no {name}: every row has an entry, a seed, a step and a score"
            )
    entry, seed, step, score = values
    try:
        numbers = whole(seed), whole(step), float(score)
    except (ValueError, TypeError, OverflowError):
        texts = ", ".join(ascii(value)[:30] for value in values)
        raise FileError(
            f"{source}, {place}: {texts}: seed and step are whole numbers, and the score is a number"
        ) from None
    # CleanRL's run ends with its seed and the second when it began.
    name = re.sub(rf"__{numbers[0]}__\d{{9,}}$", "", str(entry).strip())
    rows.add(name, *numbers, source, metric)


_SEED = re.compile(
    r".*(?<![a-z])seed[-_ =]*(?P<named>\d+)(?!\d).*|.+__(?P<cleanrl>\d+)__\d{9,}|.*?(?P<last>\d+)",
    re.IGNORECASE | re.DOTALL,
)
"""A run's name with its seed; CleanRL's names are `ENVIRONMENT__NAME__SEED__TIME`."""
_BEFORE = re.compile(r"[-_ =.]*(seed|run)?[-_ =.]*$", re.IGNORECASE)


def _by_words(paths: Sequence[Path]) -> dict[tuple[str, ...], list[Path]]:
    """Return files by the words that name their run."""
    of_folders: dict[tuple[str, ...], list[Path]] = defaultdict(list)
    for path in paths:
        of_folders[run_files.words(path)].append(path)
    return of_folders


def _named(of_folders: Mapping[tuple[str, ...], list[Path]]) -> dict[Run, list[Path]]:
    words_of: dict[tuple[str, ...], tuple[list[str], int]] = {}
    for key, files in of_folders.items():
        *above, run = key
        found = _SEED.fullmatch(run)
        if found is None:
            raise FileError(
                f"{files[0]}: which seed is '{ascii(run)[1:-1]}'? Call the folders of runs ENTRY/seed-0, ENTRY/seed-1, "
                f"..., or write a csv file with the columns {','.join(COLUMNS)}"
            )
        group = found.lastgroup or 0
        words_of[key] = [*above, _BEFORE.sub("", run[: found.start(group)])], int(found[group])
    return _by_difference(of_folders, words_of)


def _by_difference(
    files: Mapping[tuple[str, ...], list[Path]], words_of: Mapping[tuple[str, ...], tuple[list[str], int]]
) -> dict[Run, list[Path]]:
    """Name entries by the words that differ between runs, or by the last word of all."""
    longest = max((len(words) for words, _ in words_of.values()), default=0)
    padded = {key: [""] * (longest - len(words)) + words for key, (words, _) in words_of.items()}
    differing = [place for place, words in enumerate(zip(*padded.values())) if len(set(words)) > 1]
    found: dict[Run, list[Path]] = {}
    for key, words in padded.items():
        own = [words[place] for place in differing if words[place]] or [word for word in words if word][-1:]
        run = " ".join(own), words_of[key][1]
        if run in found:
            raise FileError(
                f"{found[run][0]} and {files[key][0]} are both seed {run[1]} of '{run[0]}' by their paths"
            )
        found[run] = files[key]
    return found
