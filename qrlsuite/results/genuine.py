"""Checks that folders are genuine: a seed's folder holds that seed, and no seed is a copy of another.

Folders are copied, linked and renamed, by hand and by scripts, and results folders come from others. Here their
content is checked against their names and records.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qrlsuite.errors import StoreError
from qrlsuite.files import read_bytes

if TYPE_CHECKING:
    from qrlsuite.results.records import RunRecord
    from qrlsuite.results.store import EntryStore, SeedRun

_CONTROLS = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff]")
"""Control characters except tabs and line feeds, and the marks that force a direction of writing."""


def require_no_link(*paths: Path) -> None:
    """Refuse links below a results folder; the results folder itself may be one."""
    for path in paths:
        if path.is_symlink():
            raise StoreError(
                f"{path} is a link: links in a results folder are not followed, because their targets would "
                "count twice; move the folder or file itself there"
            )


def require_plain(path: Path | str, content: object) -> None:
    """Refuse content, as of a file, if a text in it could control the terminal that shows it."""
    left = [content]
    while left:
        value = left.pop()
        if isinstance(value, str):
            if _CONTROLS.search(value):
                raise StoreError(f"{path} holds a text that controls a terminal: {ascii(value)[:80]}")
        elif isinstance(value, dict):
            left += value
            left += value.values()
        elif isinstance(value, list):
            left += value


def require_seed(folder: Path, seed: int, record: RunRecord, names: Mapping[str, str]) -> None:
    """Refuse a record of another seed, entry or task than the seed's folder is of.

    Parameters
    ----------
    names:
        `entry`, `task` and `task_hash` of the entry that the folder lies in; empty where its own record is damaged.
    """
    for name, expected in {"seed": seed, **names}.items():
        if (value := getattr(record, name)) != expected:
            of_entry = f" of {names['entry']} on task {names['task']}" if names else ""
            raise StoreError(
                f"{folder}: its run.json does not say that it is seed {seed}{of_entry} ({name} is "
                f"{value!r} in it): delete the folder if it is a copy, or move it back where it belongs"
            )


def copies(store: EntryStore, runs: Sequence[SeedRun]) -> Iterator[tuple[int, ...]]:
    """Yield groups of seeds that are copies of each other: no two seeds have equal curves by chance.

    Equal curves of three values or more are copies. Curves of fewer values may coincide: agents never learn, or solve a
    deterministic task at once. Such seeds are copies if their trained parameters are equal and finite: equal NaN prove
    nothing.
    """
    equal: dict[bytes, list[SeedRun]] = {}
    for run in runs:
        equal.setdefault(run.scores.tobytes(), []).append(run)
    for alike in equal.values():
        if len(alike) == 1:
            continue
        if len(np.unique(alike[0].curve)) > 2:
            yield tuple(run.seed for run in alike)
            continue
        agents: dict[bytes, list[int]] = {}
        for run in alike:
            if agent := _finite_agent(store.seed(run.seed).agent):
                agents.setdefault(agent, []).append(run.seed)
        yield from (tuple(seeds) for seeds in agents.values() if len(seeds) > 1)


def _finite_agent(path: Path) -> bytes | None:
    """Return a trained agent's file, None where there is none or not all of its parameters are numbers."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        content = read_bytes(path)
        arrays = load(content)
    except (OSError, SafetensorError, ValueError, KeyError, TypeError):
        return None
    finite = all(np.isfinite(array).all() for array in arrays.values())
    return content if arrays and finite else None
