"""Learning curves of other programs from Python: import them, to compare and draw them as any."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal

from numpy.typing import ArrayLike

from qrlsuite import options
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.shelf import import_curves as curve_files
from qrlsuite.leaderboard.shelf.import_seeds import Imported
from qrlsuite.results import points
from qrlsuite.statistics.grid import Goal


def import_curves(
    curves: str
    | PathLike[str]
    | Sequence[str | PathLike[str]]
    | Mapping[str, tuple[Iterable[int], ArrayLike]]
    | Any,
    *,
    steps: ArrayLike | None = None,
    task: str | None = None,
    maximum: float | None = None,
    thresholds: Sequence[float] = (),
    every: int | None = None,
    metric: str | None = None,
    goal: Goal | None = None,
    early: Literal["solved", "failed", "cut"] | None = None,
    units: Literal["same"] | None = None,
    runs: str | PathLike[str] = "runs",
) -> list[Imported]:
    """Import learning curves that other programs made, as *external* entries to compare.

    At every grid point stands the last score at or before it: nothing is interpolated or carried backward, and a curve
    ends at its last observation, unless `early` says otherwise. External entries cannot be trained, evaluated or
    exported for publication.

    Parameters
    ----------
    curves:
        By entry (seeds, points), (N,) and (N, K); or a table with the columns entry, seed, step and score (Arrow, or a
        data frame of pandas or polars); or files: csv with these columns, `evaluations.npz`, `monitor.csv` and
        `progress.csv` of Stable-Baselines3, event files of TensorBoard.
    steps:
        (K,) environment steps of `points`, increasing.
    task:
        The suite's task of the curves; or the name of a new task, `external` if it is None. Later imports into it need
        no other option.
    maximum:
        The best possible score: scores become fractions of it, in [0, 1].
    thresholds:
        Scores that count as reached, for a new task; by default .6, .7, .8 and .9 of the maximum.
    every:
        Environment steps between two grid points of a new task. By default the curves' own if they are equal, else a
        round number that gives 100 points or fewer.
    metric:
        The column of a csv file or a table, or the scalar of TensorBoard, that is the score.
    goal:
        `below` where less of it is better, for a new task with `thresholds`.
    early:
        What it means that runs end before the others of their entry: `solved`, their last score holds; `failed`, they
        reach no threshold from there on; `cut`, every run is cut to the shortest. None refuses such runs.
    units:
        `same` if scores or steps of entries that differ tenfold are in one unit. None refuses them.
    runs:
        The results folder.

    Returns
    -------
    list of Imported
        For each entry its `label`, `task`, and the seeds that are `new`; `notes` have warnings.

    Raises
    ------
    FileError
        If a file cannot be read, or something is no learning curve. Nothing is written then.
    OptionError
        If an array has the wrong shape, or no argument defines a good score.

    Examples
    --------
    >>> import_curves("runs.csv", maximum=500)  # doctest: +SKIP
    """
    if isinstance(curves, Mapping):
        if steps is None:
            raise OptionError("steps: give the environment steps of the points, shape (points,)")
        found = points.read_arrays(curves, steps)
    elif steps is not None:
        raise OptionError("steps: files and tables have steps of their own; leave it out")
    else:
        paths = [curves] if isinstance(curves, str | PathLike) else curves
        if isinstance(paths, Sequence) and all(isinstance(each, str | PathLike) for each in paths):
            found = points.read_files([Path(fspath(each)) for each in paths], metric)
        else:
            found = points.read_table(curves, metric)
    given = {"metric": metric, "maximum": maximum, "thresholds": thresholds, "every": every, "goal": goal}
    chosen = options.build(curve_files.Options, {**given, "early": early, "units": units}, "import")
    return curve_files.import_points(found, Path(runs), task, chosen)
