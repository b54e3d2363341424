"""Trained Fourier features: cosines and sines of linear functions of the input, then a linear layer."""

from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import nn


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """Options of `waves`."""

    features: Annotated[int, Field(ge=1, description="number of frequencies")] = 24
    scale: Annotated[float, Field(gt=0, description="spread of the initial frequencies")] = 3.0


class Fourier(nn.Module):
    def __init__(self, inputs, outputs, options, generator):
        super().__init__()
        frequencies = options.scale * torch.randn(options.features, inputs, generator=generator)
        amplitudes = torch.randn(outputs, 2 * options.features, generator=generator)
        self.frequencies = nn.Parameter(frequencies)
        self.amplitudes = nn.Parameter(amplitudes / options.features)

    def forward(self, x):  # (B, inputs) -> (B, outputs)
        phases = x @ self.frequencies.T
        return torch.cat([phases.cos(), phases.sin()], dim=1) @ self.amplitudes.T


def build(obs_dim, out_dim, options, generator):
    return Fourier(obs_dim, out_dim, options, generator)
