"""Quantum fast weights (Chen 2024, "Learning to program variational quantum circuits with fast weights",
arXiv:2402.17760): a classical network writes into a circuit's angles, which remember.

With observation x, a state F that is 0 where an episode begins, and E the expectation values <Z_q> of a circuit with
parameters w beside its scales of inputs, L rows of P numbers (layers, and numbers of a layer):

    a  = A x + a0                         L numbers   the slow programmer
    p  = B x + b0                         P numbers
    F' = F + a p^T                        the observation is added, and nothing is overwritten
    y  = V E(W x + b; w + F') + u         w is trained

The state is L P numbers. With `linear = false` there are no W and V: inputs are x, and y_j = u_j E_j.

Deviations from the paper: the slow programmer has no layer before A and B; the circuit is any ansatz, by default `cz`,
where the paper has one rotation RY per qubit and layer, and its w starts at random and is trained.

Every sample has angles of its own, and so the backend is given S x B circuits of one input each.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.errors import OptionError
from qrlsuite.plugins.models import vqc
from qrlsuite.plugins.models.mlp import initial_layer
from qrlsuite.plugins.models.qlstm import QLSTMOptions, Remembering
from qrlsuite.population import linear


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class QFWPOptions(QLSTMOptions):
    """Options of quantum fast weights, as of `qlstm`."""

    def check(self) -> None:
        """Refuse a circuit without angles to write into, and circuits that `vqc` refuses."""
        super().check()
        _written(self._circuit)


def _written(circuit: Any) -> dict[str, tuple[int, int]]:
    """Return the rows and columns of the parameters that fast weights are added to, by name."""
    shapes = {
        name: (parameter.shape[0], math.prod(parameter.shape[1:]))
        for name, parameter in circuit.parameters.items()
        if name not in vqc._scales(circuit)
    }
    if not shapes or len({rows for rows, _ in shapes.values()}) > 1:
        raise OptionError(
            "fast weights need an ansatz with parameters that scale no inputs, of (layers, ...) each"
        )
    return shapes


class QFWP(Remembering):
    """Quantum fast weights; parameters `rows.*` and `columns.*` are the slow programmer's."""

    def __init__(self, runner: Any, state: dict[str, Tensor], remembers: int, alone: bool = True) -> None:
        super().__init__(runner, state, remembers, alone)
        for name in ("rows", "columns"):
            self.add_module(name, vqc._Affine(state[f"{name}.weight"], state[f"{name}.bias"]))

    def step(self, x: Tensor, before: Tensor, own: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return outputs and the next state, see `Remembering`."""
        seeds, batch = x.shape[:2]
        inner = self._circuit_inputs(x, own)
        seen = x.to(inner.dtype)
        rows, columns = (linear(seen, own[f"{n}.weight"], own[f"{n}.bias"]) for n in ("rows", "columns"))
        after = before.to(inner.dtype) + (rows[..., None] * columns[..., None, :]).flatten(2)
        shapes = _written(self._runner.circuit)
        fast = torch.split(
            after.view(seeds, batch, rows.shape[2], -1), [size for _, size in shapes.values()], 3
        )
        written = dict(zip(shapes, fast))
        parameters = {}
        for name, parameter in self._runner.circuit.parameters.items():
            value = own[f"circuit.{name}"][:, None]
            if name in written:
                value = value + written[name].reshape(seeds, batch, *parameter.shape)
            parameters[name] = value.expand(-1, batch, *parameter.shape).flatten(0, 1)
        drawn = self._shot_seeds()
        each = None if drawn is None else [vqc._derived(seed, b) for seed in drawn for b in range(batch)]
        values = self.measured(inner.reshape(seeds * batch, 1, -1), parameters, each, batch)
        return self._shown(values.view(seeds, batch, -1), own).to(x.dtype), after.to(x.dtype)


def build(
    obs_dim: int, out_dim: int, options: QFWPOptions, generator: torch.Generator, role: str = "network"
) -> nn.Module:
    """Build one agent's network with every random number drawn from `generator`, see `vqc.build`."""
    if role == "critic" and options.critic == "mlp":
        return vqc.build(obs_dim, out_dim, options, generator, role)
    runner = vqc._Runner(options)
    circuit = runner.circuit
    if not options.linear:
        vqc._require_fit(runner, obs_dim, out_dim, role)
    state = vqc.initial(runner, obs_dim, len(circuit.observables), out_dim, (), generator)
    shapes = _written(circuit)
    sizes = {"rows": next(iter(shapes.values()))[0], "columns": sum(size for _, size in shapes.values())}
    for name, size in sizes.items():
        drawn = initial_layer(obs_dim, size, "torch", generator)
        state[f"{name}.weight"], state[f"{name}.bias"] = (
            each.to(state["output.weight"].dtype) for each in drawn
        )
    return QFWP(runner, state, sizes["rows"] * sizes["columns"])
