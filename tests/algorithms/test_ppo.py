"""PPO against hand cases, and its first update against numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from qrlsuite.plugins.algorithms.ppo import PPO, Rollout, generalized_advantages, minibatches
from qrlsuite.testing.group import SPACES, Toy
from tests.algorithms.worlds import Clock, Contexts, Group, Perceptron, log_softmax

NEVER = [False, False, False]


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"),
    [
        # deltas 1 + .5 * 2 - 1 = 1, 2 + .5 * 4 - 1 = 3, 3 + .5 * 8 - 1 = 6, each decaying by .5 * .5
        (NEVER, NEVER, [2.125, 4.5, 6]),
        # the second step's future is worth nothing: delta 2 - 1
        ([False, True, False], NEVER, [1.25, 1, 6]),
        # ... is worth V(s'), but no later error reaches back
        (NEVER, [False, True, False], [1.75, 3, 6]),
        ([False, True, False], [False, True, False], [1.25, 1, 6]),
        # the epoch's last step terminates: delta 3 - 1
        ([False, False, True], NEVER, [1 + 0.25 * 3.5, 3.5, 2]),
    ],
)
def test_generalized_advantages_by_hand(
    terminated: list[bool], truncated: list[bool], expected: list[float]
) -> None:
    def column(values: list[Any]) -> NDArray[Any]:
        return np.array(values).reshape(1, 3, 1)

    given = [1.0, 2.0, 3.0], [1.0, 1.0, 1.0], [2.0, 4.0, 8.0], terminated, truncated
    result = generalized_advantages(*map(column, given), gamma=0.5, gae_lambda=0.5)
    assert result.ravel().tolist() == expected


def test_advantages_with_lambda_one_are_returns_minus_values() -> None:
    draw = np.random.default_rng(0)
    rewards, values, last = draw.random((2, 6, 3)), draw.random((2, 6, 3)), draw.random((2, 1, 3))
    following = np.concatenate([values[:, 1:], last], axis=1)
    never = np.zeros(rewards.shape, dtype=bool)
    result = generalized_advantages(rewards, values, following, never, never, 0.9, 1.0)
    discounts = 0.9 ** np.arange(6)[:, None]
    returns = (discounts * rewards).sum(1) + 0.9**6 * last[:, 0]
    np.testing.assert_allclose(result[:, 0], returns - values[:, 0])


@pytest.mark.parametrize(
    ("samples", "sizes"),
    [(2000, [64] * 30 + [80]), (128, [64, 64]), (127, [127]), (64, [64]), (63, [63]), (1, [1])],
)
def test_minibatches_merge_the_remainder(samples: int, sizes: list[int]) -> None:
    pieces = minibatches(samples, 64)
    assert [p.stop - p.start for p in pieces] == sizes
    assert np.concatenate([np.arange(samples)[p] for p in pieces]).tolist() == list(range(samples))


def ppo(seeds: list[int], lanes: int = 1, **settings: Any) -> PPO:
    made: PPO = Group("ppo", seeds, Contexts(lanes * len(seeds)), **settings).start().algorithm
    return made


def test_every_pass_takes_every_sample_once_in_an_order_of_its_own() -> None:
    made, alone = ppo([5, 6], repeats=3), ppo([6], repeats=3)
    orders = made._orders(40).numpy()
    assert orders.shape == (3, 2, 40)
    for repeat in orders:
        assert sorted(repeat[0]) == sorted(repeat[1]) == list(range(40))
    np.testing.assert_array_equal(orders[:, 1], alone._orders(40).numpy()[:, 0])
    made.epoch = 1
    for other in (orders[1], orders[2], made._orders(40).numpy()[0]):
        assert not np.array_equal(orders[0], other)
    assert not np.array_equal(orders[0, 0], orders[0, 1])


def test_every_agent_makes_the_same_number_of_steps() -> None:
    made = ppo([0, 1, 2], lanes=4)
    made.train_epoch(35)  # 140 samples: minibatches of 64 and 76, ten times
    assert made.actor_adam.steps.tolist() == made.critic_adam.steps.tolist() == [20] * 3


def test_first_update_is_that_of_an_independent_computation() -> None:
    """Loss, gradients and Adam's step of both networks, with samples on all sides of the clipping."""
    B, clip, lr = 40, 0.2, 2e-3
    made = ppo([1, 2], clip=clip, lr=lr, value_coefficient=0.7, entropy_coefficient=0.05)
    generator = torch.Generator().manual_seed(2)
    states = torch.rand((2, B, 4), generator=generator)
    actions = torch.randint(3, (2, B), generator=generator)
    with torch.no_grad():
        now = torch.log_softmax(made.actor(states), -1).gather(2, actions[..., None]).squeeze(2)
    old = now + 0.4 * torch.randn((2, B), generator=generator)
    advantages, returns = (5 * torch.randn((2, B), generator=generator) for _ in range(2))
    actors, critics = ([Perceptron(m, s) for s in range(2)] for m in (made.actor, made.critic))
    measured = made._learn(states, actions[..., None], old, advantages, returns).numpy()
    rows = np.arange(B)
    for s in range(2):
        x, a = states[s].numpy(), actions[s].numpy()
        logs = log_softmax(actors[s](x))
        p = np.exp(logs)
        ratio = np.exp(logs[rows, a] - old[s].numpy())
        given = advantages[s].numpy().astype(np.float64)
        scaled = (given - given.mean()) / (given.std(ddof=1) + 1e-8)
        free, held = ratio * scaled, np.clip(ratio, 1 - clip, 1 + clip) * scaled
        entropy = -(p * logs).sum(1)
        critic = critics[s](x)[:, 0]
        error = critic - returns[s].numpy()
        kl = np.mean(old[s].numpy() - logs[rows, a])
        expected = [-np.minimum(free, held).mean(), (error**2).mean(), entropy.mean(), kl]
        np.testing.assert_allclose(measured[:, s], expected, rtol=1e-4, atol=1e-6)
        learns = free <= held
        outside = np.abs(ratio - 1) > clip
        for sign in (scaled > 0, scaled < 0):  # the test would miss a mistake on a side without samples
            assert (learns & outside & sign).any()
            assert (~learns & sign).any()
        chosen = np.eye(3)[a]
        d = -np.where(learns, scaled * ratio, 0)[:, None] * (chosen - p) / B
        d += 0.05 * p * (logs + entropy[:, None]) / B
        actors[s].assert_updated(made.actor, d, lr, s)
        critics[s].assert_updated(made.critic, 0.7 * 2 * error[:, None] / B, lr, s)


@settings(max_examples=40, deadline=None)
@given(
    kind=st.sampled_from([*SPACES, "masked"]),
    options=st.fixed_dictionaries(
        {
            "clip": st.sampled_from([0.02, 0.2]),
            "value_coefficient": st.sampled_from([0.0, 0.5]),
            "entropy_coefficient": st.sampled_from([0.0, 0.3]),
            "value_clip": st.sampled_from([None, 0.1]),
            "longest_gradient": st.sampled_from([None, 0.05]),
        }
    ),
    batch=st.integers(1, 40),
)
def test_gradients_without_autograd_are_those_of_autograd(
    kind: str, options: dict[str, Any], batch: int
) -> None:
    def made() -> PPO:
        space = "discrete" if kind == "masked" else kind
        learner: PPO = (
            Group("ppo", [0, 1], Toy(4, space, masked=kind == "masked"), **options).start().algorithm
        )
        return learner

    compiled, plain = made(), made()
    for network in (plain.actor, plain.critic):
        network.register_forward_hook(lambda *given: None)  # which a compiled pass would not call
    assert (compiled._sweeps() is None, plain._sweeps() is None) == (False, True)
    rollout = compiled._collect(20)
    assert torch.allclose(rollout.log_probs, plain._collect(20).log_probs, atol=1e-6)
    noise = torch.randn((3, 2, batch), generator=torch.Generator().manual_seed(batch))
    seen, actions = rollout.states[:, :batch], rollout.actions[:, :batch]
    given_to_both = seen, actions, rollout.log_probs[:, :batch] + 0.2 * noise[0], noise[1], noise[2]
    measured = [learner._learn(*given_to_both).to(torch.float64) for learner in (compiled, plain)]
    torch.testing.assert_close(*measured, rtol=1e-4, atol=1e-5)
    parts = [[learner.actor, learner.critic, learner.policy] for learner in (compiled, plain)]
    networks = [
        [p for each in own if isinstance(each, torch.nn.Module) for p in each.parameters()] for own in parts
    ]
    for ours, theirs in zip(*networks, strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-3, atol=1e-6)


def test_values_and_gradients_are_clipped_as_cleanrls_are() -> None:
    """By its formula of the value loss, and torch's own scaling of one agent's gradients, in another population."""
    generator = torch.Generator().manual_seed(2)
    states, old = torch.rand((2, 40, 4), generator=generator), torch.full((2, 40), -1.0)
    actions = torch.randint(3, (2, 40, 1), generator=generator)
    advantages, returns = (torch.randn((2, 40), generator=generator) for _ in range(2))
    made, free = (
        ppo([1, 2], entropy_coefficient=0, **own)
        for own in ({"value_clip": 0.5, "longest_gradient": 0.376}, {})
    )
    made._learn(states, actions, old, advantages, returns)
    values, collected = free.critic(states)[..., 0], returns - advantages
    near = collected + torch.clamp(values - collected, -0.5, 0.5)
    assert 0.1 < (near != values).float().mean() < 0.9
    value_loss = 0.5 * torch.max((values - returns) ** 2, (near - returns) ** 2).mean(1)
    ratio = (free.policy.judge(free.actor(states), actions)[0] - old).exp()
    scaled = (advantages - advantages.mean(1, keepdim=True)) / (advantages.std(1, keepdim=True) + 1e-8)
    policy_loss = -torch.min(ratio * scaled, ratio.clamp(0.9, 1.1) * scaled).mean(1)
    (policy_loss + value_loss).sum().backward()
    lengths = []
    for s in range(2):
        own = [torch.zeros_like(p[s]) for p in (*free.actor.parameters(), *free.critic.parameters())]
        for each, p in zip(own, (*free.actor.parameters(), *free.critic.parameters())):
            each.grad = p.grad[s]
        lengths.append(torch.nn.utils.clip_grad_norm_(own, 0.376))
        for each, p in zip(own, (*made.actor.parameters(), *made.critic.parameters())):
            torch.testing.assert_close(p.grad[s], each.grad, rtol=1e-4, atol=1e-6)
    assert min(lengths) < 0.376 < max(lengths), "one agent's gradients are scaled, the other's are not"


def test_advantages_are_normalized_within_the_minibatch() -> None:
    """Shifting and scaling a minibatch's advantages changes nothing."""
    results = []
    for shift, scale in ((0.0, 1.0), (100.0, 7.0)):
        made = ppo([0])
        generator = torch.Generator().manual_seed(3)
        states = torch.rand((1, 16, 4), generator=generator)
        advantages = torch.randn((1, 16), generator=generator)
        old = torch.full((1, 16), -1.1)
        actions = torch.arange(16)[None] % 3
        scaled = advantages * scale + shift
        results.append(made._learn(states, actions[..., None], old, scaled, torch.zeros(1, 16)))
    torch.testing.assert_close(results[0], results[1], rtol=1e-3, atol=1e-5)
    assert torch.isfinite(ppo([0])._learn(states[:, :1], actions[:, :1, None], *[torch.ones(1, 1)] * 3)).all()


def collect(cut: bool) -> tuple[PPO, Rollout]:
    """Four rounds of a lane whose episodes have 3 steps, and of one whose episodes have 5."""
    made: PPO = Group("ppo", [0], Clock([3, 5], cut), gamma=0.5, gae_lambda=0.0).start().algorithm
    return made, made._collect(4)


@pytest.mark.parametrize("cut", [False, True])
def test_rollouts_run_across_ends(cut: bool) -> None:
    made, rollout = collect(cut)
    began, arrived = rollout.states[0].view(4, 2, 3), rollout.arrived[0].view(4, 2, 3)
    assert began[:, 0, 0].tolist() == pytest.approx([0, 0.1, 0.2, 0])
    assert arrived[:, 0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.1])  # 0.3: before the reset
    assert began[:, 1].tolist() == [pytest.approx([t / 10, 0.1, 1]) for t in range(4)]
    ends = rollout.truncated if cut else rollout.terminated
    assert ends[0].tolist() == [[False, False], [False, False], [True, False], [False, False]]
    assert not (rollout.terminated if cut else rollout.truncated).any()
    assert rollout.rewards[0].tolist() == [[1, 1], [2, 2], [3, 3], [1, 4]]
    assert made.observations[0, :, 0].tolist() == pytest.approx([0.1, 0.4])


@pytest.mark.parametrize("cut", [False, True])
def test_the_critic_stands_in_for_what_is_cut_off(cut: bool) -> None:
    """With lambda 0, R = r + gamma V(s'), also at the epoch's end and at a time limit; not at a termination."""
    made, rollout = collect(cut)
    advantages, returns = (t[0].view(4, 2).numpy() for t in made._estimate(rollout)[:2])
    critic = Perceptron(made.critic)
    following = critic(rollout.arrived[0].numpy()).reshape(4, 2)
    if not cut:
        following[2, 0] = 0
    expected = rollout.rewards[0] + 0.5 * following
    np.testing.assert_allclose(returns, expected, rtol=1e-5)
    values = critic(rollout.states[0].numpy()).reshape(4, 2)
    np.testing.assert_allclose(advantages, expected - values, rtol=1e-4, atol=1e-6)


def test_log_probabilities_are_those_of_the_policy_that_acted() -> None:
    made, rollout = collect(False)
    logs = log_softmax(Perceptron(made.actor)(rollout.states[0].numpy()))
    expected = logs[np.arange(8), rollout.actions[0, :, 0].numpy()]
    np.testing.assert_allclose(rollout.log_probs[0].numpy(), expected, rtol=1e-5)


def with_known_policy(**settings: Any) -> PPO:
    """An actor with probabilities 0.7, 0.2 and 0.1 in every state."""
    made = ppo([0, 1], lanes=100, **settings)
    for name, parameter in made.actor.named_parameters():
        parameter.data.zero_()
        if name == "b1":
            parameter.data[:] = torch.tensor([0.7, 0.2, 0.1]).log()
    return made


def test_training_samples_from_the_policy() -> None:
    made = with_known_policy()
    actions = made._collect(100).actions.numpy()
    for chosen in actions[..., 0]:
        np.testing.assert_allclose(np.bincount(chosen, minlength=3) / 10_000, [0.7, 0.2, 0.1], atol=0.02)
    assert not np.array_equal(actions[0], actions[1])
    made.epoch = 1
    assert not np.array_equal(made._collect(100).actions.numpy(), actions)


def test_validation_is_greedy_or_samples() -> None:
    observations = np.zeros((2, 10_000, 4), dtype=np.float32)
    assert (with_known_policy().act(observations) == 0).all()
    made, same, later = (with_known_policy(validation="sampled") for _ in range(3))
    first, second = made.act(observations), made.act(observations)
    for chosen in first:
        np.testing.assert_allclose(np.bincount(chosen, minlength=3) / 10_000, [0.7, 0.2, 0.1], atol=0.02)
    np.testing.assert_array_equal(same.act(observations), first)
    later.epoch = 1
    for other in (second, later.act(observations), first[::-1]):
        assert not np.array_equal(first, other)


def test_sampled_validation_begins_anew_after_every_epoch() -> None:
    """However often `act` was called before, an epoch's validation draws the numbers of that epoch."""
    once, often = (ppo([0], lanes=2, validation="sampled") for _ in range(2))
    observations = np.zeros((1, 200, 4), dtype=np.float32)
    often.act(observations)
    for made in (once, often):
        made.train_epoch(4)
    np.testing.assert_array_equal(once.act(observations), often.act(observations))
