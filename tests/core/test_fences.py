"""Global random generators: `build` may draw from them, and a pass may move none."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from qrlsuite.training.fences import moved, seeded, states

DRAWS = {
    "Python's `random`": random.random,
    "numpy's `np.random`": np.random.rand,
    "torch's default generator": lambda: torch.rand(()),
}


def test_numbers_follow_from_the_seed_and_states_are_given_back() -> None:
    before = [draw() for draw in DRAWS.values()], random.getstate()
    drawn = []
    for seed in (3, 3, 4):
        with seeded(seed):
            drawn.append([float(draw()) for draw in DRAWS.values()])
    assert drawn[0] == drawn[1]
    assert all(a != b for a, b in zip(drawn[0], drawn[2]))
    assert random.getstate() == before[1]
    with seeded(2**128 - 1):  # keys of streams have 128 bits
        pass


@pytest.mark.parametrize("name", DRAWS)
def test_a_generator_that_moved_is_named(name: str) -> None:
    before = states()
    assert moved(before) == []
    DRAWS[name]()
    assert moved(before) == [name]
