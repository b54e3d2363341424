"""Global random generators: `build` may draw from them, and no other call into a plugin may move one."""

from __future__ import annotations

import copy
import random
import threading

import numpy as np
import pytest
import torch
from torch import nn

from qrlsuite.errors import PluginError
from qrlsuite.training.fences import FINE_CALLS, Fence, seeded

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
def test_a_call_that_moves_a_generator_is_named(name: str) -> None:
    fence = Fence(closed=True, alone=True)
    with fence.around("model 'acme', forward"):
        pass
    said = f"^model 'acme', forward: it moved {name}, which"
    with pytest.raises(PluginError, match=said), fence.around("model 'acme', forward"):
        DRAWS[name]()
    with Fence(closed=False).around("model 'mlp', forward"):
        DRAWS[name]()


def test_later_calls_are_watched_by_the_epoch() -> None:
    fence = Fence(closed=True, alone=True)
    for _ in range(FINE_CALLS):
        with fence.around("environment 'acme', step"):
            pass
    step = fence.around("environment 'acme', step")
    with pytest.raises(PluginError, match=r"^epoch: it moved"), fence.around("epoch", fine=False), step:
        random.random()


def test_passes_of_copies_are_watched_too() -> None:
    class Noisy(nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return x + torch.rand(())

    fence, model = Fence(closed=True, alone=True), Noisy()
    fence.watch(model, "model 'acme', forward")
    for each in (model, copy.deepcopy(model)):
        with pytest.raises(PluginError, match=r"^model 'acme', forward"):
            each(torch.zeros(1))


def test_other_threads_may_draw() -> None:
    """As those of a tracker may; torch's generator they leave alone."""
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    try:
        with Fence(closed=True).around("call"):
            random.random()
        with pytest.raises(PluginError, match="torch's default"), Fence(closed=True).around("call"):
            torch.rand(())
    finally:
        ended.set()
        thread.join()
