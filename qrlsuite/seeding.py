"""Named random streams per seed: training seeds together gives each the same result as training it alone.

A stream's key is the first 128 bits of SHA-256 over (task hash, seed, stream name, index). Algorithm and model
are deliberately not in the key: all entries of a task face the same validation episodes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

UINT64 = (1 << 64) - 1


def stream_key(task_hash: str, seed: int, name: str, index: int = 0) -> int:
    """Return the 128-bit key of a stream."""
    text = f"{task_hash}/{seed}/{name}/{index}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:16], "big")


class Streams:
    """The random streams of one seed of one task.

    Parameters
    ----------
    task_hash:
        `Task.hash`.
    seed:
        The protocol seed, a non-negative integer.
    """

    def __init__(self, task_hash: str, seed: int) -> None:
        self.task_hash = task_hash
        self.seed = seed

    def numpy(self, name: str, index: int = 0) -> np.random.Generator:
        """Return a fresh numpy generator for a stream; the same arguments give the same numbers."""
        return np.random.Generator(np.random.Philox(key=stream_key(self.task_hash, self.seed, name, index)))

    def torch(self, name: str, index: int = 0) -> torch.Generator:
        """Return a fresh torch generator (CPU) for a stream."""
        generator = torch.Generator()
        generator.manual_seed(stream_key(self.task_hash, self.seed, name, index) & (UINT64 >> 1))
        return generator


def pack(generators: Sequence[np.random.Generator]) -> NDArray[np.uint64]:
    """Return the states of Philox generators as an array (len(generators), 13), for checkpoints."""
    rows = []
    for generator in generators:
        state: dict[str, Any] = dict(generator.bit_generator.state)
        rows.append(
            [
                *(int(v) for v in state["state"]["counter"]),
                *(int(v) for v in state["state"]["key"]),
                *(int(v) for v in state["buffer"]),
                int(state["buffer_pos"]),
                int(state["has_uint32"]),
                int(state["uinteger"]),
            ]
        )
    return np.array(rows, dtype=np.uint64).reshape(len(rows), 13)


def unpack(states: NDArray[np.uint64]) -> list[np.random.Generator]:
    """Return generators that continue where `pack` found them.

    Raises
    ------
    ValueError
        If the array is not (n, 13).
    """
    if states.ndim != 2 or states.shape[1] != 13:
        raise ValueError(f"random stream states have shape {states.shape}, expected (n, 13)")
    generators = []
    for row in states:
        bit_generator = np.random.Philox(key=0)
        bit_generator.state = {
            "bit_generator": "Philox",
            "state": {"counter": row[0:4].copy(), "key": row[4:6].copy()},
            "buffer": row[6:10].copy(),
            "buffer_pos": int(row[10]),
            "has_uint32": int(row[11]),
            "uinteger": int(row[12]),
        }
        generators.append(np.random.Generator(bit_generator))
    return generators
