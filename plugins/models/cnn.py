"""A small convolutional network for images: convolutions with rectifiers, one hidden layer, a linear layer.

The architecture of Mnih et al. (2015, Nature 518, 529) made small: theirs has three convolutions and a hidden layer of
512 units. Images are (height, width), (height, width, channels), or (channels, height, width) where the first side is
shorter than the last. Their values are mapped from the space's bounds to 0 .. 1, bytes thus divided by 255; without
bounds they are not changed. A critic's action, given beside the image, joins the hidden layer's inputs.

Initial values are as in `torch.nn.Conv2d` and `torch.nn.Linear`: uniform(-1/sqrt(n), 1/sqrt(n)), n being the inputs
of a unit. A population's convolutions are exact in any stack (`qrlsuite.population.stack`).
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import spaces
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.errors import OptionError


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CNNOptions:
    """Options of the convolutional network."""

    channels: Annotated[int, Field(ge=1, le=1024, description="channels of each convolution")] = 16
    depth: Annotated[int, Field(ge=1, le=6, description="number of convolutions")] = 2
    kernel: Annotated[int, Field(ge=1, le=15, description="side of a convolution's window")] = 3
    stride: Annotated[int, Field(ge=1, le=8, description="steps of the window")] = 1
    width: Annotated[int, Field(ge=1, le=4096, description="units of the hidden layer")] = 64


class CNN(nn.Module):
    """One agent's network, (B, inputs) -> (B, outputs); inputs are flat, as lanes give them."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        space: spaces.Space[Any],
        options: CNNOptions,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        if not isinstance(space, spaces.Box) or len(space.shape) not in (2, 3):
            raise OptionError(
                f"model 'cnn' needs images, a Box of (height, width) or (height, width, channels), and observations "
                f"are {' '.join(str(space).split())[:100]}: take model 'mlp'"
            )
        self.shape = space.shape if len(space.shape) == 3 else (*space.shape, 1)
        self.channels = 0 if self.shape[0] < self.shape[2] else 2  # their axis
        low, high = float(space.low.min()), float(space.high.max())
        self.low, self.span = (low, high - low) if -np.inf < low < high < np.inf else (0.0, 1.0)
        self.pixels = math.prod(self.shape)
        layers: list[nn.Module] = []
        sides = [side for axis, side in enumerate(self.shape) if axis != self.channels]
        before = self.shape[self.channels]
        for convolution in range(options.depth):
            if min(sides) < options.kernel:
                raise OptionError(
                    f"model 'cnn': an image of {space.shape} has sides of {sides} at convolution {convolution + 1}, "
                    f"below kernel = {options.kernel}: set depth={convolution or 1}, a smaller kernel or stride=1"
                )
            layers += [nn.Conv2d(before, options.channels, options.kernel, options.stride), nn.ReLU()]
            sides = [(side - options.kernel) // options.stride + 1 for side in sides]
            before = options.channels
        self.convolutions = nn.Sequential(*layers)
        self.hidden = nn.Linear(before * math.prod(sides) + inputs - self.pixels, options.width)
        self.last = nn.Linear(options.width, outputs)
        with torch.no_grad():
            for layer in (*layers[::2], self.hidden, self.last):
                assert isinstance(layer, nn.Conv2d | nn.Linear)
                assert layer.bias is not None
                bound = 1.0 / math.sqrt(layer.weight[0].numel())
                for parameter in (layer.weight, layer.bias):
                    parameter.copy_((torch.rand(parameter.shape, generator=generator) * 2.0 - 1.0) * bound)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs) to (B, outputs)."""
        pixels = (x[..., : self.pixels] - self.low) / self.span
        images = pixels.view(*x.shape[:-1], *self.shape)
        seen = self.convolutions(images.movedim(self.channels - 3, -3)).flatten(-3)
        both = torch.cat([seen, x[..., self.pixels :]], -1)
        outputs: Tensor = self.last(torch.relu(self.hidden(both)))
        return outputs


def build(
    obs_dim: int, out_dim: int, options: CNNOptions, generator: torch.Generator, space: spaces.Space[Any]
) -> CNN:
    """Build one agent's network with its initial parameters drawn from `generator`."""
    return CNN(obs_dim, out_dim, space, options, generator)
