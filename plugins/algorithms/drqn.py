"""Deep recurrent Q-learning (Hausknecht & Stone 2015, arXiv:1507.06527) for a population of S seeds.

Double Q-learning, as in `ddqn`, with networks that remember (`qrlsuite.population.remembers`). Online network Q and
target network Q' see the observations o_1 .. o_t of an episode one by one; h_t is Q's memory after o_t, h'_t the memory
of Q':

    y_t  = r_t + g (1 - d_t) Q'(s'_t | h'_t, argmax_a Q(s'_t | h_t, a))    s'_t: where step t arrived, before any reset
    loss = mean over the batch's sequences and their last `length` steps of (Q(o_t | h_(t-1), a_t) - y_t)^2

d_t = 1 where the episode terminated at s'_t; where a time limit truncated it, the further return is estimated
from s'_t like anywhere else. Losses are summed over the S agents, so that gradients do not mix. Per round, every
environment takes one epsilon-greedy step and `updates` Adam steps are made, each on `batch` sequences of `burn_in` +
`length` steps. They begin anywhere in an environment's last steps, uniformly, and may run across ends of episodes:
the memory becomes 0 where an episode begins.

A sequence begins with nothing remembered, as in the paper's "bootstrapped random updates"; its first `burn_in` steps
only fill the memory, without gradients (Kapturowski et al. 2019, "Recurrent Experience Replay in Distributed
Reinforcement Learning", section 3). The replay buffer holds no memories, so that none in it is out of date.

A model that does not remember is trained as by `ddqn`, on steps that are drawn in sequences.

Deviations from the paper:
- Double Q-learning, Adam, and `ddqn`'s discount, batch and buffer; the paper has Adadelta on Atari games.
- Burn-in is Kapturowski's; `burn_in = 0` is the paper's form.
- Gradients are not clipped; the paper clips them at 10.
- One gradient step per round of all environments; the paper has one for every fourth step of one environment.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite import masks
from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv, arrived
from qrlsuite.options import Tuned
from qrlsuite.population import Adam, by_seed, part, prefixed, remember, remembers, renew, unroll
from qrlsuite.seeding import Streams


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DRQNOptions:
    """Options of deep recurrent Q-learning."""

    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.99
    lr: Annotated[
        float,
        Field(gt=0, description="learning rate of classical parameters"),
        Tuned(1e-4, 1e-2, per_agent=True),
    ] = 1e-3
    quantum_lr: Annotated[
        float,
        Field(gt=0, description="learning rate of quantum parameters"),
        Tuned(1e-4, 1e-2, "quantum", per_agent=True),
    ] = 1e-3
    epsilon: Annotated[float, Field(ge=0, le=1, description="probability of a random action in training")] = (
        0.1
    )
    length: Annotated[int, Field(ge=1, description="steps of a sequence that are learned from")] = 10
    burn_in: Annotated[int, Field(ge=0, description="steps before them, which fill the memory")] = 5
    batch: Annotated[int, Field(ge=1, description="sequences per gradient step")] = 16
    updates: Annotated[int, Field(ge=1, description="gradient steps per round")] = 1
    buffer: Annotated[int, Field(ge=1, description="transitions held by the replay buffer, per seed")] = (
        10_000
    )
    target_steps: Annotated[int, Field(ge=1, description="gradient steps between copies to the target")] = 500


class DRQN:
    """S agents learning by deep recurrent Q-learning; see `qrlsuite.algorithm.Algorithm` for the contract."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: DRQNOptions,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams, self.device = envs, options, streams, device
        self.S = len(streams)
        self.E = envs.num_envs // self.S
        self.actions = int(envs.single_action_space.n)  # type: ignore[attr-defined]
        self.obs_dim = int(np.prod(envs.single_observation_space.shape or (1,)))
        self.online = build_model(self.actions).to(device)
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        self.adam = Adam(self.online, options.lr, options.quantum_lr)
        self.target_steps = torch.full((self.S,), options.target_steps, device=device)
        self.L = options.burn_in + options.length
        self.capacity = max(options.buffer // self.E, self.L)  # rounds
        self.stored = 0  # rounds ever stored
        self.epoch = 0
        self._hold(torch.zeros((self.S, self.E, self.obs_dim), device=device))
        self.begins = torch.ones((self.S, self.E), device=device)
        self.remembered = self._nothing(self.E)
        self.validation = self._nothing(0)  # what is remembered in validation: no part of training

    def _hold(self, observations: Tensor) -> None:
        """Store the observations, followed by masks if any, and create a replay buffer of their size."""
        self.observations, self.seen_dim = observations, observations.shape[2]
        # a row is one step: observation, where it arrived, action, reward, 1 - terminated, 1 where an episode begins
        self.columns = 2 * self.seen_dim + 4
        self.buffer = torch.zeros((self.S, self.E, self.capacity, self.columns), device=self.device)

    def _best(self, values: Tensor, seen: Tensor) -> Tensor:
        """Return the best actions (S, B) of values (S, B, actions), none that is forbidden."""
        return masks.masked(values, seen, self.obs_dim).argmax(2)

    def _nothing(self, batch: int) -> Tensor:
        """Return the memory at the begin of episodes, zeros (S, batch, M)."""
        return torch.zeros((self.S, batch, remembers(self.online)), device=self.device)

    def start(self) -> None:
        """Reset the environments."""
        first, infos = self.envs.reset()
        self._hold(masks.behind(by_seed(first, self.S, self.device), infos))
        self.begins = torch.ones((self.S, self.E), device=self.device)

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Interact and learn for `rounds` rounds; returns the mean squared TD error `loss` (S,), NaN without a step."""
        o = self.options
        explore, random_action, draws = self._epoch_numbers(rounds)
        losses = torch.zeros(self.S, dtype=torch.float64, device=self.device)
        steps = 0
        for k in range(rounds):
            with torch.no_grad():
                plain = masks.observed(self.observations, self.obs_dim)
                values, self.remembered = remember(
                    self.online, plain, self.remembered * (1.0 - self.begins)[..., None]
                )
            uniform = masks.drawn(
                random_action[:, k], self.observations, self.obs_dim, self.streams, self.epoch, k
            )
            self._interact(torch.where(explore[:, k], uniform, self._best(values, self.observations)))
            for u in range(k * o.updates, (k + 1) * o.updates) if self.stored >= self.L else ():
                losses += self._learn(self._sequences(draws[:, u]))
                steps += 1
        self.epoch += 1
        loss = losses.cpu().numpy() / steps if steps else np.full(self.S, np.nan)
        return {"loss": loss, **self.adam.gradient_norms()}

    def _epoch_numbers(self, rounds: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw an epoch's exploration (S, rounds, E), twice, and sequences (S, steps, 2, batch) in [0, 1)."""
        steps = rounds * self.options.updates
        explore = np.empty((self.S, rounds, self.E), dtype=bool)
        action = np.empty((self.S, rounds, self.E), dtype=np.int64)
        draws = np.empty((self.S, steps, 2, self.options.batch))
        for s, streams in enumerate(self.streams):
            exploration = streams.numpy("exploration", self.epoch)
            explore[s] = exploration.random((rounds, self.E)) < self.options.epsilon
            action[s] = exploration.integers(self.actions, size=(rounds, self.E))
            draws[s] = streams.numpy("replay", self.epoch).random(draws.shape[1:])
        return tuple(torch.from_numpy(a).to(self.device) for a in (explore, action, draws))  # type: ignore[return-value]

    def _interact(self, actions: Tensor) -> None:
        """Step every environment once with actions (S, E), and store the steps."""
        after, rewards, terminated, truncated, infos = self.envs.step(actions.reshape(-1).cpu().numpy())
        self.buffer[:, :, self.stored % self.capacity] = torch.cat(
            [
                self.observations,
                masks.behind(by_seed(arrived(after, infos), self.S, self.device), infos, arrived=True),
                actions[..., None].to(torch.float32),
                by_seed(rewards, self.S, self.device),
                1.0 - by_seed(terminated, self.S, self.device),
                self.begins[..., None],
            ],
            dim=2,
        )
        self.stored += 1
        self.observations = masks.behind(by_seed(after, self.S, self.device), infos)
        self.begins = by_seed(terminated | truncated, self.S, self.device)[..., 0]

    def _sequences(self, draws: Tensor) -> Tensor:
        """Return sequences (S, batch, L, columns) of consecutive steps, by draws (S, 2, batch) in [0, 1)."""
        filled = min(self.stored, self.capacity)
        oldest = self.stored % self.capacity if self.stored > self.capacity else 0
        lane = (draws[:, 0] * self.E).to(torch.int64)
        first = oldest + (draws[:, 1] * (filled - self.L + 1)).to(torch.int64)
        steps = (first[..., None] + torch.arange(self.L, device=self.device)) % self.capacity
        seeds = torch.arange(self.S, device=self.device)[:, None, None]
        return self.buffer[seeds, lane[..., None], steps]

    def _learn(self, rows: Tensor) -> Tensor:
        """Make one Adam step of every agent on its sequences (S, B, L, columns); returns the losses (S,)."""
        o, d = self.options, self.seen_dim
        seen, following = rows[..., : self.obs_dim], rows[..., d : 2 * d]
        action, reward, alive, begins = (rows[..., 2 * d + i] for i in range(4))
        new = slice(o.burn_in, None)
        nothing = self._nothing(rows.shape[1])
        start = nothing
        with torch.no_grad():
            if o.burn_in:
                _, before = unroll(self.online, seen[:, :, : o.burn_in], begins[:, :, : o.burn_in], nothing)
                start = before[:, :, -1]
            _, behind = unroll(self.target, seen, begins, nothing)
        values, states = unroll(self.online, seen[:, :, new], begins[:, :, new], start)
        flat = (self.S, rows.shape[1] * o.length, -1)
        with torch.no_grad():
            masked = following[:, :, new].reshape(flat)
            beyond = masks.observed(masked, self.obs_dim)
            best = remember(self.online, beyond, states.detach().reshape(*flat[:2], nothing.shape[2]))[0]
            least = remember(self.target, beyond, behind[:, :, new].reshape(*flat[:2], nothing.shape[2]))[0]
            worth = least.gather(2, self._best(best, masked)[..., None]).view(self.S, rows.shape[1], o.length)
            y = reward[:, :, new] + o.gamma * alive[:, :, new] * worth
        taken = values.gather(3, action[:, :, new].long()[..., None]).squeeze(3)
        losses = (taken - y).square().reshape(self.S, -1).mean(1)
        self.adam.zero_grad()
        torch.autograd.backward(losses.sum())
        self.adam.step()
        renew(self.target, self.online, self.adam.steps, self.target_steps)
        detached: Tensor = losses.detach().to(torch.float64)
        return detached

    @torch.no_grad()
    def act(
        self, observations: NDArray[np.float32], begins: NDArray[np.bool_], infos: Mapping[str, Any]
    ) -> NDArray[np.int64]:
        """Return the greedy actions (S, B) for observations (S, B, obs), and remember them where episodes go on.

        Parameters
        ----------
        begins:
            Where an episode begins with the observation (S, B).
        infos:
            The lanes' infos on it: forbidden actions are not chosen.
        """
        going_on = torch.from_numpy(~begins).to(self.device)[..., None]
        if self.validation.shape[1] != begins.shape[1]:  # other lanes than before: their episodes begin
            self.validation = self._nothing(begins.shape[1])
        seen = torch.from_numpy(observations).to(self.device)
        values, self.validation = remember(self.online, seen, self.validation * going_on)
        result: NDArray[np.int64] = self._best(values, masks.behind(seen, infos)).cpu().numpy()
        return result

    def policy_state(self) -> dict[str, Tensor]:
        """Return the online network's parameters and buffers."""
        return dict(self.online.state_dict())

    def state_dict(self) -> dict[str, Tensor]:
        """Return networks, optimizer, replay buffer, the memory of unfinished episodes, and counters."""
        return {
            **prefixed(
                online=self.online.state_dict(), target=self.target.state_dict(), adam=self.adam.state_dict()
            ),
            "buffer": self.buffer,
            "observations": self.observations,
            "begins": self.begins,
            "remembered": self.remembered,
            "counters": torch.tensor([[self.stored, self.epoch]] * self.S, dtype=torch.int64),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.online.load_state_dict(part(state, "online"))
        self.target.load_state_dict(part(state, "target"))
        self.adam.load_state_dict(part(state, "adam"))
        self._hold(state["observations"].clone().to(self.device))
        self.buffer.copy_(state["buffer"])
        self.begins, self.remembered = (
            state[name].clone().to(self.device) for name in ("begins", "remembered")
        )
        self.stored, self.epoch = (int(v) for v in state["counters"][0])
