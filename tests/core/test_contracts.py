"""What the core hands to models and algorithms that ask for more than observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import actions, specs
from qrlsuite.actions import draw
from qrlsuite.errors import EnvironmentFailure, PluginError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.training.group import lines_of
from qrlsuite.training.trainer import Trainer, count_parameters, play_episodes
from tests.environments.strangers import HERE

ASKED: list[tuple[Any, ...]] = []
SEEN: list[tuple[Any, ...]] = []


@dataclass(frozen=True)
class Nothing:
    """No options."""


def build(obs_dim: int, out_dim: int, options: Any, generator: Any, *, role: str, space: Any) -> nn.Module:
    ASKED.append((obs_dim, out_dim, role, space))
    return nn.Linear(obs_dim, out_dim)


class Watcher:
    """Builds an actor and a critic of observation and action, acts at random, and notes what `act` is given."""

    def __init__(self, envs: Any, build_model: Any, options: Any, streams: Any, device: Any) -> None:
        self.envs, self.streams, self.S = envs, streams, len(streams)
        observed = int(np.prod(envs.single_observation_space.shape))
        self.actor = build_model(2, role="actor")
        self.critic = build_model(1, inputs=observed + 2, role="critic")

    def start(self) -> None:
        self.envs.reset()

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        for _ in range(rounds):
            self.envs.step(draw(self.envs.single_action_space, np.random.default_rng(0), self.envs.num_envs))
        return {}

    def act(self, observations: NDArray[np.float32], begins: NDArray[np.bool_], infos: Any) -> NDArray[Any]:
        SEEN.append((observations.copy(), begins.copy(), dict(infos)))
        return draw(self.envs.single_action_space, np.random.default_rng(0), *observations.shape[:2])

    def state_dict(self) -> dict[str, Tensor]:
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        pass

    def policy_state(self) -> dict[str, Tensor]:
        return dict(self.actor.state_dict())


WATCHER = specs.AlgorithmSpec(
    "watcher", "notes what it is given", f"{__name__}:Nothing", f"{__name__}:Watcher",
    actions=("discrete", "multi-discrete", "multi-binary", "box"),
)  # fmt: skip
ASKING = specs.ModelSpec(
    "asking",
    "notes what it is given",
    family="classical",
    options=f"{__name__}:Nothing",
    build=f"{__name__}:build",
)


def entry(*arguments: str) -> Entry:
    words = ", ".join(f"{name} = '{value}'" for name, value in (word.split("=") for word in arguments))
    found = resolve(f"gym:{HERE}:Walk-v0", "mlp", None, [parse_setting(f"arguments={{{words}}}")])
    return replace(
        found, algorithm=WATCHER, model=ASKING, algorithm_options=Nothing(), model_options=Nothing()
    )


@pytest.fixture(autouse=True)
def _empty() -> None:
    ASKED.clear()
    SEEN.clear()


@pytest.mark.parametrize(("kind", "size"), [("image", 4), ("dict", 6)])
def test_a_model_that_asks_is_told_what_it_is_for_and_what_it_sees(kind: str, size: int) -> None:
    """An image keeps its shape in the space; the numbers are given flat, the observation's before the action's."""
    trainer = Trainer(entry(f"kind={kind}", "acts=box"), [0, 1])
    told = {asked[:3] for asked in ASKED}
    assert told == {(size, 2, "actor"), (size + 2, 1, "critic")}
    spaces = {type(asked[3]).__name__ for asked in ASKED}
    assert spaces == {"Box" if kind == "image" else "Dict"}
    if kind == "image":
        assert ASKED[0][3].shape == (2, 2)
    assert trainer.models.trained()["networks"] == 2
    assert count_parameters(entry(f"kind={kind}", "acts=box")) == (2 * size + 2, 0), "of the actor"


@pytest.mark.parametrize("acts", ["discrete", "multi-discrete", "multi-binary", "box"])
def test_an_algorithm_that_asks_is_told_where_episodes_begin(acts: str) -> None:
    trainer = Trainer(entry(f"acts={acts}", "masked=some"), [0, 1])
    trainer.start()
    trainer.train_epoch()
    first = SEEN[0]
    assert first[0].shape == (2, trainer.V, 4)
    assert first[1].shape == (2, trainer.V)
    assert first[1].all(), "every validation begins anew"
    assert [int(begins.sum()) for _, begins, _ in SEEN[1:3]] == [0, 0], "episodes have 3 steps or more"
    ended = np.sum([begins for _, begins, _ in SEEN[1:]], axis=0)
    assert (ended <= 1).all()
    assert ended.sum() == 2 * trainer.V - np.sum(~ended.astype(bool))
    for step, (_, _, infos) in enumerate(SEEN[:3]):
        assert set(infos) == {"action_mask"}
        assert infos["action_mask"].shape[:2] == (2, trainer.V)
        assert (infos["action_mask"][..., 0] == step % 2).all()
    with pytest.raises(ValueError, match="'watcher' remembers episodes: give act"):
        trainer.act(np.zeros((4, 4), np.float32))


def test_statistics_standardize_the_observation_and_leave_the_action() -> None:
    from qrlsuite.training.standardization import RunningStatistics

    statistics = RunningStatistics(2, 1, 3, torch.device("cpu"))
    for row in range(5):
        statistics.observe(np.array([[row, 2 * row, 1], [5, row, 0]], np.float32))
    statistics.adopt()
    x = torch.arange(20, dtype=torch.float32).reshape(2, 2, 5)
    (observed,), (both,) = statistics(nn.Identity(), (x[..., :3],)), statistics(nn.Identity(), (x,))
    assert torch.equal(both, torch.cat([observed, x[..., 3:]], 2))
    assert not torch.equal(observed, x[..., :3])


def test_what_an_environment_measures_is_recorded() -> None:
    """The means over a validation's episodes: their lengths, and of late ones 1; nothing of those that are not."""
    trainer = Trainer(entry("measured=steps-taken"), [0, 1])
    trainer.start()
    epoch = trainer.train_epoch()
    trainer.validation.seed_lanes([streams.numpy("validation", 1) for streams in trainer.streams])
    episodes = play_episodes(trainer.validation, lambda: trainer.act)
    lengths = episodes.lengths.reshape(2, -1)
    np.testing.assert_array_equal(epoch.measured["steps-taken"], lengths.mean(1))
    np.testing.assert_array_equal(epoch.measured["late"], np.where((lengths > 8).any(1), 1.0, np.nan))
    for line, steps in zip(lines_of(epoch), lengths.mean(1)):
        assert line.content["measured.steps-taken"] == steps
    wrong = Trainer(entry("measured=Steps taken"), [0])
    wrong.start()
    with pytest.raises(
        EnvironmentFailure, match=r"info\['metrics'\] of an episode has 'Steps taken' = .*: names are like"
    ):
        wrong.train_epoch()


def test_specs_know_the_kinds_of_actions() -> None:
    """`qrlsuite.specs` imports no Gymnasium, and so has the names once more."""
    spec = specs.AlgorithmSpec("any", "Any", options="a:b", factory="a:b", actions=tuple(actions.KINDS))
    assert spec.actions == tuple(actions.KINDS)
    with pytest.raises(PluginError, match=", ".join(actions.KINDS)):
        replace(spec, actions=("continuous",))


def test_a_plugin_that_changes_torchs_dtype_for_the_whole_process_is_refused(tiny_task: str) -> None:
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(PluginError, match=r"torch's default dtype to torch\.float64"):
            Trainer(resolve(tiny_task, "mlp"), [0])
    finally:
        torch.set_default_dtype(torch.float32)
