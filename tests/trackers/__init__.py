from typing import Any

RUN: dict[str, Any] = {
    "task": "example",
    "task_hash": "0123456789abcdef",
    "entry": "ddqn-mlp-01234567",
    "label": "ddqn mlp width=64",
    "algorithm": "ddqn",
    "algorithm_options": {"gamma": 0.95},
    "model": "mlp",
    "family": "classical",
    "model_options": {"width": 64},
    "parameters": {"classical": 4611, "quantum": 0, "networks": 1},
    "seed": 7,
    "interactions_per_epoch": 2000,
}
"""A run as a tracker sees it."""

RECORD: dict[str, Any] = {
    "epoch": 1,
    "scores": [0.5, 0.75],
    "loss": 0.25,
    "train_return": None,
    "train_score": None,
    "executions": {"forward": 12},
}
"""An epoch's line as `epoch_finished` sees it; a metric without a value is None."""
