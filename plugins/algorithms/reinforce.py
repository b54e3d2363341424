"""REINFORCE (Williams 1992), the vanilla policy gradient, for a population of S seeds.

With policy pi (a softmax over the model's outputs), discount g, and the n steps of a seed's episodes that were
completed in an epoch:

    G_t  = r_t + g G_{t+1}, G = 0 after an episode's last step          the reward-to-go
    loss = - 1/n sum_t (G_t - b) log pi(a_t|s_t),  summed over the S agents
    b    = 0 (`baseline = "none"`), the mean of the n G_t ("mean"), or V(s_t) of a value network of the model's
           architecture ("value"), which learns by 1/n sum_t (V(s_t) - G_t)^2 in the same step

One Adam step per epoch, or per `epochs_per_update` epochs. The paper names the algorithm only ('vanilla policy
gradient', its section 6.4 on CartPole) and gives no settings; the defaults are ours.

How it meets a fixed number of steps per epoch:
- An episode that is unfinished when the epoch ends carries over, and its steps are learned from in the epoch in which
  it ends. Its actions stay, while log pi(a|s) is evaluated under the parameters of the update: with
  episodes longer than an epoch, the earliest steps are off-policy by as many updates. No importance weights.
- With `epochs_per_update` > 1 all environments begin anew after each update, and no episode carries over to the next:
  every step that is learned from was made by the policy that is updated. Episodes that are unfinished then are lost.
- A seed without a completed episode makes no step: its parameters, moments and step count stay.
- The last `memory` steps of an unfinished episode are stored. The earliest steps of a longer episode are not learned
  from; the reward-to-go of later steps is exact, as it does not look back.
- A time limit ends the reward-to-go like any other end, except with a value network, which then estimates the further
  return: r_t + g V(s') at a truncated step.

Steps lie in slots, (memory + rounds) per environment, and every slot goes through the networks in every epoch, with
weight 0 if it has no step to learn from. All sums thus run over shapes that do not depend on the lengths of episodes,
so that each agent is bitwise the agent of a separate training. A model's count of circuit executions includes the
empty slots, so `memory` should not be longer than episodes are. Compiled networks without circuits see each agent's
filled slots first, and only as many blocks as one of the agents fills: further blocks would add zeros.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite import masks
from qrlsuite.actions import information_of_choices
from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError
from qrlsuite.options import Since, Tuned
from qrlsuite.population import Adam, by_seed, part, prefixed, sweeps
from qrlsuite.seeding import Streams

if TYPE_CHECKING:
    from qrlsuite.compiled.perceptron import Sweep

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

BLOCK = 128
"""Slots per forward and backward pass of each agent; bounds the memory that simulated circuits take."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class REINFORCEOptions:
    """Options of REINFORCE."""

    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.99
    lr: Annotated[
        float,
        Field(gt=0, description="learning rate of classical parameters"),
        Tuned(2e-4, 1e-2, per_agent=True),
    ] = 1e-2
    quantum_lr: Annotated[
        float,
        Field(gt=0, description="learning rate of quantum parameters"),
        Tuned(2e-4, 1e-2, "quantum", per_agent=True),
    ] = 1e-3
    baseline: Annotated[
        Literal["none", "mean", "value"],
        Field(description="subtracted from rewards-to-go: nothing, their mean, or a value network"),
    ] = "none"
    memory: Annotated[
        int,
        Field(ge=1, description="steps kept of an unfinished episode, per environment, when an epoch ends"),
    ] = 500
    epochs_per_update: Annotated[
        int,
        Field(
            ge=1,
            description="epochs between updates; from 2 on, environments are reset after each update, so "
            "that an episode is whole and has one policy",
        ),
        Since("0.2.0"),
    ] = 1


def rewards_to_go(rewards: FloatArray, ended: BoolArray, gamma: float) -> tuple[FloatArray, BoolArray]:
    """Return the discounted reward-to-go of every step, and whether its episode has ended; (S, E, T) all.

    The reward-to-go of a step in an unfinished episode is the sum so far.
    """
    later, complete = np.zeros(rewards.shape[:2]), np.zeros(rewards.shape[:2], dtype=np.bool_)
    returns, known = np.empty_like(rewards), np.empty_like(ended)
    for t in reversed(range(rewards.shape[2])):
        later = rewards[:, :, t] + gamma * np.where(ended[:, :, t], 0.0, later)
        complete = complete | ended[:, :, t]
        returns[:, :, t], known[:, :, t] = later, complete
    return returns, known


class Reinforce:
    """S agents learning by REINFORCE; see `qrlsuite.algorithm.Algorithm` for the contract."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: REINFORCEOptions,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams, self.device = envs, options, streams, device
        self.S = len(streams)
        self.E = envs.num_envs // self.S
        self.n_actions = int(envs.single_action_space.n)  # type: ignore[attr-defined]
        self.obs_dim = int(np.prod(envs.single_observation_space.shape or (1,)))
        self.policy = build_model(self.n_actions).to(device)
        self.adam = Adam(self.policy, options.lr, options.quantum_lr)
        self.value = build_model(1).to(device) if options.baseline == "value" else None
        self.value_adam = None if self.value is None else Adam(self.value, options.lr, options.quantum_lr)
        self.epoch = 0
        self._hold(torch.zeros((self.S, self.E, self.obs_dim), device=device))
        self.lengths = torch.zeros((self.S, self.E), dtype=torch.int64)  # slots of `carried` in use
        # where an episode ended among them; none where episodes carry over
        self.carried_ends = torch.zeros(self.carried.shape[:3], dtype=torch.bool)

    def _hold(self, observations: Tensor) -> None:
        """Store the observations, followed by masks if any, and allocate memory for steps of their size."""
        self.observations, self.seen_dim = observations, observations.shape[2]
        # the steps of unfinished episodes, the last step in the last slot; a row is observation, action, reward
        shape = (self.S, self.E, self.options.memory, self.seen_dim + 2)
        self.carried = torch.zeros(shape, device=self.device)

    def start(self) -> None:
        """Reset the environments."""
        first, infos = self.envs.reset()
        seen = masks.behind(by_seed(first, self.S, self.device), infos)
        if self.epoch == 0:
            self._hold(seen)
        self.observations = seen

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Collect `rounds` steps of every environment and make one update.

        Returns, per seed (S,), the number of steps learned from `learned_steps` and the policy's loss `loss`, NaN
        where no episode ended or there was no update; with a value network also its mean squared error `value_loss`.
        """
        memory, each = self.options.memory, self.options.epochs_per_update
        place = self.epoch % each  # among the epochs of one update
        if memory < (each - 1) * rounds:
            raise OptionError(
                f"memory = {memory}: epochs_per_update = {each} keeps {(each - 1) * rounds} steps of each environment; "
                f"set memory={(each - 1) * rounds}"
            )
        if self.epoch and each > 1 and place == 0:
            self.start()
        rows, ended, cut, final = self._collect(rounds)
        rewards = rows[..., -1].to(torch.float64).cpu().numpy()
        if self.value is not None:
            beyond = self._beyond(final)  # (S, E, rounds)
            rewards[:, :, memory:] += self.options.gamma * np.where(cut[:, :, memory:], beyond, 0.0)
        returns, known = rewards_to_go(rewards, ended, self.options.gamma)
        lengths = self.lengths.numpy()
        if place < each - 1:
            rows[..., -1] = torch.from_numpy(rewards).to(rows)
            self.carried, self.carried_ends = rows[:, :, -memory:], torch.from_numpy(ended[:, :, -memory:])
            self.lengths += rounds
            self.epoch += 1
            names = ("loss",) if self.value is None else ("loss", "value_loss")
            nothing = {name: np.full(self.S, np.nan) for name in names}
            return {"learned_steps": np.zeros(self.S), **nothing, **self.adam.gradient_norms()}
        filled = np.arange(memory + rounds) >= memory - lengths[..., None]
        metrics = self._learn(rows[..., :-1], returns, known & filled)
        if each == 1:
            self._carry(rows, lengths + rounds, known)
        else:
            self.lengths, self.carried_ends = (
                torch.zeros_like(kept) for kept in (self.lengths, self.carried_ends)
            )
        self.epoch += 1
        return metrics

    def _collect(self, rounds: int) -> tuple[Tensor, BoolArray, BoolArray, Tensor]:
        """Step every environment `rounds` times with the stochastic policy.

        An action is the argmax of logits plus standard Gumbel noise, which draws from their softmax (Gumbel-max).

        Returns
        -------
        tuple
            With T = memory + rounds slots: rows (S, E, T, seen + 2), whether an episode ended at a step (S, E, T),
            whether it did by truncation (S, E, T), and where truncated steps arrived (S, E, rounds, obs).
        """
        memory, shape = self.options.memory, (self.S, self.E, self.options.memory + rounds)
        noise = np.empty((self.S, rounds, self.E, self.n_actions), dtype=np.float32)
        for s, streams in enumerate(self.streams):
            noise[s] = streams.numpy("exploration", self.epoch).gumbel(size=noise.shape[1:])
        gumbel = torch.from_numpy(noise).to(self.device)
        rows = torch.zeros((*shape, self.seen_dim + 2), device=self.device)
        rows[:, :, :memory] = self.carried
        ended, cut = np.zeros(shape, dtype=np.bool_), np.zeros(shape, dtype=np.bool_)
        ended[:, :, :memory] = self.carried_ends.numpy()
        final = torch.zeros((self.S, self.E, rounds, self.obs_dim), device=self.device)
        for k in range(rounds):
            with torch.no_grad():
                actions = (self._logits(self.observations) + gumbel[:, k]).argmax(2)  # (S, E)
            lanes = actions.reshape(-1).cpu().numpy()
            after, reward, terminated, truncated, infos = self.envs.step(lanes)
            slot = memory + k
            rows[:, :, slot, :-2] = self.observations
            rows[:, :, slot, -2] = actions.to(torch.float32)
            rows[:, :, slot, -1] = torch.from_numpy(np.asarray(reward, np.float32)).view(self.S, self.E)
            ended[:, :, slot] = np.reshape(terminated | truncated, (self.S, self.E))
            cut[:, :, slot] = np.reshape(truncated & ~terminated, (self.S, self.E))
            if self.value is not None and truncated.any():
                arrived = by_seed(infos["final_obs"], self.S, self.device)
                mask = torch.from_numpy(cut[:, :, slot, None]).to(self.device)
                final[:, :, k] = torch.where(mask, arrived, final[:, :, k])
            self.observations = masks.behind(by_seed(after, self.S, self.device), infos)
        return rows, ended, cut, final

    def _logits(self, seen: Tensor) -> Tensor:
        """Return the policy's logits (S, B, actions), lowest where actions are forbidden."""
        return masks.masked(self.policy(masks.observed(seen, self.obs_dim)), seen, self.obs_dim)

    @torch.no_grad()
    def _beyond(self, final: Tensor) -> FloatArray:
        """Return the value network's estimates (S, E, rounds) at states (S, E, rounds, obs)."""
        assert self.value is not None
        states = final.reshape(self.S, -1, self.obs_dim)
        values = [self.value(block.contiguous()) for block in torch.split(states, BLOCK, dim=1)]
        result: FloatArray = torch.cat(values, dim=1).view(final.shape[:3]).to(torch.float64).cpu().numpy()
        return result

    def _learn(self, rows: Tensor, returns: FloatArray, learned: BoolArray) -> dict[str, NDArray[np.float64]]:
        """Make one Adam step of every agent that has anything to learn from.

        Parameters
        ----------
        rows:
            Observation and action of every slot (S, E, T, seen + 1).
        returns:
            Reward-to-go (S, E, T).
        learned:
            Which slots hold a step of a completed episode (S, E, T).
        """
        flat = learned.reshape(self.S, -1)
        count = flat.sum(1)
        weight = flat / np.maximum(count, 1)[:, None]
        g = np.where(flat, returns.reshape(self.S, -1), 0.0)
        baseline = (g * weight).sum(1, keepdims=True) if self.options.baseline == "mean" else 0.0
        columns = np.stack([weight, g - baseline]).astype(np.float32)
        w, advantage = torch.from_numpy(columns).to(self.device)  # (S, N) each, N = E x T
        every = rows.reshape(self.S, -1, self.seen_dim + 1)
        if self._sweeps() is not None and not hasattr(self.policy, "executions"):
            most = BLOCK * max(
                1, -(-count.max() // BLOCK)
            )  # whole blocks: sums are alike for any number of agents
            filled = torch.from_numpy(np.argsort(~flat, axis=1, kind="stable")[:, :most])
            w, advantage = w.gather(1, filled), advantage.gather(1, filled)
            every = every.take_along_dim(filled[..., None], 1)
        self.adam.zero_grad()
        if self.value_adam is not None:
            self.value_adam.zero_grad()
        total = torch.zeros((2, self.S), dtype=torch.float64, device=self.device)
        for a in range(0, every.shape[1], BLOCK):
            block = slice(a, a + BLOCK)
            total += self._accumulate(
                every[:, block, :-1].contiguous(),
                every[:, block, -1].long(),
                w[:, block].contiguous(),
                advantage[:, block].contiguous(),
            )
        active = torch.from_numpy(count > 0)
        self.adam.step(active)
        metrics = {"learned_steps": count.astype(np.float64)}
        names = ["loss"]
        if self.value_adam is not None:
            self.value_adam.step(active)
            names.append("value_loss")
        for name, loss in zip(names, total.cpu().numpy()):
            metrics[name] = np.where(count > 0, loss, np.nan)
        return metrics | self.adam.gradient_norms()

    def _accumulate(self, states: Tensor, actions: Tensor, weights: Tensor, advantages: Tensor) -> Tensor:
        """Add a block's part of both losses to the gradients; returns the parts (2, S).

        Parameters
        ----------
        states:
            (S, B, seen).
        actions, weights, advantages:
            (S, B); weights are 1/n, or 0 in slots that are not learned from.
        """
        whole = self._sweeps()
        if whole is not None:
            return self._add_slopes(whole, states, actions, weights, advantages)
        log_policy = torch.log_softmax(self._logits(states), -1).gather(2, actions[..., None]).squeeze(2)
        value_loss = torch.zeros(self.S, device=self.device)
        if self.value is not None:
            error = self.value(masks.observed(states, self.obs_dim)).squeeze(2) - advantages
            value_loss = (weights * error.square()).sum(1)
            advantages = -error.detach()
        loss = -(weights * advantages * log_policy).sum(1)
        torch.autograd.backward((loss + value_loss).sum())
        return torch.stack([loss.detach(), value_loss.detach()]).to(torch.float64)

    def _sweeps(self) -> list[Sweep] | None:
        """Return the networks as compiled sweeps, which learn without autograd; None where one is none."""
        networks = [self.policy] if self.value is None else [self.policy, self.value]
        return sweeps(*networks) if self.device.type == "cpu" else None

    def _add_slopes(
        self, networks: Sequence[Sweep], states: Tensor, actions: Tensor, weights: Tensor, advantages: Tensor
    ) -> Tensor:
        """Do as `_accumulate` by the derivatives of its formulas."""
        from qrlsuite.compiled.policies import judge_choices

        x, value_loss = masks.observed(states, self.obs_dim).numpy(), torch.zeros(self.S)
        if self.value is not None:
            values, records = networks[1].values(x, True)
            error = torch.from_numpy(values).squeeze(2) - advantages
            networks[1].add_gradients(records, (2.0 * weights * error)[..., None].numpy())
            value_loss, advantages = (weights * error.square()).sum(1), -error
        outputs, records = networks[0].values(x, True)
        free = masks.masked(torch.from_numpy(outputs), states, self.obs_dim).numpy()
        log_policy, _, pull = judge_choices(free, [self.n_actions], actions[..., None].numpy())
        slopes = -(weights * advantages)
        networks[0].add_gradients(records, pull(slopes.numpy(), 0.0))
        return torch.stack([(slopes * torch.from_numpy(log_policy)).sum(1), value_loss]).to(torch.float64)

    def _carry(self, rows: Tensor, steps: NDArray[np.int64], known: BoolArray) -> None:
        """Keep the last steps of unfinished episodes: the steps after the last end among the last `steps` slots."""
        memory = self.options.memory
        open_steps = np.minimum((~known).sum(2), steps)
        self.lengths = torch.from_numpy(np.minimum(open_steps, memory))
        kept = torch.arange(memory) >= memory - self.lengths[..., None]
        rows = rows[:, :, -memory:]
        self.carried = torch.where(kept[..., None].to(self.device), rows, torch.zeros_like(rows))

    @torch.no_grad()
    def act(
        self, observations: NDArray[np.float32], infos: Mapping[str, Any] = masks.NOTHING
    ) -> NDArray[np.int64]:
        """Return the greedy actions (S, B) for observations (S, B, obs), none that `infos` forbid."""
        seen = masks.behind(torch.from_numpy(observations).to(self.device), infos)
        result: NDArray[np.int64] = self._logits(seen).argmax(2).cpu().numpy()
        return result

    def information(self, outputs: FloatArray) -> FloatArray:
        """Return the Fisher information of the policy by its logits, see `qrlsuite.algorithm.Algorithm`."""
        return information_of_choices(outputs, [self.n_actions])

    def policy_state(self) -> dict[str, Tensor]:
        """Return the policy network's parameters and buffers."""
        return dict(self.policy.state_dict())

    def state_dict(self) -> dict[str, Tensor]:
        """Return networks, optimizers, unfinished episodes, current observations and the epoch, seed-first."""
        networks: dict[str, Mapping[str, Tensor]] = {
            "policy": self.policy.state_dict(),
            "adam": self.adam.state_dict(),
        }
        if self.value is not None and self.value_adam is not None:
            networks |= {"value": self.value.state_dict(), "value_adam": self.value_adam.state_dict()}
        return {
            **prefixed(**networks),
            "carried": self.carried,
            "lengths": self.lengths,
            "observations": self.observations,
            "epoch": torch.full((self.S,), self.epoch, dtype=torch.int64),
            **({} if self.options.epochs_per_update == 1 else {"carried_ends": self.carried_ends}),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.policy.load_state_dict(part(state, "policy"))
        self.adam.load_state_dict(part(state, "adam"))
        if self.value is not None and self.value_adam is not None:
            self.value.load_state_dict(part(state, "value"))
            self.value_adam.load_state_dict(part(state, "value_adam"))
        self._hold(state["observations"].clone().to(self.device))
        self.carried.copy_(state["carried"])
        self.lengths.copy_(state["lengths"])
        if self.options.epochs_per_update > 1:
            self.carried_ends.copy_(state["carried_ends"])
        self.epoch = int(state["epoch"][0])
