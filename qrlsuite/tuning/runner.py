"""Running searches: of several models with equal budgets, in turns, until all are over or the time is up."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from qrlsuite.engine import missing
from qrlsuite.engine.where import Where
from qrlsuite.engine.work import raise_failures
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment import preset
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.store import EntryStore
from qrlsuite.tuning.bayesian import Bayesian
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.search import FOLDER, Request, Search


def build(requests: Sequence[Request], runs: Path) -> list[Search]:
    """Build searches; of several grids, larger ones are sampled down to the number of combinations of the smallest.

    By `bayesian` each goes on until the same expected regret, or for as many trials per option or core-hours.

    Parameters
    ----------
    runs:
        The results folder.
    """
    if requests[0].sampler == "bayesian":
        searches = [Bayesian(request, runs) for request in requests]
        for row in requests[0].rows:
            if not any(row in search.taken for search in searches):
                raise OptionError(
                    f"--vary '{row}': no entry has all of these options among those that are varied, which are "
                    f"{', '.join(dimension.name for dimension in searches[0].space)}"
                )
        return [*searches]
    built = [Search(request, runs) for request in requests]
    fewest = min(search.planned for search in built)
    for i, search in enumerate(built):
        if search.planned == fewest:
            continue
        if search.request.sampler != "grid":
            counts = " and ".join(str(each.planned) for each in built)
            raise OptionError(
                f"sampler '{search.request.sampler}' gives these models {counts} trials; "
                f"--sampler 'random trials={fewest}' gives each as many"
            )
        built[i] = Search(dataclasses.replace(search.request, sampler="random", trials=fewest), runs)
    return built


def run(
    searches: Sequence[Search],
    runs: Path,
    where: Where,
    display: TuneDisplay,
    out: Path | None = None,
) -> bool:
    """Run trials, then write the preset file of each search that has a best trial and waits for none.

    After Ctrl-C, the files have the best settings so far; a file with more runs behind it stays unchanged.

    A trial is begun only if it would end within the requests' budget of time, at the pace of the trials before.
    Trials that an earlier call finished cost no time.

    Parameters
    ----------
    out:
        The preset file of the one search; None takes `Search.path`.

    Returns
    -------
    bool
        Whether all trials are over, none left to another process or a queue.
    """
    try:
        budget = searches[0].request.seconds(where.workers)
        complete = _run(searches, runs, where, display, budget)
    except KeyboardInterrupt:
        try:
            _write([each for each in searches if not _rests_on_more(out or each.path, each)], out)
        except QrlSuiteError as error:
            display.console.print(f"the best settings so far are not written: {error}", markup=False)
        display.interrupted()
        raise
    finally:
        display.close()
    _write(searches, out)
    return complete


def _rests_on_more(path: Path, search: Search) -> bool:
    """Whether a preset file has more runs behind it: trials of an earlier call may not be read again yet."""
    try:
        tuning = preset.load(path).tuning
    except QrlSuiteError:
        return False  # there is none, or it is damaged
    return tuning is not None and (tuning.runs or 0) > search.runs_done


def _write(searches: Sequence[Search], out: Path | None) -> None:
    for search in searches:
        if search.presentable:
            search.write(out or search.path)


def _run(
    searches: Sequence[Search], runs: Path, where: Where, display: TuneDisplay, budget: float | None
) -> bool:
    trained = 0

    def train(entries: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        nonlocal trained
        missing.settle_codes(runs / FOLDER, entries, where, display.console.quiet)
        missing.require_trainable(entries, where, display.console.quiet)
        works = [missing.find(runs / FOLDER, entry, where, seeds, epochs) for entry in entries]
        for work in works:
            missing.prepare(work)
            trained += len(work.todo)
        display.begin_trials(works)
        for together in where.divide(works):
            display.training(together)
            outcome = where.run(together, display.update)
            raise_failures(outcome)
            if outcome.submitted is not None:
                display.console.print(outcome.submitted, markup=False)
        return [work.store for work in works]

    spent = 0.0  # seconds in steps that trained; trials of an earlier call cost no budget
    pace: dict[int, float] = {}  # seconds per run of each search
    while turn := [(i, search) for i, search in enumerate(searches) if not search.over]:
        most = None
        if budget is not None:
            left = budget - spent
            one_each = sum(pace.get(i, 0.0) * search.next_seeds for i, search in turn)
            if left < one_each:
                return False
            most = int(left / one_each) if one_each else 1
        for i, search in turn:
            started, before = time.monotonic(), trained
            room = max(1, where.room // search.next_seeds)
            for trial in search.step(train, room if most is None else min(room, most)):
                display.told(search, trial)
            display.regret(search)
            if trained > before:
                took = time.monotonic() - started
                spent += took
                pace[i] = took / (trained - before)
    return not any(search.pending for search in searches)
