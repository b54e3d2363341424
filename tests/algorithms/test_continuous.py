"""Algorithms of continuous actions: their formulas by independent computations, and that they learn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import distributions

from qrlsuite.plugins.algorithms.ppo import Choices, Gaussian
from qrlsuite.plugins.algorithms.sac import SAC, log_probabilities
from qrlsuite.plugins.algorithms.td3 import TD3
from qrlsuite.testing.group import Toy
from tests.algorithms.worlds import Contexts, Group, Perceptron, log_softmax

LANES = 2


def made(name: str, kind: str = "box", seeds: int = 2, **settings: Any) -> Any:
    group = Group(name, range(seeds), Toy(seeds * LANES, kind), **settings).start()
    return group.algorithm


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_log_probabilities_of_squashed_normals() -> None:
    mean, log_spread, noise = normal(2, 5, 3), 0.5 * normal(2, 5, 3, seed=1), normal(2, 5, 3, seed=2)
    u = mean + noise * log_spread.exp()
    base = distributions.Normal(mean.double(), log_spread.double().exp())
    squashed = distributions.TransformedDistribution(base, [distributions.TanhTransform(cache_size=1)])
    expected = squashed.log_prob(torch.tanh(u.double())).sum(2)
    torch.testing.assert_close(
        log_probabilities(u, noise, log_spread).double(), expected, rtol=1e-4, atol=1e-4
    )
    far = log_probabilities(torch.full((1, 1, 1), 40.0), torch.zeros(1, 1, 1), torch.zeros(1, 1, 1))
    # log N(0) - log(1 - tanh(40)^2), where tanh rounds to 1: 1 - tanh(u)^2 = 4 e^(-2 u) for large u
    np.testing.assert_allclose(far.item(), -0.5 * np.log(2 * np.pi) - np.log(4) + 80, rtol=1e-6)


def test_gaussian_policy_of_ppo_is_the_normal_of_torch() -> None:
    policy = Gaussian(spaces.Box(-1, 3, (2,)), 3, 0.3)
    policy.log_spread.data += normal(3, 2)
    outputs, u = normal(3, 7, 2, seed=1), normal(3, 7, 2, seed=2)
    expected = distributions.Normal(outputs, policy.log_spread.exp()[:, None])
    log_probs, entropies = policy.judge(outputs, u)
    torch.testing.assert_close(log_probs, expected.log_prob(u).sum(2))
    torch.testing.assert_close(entropies, expected.entropy().sum(2))
    torch.testing.assert_close(policy.draw(outputs, u), outputs + u * policy.log_spread.exp()[:, None])
    assert policy.lanes(torch.tensor([[0.0, 5.0], [-1.0, float("nan")]])).tolist() == [[1, 3], [-1, 1]]


@pytest.mark.parametrize(
    ("space", "sizes"),
    [
        (spaces.MultiDiscrete([3, 2]), [3, 2]),
        (spaces.MultiBinary(3), [2, 2, 2]),
        (spaces.MultiDiscrete([[2], [4]]), [2, 4]),
    ],
)
def test_choices_of_ppo_are_independent_softmaxes(space: Any, sizes: list[int]) -> None:
    policy = Choices(space)
    assert (policy.sizes, policy.outputs, policy.numbers) == (sizes, sum(sizes), len(sizes))
    outputs = normal(2, 5, sum(sizes))
    chosen = policy.draw(outputs, torch.zeros_like(outputs))
    parts = [distributions.Categorical(logits=part) for part in torch.split(outputs, sizes, 2)]
    log_probs, entropies = policy.judge(outputs, chosen)
    torch.testing.assert_close(log_probs, sum(part.log_prob(chosen[..., k]) for k, part in enumerate(parts)))
    torch.testing.assert_close(entropies, sum(part.entropy() for part in parts))
    lanes = policy.lanes(chosen.reshape(10, -1))
    assert lanes.shape == (10, *space.shape)
    assert all(space.contains(action) for action in lanes)


def rows(algorithm: Any, count: int, discrete: bool = False) -> dict[str, torch.Tensor]:
    """Transitions (S, count, ...), every third of them an end."""
    S, n = algorithm.S, algorithm.obs_dim
    action = torch.tanh(normal(S, count, 2, seed=3))
    if discrete:
        action = torch.arange(count).remainder(3).float().expand(S, count)[..., None]
    alive = (torch.arange(count).remainder(3) > 0).float().expand(S, count)[..., None]
    return {
        "observation": normal(S, count, n, seed=1), "arrived": normal(S, count, n, seed=2), "action": action,
        "reward": normal(S, count, 1, seed=4), "alive": alive,
    }  # fmt: skip


def q(critics: Any, s: int, *inputs: torch.Tensor) -> list[NDArray[np.float64]]:
    x = torch.cat([each[s] for each in inputs], 1).numpy()
    return [Perceptron(critic, s)(x) for critic in critics]


def test_first_updates_of_td3_are_those_of_an_independent_computation() -> None:
    td3: TD3 = made("td3", gamma=0.9, lr=2e-3, target_noise=0.3, target_clip=0.4, tau=0.1)
    batch, noise = rows(td3, 12), normal(2, 12, 2, seed=5)
    agents = [[Perceptron(critic, s) for critic in td3.critics] for s in range(2)]
    wanted, targets = [], []
    for s in range(2):
        arrived = batch["arrived"][s].numpy()
        shift = np.clip(0.3 * noise[s].numpy(), -0.4, 0.4)
        action = np.clip(np.tanh(Perceptron(td3.target_actor, s)(arrived)) + shift, -1, 1)
        least = np.minimum(*q(td3.target_critics, s, batch["arrived"], torch.tensor(np.stack([action] * 2))))
        y = batch["reward"][s].numpy() + 0.9 * batch["alive"][s].numpy() * least
        errors = [value - y for value in q(td3.critics, s, batch["observation"], batch["action"])]
        wanted.append(np.mean([np.mean(error**2) for error in errors]))
        targets.append(errors)
        for agent in agents[s]:
            agent(torch.cat([batch["observation"][s], batch["action"][s]], 1).numpy())
    np.testing.assert_allclose(td3._learn_values(batch, noise).numpy(), wanted, rtol=1e-4)
    for s in range(2):
        for agent, critic, error in zip(agents[s], td3.critics, targets[s]):
            agent.assert_updated(critic, 2 * error / 12, 2e-3, s)
    before = {name: value.clone() for name, value in td3.state_dict().items()}
    values = td3._learn_policy(batch["observation"]).numpy()
    for s in range(2):
        seen = batch["observation"][s].numpy()
        old = Perceptron(td3.actor, s)
        for name in ("w0", "b0", "w1", "b1"):
            setattr(old, name, before[f"actor.{name}"][s].numpy().astype(np.float64))
        action = torch.tensor(np.stack([np.tanh(old(seen))] * 2))
        np.testing.assert_allclose(
            values[s], q(td3.critics, s, batch["observation"], action)[0].mean(), rtol=1e-4
        )
    after = td3.state_dict()
    for name, value in before.items():
        part, _, rest = name.partition(".")
        if part in ("critics", "critic_adam0", "critic_adam1"):
            assert torch.equal(after[name], value), f"the actor's step changes {name}"
        if part == "actor":
            assert not torch.equal(after[name], value)
        if part.startswith("target"):
            followed = after[f"{part.removeprefix('target_')}.{rest}"]
            torch.testing.assert_close(after[name], value + 0.1 * (followed - value))


def test_td3_begins_uniformly_and_delays_its_actor() -> None:
    td3: TD3 = made("td3", warm_up=9, batch=4, delay=3)
    before = {name: value.clone() for name, value in td3.policy_state().items()}
    first = td3.train_epoch(4)
    assert td3.replay.stored == 8
    assert np.isnan(first["value_loss"]).all(), "8 transitions are fewer than 9"
    td3.train_epoch(2)
    assert td3.steps == 2
    assert all(torch.equal(before[name], value) for name, value in td3.policy_state().items())
    metrics = td3.train_epoch(1)
    assert td3.steps == 3
    assert np.isfinite(metrics["value"]).all()
    assert not any(torch.equal(before[name], value) for name, value in td3.policy_state().items())


def test_exploration_of_td3_lasts_and_keeps_its_spread() -> None:
    noise = made("td3", correlation=0.8)._epoch_numbers(4000)[0]  # (S, rounds, E, A)
    assert noise.std().item() == pytest.approx(1.0, abs=0.05)
    shifted = (noise[:, 1:] * noise[:, :-1]).mean((1, 3)) / noise.square().mean((1, 3))
    np.testing.assert_allclose(shifted.numpy(), 0.8, atol=0.05)
    first = made("td3")._epoch_numbers(4000)[0][:, 0]
    assert torch.equal(noise[:, 0], first), "the first of an epoch is drawn as ever"


def test_soft_values_of_discrete_actions_are_those_by_hand() -> None:
    sac: SAC = Group("sac", range(2), Contexts(4), temperature=0.5).start().algorithm
    states = normal(2, 6, 4)
    values, entropies = sac._soft(states, sac.targets, torch.zeros(2, 6, 0))
    for s in range(2):
        logs = log_softmax(Perceptron(sac.actor, s)(states[s].numpy()))
        least = np.minimum(*q(sac.targets, s, states))
        np.testing.assert_allclose(
            values[s].detach().numpy(), (np.exp(logs) * (least - 0.5 * logs)).sum(1), rtol=1e-4
        )
        np.testing.assert_allclose(entropies[s].detach().numpy(), -(np.exp(logs) * logs).sum(1), rtol=1e-4)


@pytest.mark.parametrize("kind", ["box", "discrete"])
def test_the_temperature_falls_while_entropy_is_higher_than_wanted(kind: str) -> None:
    most = 50.0 if kind == "box" else float(np.log(3))  # of three actions no policy has more
    for least, falls in ((-50.0, True), (most, False)):
        sac: SAC = made("sac", kind, target_entropy=least, warm_up=4, batch=4)
        metrics = sac.train_epoch(20)
        assert ((sac.temperature.log.detach() < 0) == falls).all()
        assert ((metrics["temperature"] < 1) == falls).all()
    fixed: SAC = made("sac", kind, temperature=0.2, warm_up=4, batch=4)
    np.testing.assert_allclose(fixed.train_epoch(20)["temperature"], 0.2, rtol=1e-6)
    usual: SAC = made("sac", kind)
    assert usual.least_entropy == (-2 if kind == "box" else pytest.approx(0.98 * np.log(3)))


LEARNING: dict[str, tuple[int, int, dict[str, Any]]] = {
    "sac": (1, 500, {"lr": 5e-3, "gamma": 0.0, "batch": 64, "tau": 0.05}),
    "td3": (1, 400, {"lr": 5e-3, "gamma": 0.0, "batch": 64, "tau": 0.05}),
    "ppo": (12, 100, {"lr": 5e-3, "gamma": 0.0}),
}


@pytest.mark.parametrize("name", LEARNING)
def test_it_learns_where_to_push(name: str) -> None:
    """After seconds every seed knows the action of every context: (c - 1) of half the box in both numbers."""
    epochs, rounds, settings = LEARNING[name]
    algorithm = made(name, "box", 3, **settings)
    contexts = np.column_stack([np.eye(3), np.full(3, 0.3)]).astype(np.float32)
    wanted = np.array([[-1, 0], [0, 2], [1, 4]])

    def error() -> float:
        return float(np.abs((algorithm.act(np.stack([contexts] * 3)) - wanted) / [1, 2]).mean((1, 2)).max())

    assert error() > 0.4
    for _ in range(epochs):
        algorithm.train_epoch(rounds)
    assert error() < 0.15
