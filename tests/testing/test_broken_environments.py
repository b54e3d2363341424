"""Environments that break one rule each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from qrlsuite.environment import LaneEnv, State, batched_spaces
from qrlsuite.specs import EnvironmentSpec
from qrlsuite.testing import check_environment
from tests.testing.broken import Broken, assert_breaks, ids, own_rules

HERE = __name__
BOX, CHOICES = Box(0, 1, (2,)), Discrete(2)


@dataclass(frozen=True)
class Options:
    steps: int = 6


class Single(gymnasium.Env[Any, Any]):
    """Reward 1 for the action that the observed number, uniform in [0, 1), rounds to; 6 steps."""

    observation_space: gymnasium.Space[Any] = BOX
    action_space: gymnasium.Space[Any] = CHOICES

    def __init__(self, steps: int = 6) -> None:
        self.steps, self.taken, self.value = steps, 0, 0.0

    def observe(self) -> NDArray[np.float32]:
        self.value = self.np_random.random()
        return np.array([self.value, self.taken / self.steps], dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self.taken = 0
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = float(action == round(self.value))
        self.taken += 1
        return self.observe(), reward, self.taken >= self.steps, False, {}


class Unseeded(Single):
    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.taken = 0
        return self.observe(), {}


class NoArguments(Single):
    def __init__(self) -> None:
        super().__init__()


class Numbers(Single):
    def step(self, action: Any) -> tuple[Any, float, Any, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, int(terminated), truncated, info


class Steering(Single):
    action_space = Box(-1, 1, (1,))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return super().step(int(action[0] > 0))


class Good(LaneEnv):
    """`Single` in lanes, with a score: the mean reward."""

    space, choices = BOX, CHOICES

    def __init__(self, options: Options, num_envs: int) -> None:
        batched_spaces(self, self.space, self.choices, num_envs)
        self.steps = options.steps
        self.streams = []
        self.taken, self.resets = (np.zeros(num_envs, dtype=np.int64) for _ in range(2))
        self.value, self.total = np.zeros(num_envs), np.zeros(num_envs)

    def stream(self, lane: int) -> np.random.Generator:
        return self.streams[lane * len(self.streams) // self.num_envs]

    def draw(self, lanes: Any) -> None:
        self.value[lanes] = [self.stream(int(lane)).random() for lane in lanes]

    def begin(self, lanes: NDArray[np.intp]) -> None:
        self.taken[lanes], self.total[lanes] = 0, 0
        self.draw(lanes)

    def observe(self) -> NDArray[Any]:
        return np.column_stack([self.value, np.minimum(self.taken / self.steps, 1)]).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        self.resets += 1
        self.begin(np.arange(self.num_envs))
        return self.observe(), {}

    def ended(self) -> NDArray[np.bool_]:
        return self.taken == self.steps

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        rewards = (actions == self.value.round()).astype(np.float64)
        self.taken += 1
        self.total += rewards
        self.draw(range(self.num_envs))
        done = self.ended()
        infos = self.finish(done) if done.any() else {}
        return self.observe(), rewards, done, np.zeros_like(done), infos

    def finish(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        infos = {"final_obs": self.observe(), "_final_obs": done, "final_info": self.final(done)}
        if self.autoreset:
            self.begin(np.flatnonzero(done))
        return infos

    def final(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {"score": self.total / self.steps, "_score": done}

    def state_dict(self) -> State:
        return {"taken": self.taken, "value": self.value, "total": self.total, "resets": self.resets}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        for name, value in state.items():
            setattr(self, name, np.array(value))


def nothing(options: Options, num_envs: int) -> None:
    Good(options, num_envs)


def always_ten(options: Options, num_envs: int) -> LaneEnv:
    return Good(options, 10)


class Spaceless(Good):
    def __init__(self, options: Options, num_envs: int) -> None:
        self.num_envs = num_envs


class Continuous(Good):
    choices = Box(-1, 1, (1,))  # type: ignore[assignment]


class FromOne(Good):
    choices = Discrete(2, start=1)


class Numbered(Good):
    space = Discrete(4)  # type: ignore[assignment]


class Doubles(Good):
    def observe(self) -> NDArray[Any]:
        return super().observe().astype(np.float64)


class LanesLast(Good):
    def observe(self) -> NDArray[Any]:
        return super().observe().T


class Lists(Good):
    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, *rest = super().step(actions)
        return observations, list(rewards), *rest  # type: ignore[return-value]


class Outside(Good):
    def observe(self) -> NDArray[Any]:
        return super().observe() + (self.taken[:, None] == 3).astype(np.float32)


class Undefined(Good):
    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, *rest = super().step(actions)
        return observations, np.where(self.taken == 3, np.nan, rewards), *rest  # type: ignore[return-value]


class OneBuffer(Good):
    def observe(self) -> NDArray[Any]:
        self.buffer = getattr(self, "buffer", np.zeros((self.num_envs, 2), dtype=np.float32))
        self.buffer[:] = super().observe()
        return self.buffer


class FourValues(Good):
    def step(self, actions: NDArray[np.int64]) -> Any:
        observations, rewards, terminated, _, infos = super().step(actions)
        return observations, rewards, terminated, infos


class NoInfos(Good):
    def step(self, actions: NDArray[np.int64]) -> Any:
        *shown, infos = super().step(actions)
        return *shown, infos or None


class Endless(Good):
    def ended(self) -> NDArray[np.bool_]:
        return np.zeros(self.num_envs, dtype=bool)


class NothingFinal(Good):
    def finish(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        super().finish(done)
        return {}


class TooLate(Good):
    def finish(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {**super().finish(done), "final_obs": self.observe()}


class OneFinal(Good):
    def finish(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {**super().finish(done), "final_obs": self.observe()[0]}


class Unmasked(Good):
    def finish(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {**super().finish(done), "_final_obs": ~done}


class NeverAnew(Good):
    def ended(self) -> NDArray[np.bool_]:
        return self.taken >= self.steps

    def begin(self, lanes: NDArray[np.intp]) -> None:
        if len(lanes) == self.num_envs and not self.ended().any():
            super().begin(lanes)


class Sum(Good):
    def final(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {"score": self.total.copy(), "_score": done}


class Sometimes(Good):
    def final(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {} if self.resets[0] % 2 else super().final(done)

    def begin(self, lanes: NDArray[np.intp]) -> None:
        self.resets[lanes] += 1
        super().begin(lanes)

    def reset(self, **given: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        self.resets[:] = 0
        return super().reset(**given)


class OneScore(Good):
    def final(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        return {"score": float(self.total[done][0]) / self.steps}


class Global(Good):
    def draw(self, lanes: Any) -> None:
        self.value[lanes] = np.random.random(len(lanes))  # noqa: NPY002


class Ageing(Good):
    def observe(self) -> NDArray[Any]:
        return super().observe() / self.resets[:, None].astype(np.float32)


class Constant(Good):
    def draw(self, lanes: Any) -> None:
        self.value[lanes] = (self.taken[lanes] * 0.37) % 1


class Coupled(Good):
    def observe(self) -> NDArray[Any]:
        return super().observe() * np.float32(1 - self.value.mean() / 1000)


class Forgetful(Good):
    def state_dict(self) -> State:
        return {name: value for name, value in super().state_dict().items() if name != "taken"}


class OneForAll(Good):
    def state_dict(self) -> State:
        return {**super().state_dict(), "taken": self.taken[:1]}


class Objects(Good):
    def state_dict(self) -> State:
        return {**super().state_dict(), "resets": np.array([None] * self.num_envs)}


class Unprepared(Good):
    def reset(self, **given: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        self.ready = True
        return super().reset(**given)

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        if self.ready:
            super().load_state_dict(state)


class OneStreamEach(Good):
    def stream(self, lane: int) -> np.random.Generator:
        return self.streams[lane]


class RoundRobin(Good):
    def stream(self, lane: int) -> np.random.Generator:
        return self.streams[lane % len(self.streams)]


class Strict(Good):
    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        if (self.taken >= self.steps).any():
            raise gymnasium.error.ResetNeeded("an episode has ended")
        return super().step(actions)


class Emptied(Good):
    """Hands out the array that the reset in the same step empties."""

    def final(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        self.total[done] /= self.steps
        return {"score": self.total, "_score": done}


class Easier(Good):
    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, *rest = super().step(actions)
        return observations, rewards if self.autoreset else rewards + 1, *rest  # type: ignore[return-value]


class HalfEndless(Good):
    def ended(self) -> NDArray[np.bool_]:
        return super().ended() & (np.arange(self.num_envs) % 2 == 0)


def env(vector: Any = Good, single: type[Single] = Single, **more: Any) -> EnvironmentSpec:
    name = (single if vector in (None, Good) else vector).__name__.lower()
    return EnvironmentSpec(
        name=name.replace("_", "-"),
        summary="Breaks a rule",
        options=f"{HERE}:Options",
        gymnasium_id=f"{single.__name__}-v0",
        entry_point=f"{HERE}:{single.__name__}",
        vector=None if vector is None else f"{HERE}:{vector.__name__}",
    )


COMPANY = frozenset({"seed independence", "state", "validation"})
BROKEN = [
    ("gymnasium", Broken(env(single=Unseeded), r"is non-deterministic .*: is super\(\).reset\(seed=seed\) called")),
    ("gymnasium", Broken(env(single=NoArguments), r"make\('NoArguments-v0'\) fails: .* its keyword arguments")),
    ("gymnasium", Broken(env(single=Numbers), r"^check_env warns: Expects `terminated` signal to be a boolean")),
    ("spaces", Broken(env(nothing), r"nothing returned NoneType, .*LaneEnv: is `return` there")),
    ("spaces", Broken(env(always_ten), r"asked for 2 lanes, num_envs is 10: the second argument of .*:always_ten")),
    ("spaces", Broken(env(Spaceless), r"'single_action_space'; in __init__, call .*batched_spaces\(self, ")),
    ("spaces", Broken(env(Continuous), r"actions are Box\(.*use gymnasium.spaces.Discrete\(n\)")),
    ("spaces", Broken(env(None, Steering), r"^environment 'Steering-v0' has .*: only discrete actions are supported")),
    ("spaces", Broken(env(FromOne), r"actions are Discrete\(2, start=1\); in lanes they count from 0")),
    ("spaces", Broken(env(Numbered), r"observations are Discrete\(4\); networks need a gymnasium.spaces.Box")),
    ("shapes", Broken(env(Doubles), r"reset's observations are float64, .*: convert with .astype\(np.float32\)")),
    ("shapes", Broken(env(LanesLast), r"have shape \(2, 10\), and must have \(10, 2\): lanes come first")),
    ("shapes", Broken(env(Lists), r"rewards are list, and must be a numpy array")),
    ("shapes", Broken(env(Outside), r"the observation \[.*\] of step 3 is outside Box\(.*: widen the space")),
    ("shapes", Broken(env(Undefined), r"rewards are not finite: is there a division by zero")),
    ("shapes", Broken(env(OneBuffer), r"changes the observations that were returned before it: return a copy")),
    ("shapes", Broken(env(FourValues), r"not enough values .*; step takes \(L,\) integers and returns observations")),
    ("shapes", Broken(env(NoInfos), r"infos are NoneType, and must be a dict")),
    ("episodes end", Broken(env(Endless), r"no episode ended within 10000 steps .* give it a time limit")),
    ("episodes end", Broken(env(NothingFinal), r"after 6 steps and infos have no 'final_obs': the last observation")),
    ("episodes end", Broken(env(OneFinal), r"has shape \(2,\), and must have that of observations, \(2, 2\)")),
    ("episodes end", Broken(env(Unmasked), r"it is the mask terminated \| truncated")),
    ("episodes end", Broken(env(TooLate), r"holds \[.* 0. *\]: copy the observations before the reset")),
    ("episodes end", Broken(env(NeverAnew), r"and again at each of the 5 steps after it: reset the lanes")),
    ("score", Broken(env(Sum), r"info\['score'\] at an episode's end is \d, and must lie in \[0, 1\]: divide by")),
    ("score", Broken(env(Sometimes), r"some episodes end with info\['score'\] and some without: set it at every")),
    ("score", Broken(env(OneScore), r"has shape \(\), and must have one number per lane, \(10,\)")),
    ("same seed", Broken(env(Ageing), r"a used environment, reset, shows other observations than a new one: draw")),
    ("same seed", Broken(env(Global), r"same streams and actions give other observations: draw from", COMPANY)),
    ("different seed", Broken(env(Constant), r"other streams give the same 11 steps: .* with --deterministic")),
    (
        "seed independence",
        Broken(
            env(Coupled),
            r"seeds \[0\] among themselves see other observations than among all 5: a lane may depend on its own",
            COMPANY - {"seed independence"},
        ),
    ),
    ("state", Broken(env(Forgetful), r"in the middle of an episode, .* see other observations: something that")),
    ("state", Broken(env(OneForAll), r"'taken' of shape \(1,\) has no leading axis of 10 lanes")),
    ("state", Broken(env(Objects), r"'resets' is object, and checkpoints hold arrays of numbers")),
    ("state", Broken(env(Unprepared), r"has no attribute 'ready'; .* in new lanes that were never reset")),
    ("validation", Broken(env(OneStreamEach), r"IndexError: .*in validation a stream serves several lanes, lane l by")),
    ("validation", Broken(env(RoundRobin), r"seeds \[3\] among themselves see other observations .* lane l draws")),
    ("validation", Broken(env(Strict), r"ResetNeeded: an episode has ended; .* whose episode ended are stepped on")),
    ("validation", Broken(env(Easier), r"autoreset = False the same streams and actions give other rewards in the")),
    ("validation", Broken(env(Emptied), r"give other scores in the first episode: .* is copied before")),
    ("validation", Broken(env(HalfEndless), r"5 of 10 lanes have not ended .* every episode needs a time limit")),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "case"), BROKEN, ids=ids(BROKEN))
def test_one_rule_is_broken(rule: str, case: Broken) -> None:
    assert_breaks("environments", rule, case)


@pytest.mark.parametrize("good", [env(), env(None)], ids=["lanes", "single"])
def test_every_rule_has_an_environment_that_breaks_it(good: EnvironmentSpec) -> None:
    findings = own_rules("environments", good)
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in BROKEN}


def test_episodes_may_be_alike_where_they_are_meant_to() -> None:
    findings = check_environment(env(Constant), deterministic=True)
    rules = {finding.rule: finding.ok for finding in findings}
    assert "different seed" not in rules
    assert rules["same seed"]
    assert rules["validation"]
