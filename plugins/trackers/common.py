"""Common parts of all built-in trackers: names of metrics, settings of a run, and the identity of a run."""

from __future__ import annotations

import re
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qrlsuite.errors import StoreError


def scalars(record: Mapping[str, Any]) -> dict[str, float]:
    """Return an epoch's numbers by name: `validation/score`, the mean over episodes, and `training/METRIC`."""
    scores = record["scores"]
    values = {"validation/score": sum(scores) / len(scores)}
    for name, value in record.items():
        if name != "epoch" and isinstance(value, int | float):  # None: there is no value in this epoch
            values[f"training/{name.removeprefix('train_')}"] = float(value)
    return values


def settings(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run as a flat mapping: `task`, `seed`, ..., `algorithm.gamma`, `model.width`."""
    names = ("task", "task_hash", "entry", "label", "algorithm", "model", "family", "seed")
    found = {name: run[name] for name in names}
    for part in ("algorithm", "model"):
        found |= {f"{part}.{name}": value for name, value in run[f"{part}_options"].items()}
    return found


def title(run: Mapping[str, Any]) -> str:
    """Return a run's name in a list of runs."""
    return f"{run['label']} seed {run['seed']}"


def identity(run: Mapping[str, Any]) -> str:
    """Return the 8 characters under which a tracker knows this run, resumed or not: `tracking-id` in its folder.

    They are drawn when the run is first tracked. Results that are deleted and trained again are another run.
    """
    path = Path(run["folder"], "tracking-id")
    if not path.exists():
        begun = path.with_name(".tracking-id")
        begun.write_text(secrets.token_hex(4))
        begun.replace(path)  # a kill leaves a whole name, or none
    name = path.read_bytes()
    if not re.fullmatch(rb"[0-9a-f]{8}", name):
        raise StoreError(f"{path} does not hold the 8 characters of a tracked run: delete it for a new one")
    return name.decode()


def folder(target: Path | None, run: Mapping[str, Any], name: str) -> Path:
    """Return the folder in which a tracker keeps a run: `name` in its own, or below `target` one for each seed."""
    own = Path(run["folder"])
    return own / name if target is None else target / run["task"] / run["entry"] / own.name
