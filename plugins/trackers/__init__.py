"""The built-in trackers, registered as a plugin's are."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite import hookimpl
from qrlsuite.specs import TrackerSpec


@hookimpl
def register_trackers(register: Callable[[TrackerSpec], None]) -> None:
    """Register `tensorboard`."""
    register(
        TrackerSpec(
            name="tensorboard",
            summary="Scores, returns and losses of every seed in TensorBoard, beside the results or in a folder",
            factory="qrlsuite.plugins.trackers.tensorboard:TensorBoard",
            extras={"tensorboard": "pip install 'qrlsuite[tensorboard]'"},
        )
    )
