"""A small environment, a linear model and a group of seeds, on which algorithms are checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from torch import Tensor, nn

from qrlsuite import population, specs
from qrlsuite.environment import LaneEnv, State, batched_spaces
from qrlsuite.seeding import Streams, pack, unpack
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import require

E, OBS, ACTIONS, ROUNDS = 2, 4, 3, 40

Saved = Mapping[str, NDArray[Any]]
"""All that a group has, seed-first."""


class Toy(LaneEnv):
    """Reward 1 for the action that the observation shows; episodes of 2 to 10 steps, terminated or truncated."""

    def __init__(self, lanes: int) -> None:
        batched_spaces(self, Box(0.0, 2.0, (OBS,)), Discrete(ACTIONS), lanes)
        self.streams = []
        self.steps = 0
        self.begun = False
        self.kept = np.zeros((lanes, 4), dtype=np.int64)
        """Step, length, context, and whether the episode is to be truncated, of every lane."""

    def _begin(self, lane: int) -> None:
        stream = self.streams[lane]
        self.kept[lane] = 0, stream.integers(2, 11), stream.integers(ACTIONS), stream.integers(2)

    def _observe(self) -> NDArray[np.float32]:
        return np.column_stack([np.eye(ACTIONS)[self.kept[:, 2]], self.kept[:, 0] / 10]).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every lane."""
        self.begun = True
        for lane in range(self.num_envs):
            self._begin(lane)
        return self._observe(), {}

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take actions (L,)."""
        require(self.begun, "the environment was stepped before it was reset: start() resets it")
        taken = np.asarray(actions)
        require(
            taken.shape == (self.num_envs,) and taken.dtype.kind == "i",
            f"the environment was stepped with {taken.dtype} of shape {taken.shape}, and needs {self.num_envs} "
            "integers: lanes are seed-major, so reshape (S, E) to (S * E,)",
        )
        require(
            bool((taken >= 0).all() and (taken < ACTIONS).all()),
            f"the environment was stepped with actions {taken.min()}..{taken.max()}, and there are {ACTIONS}: they "
            "count from 0",
        )
        self.steps += 1
        rewards = (taken == self.kept[:, 2]).astype(np.float64)
        self.kept[:, 0] += 1
        self.kept[:, 2] = [stream.integers(ACTIONS) for stream in self.streams]
        done = self.kept[:, 0] >= self.kept[:, 1]
        cut = self.kept[:, 3] == 1
        final = self._observe()
        for lane in np.flatnonzero(done):
            self._begin(int(lane))
        infos: dict[str, Any] = {}
        if done.any():
            infos = {"final_obs": final, "_final_obs": done, "final_info": {}, "_final_info": done}
        return self._observe(), rewards, done & ~cut, done & cut, infos

    def state_dict(self) -> State:
        """Return the lanes' state (L, 4)."""
        return {"kept": self.kept.copy()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore it."""
        self.kept = np.array(state["kept"])
        self.begun = True


class _Linear(nn.Module):
    """A population of linear layers, every agent's parameters from a generator of its own."""

    def __init__(self, out_dim: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        drawn = torch.stack([torch.rand(out_dim, OBS, generator=generator) for generator in generators])
        self.weight = nn.Parameter((drawn * 2 - 1) / math.sqrt(OBS))
        self.bias = nn.Parameter(torch.zeros(len(generators), out_dim))

    def forward(self, x: Tensor) -> Tensor:
        """Map (S, B, 4) to (S, B, out)."""
        return population.linear(x, self.weight, self.bias)


class ToyGroup:
    """An algorithm with a group of seeds, as the core runs it."""

    def __init__(self, subject: Subject, seeds: Sequence[int], lanes: int = E, options: Any = None) -> None:
        spec = subject.spec
        assert isinstance(spec, specs.AlgorithmSpec)
        self.seeds = list(seeds)
        self.streams = [Streams("conformance", seed) for seed in seeds]
        self.envs = Toy(len(self.seeds) * lanes)
        self.envs.seed_lanes([s.numpy("environment", e) for s in self.streams for e in range(lanes)])
        self.outputs: list[int] = []
        factory = specs.resolve(spec.factory)
        own = subject.options() if options is None else options
        self.algorithm = factory(self.envs, self._model, own, self.streams, torch.device("cpu"))

    def _model(self, out_dim: int) -> nn.Module:
        call = len(self.outputs)
        self.outputs.append(out_dim)
        return _Linear(out_dim, [s.torch("init", call) for s in self.streams])

    def start(self) -> ToyGroup:
        """Begin."""
        self.algorithm.start()
        return self

    def train(self, epochs: int = 1) -> dict[str, NDArray[Any]]:
        """Train; returns the last epoch's metrics."""
        metrics: dict[str, NDArray[Any]] = {}
        for _ in range(epochs):
            metrics = self.algorithm.train_epoch(ROUNDS)
        return metrics

    def act(self) -> NDArray[np.int64]:
        """Return the greedy actions on fixed observations (S, 8, 4)."""
        observations = np.stack([s.numpy("look").random((8, OBS)).astype(np.float32) for s in self.streams])
        chosen: NDArray[np.int64] = self.algorithm.act(observations)
        return chosen

    @property
    def draws(self) -> bool:
        """Whether actions in validation are drawn, and differ from call to call."""
        return bool(getattr(self.algorithm, "draws", False))

    def save(self) -> dict[str, NDArray[Any]]:
        """Return everything, seed-first."""
        saved = {f"algorithm.{k}": array(v) for k, v in self.algorithm.state_dict().items()}
        size = len(self.seeds)
        saved["environment"] = self.envs.kept.reshape(size, E, -1).copy()
        saved["streams"] = pack(self.envs.streams).reshape(size, E, -1)
        return saved

    def load(self, saved: Mapping[str, NDArray[Any]]) -> ToyGroup:
        """Restore what `save` returned, or slices of it."""
        lanes = len(self.seeds) * E
        self.envs.load_state_dict({"kept": saved["environment"].reshape(lanes, -1)})
        self.envs.seed_lanes(unpack(saved["streams"].reshape(lanes, -1)))
        self.algorithm.load_state_dict(
            {
                k.removeprefix("algorithm."): torch.from_numpy(v.copy())
                for k, v in saved.items()
                if k.startswith("algorithm.")
            }
        )
        return self


def array(value: Any) -> NDArray[Any]:
    """Copy what an algorithm returned, whatever it is."""
    return np.array(value.detach().numpy() if isinstance(value, Tensor) else value)


def differs(a: Saved, b: Saved) -> str | None:
    """Return the names that only one of them has, or the first that is not the same in both, or None."""
    if a.keys() != b.keys():
        return ", ".join(sorted(a.keys() ^ b.keys()))
    return next((k for k, v in a.items() if not np.array_equal(v, b[k], equal_nan=v.dtype.kind == "f")), None)
