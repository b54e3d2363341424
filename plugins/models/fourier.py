"""Fourier features: cosines and sines of linear functions of the input, then a linear layer.

    f(x) = A [cos(W x), sin(W x)] + b,   W (frequencies, inputs), at first normal with standard deviation `bandwidth`

A re-uploading circuit is a trigonometric polynomial of its inputs (Schuld, Sweke & Meyer 2021, Phys. Rev. A 103,
032430), so this is its classical relative. With `train = linear` the frequencies stay as drawn: random Fourier features
(Rahimi & Recht 2007; for circuits Landman et al. 2022, arXiv:2210.13200).

For i inputs and o outputs D frequencies are D i + 2 D o + o scalars: 309 at D = 34, i = o = 3. With fixed frequencies,
D = 51 has 309 to train.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.options import Tuned
from qrlsuite.plugins.models.mlp import initial_layer
from qrlsuite.population import layers


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FourierOptions:
    """Options of Fourier features."""

    frequencies: Annotated[
        int, Field(ge=1, le=2**16, description="number D of frequencies; each has a cosine and a sine")
    ] = 34
    bandwidth: Annotated[
        float,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="standard deviation of the initial frequencies, radians per unit",
        ),
        Tuned(0.3, 30, per_agent=True),
    ] = 1.0
    train: Annotated[
        Literal["all", "linear"],
        Field(
            description="all: frequencies and linear layer; linear: the linear layer, frequencies stay as drawn"
        ),
    ] = "all"


class Fourier(nn.Module):
    """One agent's features and linear layer; (B, in) -> (B, out).

    Parameters `frequencies` (D, in), `weight` (out, 2 D) and `bias` (out,).
    """

    def __init__(
        self, obs_dim: int, out_dim: int, options: FourierOptions, generator: torch.Generator
    ) -> None:
        super().__init__()
        drawn = options.bandwidth * torch.randn((options.frequencies, obs_dim), generator=generator)
        weight, bias = initial_layer(2 * options.frequencies, out_dim, "torch", generator)
        self.frequencies = nn.Parameter(drawn, requires_grad=options.train == "all")
        self.weight, self.bias = nn.Parameter(weight), nn.Parameter(bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, in) to (B, out)."""
        angles = nn.functional.linear(x, self.frequencies)
        return nn.functional.linear(torch.cat([angles.cos(), angles.sin()], dim=1), self.weight, self.bias)


class FourierPopulation(nn.Module):
    """S modules; (S, B, in) -> (S, B, out); parameters as in `Fourier` with a leading axis S."""

    compiled = True
    frequencies: Tensor
    weight: Tensor
    bias: Tensor

    def __init__(self, modules: Sequence[Fourier]) -> None:
        super().__init__()
        for name, first in modules[0].named_parameters():
            stacked = torch.stack([m.get_parameter(name).detach() for m in modules])
            self.register_parameter(name, nn.Parameter(stacked, requires_grad=first.requires_grad))

    def forward(self, x: Tensor) -> Tensor:
        """Map (S, B, in) to (S, B, out)."""
        angles = layers(x, [self.frequencies], [self.frequencies.new_zeros(self.frequencies.shape[:2])])
        return layers(torch.cat([angles.cos(), angles.sin()], dim=2), [self.weight], [self.bias])


def build(obs_dim: int, out_dim: int, options: FourierOptions, generator: torch.Generator) -> Fourier:
    """Build one agent's model with every random number drawn from `generator`."""
    return Fourier(obs_dim, out_dim, options, generator)


def population(modules: Sequence[Fourier], options: FourierOptions) -> FourierPopulation:
    """Stack built models."""
    return FourierPopulation(modules)
