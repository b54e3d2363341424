"""Every seed's curves in TensorBoard.

    qrlsuite run --task beam6g --model mlp --track tensorboard
    tensorboard --logdir runs

Event files lie in `tensorboard/` in each seed's folder; with `--track tensorboard=DIR`, in
`DIR/<task>/<entry>/seed-0007`. Scalars by epoch: `validation/score` is the mean over the validation episodes,
`training/return`, `training/score`, `training/loss` and the algorithm's other metrics are from `epochs.jsonl`.

A resumed run repeats the epochs after its checkpoint. Its new event file names its first epoch, and readers drop
epochs from there on in earlier files (TensorBoard's session start), so every epoch is shown once. Files are opened for
each epoch alone: a worker trains a hundred seeds, and TensorBoard's own writer would keep a thread for each.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from qrlsuite.plugins.trackers import common


class TensorBoard:
    """Writes event files.

    Parameters
    ----------
    target:
        The folder to write below; None for the seeds' own folders.
    """

    def __init__(self, target: str | None = None) -> None:
        self.target = None if target is None else Path(target).expanduser().absolute()
        self._files: dict[str, Path] = {}

    def run_started(self, run: Mapping[str, Any]) -> None:
        """Open a new event file for a seed, which goes on after `run["epochs"]`."""
        folder = common.folder(self.target, run, "tensorboard")
        folder.mkdir(parents=True, exist_ok=True)
        # readers go through files in the order of their names
        path = folder / f"events.out.tfevents.{time.time_ns()}.{socket.gethostname()}"
        self._files[run["folder"]] = path
        start = SessionLog(status=SessionLog.START)
        _append(
            path,
            Event(wall_time=time.time(), file_version="brain.Event:2"),
            Event(wall_time=time.time(), step=int(run["epochs"]) + 1, session_log=start),
        )

    def epoch_finished(self, run: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Append an epoch's scalars."""
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in common.scalars(record).items()]
        event = Event(wall_time=time.time(), step=record["epoch"], summary=Summary(value=values))
        _append(self._files[run["folder"]], event)


def _append(path: Path, *events: Event) -> None:
    with path.open("ab") as file:
        writer = RecordWriter(file)
        for event in events:
            writer.write(event.SerializeToString())
