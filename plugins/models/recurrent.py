"""Networks that remember: a recurrent unit and a linear layer. s(a) = (1 + tanh(a / 2)) / 2 is the logistic function.

`gru`, the gated recurrent unit (Cho et al. 2014, arXiv:1406.1078): with input x, and a state h of `width` numbers that
is 0 where an episode begins,

    r  = s(W_r x + U_r h + b_r)                  which of h is seen
    z  = s(W_z x + U_z h + b_z)                  how much of h is kept
    c  = tanh(W_c x + b_c + r (U_c h + d_c))     as torch.nn.GRU and cuDNN have it; the paper has U_c (r h)
    h' = (1 - z) c + z h
    y  = V h' + v

`lstm`, long short-term memory (Hochreiter & Schmidhuber 1997, with the forget gate of Gers et al. 2000): the state is h
and m, `width` numbers each,

    i  = s(W_i x + U_i h + b_i)                  how much is added to m
    f  = s(W_f x + U_f h + b_f)                  how much of m is kept
    g  = tanh(W_g x + U_g h + b_g)
    o  = s(W_o x + U_o h + b_o)                  how much of m is shown
    m' = f m + i g
    h' = o tanh(m')
    y  = V h' + v

The cells are written out, and s by the hyperbolic tangent: torch rounds its own sigmoid differently in the body and in
the tail of a vector, and a seed would depend on the seeds that are trained with it. Initial values are as in
`torch.nn.GRU`, `torch.nn.LSTM` and `torch.nn.Linear`: uniform(-1/sqrt(n), 1/sqrt(n)), n being the width. As there, a
sum of two biases stands for every b.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.options import Tuned
from qrlsuite.population import StackedPopulation, linear

Layer = Callable[[str, Tensor], Tensor]
"""Computes a linear layer by its name."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RecurrentOptions:
    """Options of recurrent units."""

    width: Annotated[int, Field(ge=1, le=4096, description="numbers that the unit shows the last layer")] = 64
    input_scale: Annotated[
        float, Field(gt=0, allow_inf_nan=False, description="factor on the observation"), Tuned(0.3, 30)
    ] = 1.0


def gate(x: Tensor) -> Tensor:
    """Return the logistic function of x, with the same bits wherever in a vector a number stands."""
    return 0.5 * (1.0 + torch.tanh(0.5 * x))


def lstm_step(parts: Tensor, before: Tensor) -> Tensor:
    """Return h' and m' (..., 2 width) from the arguments of i, f, g and o (..., 4 width), and from h and m."""
    i, f, g, o = torch.chunk(parts, 4, -1)
    kept = gate(f) * before[..., before.shape[-1] // 2 :] + gate(i) * torch.tanh(g)
    return torch.cat([gate(o) * torch.tanh(kept), kept], -1)


class _Unit(nn.Module):
    """One agent's unit: (B, in) and a state (B, remembers) to outputs (B, out) and the next state.

    `from_input` and `from_state` compute all parts together, in the order of the equations.
    """

    parts: ClassVar[int]
    states: ClassVar[int]

    def __init__(
        self, inputs: int, outputs: int, options: RecurrentOptions, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.options, self.remembers = options, self.states * options.width
        self.from_input = nn.Linear(inputs, self.parts * options.width)
        self.from_state = nn.Linear(options.width, self.parts * options.width)
        self.last = nn.Linear(options.width, outputs)
        bound = 1.0 / math.sqrt(options.width)
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.copy_((torch.rand(parameter.shape, generator=generator) * 2.0 - 1.0) * bound)

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Return outputs and the next state; without a state, an episode's first outputs alone."""
        return self.compute(lambda name, inner: self.get_submodule(name)(inner), x, state, self.options)

    @classmethod
    def compute(cls, layer: Layer, x: Tensor, state: Tensor | None, options: RecurrentOptions) -> Any:
        """Return the result of `forward`, of one agent or of S, by their layers."""
        width = options.width
        before = x.new_zeros((*x.shape[:-1], cls.states * width)) if state is None else state
        after = cls.step(
            layer("from_input", x * options.input_scale), layer("from_state", before[..., :width]), before
        )
        outputs = layer("last", after[..., :width])
        return outputs if state is None else (outputs, after)

    @classmethod
    def step(cls, seen: Tensor, shown: Tensor, before: Tensor) -> Tensor:
        """Return the next state, h first, from the layers' outputs for x and for h."""
        raise NotImplementedError


class GRU(_Unit):
    """One agent's gated recurrent unit."""

    parts, states = 3, 1

    @classmethod
    def step(cls, seen: Tensor, shown: Tensor, before: Tensor) -> Tensor:
        """Return h'."""
        (xr, xz, xc), (hr, hz, hc) = torch.chunk(seen, 3, -1), torch.chunk(shown, 3, -1)
        candidate = torch.tanh(xc + gate(xr + hr) * hc)
        return candidate + gate(xz + hz) * (before - candidate)


class LSTM(_Unit):
    """One agent's long short-term memory."""

    parts, states = 4, 2

    @classmethod
    def step(cls, seen: Tensor, shown: Tensor, before: Tensor) -> Tensor:
        """Return h' and m'."""
        return lstm_step(seen + shown, before)


class UnitPopulation(StackedPopulation):
    """S units, (S, B, in) and a state (S, B, remembers), in products of stacked matrices."""

    def __init__(self, modules: Sequence[_Unit], options: RecurrentOptions) -> None:
        super().__init__(modules)
        self.compute, self.options = modules[0].compute, options

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Return outputs (S, B, out), and with a state the next one."""

        def layer(name: str, inner: Tensor) -> Tensor:
            own: Any = self._modules[name]
            return linear(inner, own.weight, own.bias)

        return self.compute(layer, x, state, self.options)


def gru(obs_dim: int, out_dim: int, options: RecurrentOptions, generator: torch.Generator) -> GRU:
    """Build one agent's gated recurrent unit with its initial parameters drawn from `generator`."""
    return GRU(obs_dim, out_dim, options, generator)


def lstm(obs_dim: int, out_dim: int, options: RecurrentOptions, generator: torch.Generator) -> LSTM:
    """Build one agent's long short-term memory with its initial parameters drawn from `generator`."""
    return LSTM(obs_dim, out_dim, options, generator)


def population(modules: Sequence[_Unit], options: RecurrentOptions) -> UnitPopulation:
    """Stack built units."""
    return UnitPopulation(modules, options)
