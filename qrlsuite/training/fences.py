"""The global random generators (`random`, numpy's, torch's): no call into a plugin may depend on them or move them.

All seeds of a process share them, so a seed that draws from one gives another result in other company. Models are built
with their own states of them (`seeded`). What draws from them in training is found by `qrlsuite check` and the probe.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

States = tuple[Any, Any, torch.Tensor]

_GENERATORS = ("Python's `random`", "numpy's `np.random`", "torch's default generator")


def states() -> States:
    """Return the states of the global generators."""
    return random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002


def moved(before: States) -> list[str]:
    """Return the names of the generators that are not in the state that `states` returned."""
    after = states()
    same = (
        before[0] == after[0],
        before[1][2:] == after[1][2:] and bool(np.array_equal(before[1][1], after[1][1])),
        torch.equal(before[2], after[2]),
    )
    return [name for name, equal in zip(_GENERATORS, same) if not equal]


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Give the global generators states that follow from a seed, and afterwards the states that they had."""
    before = states()
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    torch.default_generator.manual_seed(seed % 2**63)
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        torch.set_rng_state(before[2])
