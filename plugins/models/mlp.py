"""Multilayer perceptron, and its population of S agents as batched matrix products.

Source: the paper's classical models (section 'Experimental Setup'). The paper's text says "He
initialization"; its released code uses the default of `torch.nn.Linear`, which is ours too (`init = "he"` is
the text's).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal, cast

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.options import Since, Tuned
from qrlsuite.population import ACTIVATIONS, compilable, layers, sweep

if TYPE_CHECKING:
    from qrlsuite.compiled.perceptron import Sweep


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class MLPOptions:
    """Options of the multilayer perceptron."""

    width: Annotated[int, Field(ge=1, le=4096, description="units of each hidden layer")] = 64
    depth: Annotated[int, Field(ge=1, le=16, description="number of hidden layers")] = 2
    activation: Annotated[
        Literal["relu", "tanh", "sin", "none"], Field(description="after each hidden layer")
    ] = "relu"
    init: Annotated[
        Literal["torch", "he", "siren"],
        Field(
            description="torch: uniform(-1/sqrt(in), 1/sqrt(in)), as released; he: normal(0, sqrt(2/in)); siren, for "
            "activation sin: uniform(-sqrt(6/in), sqrt(6/in)), in the first layer uniform(-1/in, 1/in)"
        ),
    ] = "torch"
    input_scale: Annotated[
        float,
        Field(gt=0, allow_inf_nan=False, description="factor on the observation"),
        Since("0.2.0"),
        Tuned(0.3, 30, per_agent=True),
    ] = 1.0


class MLP(nn.Module):
    """One agent's perceptron: `depth` hidden layers of `width` units; (B, in) -> (B, out).

    Parameters `w0, b0, w1, b1, ...`: w (out, in), b (out,). For 3 inputs and outputs they are
    (depth - 1) w^2 + (depth + 6) w + 3 scalars at width w.
    """

    def __init__(self, sizes: Sequence[int], options: MLPOptions, generator: torch.Generator) -> None:
        super().__init__()
        self.layers = len(sizes) - 1
        self.options = options
        for i, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
            weight, bias = initial_layer(fan_in, fan_out, options.init, generator, first=i == 0)
            self.register_parameter(f"w{i}", nn.Parameter(weight))
            self.register_parameter(f"b{i}", nn.Parameter(bias))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, in) to (B, out), by torch's own operations."""
        activation = ACTIVATIONS[self.options.activation]
        x = x * self.options.input_scale
        for i in range(self.layers):
            x = nn.functional.linear(x, self.get_parameter(f"w{i}"), self.get_parameter(f"b{i}"))
            if i < self.layers - 1:
                x = activation(x)
        return x


class MLPPopulation(nn.Module):
    """S perceptrons; (S, B, in) -> (S, B, out); parameters as in `MLP` with a leading axis S.

    `input_scale` is the same for all, or (S, 1, 1) where it differs: a buffer that moves to the device with the
    parameters, and is no state, for the options hold it.
    """

    compiled = True
    input_scale: float | Tensor

    def __init__(self, modules: Sequence[MLP], options: MLPOptions) -> None:
        super().__init__()
        self.layers = modules[0].layers
        self.options = options
        scale = cast("float | Tensor", options.input_scale)
        if isinstance(scale, Tensor):
            self.register_buffer("input_scale", scale.to(torch.float32)[:, None, None], persistent=False)
        else:
            self.input_scale = scale
        for name, _ in modules[0].named_parameters():
            stacked = torch.stack([m.get_parameter(name).detach() for m in modules])
            self.register_parameter(name, nn.Parameter(stacked))

    def forward(self, x: Tensor) -> Tensor:
        """Map (S, B, in) to (S, B, out)."""
        whole = self.sweep()
        if whole is not None and compilable(x):
            return whole(x)
        parameters = self._listed()
        return layers(x * self.input_scale, parameters[::2], parameters[1::2], self.options.activation)

    def sweep(self) -> Sweep | None:
        """Return it as one compiled sweep, see `qrlsuite.population.sweep`."""

        def made(own: Sequence[Tensor]) -> Sweep:
            from qrlsuite.compiled.perceptron import LayersSweep

            return LayersSweep(own[::2], own[1::2], self.options.activation, self.input_scale)

        return None if self.options.activation == "tanh" else sweep(self, self._listed(), made)

    def _listed(self) -> list[Tensor]:
        return cast("list[Tensor]", [*self._parameters.values()])  # in the order of their names in `MLP`


def initial_layer(
    fan_in: int, fan_out: int, init: str, generator: torch.Generator, first: bool = False
) -> tuple[Tensor, Tensor]:
    """Draw a layer's weight (fan_out, fan_in) and bias (fan_out,).

    `torch` is `torch.nn.Linear`'s initialization, `he` He et al.'s (2015), `siren` Sitzmann et al.'s (2020, section
    3.2; their factor on the input is an option of its own here), which treats the `first` layer differently.
    """
    bound = 1.0 / math.sqrt(fan_in)
    if init == "he":
        weight = torch.randn((fan_out, fan_in), generator=generator) * math.sqrt(2.0 / fan_in)
        return weight, torch.zeros(fan_out)
    width = bound if init == "torch" else 1.0 / fan_in if first else math.sqrt(6.0 / fan_in)
    weight = (torch.rand((fan_out, fan_in), generator=generator) * 2.0 - 1.0) * width
    bias = (torch.rand(fan_out, generator=generator) * 2.0 - 1.0) * bound
    return weight, bias


def build(obs_dim: int, out_dim: int, options: MLPOptions, generator: torch.Generator) -> MLP:
    """Build one agent's perceptron with its initial parameters drawn from `generator`."""
    return MLP([obs_dim, *[options.width] * options.depth, out_dim], options, generator)


def population(modules: Sequence[MLP], options: MLPOptions) -> MLPPopulation:
    """Stack built perceptrons."""
    return MLPPopulation(modules, options)
