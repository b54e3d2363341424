"""Files that hold the learning curve of one run: of Stable-Baselines3 and TensorBoard.

No file is unpickled, and how much one may hold is bounded before it is read.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import itertools
import json
import math
import shlex
import stat
import zipfile
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import FileError, listed

EVALUATED, TRAINED = "eval/mean_reward", "rollout/ep_rew_mean"
METRICS = ("validation/score", EVALUATED, TRAINED, "charts/episodic_return", "score")
"""Names of the score in this suite's trackers, in Stable-Baselines3's evaluations and training, and in CleanRL. If the
user names no scalar, the first of these names in a file is read."""

WHILE_TRAINING = (TRAINED, "charts/episodic_return")
"""Returns of agents that still explore, which are not compared with scores of validations."""

MOST_BYTES = 1_000_000_000
"""Bytes of a file that is read at once, packed or unpacked, at most."""

MOST_POINTS = 20_000_000
"""Points of one import, at most."""

WINDOW = 100
"""Episodes over which training returns are averaged, as Stable-Baselines3 does (`stats_window_size`)."""

_LONGEST_LINE = 1_000_000

_CURVES = "evaluations.npz", "*monitor.csv", "*.tfevents.*", "*.csv"
_MOST_PATHS = 100_000

Curve = Iterable[tuple[int, float]]
"""Environment steps and scores, in order."""


def below(folder: Path) -> str:
    """Return the command that imports the curves of other programs below a folder; empty if there are none."""
    paths = [path.relative_to(folder) for path in itertools.islice(folder.rglob("*"), _MOST_PATHS)]
    shown = [path for path in paths if not any(part.startswith(".") for part in path.parts)]
    for name in _CURVES:
        depths = Counter(len(path.parts) for path in shown if path.match(name) and (folder / path).is_file())
        if depths:
            [(depth, count)] = depths.most_common(1)
            files = "/".join([shlex.quote(str(folder)), *["*"] * (depth - 1), name])
            return (
                f"{folder} holds {count} {name}: qrlsuite import {files} maximum=500, where 500 stands for the best "
                "possible score"
            )
    return ""


def holds_one_run(path: Path) -> bool:
    """Return whether a file holds one run; a csv file may hold many."""
    try:
        if path.is_dir():
            raise FileError(
                below(path)
                or f"{path} holds no entry of this suite; to import curves that other programs wrote, name their "
                f"files, such as {path}/*/*/evaluations.npz"
            )
        status = path.stat()
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from None
    if not stat.S_ISREG(status.st_mode):
        raise FileError(f"{path} cannot be read: not a regular file")
    if status.st_size > MOST_BYTES and _kind(path) is not _tensorboard:  # which is read bit by bit
        raise FileError(f"{path}: larger than {MOST_BYTES // 10**6} MB")
    if _kind(path) is not None:
        return True
    if not path.name.endswith(".csv"):
        raise FileError(
            f"{path}: give a csv file with the columns entry,seed,step,score; evaluations.npz, monitor.csv or "
            "progress.csv of Stable-Baselines3; or events.out.tfevents.* of TensorBoard"
        )
    return False


def words(path: Path) -> tuple[str, ...]:
    """Return the words that name the run of a file: words that may name its entry, and last the run's own name.

    The words are the folders of the path. The last folder names the run, unless the file itself does: an npz file with
    a name of its own, or a csv file whose columns no program fixes.
    """
    place = path.absolute()
    fixed = path.name in ("evaluations.npz", "progress.csv")
    named_by_itself = not fixed and _kind(path) in (None, _evaluations)
    run = place.with_suffix("") if named_by_itself else place.parent
    return (*run.parent.parts[1:], run.name)


def read(paths: Sequence[Path], metric: str | None = None) -> tuple[str, Curve]:
    """Read the files of one run: the name of the score, and its curve.

    Parameters
    ----------
    metric:
        The scalar of TensorBoard that is the score.
    """
    kinds = {_kind(path) for path in paths}
    reader = _kind(paths[0])
    if len(kinds) > 1 or reader is None or (reader is _evaluations and len(paths) > 1):
        names = listed([path.name for path in paths])
        raise FileError(f"{paths[0].parent}: {names} are of one run: name one of them")
    only = TRAINED if reader is _monitor else EVALUATED if reader is _evaluations else metric
    if metric not in (None, only):
        raise FileError(f"{paths[0]}: metric={metric}: {paths[0].name} has one score, {only}")
    return reader(paths, metric)


def _kind(path: Path) -> Callable[[Sequence[Path], str | None], tuple[str, Curve]] | None:
    """Return the reader of a file of one run, None for any other file."""
    name = path.name
    if ".tfevents." in name:
        return _tensorboard
    if name.endswith(".npz"):
        return _evaluations
    return _monitor if name == "monitor.csv" or name.endswith(".monitor.csv") else None


def whole(value: Any) -> int:
    """Return a whole number, also of text such as 1000 or 1000.0."""
    number = value if isinstance(value, int) and not isinstance(value, bool) else float(value)
    if not math.isfinite(number) or number != int(number) or abs(number) >= 2**53:
        raise ValueError(f"{value!r} is not a whole number")
    return int(number)


def lines_of(path: Path) -> Iterator[str]:
    """Yield the lines of a text file."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            while line := file.readline(_LONGEST_LINE):
                if len(line) == _LONGEST_LINE:
                    raise FileError(f"{path}: a line of it has {_LONGEST_LINE:,} characters or more")
                yield line
    except UnicodeDecodeError:
        raise FileError(f"{path} is not text (UTF-8)") from None
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from None


def table_of(
    path: Path, lines: Iterable[str] | None = None
) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Return the names in the first line of a csv file, and the number and the cells of each further one."""
    content = _cells_of(path, lines_of(path) if lines is None else lines)
    _, names = next(content, (0, list[str]()))
    return [name.strip() for name in names], content


def _cells_of(path: Path, lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of every line that is not empty."""
    reader = csv.reader(lines)
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    except csv.Error as error:
        raise FileError(f"{path}, line {reader.line_num}: {error}") from None


def _monitor(paths: Sequence[Path], metric: str | None) -> tuple[str, Curve]:
    return TRAINED, _recent(paths)


def _recent(paths: Sequence[Path]) -> Curve:
    """Yield the mean return of the last episodes at the end of each; episodes of several environments by their time."""
    episodes = [episode for path in paths for episode in _episodes(path)]
    episodes.sort(key=lambda episode: episode[0])  # stable: those of one environment keep their order
    recent: deque[float] = deque(maxlen=WINDOW)
    steps = 0
    for _, length, reward in episodes:
        steps += length
        recent.append(reward)
        yield steps, math.fsum(recent) / len(recent)


def _episodes(path: Path) -> Iterator[tuple[float, int, float]]:
    """Yield the end, the length and the return of every episode of a monitor file."""
    lines = lines_of(path)
    try:
        started = float(json.loads(next(lines, "").removeprefix("#"))["t_start"])
    except (ValueError, TypeError, KeyError, RecursionError):
        raise FileError(f'{path}: a monitor file begins with #{{"t_start": ...}}') from None
    names, content = table_of(path, lines)
    if not {"r", "l", "t"} <= set(names):
        raise FileError(
            f"{path}: expected the columns r, l, t; found {listed([ascii(n)[1:-1] for n in names]) or 'none'}"
        )
    for line, cells in content:
        try:
            reward, length, time = (cells[names.index(name)] for name in "rlt")
            episode = started + float(time), whole(length), float(reward)
        except (ValueError, IndexError, OverflowError):
            raise FileError(
                f"{path}, line {line + 1}: not an episode: {ascii(','.join(cells))[:80]}"
            ) from None
        if episode[1] < 1:
            raise FileError(f"{path}, line {line + 1}: an episode of {episode[1]} steps")
        yield episode


def _evaluations(paths: Sequence[Path], metric: str | None) -> tuple[str, Curve]:
    path = paths[0]
    steps, results = (_npz_array(path, name) for name in ("timesteps", "results"))
    if steps.ndim != 1 or results.ndim != 2 or len(results) != len(steps) or not results.shape[1]:
        raise FileError(
            f"{path}: timesteps of shape {steps.shape} and results of shape {results.shape}; expected (evaluations,) "
            "and (evaluations, episodes)"
        )
    if steps.dtype.kind not in "iu" or results.dtype.kind not in "iuf":
        raise FileError(f"{path}: timesteps are {steps.dtype} and results {results.dtype}; expected numbers")
    return EVALUATED, zip(steps.tolist(), results.astype(np.float64).mean(axis=1).tolist())


def _npz_array(path: Path, name: str) -> NDArray[Any]:
    """Return an array of an npz file; its size is known before it is unpacked."""
    try:
        with zipfile.ZipFile(path) as archive:
            here = archive.namelist()
            if f"{name}.npy" not in here:
                names = listed([ascii(each)[1:-1][:40] for each in here]) or "none"
                raise FileError(
                    f"{path}: expected the arrays timesteps and results, as EvalCallback writes them; found {names}"
                )
            size = archive.getinfo(f"{name}.npy").file_size
            if size > 8 * MOST_POINTS:
                raise FileError(f"{path}: {name} unpacks to {size:,} bytes: refused")
            with archive.open(f"{name}.npy") as file:
                content = file.read(size + 1)
        _require_size(io.BytesIO(content), len(content), f"{path}: {name}")
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))
    except (OSError, ValueError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile) as error:
        raise FileError(f"{path} is not a readable npz file: {' '.join(str(error).split())[:200]}") from None


def _require_size(stream: io.BytesIO, length: int, source: str) -> None:
    """Refuse an array of objects, and one whose head asks for other memory than its bytes."""
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, kind = readers[version](stream)
    if kind.hasobject:
        raise FileError(f"{source} holds Python objects, which are never unpickled: refused")
    if math.prod(shape) * kind.itemsize != length - stream.tell():
        raise FileError(f"{source} does not have the bytes of an array of shape {shape}")


def _tensorboard(paths: Sequence[Path], metric: str | None) -> tuple[str, Curve]:
    """Return a scalar of event files; the last written value of a step counts."""
    if importlib.util.find_spec("tensorboard") is None:
        raise FileError(f"{paths[0]}: to read it, pip install tensorboard")
    wanted = METRICS if metric is None else (metric,)
    found: dict[str, dict[int, float]] = {}
    for path in sorted(paths, key=lambda path: path.name):
        try:
            for tag, step, value in _scalars(path):
                values = found.setdefault(tag, {})
                if tag in wanted:
                    values[step] = value
                if len(values) > MOST_POINTS or len(found) > 10_000:
                    raise FileError(f"{path}: more than {MOST_POINTS:,} points or 10,000 scalars")
        except FileError:
            raise
        except Exception as error:  # whatever the library says of a damaged file
            raise FileError(
                f"{path} is not a readable event file: {' '.join(str(error).split())[:200]}"
            ) from None
    name = next((name for name in wanted if found.get(name)), None)
    if name is None:
        here = listed([ascii(each)[1:-1][:60] for each in sorted(found)]) or "none"
        raise FileError(f"{paths[0]}: name the scalar that is the score with metric=NAME; found {here}")
    return name, sorted(found[name].items())


def _scalars(path: Path) -> Iterator[tuple[str, int, float]]:
    """Yield name, step and value of every scalar of an event file."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
    from tensorboard.util.tensor_util import make_ndarray

    for event in EventFileLoader(str(path)).Load():
        for value in event.summary.value:
            if value.metadata.plugin_data.plugin_name == "scalars" and value.HasField("tensor"):
                yield value.tag, int(event.step), float(make_ndarray(value.tensor).item())
