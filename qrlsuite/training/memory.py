"""Checks, before training, that the groups fit into memory.

Only the memory stated in the specs of models and algorithms is counted (`memory`). A refused group therefore does not
fit; an accepted group may still be too large (the environment's memory, long observations, a model without `memory`).
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qrlsuite import registry, specs
from qrlsuite.errors import OptionError, PluginError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import size_text

if TYPE_CHECKING:
    from qrlsuite.algorithm import Memory

PROCESS = 300 << 20
"""Bytes of a process that has imported torch."""

COPIES = 3
"""Copies of the saved state: the training's own, the snapshot of the last epoch, and the next one in the making."""


def group_bytes(entry: Entry, seeds: int) -> int:
    """Return the bytes that a group of `seeds` needs in its process, at least.

    The algorithm's saved state counts three times, for checkpoints, and the parameters once more as gradients.
    """
    kept = algorithm_memory(entry.algorithm, entry.algorithm_options, entry.task.file.protocol.rounds)
    model = model_bytes(entry.model, entry.model_options, seeds, kept.batch, kept.networks * COPIES + 1)
    return PROCESS + seeds * (kept.saved * COPIES + kept.working) + model


def algorithm_memory(spec: specs.AlgorithmSpec, options: Any, rounds: int) -> Memory:
    """Return an agent's memory by its algorithm's spec, or the least of any algorithm if the spec states none."""
    from qrlsuite.algorithm import Memory  # imports torch

    if spec.memory is None:
        return Memory()
    kept = _call(spec, options, rounds)
    if not isinstance(kept, Memory) or not all(map(_is_count, dataclasses.astuple(kept))):
        raise _wrong(spec, f"returned {kept!r}, and must return a Memory of whole numbers")
    return kept


def model_bytes(spec: specs.ModelSpec, options: Any, agents: int, batch: int, copies: int) -> int:
    """Return the bytes that a model's spec says that a population takes, 0 where it says nothing."""
    if spec.memory is None:
        return 0
    said: int = _call(spec, options, agents, batch, copies)
    if not _is_count(said):
        raise _wrong(spec, f"returned {said!r}, and must return a whole number of bytes")
    return said


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _call(spec: specs.AlgorithmSpec | specs.ModelSpec, *arguments: Any) -> Any:
    """Call the function that `memory` of a spec refers to."""
    function = specs.resolve(str(spec.memory))
    try:
        return function(*arguments)
    except Exception as error:  # whatever a stranger's code raises
        raise _wrong(spec, f"fails: {registry.words(error)}") from error


def _wrong(spec: specs.AlgorithmSpec | specs.ModelSpec, problem: str) -> PluginError:
    return PluginError(f"'{spec.name}': memory = '{spec.memory}' {problem}")


def available(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Return the bytes for new processes; the machine's whole memory if only that is known; None if unknown."""
    try:
        for line in meminfo.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf
        return None


def require(entry: Entry, groups: Sequence[Sequence[int]], workers: int, free: int | None) -> None:
    """Refuse groups of seeds if `workers` of them do not fit into `free` bytes at once; None: unknown."""
    sizes = sorted((len(group) for group in groups), reverse=True)[:workers]
    bytes_of = functools.cache(functools.partial(group_bytes, entry))
    needed = sum(map(bytes_of, sizes))
    if free is None or needed <= free:
        return
    fits = [
        (each * processes, processes)
        for processes in range(1, len(sizes) + 1)
        for each in range(1, sizes[0] + 1)
        if processes * bytes_of(each) <= free
    ]
    if fits:
        seeds, processes = max(fits)
        first = format_seeds(sorted(seed for group in groups for seed in group)[:seeds])
        fewer = f" --workers {processes}" if processes < workers else ""
        advice = f"train fewer at a time, first --seeds {first}{fewer}; what is trained stays and counts"
    else:
        advice = (
            f"not even one seed fits: make the model smaller (`qrlsuite show model {entry.model.name}` lists its "
            f"options) or what the algorithm keeps (`qrlsuite show algorithm {entry.algorithm.name}`)"
        )
    raise OptionError(
        f"'{entry.label}': training {sum(sizes)} seeds at a time takes {size_text(needed)} of memory or more, and "
        f"{size_text(free)} are free here: {advice}"
    )
