"""The replay buffer of `dqn.py`, in a file beside it."""

import numpy as np
import torch


class ReplayBuffer:
    def __init__(self, size, inputs):
        self.size, self.count = size, 0
        self.obs, self.next_obs = np.zeros((2, size, inputs), np.float32)
        self.actions, self.rewards, self.dones = np.zeros(size, np.int64), *np.zeros((2, size), np.float32)

    def add(self, obs, next_obs, action, reward, done):
        place = self.count % self.size
        self.obs[place], self.next_obs[place] = obs, next_obs
        self.actions[place], self.rewards[place], self.dones[place] = action, reward, done
        self.count += 1

    def sample(self, rng, batch):
        at = rng.integers(min(self.count, self.size), size=batch)
        parts = (self.obs, self.next_obs, self.actions, self.rewards, self.dones)
        return [torch.from_numpy(part[at]) for part in parts]
