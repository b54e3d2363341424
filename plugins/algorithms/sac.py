"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018, arXiv:1812.05905) for a population of S seeds.

With policy pi, critics Q1 and Q2, their slowly following copies Q1' and Q2', temperature alpha, discount g and a
transition (s, a, r, s', d), d = 1 where the episode terminated at s', the soft value of a state under two critics is

    V(s) = E [ min(Q1, Q2)(s, a) - alpha log pi(a|s) ],  a ~ pi(.|s)     the paper's eq. 3

    y    = r + g (1 - d) V'(s'), by the copies                           eq. 5 and 6
    loss = (mean (Q1(s, a) - y)^2 + mean (Q2(s, a) - y)^2) / 2,          of the critics
    loss = - mean V(s),                                                  of the policy: eq. 7 and 9
    loss = mean log alpha (H(pi(.|s)) - H0),                             of log alpha: eq. 18, see below
    Q'   = tau Q + (1 - tau) Q'

every step in this order, losses summed over the S agents, so that gradients do not mix. Per round, every environment
takes one step with an action drawn from pi, the transitions enter the replay buffer, and `updates` steps are made on
batches drawn uniformly, with replacement, from the buffer. The first `warm_up` transitions of a seed come from
uniform actions, and nothing is learned before.

*Continuous actions.* The model's outputs are mean m and logarithm of the spread l of a normal u, l clipped to -20 .. 2,
and a = tanh(u), linear in the box of the environment's (`qrlsuite.actions.from_units`). The expectation is one sample;
log pi(a|s) = sum over the action's A numbers of log N(u; m, e^l) - log(1 - tanh(u)^2) (appendix C, eq. 21), the last
term computed as 2 (log 2 - u - log(1 + e^(-2 u))), which is exact where tanh(u)^2 rounds to 1. H0 = -A (appendix D).
Validation takes tanh(m).

*Discrete actions* (Christodoulou 2019, arXiv:1910.07207). pi is the softmax of the model's outputs, a critic returns Q
of every action, and the expectation is the sum over all of them (its eq. 10 to 12). H0 = 0.98 log(number of actions),
as in the author's code; the text has no number. Validation takes the most probable action.

Deviations from the papers:
- The loss is linear in log alpha, not in alpha, as in the authors' code.
- Batch 256, a learning rate of 3e-4, tau 0.005 and `warm_up` 100 are Stable-Baselines3's defaults, and except for
  `warm_up` the paper's; Christodoulou has batch 64 and a gradient step every fourth interaction.
- One gradient step per round of all environments; the papers have one environment, hence a step per interaction.
- The replay buffer holds 50,000 transitions, not a million: it is part of every checkpoint.
- Networks have the architecture of the entry's model; a critic is given s, and then a, in its first layer.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import masks
from qrlsuite.actions import from_units, information_of_choices, size
from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv, arrived
from qrlsuite.errors import OptionError
from qrlsuite.options import Tuned
from qrlsuite.population import (
    Adam,
    DecaySteps,
    by_seed,
    chosen_errors,
    follow,
    gradients,
    held,
    part,
    prefixed,
)
from qrlsuite.replay import Replay
from qrlsuite.seeding import Streams

LOG_SPREAD = (-20.0, 2.0)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SACOptions:
    """Options of soft actor-critic; the defaults are Stable-Baselines3's, the buffer aside."""

    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.99
    lr: Annotated[
        float,
        Field(gt=0, description="learning rate of classical parameters, and of the temperature"),
        Tuned(1e-4, 1e-2, per_agent=True),
    ] = 3e-4
    quantum_lr: Annotated[
        float,
        Field(gt=0, description="learning rate of quantum parameters"),
        Tuned(1e-4, 1e-2, "quantum", per_agent=True),
    ] = 3e-4
    tau: Annotated[float, Field(gt=0, le=1, description="share of the critics in their copies, per step")] = (
        0.005
    )
    temperature: Annotated[
        float | None, Field(gt=0, description="alpha, fixed; absent: it begins at 1 and is learned")
    ] = None
    target_entropy: Annotated[
        float | None,
        Field(description="H0, in nats; absent: minus the numbers of an action, 0.98 log of discrete ones"),
    ] = None
    updates: Annotated[int, Field(ge=1, description="gradient steps per round")] = 1
    warm_up: Annotated[int, Field(ge=0, description="first transitions with uniform actions, per seed")] = 100
    buffer: Annotated[int, Field(ge=1, description="transitions held by the replay buffer, per seed")] = (
        50_000
    )
    batch: Annotated[int, Field(ge=1, description="transitions per gradient step")] = 256
    decay_steps: DecaySteps = None


def log_probabilities(u: Tensor, noise: Tensor, log_spread: Tensor) -> Tensor:
    """Return log pi of tanh(u), u = m + noise e^l, all (S, B, A): (S, B).

    Only elementwise functions that torch computes alike in a vector's body and tail; softplus is not.
    """
    normal = -0.5 * noise.square() - log_spread - 0.5 * math.log(2.0 * math.pi)
    softplus = torch.relu(-2.0 * u) + torch.log1p(torch.exp(-2.0 * u.abs()))
    return (normal - 2.0 * (math.log(2.0) - u - softplus)).sum(2)


class Temperature(nn.Module):
    """The logarithms of S temperatures."""

    def __init__(self, start: float, seeds: int) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.full((seeds,), math.log(start)))


class SAC:
    """S agents learning by soft actor-critic; see `qrlsuite.algorithm.Algorithm` for the contract."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: SACOptions,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams, self.device = envs, options, streams, device
        self.S = len(streams)
        self.E = envs.num_envs // self.S
        self.obs_dim = int(np.prod(envs.single_observation_space.shape or (1,)))
        self.space: Any = envs.single_action_space
        choices = self.space.n if isinstance(self.space, spaces.Discrete) else None
        self.discrete = choices is not None
        self.N = size(self.space) if choices is None else int(choices)  # choices, or numbers of an action
        self.actor = build_model(self.N if self.discrete else 2 * self.N, role="actor").to(device)
        outputs, inputs = (self.N, self.obs_dim) if self.discrete else (1, self.obs_dim + self.N)
        self.critics = nn.ModuleList(
            build_model(outputs, inputs=inputs, role="critic").to(device) for _ in range(2)
        )
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = Temperature(options.temperature or 1.0, self.S).to(device)
        usual = 0.98 * math.log(self.N) if self.discrete else -float(self.N)
        self.least_entropy = usual if options.target_entropy is None else options.target_entropy
        if self.discrete and self.least_entropy > math.log(self.N):
            raise OptionError(
                f"target_entropy = {self.least_entropy:g}: a policy of {self.N} actions has log {self.N} = "
                f"{math.log(self.N):.4f} at most, and the temperature would grow without end: set a smaller one"
            )
        self.adams = {
            name: Adam(module, options.lr, options.quantum_lr)
            for name, module in (
                ("actor_adam", self.actor), ("critic_adam0", self.critics[0]), ("critic_adam1", self.critics[1]),
                ("temperature_adam", self.temperature),
            )
        }  # fmt: skip
        self.epoch = 0
        self._hold(torch.zeros((self.S, self.E, self.obs_dim), device=device))

    def _hold(self, observations: Tensor) -> None:
        """Store the observations, followed by masks if any, and create a replay buffer of their size."""
        self.observations, seen = observations, observations.shape[2]
        self.replay = Replay(
            self.S, self.options.buffer, self.device,
            observation=seen, arrived=seen, action=1 if self.discrete else self.N, reward=1, alive=1,
        )  # fmt: skip

    def start(self) -> None:
        """Reset the environments."""
        self._hold(self._seen(*self.envs.reset()))

    def _seen(self, observations: NDArray[Any], infos: Mapping[str, Any], arrived: bool = False) -> Tensor:
        """Return observations of lanes (S, E, obs); of discrete actions with masks behind them if there are any."""
        own = by_seed(observations, self.S, self.device)
        return masks.behind(own, infos, arrived) if self.discrete else own

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Interact and learn for `rounds` rounds.

        Returns the means over the gradient steps (S,) of `value_loss`, the critics' mean squared error, `value`, the
        soft value of the batches' states, `entropy` of the policy and `temperature`; NaN without a step.
        """
        o = self.options
        explore, uniform, draws, noise = self._epoch_numbers(rounds)
        total = torch.zeros((4, self.S), dtype=torch.float64, device=self.device)
        steps = 0
        for adam in self.adams.values():
            adam.decay(self.epoch * rounds * self.E, o.decay_steps)
        for k in range(rounds):
            if self.replay.stored >= o.warm_up:
                self._interact(self._draw(self.observations, explore[:, k]))
            else:
                self._interact(self._uniform(uniform[:, k], k))
            for u in range(k * o.updates, (k + 1) * o.updates) if self.replay.stored >= o.warm_up else ():
                total += self._learn(self.replay.batch(draws[:, u]), noise[:, u])
                steps += 1
        self.epoch += 1
        means = total.cpu().numpy() / steps if steps else np.full((4, self.S), np.nan)
        metrics = dict(zip(("value_loss", "value", "entropy", "temperature"), means))
        return metrics | self.adams["actor_adam"].gradient_norms()

    def _epoch_numbers(self, rounds: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw an epoch's random numbers.

        Returns
        -------
        tuple
            Exploration (S, rounds, E, N), normal, or Gumbel's of discrete actions; uniform actions (S, rounds, E, N),
            or (S, rounds, E, 1) of discrete ones; replay positions in [0, 1) (S, rounds x updates, batch); and normal
            noise (S, rounds x updates, 2, batch, N) for s' and s, empty of discrete actions.
        """
        o, steps = self.options, rounds * self.options.updates
        explore = np.empty((self.S, rounds, self.E, self.N), np.float32)
        uniform = np.empty((self.S, rounds, self.E, 1 if self.discrete else self.N), np.float32)
        draws = np.empty((self.S, steps, o.batch))
        noise = np.empty((self.S, steps, 2, o.batch, 0 if self.discrete else self.N), np.float32)
        for s, streams in enumerate(self.streams):
            exploration, replay = (
                streams.numpy("exploration", self.epoch),
                streams.numpy("replay", self.epoch),
            )
            if self.discrete:
                explore[s] = exploration.gumbel(size=explore.shape[1:])
                uniform[s] = exploration.integers(self.N, size=uniform.shape[1:])
            else:
                explore[s] = exploration.standard_normal(explore.shape[1:])
                uniform[s] = exploration.uniform(-1.0, 1.0, uniform.shape[1:])
            draws[s] = replay.random(draws.shape[1:])
            noise[s] = replay.standard_normal(noise.shape[1:])
        return tuple(torch.from_numpy(a).to(self.device) for a in (explore, uniform, draws, noise))  # type: ignore[return-value]

    def _policy(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the spread (S, B, A) of the normal under the hyperbolic tangent."""
        outputs = self.actor(observations)
        return outputs[..., : self.N], outputs[..., self.N :].clamp(*LOG_SPREAD)

    def _uniform(self, drawn: Tensor, step: int) -> Tensor:
        """Return drawn uniform actions; discrete actions (S, E, 1) are drawn among the allowed ones."""
        if not self.discrete:
            return drawn
        seen, inputs = self.observations, self.obs_dim
        return masks.drawn(drawn[..., 0], seen, inputs, self.streams, self.epoch, step)[..., None]

    def _logits(self, seen: Tensor) -> Tensor:
        """Return the logits (S, B, N) of discrete actions, lowest where they are forbidden."""
        return masks.masked(self.actor(masks.observed(seen, self.obs_dim)), seen, self.obs_dim)

    @torch.no_grad()
    def _draw(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Draw actions (S, B, A) in -1 .. 1, or the numbers of discrete ones (S, B, 1)."""
        if self.discrete:
            return (self._logits(observations) + noise).argmax(2, keepdim=True)
        mean, log_spread = self._policy(observations)
        return torch.tanh(mean + noise * log_spread.exp())

    def _interact(self, chosen: Tensor) -> None:
        """Step every environment once with actions (S, E, A) or (S, E, 1), and store the S x E transitions."""
        after, rewards, terminated, _, infos = self.envs.step(
            self._lanes(chosen.reshape(self.S * self.E, -1))
        )
        self.replay.add(
            observation=self.observations,
            arrived=self._seen(arrived(after, infos), infos, arrived=True),
            action=chosen,
            reward=by_seed(rewards, self.S, self.device),
            alive=1.0 - by_seed(terminated, self.S, self.device),
        )
        self.observations = self._seen(after, infos)

    def _lanes(self, chosen: Tensor) -> NDArray[Any]:
        """Return actions (..., A) or (..., 1) as the environments take them."""
        values = chosen.cpu().numpy()
        return values[..., 0].astype(np.int64) if self.discrete else from_units(values, self.space)

    def _soft(self, observations: Tensor, critics: nn.ModuleList, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return soft values V and entropies of states (S, B, obs) under the policy, both (S, B)."""
        alpha = self.temperature.log.detach().exp()[:, None]
        if self.discrete:
            log_policy = torch.log_softmax(self._logits(observations), -1)
            policy = log_policy.exp()
            plain = masks.observed(observations, self.obs_dim)
            least = torch.minimum(*(critic(plain) for critic in critics))
            entropy = -(policy * log_policy).sum(2)
            return (policy * least).sum(2) + alpha * entropy, entropy
        mean, log_spread = self._policy(observations)
        u = mean + noise * log_spread.exp()
        taken = torch.cat([observations, torch.tanh(u)], 2)
        least = torch.minimum(*(critic(taken) for critic in critics)).squeeze(2)
        entropy = -log_probabilities(u, noise, log_spread)
        return least + alpha * entropy, entropy

    def _learn(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        """Make one Adam step of every network of every agent; returns the epoch's metrics of it (4, S)."""
        o, adams = self.options, self.adams
        states = batch["observation"]
        with torch.no_grad():
            beyond, _ = self._soft(batch["arrived"], self.targets, noise[:, 0])
            y = (batch["reward"] + o.gamma * batch["alive"] * beyond[..., None]).squeeze(2)
        if self.discrete:
            taken, picked = masks.observed(states, self.obs_dim), batch["action"].squeeze(2).long()
        else:  # Q(s, a) is a critic's one output
            taken = torch.cat([states, batch["action"]], 2)
            picked = torch.zeros(y.shape, dtype=torch.int64, device=self.device)
        each = [chosen_errors(critic, taken, picked, y, weight=0.5) for critic in self.critics]
        errors = torch.stack([own.square().mean(1) for own in each])
        for name in ("critic_adam0", "critic_adam1"):
            adams[name].step()
        with held(self.critics):
            value, entropy = self._soft(states, self.critics, noise[:, 1])
            gradients(-value.mean(1).sum(), self.actor)
        adams["actor_adam"].step()
        surplus = entropy.detach().mean(1) - self.least_entropy
        alpha = self.temperature.log.detach().exp()
        if o.temperature is None:
            gradients((self.temperature.log * surplus).sum(), self.temperature)
            adams["temperature_adam"].step()
        follow(self.targets, self.critics, o.tau)
        seen = (errors.mean(0), value.detach().mean(1), entropy.detach().mean(1), alpha)
        return torch.stack(seen).to(torch.float64)

    @torch.no_grad()
    def act(
        self, observations: NDArray[np.float32], infos: Mapping[str, Any] = masks.NOTHING
    ) -> NDArray[Any]:
        """Return the most probable actions (S, B), or tanh of the means (S, B, ...), for observations (S, B, obs).

        None is chosen that `infos` forbid.
        """
        seen = torch.from_numpy(observations).to(self.device)
        if self.discrete:
            return self._lanes(self._logits(masks.behind(seen, infos)).argmax(2, keepdim=True))
        return self._lanes(torch.tanh(self._policy(seen)[0]))

    def information(self, outputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Fisher information of the policy by the actor's outputs, see `qrlsuite.algorithm.Algorithm`.

        The hyperbolic tangent, which maps the normal one to one, changes nothing of it.
        """
        if self.discrete:
            return information_of_choices(outputs, [self.N])
        of_means = np.exp(-2.0 * outputs[..., self.N :].clip(*LOG_SPREAD))
        diagonal = np.concatenate([of_means, np.full_like(of_means, 2.0)], axis=-1)
        return np.asarray(np.eye(2 * self.N) * diagonal[..., None])

    def policy_state(self) -> dict[str, Tensor]:
        """Return the policy's parameters and buffers."""
        return dict(self.actor.state_dict())

    def _parts(self) -> dict[str, nn.Module | Adam | Replay]:
        return {
            "actor": self.actor, "critics": self.critics, "targets": self.targets, "temperature": self.temperature,
            **self.adams, "replay": self.replay,
        }  # fmt: skip

    def state_dict(self) -> dict[str, Tensor]:
        """Return networks, temperatures, optimizers, replay buffer, current observations and the epoch, seed-first."""
        return {
            **prefixed(**{name: each.state_dict() for name, each in self._parts().items()}),
            "observations": self.observations,
            "epoch": torch.full((self.S,), self.epoch, dtype=torch.int64),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self._hold(state["observations"].clone().to(self.device))
        for name, each in self._parts().items():
            each.load_state_dict(part(state, name))
        self.epoch = int(state["epoch"][0])
