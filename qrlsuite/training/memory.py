"""Checks, before training, that the groups fit into memory.

Only the large arrays of the suite's own algorithms and models are counted, found by the names of their options; each is
explained where it is counted. What is refused does therefore not fit; what is let through may still be large for
reasons that are not known here (an environment's own memory, long observations, a plugin's model).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qrlsuite import options
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import size_text

PROCESS = 300 << 20
"""Bytes of a process that has imported torch."""

COPIES = 3
"""Of what is saved: the training's own, the snapshot of the last epoch, and the next one while it is made."""

OBSERVATION = 4
"""Numbers of an observation: beam6g has 3, CartPole 4."""

NATIVE_STATES, PENNYLANE_STATES = 256 << 20, 1 << 30
"""Bytes of circuit states that the two simulators keep at most, except that PennyLane takes at least one seed."""


def group_bytes(entry: Entry, seeds: int) -> int:
    """Return the bytes that a group of `seeds` needs in its process, at least.

    Counted are, at S seeds and batches of B samples, in float32 where nothing else is said:

    - a network of width w and depth d: (d - 1) w^2 parameters per seed; of these the network, Adam's two moments and
      (with a replay buffer) the target network, each with the copies for checkpoints, and the gradients;
    - D Fourier frequencies: per sample 2 D features, and their products with the weights of two actions or more;
    - the replay buffer: S x buffer rows of two observations, action, reward and whether the episode went on, copied
      for checkpoints;
    - an epoch's draws from it: S x rounds x B in float64;
    - circuit states of 2^n complex amplitudes: S x B x 8 bytes each (16 in float64) where the native simulator keeps
      them, and three of its working states of 128 bytes each; S x B x layers x n x 64 where PennyLane backpropagates.
    """
    model, algorithm = (options.plain(o) for o in (entry.model_options, entry.algorithm_options))
    batch = int(algorithm.get("batch", 64))
    total = PROCESS
    if "width" in model:
        weights = (int(model["depth"]) - 1) * int(model["width"]) ** 2
        total += 4 * seeds * weights * ((4 if "buffer" in algorithm else 3) * COPIES + 1)
    if "frequencies" in model:
        total += 4 * seeds * batch * int(model["frequencies"]) * (2 + 2 * 2)
    if "buffer" in algorithm:
        total += 4 * seeds * int(algorithm["buffer"]) * (2 * OBSERVATION + 3) * COPIES
        total += 8 * seeds * entry.task.file.protocol.rounds * batch
    if "qubits" in model:
        total += _states(entry.model.name, model, seeds * batch, batch)
    return total


def _states(name: str, model: dict[str, Any], lanes: int, batch: int) -> int:
    """Return the bytes of circuit states, `batch` of the lanes belonging to one seed."""
    if model["ansatz_options"].get("entangled", True) is not True:
        return 0  # no state of several qubits
    amplitudes = 1 << int(model["qubits"])
    if name == "vqc-native":
        kept = lanes * amplitudes * (16 if model["dtype"] == "float64" else 8)
        return 3 * 128 * amplitudes + (kept if kept <= NATIVE_STATES else 0)
    backprop = model.get("diff_method") in ("auto", "backprop") and model.get("shots") is None
    if name == "vqc-pennylane" and model["device"] == "default.qubit" and backprop:
        lane = 64 * amplitudes * int(model["layers"]) * int(model["qubits"])
        return min(lanes * lane, max(batch * lane, PENNYLANE_STATES))
    return 0


def available(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Return the bytes that new processes can have; all of the machine's where only that is known, None without it."""
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
    """Refuse groups of seeds of which `workers` at a time do not fit into `free` bytes; None means that it is unknown.

    Raises
    ------
    OptionError
        Saying how many seeds would fit.
    """
    sizes = sorted((len(group) for group in groups), reverse=True)[:workers]
    needed = sum(group_bytes(entry, size) for size in sizes)
    if free is None or needed <= free:
        return
    fits = [
        (each * processes, processes)
        for processes in range(1, len(sizes) + 1)
        for each in range(1, sizes[0] + 1)
        if processes * group_bytes(entry, each) <= free
    ]
    if fits:
        seeds, processes = max(fits)
        first = format_seeds(sorted(seed for group in groups for seed in group)[:seeds])
        fewer = f" --workers {processes}" if processes < workers else ""
        advice = f"train fewer at a time, first --seeds {first}{fewer}; what is trained stays and counts"
    else:
        advice = (
            "not even one seed fits: give the model fewer qubits or units or frequencies, or the algorithm a smaller "
            "buffer"
        )
    raise OptionError(
        f"'{entry.label}': training {sum(sizes)} seeds at a time takes {size_text(needed)} of memory or more, and "
        f"{size_text(free)} are free here: {advice}"
    )
