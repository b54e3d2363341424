"""Environments that break one rule each: edits of the one of `acme-qrl`, and of one in lanes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from qrlsuite.specs import EnvironmentSpec
from qrlsuite.testing import check
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, ids, module

LANES = '''
from gymnasium.spaces import Box, Discrete
from qrlsuite.environment import LaneEnv, batched_spaces


class Lanes(LaneEnv):
    """Reward 1 for the action that the observed number, uniform in [0, 1), rounds to; the score is the mean."""

    def __init__(self, options, num_envs):
        batched_spaces(self, Box(0, 1, (2,)), Discrete(2), num_envs)
        self.steps, self.streams = options.steps, []
        self.taken, self.resets = (np.zeros(num_envs, dtype=np.int64) for _ in range(2))
        self.value, self.total = np.zeros(num_envs), np.zeros(num_envs)

    def draw(self, lanes):
        per_stream = self.num_envs // len(self.streams)
        self.value[lanes] = [self.streams[lane // per_stream].random() for lane in lanes]

    def begin(self, lanes):
        self.taken[lanes], self.total[lanes] = 0, 0
        self.draw(lanes)

    def observe(self):
        seen = np.column_stack([self.value, np.minimum(self.taken / self.steps, 1)]).astype(np.float32)
        return seen

    def reset(self, *, seed=None, options=None):
        self.resets += 1
        self.begin(np.arange(self.num_envs))
        return self.observe(), {}

    def step(self, actions):
        rewards = (actions == self.value.round()).astype(np.float64)
        self.taken += 1
        self.total += rewards
        self.draw(range(self.num_envs))
        done = self.taken == self.steps
        infos = self.finish(done) if done.any() else {}
        return self.observe(), rewards, done, np.zeros_like(done), infos

    def finish(self, done):
        final = {"score": self.total / self.steps, "_score": done}
        infos = {"final_obs": self.observe(), "_final_obs": done, "final_info": final}
        if self.autoreset:
            self.begin(np.flatnonzero(done))
        return infos

    def state_dict(self):
        return {"taken": self.taken, "value": self.value, "total": self.total, "resets": self.resets}

    def load_state_dict(self, state):
        for name, value in state.items():
            setattr(self, name, np.array(value))


def nothing(options, num_envs):
    Lanes(options, num_envs)


def always_ten(options, num_envs):
    return Lanes(options, 10)
'''
ACME = Path(__file__).parents[1] / "third_party" / "acme-qrl" / "src" / "acme_qrl"
GOOD = (ACME / "environment.py").read_text().replace("] = 40", "] = 6") + LANES
SPACES = "Box(0, 1, (2,)), Discrete(2)"
STREAM = "self.streams[lane // per_stream].random() for lane in lanes"
SEEN, REWARD, DONE, INFOS = (
    "return seen",
    "self.observe(), rewards",
    "done = self.taken == self.steps",
    "return infos",
)
SCORE = '{"score": self.total / self.steps, "_score": done}'
COMPANY = {"seed independence", "state", "validation"}
EDITS = [
    edit("gymnasium", r"super\(\).reset\(seed=seed\)",
         "super().reset(seed=seed)", ""),
    edit("gymnasium", r"make\('.*'\) fails: .* its keyword arguments",
         "channels=5, steps=40", "", "= channels, steps", "= 5, 6", "(channels)", "(5)"),
    edit("gymnasium", r"^check_env warns: Expects `terminated` signal to be a boolean",
         "reward, ended, False", "reward, int(ended), False"),
    edit("spaces", r"nothing returned NoneType, .*LaneEnv: is `return` there", vector="nothing"),
    edit("spaces", r"asked for 2 lanes, num_envs is 10: the second argument of .*:always_ten", vector="always_ten"),
    edit("spaces", r"'single_action_space'; in __init__, call .*batched_spaces\(self, ",
         f"batched_spaces(self, {SPACES}, num_envs)", "self.num_envs = num_envs"),
    edit("spaces", r"^the action space Box\(-inf, inf, .* has no bounds: state finite ones",
         SPACES, "Box(0, 1, (2,)), Box(-np.inf, np.inf, (1,))"),
    edit("spaces", r"^environment '.*': the action space Box\(-inf, inf, .* has no bounds",
         "Discrete(channels)", "Box(-np.inf, np.inf, (1,))", "action == self.free", "action[0] > 0", vector=None),
    edit("spaces", r"actions are Discrete\(2, start=1\); in lanes they count from 0",
         SPACES, SPACES.replace("Discrete(2", "Discrete(2, start=1")),
    edit("spaces", r"observations are Discrete\(4\); networks need a gymnasium.spaces.Box",
         SPACES, "Discrete(4), Discrete(2)"),
    edit("shapes", r"reset's observations are float64, .*: convert with .astype\(np.float32\)",
         SEEN, f"{SEEN}.astype(np.float64)"),
    edit("shapes", r"have shape \(2, 10\), and must have \(10, 2\): lanes come first", SEEN, f"{SEEN}.T"),
    edit("shapes", r"rewards are list, and must be a numpy array", REWARD, "self.observe(), list(rewards)"),
    edit("shapes", r"the observation \[.*\] of step 3 is outside Box\(.*: widen the space",
         SEEN, f"{SEEN} + (self.taken[:, None] == 3).astype(np.float32)"),
    edit("shapes", r"rewards are not finite: is there a division by zero",
         REWARD, "self.observe(), np.where(self.taken == 3, np.nan, rewards)"),
    edit("shapes", r"changes the observations that were returned before it: return a copy",
         SEEN, "self.seen = getattr(self, 'seen', seen); self.seen[:] = seen; return self.seen"),
    edit("shapes", r"not enough values .*; step takes \(L, \.\.\.\) actions and returns observations",
         "np.zeros_like(done), infos", "infos"),
    edit("shapes", r"infos are NoneType, and must be a dict",
         "np.zeros_like(done), infos", "np.zeros_like(done), infos or None"),
    edit("episodes end", r"no episode ended within 10000 steps .* give it a time limit", DONE, "done = self.taken < 0"),
    edit("episodes end", r"after 6 steps and infos have no 'final_obs': the last observation", INFOS, "return {}"),
    edit("episodes end", r"has shape \(2,\), and must have that of observations, \(2, 2\)",
         INFOS, "return {**infos, 'final_obs': self.observe()[0]}"),
    edit("episodes end", r"it is the mask terminated \| truncated", '"_final_obs": done', '"_final_obs": ~done'),
    edit("episodes end", r"holds \[.* 0. *\]: copy the observations before the reset",
         INFOS, "return {**infos, 'final_obs': self.observe()}"),
    edit("episodes end", r"and again at each of the 5 steps after it: reset the lanes",
         DONE, "done = self.taken >= self.steps", "if self.autoreset", "if False"),
    edit("score", r"info\['score'\] at an episode's end is \d, and must lie in \[0, 1\]: divide by",
         "self.total / self.steps", "self.total.copy()"),
    edit("score", r"some episodes end with info\['score'\] and some without: set it at every", "self.resets += 1",
         "self.resets[:] = 0", "self.draw(lanes)", "self.draw(lanes); self.resets[lanes] += 1",
         SCORE, f"{{}} if self.resets[0] % 2 else {SCORE}"),
    edit("score", r"has shape \(\), and must have one number per lane, \(10,\)",
         SCORE, '{"score": float(self.total[done][0]) / self.steps}'),
    edit("same seed", r"a used environment, reset, shows other observations than a new one: draw",
         SEEN, f"{SEEN} / self.resets[:, None].astype(np.float32)"),
    edit("same seed", r"same streams and actions give other observations, .*: draw from",
         STREAM, "np.random.random() for lane in lanes", also=COMPANY),
    edit("different seed", r"all episodes are alike, whatever the stream: .* write repeats = True",
         STREAM, "self.taken[lane] * 0.37 % 1 for lane in lanes"),
    edit("different seed", r"its episodes differ, and several seeds meet the same ones, .* write repeats = True",
         "channels, steps\n", "channels, steps\n        self.rng = np.random.default_rng(0)\n",
         "self.np_random.int", "self.rng.int", "self.np_random.choice", "self.rng.choice", vector=None,
         also=["gymnasium", "same seed"]),
    edit("seed independence", r"seeds \[0\] among themselves see other observations than among all 5: a lane may "
         r"depend on its own", SEEN,
         f"{SEEN} * np.float32(1 - self.value.mean() / 1000)", also=COMPANY - {"seed independence"}),
    edit("state", r"in the middle of an episode, .* see other observations: something that",
         '"taken": self.taken, ', ""),
    edit("state", r"'taken' of shape \(1,\) has no leading axis of 10 lanes", ': self.taken,', ': self.taken[:1],'),
    edit("state", r"'resets' is object, and checkpoints hold arrays of numbers",
         ": self.resets", ": np.array([None] * self.num_envs)"),
    edit("state", r"has no attribute 'ready'; .* in new lanes that were never reset",
         "self.resets += 1", "self.resets += 1; self.ready = True", "state.items()", "self.ready and state.items()"),
    edit("kind=wide", r"observations are float64", "import Annotated", "import Annotated, Literal", "class Options:",
         "class Options:\n    kind: Literal['plain', 'wide'] = 'plain'", "steps=40):", "steps=40, kind='plain'):",
         "self.steps, self.streams = options.steps, []",
         "self.steps, self.streams, self.kind = options.steps, [], options.kind",
         SEEN, f"{SEEN}.astype(np.float64 if self.kind == 'wide' else np.float32)"),
    edit("validation", r"IndexError: .*in validation a stream serves several lanes, lane l by",
         "lane // per_stream", "lane"),
    edit("validation", r"seeds \[3\] among themselves see other observations .* lane l draws",
         "lane // per_stream", "lane % len(self.streams)"),
    edit("validation", r"ResetNeeded: an episode has ended; .* whose episode ended are stepped on",
         "rewards = (actions",
         "if max(self.taken) >= self.steps: raise gymnasium.error.ResetNeeded('an episode has ended')\n        "
         "rewards = (actions"),
    edit("validation", r"autoreset = False the same streams and actions give other rewards in the",
         REWARD, "self.observe(), rewards if self.autoreset else rewards + 1"),
    edit("validation", r"give other scores in the first episode: .* is copied before",
         "final = {", "self.total[done] /= self.steps; final = {", "self.total / self.steps", "self.total"),
    edit("validation", r"5 of 10 lanes have not ended .* every episode needs a time limit",
         DONE, f"{DONE}; done &= np.arange(self.num_envs) % 2 == 0"),
]  # fmt: skip


def spec(*changes: str, vector: str | None = "Lanes") -> EnvironmentSpec:
    name = module(edit("", "", *changes).of(GOOD))
    return EnvironmentSpec(
        "broken",
        "Breaks a rule",
        f"{name}:Options",
        f"{name.title()}-v0",
        f"{name}:ChannelHop",
        None if vector is None else f"{name}:{vector}",
    )


@pytest.mark.parametrize("edit", EDITS, ids=ids(EDITS))
def test_one_rule_is_broken(edit: Edit) -> None:
    assert_breaks(spec(*edit.changes, **edit.spec), edit.rule, edit.message, edit.also)


@pytest.mark.parametrize("vector", ["Lanes", None])
def test_every_rule_has_an_environment_that_breaks_it(vector: str | None) -> None:
    assert assert_all_good(spec(vector=vector)) == {edit.rule for edit in EDITS if "=" not in edit.rule}


def test_episodes_may_be_alike_where_they_are_meant_to() -> None:
    alike = replace(spec(STREAM, "self.taken[lane] * 0.37 % 1 for lane in lanes"), repeats=True)
    rules = {finding.rule: finding.ok for finding in check("environment", alike)}
    assert "different seed" not in rules
    assert rules["same seed"]
    assert rules["validation"]
