"""A network that keeps the rules of models, which the tests beside this folder break one by one."""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    width: Annotated[int, Field(ge=1, description="units of the hidden layer")] = 32


class Network(nn.Module):
    def __init__(self, inputs: int, outputs: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, width)
        self.out = nn.Linear(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.out(torch.tanh(self.hidden(x)))
        return y


def build(obs_dim: int, out_dim: int, options: Options, generator: torch.Generator) -> Network:
    return Network(obs_dim, out_dim, options.width)
