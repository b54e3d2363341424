"""Rules of algorithms: seeds do not influence each other, resuming is exact, agents learn from their own data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qrlsuite import population as populations
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import SIZES, Checklist, Finding, one_thread, require
from qrlsuite.testing.group import ACTIONS, ROUNDS, E, ToyGroup, array, differs

S = 5


def check(subject: Subject) -> list[Finding]:
    """Check an algorithm on an environment of four inputs and three actions."""
    rules = Checklist()
    with one_thread():
        cause = "the factory takes (envs, build_model, options, streams, device)"
        if not rules.run(
            "builds", "factory, and a population with one output per action", lambda: _builds(subject), cause
        ):
            return rules.findings
        cause = "start() resets the environments, train_epoch(rounds) steps them and returns metrics"
        if not rules.run("trains", "an epoch gives metrics (S,) in float64", lambda: _trains(subject), cause):
            return rules.findings
        rules.run(
            "interactions",
            f"{ROUNDS} rounds are {ROUNDS} steps of every lane",
            lambda: _interactions(subject),
        )
        cause = "act takes observations (S, B, inputs), B as many as validation has lanes"
        rules.run(
            "acts", "integers (S, B), the same every time, changing nothing", lambda: _acts(subject), cause
        )
        cause = "`qrlsuite evaluate` builds a new algorithm, never starts it, loads the policy, and calls act"
        rules.run("learns", "every policy changes, and can be published", lambda: _learns(subject), cause)
        rules.run("same seed", "the same streams give the same bits", lambda: _same(subject))
        rules.run("different seed", "other seeds become other agents", lambda: _different(subject))
        if not rules.run("state is seed-first", "every tensor of it", lambda: _seed_first(subject)):
            return rules.findings
        rules.run(
            "seed independence", "alone, in pairs, shuffled: the same bits", lambda: _independence(subject)
        )
        cause = (
            "an option marked per_agent is a float64 tensor (S,) where agents differ in it: Adam of "
            "qrlsuite.population takes one as a learning rate; reshape it to (S, 1, 1) before it multiplies (S, B, n)"
        )
        rules.run(
            "options per agent",
            "two values in one population: the bits of each alone",
            lambda: _per_agent(subject),
            cause,
        )
        cause = "load_state_dict() takes what state_dict() returned, or slices of it, in place of start()"
        rules.run("state", "saved, sliced and restored exactly", lambda: _state(subject), cause)
    return rules.findings


def _builds(subject: Subject) -> None:
    group = ToyGroup(subject, range(S))
    require(
        ACTIONS in group.outputs,
        f"build_model was called with {group.outputs} outputs, and there are {ACTIONS} actions: take "
        "envs.single_action_space.n",
    )


def _trains(subject: Subject) -> None:
    metrics = ToyGroup(subject, range(S)).start().train()
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
    group = ToyGroup(subject, range(S)).start()
    for epoch in (1, 2):
        group.train()
        require(
            group.envs.steps == epoch * ROUNDS,
            f"after {epoch} epochs of {ROUNDS} rounds the lanes were stepped {group.envs.steps} times: sample "
            "complexity counts interactions, so an epoch is cut where its rounds end, also inside an episode",
        )


def _acts(subject: Subject) -> None:
    group = ToyGroup(subject, range(S)).start()
    group.train()
    before = group.save()
    first, second = group.act(), group.act()
    require(
        isinstance(first, np.ndarray),
        f"act returned {type(first).__name__}, and must return a numpy array: end with .cpu().numpy()",
    )
    require(
        first.shape == (S, 8) and first.dtype == np.int64,
        f"act returned {first.dtype} of shape {first.shape}, and must return int64 of shape ({S}, 8): one action per "
        "observation, the best of the last axis by .argmax(2)",
    )
    require(
        bool((first >= 0).all() and (first < ACTIONS).all()),
        f"act chose {first.min()}..{first.max()}, and there are the actions 0..{ACTIONS - 1}",
    )
    require(
        group.draws or np.array_equal(first, second),
        "act chooses differently on the same observations: it must be greedy, without exploration or sampling; an "
        "algorithm that means to draw in validation says so by self.draws = True",
    )
    name = differs(before, group.save())
    require(name is None, f"act changes the state '{name}': validation must leave no trace in training")
    never = ToyGroup(subject, range(S)).start()
    never.train(2)
    group.train()
    name = differs(never.save(), group.save())
    require(
        name is None,
        f"an epoch after act ends with another '{name}' than without it: validation must leave no trace in training; "
        "does act draw from a generator, or count, and training depend on it?",
    )


def _learns(subject: Subject) -> None:
    group = ToyGroup(subject, range(S)).start()
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
    other = ToyGroup(subject, range(S), lanes=1)
    with torch.no_grad():
        for name, value in other.algorithm.policy_state().items():
            value.copy_(after[name])
    require(
        group.draws or np.array_equal(other.act(), group.act()),
        "trained parameters, copied into the tensors of policy_state(), do not make a new algorithm act as the trained "
        "one: return the tensors that act uses, all of them and no copies, for `qrlsuite evaluate` loads into them",
    )


def _trained(
    subject: Subject, seeds: Sequence[int], noise: int = 0, options: Any = None
) -> dict[str, NDArray[Any]]:
    """Return everything after two epochs, with another global random state for every `noise`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(noise)
        state = np.random.get_state()  # noqa: NPY002
        np.random.seed(noise)  # noqa: NPY002
        try:
            group = ToyGroup(subject, seeds, options=options).start()
            metrics = group.train(2)
            return {
                **group.save(),
                **{f"metric {k}": v for k, v in metrics.items()},
                "actions": array(group.act()),
            }
        finally:
            np.random.set_state(state)  # noqa: NPY002


def _same(subject: Subject) -> None:
    name = differs(_trained(subject, [0, 1], 1), _trained(subject, [0, 1], 2))
    require(
        name is None,
        f"the same seeds trained twice differ in '{name}': draw from streams[s].numpy(name, epoch) or "
        "streams[s].torch(name, epoch), and from no global generator",
    )


def _different(subject: Subject) -> None:
    group = ToyGroup(subject, [0, 1]).start()
    group.train(2)
    policy = group.algorithm.policy_state()
    require(
        any(not torch.equal(value[0], value[1]) for value in policy.values()),
        "seeds 0 and 1 became the same agent: are populations built by build_model, with every seed's stream?",
    )


def _seed_first(subject: Subject) -> None:
    group = ToyGroup(subject, range(S)).start()
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


def _independence(subject: Subject) -> None:
    whole = _trained(subject, range(S))
    for members in (*SIZES, (2, 2)):  # a search trains one seed with several settings in one population
        part = _trained(subject, members)
        name = differs(part, {key: value[list(members)] for key, value in whole.items()})
        require(
            name is None,
            f"seeds {list(members)} trained among themselves differ from those trained among all {S} in '{name}': sum "
            "the agents' own mean losses, clip norms per agent, normalize per agent, draw per seed",
        )


def _per_agent(subject: Subject) -> None:
    """Train one seed with two values of each marked option: as two agents, and alone."""
    for option, both in subject.per_agent().items():
        together = _trained(subject, [0, 0], options=populations.joined(both))
        for place, own in enumerate(both):
            name = differs(_trained(subject, [0], options=own), {k: v[[place]] for k, v in together.items()})
            require(
                name is None,
                f"an agent with {option} = {getattr(own, option):g} differs in '{name}' beside one with another value "
                "from itself alone: such an option is then a float64 tensor (S,), and each agent's value belongs to "
                "its slice only; or leave per_agent out",
            )


def _state(subject: Subject) -> None:
    straight = ToyGroup(subject, range(S)).start()
    straight.train(2)
    saved = straight.save()
    metrics = straight.train(2)
    expected = {**straight.save(), **{f"metric {k}": v for k, v in metrics.items()}}
    for members in (list(range(S)), [3], [4, 1]):
        other = ToyGroup(subject, members).load({key: value[members] for key, value in saved.items()})
        metrics = other.train(2)
        got = {**other.save(), **{f"metric {k}": v for k, v in metrics.items()}}
        name = differs(got, {key: value[members] for key, value in expected.items()})
        require(
            name is None,
            f"resumed from a checkpoint, seeds {members} differ in '{name}' from those never stopped: optimizer "
            "moments, replay, current observations and the epoch's number belong into state_dict(), copied",
        )
