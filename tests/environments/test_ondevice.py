"""Environments on a device, on the CPU's tensors: they play ahead of the lanes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from qrlsuite import registry, specs

CASES = {
    "beam6g": {"steps": 7},
    "beam6g stack": {"steps": 5, "stack": 3, "physics": "text", "degree": 6},
    "cartpole": {"steps": 9},
    "cartpole bounds": {"steps": 30, "normalization": "bounds"},
    "cartpole arctan": {"steps": 30, "normalization": "arctan"},
    "clifford": {"steps": 6, "scramble": 2},
    "channel": {"steps": 4},
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("autoreset", [True, False])
def test_steps_on_a_device_are_those_that_the_lanes_make_afterwards(case, autoreset):
    """Three times 12 steps; without autoreset one episode."""
    spec = registry.get(specs.EnvironmentSpec, case.split()[0])
    lanes = specs.resolve(spec.vector)(specs.resolve(spec.options)(**CASES[case]), 6)
    lanes.seed_lanes([np.random.default_rng([3, g]) for g in range(6 if autoreset else 2)])
    lanes.autoreset = autoreset
    seen, _ = lanes.reset()
    ahead = specs.resolve(spec.device)(lanes, torch.device("cpu"))
    draws, choices = np.random.default_rng(1), int(lanes.single_action_space.n)
    ends = 0
    for _ in range(3 if autoreset else 1):
        steps = 12 if autoreset else lanes.options.steps
        ahead.begin(steps)
        assert np.array_equal(ahead.state["observations"].numpy(), seen)
        actions = draws.integers(choices, size=(steps, 6))
        found = [(*ahead.step(torch.from_numpy(row)), ahead.state["observations"].clone()) for row in actions]
        assert np.array_equal(ahead.actions(), actions)
        for row, step in zip(actions, found):
            seen, rewards, terminated, truncated, infos = lanes.step(row)
            done = terminated | truncated
            arrived = np.where(done[:, None], infos["final_obs"], seen) if done.any() else seen
            for one, other in zip(step[: 4 if autoreset else 3], (arrived, rewards, terminated, seen)):
                assert np.array_equal(one.numpy(), other)
            ends += done.sum()
    assert ends
