"""A gated recurrent unit (Cho et al. 2014, arXiv:1406.1078) and a linear layer: a network that remembers.

With input x, state h of `width` numbers, 0 where an episode begins, and logistic function s(a) = (1 + tanh(a / 2)) / 2:

    r  = s(W_r x + U_r h + b_r)                  which of h is seen
    z  = s(W_z x + U_z h + b_z)                  how much of h is kept
    c  = tanh(W_c x + b_c + r (U_c h + d_c))     as torch.nn.GRU and cuDNN have it; the paper has U_c (r h)
    h' = (1 - z) c + z h
    y  = V h' + v

The cell is written out, and s by the hyperbolic tangent: torch rounds its own sigmoid differently in the body and in
the tail of a vector, and a seed would depend on the seeds that are trained with it. Initial values are those of
`torch.nn.GRU` and `torch.nn.Linear`: uniform(-1/sqrt(n), 1/sqrt(n)), n being the width.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.options import Tuned


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class GRUOptions:
    """Options of the gated recurrent unit."""

    width: Annotated[int, Field(ge=1, le=4096, description="numbers that are remembered")] = 64
    input_scale: Annotated[
        float, Field(gt=0, allow_inf_nan=False, description="factor on the observation"), Tuned(0.3, 30)
    ] = 1.0


class GRU(nn.Module):
    """One agent's unit: (B, in) and a state (B, width) to outputs (B, out) and the next state.

    `from_input` and `from_state` compute r, z and c together, in this order.
    """

    def __init__(self, inputs: int, outputs: int, options: GRUOptions, generator: torch.Generator) -> None:
        super().__init__()
        self.options, self.remembers = options, options.width
        self.from_input = nn.Linear(inputs, 3 * options.width)
        self.from_state = nn.Linear(options.width, 3 * options.width)
        self.last = nn.Linear(options.width, outputs)
        bound = 1.0 / math.sqrt(options.width)
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.copy_((torch.rand(parameter.shape, generator=generator) * 2.0 - 1.0) * bound)

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Return outputs and the next state; without a state those outputs alone that an episode begins with."""
        before = x.new_zeros((*x.shape[:-1], self.remembers)) if state is None else state
        xr, xz, xc = torch.chunk(self.from_input(x * self.options.input_scale), 3, -1)
        hr, hz, hc = torch.chunk(self.from_state(before), 3, -1)
        r, z = 0.5 * (1.0 + torch.tanh(0.5 * (xr + hr))), 0.5 * (1.0 + torch.tanh(0.5 * (xz + hz)))
        candidate = torch.tanh(xc + r * hc)
        after = candidate + z * (before - candidate)
        outputs = self.last(after)
        return outputs if state is None else (outputs, after)


def build(obs_dim: int, out_dim: int, options: GRUOptions, generator: torch.Generator) -> GRU:
    """Build one agent's unit with its initial parameters drawn from `generator`."""
    return GRU(obs_dim, out_dim, options, generator)


def memory(options: GRUOptions, agents: int, batch: int, copies: int) -> int:
    """Return the bytes of the square weights: 3 w^2 numbers of float32 per agent and copy, w the width."""
    return 4 * agents * 3 * options.width**2 * copies
