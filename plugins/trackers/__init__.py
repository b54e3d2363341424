"""The built-in trackers, registered as a plugin's are."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite import hookimpl
from qrlsuite.specs import TrackerSpec


@hookimpl
def register_trackers(register: Callable[[TrackerSpec], None]) -> None:
    """Register `tensorboard`, `wandb` and `mlflow`."""
    register(
        TrackerSpec(
            name="tensorboard",
            summary="Scores, returns and losses of every seed in TensorBoard, beside the results or in a folder",
            factory="qrlsuite.plugins.trackers.tensorboard:TensorBoard",
            extras={"tensorboard": "pip install tensorboard"},
        )
    )
    register(
        TrackerSpec(
            name="wandb",
            summary="Every seed as a run of Weights & Biases, offline unless WANDB_MODE says online",
            factory="qrlsuite.plugins.trackers.wandb:WandB",
            extras={"wandb": "pip install wandb"},
        )
    )
    register(
        TrackerSpec(
            name="mlflow",
            summary="Every seed as a run of MLflow, in the results folder's mlflow.db, a folder or on a server",
            factory="qrlsuite.plugins.trackers.mlflow:MLflow",
            extras=dict.fromkeys(("mlflow", "sqlalchemy"), "pip install mlflow"),
        )
    )
