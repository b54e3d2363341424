"""Checkpoints of groups of seeds: every tensor seed-first, so that groups are split and merged by slicing.

One file per group, `groups/<id>/checkpoint.safetensors`; its metadata names the epoch and the seeds. Where two
checkpoints hold the same seed, the later epoch counts.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file
from safetensors.numpy import save as encode

from qrlsuite.errors import StoreError
from qrlsuite.files import open_regular
from qrlsuite.results.records import FORMAT_VERSION
from qrlsuite.results.store import Arrays as Arrays
from qrlsuite.results.store import EntryStore, write_atomically

FILE = "checkpoint.safetensors"  # in the group's folder


@dataclass(frozen=True)
class Header:
    """A checkpoint's path and content."""

    path: Path
    epoch: int
    seeds: tuple[int, ...]


def group_id(seeds: Sequence[int]) -> str:
    """Return a group's folder name: its range, and a digest of the exact seeds."""
    text = ",".join(str(seed) for seed in seeds)
    return f"{min(seeds):04d}-{max(seeds):04d}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def save(store: EntryStore, seeds: Sequence[int], epoch: int, arrays: Mapping[str, NDArray[Any]]) -> Header:
    """Write a group's checkpoint and remove the checkpoints that it supersedes.

    Parameters
    ----------
    arrays:
        Everything by name, first axis = position in `seeds`.
    """
    for name, array in arrays.items():
        if array.ndim == 0 or array.shape[0] != len(seeds):
            raise ValueError(f"checkpointed array '{name}' of shape {array.shape} is not seed-first")
    metadata = {
        "format_version": str(FORMAT_VERSION),
        "epoch": str(epoch),
        "seeds": json.dumps([int(seed) for seed in seeds]),
    }
    path = store.groups / group_id(seeds) / FILE
    content = encode({name: np.ascontiguousarray(array) for name, array in arrays.items()}, metadata=metadata)
    write_atomically(path, content)
    header = Header(path, epoch, tuple(int(seed) for seed in seeds))
    _remove_superseded(store, header)
    return header


def _remove_superseded(store: EntryStore, newest: Header) -> None:
    """Remove other groups' checkpoints that hold nothing but seeds of `newest`, at no later epoch."""
    for header in headers(store):
        if (
            header.path != newest.path
            and header.epoch <= newest.epoch
            and set(header.seeds) <= set(newest.seeds)
        ):
            shutil.rmtree(header.path.parent, ignore_errors=True)


def headers(store: EntryStore) -> list[Header]:
    """Return the header of every group's checkpoint; tensors are not read."""
    if not store.groups.is_dir():
        return []
    headers_found = []
    for path in sorted(store.groups.glob(f"*/{FILE}")):
        try:
            with open_regular(path) as file:
                length = int.from_bytes(file.read(8), "little")
                if length > 100_000_000:
                    raise ValueError("header too long")
                metadata = json.loads(file.read(length))["__metadata__"]
            version, epoch = metadata["format_version"], int(metadata["epoch"])
            seeds = tuple(int(seed) for seed in json.loads(metadata["seeds"]))
        except FileNotFoundError:
            continue  # superseded and removed by a worker a moment ago
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StoreError(
                f"{path} is damaged ({type(error).__name__}: {error}): delete its folder, and its seeds start again"
            ) from None
        if version != str(FORMAT_VERSION):
            raise StoreError(f"{path} has format version {version}, this suite reads {FORMAT_VERSION}")
        headers_found.append(Header(path, epoch, seeds))
    return headers_found


def latest(store: EntryStore) -> dict[int, Header]:
    """Return the newest checkpoint of every seed that has one; a seed without a folder starts again."""
    newest_first = headers(store)
    begun = set(store.seeds()) if newest_first else set()
    newest: dict[int, Header] = {}
    for header in newest_first:
        for seed in begun.intersection(header.seeds):
            if seed not in newest or newest[seed].epoch < header.epoch:
                newest[seed] = header
    return newest


def load(store: EntryStore, seeds: Sequence[int]) -> tuple[int, Arrays]:
    """Assemble the state of a group from whatever groups its seeds were checkpointed in.

    Returns
    -------
    tuple
        The epoch, and every array with first axis = position in `seeds`; epoch 0 and no arrays where no seed
        has a checkpoint.
    """
    newest = latest(store)
    epochs = {newest[seed].epoch if seed in newest else 0 for seed in seeds}
    if len(epochs) != 1:
        raise StoreError(f"{store.path}: seeds {list(seeds)} are at different epochs {sorted(epochs)}")
    epoch = epochs.pop()
    if epoch == 0:
        return 0, {}
    files: dict[Path, Arrays] = {}
    for seed in seeds:
        path = newest[seed].path
        if path not in files:
            try:
                files[path] = load_file(path)
            except (OSError, SafetensorError) as error:
                raise StoreError(
                    f"{path} is damaged ({error}): delete its folder, and its seeds start again"
                ) from None
    names = set.intersection(*(set(arrays) for arrays in files.values()))
    if any(set(arrays) != names for arrays in files.values()):
        raise StoreError(f"{store.path}: the checkpoints of its groups hold different tensors")
    positions = {seed: newest[seed].seeds.index(seed) for seed in seeds}
    return epoch, {
        name: np.stack([files[newest[seed].path][name][positions[seed]] for seed in seeds])
        for name in sorted(names)
    }
