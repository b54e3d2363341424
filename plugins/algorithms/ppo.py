"""Proximal policy optimization (Schulman et al. 2017, arXiv:1707.06347) for a population of S seeds.

With actor pi, critic V, discount g, GAE parameter l (Schulman et al. 2016,
arXiv:1506.02438, eq. 16) and T steps of E environments per epoch:

    delta_t = r_t + g (1 - terminated_t) V(s'_t) - V(s_t)     s'_t: where step t arrived, before any reset
    A_t     = delta_t + g l (1 - ended_t) A_{t+1},  A_T = 0   ended_t: terminated or truncated at step t
    R_t     = A_t + V(s_t)
    rho     = pi(a|s) / pi_old(a|s)
    loss    = - mean min(rho A, clip(rho, 1 - c, 1 + c) A)
              + 0.5 mean (V(s) - R)^2 - 0.01 mean entropy of pi(.|s),   summed over the S agents

A and R are computed once per epoch; A is normalized in every minibatch to mean 0 and standard deviation 1. Then
the T x E samples are passed through `repeats` times, every time in a fresh random order, in minibatches of `batch`;
a remainder is merged into the last one (2000 samples, batch 64: 30 of 64, one of 80). Actor and critic are separate
networks of the same architecture; every agent makes the same number of Adam steps.

The actor's outputs are pi by the kind of the environment's actions:

- discrete: the logits of a softmax;
- multi-discrete, multi-binary: the logits of a softmax for each number of an action, which are independent given the
  state: log pi(a|s) and entropy are sums over them;
- box: the means of independent normals u with spreads e^l, l being A numbers beside the network that no state changes
  and Adam trains with it (`log_spread` at first; not counted as the model's parameters). An action is u clipped to
  -1 .. 1, linear in the box (`qrlsuite.actions.from_units`); log pi is computed from u, as in Stable-Baselines3.

Rollouts run across the ends of episodes and are cut where the epoch ends. The critic estimates the further return
there, and where a time limit truncated an episode, but not where an episode terminated.

*Models that remember* (`qrlsuite.population.remembers`) see an episode's observations one by one; pi and V depend on
their memory, too: s_t stands for both. The samples of a minibatch are then sequences of `length` consecutive
steps of one environment, `batch` / `length` of them. A sequence begins with the memory at its collection, as in
sb3-contrib's RecurrentPPO, and as the "stored state" of Kapturowski et al. (2019), who replay; gradients reach back
to its first step. Where an episode begins, the memory becomes 0. Where `length` does not
divide T, some sequences overlap, so that all are equally long. RecurrentPPO cuts them at the ends of episodes and pads.

With `repeats=1` and a `batch` of all samples, the ratio is 1 and nothing is clipped: one step per epoch along the
gradient of - mean log pi(a|s) A, A2C's gradient (Mnih et al. 2016, arXiv:1602.01783, algorithm S3; Huang et al.
2022, arXiv:2205.09123), with generalized, normalized advantages.

Deviations from the paper (its algorithm 'Estimating the Sample Complexity of PPO' and its table of hyperparameters):
- The paper's epoch is one whole episode of each environment. Ours is as many steps, so that every agent learns from
  equally many samples whatever the lengths of its episodes; with 200 steps per episode and environment the two agree.
- The table's "gradient clipping" is the clipping of the ratio. Gradients and values are clipped, and learning rates
  fall, where `longest_gradient`, `value_clip` and `decay_steps` say so; the updates do not stop early.
- The clip range depends on the family, 0.1 for classical and 0.2 for quantum models: a task's preset says so.
- GAE parameter, value and entropy coefficients are the released code's; the text is silent.
- Validation is greedy; the released code samples (`validation = "sampled"`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import masks
from qrlsuite.actions import choices, from_units, information_of_choices, size
from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv, arrived
from qrlsuite.options import Since, Tuned
from qrlsuite.population import (
    Adam,
    DecaySteps,
    by_seed,
    clip_gradients,
    part,
    prefixed,
    remember,
    remembers,
    sweeps,
    unroll,
)
from qrlsuite.replay import Replay
from qrlsuite.seeding import Streams

if TYPE_CHECKING:
    from qrlsuite.compiled.perceptron import Sweep
    from qrlsuite.compiled.policies import Pull

FloatArray = NDArray[np.float64]
Array = NDArray[Any]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PPOOptions:
    """Options of proximal policy optimization; the defaults are the released settings of classical models."""

    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.95
    gae_lambda: Annotated[
        float, Field(ge=0, le=1, description="0: one-step advantages, 1: Monte-Carlo advantages")
    ] = 0.95
    lr: Annotated[
        float,
        Field(gt=0, description="learning rate of classical parameters"),
        Tuned(2e-4, 1e-2, per_agent=True),
    ] = 1e-3
    quantum_lr: Annotated[
        float,
        Field(gt=0, description="learning rate of quantum parameters"),
        Tuned(2e-4, 1e-2, "quantum", per_agent=True),
    ] = 1e-3
    clip: Annotated[
        float,
        Field(gt=0, description="ratios beyond 1 - clip and 1 + clip earn nothing"),
        Tuned(0.05, 0.5, per_agent=True),
    ] = 0.1
    repeats: Annotated[int, Field(ge=1, description="passes over an epoch's samples"), Tuned(5, 40)] = 10
    batch: Annotated[int, Field(ge=2, description="samples per gradient step"), Tuned(16, 256)] = 64
    length: Annotated[
        int,
        Field(ge=1, description="steps of a sequence that models that remember learn from"),
        Since("0.2.0"),
    ] = 16
    value_coefficient: Annotated[float, Field(ge=0, description="weight of the squared value error")] = 0.5
    entropy_coefficient: Annotated[float, Field(ge=0, description="weight of the policy's entropy")] = 0.01
    validation: Annotated[
        Literal["greedy", "sampled"], Field(description="actions in validation: most probable, or drawn")
    ] = "greedy"
    log_spread: Annotated[
        float,
        Field(ge=-20, le=2, description="of a box's actions, at first: logarithm, in halves of their range"),
        Since("0.2.0"),
    ] = 0.0
    value_clip: Annotated[
        float | None,
        Field(gt=0, description="distance from the collected values where learning stops; absent: none"),
        Since("0.2.0"),
    ] = None
    longest_gradient: Annotated[
        float | None,
        Field(gt=0, description="norm to which longer gradients of an agent are scaled down; absent: none"),
        Since("0.2.0"),
    ] = None
    decay_steps: DecaySteps = None


class Choices:
    """Independent softmaxes, one for each number of an action: one alone where actions are discrete.

    Attributes
    ----------
    sizes:
        How many choices each has.
    outputs, numbers:
        Of the actor, and of an action.
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.space = space
        self.sizes = choices(space)
        self.outputs, self.numbers = sum(self.sizes), len(self.sizes)

    def noise(self, generator: np.random.Generator, *shape: int) -> NDArray[np.float64]:
        """Draw what `draw` adds (*shape, outputs)."""
        return generator.gumbel(size=(*shape, self.outputs))

    def draw(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Draw actions (..., numbers): the argmax of logits plus standard Gumbel noise draws from their softmax."""
        return self.best(outputs + noise)

    def best(self, outputs: Tensor) -> Tensor:
        """Return the most probable actions (..., numbers) int64."""
        return torch.cat([each.argmax(-1, keepdim=True) for each in torch.split(outputs, self.sizes, -1)], -1)

    def judge(self, outputs: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return log pi of chosen actions (..., numbers), and the entropy of pi, both (...)."""
        log_probs, entropies = [], []
        for logits, number in zip(torch.split(outputs, self.sizes, -1), torch.split(chosen, 1, -1)):
            log_policy = torch.log_softmax(logits, -1)
            log_probs.append(log_policy.gather(-1, number).squeeze(-1))
            entropies.append(-(log_policy.exp() * log_policy).sum(-1))
        return _total(log_probs), _total(entropies)

    def compiled(self, outputs: Array, chosen: Array) -> tuple[Array, Array, Pull]:
        """Return what `judge` returns, and the function that autograd would be, see `qrlsuite.compiled.policies`."""
        from qrlsuite.compiled.policies import judge_choices

        return judge_choices(outputs, self.sizes, chosen)

    def information(self, outputs: FloatArray) -> FloatArray:
        """Return the Fisher information (..., outputs, outputs) of pi."""
        return information_of_choices(outputs, self.sizes)

    def lanes(self, chosen: Tensor) -> NDArray[Any]:
        """Return actions (..., numbers) as the environments take them."""
        shape = (*chosen.shape[:-1], *(self.space.shape or ()))
        return chosen.reshape(shape).cpu().numpy().astype(self.space.dtype)


class Gaussian(nn.Module):
    """Independent normals, one for each number of an action, with spreads of their own.

    Attributes
    ----------
    log_spread:
        (S, numbers).
    outputs, numbers:
        Of the actor, and of an action.
    """

    def __init__(self, space: spaces.Box, seeds: int, log_spread: float) -> None:
        super().__init__()
        self.space = space
        self.outputs = self.numbers = size(space)
        self.log_spread = nn.Parameter(torch.full((seeds, self.numbers), log_spread))

    def _spread(self, outputs: Tensor) -> Tensor:
        """Return the logarithms of the spreads, to broadcast to outputs (S, ..., numbers)."""
        return self.log_spread.view(len(outputs), *[1] * (outputs.dim() - 2), -1)

    def noise(self, generator: np.random.Generator, *shape: int) -> NDArray[np.float64]:
        """Draw what `draw` adds (*shape, outputs)."""
        return generator.standard_normal((*shape, self.outputs))

    def draw(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Draw u (S, ..., numbers)."""
        return outputs + self._spread(outputs).exp() * noise

    def best(self, outputs: Tensor) -> Tensor:
        """Return the means."""
        return outputs

    def judge(self, outputs: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return log pi of u (S, ..., numbers), and the entropy of pi, both (S, ...)."""
        log_spread = self._spread(outputs).expand_as(outputs)
        away = (chosen - outputs) * (-log_spread).exp()
        log_probs = (-0.5 * away.square() - log_spread - HALF_LOG_2_PI).sum(-1)
        return log_probs, (log_spread + 0.5 + HALF_LOG_2_PI).sum(-1)

    def compiled(self, outputs: Array, chosen: Array) -> tuple[Array, Array, Pull]:
        """Return what `Choices.compiled` returns; the function sets the gradient of the spreads, too."""
        means, drawn = torch.from_numpy(outputs), torch.from_numpy(chosen)
        with torch.no_grad():
            log_probs, entropies = self.judge(means, drawn)
            narrow = (-self._spread(means)).exp()

        def pull(slopes: Array, entropy_slope: float) -> Array:
            own, away = torch.from_numpy(slopes)[..., None], (drawn - means) * narrow
            self.log_spread.grad = (own * (away.square() - 1.0) + entropy_slope).cumsum(1)[:, -1]
            cotangents: Array = (own * away * narrow).numpy()
            return cotangents

        return log_probs.numpy(), entropies.numpy(), pull

    def information(self, outputs: FloatArray) -> FloatArray:
        """Return the Fisher information (S, ..., numbers, numbers) of pi, by its means."""
        spread = self._spread(torch.tensor(outputs)).detach().cpu().double().exp().numpy()
        return np.asarray(np.eye(self.numbers) * np.broadcast_to(spread**-2.0, outputs.shape)[..., None])

    def lanes(self, chosen: Tensor) -> NDArray[Any]:
        """Return u (..., numbers) as the environments take them."""
        return from_units(chosen.cpu().numpy(), self.space)


HALF_LOG_2_PI = 0.5 * float(np.log(2 * np.pi))


def _total(parts: Sequence[Tensor]) -> Tensor:
    """Add tensors; a single tensor is returned unchanged."""
    total = parts[0]
    for each in parts[1:]:
        total = total + each
    return total


class Rollout(NamedTuple):
    """The samples of an epoch of T rounds: N = T x E per seed; sample t * E + e is step t of environment e."""

    states: Tensor
    """(S, N, obs)"""
    arrived: Tensor
    """Where each step arrived, before any reset (S, N, obs)."""
    actions: Tensor
    """(S, N, numbers): of a box u, before it was clipped, else int64"""
    log_probs: Tensor
    """Of the actions, under the policy that chose them (S, N)."""
    begins: Tensor
    """1 where an episode begins with the state (S, N)."""
    remembered: Tensor
    """The actor's memory before it saw the state (S, N, M)."""
    rewards: FloatArray
    """(S, T, E), as the two below"""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def generalized_advantages(
    rewards: FloatArray,
    values: FloatArray,
    following: FloatArray,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    gamma: float,
    gae_lambda: float,
) -> FloatArray:
    """Return the advantages A of the module's equations, (S, T, E) like every array given.

    Parameters
    ----------
    rewards:
        r_t.
    values, following:
        V(s_t), and V(s'_t) of where the step arrived, before any reset.
    terminated, truncated:
        Whether and how the step ended its episode.
    gamma, gae_lambda:
        Discount factor and GAE parameter.
    """
    delta = rewards + gamma * np.where(terminated, 0.0, following) - values
    decay = np.where(terminated | truncated, 0.0, gamma * gae_lambda)
    advantages = np.empty_like(delta)
    later = np.zeros_like(delta[:, 0])
    for t in reversed(range(delta.shape[1])):
        later = delta[:, t] + decay[:, t] * later
        advantages[:, t] = later
    return advantages


def minibatches(samples: int, batch: int) -> list[slice]:
    """Split `samples` into pieces of `batch`, a remainder merged into the last one."""
    starts = list(range(0, max(samples - batch, 0) + 1, batch))
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], samples])]


class PPO:
    """S agents learning by PPO; see `qrlsuite.algorithm.Algorithm` for the contract."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: PPOOptions,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams, self.device = envs, options, streams, device
        self.S = len(streams)
        self.E = envs.num_envs // self.S
        self.obs_dim = int(np.prod(envs.single_observation_space.shape or (1,)))
        space = envs.single_action_space
        self.policy: Choices | Gaussian = Choices(space)
        if isinstance(space, spaces.Box):
            self.policy = Gaussian(space, self.S, options.log_spread).to(device)
        self.actor = build_model(self.policy.outputs, role="actor").to(device)
        self.critic = build_model(1, role="critic").to(device)
        self.actor_adam = Adam(self.actor, options.lr, options.quantum_lr)
        self.critic_adam = Adam(self.critic, options.lr, options.quantum_lr)
        self.adams = [self.actor_adam, self.critic_adam]
        clip: Any = options.clip
        self.clip: tuple[Any, Any] = (1.0 - clip, 1.0 + clip)
        self.ends = [
            np.full(self.S, end, np.float64) for end in (1.0 - np.asarray(clip), 1.0 + np.asarray(clip))
        ]
        if isinstance(clip, Tensor):  # each agent's own, (S, 1)
            self.clip = tuple(end.to(device, torch.float32)[:, None] for end in self.clip)
        if isinstance(self.policy, Gaussian):
            self.spread_adam = Adam(self.policy, options.lr, options.quantum_lr)
            self.adams.append(self.spread_adam)
        self.epoch = 0
        self.observations = torch.zeros((self.S, self.E, self.obs_dim), device=device)
        self.begins = torch.ones((self.S, self.E), device=device)
        self.actor_memory, self.critic_memory = (self._nothing(n, self.E) for n in (self.actor, self.critic))
        self.remembers = remembers(self.actor) + remembers(self.critic) > 0
        self.validation_memory = self._nothing(self.actor, 0)  # no part of training
        self._validation: list[np.random.Generator] = []
        self.draws = options.validation == "sampled"

    def _seen(self, observations: NDArray[Any], infos: Mapping[str, Any]) -> Tensor:
        """Return observations of lanes (S, E, obs), with masks behind them if there are any and actions are choices."""
        own = by_seed(observations, self.S, self.device)
        return masks.behind(own, infos) if isinstance(self.policy, Choices) else own

    def _nothing(self, network: nn.Module, lanes: int) -> Tensor:
        """Return a network's memory at the begin of episodes, zeros (S, lanes, M)."""
        return torch.zeros((self.S, lanes, remembers(network)), device=self.device)

    def start(self) -> None:
        """Reset the environments."""
        self.observations = self._seen(*self.envs.reset())
        self.begins = torch.ones((self.S, self.E), device=self.device)

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Collect `rounds` steps of every environment and learn from them.

        Returns the means over the epoch's minibatches (S,) of `policy_loss`, `value_loss` (mean squared error),
        `entropy` and `kl`, an estimate of how far the policy has moved from the one that collected the samples.
        """
        for adam in self.adams:
            adam.decay(self.epoch * rounds * self.E, self.options.decay_steps)
        rollout = self._collect(rounds)
        samples = self._samples(rollout)
        sequences = self._sequences(rounds)
        length = sequences.shape[1]
        total, steps = torch.zeros((4, self.S), device=self.device), 0
        for order in self._orders(len(sequences)):  # (S, n)
            places = sequences[order]
            for piece in minibatches(order.shape[1], max(1, self.options.batch // length)):
                batch = samples.at(places[:, piece].flatten(1))
                seen, action, log_prob, advantage, aim, begins, first, second = batch.values()
                shape = (self.S, begins.shape[1] // length, length)
                total += self._learn(
                    seen, action.to(rollout.actions.dtype), *(each.squeeze(2) for each in (log_prob, advantage, aim)),
                    begins.view(shape), *(each.view(*shape, each.shape[2])[:, :, 0] for each in (first, second)),
                )  # fmt: skip
                steps += 1
        self.epoch += 1
        self._validation = []
        means = (total.to(torch.float64) / steps).cpu().numpy()
        metrics = dict(zip(("policy_loss", "value_loss", "entropy", "kl"), means))
        return metrics | self.actor_adam.gradient_norms()

    def _samples(self, rollout: Rollout) -> Replay:
        """Return a rollout's samples with their advantages, returns and the networks' memories, to draw batches."""
        advantages, returns, critic_remembered = self._estimate(rollout)
        columns = {
            "seen": rollout.states, "action": rollout.actions, "log_prob": rollout.log_probs[..., None],
            "advantage": advantages[..., None], "return": returns[..., None], "begins": rollout.begins[..., None],
            "actor_memory": rollout.remembered, "critic_memory": critic_remembered,
        }  # fmt: skip
        widths = {name: each.shape[2] for name, each in columns.items()}
        samples = Replay(self.S, rollout.states.shape[1], self.device, **widths)
        samples.add(**columns)
        return samples

    def _sequences(self, rounds: int) -> Tensor:
        """Return the samples of all sequences (n, length), numbered through the N samples of a seed."""
        length = min(self.options.length, rounds) if self.remembers else 1
        first = np.linspace(0, rounds - length, -(-rounds // length)).round().astype(np.int64)
        step = first[:, None, None] + np.arange(length)  # (n / E, 1, length)
        samples = (step * self.E + np.arange(self.E)[:, None]).reshape(-1, length)
        return torch.from_numpy(samples).to(self.device)

    def _orders(self, samples: int) -> Tensor:
        """Draw every pass's order of a seed's samples (repeats, S, N)."""
        straight = np.tile(np.arange(samples), (self.options.repeats, 1))
        drawn = [s.numpy("minibatches", self.epoch).permuted(straight, axis=1) for s in self.streams]
        return torch.from_numpy(np.stack(drawn, axis=1)).to(self.device)

    def _collect(self, rounds: int) -> Rollout:
        """Step every environment `rounds` times with the stochastic policy."""
        shape = (self.S, rounds, self.E)
        drawn = np.empty((*shape, self.policy.outputs), dtype=np.float32)
        for s, streams in enumerate(self.streams):
            drawn[s] = self.policy.noise(streams.numpy("exploration", self.epoch), rounds, self.E)
        noise = torch.from_numpy(drawn).to(self.device)
        states = torch.empty((*shape, self.observations.shape[2]), device=self.device)
        arrivals = torch.empty((*shape, self.obs_dim), device=self.device)
        outputs = torch.empty((*shape, self.policy.outputs), device=self.device)
        begun, chosen, remembered = [self.begins], [], []
        rewards = np.empty(shape)
        terminated, truncated = np.empty(shape, dtype=np.bool_), np.empty(shape, dtype=np.bool_)
        for k in range(rounds):
            states[:, k] = self.observations
            if self.remembers:
                self.actor_memory = self.actor_memory * (1.0 - self.begins)[..., None]
            remembered.append(self.actor_memory)
            with torch.no_grad():
                plain = masks.observed(self.observations, self.obs_dim)
                free, self.actor_memory = remember(self.actor, plain, remembered[k])
                outputs[:, k] = masks.masked(free, self.observations, self.obs_dim)
                chosen.append(self.policy.draw(outputs[:, k], noise[:, k]))
            lanes = self.policy.lanes(chosen[k].reshape(self.S * self.E, -1))
            after, reward, terminal, limit, infos = self.envs.step(lanes)
            self.observations = self._seen(after, infos)
            arrivals[:, k] = by_seed(arrived(after, infos), self.S, self.device)
            rewards[:, k] = np.reshape(reward, (self.S, self.E))
            terminated[:, k] = np.reshape(terminal, (self.S, self.E))
            truncated[:, k] = np.reshape(limit, (self.S, self.E))
            self.begins = by_seed(terminal | limit, self.S, self.device)[..., 0]
            begun.append(self.begins)
        actions = torch.stack(chosen, 1)  # (S, rounds, E, numbers)
        samples = (self.S, rounds * self.E)
        outputs, actions = outputs.view(*samples, -1), actions.view(*samples, -1)
        with torch.no_grad():
            if self._sweeps() is None:
                log_probs, _ = self.policy.judge(outputs, actions)
            else:
                log_probs = torch.from_numpy(self.policy.compiled(outputs.numpy(), actions.numpy())[0])
        return Rollout(
            states.view(*samples, -1),
            arrivals.view(*samples, -1),
            actions,
            log_probs,
            torch.stack(begun[:-1], 1).view(samples),
            torch.stack(remembered, 1).flatten(1, 2),
            rewards,
            terminated,
            truncated,
        )

    def _estimate(self, rollout: Rollout) -> tuple[Tensor, Tensor, Tensor]:
        """Return A and R of the samples, both (S, N), and the critic's memory before each (S, N, M)."""
        o, shape = self.options, rollout.rewards.shape
        rollout = rollout._replace(states=masks.observed(rollout.states, self.obs_dim))
        if remembers(self.critic):
            values, following, remembered = self._values_in_order(rollout)
        else:
            values, following = (self._values(states) for states in (rollout.states, rollout.arrived))
            remembered = rollout.states[..., :0]
        values, following = values.reshape(shape), following.reshape(shape)
        advantages = generalized_advantages(
            rollout.rewards,
            values,
            following,
            rollout.terminated,
            rollout.truncated,
            o.gamma,
            o.gae_lambda,
        )
        both = np.stack([advantages, advantages + values]).astype(np.float32).reshape(2, self.S, -1)
        first, second = torch.from_numpy(both).to(self.device)
        return first, second, remembered

    @torch.no_grad()
    def _values_in_order(self, rollout: Rollout) -> tuple[FloatArray, FloatArray, Tensor]:
        """Show the critic every environment's steps; returns V(s) and V(s') (S, N), and its memory before (S, N, M)."""
        S, T, E = rollout.rewards.shape
        states, begins = rollout.states.view(S, T, E, -1), rollout.begins.view(S, T, E)
        values, after = unroll(
            self.critic, states.transpose(1, 2), begins.transpose(1, 2), self.critic_memory
        )
        before = torch.cat([self.critic_memory[:, :, None], after[:, :, :-1]], 2).transpose(1, 2)
        self.critic_memory = after[:, :, -1]
        following, _ = remember(self.critic, rollout.arrived, after.transpose(1, 2).reshape(S, T * E, -1))
        both = (each.to(torch.float64).cpu().numpy() for each in (values.transpose(1, 2), following))
        remembered = before * (1.0 - begins)[..., None]
        return next(both), next(both), remembered.reshape(S, T * E, -1)

    @torch.no_grad()
    def _values(self, states: Tensor) -> FloatArray:
        """Return the critic's values (S, N) of states (S, N, obs), a minibatch at a time: circuits take memory."""
        pieces = minibatches(states.shape[1], self.options.batch)
        values = torch.cat([self.critic(states[:, piece].contiguous()) for piece in pieces], dim=1)
        result: FloatArray = values.squeeze(2).to(torch.float64).cpu().numpy()
        return result

    def _learn(
        self,
        states: Tensor,
        actions: Tensor,
        old_log_probs: Tensor,
        advantages: Tensor,
        returns: Tensor,
        *memory: Tensor,
    ) -> Tensor:
        """Make one Adam step of every agent on its minibatch of B samples.

        Parameters
        ----------
        states:
            (S, B, obs), with masks behind them if there are any.
        actions:
            (S, B, numbers).
        old_log_probs, advantages, returns:
            (S, B).
        memory:
            For models that remember: begins of episodes in each sequence (S, B / length, length), and the memories of
            actor and critic before it, both (S, B / length, M).

        Returns
        -------
        Tensor
            Policy loss, value loss, entropy and divergence (4, S).
        """
        o, whole = self.options, self._sweeps()
        if whole is not None:
            measured = self._slopes(whole, states, actions, old_log_probs, advantages, returns)
            self._step()
            return measured
        plain = masks.observed(states, self.obs_dim)
        free = masks.masked(_outputs(self.actor, plain, *memory[:2]), states, self.obs_dim)
        log_probs, entropies = self.policy.judge(free, actions)
        log_ratio = log_probs - old_log_probs
        ratio = log_ratio.exp()
        a = _normalized(advantages)
        policy_loss = -torch.minimum(ratio * a, ratio.clamp(*self.clip) * a).mean(1)
        values = _outputs(self.critic, plain, *memory[::2]).squeeze(2)
        value_errors = (values - returns).square()
        if o.value_clip is not None:
            collected = returns - advantages
            near = collected + (values - collected).clamp(-o.value_clip, o.value_clip)
            value_errors = torch.maximum(value_errors, (near - returns).square())
        value_loss = value_errors.mean(1)
        entropy = entropies.mean(1)
        losses = policy_loss + o.value_coefficient * value_loss - o.entropy_coefficient * entropy
        for adam in self.adams:
            adam.zero_grad()
        torch.autograd.backward(losses.sum())
        self._step()
        with torch.no_grad():
            return torch.stack([policy_loss, value_loss, entropy, -log_ratio.mean(1)])

    def _sweeps(self) -> list[Sweep] | None:
        """Return actor and critic as compiled sweeps, which learn without autograd; None where one is none."""
        return None if self.remembers or self.device.type != "cpu" else sweeps(self.actor, self.critic)

    def _slopes(self, networks: Sequence[Sweep], seen: Tensor, actions: Tensor, *judged: Tensor) -> Tensor:
        """Set the gradients of `_learn` by its formulas' derivatives; returns the same numbers."""
        from qrlsuite.compiled.policies import proximal

        o, plain = self.options, masks.observed(seen, self.obs_dim).numpy()
        (outputs, actor_records), (values, critic_records) = (each.values(plain, True) for each in networks)
        free = masks.masked(torch.from_numpy(outputs), seen, self.obs_dim)
        log_probs, entropies, pull = self.policy.compiled(free.numpy(), actions.contiguous().numpy())
        slopes, value_slopes = np.empty_like(log_probs), np.empty_like(values)
        measured = np.empty((4, self.S))
        proximal(
            log_probs, entropies, *(each.contiguous().numpy() for each in judged), values, *self.ends,
            np.inf if o.value_clip is None else o.value_clip, o.value_coefficient, slopes, value_slopes, measured,
        )  # fmt: skip
        networks[0].set_gradients(actor_records, pull(slopes, -o.entropy_coefficient / slopes.shape[1]))
        networks[1].set_gradients(critic_records, value_slopes)
        return torch.from_numpy(measured)

    def _step(self) -> None:
        """Make an Adam step of every agent."""
        if self.options.longest_gradient is not None:
            spreads = [self.policy] if isinstance(self.policy, Gaussian) else []
            clip_gradients(self.options.longest_gradient, self.actor, self.critic, *spreads)
        for adam in self.adams:
            adam.step()

    @torch.no_grad()
    def act(
        self,
        observations: NDArray[np.float32],
        begins: NDArray[np.bool_] | None = None,
        infos: Mapping[str, Any] | None = None,
    ) -> NDArray[Any]:
        """Return actions (S, B, ...) for observations (S, B, obs), as the option `validation` says.

        Drawn actions come from one stream per seed and epoch, in the order of the calls since the epoch ended.

        Parameters
        ----------
        begins:
            Where an episode begins with the observation (S, B); None: everywhere.
        infos:
            The lanes' infos on it: forbidden actions are not chosen.
        """
        seen = torch.from_numpy(observations).to(self.device)
        if begins is None or self.validation_memory.shape[1] != seen.shape[1]:  # or other lanes than before
            self.validation_memory = self._nothing(self.actor, seen.shape[1])
        else:
            going_on = torch.from_numpy(~begins).to(self.device)[..., None]
            self.validation_memory = self.validation_memory * going_on
        outputs, self.validation_memory = remember(self.actor, seen, self.validation_memory)
        if isinstance(self.policy, Choices):
            outputs = masks.masked(outputs, masks.behind(seen, infos or masks.NOTHING), self.obs_dim)
        if not self.draws:
            return self.policy.lanes(self.policy.best(outputs))
        if not self._validation:
            self._validation = [s.numpy("validation actions", self.epoch) for s in self.streams]
        noise = [self.policy.noise(g, outputs.shape[1]) for g in self._validation]
        drawn = torch.from_numpy(np.stack(noise).astype(np.float32)).to(self.device)
        return self.policy.lanes(self.policy.draw(outputs, drawn))

    def information(self, outputs: FloatArray) -> FloatArray:
        """Return the Fisher information of the policy by the actor's outputs, see `qrlsuite.algorithm.Algorithm`."""
        return self.policy.information(outputs)

    def policy_state(self) -> dict[str, Tensor]:
        """Return the actor's parameters and buffers, and the spreads of continuous actions."""
        return {**self.actor.state_dict(), **self._spreads("ppo")}

    def _spreads(self, prefix: str) -> dict[str, Tensor]:
        """Return the spreads of continuous actions under a prefix; nothing where actions are choices."""
        return prefixed(**{prefix: self.policy.state_dict()}) if isinstance(self.policy, Gaussian) else {}

    def state_dict(self) -> dict[str, Tensor]:
        """Return networks, optimizers, current observations, the memories at them, and the epoch, seed-first."""
        remembered = {
            "begins": self.begins,
            "actor_memory": self.actor_memory,
            "critic_memory": self.critic_memory,
        }
        return {
            **prefixed(
                actor=self.actor.state_dict(),
                critic=self.critic.state_dict(),
                actor_adam=self.actor_adam.state_dict(),
                critic_adam=self.critic_adam.state_dict(),
            ),
            **self._spreads("spread"),
            **(
                prefixed(spread_adam=self.spread_adam.state_dict())
                if isinstance(self.policy, Gaussian)
                else {}
            ),
            "observations": self.observations,
            **(remembered if self.remembers else {}),
            "epoch": torch.full((self.S,), self.epoch, dtype=torch.int64),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.actor.load_state_dict(part(state, "actor"))
        self.critic.load_state_dict(part(state, "critic"))
        self.actor_adam.load_state_dict(part(state, "actor_adam"))
        self.critic_adam.load_state_dict(part(state, "critic_adam"))
        if isinstance(self.policy, Gaussian):
            self.policy.load_state_dict(part(state, "spread"))
            self.spread_adam.load_state_dict(part(state, "spread_adam"))
        self.observations = state["observations"].clone().to(self.device)
        if self.remembers:
            self.begins, self.actor_memory, self.critic_memory = (
                state[name].clone().to(self.device) for name in ("begins", "actor_memory", "critic_memory")
            )
        self.epoch = int(state["epoch"][0])
        self._validation = []


def _outputs(
    network: nn.Module, states: Tensor, begins: Tensor | None = None, remembered: Tensor | None = None
) -> Tensor:
    """Return a network's outputs (S, B, out) for states (S, B, obs), which are sequences where it remembers."""
    if not remembers(network) or begins is None or remembered is None:
        outputs: Tensor = network(states)
        return outputs
    sequences = states.view(*begins.shape, -1)
    return unroll(network, sequences, begins, remembered)[0].flatten(1, 2)


def _normalized(advantages: Tensor) -> Tensor:
    """Shift and scale (S, B) to mean 0 and (unbiased) standard deviation 1 per agent."""
    if advantages.shape[1] < 2:
        return advantages - advantages  # a single sample is its own mean
    return (advantages - advantages.mean(1, keepdim=True)) / (advantages.std(1, keepdim=True) + 1e-8)
