"""A policy gradient that keeps the rules of algorithms, which the tests beside this folder break one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv
from qrlsuite.population import Adam, part, prefixed
from qrlsuite.seeding import Streams

BLOCK = 128  # steps per forward pass of each agent: bounds the memory of circuits


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.99
    lr: Annotated[float, Field(gt=0, description="learning rate")] = 1e-2
    quantum_lr: Annotated[float, Field(gt=0, description="that of circuits")] = 1e-3


class PolicyGradient:
    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: Options,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams = envs, options, streams
        self.device, self.epoch = device, 0
        self.S, self.E = len(streams), envs.num_envs // len(streams)
        self.actions = int(envs.single_action_space.n)  # type: ignore[attr-defined]
        self.policy = build_model(self.actions).to(device)
        self.adam = Adam(self.policy, options.lr, options.quantum_lr)
        self.observations = torch.zeros(0)

    def start(self) -> None:
        self.observations = self.tensor(self.envs.reset()[0])

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        shape = (self.S, rounds, self.E)
        draws = [streams.numpy("exploration", self.epoch) for streams in self.streams]
        size = (rounds, self.E, self.actions)
        noise = np.stack([draw.gumbel(size=size) for draw in draws])
        gumbel = torch.from_numpy(noise.astype(np.float32)).to(self.device)
        states, actions = [], []
        rewards, ended = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
        for t in range(rounds):
            with torch.no_grad():
                logits = self.policy(self.observations)
            # the argmax of logits and Gumbel noise is a draw from their softmax
            chosen = (logits + gumbel[:, t]).argmax(2)  # (S, E)
            states.append(self.observations)
            actions.append(chosen)
            lanes = chosen.cpu().numpy().ravel()
            after, reward, terminated, truncated, _ = self.envs.step(lanes)
            rewards[:, t] = reward.reshape(self.S, self.E)
            ended[:, t] = (terminated | truncated).reshape(self.S, self.E)
            self.observations = self.tensor(after)
        returns = np.zeros(shape)
        later = np.zeros((self.S, self.E))
        for t in reversed(range(rounds)):
            later = np.where(ended[:, t], 0.0, later)
            later = rewards[:, t] + self.options.gamma * later
            returns[:, t] = later
        self.epoch += 1
        loss = self.learn(torch.cat(states, 1), torch.cat(actions, 1), returns)
        return {"loss": loss}

    def learn(self, states: Tensor, actions: Tensor, returns: NDArray[np.float64]) -> NDArray[np.float64]:
        flat = returns.reshape(self.S, -1)
        centered = (flat - flat.mean(1, keepdims=True)) / flat.shape[1]
        advantages = torch.from_numpy(centered.astype(np.float32)).to(self.device)
        total = torch.zeros(self.S, dtype=torch.float64)
        self.adam.zero_grad()
        for a in range(0, flat.shape[1], BLOCK):
            block = slice(a, a + BLOCK)
            logits = self.policy(states[:, block].contiguous())
            log_policy = torch.log_softmax(logits, -1)
            taken = log_policy.gather(2, actions[:, block, None]).squeeze(2)
            loss = -(advantages[:, block].contiguous() * taken).sum(1)  # (S,)
            torch.autograd.backward(loss.sum())
            total += loss.detach().cpu().to(torch.float64)
        self.adam.step()
        losses: NDArray[np.float64] = total.numpy()
        return losses

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        with torch.no_grad():
            logits = self.policy(torch.from_numpy(observations).to(self.device))
        chosen: NDArray[np.int64] = logits.argmax(2).cpu().numpy()
        return chosen

    def tensor(self, lanes: NDArray[np.float32]) -> Tensor:
        values = torch.from_numpy(np.array(lanes, dtype=np.float32))
        return values.view(self.S, self.E, -1).to(self.device)

    def policy_state(self) -> dict[str, Tensor]:
        return dict(self.policy.state_dict())

    def state_dict(self) -> dict[str, Tensor]:
        return {
            **prefixed(policy=self.policy.state_dict(), adam=self.adam.state_dict()),
            "observations": self.observations,
            "epoch": torch.full((self.S,), self.epoch),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.policy.load_state_dict(part(state, "policy"))
        self.adam.load_state_dict(part(state, "adam"))
        self.observations = state["observations"].clone().to(self.device)
        self.epoch = int(state["epoch"][0])
