"""DDQN against hand cases, and its first update against numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from qrlsuite.plugins.algorithms.ddqn import DDQN
from qrlsuite.population import Adam, sweeps
from tests.algorithms.worlds import Clock, Contexts, Group, Perceptron, Table


def tabular(transition: list[float]) -> DDQN:
    """One agent with two states and two actions, one transition in its buffer: s (2), s' (2), a, r, alive."""
    made: DDQN = Group("ddqn", [0], Contexts(1), batch=1, gamma=0.5, buffer=1).algorithm
    made.obs_dim = 2
    made._hold(torch.zeros(1, 1, 2))
    made.online = Table(torch.tensor([[[0.5, -3.0], [1.0, 2.0]]]))
    made.target = Table(torch.tensor([[[7.0, 7.0], [10.0, 5.0]]]))
    made.adam = Adam(made.online, 1e-3, 1e-3)
    made.replay.rows, made.replay.stored = torch.tensor([[transition]], dtype=torch.float32), 1
    return made


def loss(made: DDQN) -> float:
    return float(made._learn(torch.zeros((1, 1), dtype=torch.float64))[0, 0] ** 2)


def test_the_online_network_picks_and_the_target_network_rates() -> None:
    """Online prefers action 1 at s' (2 > 1), which the target rates 5: y = 1 + 0.5 * 5, not 1 + 0.5 * 10."""
    assert loss(tabular([1, 0, 0, 1, 0, 1, 1])) == pytest.approx((0.5 - 3.5) ** 2)


def test_nothing_follows_a_termination() -> None:
    assert loss(tabular([1, 0, 0, 1, 1, 1, 0])) == pytest.approx((-3.0 - 1.0) ** 2)


def test_first_update_is_that_of_an_independent_computation() -> None:
    group = Group("ddqn", [3, 4], Contexts(2), batch=8, buffer=20, lr=2e-3, gamma=0.9)
    made: DDQN = group.algorithm
    generator = torch.Generator().manual_seed(1)
    rows = made.replay.rows
    rows[:], made.replay.stored = torch.randn(rows.shape, generator=generator), 20
    rows[..., 8] = torch.randint(3, (2, 20), generator=generator)
    rows[..., 10] = torch.randint(2, (2, 20), generator=generator)
    for parameter in made.target.parameters():
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    picked = torch.randint(20, (2, 8), generator=generator)
    online = [Perceptron(made.online, s) for s in range(2)]
    target = [Perceptron(made.target, s) for s in range(2)]
    losses = made._learn((picked + 0.5).double() / 20).square().mean(1).numpy()
    for s in range(2):
        batch = rows[s].numpy().astype(np.float64)[picked[s].numpy()]
        states, following, (action, reward, alive) = batch[:, :4], batch[:, 4:8], batch[:, 8:].T
        action = action.astype(int)
        best = online[s](following).argmax(1)
        y = reward + 0.9 * alive * target[s](following)[range(8), best]
        values = online[s](states)
        error = values[range(8), action] - y
        assert losses[s] == pytest.approx((error**2).mean(), rel=1e-5)
        d = np.zeros_like(values)
        d[range(8), action] = 2 * error / 8
        online[s].assert_updated(made.online, d, 2e-3, s)


def test_steps_without_autograd_have_its_bits() -> None:
    compiled, plain = (
        Group("ddqn", [0, 1], Contexts(2), batch=50, target_steps=5, buffer=30).start().algorithm
        for _ in range(2)
    )
    for network in (plain.online, plain.target):
        network.register_forward_hook(lambda *given: None)  # which a compiled pass would not call
    assert (sweeps(compiled.online, compiled.target) is None, sweeps(plain.online, plain.target)) == (
        False,
        None,
    )
    losses = [each.train_epoch(20)["loss"] for each in (compiled, plain)]
    assert (losses[0] == losses[1]).all()
    for ours, theirs in zip(compiled.state_dict().values(), plain.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_target_is_copied_after_every_so_many_gradient_steps() -> None:
    made: DDQN = Group("ddqn", [0], Contexts(2), batch=4, target_steps=3).start().algorithm
    initial = {k: v.clone() for k, v in made.target.state_dict().items()}
    history = [{k: v.clone() for k, v in made.online.state_dict().items()}]
    held = []
    for _ in range(7):
        made.train_epoch(1)
        history.append({k: v.clone() for k, v in made.online.state_dict().items()})
        state = made.target.state_dict()
        held.append([i for i, h in enumerate(history) if all(torch.equal(h[k], state[k]) for k in h)])
    assert held == [[0], [0], [3], [3], [3], [6], [6]]
    assert all(torch.equal(initial[k], history[0][k]) for k in initial)


@pytest.mark.parametrize(("epsilon", "low", "high"), [(0.0, 0, 0), (0.3, 0.17, 0.23), (1.0, 0.63, 0.70)])
def test_epsilon_is_the_probability_of_any_action(epsilon: float, low: float, high: float) -> None:
    """Of three actions, two thirds of the random ones are not the greedy one."""
    group = Group("ddqn", [0], Contexts(20), epsilon=epsilon, lr=1e-12, batch=2).start()
    group.algorithm.online.get_parameter("b1").data[:] = torch.tensor([0.0, 50.0, 0.0])
    for _ in range(2):
        group.algorithm.train_epoch(75)
    chosen = np.concatenate(group.envs.history)  # type: ignore[attr-defined]
    assert low <= (chosen != 1).mean() <= high
    if epsilon == 1.0:
        assert not np.array_equal(*np.split(chosen, 2)), "drawn anew in every epoch"
        np.testing.assert_allclose(np.bincount(chosen, minlength=3) / 3000, 1 / 3, atol=0.03)


def test_exploration_and_learning_fall_to_their_ends() -> None:
    """After 2 of 4 epochs, halfway: a half of the actions are drawn; after 4, none, and no learning."""
    group = Group(
        "ddqn", [0], Contexts(20), epsilon=0.0, batch=2, lr=1e-12, decay_steps=6000, epsilon_steps=6000
    )
    made: DDQN = group.start().algorithm
    made.online.get_parameter("b1").data[:] = torch.tensor([0.0, 50.0, 0.0])
    for left in (1.0, 0.75, 0.5, 0.25, 0.0, 0.0):
        made.train_epoch(75)
        assert made.adam.rates["w0"] == pytest.approx(left * 1e-12)
    other = [(each != 1).mean() for each in np.split(np.concatenate(group.envs.history), 6)]  # type: ignore[attr-defined]
    np.testing.assert_allclose(other, np.array([0.875, 0.625, 0.375, 0.125, 0, 0]) * 2 / 3, atol=0.05)
    assert other[4:] == [0, 0]


def test_buffer_wraps_around() -> None:
    """Environment e's step t has reward t + 1: after three rounds of two, the sixth transition replaces the first."""
    group = Group("ddqn", [0], Clock([9, 9]), buffer=5, batch=2).start()
    group.algorithm.train_epoch(3)
    rewards, lanes = group.algorithm.replay.rows[0, :, 7], group.algorithm.replay.rows[0, :, 1]
    assert rewards.tolist() == [3, 1, 2, 2, 3]
    assert lanes.tolist() == pytest.approx([0.1, 0.1, 0, 0.1, 0])
    assert group.algorithm.replay.stored == 6


def test_batches_are_drawn_from_what_the_buffer_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    group = Group("ddqn", [0, 1], Clock([9] * 4), buffer=7, batch=64).start()
    replay, seen = group.algorithm.replay, []
    draw = replay.batch

    def spy(draws: torch.Tensor) -> dict[str, torch.Tensor]:
        batch: dict[str, torch.Tensor] = draw(draws)
        held = replay.rows[:, : replay.filled].clone()
        seen.append((batch, held))
        return batch

    monkeypatch.setattr(replay, "batch", spy)
    group.algorithm.train_epoch(5)
    for (batch, held), filled in zip(seen, (2, 4, 6, 7, 7)):
        rows = torch.cat([batch[name] for name in replay.columns], 2)
        assert rows.shape == (2, 64, 9)
        for s in range(2):
            assert set(map(tuple, rows[s].tolist())) == set(map(tuple, held[s].tolist()))
            assert held.shape[1] == filled


@pytest.mark.parametrize("cut", [False, True])
def test_an_episode_ends_where_it_arrived_not_where_the_next_begins(cut: bool) -> None:
    group = Group("ddqn", [0], Clock([2], cut), buffer=4, batch=2).start()
    group.algorithm.train_epoch(3)
    rows = group.algorithm.replay.rows[0]
    assert rows[:3, 0].tolist() == pytest.approx([0.0, 0.1, 0.0])  # where each step began
    assert rows[:3, 3].tolist() == pytest.approx([0.1, 0.2, 0.1])  # where it arrived
    assert rows[:3, 8].tolist() == [1, 1 if cut else 0, 1]  # only a termination ends the future
