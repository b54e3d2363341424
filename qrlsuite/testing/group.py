"""A small environment, a linear model and a group of seeds, on which algorithms are checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import InvalidAction
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray
from torch import Tensor, nn

from qrlsuite import population, specs
from qrlsuite.actions import check_actions
from qrlsuite.environment import LaneEnv, State, batched_spaces
from qrlsuite.masks import NOTHING
from qrlsuite.seeding import Streams, pack, unpack
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import require
from qrlsuite.training.trainer import asks_for_more, build_envs

E, OBS, ACTIONS, ROUNDS = 2, 4, 3, 40

SPACES: dict[str, gymnasium.Space[Any]] = {
    "discrete": Discrete(ACTIONS),
    "multi-discrete": MultiDiscrete([ACTIONS, 2]),
    "multi-binary": MultiBinary(ACTIONS),
    "box": Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32)),
}
"""The actions of the toys, by kind."""


class Toy(LaneEnv):
    """Reward 1 for the action that the observation shows, part of it for a part; episodes of 2 to 10 steps.

    They are terminated or truncated. With `hidden`, an episode has one context, which only its first observation shows.
    With `masked`, one of the discrete actions is forbidden, another at every other step, and never the best.
    """

    def __init__(
        self, lanes: int, kind: str = "discrete", hidden: bool = False, masked: bool = False
    ) -> None:
        batched_spaces(self, Box(0.0, 2.0, (OBS,)), SPACES[kind], lanes)
        self.hidden, self.masked = hidden, masked
        self.streams = []
        self.begun = False
        self.kept = np.zeros((lanes, 4), dtype=np.int64)
        """Step, length, context, and whether the episode is to be truncated, of every lane."""

    def _begin(self, lane: int) -> None:
        stream = self.streams[lane]
        self.kept[lane] = 0, stream.integers(2, 11), stream.integers(ACTIONS), stream.integers(2)

    def _observe(self) -> NDArray[np.float32]:
        shown = np.eye(ACTIONS)[self.kept[:, 2]]
        if self.hidden:
            shown[self.kept[:, 0] > 0] = 0
        return np.column_stack([shown, self.kept[:, 0] / 10]).astype(np.float32)

    def masks(self) -> dict[str, Any]:
        """Return infos with the mask of allowed actions (L, actions); empty without `masked`."""
        forbidden = (self.kept[:, 2] + 1 + self.kept[:, 0] % 2) % ACTIONS
        return {"action_mask": forbidden[:, None] != np.arange(ACTIONS)} if self.masked else {}

    def _rewards(self, taken: NDArray[Any]) -> NDArray[np.float64]:
        context, space = self.kept[:, 2], self.single_action_space
        right: NDArray[Any] = taken == context if taken.ndim == 1 else taken[:, 0] == context
        if isinstance(space, MultiDiscrete):
            right = 0.5 * right + 0.5 * (taken[:, 1] == (context > 0))
        elif isinstance(space, MultiBinary):
            right = (taken == np.eye(ACTIONS)[context]).mean(1)
        elif isinstance(space, Box):
            middle, half = (space.low + space.high) / 2, (space.high - space.low) / 2
            right = 1.0 - np.abs((taken - middle) / half - (context - 1)[:, None]).mean(1)
        return right.astype(np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every lane."""
        self.begun = True
        for lane in range(self.num_envs):
            self._begin(lane)
        return self._observe(), self.masks()

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take actions (L, ...)."""
        taken = np.asarray(actions)
        _require_actions(taken, self)
        rewards = self._rewards(taken)
        self.kept[:, 0] += 1
        if not self.hidden:
            self.kept[:, 2] = [stream.integers(ACTIONS) for stream in self.streams]
        done = self.kept[:, 0] >= self.kept[:, 1]
        cut = self.kept[:, 3] == 1
        final, last = self._observe(), self.masks()
        for lane in np.flatnonzero(done):
            self._begin(int(lane))
        infos: dict[str, Any] = {}
        if done.any():
            infos = {"final_obs": final, "_final_obs": done, "final_info": last, "_final_info": done}
        return self._observe(), rewards, done & ~cut, done & cut, {**infos, **self.masks()}

    def state_dict(self) -> State:
        """Return the lanes' state (L, 4)."""
        return {"kept": self.kept.copy()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore it."""
        self.kept = np.array(state["kept"])
        self.begun = True


def _require_actions(taken: NDArray[Any], envs: Toy) -> None:
    """Require that lanes are stepped with actions of their space, after a reset."""
    require(envs.begun, "the environment was stepped before it was reset: start() resets it")
    lanes, space = envs.num_envs, envs.single_action_space
    try:
        check_actions(taken, lanes, space)
    except InvalidAction as error:
        require(
            False,
            f"the environment was stepped with actions that are none of {space}: {error}; lanes are seed-major, so "
            "reshape (S, E) to (S * E,), and choices count from 0",
        )
    if envs.masked:
        free = envs.masks()["action_mask"][np.arange(lanes), taken]
        require(
            bool(free.all()),
            "the environment was stepped with actions that infos['action_mask'] forbids: exploring ones too are drawn "
            "among the others (qrlsuite.masks)",
        )


@dataclass(frozen=True)
class World:
    """Where an algorithm is checked: a toy with a kind of actions, or the environment of a task.

    Attributes
    ----------
    make:
        Builds a number of lanes.
    hidden:
        Whether something has to be remembered, so that networks do.
    masked:
        Whether actions are forbidden.
    """

    make: Callable[[int], LaneEnv]
    hidden: bool = False
    masked: bool = False

    @classmethod
    def toy(cls, kind: str, hidden: bool = False, masked: bool = False) -> World:
        """Return the toy with a kind of actions."""
        return cls(lambda lanes: Toy(lanes, kind, hidden, masked), hidden, masked)

    @classmethod
    def of_task(cls, name: str) -> World:
        """Return the environment of a registered task, or of a task's file."""
        from qrlsuite.experiment.entry import Entry
        from qrlsuite.experiment.task import load

        nothing: Any = None
        entry = Entry(load(name), nothing, nothing, None, None, None)
        return cls(lambda lanes: build_envs(entry, lanes, lambda: None).inner)

    @cached_property
    def one(self) -> LaneEnv:
        """One lane, to look at its spaces."""
        return self.make(1)

    @property
    def inputs(self) -> int:
        """The numbers of an observation."""
        return int(np.prod(self.one.single_observation_space.shape or (1,)))

    @property
    def space(self) -> gymnasium.Space[Any]:
        """The actions."""
        return self.one.single_action_space


class _Linear(nn.Module):
    """A population of linear layers, every agent's parameters from a generator of its own."""

    def __init__(self, outputs: int, inputs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        drawn = torch.stack([torch.rand(outputs, inputs, generator=generator) for generator in generators])
        self.weight = nn.Parameter((drawn * 2 - 1) / math.sqrt(inputs))
        self.bias = nn.Parameter(torch.zeros(len(generators), outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, outputs)."""
        return population.linear(x, self.weight, self.bias)


class _Remembering(nn.Module):
    """A population of layers that see the mean of an episode's observations so far, the last half of it."""

    def __init__(self, outputs: int, inputs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__()
        self.remembers = inputs
        self.layer = _Linear(outputs, 2 * inputs, generators)

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Map (S, B, inputs) and a memory (S, B, inputs) to (S, B, outputs) and the next memory."""
        before = torch.zeros_like(x) if state is None else state
        after = 0.5 * before + 0.5 * x
        outputs = self.layer(torch.cat([x, before], 2))
        return outputs if state is None else (outputs, after)


class ToyGroup:
    """An algorithm with a group of seeds, as the core runs it."""

    def __init__(
        self,
        subject: Subject,
        seeds: Sequence[int],
        lanes: int = E,
        options: Any = None,
        world: World | None = None,
    ) -> None:
        spec = subject.spec
        assert isinstance(spec, specs.AlgorithmSpec)
        self.seeds = list(seeds)
        self.world = world or World.toy(spec.actions[0])
        self.streams = [Streams("conformance", seed) for seed in seeds]
        self.envs, self.steps = self.world.make(len(self.seeds) * lanes), 0
        self.envs.step = self._counted(self.envs.step)  # type: ignore[method-assign]
        self.envs.seed_lanes([s.numpy("environment", e) for s in self.streams for e in range(lanes)])
        self.outputs: list[int] = []
        factory = specs.resolve(spec.factory)
        own = subject.options() if options is None else options
        self.algorithm = factory(self.envs, self._model, own, self.streams, torch.device("cpu"))

    def _counted(self, step: Callable[..., Any]) -> Callable[..., Any]:
        def counted(actions: NDArray[Any]) -> Any:
            self.steps += 1
            return step(actions)

        return counted

    def _model(self, outputs: int, inputs: int | None = None, role: str = "network") -> nn.Module:
        call = len(self.outputs)
        self.outputs.append(outputs)
        given = self.world.inputs if inputs is None else inputs
        generators = [s.torch("init", call) for s in self.streams]
        model = _Remembering if self.world.hidden else _Linear
        return model(outputs, given, generators)

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

    def look(self, lanes: int = 8) -> NDArray[np.float32]:
        """Return fixed observations (S, lanes, inputs)."""
        size = (lanes, self.world.inputs)
        return np.stack([s.numpy("look").random(size).astype(np.float32) for s in self.streams])

    def act(
        self,
        observations: NDArray[np.float32] | None = None,
        begins: NDArray[np.bool_] | None = None,
        infos: Mapping[str, Any] = NOTHING,
    ) -> NDArray[Any]:
        """Return the greedy actions on observations (S, B, inputs), by default on the fixed ones.

        Parameters
        ----------
        begins:
            Where episodes begin (S, B), for an algorithm that asks; None: everywhere.
        infos:
            The lanes' infos on the observations, for an algorithm that asks for them.
        """
        seen = self.look() if observations is None else observations
        more: tuple[Any, ...] = ()
        if self.remembers:
            more = np.ones(seen.shape[:2], np.bool_) if begins is None else begins, infos
        heeds = {"infos": infos} if infos and not more else {}
        chosen: NDArray[Any] = self.algorithm.act(seen, *more, **heeds)
        return chosen

    @property
    def remembers(self) -> bool:
        """Whether `act` asks where episodes begin."""
        return asks_for_more(self.algorithm.act)

    @property
    def draws(self) -> bool:
        """Whether actions in validation are drawn, and differ from call to call."""
        return bool(getattr(self.algorithm, "draws", False))

    def save(self) -> dict[str, NDArray[Any]]:
        """Return everything, seed-first."""
        saved = {f"algorithm.{k}": array(v) for k, v in self.algorithm.state_dict().items()}
        size = len(self.seeds)
        for name, value in self.envs.state_dict().items():
            saved[f"environment.{name}"] = value.reshape(size, E, *value.shape[1:]).copy()
        saved["streams"] = pack(self.envs.streams).reshape(size, E, -1)
        return saved

    def load(self, saved: Mapping[str, NDArray[Any]]) -> ToyGroup:
        """Restore a result of `save`, or slices of it."""
        lanes = len(self.seeds) * E
        self.envs.seed_lanes(unpack(saved["streams"].reshape(lanes, -1)))
        self.envs.load_state_dict(
            {
                k.removeprefix("environment."): v.reshape(lanes, *v.shape[2:]).copy()
                for k, v in saved.items()
                if k.startswith("environment.")
            }
        )
        self.algorithm.load_state_dict(
            {
                k.removeprefix("algorithm."): torch.from_numpy(v.copy())
                for k, v in saved.items()
                if k.startswith("algorithm.")
            }
        )
        return self


def array(value: Any) -> NDArray[Any]:
    """Copy an algorithm's result of any type."""
    return np.array(value.detach().numpy() if isinstance(value, Tensor) else value)
