"""Training from Python: entries, searches of settings, and how trained agents play."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from qrlsuite.api.arguments import Seeds, check_positive, several, where_of
from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.where import Where
from qrlsuite.engine.work import Missing
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.notation import Written
from qrlsuite.options import Setting, from_mapping
from qrlsuite.results import codes
from qrlsuite.results.seeds import read_seeds
from qrlsuite.results.store import plugins_in
from qrlsuite.results.survey import groups
from qrlsuite.training import trackers
from qrlsuite.tuning import runner as tuning_runner
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.search import Search, preset_path, read_requests

if TYPE_CHECKING:
    from qrlsuite.api.evaluation import Evaluation


def train(
    task: str,
    model: str,
    *,
    algorithm: str | None = None,
    options: Mapping[str, Any] | None = None,
    preset: str | None = None,
    start: str | None = None,
    seeds: Seeds | None = None,
    epochs: int | None = None,
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    budget: str | None = None,
    track: str | Sequence[str] = (),
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
    start:
        An entry with trained agents, of the results folder or published: seed k begins with the agent of seed k, and
        its optimizer and all else are fresh. It is part of the entry, so the entry shares no seeds with an entry that
        begins without agents.
    seeds:
        A number (100: seeds 0 to 99), the seeds themselves, or text ('0:20'); None takes the task's protocol.
    epochs:
        The epoch to which each is trained; None takes the task's protocol.
    engine:
        Place of the work: a name (`qrlsuite list engines`), or a result of `qrlsuite.engine.where.Where.create` with a
        name and options.
    workers:
        Processes, or tasks in a queue; None takes one per core, or the engine's default.
    device:
        `cpu`, `cuda` or `cuda:1`.
    budget:
        `"30min"`, `"8h"` or `"2core-hours"`: stop then, with every finished epoch saved.
    track:
        Trackers that watch, `NAME` or `NAME=TARGET`.
    same:
        After a change of code: your word that results do not change, as a reason; the old seeds are continued.
        Without it, seeds of the changed code are another entry, with a mark such as `@1a2b3c4d` behind its name.
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
        If a file of the entry is damaged, or `same` is given and the old seeds cannot be continued.
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
    entry = resolve_entry(task, model, algorithm, from_mapping(options), preset, runs)
    where = where_of(engine, workers, device, same)
    work, submitted = train_entry(entry, where, seeds, epochs, budget, track, runs, progress, start=start)
    if submitted is not None and progress:
        print(submitted, file=sys.stderr)
    return collect.read(work.store)


def resolve_entry(
    task: str,
    model: str | Written,
    algorithm: str | None = None,
    settings: Sequence[Setting] = (),
    preset: str | None = None,
    runs: str | PathLike[str] = "runs",
) -> Entry:
    """Return the entry that is to be trained."""
    try:
        entry = resolve(task, model, algorithm, settings, preset)
        return entry if entry.script is None else replace(entry, folder=Path.cwd())
    except UnknownNameError as error:
        raise UnknownNameError(f"{error}{plugins_in(Path(runs), str(error))}") from None


def train_entry(
    entry: Entry,
    where: Where,
    seeds: Seeds | None,
    epochs: int | None,
    budget: str | None,
    track: str | Sequence[str],
    runs: str | PathLike[str],
    progress: bool,
    confirmed: bool = True,
    start: str | None = None,
) -> tuple[Missing, str | None]:
    """Train the missing seeds of an entry, as `train` and the command `run` do, and print a summary.

    Parameters
    ----------
    confirmed:
        Whether to go on, on a terminal, where the first measurement says that it will take more than a day.

    Returns
    -------
    tuple
        The missing seeds when it began; and one line about seeds handed to a queue, None if they were trained.
    """
    folder, quiet = Path(runs), not progress
    if entry.script is not None:
        if track or start is not None or where.device != "cpu":
            raise OptionError(
                f"'{entry.label}': the script itself handles trackers, --device and --from: write them in its command"
            )
        entry = entry if epochs is None else entry.for_epochs(epochs)
    seed_numbers = None if seeds is None else read_seeds(seeds)
    check_positive("epochs", epochs)
    put_agents = None
    if start is not None:
        from qrlsuite.api.warm import begin_with  # torch

        entry, put_agents = begin_with(entry, folder, start, seed_numbers)
    missing.check_budget(budget, where)
    (code,) = missing.settle_codes(folder, [entry], where, quiet)
    work = missing.find(folder, entry, where, seed_numbers, epochs, code)
    if put_agents is not None:
        put_agents(work.store)
    if work.groups:
        missing.require_trainable([entry], where, quiet)
    display = RunDisplay(work, where.workers, quiet)
    if where.same is not None and ((held := codes.of(work.store)) is None or len(held.digests) < 2):
        display.console.print(
            "--same changes nothing: there are no seeds of another code here", soft_wrap=True
        )
    display.expected = None if quiet else missing.expected(work, where)
    with trackers.asking([track] if isinstance(track, str) else list(track)):
        submitted = missing.train(work, where, display, budget, confirmed).submitted
    if submitted is None and not quiet and display.again == "command":
        at_work = [group for group in groups(work.store) if group.state in ("running", "submitted")]
        display.finished(missing.summarize(work), [group for group in at_work if {*group.seeds} & work.busy])
    return work, submitted


def tune(
    task: str,
    entries: str | Sequence[str],
    *,
    vary: str | Sequence[str] | Mapping[str, Any] | None = None,
    sampler: str | None = None,
    seeds: Seeds | None = None,
    epochs: int | None = None,
    objective: Literal["time", "cell", "area"] = "time",
    budget: str | None = None,
    out: str | PathLike[str] | None = None,
    engine: str | Where = "local",
    workers: int | None = None,
    device: str = "cpu",
    same: str | None = None,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> list[Search]:
    """Search settings with which models learn in few steps, on seeds that entries are never judged by.

    Interrupt it at any time: the same call continues, and ends with the same presets as if it had never stopped.

    Parameters
    ----------
    task, engine, workers, device, same, runs:
        As for `train`. Trials lie below `runs`/tuning.
    entries:
        Entries to tune: `"mlp width=16"`, or several, which get equal budgets. Their written options are not varied.
    vary:
        Varied options: lists of values, or ranges, `{"lr": [1e-3, 5e-4], "gamma": {"low": 0.9, "high": 0.99}}`; or
        words as on the command line: a grid's name (`"paper"`), a grid file's path, `"lr=1e-3,5e-4"`; settings that
        `bayesian` tries first, `"lr=.002 buffer=10000"`. `bayesian` also varies the options that models and algorithms
        mark as `Tuned`.
    sampler:
        `bayesian`, `grid` or `random`, with options `trials` and `seed`: `"random trials=50"`;
        `"bayesian regret=.03 last=100"`, whose best three settings are compared on `last` other seeds. None takes all
        combinations of the lists in `vary`, and `bayesian` without lists.
    seeds:
        Runs of each trial: a number counts from seed 1,000,000. None takes 20, with `bayesian` 4.
    epochs:
        Epochs of each trial; None takes the task's protocol.
    objective:
        The number to minimize: steps below threshold (`time`), sample complexity at the task's reference `cell`, or
        its mean over the ranking grid (`area`).
    budget:
        `"30min"`: begin no trial that would not end within this time; every call gets it anew. `"2core-hours"` with
        `bayesian`: as many trials as this holds, for each entry.
    out:
        The preset file, ending in .toml; None takes one below `runs`.
    progress:
        Whether to show the search space, and a bar on a terminal or in a notebook.

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
    where, folder = where_of(engine, workers, device, same), Path(runs)
    check_positive("epochs", epochs)
    requests = read_requests(
        task, several(entries), vary or (), sampler, seeds, epochs, objective, budget, where
    )
    path = preset_path(out, requests)
    searches = tuning_runner.build(requests, folder)
    display = TuneDisplay(searches, where, not progress)
    display.begin()
    tuning_runner.run(searches, folder, where, display, path)
    return searches


def evaluate(
    entries: str | Sequence[str],
    *,
    task: str | None = None,
    best: int = 10,
    episodes: int = 1000,
    seed: int = 0,
    device: str = "cpu",
    backend: str | None = None,
    perturb: float | Sequence[float] = (),
    yes: bool = False,
    published: bool = False,
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
        The task to play, by name or file. Names mean its own entries; entries of other tasks, named `TASK/ENTRY` or by
        their folder, play it too if observations and actions are the same. None plays the entries' own task.
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
    perturb:
        Let them play with perturbed parameters, too: each trained number times 1 + perturb * z, z standard normal, for
        every size that is given.
    yes:
        Execute circuits on a real device.
    published:
        Look among the published entries that come with the suite, too.
    runs:
        The results folder.
    progress:
        Whether to show the planned executions, and a bar, on a terminal or in a notebook.

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
        If the entries belong to different tasks, a number cannot be used, or agents cannot play the task.
    StoreError
        If an entry has no trained agent.

    Examples
    --------
    >>> evaluate(["mlp width=64", "vqc-native"], best=10).figure().savefig("histogram.pdf")  # doctest: +SKIP
    """
    from qrlsuite.api import evaluation  # torch, which all other functions do without

    check_positive("best", best)
    check_positive("episodes", episodes)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise OptionError(f"seed = {seed!r}: give a whole number, 0 or more")
    names = [entries] if isinstance(entries, str) else list(entries)
    return evaluation.evaluate(
        Selection.create(runs, task, published),
        names,
        best=best,
        episodes=episodes,
        seed=seed,
        device=device,
        progress=progress,
        backend=backend,
        yes=yes,
        perturb=[perturb] if isinstance(perturb, int | float) else list(perturb),
    )
