"""Quantum long short-term memory (Chen, Yoo & Fang 2020, arXiv:2009.01783): an `lstm` whose gates are circuits.

With observation x, a state of h and m that is 0 where an episode begins, s(a) = (1 + tanh(a / 2)) / 2, and E_k the
expectation values <Z_q> of four circuits of one ansatz, each with parameters of its own:

    v  = W [x; h] + b                     the input of all four circuits
    i  = s(E_i(v))                        how much is added to m
    f  = s(E_f(v))                        how much of m is kept
    g  = tanh(E_g(v))
    o  = s(E_o(v))                        how much of m is shown
    m' = f m + i g
    h' = o tanh(m')
    y  = V h' + u

On n qubits h and m are n numbers each. With `linear = false` there is no W, as in the paper: v = [x; h], h and m have
as many numbers as the circuit has inputs beyond x, gates are the first expectation values, and y_j = u_j h'_j.

An expectation value lies in -1 .. 1, so f lies in .27 .. .73, as in the paper: the content of m decays by a quarter per
step at least, and 20 steps leave .002 of it.

Deviations from the paper, in which an ansatz is a matter of choice, too:
- Two more circuits stand for h' and y there. Here the last layer is linear, as in Chen's agents (2022, "Quantum deep
  recurrent reinforcement learning", arXiv:2210.14876), which were trained by DRQN.
- Inputs enter as angles of the ansatz, by default `cz` with data re-uploaded in every layer; there arctan(v) and
  arctan(v^2) are angles of RY and RZ once, and CNOTs connect neighbors and next neighbors.

All circuits of all seeds are computed in one call of the backend. An agent executes four per observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.errors import OptionError
from qrlsuite.options import Since
from qrlsuite.plugins.models import vqc
from qrlsuite.plugins.models.recurrent import lstm_step
from qrlsuite.plugins.models.vqc import VQCOptions
from qrlsuite.population import ACTIVATIONS

GATES = 4


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class QLSTMOptions(VQCOptions):
    """Options of every quantum LSTM, as of `vqc`, with other defaults."""

    qubits: Annotated[int, Field(ge=1, le=20, description="qubits of each circuit, and numbers of h")] = 4
    layers: Annotated[int, Field(ge=1, le=256, description="layers of each circuit")] = 2
    ansatz: Annotated[str, Field(description="circuit family, see qrlsuite list ansatzes")] = "cz"
    linear: Annotated[
        bool,
        Field(description="linear layers before and behind the circuits; false: none"),
        Since("0.2.0"),
    ] = True


class Remembering(vqc._Hybrid):
    """The common part of networks with circuits that remember, of one agent or of S.

    Parameters
    ----------
    runner, state:
        The circuit, and parameters by name, with a leading axis S in a population.
    remembers:
        How many numbers an agent remembers.
    alone:
        Whether this is one agent's: (B, in) and a state (B, remembers) to outputs (B, out) and the next state; if not,
        all have a leading axis S.
    """

    def __init__(
        self, runner: vqc._Runner, state: dict[str, Tensor], remembers: int, alone: bool = True
    ) -> None:
        super().__init__(runner, state)
        self.remembers, self._alone = remembers, alone

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Return outputs and the next state; without a state, an episode's first outputs alone."""
        seen = x[None] if self._alone else x
        own = {name: p[None] if self._alone else p for name, p in self.named_parameters()}
        before = seen.new_zeros((*seen.shape[:2], self.remembers))
        if state is not None:
            before = state[None] if self._alone else state
        results = [each[0] if self._alone else each for each in self.step(seen, before, own)]
        return results[0] if state is None else tuple(results)

    def step(self, x: Tensor, before: Tensor, own: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return outputs (S, B, out) and the next state for (S, B, in) and a state, with parameters (S, ...)."""
        raise NotImplementedError

    def circuit_states(self, x: Tensor) -> Tensor:
        """Refuse: the states depend on the memory, too."""
        raise OptionError("the states of circuits that remember are not known by observations alone")

    def measured(
        self, inputs: Tensor, parameters: dict[str, Tensor], seeds: list[int] | None, circuits: int
    ) -> Tensor:
        """Return expectation values; every agent executes a number of circuits, and their gradients."""
        values = self._runner.backend(inputs, parameters, seeds)
        executions = self._runner.executions
        executions.count_forward(circuits)
        if values.requires_grad:
            values.register_hook(lambda grad: executions.count_backward(circuits))  # type: ignore[no-untyped-call]
        return ACTIVATIONS[self._runner.options.activation_out](values)


class QLSTM(Remembering):
    """Quantum LSTM; parameters of circuits have an axis of the four gates, behind S in a population."""

    def step(self, x: Tensor, before: Tensor, own: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return outputs and the next state, see `Remembering`."""
        (seeds, batch), width = x.shape[:2], self.remembers // 2
        shared = self._circuit_inputs(torch.cat([x, before[..., :width]], 2), own)
        given = shared[:, None].expand(-1, GATES, -1, -1).reshape(seeds * GATES, batch, -1)
        parameters = {name: own[f"circuit.{name}"].flatten(0, 1) for name in self._runner.circuit.parameters}
        drawn = self._shot_seeds()
        each = (
            None if drawn is None else [vqc._derived(seed, gate) for seed in drawn for gate in range(GATES)]
        )
        values = self.measured(given, parameters, each, GATES * batch).view(seeds, GATES, batch, -1)
        after = lstm_step(values[..., :width].transpose(1, 2).flatten(2), before.to(values.dtype))
        return self._shown(after[..., :width], own).to(x.dtype), after.to(x.dtype)


def build(
    obs_dim: int, out_dim: int, options: QLSTMOptions, generator: torch.Generator, role: str = "network"
) -> nn.Module:
    """Build one agent's quantum LSTM with every random number drawn from `generator`, see `vqc.build`."""
    if role == "critic" and options.critic == "mlp":
        return vqc.build(obs_dim, out_dim, options, generator, role)
    runner = vqc._Runner(options)
    circuit, values = runner.circuit, len(runner.circuit.observables)
    width = values if options.linear else circuit.inputs - obs_dim
    if not options.linear and not out_dim <= width <= values:
        raise OptionError(
            f"linear = false: the circuit has {circuit.inputs} inputs and {values} expectation values, the task "
            f"{obs_dim} observations and {out_dim} outputs: choose {obs_dim + out_dim} qubits or more, so that the "
            "inputs beyond the observations are as many as the outputs or more"
        )
    state = vqc.initial(runner, obs_dim + width, width, out_dim, (GATES,), generator)
    return QLSTM(runner, state, 2 * width)


def population(modules: Sequence[Any], options: VQCOptions) -> nn.Module:
    """Stack built networks that remember, or perceptrons of critics."""
    first = modules[0]
    if not isinstance(first, Remembering):
        return vqc.population(modules, options)
    runner = vqc._Runner(options)
    _ = runner.backend  # prepared now, so that what it cannot do is known before training
    states = [{**dict(m.named_parameters()), **dict(m.named_buffers())} for m in modules]
    stacked = {name: torch.stack([s[name].detach() for s in states]) for name in states[0]}
    return type(first)(runner, stacked, first.remembers, alone=False)
