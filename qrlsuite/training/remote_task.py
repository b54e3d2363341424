"""Trains a group of seeds for a minute, from bytes to bytes: the work of engines without a shared folder.

A *task* and its *answer* are bytes: a safetensors file with the checkpoint, in whose metadata the rest stands as JSON.
Nothing but plugins by path is written to a disk, and the same task gives the same answer, times aside, however often
and wherever it is worked on.

Of a task:

    token           unique to the task; repeated in its answer
    entry           the entry to train, as in `entry.json`
    seeds, epoch    the group, and the epoch of the checkpoint; at epoch 0 there is none, or the agents to begin with
    epochs          where to stop
    seconds         how long to train; one epoch is trained at least
    device          `cpu`, `cuda` or `cuda:1`
    versions        of the distributions that make the numbers: a worker with others refuses the task
    code            the parts of the entry's code identity: the same
    plugins         the plugins by path among that code: name, and content in base64 by file

Of an answer:

    token, seeds
    epoch           of the checkpoint in it
    lines, timings  of every new epoch: a line of `epochs.jsonl` for each seed; the line of `timings.jsonl`
    provenance      host, processor and versions
    parameters      their numbers, see `ModelBuilder.trained`
    warnings        for the user
    error           why the training cannot go on; None where it can. Finished epochs stay in the answer
    refused         why this worker does not take the task; None where it did. There is then nothing else

At the last epoch the answer also holds the trained agents, as arrays whose names begin with `policy.`.
"""

from __future__ import annotations

import ctypes
import functools
import json
import platform
import socket
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from qrlsuite import own
from qrlsuite.errors import QrlSuiteError, StoreError, listed
from qrlsuite.experiment import identity
from qrlsuite.results import provenance
from qrlsuite.results.checkpoint import Arrays
from qrlsuite.results.records import EntryRecord

POLICY = "policy."
MOST_BYTES = 32 << 20
"""The largest task or answer, which a queue's connections and memory take without trouble."""

_one_at_a_time = threading.Lock()
"""Locked while training: torch's number of threads and a worker's memory are meant for one group."""

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # <malloc.h>


def pack(header: Mapping[str, Any], arrays: Arrays) -> bytes:
    """Return a task or an answer as bytes."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    content: bytes = save(contiguous, metadata={"header": json.dumps(header)})
    return content


def unpack(content: bytes) -> tuple[dict[str, Any], Arrays]:
    """Return the header and the arrays of a task or an answer."""
    try:
        length = int.from_bytes(content[:8], "little")
        header = json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["header"])
        if not isinstance(header, dict):
            raise ValueError("its header is no object")
        return header, load(content)
    except (ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        raise StoreError(f"these {len(content)} bytes are no task and no answer: {error}") from None


def versions(distributions: Sequence[str]) -> dict[str, str | None]:
    """Return the installed versions of distributions, None for one that is missing, and Python's `major.minor`."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, **{name: provenance.version(name) for name in distributions}}


def differing(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """Say in which versions a worker differs: `qrlsuite 0.0.9 instead of 0.1.0`; nothing where it does not."""
    return listed(
        [
            f"{name} {version} instead of {here[name]}" if (version := there.get(name)) else f"no {name}"
            for name in here
            if here[name] != there.get(name)
        ]
    )


def work_on(task: bytes) -> bytes:
    """Work on a task; return the answer, and never raise an error of the training."""
    try:
        header, arrays = unpack(task)
        needed = dict(header["versions"])
        token, seeds = header["token"], [int(seed) for seed in header["seeds"]]
    except (QrlSuiteError, KeyError, TypeError, ValueError) as error:
        return pack({"refused": f"this is no task: {error}"}, {})
    different = differing(needed, versions([name for name in needed if name != "python"]))
    answer: dict[str, Any] = {"token": token, "seeds": seeds, "refused": None, "error": None}
    if different:
        return pack({**answer, "refused": f"{socket.gethostname()} has {different}"}, {})
    keep_freed_memory()
    with _one_at_a_time:
        try:
            _load_plugins(header.get("plugins", []))
        except QrlSuiteError as error:
            return pack({**answer, "refused": f"{socket.gethostname()}: {error}"}, {})
        if changed := _changed_code(header):
            return pack({**answer, "refused": f"{socket.gethostname()} has other code: {changed}"}, {})
        more, arrays = _trained(header, seeds, arrays)
    content = pack({**answer, **more}, arrays)
    if len(content) > MOST_BYTES:
        nothing = {"epoch": header["epoch"], "lines": [], "timings": []}
        return pack({**answer, **more, **nothing, "error": too_large(len(content), len(seeds))}, {})
    return content


def _load_plugins(packed: Sequence[Any]) -> None:
    """Load a task's plugins by path, and unload plugins of earlier tasks; loaded plugins of the task stay."""
    folder = Path(_folder().name)
    sources = [own.Source.unpacked(each, folder) for each in packed]
    for each in own.loaded():
        if each.source.path.is_relative_to(folder) and each.source not in sources:
            own.unload(each)
    for source in sources:
        own.write(source, source.path.parent)
        own.load_source(source)


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """Return this process's folder of plugins that came with tasks."""
    return tempfile.TemporaryDirectory(prefix="qrlsuite-plugins-")


def _changed_code(header: Mapping[str, Any]) -> str:
    """Name the differences between the code here and a task's code; empty if there are none."""
    try:
        sent = [dict(part) for part in header["code"]]
        return listed(
            identity.differences(
                sent, identity.of(EntryRecord.read(header["entry"], "the task").entry("the task")).parts
            )
        )
    except (QrlSuiteError, KeyError, TypeError, ValueError):  # is said where the entry is built
        return ""


@functools.cache
def keep_freed_memory() -> None:
    """Have glibc keep freed memory for the next array; elsewhere do nothing.

    Dask sets `MALLOC_TRIM_THRESHOLD_` for its workers, and runs tasks in a thread. Then arrays of 128 KB and more are
    returned to the system when they are freed, and each of the next ones is cleared page by page: an epoch of a network
    took twice its processor time.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # no glibc
        return
    mallopt(_TRIM_THRESHOLD, 256 << 20)
    mallopt(_MMAP_THRESHOLD, 32 << 20)  # the largest that it accepts


def too_large(size: int, seeds: int) -> str:
    """Return the error text for a checkpoint that is too large to send."""
    least = f"{size / 2**20:.0f} MB for {seeds} seed{'s' * (seeds > 1)}"
    return (
        f"a checkpoint is too large to be sent: {least}, and at most {MOST_BYTES >> 20} are; an engine with a shared "
        "folder takes it (--engine command, --engine local)"
    )


def _trained(header: Mapping[str, Any], seeds: list[int], arrays: Arrays) -> tuple[dict[str, Any], Arrays]:
    """Train as a task says; returns the rest of the answer's header, and its arrays."""
    from qrlsuite.training.group import lines_of, timing_of
    from qrlsuite.training.trainer import Trainer

    lines: list[Any] = []
    timings: list[Any] = []
    more: dict[str, Any] = {"epoch": header["epoch"], "lines": lines, "timings": timings, "warnings": []}
    answered: Arrays = {}
    try:
        entry = EntryRecord.read(header["entry"], "the task").entry("the task")
        trainer = Trainer(entry, seeds, header["device"])
        more["parameters"] = trainer.models.trained()
        origin = provenance.of(entry, trainer.device)
        more["provenance"] = origin.changed(host=socket.gethostname()).content
        if header["epoch"]:
            trainer.restore(header["epoch"], arrays)
        else:
            trainer.start(arrays)
        trainer.models.compile_circuits()
        began = time.monotonic()
        while trainer.epoch < header["epochs"]:
            epoch = trainer.train_epoch()
            answered = trainer.capture()
            lines.append([line.content for line in lines_of(epoch)])
            timings.append(timing_of(epoch, len(seeds)).content)
            more["epoch"] = epoch.number
            if time.monotonic() - began >= header["seconds"]:
                break
        more["warnings"] = trainer.progress.warnings
        if trainer.epoch == header["epochs"]:
            answered = {**(answered or arrays)}
            answered |= {f"{POLICY}{name}": array for name, array in trainer.policy().items()}
    except QrlSuiteError as error:
        more["error"] = str(error)
    return more, answered
