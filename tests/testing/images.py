"""A small convolutional network that asks for the observations' space, for tests of the contract of images."""

from __future__ import annotations

from typing import Any

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.specs import ModelSpec


@dataclass(frozen=True)
class Options:
    """No options."""


class Convolutions(nn.Module):
    """Two convolutions and a layer; images are (height, width, channels), as Gymnasium's are."""

    def __init__(self, space: Any, outputs: int) -> None:
        super().__init__()
        self.shape = space.shape
        height, width, channels = self.shape
        self.first = nn.Conv2d(channels, 6, 3)
        self.second = nn.Conv2d(6, 4, 3, stride=2)
        self.last = nn.Linear(4 * ((height - 4 + 1) // 2) * ((width - 4 + 1) // 2), outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, height * width * channels) to (B, outputs)."""
        images = x.unflatten(-1, self.shape).movedim(-1, -3)
        return self.last(torch.relu(self.second(torch.relu(self.first(images)))).flatten(-3))


def build(obs_dim: int, out_dim: int, options: Any, generator: torch.Generator, space: Any) -> nn.Module:
    return Convolutions(space, out_dim)


SPEC = ModelSpec(
    "convolutions",
    "two convolutions",
    family="classical",
    options=f"{__name__}:Options",
    build=f"{__name__}:build",
)
