"""REINFORCE against hand cases, its first update against numpy, and episodes longer than epochs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.plugins.algorithms import reinforce
from qrlsuite.plugins.algorithms.reinforce import Reinforce, rewards_to_go
from qrlsuite.testing.group import Toy
from tests.algorithms.worlds import Clock, Contexts, Group, Perceptron, log_softmax


def test_rewards_to_go_by_hand() -> None:
    rewards = np.array([[[1.0, 2.0, 4.0, 8.0, 16.0]]])
    ended = np.array([[[False, False, True, False, False]]])
    returns, known = rewards_to_go(rewards, ended, 0.5)
    assert returns.ravel().tolist() == [1 + 1 + 1, 2 + 2, 4, 8 + 8, 16]
    assert known.ravel().tolist() == [True, True, True, False, False]


def test_without_discount_the_reward_to_go_is_what_is_left_of_the_return() -> None:
    ended = np.array([[[True, False, False, True]], [[False, False, False, True]]])
    returns, known = rewards_to_go(np.ones((2, 1, 4)), ended, 1.0)
    assert returns[:, 0].tolist() == [[1, 3, 2, 1], [4, 3, 2, 1]]
    assert known.all()


@pytest.mark.parametrize("baseline", ["none", "mean", "value"])
def test_first_update_is_that_of_an_independent_computation(
    baseline: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Loss, gradients and Adam's step, summed over blocks, with slots that are not learned from."""
    monkeypatch.setattr(reinforce, "BLOCK", 7)
    lr, slots = 2e-3, 20
    group = Group("reinforce", [1, 2], Contexts(4), lr=lr, baseline=baseline)
    made: Reinforce = group.algorithm
    generator = torch.Generator().manual_seed(2)
    rows = torch.rand((2, 2, slots, 5), generator=generator)
    rows[..., 4] = torch.randint(3, rows.shape[:3], generator=generator)
    draw = np.random.default_rng(0)
    returns, learned = draw.normal(3, 2, (2, 2, slots)), draw.random((2, 2, slots)) < 0.6
    policies = [Perceptron(made.policy, s) for s in range(2)]
    values = [] if made.value is None else [Perceptron(made.value, s) for s in range(2)]
    metrics = made._learn(rows, returns, learned)
    for s in range(2):
        picked = rows[s].numpy()[learned[s]]
        x, a, g = picked[:, :4], picked[:, 4].astype(int), returns[s][learned[s]]
        n = len(a)
        advantage = {"none": g, "mean": g - g.mean()}.get(baseline)
        if advantage is None:
            error = values[s](x)[:, 0] - g
            advantage = -error
            assert metrics["value_loss"][s] == pytest.approx((error**2).mean(), rel=1e-4)
            assert made.value is not None
            values[s].assert_updated(made.value, 2 * error[:, None] / n, lr, s)
        logs = log_softmax(policies[s](x))
        assert metrics["loss"][s] == pytest.approx(-(advantage * logs[range(n), a]).mean(), rel=1e-4)
        assert metrics["learned_steps"][s] == n
        d = -advantage[:, None] * (np.eye(3)[a] - np.exp(logs)) / n
        policies[s].assert_updated(made.policy, d, lr, s)


@settings(max_examples=15, deadline=None)
@given(
    baseline=st.sampled_from(["none", "mean", "value"]),
    masked=st.booleans(),
    share=st.sampled_from([0.05, 0.3, 1.0]),
    draw=st.integers(0, 100),
)
def test_gradients_without_autograd_are_those_of_autograd(
    baseline: str, masked: bool, share: float, draw: int
) -> None:
    def made() -> Reinforce:
        learner: Reinforce = (
            Group("reinforce", [0, 1], Toy(4, masked=masked), baseline=baseline).start().algorithm
        )
        return learner

    compiled, plain = made(), made()
    plain.policy.register_forward_hook(lambda *given: None)  # which a compiled pass would not call
    assert (compiled._sweeps() is None, plain._sweeps() is None) == (False, True)
    rows = compiled._collect(300)[0][..., :-1]  # with the slots of `memory`, empty
    generator = np.random.default_rng(draw)
    learned = generator.random(rows.shape[:3]) < share
    learned[:, :, :500] = False
    returns = generator.normal(size=learned.shape)
    measured = [learner._learn(rows, returns, learned) for learner in (compiled, plain)]
    for name, values in measured[0].items():
        np.testing.assert_allclose(values, measured[1][name], rtol=1e-3, atol=1e-6, err_msg=name)
    for network in ("policy", "value"):
        ours, theirs = (getattr(learner, network) for learner in (compiled, plain))
        for own, other in zip(ours.parameters(), theirs.parameters()) if ours is not None else ():
            torch.testing.assert_close(own.grad, other.grad, rtol=1e-3, atol=1e-6)


def clock(lengths: list[int], seeds: int = 1, cut: bool = False, **settings: Any) -> Reinforce:
    settings = {"memory": 10, "gamma": 0.5, **settings}
    group = Group("reinforce", range(seeds), Clock(lengths, cut), **settings)
    made: Reinforce = group.start().algorithm
    return made


def test_unfinished_episodes_carry_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of 5 steps in epochs of 3 rounds end in rounds 5, 10, 15: epochs 2, 4, 5; of 2 steps: in all."""
    made = clock([5, 2])
    seen: list[list[list[tuple[float, float, float]]]] = []
    learn = made._learn

    def spy(rows: torch.Tensor, returns: Any, learned: Any) -> Any:
        steps = torch.cat([10 * rows[0, ..., :2], torch.from_numpy(returns[0])[..., None]], -1)
        seen.append([[tuple(step) for step in steps[e][learned[0, e]].tolist()] for e in range(2)])
        return learn(rows, returns, learned)

    monkeypatch.setattr(made, "_learn", spy)
    counts = [made.train_epoch(3)["learned_steps"][0] for _ in range(5)]
    five = [0, 5, 0, 5, 5]
    two = [2, 4, 2, 4, 2]
    assert [[len(lane) for lane in epoch] for epoch in seen] == [list(pair) for pair in zip(five, two)]
    assert counts == [a + b for a, b in zip(five, two)]
    # rewards 1, 2, 3, 4, 5 and discount 1/2
    returns = [1 + 2 / 2 + 3 / 4 + 4 / 8 + 5 / 16, 2 + 3 / 2 + 4 / 4 + 5 / 8, 3 + 4 / 2 + 5 / 4, 4 + 5 / 2, 5]
    whole = [(t, 0, g) for t, g in enumerate(returns)]
    for epoch in (1, 3, 4):
        np.testing.assert_allclose(seen[epoch][0], whole, atol=1e-5)
    np.testing.assert_allclose(seen[1][1], [(0, 1, 2), (1, 1, 2)] * 2, atol=1e-5)


def test_stored_actions_are_evaluated_again() -> None:
    """The carried rows hold the actions that the environment was given."""
    made = clock([7, 7, 7])
    made.train_epoch(4)
    given = np.stack(made.envs.history, axis=1)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(made.carried[0, :, -4:, 3].numpy(), given)
    assert made.lengths.tolist() == [[4, 4, 4]]
    assert not made.carried[:, :, :-4].any()
    assert len(np.unique(given)) == 2


def test_memory_keeps_the_last_steps_of_a_long_episode() -> None:
    made = clock([5], memory=1)
    assert made.train_epoch(3)["learned_steps"].tolist() == [0]
    assert made.lengths.tolist() == [[1]]
    assert made.carried[0, 0, 0, 0] == pytest.approx(0.2)  # the third step
    assert made.train_epoch(3)["learned_steps"].tolist() == [1 + 2]
    assert made.lengths.tolist() == [[1]]
    assert made.carried[0, 0, 0, 0] == 0  # the first step of the second episode


def test_whole_episodes_are_of_one_policy() -> None:
    """Three epochs of 4 rounds: from 12 steps each, episodes of 5, 2 and 8 steps keep 10, 12 and 8."""
    made = clock([5, 2, 8], memory=8, epochs_per_update=3)
    for update in (1, 2):
        before = {name: value.clone() for name, value in made.policy.state_dict().items()}
        for _ in range(2):
            metrics = made.train_epoch(4)
            assert metrics["learned_steps"].tolist() == [0]
            assert np.isnan(metrics["loss"]).all()
        assert all(torch.equal(value, before[name]) for name, value in made.policy.state_dict().items())
        assert made.train_epoch(4)["learned_steps"].tolist() == [30], "unfinished episodes are lost"
        assert made.adam.steps.tolist() == [update]


@pytest.mark.parametrize("baseline", ["mean", "value"])
def test_what_whole_episodes_teach_is_what_one_long_epoch_teaches(
    baseline: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rewards-to-go of four epochs of 3 rounds, time limits included, and interrupted after the second."""
    taught = []
    for rounds, each in ((12, 1), (3, 4)):
        made = clock([5, 3], cut=True, memory=9, epochs_per_update=each, baseline=baseline)
        for epoch in range(each):
            if epoch == 2:
                state, envs = made.state_dict(), made.envs
                made = clock([5, 3], cut=True, memory=9, epochs_per_update=each, baseline=baseline)
                made.load_state_dict(state)
                made.envs = envs
            if epoch == each - 1:
                monkeypatch.setattr(
                    made, "_learn", lambda rows, returns, learned: taught.append(returns[learned]) or {}
                )
            made.train_epoch(rounds)
    assert len(taught[0]) == 10 + 12
    np.testing.assert_allclose(taught[1], taught[0], rtol=1e-5)


def test_a_memory_too_short_for_whole_episodes_is_refused() -> None:
    with pytest.raises(OptionError, match=r"memory = 8: epochs_per_update = 4 keeps 9 steps.*set memory=9"):
        clock([5, 3], memory=8, epochs_per_update=4).train_epoch(3)


def test_a_seed_without_a_completed_episode_stays_as_it_is() -> None:
    """Seed 0's episodes last 100 steps, seed 1's three: only seed 1 learns, until seed 0's end."""
    made = clock([100, 100, 3, 3], seeds=2, memory=200, baseline="value")
    made.train_epoch(4)

    def parts() -> dict[str, torch.Tensor]:
        learned = ("policy.", "adam.", "value.", "value_adam.")
        return {k: v.clone() for k, v in made.state_dict().items() if k.startswith(learned)}

    before = parts()
    assert before["adam.steps"].tolist() == [0, 1]
    metrics = made.train_epoch(4)
    after = parts()
    for name in before:
        assert torch.equal(before[name][0], after[name][0]), name
    for name in ("policy.w0", "adam.mean.w0", "adam.square.w0", "adam.steps", "value.w0", "value_adam.steps"):
        assert not torch.equal(before[name][1], after[name][1]), name
    assert metrics["learned_steps"].tolist()[0] == 0
    assert np.isnan(metrics["loss"][0])
    assert np.isfinite(metrics["loss"][1])
    made.train_epoch(92)
    assert made.adam.steps.tolist() == [1, 3]
    assert not torch.equal(made.policy.state_dict()["w0"][0], after["policy.w0"][0])


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("baseline", ["mean", "value"])
def test_a_time_limit_is_bootstrapped_by_a_value_network_only(
    baseline: str, cut: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = clock([2, 3], cut=cut, baseline=baseline)
    given = []
    monkeypatch.setattr(made, "_learn", lambda rows, returns, learned: given.append(returns) or {})
    made.train_epoch(3)
    beyond = np.zeros(2)
    if cut and baseline == "value":
        assert made.value is not None
        beyond = Perceptron(made.value)(np.array([[0.2, 0, 1], [0.3, 0.1, 1]]))[:, 0]
        assert (np.abs(beyond) > 1e-3).all()
    # rewards 1, 2 | 1 and 1, 2, 3
    lane0 = [1 + 1 + beyond[0] / 4, 2 + beyond[0] / 2]
    lane1 = [1 + 1 + 0.75 + beyond[1] / 8, 2 + 1.5 + beyond[1] / 4, 3 + beyond[1] / 2]
    np.testing.assert_allclose(given[0][0, 0, 10:12], lane0, rtol=1e-5)
    np.testing.assert_allclose(given[0][0, 1, 10:13], lane1, rtol=1e-5)


def test_training_samples_from_the_policy_and_validation_is_greedy() -> None:
    group = Group("reinforce", [0], Contexts(100), lr=1e-9)
    made: Reinforce = group.start().algorithm
    for name, parameter in made.policy.named_parameters():
        parameter.data.zero_()
        if name == "b1":
            parameter.data[:] = torch.tensor([0.7, 0.2, 0.1]).log()
    for _ in range(2):
        made.train_epoch(100)
    first, second = np.split(np.concatenate(group.envs.history), 2)  # type: ignore[attr-defined]
    np.testing.assert_allclose(np.bincount(first, minlength=3) / 10_000, [0.7, 0.2, 0.1], atol=0.02)
    assert not np.array_equal(first, second)
    assert (made.act(np.zeros((1, 50, 4), dtype=np.float32)) == 0).all()


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("memory=400", []),
        ("memory=399", ["memory=399 is too small for episodes of 500 steps: an update sees 499"]),
        ("epochs_per_update=5", []),
        (
            "epochs_per_update=4",
            ["epochs_per_update=4 is too small for episodes of 500 steps: an update sees 400"],
        ),
        ("environment.steps=700", ["memory=500 is too small for episodes of 700 steps: an update sees 600"]),
    ],
)
def test_episodes_that_no_update_sees_whole_are_named(setting: str, said: list[str]) -> None:
    assert resolve("cartpole", "mlp", "reinforce", [parse_setting(setting)]).unusable(100) == said
