"""What `qrlsuite tune` shows: size and cost, a line per trial, the best settings."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.terminal import command, table_console
from qrlsuite.cli.training import Place, Plan
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import speed
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import counted, duration, hours_text, steps_text
from qrlsuite.tuning.objective import cell_text
from qrlsuite.tuning.samplers import NAMES
from qrlsuite.tuning.search import Search, Trial, as_dict

SHOWN = 10
"""Rows of the table of best settings."""


def plain(search: Search) -> dict[str, Any]:
    """Return a search as plain values."""
    return as_dict(search)


class TuneDisplay:
    """Shows a search: a live bar on a terminal, a line per trial everywhere, nothing when quiet."""

    def __init__(self, searches: Sequence[Search], where: Place, runs: Path, quiet: bool) -> None:
        self.searches, self.where, self.runs = searches, where, runs
        self.console = Console(stderr=True, quiet=quiet, highlight=False)
        self.live: Progress | None = None
        self.bar: Any = None
        self._began = time.monotonic()
        self._trained = 0
        self._work: Plan | None = None

    def begin(self) -> None:
        """Say how large each search is, and what it will cost as far as that is known."""
        total: float | None = 0.0
        bases: dict[str, None] = {}
        for search in self.searches:
            request, base = search.request, search.base
            seeds = len(request.seeds)
            lines = [
                f"{base.label} on {base.task.name}: {search.planned} trials ({NAMES[request.sampler]}), each "
                f"{seeds} seeds ({format_seeds(request.seeds)}) x {search.epochs} epochs, "
                f"{steps_text(search.steps)} steps in all",
                *(f"  {dimension.name}: {_short(dimension.plain())}" for dimension in search.space),
                f"  minimized: {cell_text(base.task.file.ranking, request.objective)}",
            ]
            self.console.print("\n".join(lines), markup=False)
            hours, basis = self._hours(search)
            bases.setdefault(basis)
            total = None if total is None or hours is None else total + hours
        cores = self.where.workers
        if total is None:
            self.console.print("what it costs will be known after the first trial")
        else:
            self.console.print(
                f"about {hours_text(total)} core-hours, {duration(total * 3600 / cores)} with "
                f"{counted(cores, 'process', 'processes')} ({'; '.join(bases)}); finished trials cost nothing again"
            )

    def _hours(self, search: Search) -> tuple[float | None, str]:
        """Return the core-hours of a whole search, None where unknown, and what that rests on."""
        found = speed.known(search.runs, self.runs).estimate(search.base)
        basis = speed.BASES[found.basis]
        if found.seconds is None:
            return None, basis
        return found.seconds * search.planned * len(search.request.seeds) * search.epochs / 3600, basis

    def trial(self, entry: Entry, work: Plan) -> None:
        """Show that a trial begins."""
        self._work = work
        self._trained += bool(work.groups)
        if work.busy:
            self.console.print(
                f"{entry.label}: {len(work.busy)} runs are left to another process or a queue", markup=False
            )
        if self.live is None and self.console.is_terminal:
            self.live = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[status]}", markup=False),
                console=self.console,
                transient=True,
            )
            self.live.start()
            self.bar = self.live.add_task(
                "tuning", total=sum(search.planned for search in self.searches), status=""
            )
        self.update({})

    def update(self, snapshot: dict[str, dict[str, Any]]) -> None:
        """Show where the trial at work stands."""
        if self.live is None or self._work is None:
            return
        asked = sum(search.asked for search in self.searches)
        work = self._work
        epochs = [int(snapshot.get(group.id, {}).get("epoch") or group.epoch) for group in work.groups]
        part = sum(epochs) / (len(epochs) * work.epochs) if epochs else 0.0
        words = [f"trial {asked}/{sum(search.planned for search in self.searches)}"]
        words += [f"epoch {min(epochs)}/{work.epochs}"] if epochs else []
        words += [f"best {steps_text(s.best.merit.value)}" for s in self.searches if s.best is not None]
        left = self._left()
        if left is not None:
            words.append(f"{duration(left)} left")
        self.live.update(self.bar, completed=asked - 1 + part, status="  ".join(words))

    def _left(self) -> float | None:
        """Return the seconds left by the pace of the trials that were trained now; None before one was."""
        done = self._trained - 1
        if done < 1:
            return None
        left = sum(search.planned - search.asked + 1 for search in self.searches)
        return (time.monotonic() - self._began) / done * left

    def told(self, search: Search, trial: Trial | None) -> None:
        """Show a trial's result."""
        from qrlsuite.tuning.space import text

        if trial is None:
            return
        best = "  best so far" if search.best is trial else ""
        several = f"{search.base.model.name}  " if len(self.searches) > 1 else ""
        self.console.print(
            f"{several}trial {trial.number}/{search.planned}  {text(trial.point)}: {merit_text(trial)}{best}",
            markup=False,
            soft_wrap=True,
        )

    def close(self) -> None:
        """Take the live bar away."""
        if self.live is not None:
            self.live.stop()
            self.live = None

    def interrupted(self) -> None:
        """Say that everything is safe."""
        self.close()
        done = sum(len(search.trials) for search in self.searches)
        self.console.print(
            f"stopped after {done} trials; every finished epoch is saved. The same command continues from there.",
            soft_wrap=True,
        )


def merit_text(trial: Trial) -> str:
    """Write a trial's worth: `S_hat >= 60k, area 51k, mean score 0.712`."""
    merit = trial.merit
    sign = ">= " if merit.unsettled else ""
    return (
        f"S_hat {sign}{steps_text(merit.cell)}, area {steps_text(merit.area)}, mean score {merit.score:.4f}"
    )


def _short(values: Any) -> str:
    text = str(values)
    return text if len(text) <= 100 else f"{text[:97]}..."


def report(searches: Sequence[Search], written: Mapping[int, Path], runs: Path, complete: bool) -> None:
    """Print the best settings of each search, its preset file, and what to type next."""
    wide = table_console()
    for i, search in enumerate(searches):
        if search.trials:
            wide.print(_table(search))
        if i in written:
            wide.print(f"wrote {written[i]}", markup=False, soft_wrap=True)
    if len(searches) > 1:
        counts = " and ".join(
            f"{len(search.trials)} ({hours_text(search.core_seconds / 3600)} core-hours)"
            for search in searches
        )
        wide.print(
            f"trials of {' and '.join(search.base.model.name for search in searches)}: {counts}", markup=False
        )
    waiting = sum(len(search.pending) for search in searches)
    if waiting:
        wide.print(
            f"{waiting} trials wait for other processes or a queue: repeat this command when they have ended"
        )
    elif not complete:
        left = sum(search.planned - search.asked for search in searches)
        wide.print(f"the budget is spent, {left} trials are left: the same command continues")
    for i, path in written.items():
        base = searches[i].base
        words = ["run", "--task", searches[i].request.task, "--model", base.model.name]
        if base.algorithm.name != base.task.file.default_algorithm:
            words += ["--algorithm", base.algorithm.name]
        line = command(*words, "--preset", str(path), runs=runs)
        wide.print(f"next: {line}", markup=False, soft_wrap=True)


def _table(search: Search) -> Any:

    from qrlsuite.tuning.space import text

    ranking = search.base.task.file.ranking
    seeds = len(search.request.seeds)
    table = Table(
        title=Text(
            f"{search.base.label} on {search.base.task.name}: the best of {len(search.trials)} trials, "
            f"{seeds} seeds x {search.epochs} epochs, {hours_text(search.core_seconds / 3600)} core-hours"
        ),
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        caption=Text(
            f"minimized: {cell_text(ranking, search.request.objective)}; ties by the other, then by the mean score "
            "over all epochs. Chosen as the best of many, the first row looks too good: judge it on protocol seeds"
        ),
        caption_justify="left",
        pad_edge=False,
    )
    for name in ("trial", "settings", "S_hat", "area", "mean score", "core-hours"):
        table.add_column(Text(name), justify="left" if name == "settings" else "right", overflow="fold")
    for trial in sorted(search.trials, key=lambda t: (t.merit.order, t.number))[:SHOWN]:
        merit = trial.merit
        row = [
            str(trial.number),
            text(trial.point),
            f"{'>= ' * merit.unsettled}{steps_text(merit.cell)}",
            steps_text(merit.area),
            f"{merit.score:.4f}",
            hours_text(trial.core_seconds / 3600),
        ]
        table.add_row(*(Text(cell) for cell in row))
    return table
