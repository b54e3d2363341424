"""Q-learning with a table, which builds no network: its state is where the largest number of an observation stands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite.environment import arrived
from qrlsuite.specs import AlgorithmSpec


@dataclass(frozen=True)
class Options:
    """Options of the table."""

    lr: Annotated[float, Field(gt=0, le=1, description="share of the error in a step")] = 0.2
    gamma: Annotated[float, Field(ge=0, le=1, description="discount factor")] = 0.9


class Tabular:
    def __init__(self, envs: Any, build_model: Any, options: Options, streams: Any, device: Any) -> None:
        self.envs, self.options, self.streams = envs, options, streams
        self.S, self.E = len(streams), envs.num_envs // len(streams)
        states = int(np.prod(envs.single_observation_space.shape))
        drawn = [s.numpy("table").normal(size=(states, int(envs.single_action_space.n))) for s in streams]
        self.table = torch.from_numpy(0.01 * np.stack(drawn))
        self.places = torch.zeros((self.S, self.E), dtype=torch.int64)
        self.epoch = 0

    def _where(self, lanes: NDArray[Any]) -> Tensor:
        return torch.from_numpy(lanes.reshape(self.S, self.E, -1).argmax(2))

    def start(self) -> None:
        self.places = self._where(self.envs.reset()[0])

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        actions = np.stack(
            [
                s.numpy("exploration", self.epoch).integers(self.table.shape[2], size=(rounds, self.E))
                for s in self.streams
            ]
        )
        seeds, errors = torch.arange(self.S), torch.zeros(self.S, dtype=torch.float64)
        for k in range(rounds):
            after, reward, terminated, _, infos = self.envs.step(actions[:, k].reshape(-1))
            beyond = self._where(arrived(after, infos))
            reward, alive = (torch.from_numpy(v.reshape(self.S, self.E)) for v in (reward, 1.0 - terminated))
            for e in range(self.E):
                place = seeds, self.places[:, e], torch.from_numpy(actions[:, k, e])
                best = self.table[seeds, beyond[:, e]].max(1).values
                error = reward[:, e] + self.options.gamma * alive[:, e] * best - self.table[place]
                self.table[place] += self.options.lr * error
                errors += error.abs()
            self.places = self._where(after)
        self.epoch += 1
        return {"error": (errors / rounds / self.E).numpy()}

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        seeds = np.arange(self.S)[:, None]
        return self.table.numpy()[seeds, observations.argmax(2)].argmax(2)

    def policy_state(self) -> dict[str, Tensor]:
        return {"table": self.table}

    def state_dict(self) -> dict[str, Tensor]:
        return {"table": self.table, "places": self.places, "epoch": torch.full((self.S,), self.epoch)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.table.copy_(state["table"])
        self.places, self.epoch = state["places"].clone(), int(state["epoch"][0])


SPEC = AlgorithmSpec(
    "tabular", "Q-learning with a table", options=f"{__name__}:Options", factory=f"{__name__}:Tabular"
)
