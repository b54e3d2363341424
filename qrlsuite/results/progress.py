"""Progress files: written by a group's worker, read by displays."""

from __future__ import annotations

import contextlib
import json
import resource
import statistics
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from qrlsuite.errors import StoreError
from qrlsuite.files import read_bytes
from qrlsuite.results.store import EntryStore, cause, write_atomically


@dataclass
class Progress:
    """A group's progress: phase, epoch, rounds and scores."""

    phase: str = "starting"
    epoch: int = 0
    epochs: int = 0
    done: int = 0
    """Rounds of the current phase done so far."""
    total: int = 0
    """Rounds of the current phase, 0 where unknown."""
    median_score: float | None = None
    seed_scores: list[float] = field(default_factory=list)
    """Each seed's score after `epoch`, for a median over all groups."""
    seed_diverged: list[bool] = field(default_factory=list)
    """Whether numbers of each seed's agent are no longer finite after `epoch`."""
    epoch_seconds: float | None = None
    """Seconds of the last epoch; None for a process's first epoch, which includes its start."""
    size: int = 0
    """Seeds that are trained at a time, 0 before that is known."""
    turn: int = 0
    """Groups that ended before, where fewer seeds are trained at a time; each begins at the first epoch."""
    turns: int = 1
    """Number of these groups."""
    untried: bool = False
    """Whether no epoch of so many seeds has ended here yet."""
    memory: int = 0
    """The most bytes that the process has had; 0 before its first round has ended."""
    warnings: list[str] = field(default_factory=list)
    """Warnings for the user although nothing failed: for example, a tracker was left out."""

    def finished_epoch(self, epoch: int, seed_scores: list[float], seed_diverged: list[bool]) -> None:
        """Take in that an epoch has finished, with every seed's score after it and whether it has diverged."""
        self.epoch, self.seed_scores, self.seed_diverged = epoch, seed_scores, seed_diverged
        self.untried = False
        self.median_score = statistics.median(seed_scores)


class ProgressFile:
    """A group's progress on disk, read by any display.

    Its worker writes it at most twice a second, and always before a long silent step: at the last round of an epoch's
    training, since PPO and REINFORCE learn after all rounds, and before it waits for a probe.
    """

    def __init__(self, store: EntryStore, group: str) -> None:
        self.path = store.groups / group / "progress.json"
        self._written = 0.0

    def write(
        self,
        progress: Progress,
        error: str | None = None,
        force: bool = False,
        places: slice = slice(None),
    ) -> None:
        """Write the progress; if it was just written, only before a long silence.

        Parameters
        ----------
        places:
            Of the seeds in the group whose scores count here.
        """
        now = time.monotonic()
        silent = progress.phase == "training" and 0 < progress.total <= progress.done
        silent |= progress.phase in ("compiling", "comparing", "probing")
        if not (force or silent) and now - self._written < 0.5:
            return
        self._written = now
        scores, diverged = progress.seed_scores[places], progress.seed_diverged[places]
        median = statistics.median(scores) if scores else None
        changed = {"seed_scores": scores, "seed_diverged": diverged, "median_score": median, "error": error}
        shown = {**asdict(progress), **changed}
        content = json.dumps(shown).encode()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            temporary = self.path.with_suffix(".tmp")
            temporary.write_bytes(content)
            temporary.replace(self.path)
        except OSError:
            if force:
                write_atomically(self.path, content)  # raises the clear error

    def read(self) -> dict[str, Any]:
        """Return the last progress written, empty where there is none."""
        return read_progress(self.path)

    def size(self, most: int) -> int:
        """Return how many of at most so many seeds to train at a time.

        They are as many as in the last attempt, and half as many if that was killed before one of its epochs ended, as
        happens where memory is used up.
        """
        last = self.read()
        size = last.get("size")
        size = min(size, most) if isinstance(size, int) and size > 0 else most
        return max(1, size // 2) if last.get("untried") else size

    def clear(self, seeds: int) -> None:
        """Forget an earlier attempt's progress, but for how many of the seeds to train at a time."""
        size = self.size(seeds)
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"cannot write {self.path}: {cause(error)}") from None
        if size < seeds:
            self.write(Progress(size=size), force=True)


def most_memory(process: int | str = "self") -> int:
    """Return the most bytes that a process has had in memory; 0 where that is unknown of another one."""
    with contextlib.suppress(
        OSError, ValueError, IndexError
    ):  # `getrusage` on Linux counts a parent that forked
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    if process != "self":
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def read_progress(path: Path) -> dict[str, Any]:
    """Read a progress file; empty where it is missing or damaged."""
    try:
        content = json.loads(read_bytes(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
