"""What an algorithm keeps to: seeds apart, exact resuming, and that it learns from its own interactions alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from torch import Tensor, nn

from qrlsuite import population, specs
from qrlsuite.environment import LaneEnv, State, batched_spaces
from qrlsuite.seeding import Streams, pack, unpack
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import SIZES, Checklist, Finding, one_thread, require

S, E, OBS, ACTIONS, ROUNDS = 5, 2, 4, 3, 40


class Toy(LaneEnv):
    """Reward 1 for the action that the observation shows; episodes of 2 to 10 steps, terminated or truncated."""

    def __init__(self, lanes: int) -> None:
        batched_spaces(self, Box(0.0, 2.0, (OBS,)), Discrete(ACTIONS), lanes)
        self.streams = []
        self.steps = 0
        self.kept = np.zeros((lanes, 4), dtype=np.int64)
        """Step, length, context, and whether the episode is to be truncated, of every lane."""

    def _begin(self, lane: int) -> None:
        stream = self.streams[lane]
        self.kept[lane] = 0, stream.integers(2, 11), stream.integers(ACTIONS), stream.integers(2)

    def _observe(self) -> NDArray[np.float32]:
        return np.column_stack([np.eye(ACTIONS)[self.kept[:, 2]], self.kept[:, 0] / 10]).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every lane."""
        for lane in range(self.num_envs):
            self._begin(lane)
        return self._observe(), {}

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take actions (L,)."""
        taken = np.asarray(actions)
        require(
            taken.shape == (self.num_envs,) and taken.dtype.kind == "i",
            f"the environment was stepped with {taken.dtype} of shape {taken.shape}, and needs {self.num_envs} "
            "integers: lanes are seed-major, so reshape (S, E) to (S * E,)",
        )
        require(
            bool((taken >= 0).all() and (taken < ACTIONS).all()),
            f"the environment was stepped with actions {taken.min()}..{taken.max()}, and there are {ACTIONS}",
        )
        self.steps += 1
        rewards = (taken == self.kept[:, 2]).astype(np.float64)
        self.kept[:, 0] += 1
        self.kept[:, 2] = [stream.integers(ACTIONS) for stream in self.streams]
        done = self.kept[:, 0] >= self.kept[:, 1]
        cut = self.kept[:, 3] == 1
        final = self._observe()
        for lane in np.flatnonzero(done):
            self._begin(int(lane))
        infos: dict[str, Any] = {}
        if done.any():
            infos = {"final_obs": final, "_final_obs": done, "final_info": {}, "_final_info": done}
        return self._observe(), rewards, done & ~cut, done & cut, infos

    def state_dict(self) -> State:
        """Return the lanes' state (L, 4)."""
        return {"kept": self.kept.copy()}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore it."""
        self.kept = np.array(state["kept"])


class _Linear(nn.Module):
    """One layer whose parameters come from the generator."""

    def __init__(self, out_dim: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = 1 / math.sqrt(OBS)
        self.weight = nn.Parameter((torch.rand(out_dim, OBS, generator=generator) * 2 - 1) * bound)
        self.bias = nn.Parameter(torch.zeros(out_dim))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, 4) to (B, out)."""
        return population.linear(x[None], self.weight[None], self.bias[None])[0]


class Group:
    """An algorithm with a group of seeds, as the core runs it."""

    def __init__(self, subject: Subject, seeds: Sequence[int]) -> None:
        spec = subject.spec
        assert isinstance(spec, specs.AlgorithmSpec)
        self.seeds = list(seeds)
        self.streams = [Streams("conformance", seed) for seed in seeds]
        self.envs = Toy(len(self.seeds) * E)
        self.envs.seed_lanes([s.numpy("environment", e) for s in self.streams for e in range(E)])
        self.outputs: list[int] = []
        factory = specs.resolve(spec.factory)
        self.algorithm = factory(self.envs, self._model, subject.options(), self.streams, torch.device("cpu"))

    def _model(self, out_dim: int) -> nn.Module:
        call = len(self.outputs)
        self.outputs.append(out_dim)
        return population.stack([_Linear(out_dim, s.torch("init", call)) for s in self.streams])

    def start(self) -> Group:
        """Begin."""
        self.algorithm.start()
        return self

    def train(self, epochs: int = 1) -> dict[str, NDArray[Any]]:
        """Train; returns the last epoch's metrics."""
        metrics: dict[str, NDArray[Any]] = {}
        for _ in range(epochs):
            metrics = self.algorithm.train_epoch(ROUNDS)
        return metrics

    def act(self) -> NDArray[np.int64]:
        """Return the greedy actions on fixed observations (S, 8, 4)."""
        observations = np.stack([s.numpy("look").random((8, OBS)).astype(np.float32) for s in self.streams])
        chosen: NDArray[np.int64] = self.algorithm.act(observations)
        return chosen

    def save(self) -> dict[str, NDArray[Any]]:
        """Return everything, seed-first."""
        saved = {f"algorithm.{k}": v.detach().numpy().copy() for k, v in self.algorithm.state_dict().items()}
        size = len(self.seeds)
        saved["environment"] = self.envs.kept.reshape(size, E, -1).copy()
        saved["streams"] = pack(self.envs.streams).reshape(size, E, -1)
        return saved

    def load(self, saved: Mapping[str, NDArray[Any]]) -> Group:
        """Restore what `save` returned, or slices of it."""
        lanes = len(self.seeds) * E
        self.envs.kept = saved["environment"].reshape(lanes, -1).copy()
        self.envs.seed_lanes(unpack(saved["streams"].reshape(lanes, -1)))
        self.algorithm.load_state_dict(
            {
                k.removeprefix("algorithm."): torch.from_numpy(v.copy())
                for k, v in saved.items()
                if k.startswith("algorithm.")
            }
        )
        return self


def check(subject: Subject) -> list[Finding]:
    """Check an algorithm on an environment of four inputs and three actions."""
    rules = Checklist()
    with one_thread():
        cause = "the factory takes (envs, build_model, options, streams, device)"
        if not rules.run(
            "builds", "factory, and a population with one output per action", lambda: _builds(subject), cause
        ):
            return rules.findings
        if not rules.run("trains", "an epoch gives metrics (S,) in float64", lambda: _trains(subject)):
            return rules.findings
        rules.run(
            "interactions",
            f"{ROUNDS} rounds are {ROUNDS} steps of every lane",
            lambda: _interactions(subject),
        )
        rules.run("acts", "integers (S, B), the same every time, changing nothing", lambda: _acts(subject))
        rules.run("learns", "parameters change, and the policy's are published", lambda: _learns(subject))
        rules.run("same seed", "the same streams give the same bits", lambda: _same(subject))
        rules.run("different seed", "other seeds become other agents", lambda: _different(subject))
        if not rules.run("state is seed-first", "every tensor of it", lambda: _seed_first(subject)):
            return rules.findings
        rules.run(
            "seed independence", "alone, in pairs, shuffled: the same bits", lambda: _independence(subject)
        )
        rules.run("state", "saved, sliced and restored exactly", lambda: _state(subject))
    return rules.findings


def _builds(subject: Subject) -> None:
    made = Group(subject, range(S))
    require(
        ACTIONS in made.outputs,
        f"build_model was called with {made.outputs} outputs, and there are {ACTIONS} actions: take "
        "envs.single_action_space.n",
    )


def _trains(subject: Subject) -> None:
    metrics = Group(subject, range(S)).start().train()
    require(
        isinstance(metrics, dict), f"train_epoch returned {type(metrics).__name__}, not a dict of metrics"
    )
    for name, values in metrics.items():
        got = np.asarray(values)
        require(
            got.shape == (S,) and got.dtype == np.float64,
            f"metric '{name}' is {got.dtype} of shape {got.shape}, and must be float64 of shape ({S},): one number "
            "per seed",
        )


def _interactions(subject: Subject) -> None:
    made = Group(subject, range(S)).start()
    for epoch in (1, 2):
        made.train()
        require(
            made.envs.steps == epoch * ROUNDS,
            f"after {epoch} epochs of {ROUNDS} rounds the lanes were stepped {made.envs.steps} times: sample "
            "complexity counts interactions, so an epoch is cut where its rounds end, also inside an episode",
        )


def _acts(subject: Subject) -> None:
    made = Group(subject, range(S)).start()
    made.train()
    before = made.save()
    first, second = made.act(), made.act()
    require(
        first.shape == (S, 8) and first.dtype == np.int64,
        f"act returned {first.dtype} of shape {first.shape}, and must return int64 of shape ({S}, 8)",
    )
    require(bool((first >= 0).all() and (first < ACTIONS).all()), f"act chose outside 0..{ACTIONS - 1}")
    require(
        np.array_equal(first, second), "act chooses differently on the same observations: it must be greedy"
    )
    name = _differs(before, made.save())
    require(name is None, f"act changes the state '{name}': validation must leave no trace in training")


def _learns(subject: Subject) -> None:
    made = Group(subject, range(S)).start()
    before = {k: v.detach().clone() for k, v in made.algorithm.policy_state().items()}
    require(bool(before), "policy_state() is empty: it is what is published as the trained agents")
    made.train(3)
    after = made.algorithm.policy_state()
    for name, value in after.items():
        require(
            value.dim() > 0 and value.shape[0] == S,
            f"policy '{name}' of shape {tuple(value.shape)} has no leading axis of {S} seeds",
        )
    for s in range(S):
        require(
            any(not torch.equal(before[name][s], value[s]) for name, value in after.items()),
            f"after three epochs the policy of seed {s} is as it was: is the optimizer stepped, and is policy_state() "
            "the network that act uses?",
        )


def _differs(a: Mapping[str, NDArray[Any]], b: Mapping[str, NDArray[Any]]) -> str | None:
    if a.keys() != b.keys():
        return ", ".join(sorted(a.keys() ^ b.keys()))
    return next((k for k, v in a.items() if not np.array_equal(v, b[k], equal_nan=v.dtype.kind == "f")), None)


def _trained(subject: Subject, seeds: Sequence[int], noise: int = 0) -> dict[str, NDArray[Any]]:
    """Return everything after two epochs, with another global random state for every `noise`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(noise)
        state = np.random.get_state()  # noqa: NPY002
        np.random.seed(noise)  # noqa: NPY002
        try:
            made = Group(subject, seeds).start()
            metrics = made.train(2)
            return {**made.save(), **{f"metric {k}": v for k, v in metrics.items()}, "actions": made.act()}
        finally:
            np.random.set_state(state)  # noqa: NPY002


def _same(subject: Subject) -> None:
    name = _differs(_trained(subject, [0, 1], 1), _trained(subject, [0, 1], 2))
    require(
        name is None,
        f"the same seeds trained twice differ in '{name}': draw from streams[s].numpy(name, epoch) or "
        "streams[s].torch(name, epoch), and from no global generator",
    )


def _different(subject: Subject) -> None:
    made = Group(subject, [0, 1]).start()
    made.train(2)
    policy = made.algorithm.policy_state()
    require(
        any(not torch.equal(value[0], value[1]) for value in policy.values()),
        "seeds 0 and 1 became the same agent: are populations built by build_model, with every seed's stream?",
    )


def _seed_first(subject: Subject) -> None:
    made = Group(subject, range(S)).start()
    made.train()
    state = made.algorithm.state_dict()
    require(bool(state), "state_dict() is empty: what training depends on is lost when a run is resumed")
    for name, value in state.items():
        require(isinstance(value, Tensor), f"state '{name}' is {type(value).__name__}, not a tensor")
        require(
            value.dim() > 0 and value.shape[0] == S,
            f"state '{name}' of shape {tuple(value.shape)} has no leading axis of {S} seeds: checkpoints are sliced; "
            "repeat a counter as torch.tensor([count] * S)",
        )


def _independence(subject: Subject) -> None:
    whole = _trained(subject, range(S))
    for members in SIZES:
        part = _trained(subject, members)
        name = _differs(part, {key: value[list(members)] for key, value in whole.items()})
        require(
            name is None,
            f"seeds {list(members)} trained among themselves differ from those trained among all {S} in '{name}': sum "
            "the agents' own mean losses, clip norms per agent, normalize per agent, draw per seed",
        )


def _state(subject: Subject) -> None:
    straight = Group(subject, range(S)).start()
    straight.train(2)
    saved = straight.save()
    metrics = straight.train(2)
    expected = {**straight.save(), **{f"metric {k}": v for k, v in metrics.items()}}
    for members in (list(range(S)), [3], [4, 1]):
        other = Group(subject, members).load({key: value[members] for key, value in saved.items()})
        metrics = other.train(2)
        got = {**other.save(), **{f"metric {k}": v for k, v in metrics.items()}}
        name = _differs(got, {key: value[members] for key, value in expected.items()})
        require(
            name is None,
            f"resumed from a checkpoint, seeds {members} differ in '{name}' from those never stopped: optimizer "
            "moments, replay, current observations and the epoch's number belong into state_dict(), copied",
        )
