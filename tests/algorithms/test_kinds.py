"""Kinds of algorithms, models and actions on the contract: alone as in company, killed as never stopped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import masks, registry, specs
from qrlsuite.errors import EnvironmentFailure, OptionError, PluginError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.population import Adam, by_seed, gradients, part, prefixed
from qrlsuite.seeding import Streams
from qrlsuite.testing import algorithm, check
from qrlsuite.testing.common import Subject
from qrlsuite.testing.group import World
from qrlsuite.training.trainer import Trainer
from tests.environments.strangers import HERE

TASK = """
extends = "{task}"
name = "short"
summary = "A few steps"

[environment.options]
{options}

[protocol]
environments = 2
interactions = 12
validation_episodes = 2

[ranking]
horizons = [24]
"""


def entry(folder: Path, task: str, text: str) -> Entry:
    """An entry in its notation, on a task of short episodes; those of a walk have its arguments behind the name."""
    file, name, _, arguments = folder / "task.toml", *task.partition(" ")
    options = "steps = 10" if name == "cartpole" else "max_episode_steps = 10"
    if name == "walk":
        name, options = "pendulum", f"id = '{HERE}:Walk-v0'\narguments = {{{arguments}}}"
    file.write_text(TASK.format(task=name, options=options), encoding="utf-8")
    return resolve(str(file), text)


def trained(made: Entry, seeds: Sequence[int], pause: bool = False) -> dict[str, NDArray[Any]]:
    """Everything after two epochs, seed-first; with a pause another process, as it were, goes on after the first."""
    trainer = Trainer(made, seeds)
    trainer.start()
    scores = [trainer.train_epoch().scores]
    if pause:
        saved, trainer = trainer.capture(), Trainer(made, seeds)
        trainer.restore(1, saved)
    scores.append(trainer.train_epoch().scores)
    return {**trainer.capture(), **trainer.policy(), "scores": np.stack(scores, 1)}


def assert_contract(made: Entry) -> None:
    whole = trained(made, [0, 1, 2])
    for seeds in ([1], [2, 0]):
        for name, value in trained(made, seeds, pause=True).items():
            np.testing.assert_array_equal(value, whole[name][seeds], err_msg=f"{name} of {seeds}")


SMALL = {"sac": "batch=7 warm_up=4", "td3": "batch=7 warm_up=4", "ppo": "batch=5 repeats=2"}
CIRCUIT = "qubits=3 layers=1"


@pytest.mark.parametrize(
    ("algorithm", "model"),
    [
        *((algorithm, f"vqc-native {CIRCUIT}") for algorithm in SMALL),
        ("sac", "fourier"),
        ("sac", f"vqc-pennylane {CIRCUIT}"),
        ("sac", f"vqc-native {CIRCUIT} linear=false critic=mlp output_rate=100"),
    ],
)
def test_circuits_and_features_of_continuous_actions(algorithm: str, model: str, tmp_path: Path) -> None:
    assert_contract(entry(tmp_path, "pendulum", f"{algorithm} {model} {SMALL[algorithm]}"))


def test_heads_of_circuits(tmp_path: Path) -> None:
    """Factors on what is behind the circuit, perceptrons as critics, and what does not fit."""
    text = f"td3 vqc-native {CIRCUIT} linear=false {SMALL['td3']}"
    with pytest.raises(OptionError, match="the critic 4 inputs and 1 outputs: set critic=mlp"):
        Trainer(entry(tmp_path, "pendulum", text), [0])
    trainer = Trainer(entry(tmp_path, "pendulum", f"{text} critic=mlp output_rate=100"), [0])
    assert trainer.models.trained() == {
        "classical": 1 + 2 * (5 * 64 + 65 * 64 + 65),
        "quantum": 18,
        "networks": 3,
    }
    rates = trainer.algorithm.actor_adam.rates
    assert rates["output.weight"] == pytest.approx(100 * rates["circuit.weights"])


@pytest.mark.parametrize(
    ("task", "text"),
    [
        ("walk kind = 'image', masked = 'some'", "ddqn cnn kernel=2 depth=1 channels=3 width=5 batch=7"),
        (
            "walk kind = 'image', acts = 'box'",
            "td3 cnn kernel=2 depth=1 channels=3 width=5 batch=7 warm_up=4",
        ),
        ("walk masked = 'some'", "drqn gru width=5 batch=3 length=3 burn_in=2"),
        ("walk masked = 'some'", "ppo lstm width=5 batch=7"),
        ("walk masked = 'some'", "reinforce mlp width=5 memory=4"),
        ("walk masked = 'some'", "sac mlp width=5 batch=7 warm_up=4"),
        ("walk acts = 'multi-discrete', masked = 'some'", "ppo mlp width=5 batch=7"),
    ],
)
def test_images_masks_memory_and_joint_actions(task: str, text: str, tmp_path: Path) -> None:
    assert_contract(entry(tmp_path, task, text))


def test_an_entropy_that_no_policy_has_is_refused(tmp_path: Path) -> None:
    made = entry(tmp_path, "cartpole", "sac mlp width=5 target_entropy=0.7")
    with pytest.raises(
        OptionError, match=r"target_entropy = 0.7: a policy of 2 actions has log 2 = 0.6931 at most"
    ):
        Trainer(made, [0])


def test_masks_leave_something_to_choose(tmp_path: Path) -> None:
    with pytest.raises(
        EnvironmentFailure, match=r"'action_mask'\] leaves no action, and the episode goes on: end it"
    ):
        Trainer(entry(tmp_path, "walk masked = 'all'", "ddqn mlp width=5"), [0]).start()
    trainer = Trainer(entry(tmp_path, "walk masked = 'some'", "ddqn mlp width=5"), [0])
    with pytest.raises(EnvironmentFailure, match=r"'action_mask'\] has 2 numbers, and there are 3 choices"):
        trainer.envs._require_choice({"action_mask": np.ones((2, 2))})
    streams = [Streams("tests", seed) for seed in (0, 1)]
    seen = torch.tensor([[[0.5, 1, 0, 1]] * 200] * 2)  # one number is seen, and choice 1 is forbidden
    drawn = masks.drawn(torch.ones(2, 200, dtype=torch.int64), seen, 1, streams, 0, 0)
    assert set(drawn.unique().tolist()) == {0, 2}
    assert (drawn == 0).float().mean().item() == pytest.approx(0.5, abs=0.1)
    assert not torch.equal(drawn[0], drawn[1])
    outputs = torch.tensor([[[3.0, 9.0, float("-inf")]] * 200] * 2)
    assert masks.masked(outputs, seen, 1).argmax(2).unique().tolist() == [0]
    assert torch.softmax(masks.masked(outputs, seen, 1), 2)[..., 1].sum() == 0


@pytest.mark.parametrize("broken", ["masked", "drawn"])
def test_check_finds_an_algorithm_that_ignores_masks(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(masks, broken, lambda values, *more: values)
    subject = Subject(registry.get(specs.AlgorithmSpec, "ddqn"), None, (), {})
    (finding,) = algorithm._check_more(subject, World.toy("discrete", masked=True), "masks")
    assert not finding.ok
    assert "infos['action_mask'] forbids" in finding.message


@dataclass(frozen=True)
class Nothing:
    """No options."""


class Forgetful(nn.Linear):
    """Says that it remembers, and returns no next state."""

    remembers = 3

    def forward(self, x: Tensor, state: Tensor | None = None) -> Tensor:
        return super().forward(x)


def forgetful(inputs: int, outputs: int, options: Any, generator: torch.Generator) -> nn.Module:
    return Forgetful(inputs, outputs)


def test_a_model_that_forgets_its_state_and_actions_out_of_range(tmp_path: Path) -> None:
    spec = specs.ModelSpec("kind", "a kind", "classical", f"{__name__}:Nothing", f"{__name__}:forgetful")
    made = replace(entry(tmp_path, "cartpole", "drqn gru"), model=spec, model_options=Nothing())
    with pytest.raises(PluginError, match="`remembers` = 3 returns from forward"):
        trained(made, [0, 1])
    trainer = Trainer(entry(tmp_path, "pendulum", "td3 mlp width=5"), [0])
    trainer.start()
    with pytest.raises(
        PluginError,
        match=r"got an action outside its action space: actions must lie in -2\.\.2, not 3: .*from_units",
    ):
        trainer.envs.step(np.full((2, 1), 3, np.float32))


def specified(folder: Path, task: str, model: Any = None, algorithm: Any = None) -> Entry:
    """An entry with an algorithm or a model of this file."""
    made = entry(folder, task, "sac mlp width=5" if task == "pendulum" else "ddqn mlp width=5 batch=7")
    own = {side: spec for side, spec in (("model", model), ("algorithm", algorithm)) if spec is not None}
    options = {f"{side}_options": specs.resolve(spec.options)() for side, spec in own.items()}
    return replace(made, **own, **options)


class Evolution:
    """Keeps a random change of every agent's numbers where an epoch's mean reward is not less: (1+1), no gradients."""

    def __init__(self, envs: Any, build_model: Any, options: Any, streams: Any, device: Any) -> None:
        self.envs, self.streams, self.S = envs, streams, len(streams)
        self.network = build_model(int(envs.single_action_space.n)).requires_grad_(False)
        self.best, self.seen = torch.full((self.S,), -torch.inf, dtype=torch.float64), torch.zeros(0)
        self.epoch = 0

    def start(self) -> None:
        self.seen = by_seed(self.envs.reset()[0], self.S, torch.device("cpu"))

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        before = [value.clone() for value in self.network.parameters()]
        sources = [each.numpy("mutation", self.epoch) for each in self.streams]
        for value in self.network.parameters():
            value += torch.tensor(np.stack([s.normal(0, 0.1, value.shape[1:]) for s in sources])).to(value)
        total = torch.zeros(self.S, dtype=torch.float64)
        for _ in range(rounds):
            after, rewards, *_ = self.envs.step(self.network(self.seen).argmax(2).reshape(-1).numpy())
            total += torch.from_numpy(rewards.reshape(self.S, -1).mean(1))
            self.seen = by_seed(after, self.S, torch.device("cpu"))
        better = total >= self.best
        for value, old in zip(self.network.parameters(), before):
            value.copy_(torch.where(better.view(-1, *[1] * (old.dim() - 1)), value, old))
        self.best, self.epoch = torch.where(better, total, self.best), self.epoch + 1
        return {"reward": total.numpy()}

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        return self.network(torch.from_numpy(observations)).argmax(2).numpy()

    def policy_state(self) -> dict[str, Tensor]:
        return dict(self.network.state_dict())

    def state_dict(self) -> dict[str, Tensor]:
        counted = {"best": self.best, "seen": self.seen, "epoch": torch.full((self.S,), self.epoch)}
        return {**prefixed(network=self.network.state_dict()), **counted}

    def load_state_dict(self, state: Any) -> None:
        self.network.load_state_dict(part(state, "network"))
        self.best, self.seen, self.epoch = (
            state["best"].clone(),
            state["seen"].clone(),
            int(state["epoch"][0]),
        )


class Cloning:
    """Learns from a fixed data set, 40 observations and the action of their largest number, and steps nothing."""

    offline = True

    def __init__(self, envs: Any, build_model: Any, options: Any, streams: Any, device: Any) -> None:
        self.envs, self.S = envs, len(streams)
        size, choices = int(np.prod(envs.single_observation_space.shape)), int(envs.single_action_space.n)
        self.network = build_model(choices)
        self.adam = Adam(self.network, 1e-2, 1e-2)
        data = np.random.Generator(np.random.Philox(0)).random((40, size)).astype(np.float32)
        self.data, self.action = torch.from_numpy(data), torch.from_numpy(data.argmax(1) % choices)

    def start(self) -> None:
        self.envs.reset()

    def train_epoch(self, rounds: int) -> dict[str, NDArray[np.float64]]:
        log_policy = torch.log_softmax(self.network(self.data.expand(self.S, -1, -1)), 2)
        losses = -log_policy.gather(2, self.action.expand(self.S, -1)[..., None]).mean((1, 2))
        gradients(losses.sum(), self.network)
        self.adam.step()
        return {"loss": losses.detach().double().numpy()}

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        with torch.no_grad():
            return self.network(torch.from_numpy(observations)).argmax(2).numpy()

    def policy_state(self) -> dict[str, Tensor]:
        return dict(self.network.state_dict())

    def state_dict(self) -> dict[str, Tensor]:
        return prefixed(network=self.network.state_dict(), adam=self.adam.state_dict())

    def load_state_dict(self, state: Any) -> None:
        self.network.load_state_dict(part(state, "network"))
        self.adam.load_state_dict(part(state, "adam"))


@pytest.mark.parametrize("kind", [Evolution, Cloning])
def test_algorithms_without_gradients_and_without_interactions(kind: type[Any], tmp_path: Path) -> None:
    spec = specs.AlgorithmSpec("kind", "a kind", f"{__name__}:Nothing", f"{__name__}:{kind.__name__}")
    assert not [finding for finding in check("algorithm", spec) if not finding.ok]
    assert_contract(specified(tmp_path, "cartpole", algorithm=spec))


@dataclass(frozen=True)
class Bond:
    """Options of a matrix product."""

    bond: Annotated[int, Field(ge=1, description="bond dimension")] = 3


class MatrixProduct(nn.Module):
    """A matrix product state of the inputs: a row, a matrix A + x B for each of them, and a matrix of outputs."""

    def __init__(self, inputs: int, outputs: int, options: Bond, generator: torch.Generator) -> None:
        super().__init__()
        shape = (2, inputs, options.bond, options.bond)
        self.cores = nn.Parameter(torch.eye(options.bond) / 2 + 0.3 * torch.randn(shape, generator=generator))
        self.last = nn.Parameter(torch.randn(options.bond, outputs, generator=generator))

    def forward(self, x: Tensor) -> Tensor:
        row = torch.ones_like(x[:, :1]).expand(-1, self.last.shape[0])
        for k in range(x.shape[1]):
            core = self.cores[0, k] + x[:, k, None, None] * self.cores[1, k]
            row = (row[:, :, None] * core).sum(1)
        return (row[:, :, None] * self.last).sum(1)


def matrix_product(inputs: int, outputs: int, options: Bond, generator: torch.Generator) -> nn.Module:
    return MatrixProduct(inputs, outputs, options, generator)


class Foreign(torch.autograd.Function):
    """tanh(x W) by JAX, and its gradients."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        import jax

        arrays = (x.detach().numpy(), weight.detach().numpy())
        with jax.enable_x64(True):
            values, ctx.back = jax.vjp(lambda a, w: jax.numpy.tanh((a[:, :, None] * w).sum(1)), *arrays)
        return torch.from_numpy(np.array(values))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        import jax

        with jax.enable_x64(True):
            return tuple(torch.from_numpy(np.array(each)) for each in ctx.back(gradient.numpy()))


class OfJax(nn.Module):
    def __init__(self, inputs: int, outputs: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(inputs, outputs, generator=generator))

    def forward(self, x: Tensor) -> Tensor:
        values: Tensor = Foreign.apply(x, self.weight)
        return values


def of_jax(inputs: int, outputs: int, options: Any, generator: torch.Generator) -> nn.Module:
    return OfJax(inputs, outputs, generator)


@pytest.mark.parametrize(
    ("build", "options", "population"),
    [("matrix_product", "Bond", None), ("of_jax", "Nothing", "qrlsuite.population:loop")],
)
def test_models_of_other_frameworks_and_forms(
    build: str, options: str, population: str | None, tmp_path: Path
) -> None:
    if build == "of_jax":
        pytest.importorskip("jax")
    spec = specs.ModelSpec(
        "kind", "a kind", family="classical", options=f"{__name__}:{options}", build=f"{__name__}:{build}",
        population=population,
    )  # fmt: skip
    assert not [finding for finding in check("model", spec) if not finding.ok]
    assert_contract(specified(tmp_path, "cartpole", model=spec))
