"""Every seed as a run of Weights & Biases, kept on this machine until it is synced.

    qrlsuite run --task beam6g --model mlp --track wandb
    wandb sync runs/*/*/seed-*/wandb

Runs are offline unless the environment variable `WANDB_MODE` says `online`. Their files lie in `wandb/` in each seed's
folder; with `--track wandb=DIR`, in `DIR/<task>/<entry>/seed-0007/wandb`. Steps are epochs, and metrics have their
names in TensorBoard. `WANDB_PROJECT` (by default `qrlsuite`) and `WANDB_ENTITY` are the target of a sync.

A resumed run is the same W&B run. Offline, W&B writes a new folder when it goes on, and a kill loses what its service
had not written yet. The new folder therefore begins with all earlier epochs, from the run's own records, and takes the
place of the old one: one folder for each seed, with every epoch once.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import wandb

from qrlsuite.errors import QrlSuiteError
from qrlsuite.plugins.trackers import common


class WandB:
    """Writes W&B runs, one for each seed, all through one service process.

    Parameters
    ----------
    target:
        The folder to write below; None for the seeds' own folders.
    """

    _runs: ClassVar[
        dict[str, wandb.Run]
    ] = {}  # this process's: W&B refuses to begin one again that is still open

    def __init__(self, target: str | None = None) -> None:
        self.target = None if target is None else Path(target).expanduser().absolute()
        self.mode: Any = os.environ.get("WANDB_MODE", "offline")
        if os.environ.get("WANDB_SERVICE", "").split("-")[1:2] != [str(os.getpid())]:
            # the service of the process that started this one: that may end first, or be on another machine
            os.environ.pop("WANDB_SERVICE", None)
        if self.mode == "online":
            if not wandb.login(prompt=False):
                raise QrlSuiteError("WANDB_MODE=online, but nobody is logged in: type `wandb login` first")
        else:  # W&B reports its own errors over the network, from offline runs too
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")

    def run_started(self, run: Mapping[str, Any]) -> None:
        """Begin or go on with a seed's W&B run; offline, write its earlier epochs into a new folder."""
        parent = common.folder(self.target, run, ".")
        parent.mkdir(parents=True, exist_ok=True)
        if not os.access(parent, os.W_OK):  # W&B would write to a temporary folder
            raise PermissionError(f"cannot write in {parent}")
        if run["folder"] in self._runs:  # it was stopped, and goes on in the same process
            self._runs.pop(run["folder"]).finish()
        name = common.identity(run)
        replaced = list(parent.glob(f"wandb/offline-run-*-{name}"))
        online = self.mode == "online"
        handle = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "qrlsuite"),
            id=name,
            name=common.title(run),
            group=run["entry"],
            job_type=run["task"],
            config=common.settings(run),
            dir=parent,
            mode=self.mode,
            resume="allow" if online else None,
            reinit="create_new",  # beside the other seeds' runs
            settings=wandb.Settings(
                console="off", silent=True, disable_git=True, x_disable_stats=True, x_save_requirements=False
            ),
        )
        self._runs[run["folder"]] = handle
        for old in replaced:
            shutil.rmtree(old)
        for record in run["history"]:
            self._log(handle, record)

    def epoch_finished(self, run: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Log an epoch."""
        self._log(self._runs[run["folder"]], record)

    def run_finished(self, run: Mapping[str, Any]) -> None:
        """End a seed's W&B run; all of it is on disk then."""
        self._runs.pop(run["folder"]).finish()

    def _log(self, handle: wandb.Run, record: Mapping[str, Any]) -> None:
        if record["epoch"] >= handle.step:  # online, W&B holds the epochs before
            handle.log(common.scalars(record), step=record["epoch"], commit=True)
