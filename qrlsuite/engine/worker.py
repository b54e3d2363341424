"""The process that trains one group: `python -m qrlsuite.engine.worker FOLDER --seeds 0:50 --epochs 100`.

Every engine starts this. It claims its seeds, trains them, and leaves everything in the entry's folder. Exit
codes: 0 finished, 2 wrong input or a failing environment (the message is in `progress.json`), 3 the seeds
belong to another worker, 130 interrupted with everything saved.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from qrlsuite.claims import Claim, SeedsClaimedError, acquire
from qrlsuite.engine.groups import ProgressFile, parse_seeds
from qrlsuite.errors import QrlSuiteError
from qrlsuite.run import GroupRun, Progress
from qrlsuite.store import EntryStore

HEARTBEAT = 5.0


class Heart(threading.Thread):
    """Refreshes the claim; interrupts this process when the claim or the parent process is lost."""

    def __init__(self, claim: Claim, follow_parent: bool) -> None:
        super().__init__(daemon=True)
        self.claim = claim
        self.parent = os.getppid() if follow_parent else None
        self.stopped = threading.Event()

    def run(self) -> None:
        """Beat until stopped."""
        while not self.stopped.wait(HEARTBEAT):
            orphaned = self.parent is not None and os.getppid() != self.parent
            if orphaned or not self.claim.refresh():
                os.kill(os.getpid(), signal.SIGTERM)
                return


def train_group(
    folder: Path, seeds: Sequence[int], epochs: int, device: str = "cpu", follow_parent: bool = False
) -> None:
    """Claim and train a group in this process.

    Raises
    ------
    SeedsClaimedError
        If another worker holds one of the seeds.
    QrlSuiteError
        If the entry cannot be built, its environment fails, or results cannot be written.
    KeyboardInterrupt
        After an interruption, with everything saved.
    """
    store = EntryStore(folder)
    from qrlsuite.checkpoint import group_id

    progress = ProgressFile(store, group_id(seeds))
    claim = acquire(store, seeds)
    heart = Heart(claim, follow_parent)
    heart.start()
    run = None
    try:
        run = GroupRun(store.entry(), store, seeds, epochs, device, progress.write)
        run.run()
        progress.write(run.progress, force=True)
    except QrlSuiteError as error:
        progress.write(run.progress if run else Progress(epochs=epochs), error=str(error), force=True)
        raise
    finally:
        heart.stopped.set()
        claim.release()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the worker's command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m qrlsuite.engine.worker", description=__doc__)
    parser.add_argument("folder", type=Path, help="the entry's folder, runs/<task>/<entry>")
    parser.add_argument("--seeds", required=True, help="0:50, or a list such as 0,3,10:12")
    parser.add_argument("--epochs", type=int, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--follow-parent", action="store_true", help="stop, saving, when the parent process ends"
    )
    given = parser.parse_args(arguments)
    try:
        train_group(given.folder, parse_seeds(given.seeds), given.epochs, given.device, given.follow_parent)
    except SeedsClaimedError as error:
        print(f"qrlsuite: {error}", file=sys.stderr)
        return 3
    except QrlSuiteError as error:
        print(f"qrlsuite: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
