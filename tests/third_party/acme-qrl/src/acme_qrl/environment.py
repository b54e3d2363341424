"""ChannelHop: all channels but one are jammed, and the free one moves on by one at every step."""

from typing import Annotated

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """Options of `channel-hop`: the keyword arguments of the environment."""

    channels: Annotated[int, Field(ge=3, description="number of channels, in a circle")] = 5
    steps: Annotated[int, Field(ge=1, description="steps of an episode")] = 40


class ChannelHop(gymnasium.Env):
    """Action: the channel to send on. Observation: the last two free channels, in [0, 1].

    Reward 1 where the channel is free. `info["score"]`: the share of messages that arrived.
    """

    def __init__(self, channels=5, steps=40):
        self.channels, self.steps = channels, steps
        self.action_space = Discrete(channels)
        self.observation_space = Box(0.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.free = int(self.np_random.integers(self.channels))
        self.direction = int(self.np_random.choice([-1, 1]))
        self.taken, self.arrived = 0, 0
        return self._observe(), {}

    def step(self, action):
        self.free = (self.free + self.direction) % self.channels
        reward = float(action == self.free)
        self.taken, self.arrived = self.taken + 1, self.arrived + int(reward)
        ended = self.taken == self.steps
        info = {"score": self.arrived / self.steps} if ended else {}
        return self._observe(), reward, ended, False, info

    def _observe(self):
        before = (self.free - self.direction) % self.channels
        return np.array([before, self.free], dtype=np.float32) / np.float32(self.channels - 1)
