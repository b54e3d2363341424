"""A distribution of plugins whose seeds are not what they are alone, each in one way; its module is this file."""

from __future__ import annotations

import itertools
import os
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from pydantic.dataclasses import dataclass
from torch import Tensor, nn


@dataclass(frozen=True)
class Options:
    """None."""


class Net(nn.Module):
    """A linear layer, drawn from the generator."""

    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.rand(out, obs, generator=generator) - 0.5)

    def forward(self, x: Tensor) -> Tensor:
        return (x[..., None, :] * self.weight).sum(-1)  # sums in one order, whatever the stack


def good(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return Net(obs, out, generator)


def scaled(net: nn.Module, factor: Any) -> nn.Module:
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.mul_(factor)
    return net


class ClassAttribute(Net):
    gain = 1.0

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * ClassAttribute.gain


def class_attribute(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    net = ClassAttribute(obs, out, generator)
    ClassAttribute.gain = 1.0 + float(net.weight.detach().abs().mean())
    return net


class Growing(Net):
    passes = 0

    def forward(self, x: Tensor) -> Tensor:
        Growing.passes += 1
        return super().forward(x) * (1 + Growing.passes / 1000)


def growing(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return Growing(obs, out, generator)


def changing(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return scaled(Net(obs, out, generator), float(os.environ.get("GAIN", "1")))


WEIGHTS: dict[str, Tensor] = {}


def module_global(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    net = Net(obs, out, generator)
    return scaled(net, 1 + WEIGHTS.setdefault("first", net.weight.detach().clone()).abs().mean())


BUILDS = itertools.count(1)


def build_counter(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return scaled(Net(obs, out, generator), 1 + 1 / next(BUILDS))


def torch_in_build(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return scaled(Net(obs, out, generator), torch.rand(()))


class TorchInForward(Net):
    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * (1 + torch.rand(()))


def torch_in_forward(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return TorchInForward(obs, out, generator)


class UrandomInForward(Net):
    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * (1 + int.from_bytes(os.urandom(4), "big") / 2**32)


def urandom_in_forward(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return UrandomInForward(obs, out, generator)


class RecurrentBuffer(Net):
    state: Tensor

    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, generator)
        self.register_buffer("state", torch.zeros(obs))

    def forward(self, x: Tensor) -> Tensor:
        self.state = torch.tanh(self.state + x.mean(0))
        return super().forward(x + self.state)


def recurrent_buffer(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return RecurrentBuffer(obs, out, generator)


SCALES: dict[tuple[int, ...], float] = {}


class CacheByShape(Net):
    def forward(self, x: Tensor) -> Tensor:
        shape = tuple(x.shape)
        if shape not in SCALES:
            SCALES[shape] = 1 + float(super().forward(x).detach().abs().max())
        return super().forward(x) * SCALES[shape]


def cache_by_shape(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return CacheByShape(obs, out, generator)


class PlainInteger(Net):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, generator)
        self.level = int(torch.randint(1000, (), generator=generator))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * (1 + self.level / 1000)


def plain_integer(obs: int, out: int, options: Any, generator: torch.Generator) -> nn.Module:
    return PlainInteger(obs, out, generator)


class Hop(gymnasium.Env[Any, Any]):
    """Ten steps; the observation shows which of three actions is rewarded."""

    def __init__(self) -> None:
        self.action_space = Discrete(3)
        self.observation_space = Box(0.0, 1.0, (3,))

    def draw(self) -> int:
        return int(self.np_random.integers(3))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps, self.right, self.free = 0, 0, self.draw()
        return np.eye(3, dtype=np.float32)[self.free], {}

    def step(self, action: Any) -> Any:
        reward = float(action == self.free)
        self.steps, self.right = self.steps + 1, self.right + int(reward)
        self.free = (self.free + 1) % 3
        info = {"score": self.right / 10} if self.steps == 10 else {}
        return np.eye(3, dtype=np.float32)[self.free], reward, self.steps == 10, False, info


class LanesShareAList(Hop):
    episodes: list[int] = []

    def draw(self) -> int:
        self.episodes.append(super().draw())
        return sum(self.episodes) % 3


class EnvironmentCounter(Hop):
    made = 0

    def __init__(self) -> None:
        super().__init__()
        EnvironmentCounter.made += 1
        self.place = EnvironmentCounter.made

    def draw(self) -> int:
        return (super().draw() + self.place // 4) % 3


class NumpyInReset(Hop):
    def draw(self) -> int:
        return int(np.random.randint(3))  # noqa: NPY002
