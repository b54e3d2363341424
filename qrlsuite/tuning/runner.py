"""Running searches: of several models with equal budgets, in turns, until all are over or the time is up."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from qrlsuite.engine import api
from qrlsuite.engine.execution import Execution, check_memory, plan
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.store import EntryStore
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.halving import Halving
from qrlsuite.tuning.search import FOLDER, Request, Search


def build(requests: Sequence[Request], runs: Path) -> list[Search]:
    """Build searches; of several grids, larger ones are sampled down to the number of combinations of the smallest.

    By `halving` each has as many settings per varied option, or as many core-hours.

    Parameters
    ----------
    runs:
        The results folder.

    Raises
    ------
    OptionError
        If `random`, `tpe` or `one-at-a-time` gives them different numbers of trials.
    QrlSuiteError
        If a name, an option or a value of a request cannot be used.
    """
    built = [Halving(r, runs) if r.sampler == "halving" else Search(r, runs) for r in requests]
    if any(isinstance(search, Halving) for search in built):
        return built
    fewest = min(search.planned for search in built)
    for i, search in enumerate(built):
        if search.planned == fewest:
            continue
        if search.request.sampler != "grid":
            counts = " and ".join(str(each.planned) for each in built)
            raise OptionError(
                f"sampler '{search.request.sampler}' gives these models {counts} trials; --sampler random --trials "
                f"{fewest} gives each as many"
            )
        built[i] = Search(dataclasses.replace(search.request, sampler="random", trials=fewest), runs)
    return built


def run(
    searches: Sequence[Search],
    runs: Path,
    execution: Execution,
    display: TuneDisplay,
    budget: float | None = None,
    out: Path | None = None,
) -> bool:
    """Run trials, then write the preset file of each search that has a best trial and waits for none.

    Parameters
    ----------
    budget:
        Seconds: no trial is begun that would not end within them, by the longest so far. None for no limit.
    out:
        The preset file of the one search; None takes `Search.path`.

    Returns
    -------
    bool
        Whether all trials are over, none left to another process or a queue.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, with everything saved.
    QrlSuiteError
        If a trial cannot be run.
    """
    try:
        complete = _run(searches, runs, execution, display, budget)
    except KeyboardInterrupt:
        display.interrupted()
        raise
    finally:
        display.close()
    for search in searches:
        if search.presentable:
            search.write(out or search.path)
    return complete


def _run(
    searches: Sequence[Search], runs: Path, execution: Execution, display: TuneDisplay, budget: float | None
) -> bool:
    def train(entry: Entry, seeds: Sequence[int], epochs: int) -> EntryStore:
        work = plan(runs / FOLDER, entry, execution, seeds, epochs)
        check_memory(work, execution)
        EntryStore.create(work.runs, entry)
        display.trial(entry, work)
        if work.groups:
            outcome = execution.run(work, display.update)
            api.raise_failures(outcome)
            if outcome.submitted is not None:
                display.console.print(outcome.submitted, markup=False)
        return work.store

    began = time.monotonic()
    longest = 0.0
    while not all(search.over for search in searches):
        if budget is not None and time.monotonic() - began + longest > budget:
            return False
        started = time.monotonic()
        for search in searches:
            if not search.over:
                display.told(search, search.step(train))
        longest = max(longest, time.monotonic() - started)
    return not any(search.pending for search in searches)
