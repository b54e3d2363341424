"""What every registered algorithm keeps to: seeds apart, exact resuming, and that it learns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from qrlsuite import registry, specs
from qrlsuite.engine.worker import train_group
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.results.store import EntryStore
from qrlsuite.testing.group import Toy
from qrlsuite.training.trainer import Trainer, asks_for_more
from tests.algorithms.worlds import Contexts, Group
from tests.conftest import results

E = 3
COUNTED = {
    "ddqn": ((), 1, (387, 0), (17, 12)),  # its target network is a copy
    "ppo": ((), 2, (387 + 353, 0), (17 + 11, 12 + 12)),
    "reinforce": ((), 1, (387, 0), (17, 12)),
    "drqn": ((), 1, (387, 0), (17, 12)),
    "sac": ((), 3, (387 * 3, 0), (17 + 2 * 17, 12 * 3)),
    "reinforce with a value network": (("baseline=value",), 2, (387 + 353, 0), (17 + 11, 12 + 12)),
}
"""Networks, and classical and quantum parameters: 3 inputs, 3 outputs or 1, width 16 and depth 2; 2 qubits, 1 layer."""
VARIANTS: dict[str, list[dict[str, Any]]] = {
    "ddqn": [
        {"buffer": 50, "batch": 16, "target_steps": 4},
        {"buffer": 50, "batch": 16, "decay_steps": 55, "epsilon_steps": 40},
    ],
    "ppo": [
        {"batch": 8, "repeats": 2},
        {"batch": 64, "repeats": 3, "validation": "sampled"},
        {"batch": 8, "repeats": 2, "value_clip": 0.01, "longest_gradient": 0.1, "decay_steps": 55},
    ],
    "drqn": [{"buffer": 40, "batch": 7, "length": 3, "burn_in": 2, "target_steps": 4}],
    "sac": [{"buffer": 50, "batch": 7, "warm_up": 12, "decay_steps": 55}],
    "td3": [{"buffer": 50, "batch": 7, "warm_up": 12, "updates": 2}],
    "reinforce": [{"baseline": b, "memory": m} for b, m in (("none", 4), ("mean", 90), ("value", 12))],
}
CASES = [
    (name, case) for name in registry.load().names(specs.AlgorithmSpec) for case in VARIANTS.get(name, [{}])
]
IDS = [f"{name}-{'-'.join(str(v) for v in case.values())}" for name, case in CASES]
every_algorithm = pytest.mark.parametrize(("name", "case"), CASES, ids=IDS)


@pytest.mark.parametrize("case", COUNTED)
def test_parameters_are_those_of_all_trained_networks(case: str, tiny_task: str) -> None:
    words, networks, *expected = COUNTED[case]
    for model, sizes, numbers in zip(
        ("mlp", "vqc-native"), (("width=16",), ("qubits=2", "layers=1")), expected
    ):
        settings = [parse_setting(word) for word in (*sizes, *words)]
        trainer = Trainer(resolve(tiny_task, model, case.split()[0], settings), [0, 1])
        told = {"classical": numbers[0], "quantum": numbers[1], "networks": networks}
        assert trainer.models.trained() == told
        trainer.models(3).requires_grad_(False)
        assert trainer.models.trained() == told, "a frozen network is not trained"


def group(name: str, seeds: Sequence[int], case: dict[str, Any], **more: Any) -> Group:
    """An algorithm on the discrete bandit if it takes discrete actions, else on the toy of the first that it does."""
    kinds = registry.get(specs.AlgorithmSpec, name).actions
    lanes = len(seeds) * E
    return Group(
        name, seeds, Contexts(lanes) if "discrete" in kinds else Toy(lanes, kinds[0]), **more, **case
    )


def trained(name: str, seeds: Sequence[int], case: dict[str, Any], **more: Any) -> dict[str, NDArray[Any]]:
    """Everything a group has after three epochs: its state, its metrics and its actions; seed-first."""
    made = group(name, seeds, case, **more).start()
    result: dict[str, NDArray[Any]] = {}
    for epoch in range(3):
        for metric, values in made.algorithm.train_epoch(7).items():
            result[f"{metric}{epoch}"] = values
        result[f"actions{epoch}"] = np.stack([actions(made) for _ in range(3)], axis=1)
    for network, counts in enumerate(made.executions()):  # one number for all agents: it must not follow one
        for kind, count in counts.items():
            result[f"{kind} executions {network}"] = np.full(len(seeds), count)
    return {**made.save(), **result}


def actions(made: Group) -> NDArray[Any]:
    observations = [s.numpy("test").random((11, 4)).astype(np.float32) for s in made.streams]
    more = (np.ones((len(made.streams), 11), np.bool_), {}) if asks_for_more(made.algorithm.act) else ()
    chosen: NDArray[Any] = made.algorithm.act(np.stack(observations), *more)
    return chosen


def assert_same(
    part: dict[str, NDArray[Any]], members: Sequence[int], whole: dict[str, NDArray[Any]]
) -> None:
    assert part.keys() == whole.keys()
    for key, array in whole.items():
        message = f"{key} of {members}"
        np.testing.assert_array_equal(part[key], array[list(members)], err_msg=message, strict=True)


@every_algorithm
def test_a_hundred_seeds_do_not_change_one(name: str, case: dict[str, Any]) -> None:
    """Wide layers, whose products are computed by another library routine than narrow ones."""
    more: dict[str, Any] = {"model_options": {"width": 64, "depth": 2}}
    whole = trained(name, range(100), case, **more)
    for members in ([0], [99], [37, 38, 39]):
        assert_same(trained(name, members, case, **more), members, whole)


PENDULUM = """
extends = "pendulum"
name = "short-pendulum"
summary = "A few steps of it"

[environment.options]
max_episode_steps = 10

[protocol]
environments = 2
interactions = 20
validation_episodes = 3

[ranking]
horizons = [40]
"""


@every_algorithm
def test_stored_results_do_not_depend_on_groups(
    name: str, case: dict[str, Any], tiny_task: str, tmp_path: Path
) -> None:
    """Through the core, with a circuit: curves, executions and agents are the same bytes, also after a pause."""
    settings = {"qubits": 2, "layers": 1, **{f"algorithm.{k}": v for k, v in case.items()}}
    words = [parse_setting(f"{k}={v}") for k, v in settings.items()]
    if "discrete" not in registry.get(specs.AlgorithmSpec, name).actions:
        tiny_task = str(tmp_path / "task.toml")
        Path(tiny_task).write_text(PENDULUM, encoding="utf-8")
    entry = resolve(tiny_task, "vqc-native", name, words)
    plans = {"together": [([0, 1, 2], 3)], "apart": [([1], 1), ([0, 2], 2), ([1], 2), ([2, 1, 0], 3)]}
    folders = []
    for folder, stages in plans.items():
        store = EntryStore.create(tmp_path / folder, entry)
        for seeds, epochs in stages:
            train_group(store.path, seeds, epochs)
        folders.append(store.path)
    for seed in range(3):
        assert results(folders[0], seed) == results(folders[1], seed)


LEARNING: dict[str, tuple[int, int, dict[str, Any]]] = {
    "ddqn": (3, 150, {"lr": 5e-3, "gamma": 0.5, "target_steps": 50}),
    "ppo": (8, 60, {"lr": 5e-3}),
    "reinforce": (60, 20, {"lr": 3e-2, "memory": 10, "gamma": 0.5}),
    "reinforce-mean": (60, 20, {"lr": 3e-2, "memory": 10, "gamma": 0.5, "baseline": "mean"}),
    "reinforce-value": (60, 20, {"lr": 3e-2, "memory": 10, "gamma": 0.5, "baseline": "value"}),
}


@pytest.mark.parametrize("label", LEARNING)
def test_it_learns_a_bandit(label: str) -> None:
    """After seconds every seed knows the action of every context, at every step."""
    epochs, rounds, settings = LEARNING[label]
    made = group(label.partition("-")[0], range(4), settings).start()
    grid = np.array([[*np.eye(3)[c], t / 10] for c in range(3) for t in range(8)], dtype=np.float32)
    wanted = np.repeat(np.arange(3), 8)

    def correct() -> NDArray[np.float64]:
        shares: NDArray[np.float64] = (made.algorithm.act(np.stack([grid] * 4)) == wanted).mean(1)
        return shares

    assert correct().mean() < 0.7
    for _ in range(epochs):
        made.algorithm.train_epoch(rounds)
    assert correct().min() > 0.95
