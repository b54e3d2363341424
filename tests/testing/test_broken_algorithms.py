"""Algorithms that break one rule each: edits of a good one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from qrlsuite.errors import PluginError
from qrlsuite.specs import AlgorithmSpec
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, good, ids, module, own_rules

GOOD = good("algorithm")
INIT, ACT = "self.observations = torch.zeros(0)", "logits.argmax(2).cpu().numpy()"
LOSS, POLICY, SEEN = '{"loss": loss}', "dict(self.policy.state_dict())", '"observations": self.observations,'
EPOCH, RESTORED = "torch.full((self.S,), self.epoch)", 'self.epoch = int(state["epoch"][0])'
PER_AGENT = (
    "from torch import", "from qrlsuite.options import Tuned\nfrom torch import",
    'Field(gt=0, description="learning rate")', "Tuned(0.01, 0.1, per_agent=True)",
)  # fmt: skip
REMEMBER = """    def remember(self, observations, begins, best):
        before = self.seen if self.seen is not None and self.seen.shape == begins.shape else 0
        self.seen = np.where(begins, 0, before) + observations[..., 0]
        return (best + (self.seen * 3).astype(np.int64)) % self.actions

    def tensor(self, lanes"""
KEPT = (
    "def act(self, observations: NDArray[np.float32])", "def act(self, observations, begins, infos)",
    INIT, f"{INIT}; self.seen = None",
    ACT, f"self.remember(observations, begins, {ACT})",
    "    def tensor(self, lanes", REMEMBER,
)  # fmt: skip
"""An algorithm whose actions depend on what it saw in an episode."""
EDITS = [
    edit("memory of episodes", r"where all episodes begin, act chooses by what it saw in earlier ones: a validation",
         *KEPT, "np.where(begins, 0, before)", "before", also=["acts"]),
    edit("memory of episodes", r"where an episode begins in one lane, act forgets what it saw in others",
         *KEPT, "np.where(begins, 0, before)", "(0 if begins.any() else before)"),
    edit("memory of episodes", r"policy 'seen' has shape \(5, 3\) with 2 lanes and \(5, 1\) with one: .* no part of a",
         *KEPT, POLICY, "{**dict(self.policy.state_dict()), "
         "'seen': torch.zeros(self.S, 1) if self.seen is None else torch.from_numpy(self.seen)}"),
    edit("builds", r"called with \[2\] outputs, and there are 3 actions: take envs.single",
         "int(envs.single_action_space.n)", "2"),
    edit("builds", r"TypeError: .*; the factory takes \(envs, build_model, options, streams,",
         "        device: torch.device,\n", "", "= device, 0", "= torch.device('cpu'), 0"),
    edit("trains", r"train_epoch returned NoneType, not a dict of metrics", f"return {LOSS}", "loss"),
    edit("trains", r"'loss' is float64 of shape \(\), and .* \(5,\): one number per seed",
         LOSS, '{"loss": loss.mean()}'),
    edit("trains", r"'loss' is float32 .* must be float64", LOSS, '{"loss": loss.astype(np.float32)}'),
    edit("trains", r"must be 10 integers, not int64 of shape \(5, 2\); lanes are seed-major",
         "chosen.cpu().numpy().ravel()", "chosen.cpu().numpy()"),
    edit("trains", r"must lie in 0..2, not 1..3; .* choices count from 0", ".ravel()", ".ravel() + 1"),
    edit("trains", r"stepped before it was reset: start\(\) resets it",
         "self.tensor(self.envs.reset()[0])", "torch.zeros(self.S, self.E, 4)"),
    edit("interactions", r"of 12 rounds .* stepped 15 times: .* an epoch is cut",
         "shape = (self.S, rounds", "rounds += 3; shape = (self.S, rounds"),
    edit("acts", r"act chooses differently on the same observations: it must be greedy",
         INIT, f"{INIT}; self.calls = 0",
         ACT, f"({ACT} + self.calls % 2) % self.actions; self.calls += 1"),
    edit("greedy=false", r"act chooses differently on the same observations", "gamma: Ann",
         "greedy: Annotated[bool, Field(description='or not')] = True\n    gamma: Ann", INIT, f"{INIT}; self.calls = 0",
         ACT, f"({ACT} + (not self.options.greedy) * self.calls) % self.actions; self.calls += 1"),
    edit("acts", r"act returned Tensor, and must return a numpy array: end with .cpu\(\)",
         "return chosen", "return torch.from_numpy(chosen)"),
    edit("acts", r"int64 of shape \(5,\), and must return int64 of shape \(5, 8\): one action",
         "return chosen", "return chosen[:, 0]"),
    edit("acts", r"none of Discrete\(3\): actions must lie in 0..2, not 1..3", "return chosen", "return chosen + 1"),
    edit("acts", r"act changes the state 'algorithm.calls': validation must leave no trace",
         INIT, f"{INIT}; self.calls = torch.zeros(self.S)", ACT, f"{ACT}; self.calls += 1",
         SEEN, f"{SEEN} 'calls': self.calls.clone(),"),
    edit("acts", r"an epoch after act ends with another '.*' than without it: validation",
         INIT, f"{INIT}; self.scale = 1",
         ACT, f"{ACT}; self.scale = 0", "noise.astype(np.float32)", "(noise * self.scale).astype(np.float32)"),
    edit("learns", r"72 interactions, the policy of seed 0 is as it was: is the optimizer",
         "self.adam.step()", "pass"),
    edit("learns", r"the policy of seed 2 is as it was",
         "loss.sum()", "loss[[stream.seed != 2 for stream in self.streams]].sum()"),
    edit("learns", r"do not make a new algorithm act as the trained one: return the tensors",
         POLICY, "{name: value.clone() for name, value in self.policy.state_dict().items()}"),
    edit("learns", r"policy 'weight' of shape \(3, 4\) has no leading axis of 5 seeds",
         POLICY, "{name: value[0] for name, value in self.policy.state_dict().items()}"),
    edit("learns", r"policy_state\(\) is empty: it is what", POLICY, "{}", also=["different seed"]),
    edit("same seed", r"seeds trained twice differ in '.*': draw from streams\[s\].numpy\(",
         "noise.astype(np.float32)", "np.roll(noise, torch.initial_seed() % 3, 3).astype(np.float32)"),
    edit("different seed", r"seeds 0 and 1 became the same agent: are populations built by",
         INIT, f"{INIT}; [parameter.data.zero_() for parameter in self.policy.parameters()]",
         "self.adam.step()", "[parameter.data.add_(0.01) for parameter in self.policy.parameters()]"),
    edit("state is seed-first", r"'epoch' of shape \(\) has .* torch.tensor\(\[count\]",
         EPOCH, "torch.tensor(self.epoch)"),
    edit("state is seed-first", r"state 'epoch' is list, not a tensor", EPOCH, "[self.epoch] * self.S"),
    edit("state is seed-first", r"state_dict\(\) is empty: what training depends on is lost",
         "        return {\n            **prefixed", "        return {}\n        return {\n            **prefixed"),
    edit("seed independence", r"seeds \[0\] trained among themselves differ from those .* all 5 in .*: sum the agents'",
         "loss.sum()", "loss.mean()", also=["state"]),
    edit("options per agent", r"lr = 0.01 differs in '.*' beside one with", *PER_AGENT,
         "Adam(self.policy, options.lr", "Adam(self.policy, float(torch.as_tensor(options.lr).mean())"),
    edit("options per agent", r"ValueError: .*; an option marked per_agent", *PER_AGENT,
         "Adam(self.policy, options.lr", "Adam(self.policy, float(options.lr)"),
    edit("state", r"resumed .* differ in '.*' .* the epoch's number belong", RESTORED, "self.epoch = 0"),
    edit("state", r"current observations and the epoch's number belong into state_dict\(\)",
         'state["observations"].clone()', 'torch.zeros_like(state["observations"])'),
    edit("state", r"no attribute 'room'; load_state_dict\(\) takes .* in place of start\(\)",
         "def start(self) -> None:", "def start(self):\n        self.room = torch.zeros(1)",
         RESTORED, f"self.room.zero_(); {RESTORED}"),
]  # fmt: skip


def spec(edit: Edit | None = None) -> AlgorithmSpec:
    name = module(edit.of(GOOD) if edit else GOOD)
    return AlgorithmSpec("broken", "Breaks a rule", f"{name}:Options", f"{name}:PolicyGradient")


@pytest.mark.parametrize("edit", EDITS, ids=ids(EDITS))
def test_one_rule_is_broken(edit: Edit) -> None:
    assert_breaks(spec(edit), edit.rule, edit.message, edit.also)


def test_every_rule_has_an_algorithm_that_breaks_it() -> None:
    per_agent = spec(edit("", "", *PER_AGENT, *KEPT))
    assert assert_all_good(per_agent) == {edit.rule for edit in EDITS if "=" not in edit.rule}
    assert "memory of episodes" not in assert_all_good(spec())


def test_a_kind_of_actions_that_is_promised_and_not_taken_is_named() -> None:
    """The good one takes discrete actions; a spec that promises more is told for which space it fails."""
    promised = replace(spec(), actions=("discrete", "box"))
    findings = {finding.rule: finding for finding in own_rules(promised)}
    assert not findings["box actions"].ok
    assert "the spec says that it takes box actions: build it for Box(" in findings["box actions"].message
    assert all(finding.ok for rule, finding in findings.items() if rule != "box actions")
    with pytest.raises(PluginError, match=r"must name some of discrete, .*, box, in a tuple"):
        replace(spec(), actions=("continuous",))


def test_a_tasks_environment_takes_the_place_of_the_toys() -> None:
    findings = own_rules(spec(), task="planted")
    assert all(finding.ok for finding in findings), findings
    assert "'Box' object has no attribute 'n'" in own_rules(spec(), task="pendulum")[0].message
