"""Perceptron whose square weights are tensor networks: the classical relative of circuits with little entanglement.

    W[o1 ... ok, i1 ... ik] = A1[o1, i1] A2[o2, i2] ... Ak[ok, ik]

Each core A holds, for every pair of its indices, a matrix from one bond to the next: W is a matrix product operator,
and a bond of dimension 1 makes it a Kronecker product. An index runs from 1 to d, and a hidden layer has d^k units.

After `TMLPwithMPO` of hyperlax (hyperlax-quantum, `tensorized_mlp.py`): one dense layer, then layers with such weights,
then a dense layer without activation. Initial values deviate: cores are normal here as there, but so narrow that the
entries of W have the variance of `torch.nn.Linear`; biases and dense layers begin as `torch.nn.Linear` does.

For i inputs and o outputs at width w = d^k these are w (i + o + 1) + o scalars, and (depth - 1) times w and the cores:
2 d^2 b for k = 2 with bond dimension b.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.errors import OptionError
from qrlsuite.plugins.models.mlp import initial_layer
from qrlsuite.population import layers


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TMLPOptions:
    """Options of the perceptron with tensor networks."""

    width: Annotated[
        int, Field(ge=4, le=4096, description="units of each hidden layer: a number to the power `cores`")
    ] = 64
    depth: Annotated[
        int, Field(ge=2, le=16, description="number of hidden layers; all but the first are tensor networks")
    ] = 2
    cores: Annotated[int, Field(ge=2, le=12, description="cores of each tensor network")] = 2
    bond: Annotated[int, Field(ge=1, le=64, description="dimension of the bonds between cores")] = 4
    activation: Annotated[
        Literal["relu", "tanh", "sin", "none"], Field(description="after each hidden layer")
    ] = "relu"

    @property
    def size(self) -> int:
        """Dimension d of each index of a core."""
        return round(math.pow(self.width, 1 / self.cores))

    def check(self) -> None:
        """Refuse a width that is no power."""
        near = max(self.size, 2) ** self.cores
        if near != self.width:
            raise OptionError(
                f"width = {self.width}: with cores = {self.cores} it is a number to the power {self.cores}, such as "
                f"{near}"
            )


class TMLP(nn.Module):
    """One agent's perceptron; (B, in) -> (B, out).

    Parameters `w0`, `b0` of the first layer; of layer l its cores `a{l}_{j}` (bond before, out, in, bond behind) and
    `b{l}`; `w{depth}` and `b{depth}` of the last.
    """

    def __init__(self, obs_dim: int, out_dim: int, options: TMLPOptions, generator: torch.Generator) -> None:
        super().__init__()
        self.options = options
        self._dense(0, *initial_layer(obs_dim, options.width, "torch", generator))
        bonds = [1, *[options.bond] * (options.cores - 1), 1]
        variance = 1 / (3 * options.width) / options.bond ** (options.cores - 1)
        deviation = math.sqrt(variance) ** (1 / options.cores)
        for layer in range(1, options.depth):
            for j in range(options.cores):
                shape = (bonds[j], options.size, options.size, bonds[j + 1])
                core = deviation * torch.randn(shape, generator=generator)
                self.register_parameter(f"a{layer}_{j}", nn.Parameter(core))
            _, bias = initial_layer(options.width, options.width, "torch", generator)
            self.register_parameter(f"b{layer}", nn.Parameter(bias))
        self._dense(options.depth, *initial_layer(options.width, out_dim, "torch", generator))

    def _dense(self, layer: int, weight: Tensor, bias: Tensor) -> None:
        self.register_parameter(f"w{layer}", nn.Parameter(weight))
        self.register_parameter(f"b{layer}", nn.Parameter(bias))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, in) to (B, out)."""
        return _forward(x[None], {name: p[None] for name, p in self.named_parameters()}, self.options)[0]


class TMLPPopulation(nn.Module):
    """S perceptrons; (S, B, in) -> (S, B, out); parameters as in `TMLP` with a leading axis S."""

    compiled = True

    def __init__(self, modules: Sequence[TMLP], options: TMLPOptions) -> None:
        super().__init__()
        self.options = options
        for name, _ in modules[0].named_parameters():
            stacked = torch.stack([m.get_parameter(name).detach() for m in modules])
            self.register_parameter(name, nn.Parameter(stacked))

    def forward(self, x: Tensor) -> Tensor:
        """Map (S, B, in) to (S, B, out)."""
        return _forward(x, dict(self.named_parameters()), self.options)


def contracted(cores: Sequence[Tensor]) -> Tensor:
    """Contract cores (S, bond, d, d, bond) to weights (S, d^k, d^k).

    A step is a linear layer, which is bitwise independent of a seed's place in the population.
    """
    seeds, _, out, inner, bond = cores[0].shape
    whole = cores[0].reshape(seeds, out * inner, bond)
    for core in cores[1:]:
        d, behind = core.shape[2], core.shape[4]
        weight = core.flatten(2).transpose(1, 2).contiguous()
        product = layers(whole, [weight], [weight.new_zeros(weight.shape[:2])])
        split = product.reshape(seeds, out, inner, d, d, behind).transpose(2, 3)
        out, inner = out * d, inner * d
        whole = split.reshape(seeds, out * inner, behind)
    return whole.reshape(seeds, out, inner)


def _forward(x: Tensor, state: dict[str, Tensor], options: TMLPOptions) -> Tensor:
    hidden = [
        contracted([state[f"a{layer}_{j}"] for j in range(options.cores)])
        for layer in range(1, options.depth)
    ]
    weights = [state["w0"], *hidden, state[f"w{options.depth}"]]
    return layers(x, weights, [state[f"b{i}"] for i in range(options.depth + 1)], options.activation)


def build(obs_dim: int, out_dim: int, options: TMLPOptions, generator: torch.Generator) -> TMLP:
    """Build one agent's perceptron with its initial parameters drawn from `generator`."""
    return TMLP(obs_dim, out_dim, options, generator)


def population(modules: Sequence[TMLP], options: TMLPOptions) -> TMLPPopulation:
    """Stack built perceptrons."""
    return TMLPPopulation(modules, options)
