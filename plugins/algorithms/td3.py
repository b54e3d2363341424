"""Twin delayed deep deterministic policy gradient (Fujimoto, van Hoof & Meger 2018, arXiv:1802.09477) for S seeds.

With actor mu, critics Q1 and Q2, slowly following copies mu', Q1' and Q2', discount g and a transition
(s, a, r, s', d), d = 1 where the episode terminated at s':

    a~   = clip(mu'(s') + clip(sigma' n, -c, c), -1, 1)      n standard normal (the paper's eq. 14)
    y    = r + g (1 - d) min(Q1'(s', a~), Q2'(s', a~))       (eq. 10)
    loss = mean (Q1(s, a) - y)^2 + mean (Q2(s, a) - y)^2,    of the critics, every step
    loss = - mean Q1(s, mu(s)),                              of the actor, every `delay` steps (algorithm 1)
    p'   = tau p + (1 - tau) p',                             of all copies, with the actor

Losses are summed over the S agents, so that gradients do not mix. Per round, every environment takes one step with
clip(mu(s) + sigma n, -1, 1), the transitions enter the replay buffer, and `updates` steps are made on batches drawn
uniformly, with replacement, from the buffer. With correlation rho, the noise of a step is sqrt(1 - rho^2) n + rho
times the noise of the step before: an Ornstein-Uhlenbeck process as in DDPG (Lillicrap et al. 2015, arXiv:1509.02971),
of equal spread, that begins anew in every epoch. The first `warm_up` transitions of a seed come from uniform actions,
and nothing is learned before.

Actions are numbers in -1 .. 1, linear in the box of the environment's (`qrlsuite.actions.from_units`); mu is the
hyperbolic tangent of the model's outputs. A time limit that truncates an episode is no d.

Deviations from the paper:
- Batch 256 and one learning rate of 1e-3 for actor and critics are Stable-Baselines3's defaults; the paper has 100, and
  1e-3 for both. A `warm_up` of 100 transitions is Stable-Baselines3's, too; the paper has 1000 or 10,000.
- One gradient step per round of all environments; the paper has one environment, hence a step per interaction.
- The replay buffer holds 50,000 transitions, not a million: it is part of every checkpoint.
- Networks have the architecture of the entry's model; a critic is given s, and then a, in its first layer.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite.actions import from_units, size
from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv, arrived
from qrlsuite.options import Tuned
from qrlsuite.population import Adam, by_seed, chosen_errors, follow, gradients, held, part, prefixed
from qrlsuite.replay import Replay
from qrlsuite.seeding import Streams


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TD3Options:
    """Options of TD3; the defaults are Stable-Baselines3's, the buffer aside."""

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
    tau: Annotated[
        float, Field(gt=0, le=1, description="share of the networks in their copies, per step")
    ] = 0.005
    noise: Annotated[
        float, Field(ge=0, description="sigma: spread of exploration, in halves of an action's range")
    ] = 0.1
    correlation: Annotated[
        float, Field(ge=0, lt=1, description="rho: of exploration, from one step to the next")
    ] = 0.0
    target_noise: Annotated[float, Field(ge=0, description="sigma': spread of the copies' actions")] = 0.2
    target_clip: Annotated[float, Field(ge=0, description="c: bound of that noise")] = 0.5
    delay: Annotated[int, Field(ge=1, description="critics' steps per step of the actor")] = 2
    updates: Annotated[int, Field(ge=1, description="gradient steps per round")] = 1
    warm_up: Annotated[int, Field(ge=0, description="first transitions with uniform actions, per seed")] = 100
    buffer: Annotated[int, Field(ge=1, description="transitions held by the replay buffer, per seed")] = (
        50_000
    )
    batch: Annotated[int, Field(ge=1, description="transitions per gradient step")] = 256


class TD3:
    """S agents learning by TD3; see `qrlsuite.algorithm.Algorithm` for the contract."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: TD3Options,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams, self.device = envs, options, streams, device
        self.S = len(streams)
        self.E = envs.num_envs // self.S
        self.space = cast(spaces.Box, envs.single_action_space)
        self.A = size(self.space)
        self.obs_dim = int(np.prod(envs.single_observation_space.shape or (1,)))
        self.actor = build_model(self.A, role="actor").to(device)
        self.critics = nn.ModuleList(
            build_model(1, inputs=self.obs_dim + self.A, role="critic").to(device) for _ in range(2)
        )
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_adam = Adam(self.actor, options.lr, options.quantum_lr)
        self.critic_adams = [Adam(critic, options.lr, options.quantum_lr) for critic in self.critics]
        self.replay = Replay(
            self.S, options.buffer, device,
            observation=self.obs_dim, arrived=self.obs_dim, action=self.A, reward=1, alive=1,
        )  # fmt: skip
        self.epoch = self.steps = 0  # gradient steps made
        self.observations = torch.zeros((self.S, self.E, self.obs_dim), device=device)

    def start(self) -> None:
        """Reset the environments."""
        first, _ = self.envs.reset()
        self.observations = by_seed(first, self.S, self.device)

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Interact and learn for `rounds` rounds.

        Returns the means (S,) of `value_loss`, the critics' mean squared error, and `value`, Q1 of the actor's actions;
        NaN without such a step.
        """
        o = self.options
        explore, uniform, draws, target_noise = self._epoch_numbers(rounds)
        totals = torch.zeros((2, self.S), dtype=torch.float64, device=self.device)
        counts = [0, 0]
        for k in range(rounds):
            if self.replay.stored < o.warm_up:
                self._interact(uniform[:, k])
            else:
                self._interact((self._mu(self.observations) + o.noise * explore[:, k]).clamp(-1.0, 1.0))
            for u in range(k * o.updates, (k + 1) * o.updates) if self.replay.stored >= o.warm_up else ():
                batch = self.replay.batch(draws[:, u])
                totals[0] += self._learn_values(batch, target_noise[:, u])
                counts[0] += 1
                self.steps += 1
                if self.steps % o.delay == 0:
                    totals[1] += self._learn_policy(batch["observation"])
                    counts[1] += 1
        self.epoch += 1
        means = [total.cpu().numpy() / count if count else np.full(self.S, np.nan)
                 for total, count in zip(totals, counts)]  # fmt: skip
        return dict(zip(("value_loss", "value"), means)) | self.actor_adam.gradient_norms()

    def _epoch_numbers(self, rounds: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw an epoch's random numbers.

        Returns
        -------
        tuple
            Exploration, normal and uniform in -1 .. 1, both (S, rounds, E, A), replay positions in [0, 1)
            (S, rounds x updates, batch), and the copies' noise, normal (S, rounds x updates, batch, A).
        """
        o, steps = self.options, rounds * self.options.updates
        explore, uniform = (np.empty((self.S, rounds, self.E, self.A), np.float32) for _ in range(2))
        draws = np.empty((self.S, steps, o.batch))
        noise = np.empty((self.S, steps, o.batch, self.A), np.float32)
        for s, streams in enumerate(self.streams):
            exploration = streams.numpy("exploration", self.epoch)
            explore[s] = exploration.standard_normal(explore.shape[1:])
            uniform[s] = exploration.uniform(-1.0, 1.0, uniform.shape[1:])
            for k in range(1, rounds) if o.correlation else ():
                explore[s, k] = (
                    math.sqrt(1.0 - o.correlation**2) * explore[s, k] + o.correlation * explore[s, k - 1]
                )
            replay = streams.numpy("replay", self.epoch)
            draws[s] = replay.random(draws.shape[1:])
            noise[s] = replay.standard_normal(noise.shape[1:])
        return tuple(torch.from_numpy(a).to(self.device) for a in (explore, uniform, draws, noise))  # type: ignore[return-value]

    def _mu(self, observations: Tensor) -> Tensor:
        """Return the actor's actions (S, B, A) in -1 .. 1, without gradients."""
        with torch.no_grad():
            return torch.tanh(self.actor(observations))

    def _interact(self, units: Tensor) -> None:
        """Step every environment once with actions (S, E, A) in -1 .. 1, and store the S x E transitions."""
        lanes = from_units(units.reshape(-1, self.A).cpu().numpy(), self.space)
        after, rewards, terminated, _, infos = self.envs.step(lanes)
        self.replay.add(
            observation=self.observations,
            arrived=by_seed(arrived(after, infos), self.S, self.device),
            action=units,
            reward=by_seed(rewards, self.S, self.device),
            alive=1.0 - by_seed(terminated, self.S, self.device),
        )
        self.observations = by_seed(after, self.S, self.device)

    def _learn_values(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        """Make one Adam step of every agent's critics; returns the mean of their losses (S,)."""
        o = self.options
        with torch.no_grad():
            shift = (o.target_noise * noise).clamp(-o.target_clip, o.target_clip)
            action = (torch.tanh(self.target_actor(batch["arrived"])) + shift).clamp(-1.0, 1.0)
            beyond = torch.cat([batch["arrived"], action], 2)
            least = torch.minimum(*(critic(beyond) for critic in self.target_critics))
            y = (batch["reward"] + o.gamma * batch["alive"] * least).squeeze(2)
        taken = torch.cat([batch["observation"], batch["action"]], 2)
        only = torch.zeros(y.shape, dtype=torch.int64, device=self.device)  # Q(s, a) is a critic's one output
        errors = [chosen_errors(critic, taken, only, y) for critic in self.critics]
        for adam in self.critic_adams:
            adam.step()
        return torch.stack([each.square().mean(1) for each in errors]).mean(0).to(torch.float64)

    def _learn_policy(self, observations: Tensor) -> Tensor:
        """Make one Adam step of every agent's actor, and let the copies follow; returns the values (S,)."""
        with held(self.critics):
            action = torch.tanh(self.actor(observations))
            values = self.critics[0](torch.cat([observations, action], 2)).mean((1, 2))
            gradients(-values.sum(), self.actor)
        self.actor_adam.step()
        follow(self.target_actor, self.actor, self.options.tau)
        follow(self.target_critics, self.critics, self.options.tau)
        detached: Tensor = values.detach().to(torch.float64)
        return detached

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return the actor's actions (S, B, ...) for observations (S, B, obs)."""
        return from_units(self._mu(torch.from_numpy(observations).to(self.device)).cpu().numpy(), self.space)

    def policy_state(self) -> dict[str, Tensor]:
        """Return the actor's parameters and buffers."""
        return dict(self.actor.state_dict())

    def _parts(self) -> dict[str, nn.Module | Adam | Replay]:
        return {
            "actor": self.actor, "critics": self.critics, "target_actor": self.target_actor,
            "target_critics": self.target_critics, "actor_adam": self.actor_adam,
            "critic_adam0": self.critic_adams[0], "critic_adam1": self.critic_adams[1], "replay": self.replay,
        }  # fmt: skip

    def state_dict(self) -> dict[str, Tensor]:
        """Return networks, optimizers, replay buffer, current observations and counters, seed-first."""
        return {
            **prefixed(**{name: each.state_dict() for name, each in self._parts().items()}),
            "observations": self.observations,
            "counters": torch.tensor([[self.epoch, self.steps]] * self.S, dtype=torch.int64),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        for name, each in self._parts().items():
            each.load_state_dict(part(state, name))
        self.observations = state["observations"].clone().to(self.device)
        self.epoch, self.steps = (int(v) for v in state["counters"][0])
