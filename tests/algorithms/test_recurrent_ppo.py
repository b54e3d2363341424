"""PPO with models that remember: by cells of torch, seeds apart, on a task of memory; and A2C, its special case."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from qrlsuite.experiment.entry import resolve
from qrlsuite.plugins.algorithms.ppo import PPO, _outputs
from qrlsuite.testing.group import Toy
from qrlsuite.training.trainer import Trainer
from tests.algorithms.test_drqn import LANES
from tests.algorithms.worlds import Contexts, Group, Perceptron, log_softmax


def made(model: str = "gru", seeds: int = 2, **settings: Any) -> PPO:
    sizes = {"width": 6, "depth": 1} if model == "mlp" else {"width": 6}
    toy = Toy(seeds * LANES, hidden=True)
    algorithm: PPO = Group("ppo", range(seeds), toy, model, sizes, **settings).start().algorithm
    return algorithm


@pytest.mark.parametrize(("rounds", "length"), [(12, 4), (11, 4), (3, 4), (7, 1)])
def test_sequences_are_consecutive_steps_and_leave_none_out(rounds: int, length: int) -> None:
    ppo = made(length=length)
    found = ppo._sequences(rounds)
    assert (torch.diff(found, dim=1) == LANES).all()
    assert sorted(set(found.reshape(-1).tolist())) == list(range(rounds * LANES))
    assert found.shape == (LANES * -(-rounds // length), min(rounds, length))


def replayed(network: nn.Module, s: int, states: Tensor, begins: Tensor) -> Tensor:
    """What a unit of torch returns for an environment's steps in order (T, obs), from the beginning."""
    p = {name: value[s] for name, value in network.state_dict().items()}
    cell = nn.GRUCell(states.shape[1], 6)
    cell.load_state_dict(
        {
            "weight_ih": p["from_input.weight"], "bias_ih": p["from_input.bias"],
            "weight_hh": p["from_state.weight"], "bias_hh": p["from_state.bias"],
        }
    )  # fmt: skip
    h, outputs = torch.zeros(1, 6), []
    for x, begin in zip(states, begins):
        h = cell(x[None], torch.zeros(1, 6) if begin else h)
        outputs.append(h @ p["last.weight"].T + p["last.bias"])
    return torch.cat(outputs)


def test_it_learns_from_what_it_remembered_when_it_acted() -> None:
    """Over two rollouts: episodes go on from one to the other, and sequences begin anywhere in them."""
    ppo = made(length=4, gae_lambda=0.0, gamma=0.5)
    rollouts = [(first := ppo._collect(11), *ppo._estimate(first)) for _ in range(2)]
    states, begins = (
        torch.cat([getattr(each[0], name).view(2, 11, LANES, -1) for each in rollouts], 1)
        for name in ("states", "begins")
    )
    assert begins[:, 0].all()
    assert 0 < begins[:, 1:].sum() < begins[:, 1:].numel() / 2
    assert not begins[:, 11].all(), "the second rollout goes on with episodes"
    rollout, advantages, returns, critic_remembered = rollouts[1]
    expected: dict[str, list[Tensor]] = {"actor": [], "critic": []}
    with torch.no_grad():
        for name, outputs in expected.items():
            for s in range(2):
                lanes = [
                    replayed(getattr(ppo, name), s, states[s, :, e], begins[s, :, e, 0])[11:]
                    for e in range(LANES)
                ]
                outputs.append(torch.stack(lanes, 1).flatten(0, 1))
        actor, critic = (torch.stack(each) for each in expected.values())
        log_probs, _ = ppo.policy.judge(actor, rollout.actions)
        torch.testing.assert_close(rollout.log_probs, log_probs)
        torch.testing.assert_close(returns - advantages, critic.squeeze(2), rtol=1e-4, atol=1e-6)
        picked = ppo._sequences(11)
        for network, remembered, whole in (
            (ppo.actor, rollout.remembered, actor),
            (ppo.critic, critic_remembered, critic),
        ):
            flat = picked.reshape(-1)
            seen = _outputs(
                network,
                rollout.states[:, flat],
                rollout.begins[:, flat].view(2, -1, 4),
                remembered[:, picked[:, 0]],
            )
            torch.testing.assert_close(seen, whole[:, flat])
    before = {name: value.clone() for name, value in ppo.critic.state_dict().items()}
    ppo.train_epoch(11)
    assert not any(torch.equal(value, ppo.critic.state_dict()[name]) for name, value in before.items())


def test_what_comes_after_a_step_is_judged_by_what_is_remembered_there() -> None:
    """With lambda 0, R = r + gamma V(s'): inside an episode the next state's value."""
    ppo = made(length=4, gae_lambda=0.0, gamma=0.5)
    rollout = ppo._collect(11)
    advantages, returns, _ = (each.view(2, 11, LANES, -1) for each in ppo._estimate(rollout))
    values = (returns - advantages)[..., 0]
    inside = ~(rollout.terminated | rollout.truncated)[:, :-1]
    expected = torch.from_numpy(rollout.rewards[:, :-1]).float() + 0.5 * values[:, 1:]
    torch.testing.assert_close(returns[:, :-1, :, 0][inside], expected[inside])


@pytest.mark.parametrize(("model", "solves"), [("gru", True), ("mlp", False)])
def test_it_remembers_what_an_episode_showed_first(model: str, solves: bool) -> None:
    """The context is shown at an episode's first step alone: without a memory, two of three later choices are wrong."""
    ppo = made(model, lr=2e-2, gamma=0.0, length=8, batch=32, repeats=5)
    for _ in range(20):
        ppo.train_epoch(32)
    rewards = ppo._collect(100).rewards.mean((1, 2))
    assert rewards.min() > 0.9 if solves else rewards.max() < 0.7


def test_without_a_memory_act_needs_no_beginnings(tiny_task: str) -> None:
    trainer = Trainer(resolve(tiny_task, "mlp", "ppo"), [0])
    assert trainer.act(np.zeros((3, trainer.algorithm.obs_dim), np.float32)).shape == (3,)
    remembering = Trainer(resolve(tiny_task, "lstm", "ppo"), [0])
    with pytest.raises(ValueError, match="'ppo' remembers episodes: give act"):
        remembering.act(np.zeros((3, remembering.algorithm.obs_dim), np.float32))


def test_one_pass_in_one_batch_is_a_step_of_a2c() -> None:
    """The gradient of - mean log pi(a|s) A + .5 mean (V - R)^2 - .01 mean entropy, nothing clipped."""
    ppo: PPO = Group("ppo", [0], Contexts(4), repeats=1, batch=1000, clip=1e-6, lr=2e-3).start().algorithm
    kept: dict[str, Any] = {}
    estimate = ppo._estimate

    def watched(rollout: Any) -> Any:
        kept.update(rollout=rollout, estimates=estimate(rollout))
        return kept["estimates"]

    ppo._estimate = watched  # type: ignore[method-assign]
    actor, critic = Perceptron(ppo.actor), Perceptron(ppo.critic)
    ppo.train_epoch(20)
    assert ppo.actor_adam.steps.tolist() == [1]
    states, actions = kept["rollout"].states[0].numpy(), kept["rollout"].actions[0, :, 0].numpy()
    advantages, returns = (each[0].double().numpy() for each in kept["estimates"][:2])
    logs = log_softmax(actor(states))
    p, a = np.exp(logs), (advantages - advantages.mean()) / advantages.std(ddof=1)
    entropy = -(p * logs).sum(1)
    d = -a[:, None] * (np.eye(3)[actions] - p) + 0.01 * p * (logs + entropy[:, None])
    actor.assert_updated(ppo.actor, d / len(states), 2e-3)
    critic.assert_updated(ppo.critic, (critic(states)[:, 0] - returns)[:, None] / len(states), 2e-3)
