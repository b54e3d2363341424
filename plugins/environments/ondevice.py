"""CartPole and quantum tasks on a device: the lanes' operations, in their order, by torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from qrlsuite.device import EpisodesOnDevice
from qrlsuite.plugins.environments import cartpole
from qrlsuite.plugins.environments.quantum.channel import EXPERIMENTS


def of_numpy(name: str, x: Tensor) -> Tensor:
    """Return numpy's function of that name, as the NumPy lanes compute it; off the CPU torch's, within the last bit."""
    return torch.from_numpy(getattr(np, name)(x.numpy())) if x.is_cpu else getattr(torch, name)(x)


def number(value: float, device: torch.device) -> Tensor:
    """Return a divisor as a tensor: by a Python number, a GPU divides by multiplying with its reciprocal."""
    return torch.tensor(value, dtype=torch.float64).to(device)


class CartPoleOnDevice(EpisodesOnDevice):
    """`CartPoleLanes` by torch operations; see `push` for the equations."""

    def __init__(self, lanes: Any, device: torch.device) -> None:
        super().__init__(lanes, device)
        bounds = torch.tensor(self.lanes.options.bounds, dtype=torch.float64)
        self._scale = (2 / (bounds + bounds)).float().to(device)  # as `Normalization` has it
        self._mass = number(cartpole.TOTAL_MASS, device)

    def _act(self, actions: Tensor, running: Tensor) -> tuple[Tensor, Tensor]:
        state = self.state["state"]
        _, x_dot, theta, theta_dot = state.T
        c, s = of_numpy("cos", theta), of_numpy("sin", theta)
        force = torch.where(actions == 1, cartpole.FORCE, -cartpole.FORCE).double()
        temp = (force + cartpole.POLE_MASS_LENGTH * (theta_dot * theta_dot) * s) / self._mass
        inertia = cartpole.LENGTH * (4.0 / 3.0 - cartpole.POLE_MASS * (c * c) / self._mass)
        theta_acc = (cartpole.GRAVITY * s - c * temp) / inertia
        x_acc = temp - cartpole.POLE_MASS_LENGTH * theta_acc * c / self._mass
        changes = (x_dot, x_acc, theta_dot, theta_acc)
        after = torch.stack([value + cartpole.TAU * each for value, each in zip(state.T, changes)], 1)
        state.copy_(torch.where(running[:, None], after, state))
        falls = (state[:, 0].abs() > cartpole.X_LIMIT) | (state[:, 2].abs() > cartpole.THETA_LIMIT)
        return torch.ones_like(temp), falls

    def _seen(self) -> Tensor:
        seen, kind = self.state["state"].float(), self.lanes.options.normalization
        return (
            of_numpy("arctan", seen) if kind == "arctan" else seen * self._scale if kind == "bounds" else seen
        )


class CliffordOnDevice(EpisodesOnDevice):
    """`CliffordLanes` by torch operations."""

    def __init__(self, lanes: Any, device: torch.device) -> None:
        super().__init__(lanes, device)
        self._matrices = torch.from_numpy(self.lanes.matrices).to(device)
        self._steps = number(self.lanes.options.steps, device)
        self._identity = torch.eye(self._matrices.shape[1], dtype=torch.int64, device=device)

    def _act(self, actions: Tensor, running: Tensor) -> tuple[Tensor, Tensor]:
        left = self.state["left"]
        # torch has no product of matrices of whole numbers on a GPU
        after = (self._matrices[actions][..., None] * left[:, None]).sum(2) % 2
        left.copy_(torch.where(running[:, None, None], after, left))
        solved = self._solved()
        return torch.where(solved, 1.0 - 0.9 * self.state["step"].double() / self._steps, 0.0), solved

    def _solved(self) -> Tensor:
        return (self.state["left"] == self._identity).flatten(1).all(1)

    def _seen(self) -> Tensor:
        return self.state["left"].flatten(1).float()


class ChannelOnDevice(EpisodesOnDevice):
    """`ChannelLanes` by torch operations."""

    def __init__(self, lanes: Any, device: torch.device) -> None:
        super().__init__(lanes, device)
        self._plus = torch.from_numpy(self.lanes.plus).to(device).T.contiguous()  # (experiments, channels)
        self._steps = number(self.lanes.options.steps, device)

    def _act(self, actions: Tensor, running: Tensor) -> tuple[Tensor, Tensor]:
        state, lane, many = self.state, self.state["lane"], len(EXPERIMENTS)
        believed, named = state["believed"], state["named"]
        names, before = actions >= many, believed.amax(1)
        tried, experiment = running & ~names, actions.clamp(max=many - 1)
        plus = self._plus[experiment]
        outcome = state["luck"][lane, state["step"] - 1] < plus[lane, state["kind"]]
        state["counts"][lane, experiment, outcome.long()] += tried
        likely = believed * torch.where(outcome[:, None], plus, 1.0 - plus)
        total = likely[:, 0]
        for k in range(1, likely.shape[1]):  # in this order, as numpy adds so few
            total = total + likely[:, k]
        believed.copy_(torch.where(tried[:, None], likely / total[:, None], believed))
        named.copy_(torch.where(running & names, actions - many, named))
        worth = torch.where(named < 0, 0.0, believed[lane, named])
        ends = names | (state["step"] >= self.lanes.options.steps)
        return torch.where(ends, worth, believed.amax(1)) - before, names

    def _seen(self) -> Tensor:
        counts, step = self.state["counts"], self.state["step"]
        made = counts.sum(2)
        means = (counts[:, :, 1] - counts[:, :, 0]).double() / made.clamp(min=1)
        pairs = torch.stack([means, made / self._steps], 2).flatten(1)
        return torch.cat([pairs, (step / self._steps)[:, None]], 1).float()
