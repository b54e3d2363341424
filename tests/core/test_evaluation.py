"""Evaluation: policies whose worth is known, episodes common to all, agents that do not depend on their company."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from qrlsuite.environment import LaneEnv, batched_spaces
from qrlsuite.errors import OptionError, PluginError, StoreError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.task import load
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation
from qrlsuite.training.trainer import count_parameters
from tests.conftest import Train

WALK = """
format_version = 1
name = "walk"
summary = "Episodes of 3 to 11 steps, whose rewards grow with the actions"
[environment]
name = "gym"
[environment.options]
id = "tests.environments.strangers:Walk-v0"
[protocol]
environments = 2
interactions = 20
[score]
source = "return"
[ranking]
thresholds = [1.0]
deltas = [0.5]
reference = { threshold = 1.0, delta = 0.5 }
horizons = [20]
"""


def test_the_optimal_policy_scores_one_and_the_others_less(tiny_task: str) -> None:
    optimal, nearest, random = evaluation.references(resolve(tiny_task, "mlp"), episodes=150)
    assert [optimal.name, nearest.name, random.name] == ["optimal", "nearest antenna", "random"]
    assert optimal.scores is not None
    assert nearest.scores is not None
    assert random.scores is not None
    assert (optimal.scores == 1.0).all()
    assert (optimal.returns >= nearest.returns).all()
    assert (optimal.returns >= random.returns).all()
    assert 0.9 < nearest.scores.mean() < 1.0
    assert optimal.returns.shape == (1, 150)


def test_nearest_is_by_distance_to_where_the_user_will_be(tiny_task: str) -> None:
    from qrlsuite.plugins.environments.beam6g import trajectory
    from qrlsuite.plugins.environments.beam6g.policies import NearestAntenna
    from qrlsuite.plugins.environments.beam6g.vector import BeamLanes

    envs = BeamLanes(resolve(tiny_task, "mlp").task.environment_options, 3)
    observations, _ = envs.reset(seed=1)
    policy = NearestAntenna(envs)
    points = envs.support_points
    x, y = trajectory.positions(points, 20)
    for step in range(20):
        chosen = policy(observations)
        for lane in range(3):
            distances = [
                np.hypot(x[lane, step + 1] - a, y[lane, step + 1] - b) for (a, b), _ in envs.options.antennas
            ]
            assert chosen[lane] == int(np.argmin(distances))
        observations, *_ = envs.step(chosen)


def test_agents_do_not_depend_on_their_company_and_episodes_repeat(kept: Train) -> None:
    store = EntryStore(kept("runs", [0, 1, 2], 1))
    together = evaluation.trained(store, best=3, episodes=120)
    again = evaluation.trained(store, best=3, episodes=120)
    other = evaluation.trained(store, best=3, episodes=120, seed=1)
    alone = evaluation.trained(store, best=1, episodes=120)
    assert together.returns.tobytes() == again.returns.tobytes()
    assert not np.array_equal(together.returns, other.returns)
    assert alone.seeds == together.seeds[:1]
    assert alone.returns.tobytes() == together.returns[:1].tobytes()
    assert len(set(together.returns.mean(axis=1))) > 1, "three agents that act alike would hide a mixture"
    assert evaluation.trained(store, 3, 100).returns.tobytes() == together.returns[:, :100].tobytes()


def test_the_best_runs_are_those_with_the_best_last_validation(kept: Train) -> None:
    store = EntryStore(kept("runs", [0, 1, 2], 2))
    last = {seed: store.seed(seed).read().curve[-1] for seed in range(3)}
    seeds, scores, runs = evaluation.best_runs(store, 2)
    assert seeds == sorted(last, key=lambda seed: (-last[seed], seed))[:2]
    assert scores == [last[seed] for seed in seeds]
    assert runs == 3
    with pytest.raises(OptionError, match="--best 0"):
        evaluation.best_runs(store, 0)


@pytest.fixture
def walk(tmp_path: Path) -> Entry:
    path = tmp_path / "walk.toml"
    path.write_text(WALK)
    return resolve(str(path), "mlp", "reinforce")


def test_short_episodes_are_not_counted_more_often(walk: Entry) -> None:
    """Every stream gives one episode: their lengths are those of as many single resets, not of the first to end."""
    assert walk.task.name == "walk"
    lengths: list[int] = []

    def build(envs: object, block: int) -> evaluation.Policy:
        running = {"steps": np.zeros(envs.num_envs, int)}  # type: ignore[attr-defined]

        def act(observations: np.ndarray) -> np.ndarray:
            done = envs._ended  # type: ignore[attr-defined]
            running["steps"] += ~done
            lengths[:] = running["steps"].tolist()
            return np.zeros(len(done), np.int64)

        return act

    returns, scores, _ = evaluation.play(walk, 1, 100, 0, build)
    assert returns.shape == (1, 100)
    assert np.isfinite(returns).all()
    assert scores is None, "the task knows no maximum"
    alone = []
    import gymnasium

    env = gymnasium.make(walk.task.environment_options.id)
    for key in range(100):
        seed = int(Streams(walk.task.hash, 0).numpy("evaluation", key).integers(2**31))
        env.reset(seed=seed)
        steps, ended = 0, False
        while not ended:
            ended = env.step(0)[2]
            steps += 1
        alone.append(steps)
    assert lengths == alone


def test_a_task_without_reference_policies_has_the_random_one(walk: Entry) -> None:
    (random,) = evaluation.references(walk, episodes=5)
    assert random.name == "random"
    assert random.summary()["score"] is None
    assert set(random.summary()["return"]) == {"mean", "std", "min", "p5", "p25", "p50", "p75", "p95", "max"}


class Push(LaneEnv):
    """Episodes of one step whose reward is the action, a number in [2, 3]."""

    def __init__(self, options: object, lanes: int) -> None:
        batched_spaces(self, spaces.Box(0, 1, (1,)), spaces.Box(2, 3, (1,)), lanes)

    def reset(self, **given: object) -> tuple[np.ndarray, dict[str, object]]:
        return np.zeros((self.num_envs, 1), np.float32), {}

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, object]]:
        assert actions.shape == (self.num_envs, 1)
        ended = np.ones(self.num_envs, bool)
        return np.zeros((self.num_envs, 1), np.float32), actions[:, 0].astype(float), ended, ~ended, {}


def hardest(envs: LaneEnv) -> Callable[[np.ndarray], np.ndarray]:
    return lambda observations: np.full((envs.num_envs, 1), 3.0)


def test_actions_need_not_be_discrete(walk: Entry) -> None:
    task = copy.copy(walk.task)
    own = f"{__name__}:"
    task.environment = replace(
        walk.task.environment, vector=f"{own}Push", policies={"hardest": f"{own}hardest"}
    )
    entry = replace(walk, task=task)
    best, random = evaluation.references(entry, episodes=200)
    assert (best.returns == 3.0).all()
    assert ((random.returns >= 2) & (random.returns <= 3)).all()
    assert 2.4 < random.returns.mean() < 2.6
    again = evaluation.references(entry, episodes=200)[1]
    assert (again.returns == random.returns).all()
    with pytest.raises(
        OptionError, match=r"'reinforce' takes discrete actions, and task '.*' has Box\(2.0, 3.0"
    ):
        count_parameters(entry)


def too_many(envs: object) -> Callable[[np.ndarray], np.ndarray]:
    return lambda observations: np.full(len(observations), 7)


def test_a_third_partys_policy_is_looked_at(tiny_task: str) -> None:
    entry = resolve(tiny_task, "mlp")
    task = load(tiny_task)
    task.environment = replace(entry.task.environment, policies={"odd": f"{__name__}:too_many"})
    with pytest.raises(PluginError, match=r"reference policy 'odd': actions must lie in 0\.\.2, not 7\.\.7"):
        evaluation.references(replace(entry, task=task), episodes=3)


def test_entries_without_parameters_say_so(kept: Train) -> None:
    store = EntryStore(kept("runs", [0, 1], 1))
    path = store.seed(0).path / "final.safetensors"
    whole = path.read_bytes()
    path.unlink()
    with pytest.raises(StoreError, match="has a learning curve but no trained parameters"):
        evaluation.trained(store, 2, 5)
    path.write_bytes(whole[:40])
    with pytest.raises(StoreError, match="is damaged"):
        evaluation.trained(store, 2, 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: {k: v for k, v in a.items() if k != "w0"}, "it has no 'w0'"),
        (lambda a: {**a, "w9": a["b0"]}, "it has 'w9', which the model has not"),
        (lambda a: {**a, "b0": a["b0"][:-1]}, "'b0' is float32 of shape"),
        (lambda a: {**a, "b0": a["b0"].astype(np.float64)}, "'b0' is float64"),
    ],
)
def test_parameters_of_another_model_are_refused(
    change: Callable[..., object], message: str, kept: Train
) -> None:
    from safetensors.numpy import load_file, save_file

    store = EntryStore(kept("runs", [0], 1))
    path = store.seed(0).path / "final.safetensors"
    save_file(change(load_file(path)), path)  # type: ignore[arg-type]
    with pytest.raises(StoreError, match="does not fit the entry's model") as refused:
        evaluation.trained(store, 1, 5)
    assert message in str(refused.value)
