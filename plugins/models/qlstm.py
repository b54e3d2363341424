"""Quantum long short-term memory (Chen, Yoo & Fang 2020, arXiv:2009.01783): an `lstm` whose gates are circuits.

With observation x, a state of h and m that is 0 where an episode begins, s(a) = (1 + tanh(a / 2)) / 2, and E_k the
expectation values <Z_q> of four circuits of one ansatz, each with parameters of its own:

    v  = W [x; h] + b                     what all four circuits are given
    i  = s(E_i(v))                        how much is added to m
    f  = s(E_f(v))                        how much of m is kept
    g  = tanh(E_g(v))
    o  = s(E_o(v))                        how much of m is shown
    m' = f m + i g
    h' = o tanh(m')
    y  = V h' + u

On n qubits h and m are n numbers each. With `linear = false` there is no W, as in the paper: v = [x; h], h and m have
as many numbers as the circuit has inputs beyond x, gates are the first expectation values, and y_j = u_j h'_j.

An expectation value lies in -1 .. 1, so f lies in .27 .. .73, as in the paper: what m holds decays by a quarter per
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
from torch import Tensor

from qrlsuite.errors import OptionError
from qrlsuite.plugins.models import vqc
from qrlsuite.plugins.models.mlp import ACTIVATIONS, initial_layer
from qrlsuite.plugins.models.recurrent import lstm_step
from qrlsuite.plugins.models.vqc import VQCOptions
from qrlsuite.population import linear

GATES = 4


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class QLSTMOptions(VQCOptions):
    """Options of every quantum LSTM: those of `vqc`, with other defaults."""

    qubits: Annotated[int, Field(ge=1, le=20, description="qubits of each circuit, and numbers of h")] = 4
    layers: Annotated[int, Field(ge=1, le=256, description="layers of each circuit")] = 2
    ansatz: Annotated[str, Field(description="circuit family: iqp, cx, cz, skolik, or a plugin's")] = "cz"


class _Cells(vqc._Hybrid):
    """What one agent's module and a population have in common; circuits' parameters have an axis of the four gates."""

    width: int
    """Numbers of h, and of m."""

    @property
    def remembers(self) -> int:
        """How many numbers an agent remembers."""
        return 2 * self.width

    def circuit_states(self, x: Tensor) -> Tensor:
        """Refuse: they depend on what is remembered, too."""
        raise OptionError(
            "--entanglement: the states of circuits that remember are not known by observations alone"
        )

    def _step(self, x: Tensor, state: Tensor | None, own: dict[str, Tensor]) -> Any:
        """Map (S, B, in) and (S, B, remembers) to outputs and the next state, with parameters (S, ...)."""
        runner, options = self._runner, self._runner.options
        seeds, batch = x.shape[:2]
        before = x.new_zeros((seeds, batch, self.remembers)) if state is None else state
        shared = self._circuit_inputs(torch.cat([x, before[..., : self.width]], 2), own)
        given = shared[:, None].expand(-1, GATES, -1, -1).reshape(seeds * GATES, batch, -1)
        parameters = {name: own[f"circuit.{name}"].flatten(0, 1) for name in runner.circuit.parameters}
        drawn = self._shot_seeds()
        each = (
            None if drawn is None else [vqc._derived(seed, gate) for seed in drawn for gate in range(GATES)]
        )
        values = runner.backend(given, parameters, each)
        runner.executions.forward += GATES * batch
        if values.requires_grad:
            values.register_hook(lambda grad: runner.executions.count_backward(GATES * batch))  # type: ignore[no-untyped-call]
        values = ACTIVATIONS[options.activation_out](values).view(seeds, GATES, batch, -1)
        after = lstm_step(values[..., : self.width].transpose(1, 2).flatten(2), before.to(values.dtype))
        shown = after[..., : self.width]
        if options.linear:
            outputs = linear(shown, own["output.weight"], own["output.bias"])
        else:
            factors = own["output.weight"][:, None]
            outputs = shown[..., : factors.shape[2]] * factors
        outputs = outputs.to(x.dtype)
        return outputs if state is None else (outputs, after.to(x.dtype))


class QLSTM(_Cells):
    """One agent's quantum LSTM: (B, in) and a state (B, remembers) to outputs (B, out) and the next state."""

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Return outputs and the next state; without a state those outputs alone that an episode begins with."""
        own = {name: p[None] for name, p in self.named_parameters()}
        results = self._step(x[None], None if state is None else state[None], own)
        return results[0] if state is None else tuple(each[0] for each in results)


class QLSTMPopulation(_Cells):
    """S quantum LSTMs: (S, B, in) and a state (S, B, remembers); parameters as in `QLSTM` with a leading axis S.

    Raises
    ------
    OptionError
        If the backend cannot run the circuit.
    """

    def __init__(self, modules: Sequence[QLSTM], options: QLSTMOptions) -> None:
        runner = vqc._Runner(options)
        _ = runner.backend  # prepared now, so that what it cannot do is known before training
        states = [{**dict(m.named_parameters()), **dict(m.named_buffers())} for m in modules]
        stacked = {name: torch.stack([s[name].detach() for s in states]) for name in states[0]}
        super().__init__(runner, stacked)
        self.width = modules[0].width

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Return outputs (S, B, out), and with a state the next one."""
        return self._step(x, state, dict(self.named_parameters()))


def build(obs_dim: int, out_dim: int, options: QLSTMOptions, generator: torch.Generator) -> QLSTM:
    """Build one agent's quantum LSTM with every random number drawn from `generator`.

    Raises
    ------
    OptionError
        If the ansatz cannot be built with these options, or does not fit the task without linear layers.
    """
    runner = vqc._Runner(options)
    circuit, values = runner.circuit, len(runner.circuit.observables)
    width = values if options.linear else circuit.inputs - obs_dim
    if not options.linear and not out_dim <= width <= values:
        raise OptionError(
            f"linear = false: the circuit has {circuit.inputs} inputs and {values} expectation values, the task "
            f"{obs_dim} observations and {out_dim} outputs: choose {obs_dim + out_dim} qubits or more, so that the "
            "inputs beyond the observations are as many as the outputs or more"
        )
    state: dict[str, Tensor] = {}
    if options.linear:
        state["input.weight"], state["input.bias"] = initial_layer(
            obs_dim + width, circuit.inputs, "torch", generator
        )
    for name, parameter in circuit.parameters.items():
        uniform = torch.rand((GATES, *parameter.shape), generator=generator)
        state[f"circuit.{name}"] = parameter.low + (parameter.high - parameter.low) * uniform
        if name in vqc._scales(circuit):
            state[f"circuit.{name}"] *= options.init_scale
    if options.linear:
        state["output.weight"], state["output.bias"] = initial_layer(width, out_dim, "torch", generator)
    else:
        state["output.weight"] = torch.ones(out_dim)
    state = {name: value.to(getattr(torch, options.dtype)) for name, value in state.items()}
    state["shot_key"] = torch.randint(2**63 - 1, (), generator=generator)
    state["shot_count"] = torch.zeros((), dtype=torch.int64)
    made = QLSTM(runner, state)
    made.width = width
    return made


def population(modules: Sequence[QLSTM], options: QLSTMOptions) -> QLSTMPopulation:
    """Stack built models."""
    return QLSTMPopulation(modules, options)


def memory(options: QLSTMOptions, agents: int, batch: int, copies: int) -> int:
    """Return the bytes of the states that a simulator keeps, 0 where nothing is known of it."""
    return vqc.memory(options, GATES * agents, batch, copies)
