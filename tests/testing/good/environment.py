"""A walk that keeps the rules of environments, which the tests beside this folder break one by one."""

from __future__ import annotations

from typing import Annotated, Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    size: Annotated[int, Field(ge=2, description="number of places")] = 10
    steps: Annotated[int, Field(ge=1, description="steps of an episode")] = 20


class Walk(gymnasium.Env[NDArray[np.float32], np.int64]):
    def __init__(self, size: int = 10, steps: int = 20) -> None:
        self.size, self.steps = size, steps
        self.action_space = Discrete(3)
        self.observation_space = Box(0.0, 1.0, (2,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        place, goal = self.np_random.integers(self.size, size=2)
        self.place, self.goal = int(place), int(goal)
        self.step_count, self.received = 0, 0.0
        self.best = sum(
            self.reward(max(0, abs(self.place - self.goal) - k)) for k in range(1, self.steps + 1)
        )
        return self.observe(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        self.place = min(max(self.place + int(action) - 1, 0), self.size - 1)
        reward = self.reward(abs(self.place - self.goal))
        self.received += reward
        self.step_count += 1
        ended = self.step_count == self.steps
        info = {"score": min(1.0, self.received / self.best)} if ended else {}
        return self.observe(), reward, ended, False, info

    def reward(self, distance: int) -> float:
        return 1.0 - distance / (self.size - 1)

    def observe(self) -> NDArray[np.float32]:
        places = np.array([self.place, self.goal], dtype=np.float32)
        return places / np.float32(self.size - 1)
