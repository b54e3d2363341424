"""Deep recurrent Q-learning and the unit that remembers: by independent computations, and on a task of memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import resolve
from qrlsuite.plugins.algorithms.drqn import DRQN
from qrlsuite.plugins.models.recurrent import GRU, LSTM, RecurrentOptions, population
from qrlsuite.testing.group import Toy
from qrlsuite.training.trainer import Trainer
from tests.algorithms.worlds import Group

LANES = 2


def made(model: str = "gru", seeds: int = 2, **settings: Any) -> DRQN:
    width: dict[str, Any] = {"width": 6} if model == "gru" else {"width": 6, "depth": 1}
    toy = Toy(seeds * LANES, hidden=True)
    algorithm: DRQN = Group("drqn", range(seeds), toy, model, width, **settings).start().algorithm
    return algorithm


@pytest.mark.parametrize(("unit", "cell"), [(GRU, nn.GRUCell), (LSTM, nn.LSTMCell)])
def test_the_unit_is_that_of_torch_and_a_population_is_each_of_them(unit: Any, cell: Any) -> None:
    units = [unit(4, 3, RecurrentOptions(width=6), torch.Generator().manual_seed(s)) for s in range(3)]
    together, x, state = (
        population(units, RecurrentOptions(width=6)),
        torch.randn(3, 5, 4),
        torch.randn(3, 5, units[0].remembers),
    )
    outputs, after = together(x, state)
    for s, one in enumerate(units):
        theirs = cell(4, 6)
        theirs.load_state_dict(
            {
                "weight_ih": one.from_input.weight, "bias_ih": one.from_input.bias,
                "weight_hh": one.from_state.weight, "bias_hh": one.from_state.bias,
            }
        )  # fmt: skip
        before = tuple(torch.chunk(state[s], 2, -1)) if unit is LSTM else state[s]
        kept = theirs(x[s], before)
        torch.testing.assert_close(after[s], torch.cat(kept, -1) if unit is LSTM else kept)
        torch.testing.assert_close(outputs[s], one.last(after[s, :, :6]))
        torch.testing.assert_close(one(x[s]), one(x[s], torch.zeros_like(state[s]))[0])


class Unit:
    """Seed s of a population of units in numpy and float64."""

    def __init__(self, units: nn.Module, s: int) -> None:
        self.p = {name: value[s].numpy().astype(np.float64) for name, value in units.state_dict().items()}

    def __call__(self, x: NDArray[Any], h: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        p = self.p
        xr, xz, xc = np.split(x @ p["from_input.weight"].T + p["from_input.bias"], 3, 1)
        hr, hz, hc = np.split(h @ p["from_state.weight"].T + p["from_state.bias"], 3, 1)
        r, z = 1 / (1 + np.exp(-(xr + hr))), 1 / (1 + np.exp(-(xz + hz)))
        after = (1 - z) * np.tanh(xc + r * hc) + z * h
        return after @ p["last.weight"].T + p["last.bias"], after


@pytest.mark.parametrize("burn_in", [0, 2])
def test_the_loss_is_that_of_an_independent_computation(burn_in: int) -> None:
    """Sequences of 5 steps, in which an episode begins in the middle, ends by termination, or by a limit."""
    drqn = made(gamma=0.9, burn_in=burn_in, length=5 - burn_in)
    drqn.target.load_state_dict({name: 1.3 * value for name, value in drqn.online.state_dict().items()})
    source = torch.Generator().manual_seed(4)
    B, L, d = 3, 5, drqn.obs_dim
    rows = torch.randn((2, B, L, drqn.columns), generator=source)
    rows[..., 2 * d] = torch.randint(3, (2, B, L), generator=source).float()
    rows[..., 2 * d + 2] = 1.0
    rows[:, 0, 1, 2 * d + 2] = 0.0  # terminated at step 1, so that an episode begins at step 2
    rows[..., 2 * d + 3] = 0.0
    rows[:, 0, 2, 2 * d + 3] = rows[:, 1, 3, 2 * d + 3] = 1.0
    expected = []
    for s in range(2):
        online, target = Unit(drqn.online, s), Unit(drqn.target, s)
        h, g, errors = np.zeros((B, 6)), np.zeros((B, 6)), []
        for k in range(L):
            row = rows[s, :, k].numpy().astype(np.float64)
            going_on = 1 - row[:, 2 * d + 3 :]
            q, h = online(row[:, :d], h * going_on)
            _, g = target(row[:, :d], g * going_on)
            best = online(row[:, d : 2 * d], h)[0].argmax(1)
            worth = target(row[:, d : 2 * d], g)[0][np.arange(B), best]
            y = row[:, 2 * d + 1] + 0.9 * row[:, 2 * d + 2] * worth
            if k >= burn_in:
                errors.append(q[np.arange(B), row[:, 2 * d].astype(int)] - y)
        expected.append(np.mean(np.square(errors)))
    before = {name: value.clone() for name, value in drqn.online.state_dict().items()}
    np.testing.assert_allclose(drqn._learn(rows).numpy(), expected, rtol=1e-4)
    assert not any(torch.equal(value, drqn.online.state_dict()[name]) for name, value in before.items())


def test_sequences_are_consecutive_steps_of_one_environment() -> None:
    drqn = made("mlp", buffer=20, burn_in=1, length=2)
    assert drqn.capacity == 10
    source = np.random.default_rng(0)
    for stored in range(1, 25):
        for e in range(LANES):
            drqn.buffer[:, e, drqn.stored % 10] = 100.0 * e + stored
        drqn.stored += 1
        if stored >= 3:
            draws = torch.from_numpy(source.random((2, 2, 200)))
            seen = drqn._sequences(draws)[..., 0]
            assert torch.equal(seen[..., 1:] - seen[..., :-1], torch.ones(2, 200, 2))
            steps = seen % 100
            assert steps.max() == stored
            assert steps.min() == max(1, stored - 9)
            assert set((seen[..., 0] // 100).unique().tolist()) == {0.0, 1.0}


def test_it_remembers_what_an_episode_showed_first() -> None:
    """The context is shown at an episode's first step alone: without a memory, two of three later choices are wrong."""
    rewards = {}
    for model in ("gru", "mlp"):
        settings = {"lr": 1e-2, "gamma": 0.0, "length": 8, "burn_in": 2}
        drqn = made(model, 2, **settings)
        drqn.train_epoch(350)
        total, envs = np.zeros(4), drqn.envs
        drqn.options = type(drqn.options)(epsilon=0.0, batch=1, **settings)
        step = envs.step

        def counted(actions: NDArray[np.int64], step: Any = step, total: Any = total) -> Any:
            seen = step(actions)
            total += seen[1]
            return seen

        envs.step = counted  # type: ignore[method-assign]
        drqn.train_epoch(100)
        rewards[model] = total.reshape(2, LANES).sum(1) / (100 * LANES)
    assert rewards["gru"].min() > 0.9
    assert rewards["mlp"].max() < 0.7


def test_a_model_that_remembers_is_not_made_to_forget(tiny_task: str) -> None:
    with pytest.raises(
        OptionError, match=r"'ddqn' would make it forget: take one of drqn, ppo: qrlsuite run 'drqn gru'"
    ):
        Trainer(resolve(tiny_task, "gru", "ddqn"), [0])
    trainer = Trainer(resolve(tiny_task, "gru", "drqn"), [0, 1])
    trainer.start()
    epoch = trainer.train_epoch()
    assert np.isfinite(epoch.scores).all()
    assert "remembered" not in "".join(trainer.policy())
