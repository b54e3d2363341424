"""Fingerprints of seeds before their first epoch: numbers that agree on machines whose later bits differ.

A published entry carries them, and a machine that trains its seeds again computes them anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qrlsuite.experiment.entry import Entry

CHUNK = 25
"""Seeds at a time, to bound memory."""

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
        (S,): mean score of the untrained agent over a validation's episodes (at epoch 0).
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


def unknown(seeds: int) -> Fingerprint:
    """Return zeros for seeds that nobody here can begin: a script trained them."""
    return Fingerprint(np.zeros((seeds, 2)), np.zeros((seeds, 2)), np.zeros(seeds))


def _chunk(entry: Entry, seeds: list[int]) -> Fingerprint:
    from qrlsuite.training.trainer import Trainer  # torch, which reading a published entry does without

    trainer = Trainer(entry, seeds)
    trainer.seed_environments()
    observations, _ = trainer.envs.reset()
    first = np.asarray(observations, np.float64).reshape(len(seeds), -1)
    trainer.start()
    policy = trainer.algorithm.policy_state()
    tensors = [
        np.asarray(policy[name].detach().cpu().numpy(), np.float64).reshape(len(seeds), -1)
        for name in sorted(policy)
    ]
    return Fingerprint(
        np.concatenate([_moments(tensor) for tensor in tensors], axis=1),
        _moments(first),
        trainer.validate(0).mean(axis=1),
    )


def _moments(values: Floats) -> Floats:
    return np.stack([values.mean(axis=1), np.sqrt((values**2).mean(axis=1))], axis=1)
