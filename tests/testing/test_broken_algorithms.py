"""Algorithms that break one rule each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass
from torch import Tensor

from qrlsuite.algorithm import BuildModel
from qrlsuite.environment import LaneEnv
from qrlsuite.options import Tuned
from qrlsuite.seeding import Streams
from qrlsuite.specs import AlgorithmSpec
from tests.testing.broken import Broken, assert_breaks, ids, own_rules

HERE = __name__


@dataclass(frozen=True)
class Options:
    epsilon: float = 0.2
    lr: float = 0.1


@dataclass(frozen=True)
class PerAgentOptions(Options):
    lr: Annotated[float, Tuned(0.1, 0.2, per_agent=True)] = 0.1


class Good:
    """Gradient descent on the squared difference between a value and the reward that followed; no bootstrapping."""

    def __init__(
        self,
        envs: LaneEnv,
        build_model: BuildModel,
        options: Options,
        streams: Sequence[Streams],
        device: torch.device,
    ) -> None:
        self.envs, self.options, self.streams = envs, options, streams
        self.size, self.lanes = len(streams), envs.num_envs // len(streams)
        self.actions = int(envs.single_action_space.n)  # type: ignore[attr-defined]
        self.values = build_model(self.outputs())
        self.epoch = 0
        self.observations = torch.zeros(self.size, self.lanes, 4)

    def outputs(self) -> int:
        return self.actions

    def start(self) -> None:
        self.observe(self.envs.reset()[0])

    def observe(self, observations: NDArray[np.float32]) -> None:
        self.observations = torch.from_numpy(observations).view(self.size, self.lanes, -1)

    def draw(self, rounds: int) -> tuple[Tensor, Tensor]:
        """Return whether to explore, and how (S, rounds, E)."""
        shape = (rounds, self.lanes)
        streams = [s.numpy("exploration", self.epoch) for s in self.streams]
        explore = np.stack([s.random(shape) < self.options.epsilon for s in streams])
        return torch.from_numpy(explore), torch.from_numpy(
            np.stack([s.integers(self.actions, size=shape) for s in streams])
        )

    def train_epoch(self, rounds: int) -> Any:
        explore, randomly = self.draw(rounds)
        seen, taken, gained = [], [], []
        for k in range(rounds):
            chosen = torch.where(explore[:, k], randomly[:, k], self.greedy(self.observations))
            seen.append(self.observations)
            after, rewards, *_ = self.envs.step(self.lane_actions(chosen))
            self.observe(after)
            taken.append(chosen)
            gained.append(torch.from_numpy(rewards.astype(np.float32)).view(self.size, self.lanes))
        values = self.values(torch.cat(seen, 1)).gather(2, torch.cat(taken, 1)[..., None])[..., 0]
        loss = (values - torch.cat(gained, 1)).square().mean(1)
        self.learn(loss)
        self.epoch += 1
        return {"loss": loss.detach().double().numpy()}

    @torch.no_grad()
    def greedy(self, observations: Tensor) -> Tensor:
        values: Tensor = self.values(observations)
        return values.argmax(2)

    def lane_actions(self, chosen: Tensor) -> NDArray[np.int64]:
        flat: NDArray[np.int64] = chosen.reshape(-1).numpy()
        return flat

    def total(self, loss: Tensor) -> Tensor:
        return loss.sum()

    def learn(self, loss: Tensor) -> None:
        parameters = list(self.values.parameters())
        for parameter, gradient in zip(parameters, torch.autograd.grad(self.total(loss), parameters)):
            with torch.no_grad():
                parameter.sub_(self.options.lr * gradient)

    def act(self, observations: NDArray[np.float32]) -> Any:
        return self.greedy(torch.from_numpy(observations)).numpy()

    def policy_state(self) -> dict[str, Tensor]:
        return dict(self.values.state_dict())

    def state_dict(self) -> dict[str, Any]:
        return {
            **self.values.state_dict(),
            "observations": self.observations,
            "epoch": torch.tensor([self.epoch] * self.size),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.values.load_state_dict({name: state[name] for name in self.values.state_dict()})
        self.observations = state["observations"].clone()
        self.epoch = int(state["epoch"][0])


class TwoActions(Good):
    def outputs(self) -> int:
        return 2


class NoDevice(Good):
    def __init__(self, envs: LaneEnv, build_model: BuildModel, options: Options, streams: Any) -> None:
        super().__init__(envs, build_model, options, streams, torch.device("cpu"))


class Unreturned(Good):
    def train_epoch(self, rounds: int) -> Any:
        super().train_epoch(rounds)


class MeanLoss(Good):
    def train_epoch(self, rounds: int) -> Any:
        return {name: values.mean() for name, values in super().train_epoch(rounds).items()}


class HalfPrecision(Good):
    def train_epoch(self, rounds: int) -> Any:
        return {name: values.astype(np.float32) for name, values in super().train_epoch(rounds).items()}


class TwoAxes(Good):
    def lane_actions(self, chosen: Tensor) -> NDArray[np.int64]:
        return chosen.numpy()  # type: ignore[no-any-return]


class OneTooMany(Good):
    def lane_actions(self, chosen: Tensor) -> NDArray[np.int64]:
        return super().lane_actions(chosen) + 1


class WithoutStart(Good):
    def start(self) -> None:
        pass


class WholeEpisodes(Good):
    def train_epoch(self, rounds: int) -> Any:
        return super().train_epoch(rounds + 3)


class Exploring(Good):
    """Another action at every second call."""

    calls = 0

    def act(self, observations: NDArray[np.float32]) -> Any:
        self.calls += 1
        return (super().act(observations) + self.calls % 2) % self.actions


class Tensors(Good):
    def act(self, observations: NDArray[np.float32]) -> Any:
        return torch.from_numpy(super().act(observations))


class PerSeed(Good):
    def act(self, observations: NDArray[np.float32]) -> Any:
        return super().act(observations)[:, 0]


class FromOne(Good):
    def act(self, observations: NDArray[np.float32]) -> Any:
        return super().act(observations) + 1


class Counting(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.calls = torch.zeros(self.size)

    def act(self, observations: NDArray[np.float32]) -> Any:
        self.calls += 1
        return super().act(observations)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "calls": self.calls.clone()}


class Distracted(Good):
    """Its next epoch has less exploration once it has acted."""

    acted = False

    def act(self, observations: NDArray[np.float32]) -> Any:
        self.acted = True
        return super().act(observations)

    def draw(self, rounds: int) -> tuple[Tensor, Tensor]:
        explore, randomly = super().draw(rounds)
        return explore & (not self.acted), randomly


class Idle(Good):
    def learn(self, loss: Tensor) -> None:
        pass


class LastIdle(Good):
    def total(self, loss: Tensor) -> Tensor:
        return loss[[s.seed != 2 for s in self.streams]].sum()


class Published(Good):
    def policy_state(self) -> dict[str, Tensor]:
        return {name: value.clone() for name, value in super().policy_state().items()}


class Untitled(Good):
    def policy_state(self) -> dict[str, Tensor]:
        return {name: value[0] for name, value in super().policy_state().items()}


class Secret(Good):
    def policy_state(self) -> dict[str, Tensor]:
        return {}


class FromGlobal(Good):
    def draw(self, rounds: int) -> tuple[Tensor, Tensor]:
        explore, randomly = super().draw(rounds)
        return explore, (randomly + torch.initial_seed() % 3) % 3


class AllAlike(Good):
    """Neither its parameters nor what it learns have to do with the seed."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        for parameter in self.values.parameters():
            parameter.data.zero_()

    def learn(self, loss: Tensor) -> None:
        for parameter in self.values.parameters():
            parameter.data += 0.01


class OneEpoch(Good):
    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "epoch": torch.tensor(self.epoch)}


class Plain(Good):
    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "epoch": [self.epoch] * self.size}


class Stateless(Good):
    def state_dict(self) -> dict[str, Any]:
        return {}


class Averaging(Good):
    def total(self, loss: Tensor) -> Tensor:
        return loss.mean()


class Restarting(Good):
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        super().load_state_dict(state)
        self.epoch = 0


class Blind(Good):
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        super().load_state_dict(state)
        self.observations = torch.zeros_like(state["observations"])


class InPlace(Good):
    """Makes room for observations when it starts, and so cannot be resumed."""

    def start(self) -> None:
        self.room = torch.zeros(self.size, self.lanes, 4)
        super().start()

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        super().load_state_dict(state)
        self.room.copy_(state["observations"])


class OneRate(Good):
    """All agents learn at the mean of their rates."""

    def learn(self, loss: Tensor) -> None:
        parameters = list(self.values.parameters())
        rate = float(torch.as_tensor(self.options.lr).mean())
        for parameter, gradient in zip(parameters, torch.autograd.grad(self.total(loss), parameters)):
            with torch.no_grad():
                parameter.sub_(rate * gradient)


def algorithm(factory: type, options: type = Options) -> AlgorithmSpec:
    reference = f"{HERE}:{factory.__name__}"
    return AlgorithmSpec(factory.__name__.lower(), "Breaks a rule", f"{HERE}:{options.__name__}", reference)


BROKEN = [
    ("builds", Broken(algorithm(TwoActions), r"called with \[2\] outputs, and there are 3 actions: take envs.single")),
    ("builds", Broken(algorithm(NoDevice), r"TypeError: .*; the factory takes \(envs, build_model, options, streams,")),
    ("trains", Broken(algorithm(Unreturned), r"train_epoch returned NoneType, not a dict of metrics")),
    ("trains", Broken(algorithm(MeanLoss), r"'loss' is float64 of shape \(\), and .* \(5,\): one number per seed")),
    ("trains", Broken(algorithm(HalfPrecision), r"'loss' is float32 .* must be float64")),
    ("trains", Broken(algorithm(TwoAxes), r"int64 of shape \(5, 2\), and needs 10 integers: lanes are seed-major")),
    ("trains", Broken(algorithm(OneTooMany), r"stepped with actions 1..3, and there are 3: they count from 0")),
    ("trains", Broken(algorithm(WithoutStart), r"stepped before it was reset: start\(\) resets it")),
    ("interactions", Broken(algorithm(WholeEpisodes), r"of 40 rounds .* stepped 43 times: .* an epoch is cut")),
    ("acts", Broken(algorithm(Exploring), r"act chooses differently on the same observations: it must be greedy")),
    ("acts", Broken(algorithm(Tensors), r"act returned Tensor, and must return a numpy array: end with .cpu\(\)")),
    ("acts", Broken(algorithm(PerSeed), r"int64 of shape \(5,\), and must return int64 of shape \(5, 8\): one action")),
    ("acts", Broken(algorithm(FromOne), r"act chose 1..3, and there are the actions 0..2")),
    ("acts", Broken(algorithm(Counting), r"act changes the state 'algorithm.calls': validation must leave no trace")),
    ("acts", Broken(algorithm(Distracted), r"an epoch after act ends with another '.*' than without it: validation")),
    ("learns", Broken(algorithm(Idle), r"240 interactions, the policy of seed 0 is as it was: is the optimizer")),
    ("learns", Broken(algorithm(LastIdle), r"the policy of seed 2 is as it was")),
    ("learns", Broken(algorithm(Published), r"do not make a new algorithm act as the trained one: return the tensors")),
    ("learns", Broken(algorithm(Untitled), r"policy 'weight' of shape \(3, 4\) has no leading axis of 5 seeds")),
    ("learns", Broken(algorithm(Secret), r"policy_state\(\) is empty: it is what", frozenset({"different seed"}))),
    ("same seed", Broken(algorithm(FromGlobal), r"seeds trained twice differ in '.*': draw from streams\[s\].numpy\(")),
    ("different seed", Broken(algorithm(AllAlike), r"seeds 0 and 1 became the same agent: are populations built by")),
    ("state is seed-first", Broken(algorithm(OneEpoch), r"'epoch' of shape \(\) has .* torch.tensor\(\[count\]")),
    ("state is seed-first", Broken(algorithm(Plain), r"state 'epoch' is list, not a tensor")),
    ("state is seed-first", Broken(algorithm(Stateless), r"state_dict\(\) is empty: what training depends on is lost")),
    (
        "seed independence",
        Broken(
            algorithm(Averaging),
            r"seeds \[0\] trained among themselves differ from those .* all 5 in 'algorithm.weight': sum the agents'",
            frozenset({"state"}),
        ),
    ),
    ("options per agent", Broken(algorithm(OneRate, PerAgentOptions), r"lr = 0.1 differs in '.*' beside one with")),
    ("options per agent", Broken(algorithm(Good, PerAgentOptions), r"RuntimeError: .*; an option marked per_agent")),
    ("state", Broken(algorithm(Restarting), r"resumed .* differ in 'algorithm.weight' .* the epoch's number belong")),
    ("state", Broken(algorithm(Blind), r"current observations and the epoch's number belong into state_dict\(\)")),
    ("state", Broken(algorithm(InPlace), r"no attribute 'room'; load_state_dict\(\) takes .* in place of start\(\)")),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "case"), BROKEN, ids=ids(BROKEN))
def test_one_rule_is_broken(rule: str, case: Broken) -> None:
    assert_breaks("algorithms", rule, case)


def test_every_rule_has_an_algorithm_that_breaks_it() -> None:
    findings = own_rules("algorithms", algorithm(Good))
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in BROKEN}
