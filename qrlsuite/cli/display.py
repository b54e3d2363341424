"""The progress display of `qrlsuite run`: what is being trained, how far it is, what is left, what it costs."""

from __future__ import annotations

import statistics
import time
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

if TYPE_CHECKING:
    from qrlsuite.experiment.entry import Entry
    from qrlsuite.results.seeds import Group
    from qrlsuite.results.store import EntryStore

PLAIN_SECONDS = 20.0
"""Seconds between lines where the output is not a terminal."""

FASTER = {"vqc-pennylane": "vqc-native", "vqc-qiskit": "vqc-native"}


def hours_text(hours: float) -> str:
    """Write core-hours to two digits, large ones as whole numbers."""
    return f"{hours:,.0f}" if hours >= 10 else f"{hours:.2g}"


def duration(seconds: float) -> str:
    """Write a duration as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    if seconds < 36 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


class CostEstimate:
    """What is left, measured: from the rounds of the first epoch at first, then from whole epochs."""

    def __init__(self, groups: Sequence[Group], epochs: int, workers: int) -> None:
        self.groups = {group.id: group for group in groups}
        self.epochs = epochs
        self.workers = min(workers, max(1, len(groups)))
        self._first: dict[str, tuple[float, int]] = {}
        self._measured: dict[str, float] = {}

    def remaining(self, snapshot: dict[str, dict[str, Any]], now: float) -> float | None:
        """Return the seconds left on these workers, None before anything was measured."""
        per_epoch = {name: self._epoch_seconds(name, state, now) for name, state in snapshot.items()}
        known = [
            seconds / len(self.groups[name].seeds)
            for name, seconds in per_epoch.items()
            if seconds is not None
        ]
        if not known:
            return None
        mean = sum(known) / len(known)
        total, longest = 0.0, 0.0
        for name, group in self.groups.items():
            state = snapshot.get(name, {})
            measured = per_epoch.get(name)
            seconds = measured if measured is not None else mean * len(group.seeds)
            left = self.epochs - float(state.get("epoch") or group.epoch)
            if state.get("phase") == "training" and state.get("total"):
                left -= (
                    0.8 * float(state["done"]) / float(state["total"])
                )  # the rest of an epoch is validation
            total += max(0.0, left) * seconds
            longest = max(longest, max(0.0, left) * seconds)
        return max(total / self.workers, longest)

    def _epoch_seconds(self, name: str, state: dict[str, Any], now: float) -> float | None:
        if state.get("epoch_seconds"):
            return float(state["epoch_seconds"])
        done, total = int(state.get("done") or 0), int(state.get("total") or 0)
        if state.get("phase") == "training" and total and done:
            began, before = self._first.setdefault(name, (now, done))
            if done - before >= 2 and now - began >= 2.0:
                self._measured[name] = 1.25 * total * (now - began) / (done - before)
        return self._measured.get(name)  # the first epoch's validation adds nothing: what was measured stays


class RunDisplay:
    """Shows one `qrlsuite run`: a live bar on a terminal, lines elsewhere, nothing when quiet."""

    def __init__(
        self,
        entry: Entry,
        store: EntryStore,
        seeds: Sequence[int],
        epochs: int,
        groups: Sequence[Group],
        workers: int,
        quiet: bool,
    ) -> None:
        self.entry, self.store, self.seeds, self.epochs, self.groups = entry, store, seeds, epochs, groups
        self.console = Console(stderr=True, quiet=quiet, highlight=False)
        self.estimate = CostEstimate(groups, epochs, workers)
        self.workers = min(workers, max(1, len(groups)))
        self.live: Progress | None = None
        self.bar: Any = None
        self._announced = False
        self._last_line = time.monotonic()

    def begin(self, busy: Collection[int], submits: bool = False) -> None:
        """Say what will be done, here or by tasks that are submitted and left."""
        task = self.entry.task
        self.console.print(
            f"[bold]{escape(self.entry.label)}[/bold] on [bold]{task.name}[/bold]  ({escape(str(self.store.path))})"
        )
        if busy:
            self.console.print(
                f"{len(busy)} of the seeds "
                + (
                    "wait in the queue or are being trained"
                    if submits
                    else "are being trained by another process"
                )
                + " and are left to it; repeat this command when it has ended to see the whole"
            )
        todo = sum(len(group.seeds) for group in self.groups)
        if not todo:
            return
        resumed = sum(len(group.seeds) for group in self.groups if group.epoch)
        there = len(self.seeds) - len(busy) - todo
        places = f"task{'s' * (self.workers > 1)}" if submits else f"process{'es' * (self.workers > 1)}"
        parts = [f"{todo} seeds to epoch {self.epochs}, {self.workers} {places}"]
        parts += [f"{there} seeds are already there"] * bool(there) + [f"{resumed} resume"] * bool(resumed)
        end = "" if submits else " Ctrl-C saves; the same command continues."
        self.console.print("; ".join(parts) + "." + end)
        if submits:
            return
        if self.console.is_terminal:
            self.live = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[status]}"),
                console=self.console,
                transient=True,
            )
            self.live.start()
            self.bar = self.live.add_task("starting", total=todo * self.epochs, status="")

    def update(self, snapshot: dict[str, dict[str, Any]]) -> None:
        """Show where every group stands."""
        now = time.monotonic()
        left = self.estimate.remaining(snapshot, now)
        if left is not None and not self._announced:
            self._announce(left)
        done, completed, epochs = 0.0, 0, []
        scores: list[float] = []
        for group in self.groups:
            state = snapshot.get(group.id, {})
            epoch = int(state.get("epoch") or group.epoch)
            fraction = 0.0
            if state.get("phase") == "training" and state.get("total"):
                fraction = 0.8 * float(state["done"]) / float(state["total"])
            done += min(self.epochs, epoch + fraction) * len(group.seeds)
            completed += len(group.seeds) * (state.get("phase") == "finished")
            epochs.append(epoch)
            scores += state.get("seed_scores") or []
        words = [
            f"seeds {completed}/{sum(len(g.seeds) for g in self.groups)}",
            f"epoch {min(epochs)}/{self.epochs}",
        ]
        words += [f"median score {statistics.median(scores):.3f}"] if scores else []
        words += [f"{duration(left)} left"] if left is not None else ["measuring"]
        text = "  ".join(words)
        if self.live is not None:
            self.live.update(self.bar, completed=done, description="training", status=text)
        elif now - self._last_line >= PLAIN_SECONDS:
            self._last_line = now
            self.console.print(text)

    def _announce(self, left: float) -> None:
        self._announced = True
        if left < 10:
            return
        self.console.print(
            f"this will take about {duration(left)} here (measured on the first rounds; refined as it goes)"
        )
        faster = FASTER.get(self.entry.model.name)
        if left > 3600 and faster is not None:
            from qrlsuite import registry

            if faster in registry.load().names("models"):
                self.console.print(f"[bold]--model {faster}[/bold] trains the same circuit many times faster")

    def close(self) -> None:
        """Take the live bar away."""
        if self.live is not None:
            self.live.stop()
            self.live = None

    def interrupted(self) -> None:
        """Say that everything is safe."""
        self.close()
        self.console.print("stopped; every finished epoch is saved. The same command continues from there.")

    def finished(self, summary: dict[str, Any]) -> None:
        """Sum the run up, and say what to type next."""
        self.close()
        score = summary["median_score"]
        shown = f", median score {score:.3f} after epoch {summary['epochs']}" if score is not None else ""
        self.console.print(f"{summary['seeds']} seeds complete{shown}")
        wanted = self.entry.task.file.protocol.seeds
        if summary["seeds"] < wanted:
            self.console.print(f"provisional: the task's protocol asks for {wanted} seeds")
        runs = self.store.path.parent.parent
        where = "" if str(runs) == "runs" else f" --runs {runs}"
        name = self.entry.task.name
        self.console.print(
            f"next: qrlsuite leaderboard --task {name}{where}    qrlsuite plot curves --task {name}{where}",
            soft_wrap=True,
        )
