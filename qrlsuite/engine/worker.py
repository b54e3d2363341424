"""The process that trains one group: `python -m qrlsuite.engine.worker FOLDER --seeds 0:50 --epochs 100`.

Every engine starts this. It claims its seeds, trains the unfinished ones, and leaves everything in the entry's
folder: starting it again is always right. Exit codes: 0 finished, 2 wrong input or a failing environment
(the message is in `progress.json`), 3 the seeds belong to another worker, 130 interrupted with everything saved.

The environment variable `QRLSUITE_CHECKPOINT_SECONDS` replaces the minute between two checkpoints.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import ctypes
import gc
import itertools
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from qrlsuite.engine import probe as probing
from qrlsuite.engine import script
from qrlsuite.errors import QrlSuiteError, StoreError
from qrlsuite.results import codes, probes
from qrlsuite.results.checkpoint import group_id
from qrlsuite.results.claims import HEARTBEAT, HEARTBEAT_THREAD, Claim, SeedsClaimedError, acquire, living
from qrlsuite.results.progress import Progress, ProgressFile, most_memory
from qrlsuite.results.seeds import format_seeds, parse_seeds, plan_groups
from qrlsuite.results.store import EntryStore
from qrlsuite.results.text import counted
from qrlsuite.training.interrupts import Interruptible

if TYPE_CHECKING:
    from qrlsuite.training.group import Part

_PR_SET_PDEATHSIG = 1


class ClaimHeartbeat(threading.Thread):
    """Refreshes the claims; interrupts this process when one or its parent is lost, or it is asked to stop."""

    def __init__(self, claims: Sequence[Claim], parent: int | None) -> None:
        super().__init__(name=HEARTBEAT_THREAD, daemon=True)
        self.claims = claims
        self.parent = parent
        self.stopped = threading.Event()

    def run(self) -> None:
        """Beat until stopped."""
        while not self.stopped.wait(HEARTBEAT):
            orphaned = self.parent is not None and os.getppid() != self.parent
            ends = orphaned or any(claim.stop_requested or not claim.refresh() for claim in self.claims)
            if ends and not self.stopped.is_set():  # it may have been released while it was being refreshed
                os.kill(os.getpid(), signal.SIGTERM)
                return


def train_group(
    folder: Path,
    seeds: Sequence[int],
    epochs: int,
    device: str = "cpu",
    parent: int | None = None,
    others: Sequence[Path] = (),
    started: str | None = None,
) -> None:
    """Claim seeds and train the unfinished ones in this process.

    Usually all are at one epoch and make one group. Seeds that another worker trained meanwhile make groups of their
    own.

    Parameters
    ----------
    parent:
        The process without which this one shall not go on.
    others:
        Folders of further entries whose seeds are trained in the same population.
    started:
        The command that trains a script's seeds one after the other, see `qrlsuite.engine.script.words`.
    """
    claims: list[Claim] = []
    heartbeat = ClaimHeartbeat(claims, parent)
    heartbeat.start()
    files: dict[Path, ProgressFile] = {}
    places: dict[Path, slice] = {}
    """Of each entry's seeds in the population."""

    def report(progress: Progress, error: str | None = None, force: bool = False) -> None:
        if progress.done:
            progress.memory = most_memory()
        for path, file in files.items():
            file.write(progress, error, force, places.get(path, slice(0)))

    def held() -> bool:
        return all(claim.refresh() for claim in claims)

    state = Progress(epochs=epochs)
    taken: SeedsClaimedError | None = None
    with Interruptible() as guard:  # a claim is given back at any time
        try:
            parts: dict[int, list[Part]] = {}
            for store in map(EntryStore, (folder, *others)):
                try:
                    with guard.deferred():
                        claims.append(acquire(store, seeds))
                except SeedsClaimedError as error:
                    taken = error
                    continue
                file = files[store.path] = ProgressFile(store, group_id(seeds))
                if started is not None:
                    places[store.path] = slice(None)
                    script.train(started, store, seeds, file.path.with_name("output.txt"), state, report)
                    continue
                probes.require_independent(store)
                for group in plan_groups(store, seeds, epochs, workers=1):
                    parts.setdefault(group.epoch, []).append((store.entry(), store, group.seeds))
            most = len(seeds) * max(1, len(files))
            state.size, state.untried = min((file.size(most) for file in files.values()), default=most), True
            report(state, force=True)
            pieces = [piece for _, whole in sorted(parts.items()) for piece in divided(whole, state.size)]
            for turn, together in enumerate(pieces):
                with guard.deferred():
                    probe = probing.prepare(together, epochs, device)
                    if probe is not None:
                        claims.append(probe.claim)
                # torch, which scripts and a supervisor do without
                from qrlsuite.training.group import GroupRun

                run = GroupRun(together, epochs, device, report, held, probe)
                run.progress.size, run.progress.untried = state.size, state.untried
                run.progress.turn, run.progress.turns = turn, len(pieces)
                if state.size < most:
                    run.progress.warnings.append(
                        f"{counted(state.size, 'seed')} at a time instead of {most}: with more, the process was "
                        "killed before an epoch ended, as happens where memory is used up; for other entries "
                        f"of this size, begin with --seeds {format_seeds(seeds[: state.size])}"
                    )
                places |= {part.store.path: its for part, its in run.parts()}
                state = run.progress
                run.run()
                report(state, force=True)  # that so many seeds fit, before more begin
                del run
            state.phase, state.epoch, state.untried = "finished", epochs, False
            report(state, force=True)
        except KeyboardInterrupt:
            state.untried = False
            report(state, force=True)
            raise
        except QrlSuiteError as error:
            state.untried = False
            if isinstance(error, probes.DependentSeedsError):
                _stop_others(claims)
            with contextlib.suppress(StoreError):  # on a full disk the message goes to stderr alone
                report(state, str(error), force=True)
            raise
        finally:
            with guard.deferred():
                heartbeat.stopped.set()
                for claim in claims:
                    claim.release()
    if taken is not None:
        raise taken


def divided(parts: Sequence[Part], size: int) -> Iterator[list[Part]]:
    """Divide the seeds of entries at one epoch into groups of at most `size`."""
    rest = [(place, seed) for place, (*_, seeds) in enumerate(parts) for seed in seeds]
    for low in range(0, len(rest), size):
        piece = itertools.groupby(rest[low : low + size], key=lambda each: each[0])
        yield [(*parts[place][:2], [seed for _, seed in its]) for place, its in piece]


def _stop_others(claims: Sequence[Claim]) -> None:
    """Make the other workers of the entries whose seeds are claimed here save and end; started again, they refuse."""
    for folder in {claim.path.parent.parent for claim in claims}:
        for other in living(EntryStore(folder)):
            if other not in claims:
                other.request_stop()


def end_with(parent: int) -> bool:
    """Let SIGTERM be sent to this process when its parent ends; returns False where it has ended already."""
    with contextlib.suppress(
        OSError, AttributeError
    ):  # elsewhere than on Linux, the heartbeat looks now and then
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    return os.getppid() == parent


def checkpoint_seconds(default: float) -> float:
    """Return the time between checkpoints that the environment asks for."""
    text = os.environ.get("QRLSUITE_CHECKPOINT_SECONDS")
    if text is None:
        return default
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not seconds >= 0:
        raise StoreError(f"QRLSUITE_CHECKPOINT_SECONDS={text} is not a number of seconds")
    return seconds


def _import_training() -> None:
    """Import the training code, and set the time between checkpoints; raises the errors of `checkpoint_seconds`.

    Imported objects live as long as the process: the garbage collector does not look at them, now or later.
    """
    gc.disable()
    try:
        import qrlsuite.training.group as training
    finally:
        gc.freeze()
        gc.enable()
    training.CHECKPOINT_SECONDS = checkpoint_seconds(training.CHECKPOINT_SECONDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the worker's command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m qrlsuite.engine.worker", description=__doc__)
    parser.add_argument(
        "folders",
        type=Path,
        nargs="+",
        metavar="FOLDER",
        help="the entry's folder, runs/<task>/<entry>; several are trained in one population",
    )
    parser.add_argument("--seeds", required=True, help="0:50, or a list such as 0,3,10:12")
    parser.add_argument("--epochs", type=int, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--follow-parent", type=int, metavar="PID", help="stop, saving, when this parent process ends"
    )
    parser.add_argument(
        "--script", metavar="JSON", help="the command that trains a seed, and where it writes"
    )
    options = parser.parse_args(arguments)
    if options.follow_parent is not None and not end_with(options.follow_parent):
        return 130
    try:
        folder, *others = options.folders
        seeds, parent = parse_seeds(options.seeds), options.follow_parent
        if options.script is None:
            _import_training()
            for path in options.folders:
                codes.load_copies(EntryStore(path))
        train_group(folder, seeds, options.epochs, options.device, parent, others, options.script)
    except SeedsClaimedError as error:
        print(f"qrlsuite: {error}", file=sys.stderr)
        return 3
    except QrlSuiteError as error:
        print(f"qrlsuite: {error}", file=sys.stderr)
        return 2
    except script.KilledError as error:
        print(f"qrlsuite: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    for warning in (
        signal.SIGUSR1,
        signal.SIGUSR2,
    ):  # with which a cluster warns its jobs, and then sends SIGTERM
        signal.signal(warning, signal.SIG_IGN)
    atexit.register(gc.freeze)  # collecting what is about to end takes most of a second
    sys.exit(main())
