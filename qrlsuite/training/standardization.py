"""Running statistics: every agent standardizes observations by mean and variance of its training observations.

Where an environment asks for it (`LaneEnv.running_statistics`, the option `normalization = "running"`), an agent with
mean m and variance v of each observed value sees

    z = clip((x - m) / sqrt(v + 1e-8), -10, 10)

in place of the observation x, in all of its networks. The constants are from Stable-Baselines3's `VecNormalize`;
Gymnasium's `NormalizeObservation` does not clip.

- *Whose.* Statistics belong to a seed. They are gathered from every observation that a step of its training
  environments returns: after an episode's end the next episode's first, so that each is an observation to act on.
  Validation and evaluation use the statistics without changing them.
- *When.* Networks use the statistics of all epochs before the current one: they stand still while an epoch is
  collected, learned from and validated. Log-probabilities of a rollout thus belong exactly to the policy that acted;
  wrappers that update with every step reach that only by storing each standardized observation. OpenAI Baselines' PPO
  and TRPO update once per rollout too. The first epoch has no statistics: m = 0, v = 1.
- *Where.* Before the first layer of each network, not in the environment. Rollouts, unfinished episodes and the
  replay buffer hold raw observations, which are standardized when used, old ones by the current statistics; the same
  holds for inputs of a target network. An algorithm needs to know nothing of it.

Mean and variance come from Welford's update in float64 for each training environment by itself (Welford 1962). A
seed's environments are merged in their order (Chan, Golub & LeVeque 1983): elementwise operations only, so that no
seed depends on its company in any bit. A circuit's model gets the same z as any other; it lies in [-10, 10],
not within one period of a rotation, and most of it in [-3, 3].
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

CLIP = 10.0
EPSILON = 1e-8
PREFIX = "observation_statistics."
"""Prefix of the statistics' names among an agent's parameters and in a checkpoint."""


class RunningStatistics:
    """The statistics of S seeds with E environments each, and the standardization by them.

    Parameters
    ----------
    seeds, environments, size:
        S, E, and the number n of values of an observation.
    device:
        Where the networks are.

    Attributes
    ----------
    count:
        Observations gathered from each environment so far.
    mean, squares:
        Their mean, and the sum of squared deviations from it (S * E, n).
    used:
        The statistics in use: `count` (S,) int64, `mean` and `variance` (S, n) float64.
    """

    def __init__(self, seeds: int, environments: int, size: int, device: torch.device) -> None:
        self.S, self.E, self.device = seeds, environments, device
        self.count = 0
        self.mean, self.squares = (np.zeros((seeds * environments, size)) for _ in range(2))
        self.used = {
            "count": torch.zeros(seeds, dtype=torch.int64),
            "mean": torch.zeros((seeds, size), dtype=torch.float64),
            "variance": torch.ones((seeds, size), dtype=torch.float64),
        }
        self.refresh()

    def attach(self, population: nn.Module) -> None:
        """Let a population (S, B, n) -> (S, B, out), and every copy of it, standardize its inputs."""
        population.register_forward_pre_hook(self)

    def __call__(self, population: nn.Module, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
        """Standardize the first of a population's inputs, (S, B, n), or its first n numbers where it has more."""
        x, *others = inputs
        n = self._mean.shape[2]
        if x.shape[2] > n:
            seen = ((x[..., :n] - self._mean) / self._deviation).clamp(-CLIP, CLIP)
            return torch.cat([seen, x[..., n:]], 2), *others
        return ((x - self._mean) / self._deviation).clamp(-CLIP, CLIP), *others

    def __deepcopy__(self, memo: dict[int, Any]) -> RunningStatistics:
        """Return itself: a target network copied from another uses the same statistics."""
        return self

    def observe(self, observations: NDArray[np.floating[Any]]) -> None:
        """Gather the observations (S * E, ...) that a training step returned."""
        x = observations.reshape(len(self.mean), -1)
        if not np.isfinite(x).all():
            value = x[~np.isfinite(x)][0]
            raise ValueError(
                f"an observation has the value {value}, and normalization = 'running' needs finite ones"
            )
        self.count += 1
        away = x - self.mean
        self.mean += away / self.count
        self.squares += away * (x - self.mean)

    def adopt(self) -> None:
        """Standardize by all that has been gathered, from now on."""
        if self.count == 0:
            return
        means, squares = (v.reshape(self.S, self.E, -1) for v in (self.mean, self.squares))
        mean, total = means[:, 0].copy(), squares[:, 0].copy()
        for e in range(1, self.E):  # e environments with `count` observations each, and one more
            away = means[:, e] - mean
            mean += away / (e + 1)
            total += squares[:, e] + away**2 * (self.count * e / (e + 1))
        self.used["count"].fill_(self.count * self.E)
        self.used["mean"].copy_(torch.from_numpy(mean))
        self.used["variance"].copy_(torch.from_numpy(total / (self.count * self.E)))
        self.refresh()

    def refresh(self) -> None:
        """Compute mean and deviation from the values in `used`."""
        deviation = (self.used["variance"] + EPSILON).sqrt()
        self._mean = self.used["mean"][:, None].to(torch.float32).to(self.device)
        self._deviation = deviation[:, None].to(torch.float32).to(self.device)

    def published(self) -> dict[str, Tensor]:
        """Return the statistics in use, seed-first, under names for the agents' parameters; no copies."""
        return {f"{PREFIX}{name}": value for name, value in self.used.items()}

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Return copies of all that is gathered and used, seed-first."""
        return {
            "count": np.full(self.S, self.count, dtype=np.int64),
            "mean": self.mean.reshape(self.S, self.E, -1).copy(),
            "squares": self.squares.reshape(self.S, self.E, -1).copy(),
            **{f"used.{name}": value.numpy().copy() for name, value in self.used.items()},
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a result of `state_dict`, also of a group cut from or merged of others at the same epoch."""
        self.count = int(state["count"][0])
        self.mean = state["mean"].reshape(self.mean.shape).copy()
        self.squares = state["squares"].reshape(self.squares.shape).copy()
        for name, value in self.used.items():
            value.copy_(torch.from_numpy(state[f"used.{name}"]))
        self.refresh()
