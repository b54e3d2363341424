"""A search: trial by trial, each an ordinary set of runs below `<runs>/tuning/`, until the best is a preset file.

A search keeps no state of its own. Interrupted and begun again, it proposes the same trials, finds the finished ones
on the disk, and ends with the same preset (except for the measured hours).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, ConsoleOptions, RenderResult

from qrlsuite import notation, options, registry
from qrlsuite.engine.budget import Budget
from qrlsuite.engine.missing import check_budget
from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError
from qrlsuite.experiment import preset
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.experiment.task import digest
from qrlsuite.options import Setting
from qrlsuite.results import provenance
from qrlsuite.results.seeds import format_seeds, read_seeds
from qrlsuite.results.store import EntryStore, write_atomically
from qrlsuite.results.text import counted, hours_text, steps_text
from qrlsuite.tuning import samplers, space
from qrlsuite.tuning.objective import Merit, Objective, cell_text, merit

SHOWN = 10
"""Rows of the table of best settings."""

FOLDER = "tuning"
"""Trials lie in a results folder of their own, so that leaderboards do not rank them."""

SEEDS = (20, 4)
"""Runs of each trial, and of each in a `bayesian` search, where settings that may be the best get further trials."""

Train = Callable[[Sequence[Entry], Sequence[int], int], Sequence[EntryStore]]
"""Trains the missing ones of some seeds of each entry to an epoch; returns the entries' folders, finished or not."""


def tuning_seeds(requested: int | str | Iterable[int]) -> tuple[int, ...]:
    """Like `read_seeds`, but a bare number counts from 1,000,000."""
    seeds = tuple(read_seeds(requested))
    if isinstance(requested, int) or (isinstance(requested, str) and requested.isdecimal()):
        return tuple(TUNING_SEEDS + seed for seed in seeds)
    if seeds[0] < TUNING_SEEDS:
        raise OptionError(
            f"--seeds {requested}: tuning uses seeds from {TUNING_SEEDS} up, so that no settings are judged by the "
            f"runs that chose them; write --seeds {len(seeds)} for {TUNING_SEEDS} to {TUNING_SEEDS + len(seeds) - 1}"
        )
    return seeds


@dataclass(frozen=True)
class Request:
    """The input of a search.

    Attributes
    ----------
    entry:
        The entry to tune, as `qrlsuite.notation.parse_entry` reads it. All trials share its settings.
    grid, varied:
        The varied options: a grid file, and options with their own lists of values.
    trials, sampler_seed:
        See `qrlsuite.tuning.samplers`, and for `bayesian` `qrlsuite.tuning.bayesian`.
    regret:
        With `bayesian`, the expected regret at which the search ends.
    last:
        With `bayesian`, the seeds of each of the best three settings in the last round; 0 for none.
    rows:
        With `bayesian`, settings that are tried first: `lr=.002 buffer=10000` or `preset=FILE.toml`.
    budget:
        A time; or core-hours, with `bayesian`: as many trials as fit.
    seeds:
        Tuning seeds of every trial; with `bayesian` of the first ones, and others as many numbers on.
    epochs:
        Epochs of every trial; None for the task's protocol.
    """

    task: str
    entry: str
    settings: tuple[Setting, ...] = ()
    grid: space.GridFile | None = None
    varied: tuple[Setting, ...] = ()
    sampler: str = "grid"
    trials: int | None = None
    budget: Budget | None = None
    sampler_seed: int = 0
    regret: float = samplers.REGRET
    last: int = 0
    rows: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    epochs: int | None = None
    objective: Objective = "time"

    @property
    def core_hours(self) -> float | None:
        """With `bayesian`, the core-hours that limit the search."""
        return self.budget.core_hours if self.budget is not None and self.sampler == "bayesian" else None

    def seconds(self, workers: int) -> float | None:
        """Return the time that the search may take; None for no limit."""
        return None if self.budget is None or self.core_hours else self.budget.seconds(workers)


def read_requests(
    task: str,
    entries: Sequence[str],
    vary: str | Sequence[str] | Mapping[str, Any],
    sampler: str | None,
    seeds: int | str | Iterable[int] | None,
    epochs: int | None,
    objective: Objective,
    budget: str | None,
    where: Where,
) -> list[Request]:
    """Return a request for each entry, all of them with the same budget.

    Parameters
    ----------
    vary:
        See `qrlsuite.tuning.space.read_varied`.
    sampler:
        A name with options, `random trials=50 seed=1`. None takes all combinations of listed values; `bayesian` if a
        range is varied or settings are given.
    seeds:
        As `tuning_seeds` reads them; None takes `SEEDS`.
    """
    grid, varied, rows = space.read_varied(vary)
    listed = space.only_lists(grid, varied) and not rows
    name, chosen = samplers.read(sampler or ("grid" if listed else "bayesian"))
    own = tuning_seeds(SEEDS[name == "bayesian"] if seeds is None else seeds)
    for_bayesian = [f"--vary '{row}'" for row in rows]
    for_bayesian += [option for option in ("regret", "last") if getattr(chosen, option) is not None]
    if name != "bayesian" and for_bayesian:
        what = for_bayesian[0]
        raise OptionError(f"{what} is for --sampler bayesian, and not for {name}")
    limit = None if budget is None else Budget.parse(budget)
    if limit is not None and limit.time is not None:
        check_budget(budget, where)
    shared = Request(
        task,
        "",
        grid=grid,
        varied=varied,
        sampler=name,
        trials=chosen.trials,
        sampler_seed=chosen.seed,
        budget=limit,
        regret=samplers.REGRET if chosen.regret is None else chosen.regret,
        last=samplers.LAST * len(own) if chosen.last is None else chosen.last,
        rows=rows,
        seeds=own,
        epochs=epochs,
        objective=objective,
    )
    if not entries:
        raise OptionError("name at least one entry to tune, for example 'mlp width=16'")
    return [replace(shared, entry=entry) for entry in entries]


def preset_path(out: str | PathLike[str] | None, requests: Sequence[Request]) -> Path | None:
    """Check the name of the preset file."""
    path = None if out is None else Path(out)
    if path is not None and (len(requests) > 1 or path.suffix != ".toml"):
        raise OptionError(f"--out {path}: one file ending in .toml, for one entry")
    return path


@dataclass(frozen=True)
class Proposal:
    """Settings to try: their number, the seeds to train, and the seeds of earlier trials of these settings."""

    number: int
    point: space.Point
    seeds: tuple[int, ...]
    round: int = 0
    before: tuple[int, ...] = ()


@dataclass(frozen=True)
class Trial:
    """A finished trial.

    Attributes
    ----------
    number:
        Number of its settings, in the order of first trials.
    core_seconds:
        Core-seconds of its runs, with earlier trials of these settings.
    seeds, round:
        All that the settings were tried on so far; rounds of `bayesian` count from 0.
    spread:
        Standard deviation of a run in units of the mean, by leaving out one at a time; 0 of a single one.
    """

    number: int
    point: space.Point
    entry: Entry
    merit: Merit
    core_seconds: float
    seeds: tuple[int, ...]
    round: int = 0
    spread: float = 0.0


class Search(Shown):
    """One search over the settings of a model and an algorithm; shows its best settings.

    Parameters
    ----------
    results:
        The results folder; trials lie in its folder `tuning`.

    Attributes
    ----------
    trials:
        The finished trials, in the order in which they were begun.
    pending:
        Entries of trials whose runs are left to another process or a queue.
    written:
        The preset file, once it is written.
    """

    def __init__(self, request: Request, results: Path) -> None:
        self.request = request
        self.results = results
        self.runs = results / FOLDER
        self.notation = notation.parse_entry(request.entry).given(settings=request.settings)
        self.base = self._entry()
        if self.base.script is not None:
            raise OptionError(f"'{self.base.label}' is not tuned here: its settings are in its command")
        self.epochs = request.epochs or self.base.epochs
        self.trials: list[Trial] = []
        self.pending: list[Entry] = []
        self.written: Path | None = None
        self.asked = 0
        self._seconds: dict[tuple[str, int], float] = {}
        self._gpus: set[str] = set()
        self._begin()

    def _entry(self, point: space.Point | None = None) -> Entry:
        """Build the entry that is tuned, or the one at a point."""
        own = (*self.notation.settings, *space.settings(point or {}))
        return resolve(self.request.task, replace(self.notation, settings=own))

    def _begin(self) -> None:
        request = self.request
        self.space = self._space(request.grid is None and not request.varied)
        self.points = samplers.points(request.sampler, self.space, request.trials, request.sampler_seed)

    def _space(self, declared: bool) -> space.Space:
        """Return the search space; `declared` adds the ranges that algorithm and model declare."""
        request = self.request
        ranges = space.declared(self.base) if declared else {}
        return space.space(self.base, request.grid, request.varied, self.notation.settings, ranges)

    @property
    def planned(self) -> int:
        """How many trials there are to be."""
        return len(self.points)

    @property
    def runs_planned(self) -> int:
        """How many runs, each of one seed, all planned trials take."""
        return self.planned * len(self.request.seeds)

    @property
    def plan_text(self) -> str:
        """Say how many settings are tried on how many seeds."""
        seeds = self.request.seeds
        return (
            f"{counted(self.planned, 'trial')} ({samplers.NAMES[self.request.sampler]}), "
            f"each {counted(len(seeds), 'seed')} ({format_seeds(seeds)})"
        )

    @property
    def steps(self) -> int:
        """Environment steps of all planned trials."""
        return self.runs_planned * self.steps_per_run

    @property
    def steps_per_run(self) -> int:
        """Environment steps of one seed: the horizon."""
        return self.epochs * self.base.task.file.protocol.interactions

    @property
    def presentable(self) -> bool:
        """Whether the best settings so far can be written down."""
        return self.best is not None and not self.pending

    @property
    def best(self) -> Trial | None:
        """The best finished trial, the earliest of equals; None before any."""
        return next(iter(self.ordered), None)

    @property
    def over(self) -> bool:
        """Whether no further trial can be begun."""
        return self.asked == self.planned

    @property
    def beside(self) -> int:
        """How many settings can be trained side by side in one population, at most; the cost of a run depends on it."""
        return self.planned if self._per_agent else 1

    @property
    def _per_agent(self) -> bool:
        """Whether agents of one population may differ in all that is varied."""
        return all(self._free.issuperset(dimension.name.split("+")) for dimension in self.space)

    @property
    def _free(self) -> set[str]:
        """The options in which agents of one population may differ, by full name."""
        sides = {"algorithm": self.base.algorithm_options, "model": self.base.model_options}
        return {f"{side}.{name}" for side, own in sides.items() for name in options.per_agent(type(own))}

    @property
    def next_seeds(self) -> int:
        """How many seeds the next trial has."""
        return len(self.request.seeds)

    def step(self, train: Train, most: int = 1) -> list[Trial | None]:
        """Run the next trials, `most` at a time where they do not depend on each other, else fewer.

        Returns
        -------
        list
            A trial is None where some of its runs are left to another process or a queue.
        """
        begun = enumerate(self.points[self.asked : self.asked + most], start=self.asked + 1)
        return self._try([Proposal(number, point, self.request.seeds) for number, point in begun], train)

    def _try(self, proposals: Sequence[Proposal], train: Train) -> list[Trial | None]:
        """Train settings on the same seeds and look at their curves; None where some are left to others."""
        self.asked += len(proposals)
        entries = [self._entry(each.point) for each in proposals]
        stores = train(entries, proposals[0].seeds, self.epochs)
        return [self._judge(*each) for each in zip(proposals, entries, stores)]

    def _spread(self, curves: NDArray[np.float64], worth: Callable[[NDArray[np.float64]], Merit]) -> float:
        """Return the spread of a trial, see `Trial`, where the search needs it."""
        return 0.0

    def _judge(self, proposal: Proposal, entry: Entry, store: EntryStore) -> Trial | None:
        """Look at the curves of settings; None where some are left to others."""
        request, seeds = self.request, (*proposal.before, *proposal.seeds)
        if store.finished(seeds, self.epochs) != set(seeds):
            self.pending.append(entry)
            return None
        curves = np.stack([store.seed(seed).read().curve[: self.epochs] for seed in seeds])
        worth = partial(
            merit,
            ranking=entry.task.file.ranking,
            steps_per_epoch=entry.task.file.protocol.interactions,
            objective=request.objective,
        )
        own = {(entry.hash, seed): store.seed(seed).seconds() for seed in seeds}
        self._seconds |= own
        for seed in seeds:
            if (record := store.seed(seed).record()) is not None:
                self._gpus |= provenance.gpus(record.provenance)
        spent = sum(own.values())
        spread = self._spread(curves, worth)
        trial = Trial(
            proposal.number, proposal.point, entry, worth(curves), spent, seeds, proposal.round, spread
        )
        self.trials.append(trial)
        return trial

    @property
    def core_seconds(self) -> float:
        """Core-seconds spent on the finished trials; each run counts once."""
        return sum(self._seconds.values())

    @property
    def runs_done(self) -> int:
        """Runs, each of one seed, of the finished trials; each counts once."""
        return len(self._seconds)

    @property
    def path(self) -> Path:
        """Default path of the preset file; its name holds a digest of the request."""
        request, base = self.request, self.base
        key = digest(
            {
                "identity": base.identity,
                "space": {dimension.name: dimension.plain() for dimension in self.space},
                "sampler": self._sampler_key(),
                "runs": [list(request.seeds), self.epochs, request.objective],
            }
        )
        return self.runs / f"{base.task.name}-{base.algorithm.name}-{base.model.name}-{key[:8]}.toml"

    def _sampler_key(self) -> list[Any]:
        return [self.request.sampler, self.planned, self.request.sampler_seed]

    def preset(self) -> preset.PresetFile:
        """Return the best settings, and how they were found."""
        best = self.best
        if best is None:
            raise OptionError("no trial has finished yet, so there are no settings to write down")
        plugins = [
            registry.load().get(type(spec), spec.name).distribution
            for spec in (best.entry.model, best.entry.algorithm)
        ]
        how = self._how()
        trained = [f"trials trained on {', '.join(sorted(self._gpus))}"] if self._gpus else []
        notes = [text for text in (how.get("note"), *trained) if text]
        return preset.PresetFile(
            format_version=1,
            algorithm=best.entry.algorithm.name,
            model=best.entry.model.name,
            algorithm_options=options.plain(best.entry.algorithm_options),
            model_options=options.plain(best.entry.model_options),
            tuning=preset.TuningRecord(
                task=best.entry.task.name,
                objective=self.request.objective,
                value=best.merit.value,
                sampler=self.request.sampler,
                seeds=format_seeds(sorted({seed for trial in self.trials for seed in trial.seeds})),
                runs=self.runs_done,
                epochs=self.epochs,
                steps=self.runs_done * self.steps_per_run,
                versions=provenance.collect(plugins).versions,
                core_hours=float(f"{self.core_seconds / 3600:.3g}"),
                **{**how, "note": "; ".join(notes) or None},
            ),
        )

    def _how(self) -> dict[str, Any]:
        """Return the record of the choice of settings."""
        return {
            "trials": len(self.trials),
            "planned": self.planned,
            "space": {dimension.name: dimension.plain() for dimension in self.space},
        }

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values: trials from best to worst."""
        return {
            "task": self.base.task.name,
            "algorithm": self.base.algorithm.name,
            "model": self.base.model.name,
            "objective": cell_text(self.base.task.file.ranking, self.request.objective),
            "sampler": self.request.sampler,
            "space": {dimension.name: dimension.plain() for dimension in self.space},
            "planned": self.planned,
            "pending": len(self.pending),
            "runs": self.runs_done,
            "epochs": self.epochs,
            "core_hours": self.core_seconds / 3600,
            "preset": None if self.written is None else str(self.written),
            "trials": [
                {
                    "number": trial.number,
                    "settings": trial.point,
                    "entry": trial.entry.name,
                    "round": trial.round,
                    "seeds": format_seeds(trial.seeds),
                    "value": trial.merit.value,
                    "mean_time": trial.merit.time,
                    "sample_complexity": trial.merit.cell,
                    "unsettled": trial.merit.unsettled,
                    "area": trial.merit.area,
                    "mean_score": trial.merit.score,
                    "core_hours": trial.core_seconds / 3600,
                }
                for trial in self.ordered
            ],
        }

    def write(self, path: Path) -> None:
        """Write the best settings to a preset file, atomically."""
        best_preset = self.preset()
        base = self.base
        comment = (
            f"Settings found by `qrlsuite tune` ({cell_text(base.task.file.ranking, self.request.objective)}); to use "
            f"them:\n  qrlsuite run {base.model.name} preset={path.name} --task {self.request.task}"
        )
        write_atomically(path, preset.dumps(best_preset, comment).encode())
        self.written = path

    @property
    def regret_text(self) -> str:
        """Say how good the best settings are, where the search knows it."""
        return ""

    @property
    def ordered(self) -> list[Trial]:
        """The finished trials from best to worst."""
        return sorted(self.trials, key=lambda trial: (trial.merit.order, trial.number))

    def __rich_console__(self, console: Console, console_options: ConsoleOptions) -> RenderResult:
        """Show the best trials, a row each."""
        ranking = self.base.task.file.ranking
        rows = [
            (
                str(trial.number),
                space.text(trial.point),
                self._seeds_text(trial),
                steps_text(trial.merit.time),
                f"{'>= ' * trial.merit.unsettled}{steps_text(trial.merit.cell)}",
                steps_text(trial.merit.area),
                f"{trial.merit.score:.4f}",
                hours_text(trial.core_seconds / 3600),
            )
            for trial in self.ordered[:SHOWN]
        ]
        yield Sheet.of(
            f"{self.base.label} on {self.base.task.name}: the best of {len(self.trials)} trials, "
            f"{self.runs_done} runs x {self.epochs} epochs, {hours_text(self.core_seconds / 3600)} core-hours",
            ("trial", "settings", "seeds", "M", "S_hat", "area", "mean score", "core-hours"),
            rows,
            notes=(
                f"minimized: {cell_text(ranking, self.request.objective)}; ties by the area, then by the mean score "
                f"over all epochs. {self._warning}",
            ),
            words=("settings",),
        )

    @property
    def _warning(self) -> str:
        return "Chosen as the best of many, the first row looks too good: judge it on protocol seeds"

    def _seeds_text(self, trial: Trial) -> str:
        return str(len(trial.seeds))


def merit_text(trial: Trial) -> str:
    """Write a trial's worth: `M 54k, S_hat >= 60k, area 51k, mean score 0.712`."""
    merit = trial.merit
    sign = ">= " if merit.unsettled else ""
    return (
        f"M {steps_text(merit.time)}, S_hat {sign}{steps_text(merit.cell)}, area {steps_text(merit.area)}, "
        f"mean score {merit.score:.4f}"
    )
