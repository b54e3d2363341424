"""What a seed looks like before its first epoch: what must agree between machines that cannot agree bit for bit.

A published entry carries these numbers, and whoever re-runs its seeds elsewhere computes them anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qrlsuite.experiment.entry import Entry
from qrlsuite.results.store import EntryStore
from qrlsuite.training.group import GroupRun

CHUNK = 25
"""Seeds at a time: memory stays that of a small group."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Fingerprint:
    """The beginning of S seeds.

    Attributes
    ----------
    parameters:
        (S, 2 P): mean and root mean square of each of the P tensors of an untrained agent, by name in order.
    episodes:
        (S, 2): mean and root mean square of the observations with which the first epoch's episodes begin.
    before:
        (S,): mean score of the untrained agent over a validation's episodes (those of epoch 0).
    """

    parameters: Floats
    episodes: Floats
    before: Floats


def fingerprint(entry: Entry, seeds: Sequence[int]) -> Fingerprint:
    """Build the seeds' agents and environments, play one validation, and train nothing.

    Returns
    -------
    Fingerprint
        One row per seed, in their order; it does not depend on which seeds are asked for together.
    """
    parts = [_chunk(entry, list(seeds[i : i + CHUNK])) for i in range(0, len(seeds), CHUNK)]
    return Fingerprint(
        np.concatenate([part.parameters for part in parts]),
        np.concatenate([part.episodes for part in parts]),
        np.concatenate([part.before for part in parts]),
    )


def _chunk(entry: Entry, seeds: list[int]) -> Fingerprint:
    group = GroupRun(entry, EntryStore(Path()), seeds, epochs=0, tracked=False)
    group.begin_episodes()
    observations, _ = group.envs.reset()
    first = np.asarray(observations, np.float64).reshape(len(seeds), -1)
    group.begin_episodes()
    group.algorithm.start()
    policy = group.algorithm.policy_state()
    tensors = [
        np.asarray(policy[name].detach().cpu().numpy(), np.float64).reshape(len(seeds), -1)
        for name in sorted(policy)
    ]
    return Fingerprint(
        np.concatenate([_moments(tensor) for tensor in tensors], axis=1),
        _moments(first),
        group.validate(0).mean(axis=1),
    )


def _moments(values: Floats) -> Floats:
    return np.stack([values.mean(axis=1), np.sqrt((values**2).mean(axis=1))], axis=1)
