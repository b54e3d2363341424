"""Running statistics of observations: what they are, whose they are, and that they follow an agent everywhere."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from qrlsuite.engine.worker import train_group
from qrlsuite.errors import EnvironmentFailure, StoreError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.results import checkpoint
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation, group
from qrlsuite.training.group import GroupRun
from qrlsuite.training.standardization import PREFIX, RunningStatistics
from qrlsuite.training.trainer import Trainer, build_envs
from tests.conftest import POLE, Train

STANDARDIZED = POLE.replace("steps = 30", 'steps = 30\nnormalization = "running"')
AGENTS = [
    ("ddqn", "mlp", ("width=16",)),
    ("ppo", "mlp", ("width=16",)),
    ("reinforce", "mlp", ("width=16", "depth=1", "baseline=value")),
    ("ppo", "vqc-native", ("qubits=2", "layers=2")),
]
agents = pytest.mark.parametrize(("algorithm", "model", "settings"), AGENTS)


@pytest.fixture
def entry(tmp_path: Path) -> Callable[..., Entry]:
    """Resolve an entry of the task above."""
    path = tmp_path / "pole.toml"
    path.write_text(STANDARDIZED)

    def make(algorithm: str, model: str = "mlp", settings: Sequence[str] = ("width=16",)) -> Entry:
        return resolve(str(path), model, algorithm, [parse_setting(word) for word in settings])

    return make


@pytest.fixture
def train(entry: Callable[..., Entry], tmp_path: Path) -> Train:
    """Train seeds as one group in this process; returns the entry's folder."""

    def go(folder: str, seeds: Sequence[int], agent: tuple[Any, ...], epochs: int = 3) -> Path:
        store = EntryStore.create(tmp_path / folder, entry(*agent))
        train_group(store.path, seeds, epochs)
        return store.path

    return go


def results(folder: Path, seed: int) -> tuple[list[dict[str, Any]], bytes]:
    """What must depend on the seed alone: lines, circuit executions among them, and the agent."""
    store = EntryStore(folder).seed(seed)
    return [line.content for line in store.epochs()], (store.path / "final.safetensors").read_bytes()


def recorded(group: Trainer) -> list[NDArray[np.float32]]:
    """Return a list to which every training step will append the observations (S, E, 4) that it returns."""
    seen: list[NDArray[np.float32]] = []
    step = group.envs.inner.step

    def spy(actions: NDArray[np.int64]) -> Any:
        result = step(actions)
        seen.append(result[0].reshape(group.S, group.E, -1).copy())
        return result

    group.envs.inner.step = spy  # type: ignore[method-assign]
    return seen


def start(entry: Entry, seeds: Sequence[int]) -> Trainer:
    trainer = Trainer(entry, seeds)
    trainer.start()
    return trainer


def statistics_of(group: Trainer) -> RunningStatistics:
    assert group.statistics is not None
    return group.statistics


@pytest.mark.parametrize("algorithm", ["ddqn", "ppo", "reinforce"])
def test_networks_standardize_by_mean_and_variance_of_all_earlier_epochs(
    algorithm: str, entry: Callable[..., Entry]
) -> None:
    group = start(entry(algorithm), [0, 1, 2])
    used, seen = statistics_of(group).used, recorded(group)
    for epoch in range(4):
        group.train_epoch()
        assert len(seen) == 15 * (epoch + 1)
        if epoch == 0:
            assert torch.equal(used["mean"], torch.zeros(3, 4, dtype=torch.float64))
            assert torch.equal(used["variance"], torch.ones(3, 4, dtype=torch.float64))
            continue
        before = np.stack(seen[: 15 * epoch], axis=1).reshape(3, -1, 4).astype(np.float64)
        assert used["count"].tolist() == [60 * epoch] * 3
        np.testing.assert_allclose(used["mean"].numpy(), before.mean(1), rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(used["variance"].numpy(), before.var(1), rtol=1e-10)


@pytest.mark.parametrize("model", ["mlp", "vqc-native", "vqc-pennylane", "vqc-qiskit"])
def test_every_model_is_given_clipped_standardized_observations(
    model: str, entry: Callable[..., Entry]
) -> None:
    group = start(entry("ppo", model, ("width=16",) if model == "mlp" else ("qubits=2", "layers=1")), [0, 1])
    generator = np.random.default_rng(0)
    before = generator.normal([0, 5, -2, 0], [1, 3, 0.1, 1e-3], size=(30, 2, 4, 4)).astype(np.float32)
    for row in before:
        statistics_of(group).observe(row.reshape(8, 4))
    statistics_of(group).adopt()
    together = before.astype(np.float64).swapaxes(0, 1).reshape(2, -1, 4)
    mean, variance = together.mean(1, keepdims=True), together.var(1, keepdims=True)
    x = generator.normal(size=(2, 7, 4)).astype(np.float32)
    z = np.clip((x - mean) / np.sqrt(variance + 1e-8), -10, 10).astype(np.float32)
    assert z.max() == 10.0
    assert z.min() == -10.0
    assert np.abs(z).min() < 1.0
    actor, critic = group.models.built
    for network in (actor, critic):
        with torch.no_grad():
            given = network(torch.from_numpy(x))
            wanted = network.forward(torch.from_numpy(z))
        np.testing.assert_allclose(given.numpy(), wanted.numpy(), rtol=1e-3, atol=1e-4)


def test_a_copied_network_uses_the_statistics_of_the_original(entry: Callable[..., Entry]) -> None:
    group = start(entry("ddqn"), [0, 1])
    copied = copy.deepcopy(group.models.built[0])
    group.train_epoch()
    statistics_of(group).adopt()
    x = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(0))
    copied.load_state_dict(group.models.built[0].state_dict())
    with torch.no_grad():
        assert torch.equal(copied(x), group.models.built[0](x))
        assert torch.equal(group.algorithm.target(x), copied(x)) is False, "never copied: parameters differ"


def test_validation_uses_the_statistics_and_leaves_them(entry: Callable[..., Entry]) -> None:
    group = start(entry("ppo"), [0, 1])
    for _ in range(2):
        group.train_epoch()
    before = statistics_of(group).state_dict()
    group.validate(7)
    after = statistics_of(group).state_dict()
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_ppo_learns_from_the_log_probabilities_of_the_policy_that_acted(entry: Callable[..., Entry]) -> None:
    """One pass in one minibatch moves nothing before its loss is taken: the divergence must be nil."""
    group = start(entry("ppo", "mlp", ("width=16", "repeats=1", "batch=60")), [0, 1])
    for _ in range(3):
        metrics = group.train_epoch().metrics
        assert np.abs(metrics["kl"]).max() < 1e-6


def test_far_away_observations_keep_their_variance() -> None:
    """1e8 with a standard deviation of 1e-2: a sum of squares would lose all of it in float64."""
    x = 1e8 + 1e-2 * np.random.default_rng(0).normal(size=(40, 2, 3, 5))
    statistics = RunningStatistics(2, 3, 5, torch.device("cpu"))
    for row in x:
        statistics.observe(row.reshape(6, 5))
    statistics.adopt()
    expected = (x - 1e8).transpose(1, 0, 2, 3).reshape(2, 120, 5).var(axis=1)
    np.testing.assert_allclose(statistics.used["variance"].numpy(), expected, rtol=1e-4)


def test_a_constant_value_becomes_zero() -> None:
    statistics = RunningStatistics(1, 2, 1, torch.device("cpu"))
    for _ in range(3):
        statistics.observe(np.full((2, 1), 0.7, dtype=np.float32))
    statistics.adopt()
    (z,) = statistics(torch.nn.Identity(), (torch.full((1, 4, 1), 0.7),))
    assert torch.equal(z, torch.zeros(1, 4, 1))


@agents
def test_interrupted_split_and_resumed_equals_undisturbed(
    algorithm: str, model: str, settings: tuple[str, ...], train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = (algorithm, model, settings)
    straight = train("straight", [0, 1], agent, 4)
    original = Trainer._validate

    def stop(self: Trainer, epoch: int) -> Any:
        if epoch == 3:
            raise KeyboardInterrupt
        return original(self, epoch)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_validate", stop)
        with pytest.raises(KeyboardInterrupt):
            train("stopped", [0, 1], agent, 4)
    store = EntryStore(straight.parent.parent.parent / "stopped" / straight.parent.name / straight.name)
    assert {header.epoch for header in checkpoint.headers(store)} == {2}
    train("stopped", [1], agent, 4)
    stopped = train("stopped", [0], agent, 4)
    for seed in (0, 1):
        assert results(straight, seed) == results(stopped, seed)


def test_killed_before_publishing_publishes_the_statistics_of_the_last_epoch(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = train("straight", [0], AGENTS[1])

    def killed(self: GroupRun) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(group.GroupRun, "_finish", killed)
        with pytest.raises(MemoryError):
            train("killed", [0], AGENTS[1])
    assert results(straight, 0) == results(train("killed", [0], AGENTS[1]), 0)


@agents
def test_evaluated_agents_are_the_trained_ones(
    algorithm: str, model: str, settings: tuple[str, ...], train: Train
) -> None:
    """On the validation's own episodes they repeat the last scores."""
    store = EntryStore(train("runs", [0, 1], (algorithm, model, settings)))
    player = evaluation.trained_agents(store.entry(), store, [0, 1])
    np.testing.assert_array_equal(play(store.entry(), player), last_scores(store))
    assert player.statistics is not None
    assert player.statistics.used["count"].tolist() == [120, 120], "of the first two of three epochs"


def last_scores(store: EntryStore) -> NDArray[np.float32]:
    return np.stack([store.seed(seed).read().scores[-1] for seed in (0, 1)])


def play(entry: Entry, player: Trainer) -> NDArray[np.float32]:
    """Play the third epoch's validation episodes of two seeds; returns scores (2, 5)."""
    envs = build_envs(entry, 2 * 5, lambda: None)
    envs.inner.autoreset = False
    envs.seed_lanes([Streams(entry.task.hash, seed).numpy("validation", 3) for seed in (0, 1)])
    observations, _ = envs.reset()
    scores = np.zeros(10)
    for _ in range(30):
        observations, *_ = envs.step(player.act(observations))
        lanes, _, given = envs.take_finished()
        scores[lanes] = given
    return scores.reshape(2, 5).astype(np.float32)  # as they are stored


def test_an_agent_without_its_statistics_is_not_played(train: Train) -> None:
    store = EntryStore(train("runs", [0], AGENTS[1], 1))
    path = store.seed(0).path / "final.safetensors"
    save_file({k: v for k, v in load_file(path).items() if not k.startswith(PREFIX)}, path)
    with pytest.raises(
        StoreError, match=r"does not fit the entry's model: it has no 'observation_statistics\."
    ):
        evaluation.trained(store, best=1, episodes=5)


def test_an_observation_that_is_no_number_fails_the_group(entry: Callable[..., Entry]) -> None:
    group = start(entry("ppo"), [0, 1])
    group.train_epoch()
    before = statistics_of(group).state_dict()
    group.envs.inner.state[2, 3] = np.nan  # type: ignore[attr-defined]
    with pytest.raises(EnvironmentFailure, match=r"'cartpole' failed: .* value nan, .* needs finite ones"):
        group.train_epoch()
    assert np.array_equal(before["mean"], statistics_of(group).state_dict()["mean"])


def test_without_the_option_nothing_is_kept(entry: Callable[..., Entry]) -> None:
    group = start(entry("ppo", "mlp", ("width=16", "normalization=none")), [0])
    assert group.statistics is None
    assert group.envs.observe is None
    assert not group.models.built[0]._forward_pre_hooks
    assert not any(PREFIX in name for name in group.capture())
