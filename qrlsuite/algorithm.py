"""The contract of a learning algorithm: one class, one file.

An algorithm trains S agents at once. Every tensor it keeps has the seed axis S first, so that a checkpointed
group of seeds can be split and merged by slicing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn


class BuildModel(Protocol):
    """Builds populations of the entry's model; every call draws anew.

    An entry's parameters are counted over all the networks that are built by it. One that is not trained, such as a
    target network, is a `copy.deepcopy` of another, or frozen by `requires_grad_(False)`.
    """

    def __call__(self, outputs: int, inputs: int | None = None, role: str = "network") -> nn.Module:
        """Return a population of S freshly initialized agents: (S, B, inputs) -> (S, B, outputs).

        Parameters
        ----------
        inputs:
            Number of its inputs; None: the size of an observation. If it gets more, such as the critic of a continuous
            action, the observation comes first.
        role:
            Purpose of the network, `"actor"` or `"critic"`: passed on to a model that asks for it.
        """


class Algorithm(Protocol):
    """A learning algorithm over S seeds with E environments each.

    Constructed as `factory(envs, build_model, options, streams, device)`: `envs` is a
    `qrlsuite.environment.LaneEnv` of S * E seed-major lanes that has not been reset, `streams` a list of S
    `qrlsuite.seeding.Streams`. Randomness is drawn per seed, from streams that carry the epoch as index where
    a whole epoch's numbers are drawn at once.

    Store observations and give them to the networks unchanged: if a task normalizes by running statistics, the
    populations of `build_model` standardize their inputs, by statistics that stand still during an epoch
    (`qrlsuite.training.standardization`).
    """

    def start(self) -> None:
        """Reset the environments. Called once for a new run; a resumed run calls `load_state_dict` instead."""

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Interact for `rounds` steps of every environment, learn, and return metrics of shape (S,).

        An algorithm that learns from data of its own, and steps nothing, has a true attribute `offline`. Boards count
        its epochs in interactions like the epochs of others.
        """

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return the actions of validation (S, B, ...) for observations (S, B, obs), in their space's shape and type.

        An algorithm that draws them has an attribute `draws` that is true. It draws from streams of its own, so that
        training goes on as if no action had been drawn.

        It may be `act(observations, begins, infos)` instead: `begins` (S, B) says where an episode begins with the
        observation, and `infos` are the lanes' infos on it, such as `action_mask` (S, B, choices). Its memory of an
        episode is a state of its own, forgotten where an episode begins. The memory of training is a separate state,
        in `state_dict`; neither is in `policy_state`.

        An algorithm may have a method `choose(seen)`, which returns greedy actions (S, B) for a tensor (S, B, obs)
        without a host read: by it, validation is played on the device (`qrlsuite.device`).

        An algorithm whose network makes a policy may have a method `information(outputs)`: for outputs (S, B, outputs)
        float64 of the first network that it built, the Fisher information (S, B, outputs, outputs) of the actions'
        distribution. Without it, `qrlsuite diagnose` takes outputs for values.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that training depends on, seed-first, environments' state excluded."""

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore `state_dict`, also onto a group cut from or merged of others at the same epoch."""

    def policy_state(self) -> dict[str, Tensor]:
        """Return the parameters that `act` uses, seed-first; they are published as the trained agents.

        The tensors themselves, not copies: `qrlsuite evaluate` loads trained parameters into them.
        """
