"""Double deep Q-learning (van Hasselt, Guez & Silver 2016) for a population of S seeds.

With online network Q and target network Q', discount g and a transition (s, a, r, s', d), d = 1 where the
episode terminated at s':

    y    = r + g (1 - d) Q'(s', argmax_a' Q(s', a'))
    loss = mean over the batch of (Q(s, a) - y)^2, summed over the S agents (so gradients do not mix)

Per round, every environment takes one epsilon-greedy step, the transitions enter the replay buffer, and one
Adam step is made on a batch drawn uniformly, with replacement, from the buffer.

Deviations from the paper (section 'Experimental Setup' and its appendix):
- The text's loss has online and target network swapped; this is the standard form, as in the released code.
- One gradient step per round of all environments (10 interactions) is the released code's; the text is silent.
- Buffer 2000 and a target copy every 2000 gradient steps are the released defaults; the text's table says
  1000 and 1000 (a task's preset `text`).
- There is no warm-up: the first update follows the first round, as released.
- Neither probability of a random action nor learning rates change, unless `epsilon_steps` and `decay_steps` say so.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite import masks
from qrlsuite.algorithm import BuildModel
from qrlsuite.device import Ahead, Captured, DeviceLanes, upload
from qrlsuite.environment import LaneEnv, arrived
from qrlsuite.options import Since, Tuned
from qrlsuite.population import Adam, DecaySteps, by_seed, chosen_errors, part, prefixed, renew, sweeps
from qrlsuite.replay import Replay
from qrlsuite.seeding import Streams

if TYPE_CHECKING:
    from qrlsuite.compiled.perceptron import Sweep


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DDQNOptions:
    """Options of double deep Q-learning; the defaults are the released settings."""

    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.95
    lr: Annotated[
        float,
        Field(gt=0, description="learning rate of classical parameters"),
        Tuned(2e-4, 1e-2, per_agent=True),
    ] = 5e-4
    quantum_lr: Annotated[
        float,
        Field(gt=0, description="learning rate of quantum parameters"),
        Tuned(2e-4, 1e-2, "quantum", per_agent=True),
    ] = 1e-3
    epsilon: Annotated[
        float,
        Field(ge=0, le=1, description="probability of a random action in training"),
        Tuned(0.02, 0.5, per_agent=True),
    ] = 0.1
    buffer: Annotated[
        int, Field(ge=1, description="transitions held by the replay buffer, per seed"), Tuned(1000, 32_000)
    ] = 2000
    batch: Annotated[int, Field(ge=1, description="transitions per gradient step"), Tuned(16, 256)] = 64
    target_steps: Annotated[
        int,
        Field(ge=1, description="gradient steps between copies to the target"),
        Tuned(125, 8000, per_agent=True),
    ] = 2000
    decay_steps: DecaySteps = None
    epsilon_steps: Annotated[
        int | None,
        Field(
            ge=1,
            description="interactions of a seed over which the probability falls linearly from 1 to epsilon; absent: "
            "it is epsilon from the first on",
        ),
        Since("0.2.0"),
    ] = None


class DDQN:
    """S agents learning by double Q-learning; see `qrlsuite.algorithm.Algorithm` for the contract."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: DDQNOptions,
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
        self.epsilon = np.broadcast_to(np.asarray(options.epsilon), self.S)
        self.target_steps = torch.as_tensor(options.target_steps).long().expand(self.S).to(device)
        self.epoch = 0
        self._numbers = Ahead(self._epoch_numbers)
        self._drawn: dict[str, Tensor] = {}
        """On the device: an epoch's numbers, and its errors."""
        self._captured = Captured(self._round, self._changed, self.online)
        self._hold(torch.zeros((self.S, self.E, self.obs_dim), device=device))

    def _hold(self, observations: Tensor) -> None:
        """Store the observations, followed by masks if any, and create a replay buffer of their size."""
        self.observations, self.seen_dim = observations, observations.shape[2]
        d = self.seen_dim  # `alive` is 1 - terminated
        self.replay = Replay(
            self.S, self.options.buffer, self.device, seen=d, after=d, action=1, reward=1, alive=1
        )

    def start(self) -> None:
        """Reset the environments."""
        first, infos = self.envs.reset()
        self._hold(masks.behind(by_seed(first, self.S, self.device), infos))

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        """Interact and learn for `rounds` rounds; returns the mean squared TD error `loss` (S,)."""
        self.adam.decay(self.epoch * rounds * self.E, self.options.decay_steps)
        if self.envs.on_device is not None:
            errors = self._epoch_on_device(self.envs.on_device, rounds)
        else:
            errors = torch.empty((rounds, self.S, self.options.batch), device=self.device)
            numbers = (each.to(self.device) for each in self._epoch_numbers(rounds, self.epoch))
            for k, (explore, action, draws, found) in enumerate(zip(*numbers, errors)):
                greedy = self.choose(self.observations)
                uniform = masks.drawn(action, self.observations, self.obs_dim, self.streams, self.epoch, k)
                self._interact(torch.where(explore, uniform, greedy))  # (S, E)
                found.copy_(self._learn(draws))
        self.epoch += 1
        losses = errors.square().mean(2).cpu().double().cumsum(0)[-1]  # in the order of rounds
        return {"loss": (losses / rounds).numpy(), **self.adam.gradient_norms()}

    def _epoch_numbers(self, rounds: int, epoch: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw an epoch's exploration (rounds, S, E), twice, and replay positions (rounds, S, batch) in [0, 1)."""
        explore = np.empty((rounds, self.S, self.E), dtype=bool)
        action = np.empty((rounds, self.S, self.E), dtype=np.int64)
        draws = np.empty((rounds, self.S, self.options.batch))
        epsilon = np.broadcast_to(self.epsilon, (rounds, self.S))
        if self.options.epsilon_steps is not None:
            interactions = (epoch * rounds + np.arange(rounds)[:, None]) * self.E
            epsilon = epsilon + (1.0 - epsilon) * np.maximum(
                0.0, 1.0 - interactions / self.options.epsilon_steps
            )
        for s, streams in enumerate(self.streams):
            exploration = streams.numpy("exploration", epoch)
            explore[:, s] = exploration.random((rounds, self.E)) < epsilon[:, s, None]
            action[:, s] = exploration.integers(self.actions, size=(rounds, self.E))
            draws[:, s] = streams.numpy("replay", epoch).random((rounds, self.options.batch))
        return torch.from_numpy(explore), torch.from_numpy(action), torch.from_numpy(draws)

    def _epoch_on_device(self, lanes: DeviceLanes, rounds: int) -> Tensor:
        """Interact and learn for `rounds` rounds without a host read; returns Q(s, a) - y (rounds, S, batch)."""
        explore, action, draws = self._numbers(rounds, self.epoch)
        self._numbers.begin(rounds, self.epoch + 1)
        errors = torch.empty(draws.shape, device=self.device)
        upload(self._drawn, self.device, explore=explore, action=action, draws=draws, errors=errors)
        lanes.begin(rounds)
        stored = self.replay.stored
        self._captured(rounds)
        self.replay.resume(stored + rounds * self.E)
        for chosen in lanes.actions():
            self.envs.step(chosen)
        return self._drawn["errors"]

    def _round(self) -> None:
        """One round on the device: every environment takes a step, and every agent learns."""
        lanes = cast("DeviceLanes", self.envs.on_device)
        k = lanes.state["round"].clone()
        explore, action, draws = (
            self._drawn[n].index_select(0, k)[0] for n in ("explore", "action", "draws")
        )
        chosen = torch.where(explore, action, self.choose(self.observations))
        arrived, reward, terminated = lanes.step(chosen.view(-1))
        self.replay.add(
            seen=self.observations,
            after=arrived.view(self.observations.shape),
            action=chosen,
            reward=reward.view(chosen.shape),
            alive=~terminated.view(chosen.shape),
        )
        self.observations.copy_(lanes.state["observations"].view(self.observations.shape))
        self._drawn["errors"].index_copy_(0, k, self._learn(draws)[None])

    def _changed(self) -> dict[str, Tensor]:
        """Return the tensors that a round on the device changes."""
        count = {} if self.replay.count is None else {"stored": self.replay.count}
        lanes = cast("DeviceLanes", self.envs.on_device)
        return {**self.state_dict(), **self._drawn, **count, **prefixed(lanes=lanes.state)}

    def _interact(self, actions: Tensor) -> None:
        """Step every environment once and store the S x E transitions."""
        lanes = actions.reshape(-1).cpu().numpy()
        after, rewards, terminated, _, infos = self.envs.step(lanes)
        arrival = masks.behind(by_seed(arrived(after, infos), self.S, self.device), infos, arrived=True)
        self.replay.add(
            seen=self.observations, after=arrival, action=lanes, reward=rewards, alive=~terminated
        )
        self.observations = masks.behind(by_seed(after, self.S, self.device), infos) if infos else arrival

    def _learn(self, draws: Tensor) -> Tensor:
        """Make one Adam step of every agent on a batch drawn by `draws` (S, batch); returns Q(s, a) - y (S, batch)."""
        masked = self.seen_dim > self.obs_dim
        whole = None if masked or self.device.type != "cpu" else sweeps(self.online, self.target)
        errors = self._errors(draws) if whole is None else self._swept_errors(draws, *whole)
        self.adam.step()
        renew(self.target, self.online, self.adam.steps, self.target_steps)
        return errors

    def _errors(self, draws: Tensor) -> Tensor:
        """Return Q(s, a) - y (S, batch), and set its gradients."""
        batch = self.replay.batch(draws)
        action, reward, alive = (batch[name].squeeze(2) for name in ("action", "reward", "alive"))
        seen, after = (masks.observed(batch[name], self.obs_dim) for name in ("seen", "after"))
        with torch.no_grad():
            best = self.choose(batch["after"])
            following = self.target(after).gather(2, best[..., None]).squeeze(2)
        y = reward + self.options.gamma * alive * following
        return chosen_errors(self.online, seen, action.long(), y)

    def _swept_errors(self, draws: Tensor, online: Sweep, target: Sweep) -> Tensor:
        """Like `_errors`, where networks are compiled sweeps; the bits are equal."""
        batch = self.replay.arrays(draws.numpy())
        action, reward, alive = (batch[name][..., 0] for name in ("action", "reward", "alive"))
        following = target.chosen(batch["after"], online.best(batch["after"]))
        y = reward + self.options.gamma * alive * following
        return torch.from_numpy(online.chosen_errors(batch["seen"], action.astype(np.int64), y))

    def choose(self, seen: Tensor) -> Tensor:
        """Return the greedy actions (S, B) for observations (S, B, obs), and perhaps masks behind them."""
        return masks.best(self.online, seen, self.obs_dim)

    def act(
        self, observations: NDArray[np.float32], infos: Mapping[str, Any] = masks.NOTHING
    ) -> NDArray[np.int64]:
        """Return the greedy actions (S, B) for observations (S, B, obs), none that `infos` forbid."""
        seen = masks.behind(torch.from_numpy(observations).to(self.device), infos)
        result: NDArray[np.int64] = self.choose(seen).cpu().numpy()
        return result

    def policy_state(self) -> dict[str, Tensor]:
        """Return the online network's parameters and buffers."""
        return dict(self.online.state_dict())

    def state_dict(self) -> dict[str, Tensor]:
        """Return networks, optimizer, replay buffer, current observations and counters, seed-first."""
        return {
            **prefixed(
                online=self.online.state_dict(), target=self.target.state_dict(), adam=self.adam.state_dict()
            ),
            "buffer": self.replay.rows,
            "observations": self.observations,
            "counters": torch.tensor([[self.replay.stored, self.epoch]] * self.S, dtype=torch.int64),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.online.load_state_dict(part(state, "online"))
        self.target.load_state_dict(part(state, "target"))
        self.adam.load_state_dict(part(state, "adam"))
        self._hold(state["observations"].clone().to(self.device))
        self.replay.rows.copy_(state["buffer"])
        stored, self.epoch = (int(v) for v in state["counters"][0])
        self.replay.resume(stored)
