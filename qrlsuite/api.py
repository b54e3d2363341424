"""The suite from Python: the functions behind the commands; each returns its results as an object.

    from qrlsuite import api

    small = api.train("beam6g", "mlp", options={"width": 16}, seeds=8, epochs=10)
    large = api.load("mlp width=64", task="beam6g", published=True)
    api.compare(large, small)
    api.board("beam6g", published=True)
    api.board("beam6g", by="executions", published=True)
    api.plot("curves", entries=[small, large])
    api.evaluate("mlp width=16", best=4)
    api.run_study("width.toml")

Results show themselves as tables: printed, at a Python prompt, and in a notebook, which shows figures, too. Errors are
those of `qrlsuite.errors`; where a message names an option of a command, such as `--task`, the function's argument has
the same name.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from matplotlib.figure import Figure
from rich.console import Console, ConsoleOptions, RenderResult

from qrlsuite.engine import budget as budgets
from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.terminal import Shown, show_figures_in_notebook
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, nearest
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard import across, rules, studies
from qrlsuite.leaderboard import board as boards
from qrlsuite.leaderboard.board import Leaderboard
from qrlsuite.leaderboard.compared import EntryComparison, compare_entries
from qrlsuite.leaderboard.costs import UNITS
from qrlsuite.leaderboard.pair import on_board
from qrlsuite.leaderboard.pictures.compose import compose
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.studies import Drawn
from qrlsuite.leaderboard.times import ALPHA
from qrlsuite.options import from_mapping
from qrlsuite.results import speed
from qrlsuite.results.seeds import read_seeds
from qrlsuite.results.store import write_atomically
from qrlsuite.studies import looks as with_looks
from qrlsuite.studies import runner as study_runner
from qrlsuite.studies import study as study_files
from qrlsuite.studies.looks import StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome
from qrlsuite.training import trackers
from qrlsuite.tuning import runner as tuning_runner
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.search import Search, preset_path, read_requests, tuning_seeds

if TYPE_CHECKING:
    from qrlsuite.leaderboard.evaluation import Evaluation

__all__ = [
    "board", "compare", "evaluate", "load", "new_study", "plot", "read_study", "run_study", "train", "tune",
]  # fmt: skip

show_figures_in_notebook()


def __dir__() -> list[str]:
    return sorted(__all__)


Selected = tuple[list[EntryResults], list[str]]
Seeds = int | str | Iterable[int]
"""100 (seeds 0 to 99), the seeds themselves, or text as on the command line: '0:20', '0,3,10:12'."""


def load(
    entry: str, *, task: str | None = None, runs: str | PathLike[str] = "runs", published: bool = False
) -> EntryResults:
    """Read an entry: the learning curves of its seeds, and how they were made.

    Parameters
    ----------
    entry:
        Its name or label, `TASK/` before it or not, or the beginning of one of them; or its folder.
    task:
        Look among the entries of this task only; None looks among all.
    runs:
        The results folder.
    published:
        Look among the published entries that come with the suite, too. Of an entry that is in both, the copy that
        gets further, then that with more seeds, is read.

    Returns
    -------
    EntryResults
        With `curves` of shape (N, T): the mean validation score of N seeds after each of T epochs, in the task's
        units ([0, 1] where scores are fractions of the optimum); `steps_per_epoch` environment steps each;
        `records` by seed; `to_table()` for pandas and polars.

    Raises
    ------
    UnknownNameError
        If no entry or several have the name, or no epoch of it is finished; the message says what to type.
    StoreError
        If there is no results folder, or a file is damaged.

    Examples
    --------
    >>> load("mlp width=64", task="beam6g", runs="none-yet", published=True).curves.shape
    (100, 100)
    """
    folder = Path(runs)
    collect.check_tasks(folder, _several(task), published)
    return collect.find(folder, entry, published, _several(task))


def board(
    tasks: str | Sequence[str] | None = None,
    *,
    by: str = "steps",
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    rule: str | None = None,
    alpha: float = ALPHA,
    horizon: int | None = None,
    entries: Sequence[str | EntryResults] = (),
    study: str | None = None,
    min_seeds: int = 1,
) -> Leaderboard:
    """Rank entries by significant outperformance: on a task, on each task, or over several tasks together.

    Parameters
    ----------
    tasks:
        A task; None means all, one after the other. Several are compared together: the entries that were trained on
        all of them with the same options, by means over the tasks.
    by:
        `steps`; `executions` (of circuits), `shots` or `core-hours`: what learning cost, within the same budget for
        all; `score`, the mean of the last tenth of the epochs, or `area`, that of all. Entries whose record does not
        hold a cost, or not so that it can be compared, have no rank, and a `price.problem` that says why.
    runs, published:
        As for `load`. Published entries that answer the question of one study are not ranked beside others of their
        task: name the study.
    rule:
        None ranks by significant outperformance with the error of the whole board held. `paper`, or another name of
        `qrlsuite list rules`, shows tiers by the cells of the task's grid in the place of ranks. A task
        may name a rule of its own.
    alpha:
        Probability of any false decision on the board.
    horizon:
        Environment steps to which all entries are cut; shorter ones are left out. None means the task's horizons.
    entries:
        Show these only: what `load` accepts. They keep the ranks that they have among all entries of their task. What
        `load` returns is compared by itself, without others; and so is all by cost, for the cheapest entry sets the
        budget.
    study:
        Rank the entries of this study only: its name, or a study file's path.
    min_seeds:
        Show no entries with fewer seeds.

    Returns
    -------
    Leaderboard
        `sections`, one per task and horizon, with a row per entry; `refused`, one line for each entry that was left
        out and why; `as_dict()`. Without any entry it has no section.

    Raises
    ------
    UnknownNameError
        If a task, an entry or the rule is unknown, or no entry is left.
    OptionError
        If there is no such axis, the horizon is no whole number of epochs, or both `entries` and `study` are given.
    StoreError
        If there is no results folder, and `published` is false.
    PluginError
        If a plugin's rule fails.

    Examples
    --------
    >>> found = board("beam6g", runs="none-yet", published=True, entries=["mlp width=64", "mlp width=16"])
    >>> [(row.rank_text, row.entry.label) for row in found.sections[0].times.rows]
    [('1-2', 'ddqn mlp width=64'), ('11', 'ddqn mlp width=16')]
    >>> names = ["vqc-native qubits=6", "mlp width=16"]
    >>> found = board("beam6g", by="executions", runs="none-yet", published=True, entries=names)
    >>> [(row.entry.label, row.price.problem) for row in found.sections[0].rows]
    [('ddqn vqc-native qubits=6', ''), ('ddqn mlp width=16', 'executes no circuits')]
    """
    folder, task_names = Path(runs), _several(tasks)
    collect.check_tasks(folder, task_names, published)
    together = task_names if len(task_names) > 1 else ()
    if rule is not None and (together or by != "steps"):
        other = "several tasks" if together else f"by = '{by}'"
        raise OptionError(f"--rule {rule} judges cells of one task in environment steps: not {other}")

    def select(names: Sequence[str], chosen: Sequence[str | EntryResults], least: int) -> Selected:
        return _selected(folder, names, chosen, study, published, horizon, least)

    if together:
        found, left_out = across.collected(together, lambda task: select([task], entries, min_seeds))
        return boards.build(found, left_out, None, horizon, alpha, by=by, together=together)
    shown, left_out = select(task_names, entries, min_seeds)
    keys = {(entry.task_hash, entry.name) for entry in shown}
    family = shown
    read = any(isinstance(entry, EntryResults) for entry in entries)
    if (entries or min_seeds > 1) and not read and by not in UNITS:
        family = _family(shown, select(task_names, (), 1)[0])
    return boards.build(
        family,
        left_out,
        rules.load(rule) if rule else None,
        horizon,
        alpha,
        lambda entry: (entry.task_hash, entry.name) in keys,
        by,
    )


def compare(
    first: str | EntryResults,
    second: str | EntryResults,
    *,
    task: str | None = None,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    rule: str | None = None,
) -> EntryComparison:
    """Say which of two entries needs fewer steps, by how much and how surely.

    All seeds of both count, up to the shorter horizon. In the cells of the task's ranking grid both are compared at
    equal numbers of seeds.

    Parameters
    ----------
    first, second:
        What `load` accepts, or what it returns.
    task, runs, published:
        As for `load`.
    rule:
        As for `board`: what counts as significant in a cell.

    Returns
    -------
    EntryComparison
        `verdict`, a sentence; `pair`, with the numbers of each threshold and the final scores; `among`, the verdict on
        the board of all entries of the task, where one of the two is given by name. Of the cells: `verdicts`, E rows of
        D; `points` of shape (2, E, D) and `intervals` of shape (2, E, D, 2), in environment steps; `outcome`, and the
        same as a `sentence`. `as_dict()` has all.

    Raises
    ------
    UnknownNameError
        If an entry, the task or the rule is unknown.
    QrlSuiteError
        If the entries belong to different tasks, or their lengths have no common horizon.

    Examples
    --------
    >>> found = compare("mlp width=64", "mlp width=16", task="beam6g", runs="none-yet", published=True)
    >>> found.verdict
    'mlp width=64 needs 53% fewer steps than mlp width=16 (50% to 57%, 100 seeds each, p < .0001)'
    """
    left, other = (
        entry if isinstance(entry, EntryResults) else load(entry, task=task, runs=runs, published=published)
        for entry in (first, second)
    )
    compared = compare_entries(left, other, rules.load(rule) if rule else None)
    if isinstance(first, EntryResults) and isinstance(second, EntryResults):
        return compared
    others, _ = collect.collect(Path(runs), [left.task], published)
    among = on_board(left, other, others, compared.grid, compared.pair.times.alpha)
    return replace(compared, among=among)


def plot(
    kind: str,
    *,
    tasks: str | Sequence[str] | None = None,
    entries: Sequence[str | EntryResults] = (),
    horizon: int | None = None,
    min_seeds: int = 1,
    seeds: Seeds | None = None,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    environment: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Figure:
    """Draw a picture of entries, of a task's environment, or of the estimator.

    Entries that would cut the others to their own length are left out, unless `entries` names them. A warning names
    each entry that was left out.

    Parameters
    ----------
    kind:
        What to draw, such as `curves`, `bars` or `tiers`: `qrlsuite plot --help` lists the kinds.
    tasks, entries, horizon, min_seeds, runs, published:
        As for `board`. Without `entries` all of the task are drawn, the smallest model first.
    seeds:
        Draw these alone, of every entry (30: seeds 0 to 29), so that all have equal numbers; None means all.
    environment:
        For a picture of an environment: options that replace the task's.
    settings:
        The picture's own settings: `qrlsuite plot KIND --settings` lists them.

    Returns
    -------
    matplotlib.figure.Figure
        To show, change, or save with `figure.savefig`.

    Raises
    ------
    UnknownNameError
        If the kind, a task or an entry is unknown, or there are no entries.
    OptionError
        If a setting is unknown or has a bad value, or the picture cannot be made of these entries or tasks.
    StoreError
        If there is no results folder, and `published` is false.

    Examples
    --------
    >>> plot("tiers", tasks="beam6g", runs="none-yet", published=True).savefig("tiers.pdf")  # doctest: +SKIP
    """
    if "task" in settings:
        raise OptionError(f"plot takes `tasks`, one or several: write tasks={settings['task']!r}")
    drawn = compose(
        kind,
        _several(tasks),
        entries,
        horizon=horizon,
        min_seeds=min_seeds,
        seeds=seeds,
        runs=Path(runs),
        published=published,
        settings=settings,
        environment=environment or {},
    )
    for line in drawn.left_out:
        warnings.warn(f"left out: {line}", stacklevel=2)
    return drawn.figure


def train(
    task: str,
    model: str,
    *,
    algorithm: str | None = None,
    options: Mapping[str, Any] | None = None,
    preset: str | None = None,
    seeds: Seeds | None = None,
    epochs: int | None = None,
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    budget: str | None = None,
    track: str | Sequence[str] = (),
    fresh: bool = False,
    same: str | None = None,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> EntryResults | None:
    """Train the missing seeds of an entry: a model and an algorithm on a task.

    Interrupt it at any time: every finished epoch is saved, and the same call continues, to the same bytes as if it
    had not been interrupted. More seeds or epochs extend earlier results; a repeated call trains nothing.

    Parameters
    ----------
    task, model:
        Registered names (`qrlsuite list tasks`, `qrlsuite list models`), or a task file's path.
    algorithm:
        A learning algorithm; None takes the task's.
    options:
        Options by name: `{"qubits": 6, "algorithm.gamma": 0.9, "environment.degree": 4}`.
    preset:
        One of the task's presets of settings, or a preset file's path.
    seeds:
        A number (100: seeds 0 to 99), the seeds themselves, or text ('0:20'); None takes the task's protocol.
    epochs:
        The epoch to which each is trained; None takes the task's protocol.
    engine:
        Where the work is done: a name (`qrlsuite list engines`), or what `qrlsuite.engine.where.Where.create` built
        of a name and options.
    workers:
        Processes, or tasks in a queue; None takes one per core, or what the engine takes.
    device:
        `cpu`, `cuda` or `cuda:1`.
    budget:
        `"30min"`, `"8h"` or `"2core-hours"`: stop then, with every finished epoch saved.
    track:
        Trackers that watch, `NAME` or `NAME=TARGET`.
    fresh:
        Where the code of the entry has changed: train anew, and move the old seeds to a folder beside it.
    same:
        Where the code has changed: your word that nothing changed in effect, as a reason; the seeds are continued.
    runs:
        The results folder.
    progress:
        Whether to show a bar on a terminal or in a notebook, and lines elsewhere.

    Returns
    -------
    EntryResults
        The entry with its learning curves (N, T), of all its seeds that are there; None where no epoch has finished
        yet, for it was handed to a queue, or the `budget` was too small.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        For an unknown name, or an option or argument that cannot be used.
    StoreError
        If a file of the entry is damaged, or another code has begun its seeds.
    QrlSuiteError
        If training failed; finished epochs are kept.
    KeyboardInterrupt
        When it was interrupted and every worker has saved and ended.

    Examples
    --------
    >>> entry = train("beam6g", "mlp", options={"width": 16}, seeds=2, epochs=1)  # doctest: +SKIP
    >>> entry.curves.shape  # doctest: +SKIP
    (2, 1)
    """
    entry = resolve(task, model, algorithm, from_mapping(options), preset)
    watching = [track] if isinstance(track, str) else list(track)
    seed_numbers = None if seeds is None else read_seeds(seeds)
    _check_positive("epochs", epochs)
    where = _where(engine, workers, device, fresh, same)
    missing.check_budget(budget, where)
    missing.require_same_code(Path(runs), [entry], where)
    work = missing.find(Path(runs), entry, where, seed_numbers, epochs)
    with trackers.asking(watching):
        missing.train(work, where, RunDisplay(work, where.workers, not progress, "call"), budget)
    return collect.read(work.store)


def evaluate(
    entries: str | Sequence[str],
    *,
    task: str | None = None,
    best: int = 10,
    episodes: int = 1000,
    seed: int = 0,
    device: str = "cpu",
    backend: str | None = None,
    yes: bool = False,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> Evaluation:
    """Play fresh episodes with the best trained agents of some entries, and with reference policies.

    The agents are chosen by their last validation score; the episodes are others, the same for every policy, so the
    choice does not raise the result.

    Parameters
    ----------
    entries:
        One or several entries of one task, each by name, label, the beginning of one of them, or folder.
    task:
        Look among the entries of this task only.
    best:
        How many agents of each entry.
    episodes:
        Complete episodes of each agent.
    seed:
        Another one gives other episodes.
    device:
        `cpu`, `cuda` or `cuda:1`.
    backend:
        Let the same agents act on this circuit backend, too: `native`, `pennylane`, `qiskit`, or a plugin's, with
        options if need be: `"qiskit shots=1000"`. Finished episodes are kept in the entry's folder.
    yes:
        Execute circuits on a device that is no simulator.
    runs:
        The results folder.
    progress:
        Whether to show what is to be executed, and a bar, on a terminal or in a notebook.

    Returns
    -------
    Evaluation
        With `policies`: `returns` (sums of rewards) and relative `scores`, each of shape (agents, episodes); a
        `figure()`; and `as_dict()`.

    Raises
    ------
    UnknownNameError
        If no entry, or several, have a name.
    OptionError
        If the entries belong to different tasks, or a number cannot be used.
    StoreError
        If an entry has no trained agent.

    Examples
    --------
    >>> evaluate(["mlp width=64", "vqc-native"], best=10).figure().savefig("histogram.pdf")  # doctest: +SKIP
    """
    from qrlsuite.leaderboard import evaluation  # torch, which all other functions do without

    _check_positive("best", best)
    _check_positive("episodes", episodes)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise OptionError(f"seed = {seed!r}: give a whole number, 0 or more")
    names = [entries] if isinstance(entries, str) else list(entries)
    return evaluation.evaluate(
        Path(runs),
        names,
        task=task,
        best=best,
        episodes=episodes,
        seed=seed,
        device=device,
        progress=progress,
        backend=backend,
        yes=yes,
    )


def tune(
    task: str,
    entries: str | Sequence[str],
    *,
    vary: str | Sequence[str] | Mapping[str, Any] | None = None,
    sampler: str | None = None,
    seeds: Seeds = 20,
    epochs: int | None = None,
    objective: Literal["time", "cell", "area"] = "time",
    budget: str | None = None,
    out: str | PathLike[str] | None = None,
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    fresh: bool = False,
    same: str | None = None,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> list[Search]:
    """Search settings with which models learn in few steps, on seeds that entries are never judged by.

    Interrupt it at any time: the same call continues, and ends with the same presets as if it had never stopped.

    Parameters
    ----------
    task, engine, workers, device, fresh, same, runs:
        As for `train`. Trials lie below `runs`/tuning.
    entries:
        What is tuned: `"mlp width=16"`, or several, which get equal budgets. Options that are written are not varied.
    vary:
        What is varied: lists of values, or ranges, `{"lr": [1e-3, 5e-4], "gamma": {"low": 0.9, "high": 0.99}}`; or
        words as on the command line: a grid's name (`"paper"`), a grid file's path, `"lr=1e-3,5e-4"`. Without it
        `halving` varies the options that models and algorithms mark as `Tuned`.
    sampler:
        `halving`, `grid`, `one-at-a-time`, `random` or `tpe`, with options `trials` and `seed`: `"random trials=50"`.
        None takes all combinations of what `vary` lists, and halving without it.
    seeds:
        Runs of each trial, with `halving` of each in the last rung: a number counts from seed 1,000,000.
    epochs:
        Of each trial; None takes the task's protocol.
    objective:
        What is minimized: steps below threshold (`time`), sample complexity at the task's reference `cell`, or its
        mean over the ranking grid (`area`).
    budget:
        `"30min"`: begin no trial that would not end within this time; every call gets it anew. `"2core-hours"` with
        `halving`: as many settings as this much of each model's time holds.
    out:
        The preset file, ending in .toml; None takes one below `runs`.
    progress:
        Whether to show what is searched, and a bar on a terminal or in a notebook.

    Returns
    -------
    list of Search
        One per entry, with `best` and all `trials`; `written`, the preset file for `train(preset=...)`, which is None
        where the search is not over.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        For an unknown name, or an option or argument that cannot be used.
    QrlSuiteError
        If a trial failed; finished epochs are kept.
    KeyboardInterrupt
        When it was interrupted and every worker has saved and ended.

    Examples
    --------
    >>> small, circuit = tune("beam6g", ["mlp width=16", "vqc-native qubits=6"])  # doctest: +SKIP
    >>> entry = train("beam6g", f"mlp preset={small.written}")  # doctest: +SKIP
    """
    _check_positive("epochs", epochs)
    where, folder = _where(engine, workers, device, fresh, same), Path(runs)
    requests = read_requests(
        task, _several(entries), vary or (), sampler, tuning_seeds(seeds), epochs, objective, budget
    )
    path = preset_path(out, requests)
    searches = tuning_runner.build(requests, folder)
    display = TuneDisplay(searches, where, not progress, "call")
    display.begin()
    tuning_runner.run(searches, folder, where, display, path)
    return searches


@dataclass(frozen=True, repr=False)
class StudyRun(Shown):
    """The state of a study after `run_study`.

    Attributes
    ----------
    overview:
        Every entry with its finished and its missing seeds.
    pictures:
        Every picture with its `figure` and file (`path`), or the `problem` why there is none yet.
    trained:
        Seeds that this run finished.
    submitted:
        One line for each entry that was handed to a queue.
    """

    overview: study_runner.Overview
    pictures: tuple[Drawn, ...]
    trained: int
    submitted: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            **self.overview.as_dict(),
            "trained": self.trained,
            "submitted": list(self.submitted),
            "pictures": [each.as_dict() for each in self.pictures],
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show the overview, and where the pictures are."""
        yield self.overview
        for picture in self.pictures:
            yield (
                f"wrote {picture.path}" if picture.path else f"no picture '{picture.name}': {picture.problem}"
            )


def new_study(
    path: str | PathLike[str],
    entries: Sequence[str],
    *,
    task: str,
    epochs: int | None = None,
    looks: Sequence[int] = (20, 40, 60, 80, 100),
    alpha: float = ALPHA,
    spending: str = "pocock",
    margin: float = 0.1,
    first_seed: int | None = None,
    reason: str = "",
    runs: str | PathLike[str] = "runs",
) -> StudyOutcome:
    """Write a study with looks, which compares entries with as many seeds as it takes. Trains nothing.

    Parameters
    ----------
    path:
        The file, NAME.toml. It can be edited until its first seed begins.
    entries:
        Two or more: `"mlp width=64"`, `"vqc-native qubits=10"`; tuned: `"mlp preset=FILE.toml"`.
    task, epochs:
        As for `train`.
    looks:
        Seeds of each entry at each look.
    alpha, spending:
        Probability of any false difference over all pairs and looks, and how it is spent over the looks.
    margin:
        Entries that differ by less count as equal: 0.1 is 10 percent.
    first_seed:
        Where the study's seeds begin; None takes the first block from 10,000 that is unused in `runs`.
    reason:
        Why the first look comes before 20 seeds, if it does.

    Raises
    ------
    OptionError, UnknownNameError
        If the file is there already, or a name or number cannot be used.
    """
    file = Path(path)
    if file.suffix != ".toml":
        raise OptionError(f"{file}: a study file's name ends in .toml")
    if file.exists():
        raise OptionError(f"{file} is there already: choose another name, or delete it")
    study = with_looks.new(
        file.stem,
        task,
        entries,
        Path(runs),
        first_seed=first_seed,
        epochs=epochs,
        looks=list(looks),
        alpha=alpha,
        spending=spending,
        margin=margin,
        reason=reason,
    )
    outcome = StudyOutcome(study, study.read())
    write_atomically(file, study_files.dumps(study.file).encode())
    return outcome


def read_study(
    name: str, *, runs: str | PathLike[str] = "runs", published: bool = False
) -> study_runner.Overview | StudyOutcome:
    """Read how far a study is: what is trained and missing of it, or what its looks have decided. Trains nothing.

    Parameters
    ----------
    name:
        A study (`qrlsuite list studies`), a study file's path, or a folder with a published study.
    runs:
        The results folder. A published study with looks that has not begun there is read as it was published.
    published:
        Count the published seeds and pairs of entries, too.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        If there is no such study, or it is malformed.
    StoreError
        If its results are damaged, or were changed after a look.
    """
    study, folder = studies.find(name), Path(runs)
    if study.file.looks is not None:
        return studies.read_outcome(name, folder)
    where, members = Where.create(), study.members()
    items = study_runner.find_pending(members, folder, where, speed.known(folder), None, None)
    pairs = studies.decided_pairs(studies.read(folder, members, published).values())
    counts = studies.published_seeds(items) if published else None
    return study_runner.Overview(study, items, where.workers, pairs, counts)


def run_study(
    name: str,
    *,
    options: Mapping[str, Any] | None = None,
    models: Mapping[str, str] | None = None,
    only: str | Sequence[str] = (),
    seeds: Seeds | None = None,
    epochs: int | None = None,
    budget: str | None = None,
    format: Literal["png", "pdf", "svg"] = "png",
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    fresh: bool = False,
    same: str | None = None,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> StudyRun | StudyOutcome:
    """Train a study's missing seeds, the cheapest entry first, and draw its pictures.

    Entries are those that `train` trains, in the same folders: nothing is trained twice. A study with looks has seeds
    of its own, which are trained look by look, until every pair is decided or the last look was taken. Interrupt it at
    any time: the same call continues, and ends with the same decisions.

    Parameters
    ----------
    name:
        A study (`qrlsuite list studies`), or a study file's path.
    options:
        Options for every entry that has them, in the place of the study's own.
    models:
        Models in the place of others: `{"vqc-pennylane": "vqc-native"}`.
    only:
        Only entries whose group, label or task has this word or one of these; or entries by name. Like `options`,
        `models`, `seeds` and `epochs`, only of a study without looks.
    seeds, epochs:
        As for `train`; None takes each task's protocol.
    budget:
        As for `train`, but stop at a group's end. The same call continues.
    format:
        Of the pictures, which are written into the results folder.
    engine, workers, device, fresh, same, runs, progress:
        As for `train`.

    Returns
    -------
    StudyRun, or StudyOutcome of a study with looks
        With `pictures`, each with a matplotlib `figure`; an `overview` of the entries; and `as_dict()`. With looks:
        `pairs`, each with its `verdict`, `difference` (mean time below threshold of the second over that of the first,
        minus 1), `interval`, `p` and `levels` of each look; `finished`; `submitted`; and `as_dict()`.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        For an unknown name, an option or argument that cannot be used, or a `budget` that holds not even one seed.
    QrlSuiteError
        If training failed; finished epochs are kept.
    KeyboardInterrupt
        When it was interrupted and every worker has saved and ended.

    Examples
    --------
    >>> run_study("fig6", seeds=20, budget="30min")  # doctest: +SKIP
    """
    if format not in ("png", "pdf", "svg"):
        raise OptionError(f"format = {format!r}{nearest(format, ['png', 'pdf', 'svg'])}")
    _check_positive("epochs", epochs)
    where = _where(engine, workers, device, fresh, same)
    limit = budgets.seconds(budget, where.workers)
    seed_numbers = None if seeds is None else read_seeds(seeds)
    study = studies.find(name)
    names = [only] if isinstance(only, str) else only
    folder = Path(runs)
    if study.file.looks is not None:
        chosen = {
            "options": options,
            "models": models,
            "only": names,
            "seeds": seeds,
            "epochs": epochs,
            "fresh": fresh,
        }
        if given := [option for option, value in chosen.items() if value]:
            raise OptionError(
                f"study '{name}' has looks, which fix what is trained: leave {', '.join(given)} out"
            )
        subject = StudyWithLooks(study, folder)
        known = speed.known(subject.folder, folder)
        return study_runner.take_looks(
            subject, study_runner.Session(subject.folder, where, known, limit, not progress, "call")
        )
    members = study_runner.select(study, from_mapping(options), models, names)
    speeds = speed.known(folder)
    missing.require_same_code(folder, [member.entry for member in members], where)
    items = study_runner.find_pending(members, folder, where, speeds, seed_numbers, epochs)
    if limit is not None:
        study_runner.check_budget(items, limit, where.workers)
    session = study_runner.Session(folder, where, speeds, limit, not progress, "call")
    session.run(items)
    drawn = studies.write(study.name, studies.draw(study, members, folder), folder, format)
    after = study_runner.find_pending(members, folder, where, speeds, seed_numbers, epochs)
    overview = study_runner.Overview(study, after, where.workers)
    return StudyRun(overview, tuple(drawn), session.trained, tuple(session.submitted))


def _where(
    engine: str | Where, workers: int | None, device: str, fresh: bool = False, same: str | None = None
) -> Where:
    """Return where training is done."""
    if isinstance(engine, Where):
        if workers is not None or device != "cpu":
            raise OptionError("workers and device belong to an engine that is built already: give them there")
        return replace(engine, fresh=engine.fresh or fresh, same=engine.same if same is None else same)
    _check_positive("workers", workers)
    return replace(Where.create(engine, workers, device=device), fresh=fresh, same=same)


def _check_positive(name: str, value: int | None) -> None:
    if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
        raise OptionError(f"{name} = {value!r}: give a whole number, 1 or more")


def _selected(
    runs: Path,
    tasks: Sequence[str],
    entries: Sequence[str | EntryResults],
    study: str | None,
    published: bool,
    horizon: int | None,
    min_seeds: int,
) -> tuple[list[EntryResults], list[str]]:
    """Return the entries of a board, those named or those of a study, and a line for each that was left out."""
    if study is None:
        return collect.select(runs, tasks, entries, published, horizon, min_seeds)
    if entries:
        raise OptionError(f"--study {study} names the entries: leave --entry out")
    return studies.select(study, runs, tasks, published, horizon, min_seeds)


def _family(shown: Sequence[EntryResults], ranked: Sequence[EntryResults]) -> list[EntryResults]:
    """Return what is compared: all ranked entries of the same definitions of tasks, and those shown beside them."""
    hashes = {entry.task_hash for entry in shown}
    family = [entry for entry in ranked if entry.task_hash in hashes]
    keys = {(entry.task_hash, entry.name) for entry in family}
    return family + [entry for entry in shown if (entry.task_hash, entry.name) not in keys]


def _several(names: str | Sequence[str] | None) -> Sequence[str]:
    """Return names as a sequence."""
    return [names] if isinstance(names, str) else names or []
