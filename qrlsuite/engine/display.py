"""Shows the progress of training, and estimates the time that is left."""

from __future__ import annotations

import statistics
import time
from collections.abc import Collection, Mapping, Sequence
from html import escape as escape_html
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TextColumn

from qrlsuite import registry, specs
from qrlsuite.engine.terminal import again, command, printable
from qrlsuite.engine.work import Missing
from qrlsuite.errors import listed
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results import lookup
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import entries
from qrlsuite.results.survey import GroupStatus
from qrlsuite.results.text import counted, duration

PLAIN_SECONDS = 20.0
"""Seconds between lines where the output is not a terminal."""

ROUNDS_SECONDS = 20.0
"""Seconds of a first epoch after which its rounds tell what is left."""

DAY = 86400.0

PHASES = {
    "starting": "starting",
    "compiling": "compiling circuits: once per machine",
    "probing": "probing",
    "comparing": "comparing a seed with its record",
}
"""Texts for a group's phases before its first epoch, which are no part of an epoch's time."""


class Clock:
    """Times one group from its progress: its epochs, and the rounds of its first one.

    Once two epochs have ended, a process's first epoch is left out, since it includes one-time work (memory that fills
    up, code that is compiled at its first run). Until then its rounds tell how long an epoch takes at least: learning
    and validation may follow them.
    """

    def __init__(self, epoch: int) -> None:
        self.first = epoch
        self.begun: float | None = None
        """When the group was started, or first heard of."""
        self.marks: list[tuple[int, float]] = []
        """Epochs, and when they were seen to have ended."""
        self.parts: list[tuple[float, float]] = []
        """Parts of the first epoch's rounds that were done, and when that was first seen: the first and the last."""

    def look(self, state: Mapping[str, Any], now: float) -> None:
        """Take in where the group stands."""
        if not state:
            return
        self.begun = now if self.begun is None else self.begun
        epoch, done = int(state.get("epoch") or 0), int(state.get("done") or 0)
        if epoch > (self.marks[-1][0] if self.marks else self.first):
            self.marks.append((epoch, now))
            self.parts = [*self.parts[:1], (1.0, now)]
        elif not self.marks and state.get("phase") in ("training", "validating"):
            part = done / max(1, int(state.get("total") or 0)) if state["phase"] == "training" else 1.0
            if not self.parts or part == 1.0 or part > self.parts[-1][0]:
                self.parts = [*self.parts[:1], (part, now)]

    @property
    def pace(self) -> float | None:
        """Seconds per epoch, over the later half of the epochs that were timed, or by the first rounds; else None."""
        if not self.settled:
            (part, began), (last, ended) = (
                self.parts[:1] + self.parts[-1:] if self.parts else [(0.0, 0.0)] * 2
            )
            return (
                (ended - began) / (last - part) if ended - began >= ROUNDS_SECONDS and last > part else None
            )
        last, ended = self.marks[-1]
        middle = (self.marks[0][0] + last) // 2
        epoch, began = max(mark for mark in self.marks[:-1] if mark[0] <= max(middle, self.marks[0][0]))
        return (ended - began) / (last - epoch)

    @property
    def settled(self) -> bool:
        """Whether whole epochs were timed, and `pace` is not of rounds."""
        return len(self.marks) >= 2

    @property
    def once(self) -> float:
        """Seconds of one-time work: the start, and the extra time of the first epoch."""
        if self.begun is None or self.pace is None:
            return 0.0
        if not self.marks:
            return self.parts[0][1] - self.begun
        epoch, ended = self.marks[0]
        return max(0.0, ended - self.begun - (epoch - self.first) * self.pace)

    def left(self, epochs: int, now: float) -> float | None:
        """Return the seconds left; an epoch is assumed to take at least as long as the current one so far."""
        if self.pace is None:
            return None
        part, began = self.parts[0] if self.parts else (0.0, now)
        epoch, ended = self.marks[-1] if self.marks else (self.first, began - part * self.pace)
        elapsed = now - ended
        return max(0.0, (epochs - epoch) * max(self.pace, elapsed) - elapsed)


def turns(state: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many turns of a group have ended, and how many there are, where not all seeds are trained at once."""
    number = max(1, int(state.get("turns") or 1))
    return min(int(state.get("turn") or 0), number - 1), number


class CostEstimate:
    """Estimates the remaining time: from a group's first rounds, and from whole epochs once two have ended."""

    def __init__(self, groups: Sequence[SeedGroup], epochs: int, workers: int) -> None:
        self.groups = {group.id: group for group in groups}
        self.epochs = epochs
        self.workers = min(workers, max(1, len(groups)))
        self._clocks = {name: Clock(group.epoch) for name, group in self.groups.items()}
        self._turns = dict.fromkeys(self.groups, 1)
        self._began = False

    def _span(self, name: str) -> int:
        """Return the number of epochs in each turn of a group."""
        return self.epochs - self.groups[name].epoch

    def remaining(self, snapshot: Mapping[str, Mapping[str, Any]], now: float) -> float | None:
        """Return the seconds left on these workers, None before enough was measured."""
        if not self._began:
            self._began = True
            for clock in list(self._clocks.values())[: self.workers]:
                clock.begun = now
        for name, state in snapshot.items():
            turn, self._turns[name] = turns(state)
            epoch = int(state.get("epoch") or 0) + turn * self._span(name)
            self._clocks[name].look({**state, "epoch": epoch} if state else state, now)
        timed = {name: clock for name, clock in self._clocks.items() if clock.pace is not None}
        if not timed:
            return None
        pace = statistics.mean(
            (clock.pace or 0.0) * self._turns[name] / len(self.groups[name].seeds)
            for name, clock in timed.items()
        )
        once = statistics.mean(clock.once for clock in timed.values())
        total, longest = 0.0, 0.0
        for name, group in self.groups.items():
            clock = self._clocks[name]
            last = group.epoch + self._turns[name] * self._span(name)
            left = clock.left(last, now)
            if left is None:  # it waits for a worker, or is at its first epochs
                epoch = clock.marks[-1][0] if clock.marks else group.epoch
                left = (last - epoch) * pace * len(group.seeds) / self._turns[name]
                left += 0.0 if clock.begun is not None else once
            total += left
            longest = max(longest, left)
        return max(total / self.workers, longest)

    @property
    def settled(self) -> bool:
        """Whether the pace of some group was measured over epochs."""
        return any(clock.settled for clock in self._clocks.values())


PROBING = (
    "probing: the middle seed of a group is trained again alone in a fresh process, to show that it does not depend on "
    "the others"
)


class Bar:
    """One progress bar: on a terminal and in a notebook, nowhere else.

    A notebook's bar is one output that is replaced, which needs no package beside the notebook's own.
    """

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self.console = console
        self._columns = columns or (TaskProgressColumn(),)
        self._live: Progress | None = None
        self._cell: Any = None
        self._bar: Any = None
        self._total = 0.0

    @property
    def shown(self) -> bool:
        """Whether there is a bar."""
        return self._live is not None or self._cell is not None

    def start(self, total: float, description: str) -> None:
        """Show the bar, where it can be shown and is not yet."""
        if self.shown or self.console.quiet or not (self.console.is_terminal or self.console.is_jupyter):
            return
        self._total = total
        if self.console.is_jupyter:
            from IPython.display import display  # in a notebook, it is there

            self._cell = display(self._html(0.0, description, ""), raw=True, display_id=True)
            return
        self._live = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            *self._columns,
            TextColumn("{task.fields[status]}", markup=False),
            console=self.console,
            transient=True,
        )
        self._live.start()
        self._bar = self._live.add_task(description, total=total, status="")

    def update(self, completed: float, description: str, status: str = "") -> None:
        """Show how far it is."""
        if self._live is not None:
            self._live.update(self._bar, completed=completed, description=description, status=status)
        elif self._cell is not None:
            self._cell.update(self._html(completed, description, status), raw=True)

    def stop(self) -> None:
        """Take the bar away."""
        if self._live is not None:
            self._live.stop()
            self._live = None
        if self._cell is not None:
            self._cell.update({"text/html": "", "text/plain": ""}, raw=True)
            self._cell = None

    def _html(self, completed: float, description: str, status: str) -> dict[str, str]:
        """Return the bar in the forms that a notebook chooses from."""
        share = completed / self._total if self._total else 0.0
        text = f"{description}  {share:.0%}  {status}"
        bar = f"<progress value='{share:.4f}' max='1'></progress>"
        return {"text/html": f"{bar} {escape_html(text)}", "text/plain": text}


def _range(numbers: Collection[int]) -> str:
    """Return the least and the greatest: `3`, or `3 to 10`."""
    least, greatest = min(numbers), max(numbers)
    return f"{least}" if least == greatest else f"{least} to {greatest}"


class RunDisplay:
    """Shows the training of one entry: a live bar on a terminal or in a notebook, lines elsewhere, nothing when quiet.

    Parameters
    ----------
    workers:
        Groups that are trained at a time.
    """

    def __init__(self, missing: Missing, workers: int, quiet: bool = False) -> None:
        self.missing, self.entry, self.epochs, self.groups = (
            missing,
            missing.entry,
            missing.epochs,
            missing.groups,
        )
        self.console = Console(stderr=True, quiet=quiet, highlight=False)
        self.estimate = CostEstimate(missing.groups, missing.epochs, workers)
        self.workers = min(workers, max(1, len(missing.groups)))
        self.again = again()
        self.new_folder = not missing.runs.exists()
        self.bar = Bar(self.console)
        self.deadline: float | None = None
        """The moment, by `time.monotonic`, at which training is stopped."""
        self.expected: str | None = None
        """The first estimate of the time that is left, as printed."""
        self.endless = False
        """Whether more than a day is left, by the pace of epochs."""
        self.probing = False
        """Whether a group has made a probe, see `qrlsuite.engine.probe`."""
        self._announced = self._advised = False
        self._last_line = time.monotonic()
        self._last: dict[str, dict[str, Any]] = {}

    def _say(self, text: str) -> None:
        """Print a sentence without markup, on one line."""
        self.console.print(text, markup=False, soft_wrap=True)

    def begin(self, submits: bool = False, holders: Sequence[str] = ()) -> None:
        """Print the plan, for training here or for submitted tasks.

        Parameters
        ----------
        holders:
            The processes that train the busy seeds: `process 12 on HOST`.
        """
        task, busy = self.entry.task, self.missing.busy
        self.console.print(
            f"[bold]{escape(self.entry.label)}[/bold] on [bold]{task.name}[/bold]  "
            f"({escape(str(self.missing.store.path))})"
        )
        if self.new_folder:
            self._say(
                f"results are in the new folder {self.missing.runs.absolute()}; "
                f"{'--runs or QRLSUITE_RUNS' if self.again == 'command' else '`runs`'} names another"
            )
        todo = sum(len(group.seeds) for group in self.groups)
        if busy:
            are = "is" if len(busy) == 1 else "are"
            waits = "waits in the queue or is" if len(busy) == 1 else "wait in the queue or are"
            who = f" by {', '.join(holders)}" if holders else ""
            nothing = "" if todo else ": nothing is left to do here"
            self._say(
                f"{counted(len(busy), 'seed')} {waits if submits else are} being trained{who}{nothing}; repeat this "
                f"{self.again} when that has ended to see the whole"
            )
        if not todo:
            return
        resumed = sum(len(group.seeds) for group in self.groups if group.epoch)
        begun = {group.epoch for group in self.groups if group.epoch}
        complete = len(self.missing.seeds) - len(busy) - todo
        places = f"task{'s' * (self.workers > 1)}" if submits else f"process{'es' * (self.workers > 1)}"
        parts = [f"{counted(todo, 'seed')} to epoch {self.epochs}, {self.workers} {places}"]
        parts += [f"{counted(complete, 'seed')} already there"] if complete else []
        parts += [f"{resumed} resume{'s' * (resumed == 1)} at epoch {_range(begun)}"] if resumed else []
        end = f" Ctrl-C saves; the same {self.again} continues."
        if self.entry.script is not None:
            end = f" After Ctrl-C the same {self.again} starts unfinished seeds again."
        end = "" if submits else end
        self.console.print("; ".join(parts) + "." + end)
        notes = [f"note: {line}" for line in self.entry.unusable(self.epochs)]
        model = self.entry.model
        if model.faster in registry.load().names(specs.ModelSpec):
            notes.append(f"faster: --model {model.faster} computes the same, {model.speedup}")
        for line in [*notes, *filter(None, [self.expected])]:
            self._say(line)
        if submits:
            return
        self.bar.start(todo * self.epochs, "starting")

    def update(self, snapshot: dict[str, dict[str, Any]]) -> None:
        """Show where every group stands."""
        now = time.monotonic()
        self._last = snapshot
        if not self.probing and any(state.get("phase") == "probing" for state in snapshot.values()):
            self.probing = True
            self._say(PROBING)
        left = self.estimate.remaining(snapshot, now)
        if left is not None:
            self._announce(left)
        if left is not None and self.deadline is not None:
            left = min(left, max(0.0, self.deadline - now))
        done, completed, epochs = 0.0, 0, []
        scores: list[float] = []
        diverged = 0
        for group in self.groups:
            state = snapshot.get(group.id, {})
            epoch = int(state.get("epoch") or group.epoch)
            fraction = 0.0
            if state.get("phase") == "training" and state.get("total"):
                fraction = 0.8 * float(state["done"]) / float(state["total"])
            turn, number = turns(state)
            part = min(self.epochs, epoch + fraction) - group.epoch + turn * (self.epochs - group.epoch)
            done += (group.epoch + part / number) * len(group.seeds)
            completed += len(group.seeds) * (state.get("phase") == "finished")
            epochs.append(epoch)
            scores += state.get("seed_scores") or []
            diverged += sum(state.get("seed_diverged") or [])
        parts = [
            f"seeds {completed}/{sum(len(g.seeds) for g in self.groups)}",
            f"epoch {_range(epochs)}/{self.epochs}",
        ]
        parts += [f"median score {statistics.median(scores):.3f}"] if scores else []
        parts += [f"{diverged} diverged"] if diverged else []
        parts.append(f"{duration(left)} left" if left is not None else self._phase(snapshot))
        text = "  ".join(parts)
        if self.bar.shown:
            self.bar.update(done, "training", text)
        elif now - self._last_line >= PLAIN_SECONDS:
            self._last_line = now
            self.console.print(text)

    def _phase(self, snapshot: Mapping[str, Mapping[str, Any]]) -> str:
        """Return the text shown before any time is known: the earliest phase of a group."""
        phases = {str(state.get("phase")) for state in snapshot.values() if state} or {"starting"}
        return next((text for phase, text in PHASES.items() if phase in phases), "measuring")

    def _announce(self, left: float) -> None:
        """Print the time that is left once it is known; advise and sound the alarm once two epochs have ended."""
        settled = self.estimate.settled
        if left >= 10 and not self._announced:
            by = (
                "about {} left, by the pace since epoch 1"
                if settled
                else "{} or more left, by the first rounds"
            )
            self._say(by.format(duration(left)))
        self._announced = True
        if settled and not self._advised:
            self._advised, self.endless = True, left > DAY
            if left > 3600:
                self._say(
                    "faster: fewer --seeds or --epochs, or --engine slurm on a cluster; every trained seed counts"
                )

    def close(self) -> None:
        """Take the live bar away."""
        self.bar.stop()

    def interrupted(self) -> None:
        """Say that everything is safe."""
        self.close()
        self._say(f"stopped; {self._goes_on}.")

    def out_of_time(self, budget: str) -> None:
        """Print that the budget has ended, the epochs so far, and the command that continues."""
        self.close()
        epochs = _range([int(state.get("epoch") or 0) for state in self._last.values()] or [0])
        limit = "--budget" if self.again == "command" else "`budget`"
        self._say(
            f"stopped after {budget}, at epoch {epochs} of {self.epochs}; {self._goes_on}, and without {limit} to the "
            "end."
        )

    @property
    def _goes_on(self) -> str:
        """Describe the saved part of stopped training, and how it goes on."""
        if self.entry.script is not None:
            return f"every finished seed is saved. The same {self.again} starts the others again"
        return f"every finished epoch is saved. The same {self.again} continues from there"

    def finished(self, summary: dict[str, Any], at_work: Sequence[GroupStatus] = ()) -> None:
        """Print a summary, the groups that others train, and the next command."""
        self.close()
        for group in at_work:
            self._say(printable(group.text))
        if at_work and not summary["seeds"]:
            return
        score = summary["median_score"]
        ranked, goal = self.entry.task.file.score.called, self.entry.task.file.score.goal
        score_text = (
            f", median {ranked} {score:.3f} after epoch {summary['epochs']}" if score is not None else ""
        )
        self.console.print(f"{counted(summary['seeds'], 'seed')} complete{score_text}")
        if summary["threshold_reached"] is False:
            self._say(
                f"no seed reached a threshold: the {'lowest' if goal == 'above' else 'highest'} is "
                f"{summary['lowest_threshold']:.4g}, the best {ranked} seen {summary['best_score']:.4g}. Entries that "
                "reach none are not told apart by steps: train longer (--epochs), rank 20 seeds or more by learning "
                f"curves alone (leaderboard --by area), or {'lower' if goal == 'above' else 'raise'} the thresholds "
                "([ranking] in the task file) before the next entry is trained"
            )
        if summary["diverged"]:
            self._say(
                f"{summary['diverged']} of them diverged: numbers of their agents are no longer finite. "
                "They stay in the results with their scores; a smaller learning rate is the usual cure"
            )
        protocol_seeds = self.entry.task.file.protocol.seeds
        if summary["seeds"] < protocol_seeds:
            self.console.print(f"provisional: the task's protocol asks for {protocol_seeds} seeds")
        self._say(f"results: {self.missing.store.path}")
        if min(self.missing.seeds) >= TUNING_SEEDS:
            self._say(
                f"seeds from {TUNING_SEEDS:,} up are for trying settings: boards and pictures leave them out"
            )
            return
        if not summary["seeds"] and not any(state.get("epoch") for state in self._last.values()):
            return  # nothing was trained that a board or a picture could show
        name = self.entry.task.name
        stored = lookup.stored(entries(self.missing.runs, name))
        others = [each.name for each in stored if each.key[1] not in ("", self.entry.task.hash)]
        if others:
            delete = command("runs", "rm", f"{name}/{others[0]}", runs=self.missing.runs)
            self._say(
                f"{counted(len(others), 'entry')} of another definition of task '{name}' here: {listed(others, 3)}. "
                "Boards rank the definition with the most entries (--task FILE.toml: that of the file), pictures need "
                f"a single one. To delete: {delete}"
            )
        for arguments in (("leaderboard", "--task", name), ("plot", "curves", "--task", name)):
            self._say(f"next: {command(*arguments, runs=self.missing.runs)}")
