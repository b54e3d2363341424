"""Rules of algorithms: seeds do not influence each other, resuming is exact, agents learn from their own data."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from gymnasium.error import InvalidAction
from gymnasium.spaces import Discrete
from numpy.typing import NDArray
from torch import Tensor

from qrlsuite import population as populations
from qrlsuite import specs
from qrlsuite.actions import check_actions, size
from qrlsuite.testing.common import Subject, check_cases
from qrlsuite.testing.findings import SIZES, Checklist, Finding, one_thread, require
from qrlsuite.testing.group import ACTIONS, ROUNDS, E, ToyGroup, World, array
from qrlsuite.testing.lanes import differs

S = 5


def check(subject: Subject, task: str | None = None) -> list[Finding]:
    """Check an algorithm on toys: one for every kind of actions that its spec names, the first by all rules.

    Parameters
    ----------
    task:
        A task, or its file, whose environment is taken in place of the toys.
    """
    assert isinstance(subject.spec, specs.AlgorithmSpec)
    first, *others = subject.spec.actions
    taken = inspect.signature(getattr(specs.resolve(subject.spec.factory), "act", len)).parameters
    asks = taken.get("begins")
    optional = asks is not None and asks.default is None
    hidden = asks is not None and not optional
    if task is not None:
        return _check(subject, replace(World.of_task(task), hidden=hidden))
    findings = _check(subject, World.toy(first, hidden=hidden))
    if all(finding.ok for finding in findings):
        worlds = {f"{kind} actions": World.toy(kind) for kind in others}
        if optional:
            worlds["memory of episodes"] = World.toy(first, hidden=True)
        if "infos" in taken and "discrete" in subject.spec.actions:
            masked = World.toy("discrete", hidden=hidden, masked=True)
            if asks is None or _obeys(Trial(subject, masked)):  # who asks for `begins` is given infos, too
                worlds["masks"] = masked
        for rule, world in worlds.items():
            findings += _check_more(subject, world, rule)
    return findings


def _check(subject: Subject, world: World) -> list[Finding]:
    rules, trial = Checklist(), Trial(subject, world)
    with one_thread():
        cause = "the factory takes (envs, build_model, options, streams, device)"
        looked_at = "factory, and a population with one output per action"
        if not rules.run("builds", looked_at, lambda: _builds(trial), cause):
            return rules.findings
        cause = "start() resets the environments, train_epoch(rounds) steps them and returns metrics"
        if not rules.run("trains", "an epoch gives metrics (S,) in float64", lambda: _trains(trial), cause):
            return rules.findings
        rules.run(
            "interactions", f"{ROUNDS} rounds are {ROUNDS} steps of every lane", lambda: _interactions(trial)
        )
        cause = "act takes observations (S, B, inputs), B as many as validation has lanes"
        looked_at = "actions (S, B, ...), the same every time, changing nothing"
        rules.run("acts", looked_at, lambda: _acts(trial), cause)
        if world.hidden:
            cause = "begins is (S, B): where it is true, what is remembered of the lane is forgotten"
            looked_at = "what an episode left is forgotten where the next begins, lane by lane"
            rules.run("memory of episodes", looked_at, lambda: _remembers(trial), cause)
        cause = "`qrlsuite evaluate` builds a new algorithm, never starts it, loads the policy, and calls act"
        rules.run("learns", "every policy changes, and can be published", lambda: _learns(trial), cause)
        rules.run("same seed", "the same streams give the same bits", lambda: _same(trial))
        rules.run("different seed", "other seeds become other agents", lambda: _different(trial))
        if not rules.run("state is seed-first", "every tensor of it", lambda: _seed_first(trial)):
            return rules.findings
        looked_at = "alone, in pairs, shuffled: the same bits"
        rules.run("seed independence", looked_at, lambda: _independence(trial))
        cause = (
            "an option marked per_agent is a float64 tensor (S,) where agents differ in it: Adam of "
            "qrlsuite.population takes one as a learning rate; reshape it to (S, 1, 1) before it multiplies (S, B, n)"
        )
        looked_at = "two values in one population: the bits of each alone"
        rules.run("options per agent", looked_at, lambda: _per_agent(trial), cause)
        rules.run("state", "saved, sliced and restored exactly", lambda: _state(trial), _RESTORES)
        check_cases(rules, subject.choices(), lambda chosen: _works(Trial(chosen, world)))
    return rules.findings


def _works(trial: Trial) -> None:
    for rule in (_trains, _acts, _learns):
        rule(trial)


_RESTORES = "load_state_dict() takes what state_dict() returned, or slices of it, in place of start()"


def _check_more(subject: Subject, world: World, rule: str) -> list[Finding]:
    """Check the rules that depend on the kind of actions, or on networks that remember."""
    rules, trial = Checklist(), Trial(subject, world)

    def all_of_it() -> None:
        for each in (_trains, _interactions, _acts, _learns, _independence, _state):
            each(trial)
        if world.masked:
            _heeds(trial)
        elif world.hidden:
            _remembers(trial)

    with one_thread():
        cause = f"the spec says that it takes {rule}: build it for {world.space}"
        looked_at = "it trains, acts, learns and resumes with them, seeds apart"
        if world.hidden:
            cause = "act(observations, begins=None, infos=None): begins is given where networks remember"
            looked_at = "with networks that remember, it trains, acts, learns and resumes, seeds apart"
        if world.masked:
            cause = "infos['action_mask'] says what can be chosen, and qrlsuite.masks keeps it behind observations"
            looked_at = "nothing forbidden is chosen; it trains, acts, learns and resumes, seeds apart"
        rules.run(rule, looked_at, all_of_it, cause)
    return rules.findings


@dataclass(frozen=True)
class Trial:
    """An algorithm and the world in which it is checked."""

    subject: Subject
    world: World

    def group(self, seeds: Sequence[int], lanes: int = E, options: Any = None) -> ToyGroup:
        """Return a fresh group of seeds."""
        return ToyGroup(self.subject, seeds, lanes, options, self.world)


def _builds(trial: Trial) -> None:
    group, space = trial.group(range(S)), trial.world.space
    require(
        not isinstance(space, Discrete) or not group.outputs or int(space.n) in group.outputs,
        f"build_model was called with {group.outputs} outputs, and there are {size_of(space)} actions: take "
        "envs.single_action_space.n",
    )


def size_of(space: Any) -> int:
    """Return the number of choices of a discrete space, of the numbers of an action elsewhere."""
    return int(space.n) if isinstance(space, Discrete) else size(space)


def _trains(trial: Trial) -> None:
    metrics = trial.group(range(S)).start().train()
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


def _interactions(trial: Trial) -> None:
    group = trial.group(range(S)).start()
    for epoch in (1, 2):
        group.train()
        if getattr(group.algorithm, "offline", False):
            require(group.steps == 0, "the algorithm is `offline`, and steps the lanes in training")
            continue
        require(
            group.steps == epoch * ROUNDS,
            f"after {epoch} epochs of {ROUNDS} rounds the lanes were stepped {group.steps} times: sample "
            "complexity counts interactions, so an epoch is cut where its rounds end, also inside an episode (an "
            "algorithm that learns from data of its own, and steps nothing, says so by self.offline = True)",
        )


def _acts(trial: Trial) -> None:
    group = trial.group(range(S)).start()
    group.train()
    before = group.save()
    first, second = group.act(), group.act()
    require(
        isinstance(first, np.ndarray),
        f"act returned {type(first).__name__}, and must return a numpy array: end with .cpu().numpy()",
    )
    space = trial.world.space
    shape = (S, 8, *(space.shape or ()))
    hint = (
        "one action per observation, the best of the last axis by .argmax(2)"
        if isinstance(space, Discrete)
        else f"actions are those of {space}, and qrlsuite.actions.from_units maps numbers into a box"
    )
    require(
        first.shape == shape and first.dtype == space.dtype,
        f"act returned {first.dtype} of shape {first.shape}, and must return {space.dtype} of shape {shape}: {hint}",
    )
    try:
        check_actions(first.reshape(S * 8, *shape[2:]), S * 8, space)
    except InvalidAction as error:
        require(False, f"act chose actions that are none of {space}: {error}")
    require(
        group.draws or np.array_equal(first, second),
        "act chooses differently on the same observations: it must be greedy, without exploration or sampling; an "
        "algorithm that means to draw in validation says so by self.draws = True",
    )
    name = differs(before, group.save())
    require(name is None, f"act changes the state '{name}': validation must leave no trace in training")
    never = trial.group(range(S)).start()
    never.train(2)
    group.train()
    name = differs(never.save(), group.save())
    require(
        name is None,
        f"an epoch after act ends with another '{name}' than without it: validation must leave no trace in training; "
        "does act draw from a generator, or count, and training depend on it?",
    )


def _remembers(trial: Trial) -> None:
    """An algorithm's memory of an episode belongs to a lane, and ends with the episode."""
    group = trial.group(range(S)).start()
    group.train()
    seen, begun = group.look(), np.zeros((S, 8), np.bool_)
    fresh = group.act(seen)
    group.act(seen[:, ::-1].copy(), begun)
    require(
        np.array_equal(group.act(seen), fresh),
        "where all episodes begin, act chooses by what it saw in earlier ones: a validation would depend on the one "
        "before it",
    )
    later = group.act(seen[:, ::-1].copy(), begun)
    mixed = begun.copy()
    mixed[:, 3] = True
    group.act(seen)
    chosen = group.act(seen[:, ::-1].copy(), mixed)
    expected = later.copy()
    group.act(seen)
    expected[:, 3] = group.act(seen[:, ::-1].copy())[:, 3]
    require(
        np.array_equal(chosen, expected),
        "where an episode begins in one lane, act forgets what it saw in others, or remembers it there",
    )
    group.act(group.look(3))
    for name, value in group.algorithm.policy_state().items():
        other = trial.group(range(S), lanes=1).algorithm.policy_state()[name]
        require(
            other.shape == value.shape,
            f"policy '{name}' has shape {tuple(value.shape)} with {E} lanes and {tuple(other.shape)} with one: what is "
            "remembered of episodes is no part of a policy",
        )


def _heeds(trial: Trial) -> None:
    """Where one action alone can be chosen, it is chosen."""
    require(_obeys(trial), "act chooses what infos['action_mask'] forbids")


def _obeys(trial: Trial) -> bool:
    """Tell whether an untrained agent chooses each action where it alone can be chosen."""
    group = trial.group(range(S)).start()
    alone = np.eye(ACTIONS, dtype=np.bool_)
    return all(
        bool((group.act(infos={"action_mask": np.broadcast_to(mask, (S, 8, ACTIONS))}) == number).all())
        for number, mask in enumerate(alone)
    )


def _learns(trial: Trial) -> None:
    group = trial.group(range(S)).start()
    before = {k: v.detach().clone() for k, v in group.algorithm.policy_state().items()}
    require(bool(before), "policy_state() is empty: it is what is published as the trained agents")
    for name, value in before.items():
        require(
            value.dim() > 0 and value.shape[0] == S,
            f"policy '{name}' of shape {tuple(value.shape)} has no leading axis of {S} seeds",
        )
    group.train(3)
    after = group.algorithm.policy_state()
    for s in range(S):
        require(
            any(not torch.equal(before[name][s], value[s]) for name, value in after.items()),
            f"after three epochs, {3 * ROUNDS * E} interactions, the policy of seed {s} is as it was: is the optimizer "
            "stepped, is policy_state() the network that act uses, and does learning begin so late by default?",
        )
    other = trial.group(range(S), lanes=1)
    with torch.no_grad():
        for name, value in other.algorithm.policy_state().items():
            value.copy_(after[name])
    require(
        group.draws or np.array_equal(other.act(), group.act()),
        "trained parameters, copied into the tensors of policy_state(), do not make a new algorithm act as the trained "
        "one: return the tensors that act uses, all of them and no copies, for `qrlsuite evaluate` loads into them",
    )


def _trained(
    trial: Trial, seeds: Sequence[int], noise: int = 0, options: Any = None
) -> dict[str, NDArray[Any]]:
    """Return everything after two epochs, with another global random state for every `noise`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(noise)
        state = np.random.get_state()  # noqa: NPY002
        np.random.seed(noise)  # noqa: NPY002
        try:
            group = trial.group(seeds, options=options).start()
            metrics = group.train(2)
            return {
                **group.save(),
                **{f"metric {k}": v for k, v in metrics.items()},
                "actions": array(group.act()),
            }
        finally:
            np.random.set_state(state)  # noqa: NPY002


def _same(trial: Trial) -> None:
    name = differs(_trained(trial, [0, 1], 1), _trained(trial, [0, 1], 2))
    require(
        name is None,
        f"the same seeds trained twice differ in '{name}': draw from streams[s].numpy(name, epoch) or "
        "streams[s].torch(name, epoch), and from no global generator",
    )


def _different(trial: Trial) -> None:
    group = trial.group([0, 1]).start()
    group.train(2)
    policy = group.algorithm.policy_state()
    require(
        any(not torch.equal(value[0], value[1]) for value in policy.values()),
        "seeds 0 and 1 became the same agent: are populations built by build_model, with every seed's stream?",
    )


def _seed_first(trial: Trial) -> None:
    group = trial.group(range(S)).start()
    group.train()
    state = group.algorithm.state_dict()
    require(bool(state), "state_dict() is empty: what training depends on is lost when a run is resumed")
    for name, value in state.items():
        require(isinstance(value, Tensor), f"state '{name}' is {type(value).__name__}, not a tensor")
        require(
            value.dim() > 0 and value.shape[0] == S,
            f"state '{name}' of shape {tuple(value.shape)} has no leading axis of {S} seeds: checkpoints are sliced; "
            "repeat a counter as torch.tensor([count] * S)",
        )


def _independence(trial: Trial) -> None:
    whole = _trained(trial, range(S))
    for members in (*SIZES, (2, 2)):  # a search trains one seed with several settings in one population
        part = _trained(trial, members)
        name = differs(part, {key: value[list(members)] for key, value in whole.items()})
        require(
            name is None,
            f"seeds {list(members)} trained among themselves differ from those trained among all {S} in '{name}': sum "
            "the agents' own mean losses, clip norms per agent, normalize per agent, draw per seed",
        )


def _per_agent(trial: Trial) -> None:
    """Train one seed with two values of each marked option: as two agents, and alone."""
    for option, both in trial.subject.per_agent().items():
        together = _trained(trial, [0, 0], options=populations.joined(both))
        for place, own in enumerate(both):
            name = differs(_trained(trial, [0], options=own), {k: v[[place]] for k, v in together.items()})
            require(
                name is None,
                f"an agent with {option} = {getattr(own, option):g} differs in '{name}' beside one with another value "
                "from itself alone: such an option is then a float64 tensor (S,), and each agent's value belongs to "
                "its slice only; or leave per_agent out",
            )


def _state(trial: Trial) -> None:
    straight = trial.group(range(S)).start()
    straight.train(2)
    saved = straight.save()
    metrics = straight.train(2)
    expected = {**straight.save(), **{f"metric {k}": v for k, v in metrics.items()}}
    for members in (list(range(S)), [3], [4, 1]):
        other = trial.group(members).load({key: value[members] for key, value in saved.items()})
        metrics = other.train(2)
        got = {**other.save(), **{f"metric {k}": v for k, v in metrics.items()}}
        name = differs(got, {key: value[members] for key, value in expected.items()})
        require(
            name is None,
            f"resumed from a checkpoint, seeds {members} differ in '{name}' from those never stopped: optimizer "
            "moments, replay, current observations and the epoch's number belong into state_dict(), copied",
        )
