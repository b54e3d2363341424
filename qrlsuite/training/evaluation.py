"""Evaluates trained agents and reference policies on fresh episodes.

Every episode is one random stream of its own, keyed by (task, evaluation seed, "evaluation", episode): all
policies of a task, whatever the entry, meet the same episodes, and no training or validation episode is among
them. Episodes are played in rounds of lanes that each finish exactly one, so that short episodes are not
counted more often than long ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import InvalidAction
from numpy.typing import NDArray

from qrlsuite import specs
from qrlsuite.actions import check_actions, draw
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError, PluginError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import Task
from qrlsuite.results import codes
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training.trainer import Policy, Trainer, build_envs, play_episodes

EVALUATION_LANES = 100
"""Episodes of a policy that are played side by side."""
PERCENTILES = (5, 25, 50, 75, 95)

FloatArray = NDArray[np.float64]
Report = Callable[[str, int, int], None]
"""Called with a policy's name, the steps played and the steps of a round before, for a progress display."""


@dataclass(frozen=True, eq=False)
class Played:
    """Episodes of P agents, N each.

    Attributes
    ----------
    name:
        An entry's label, or a reference policy's name.
    returns:
        Sums of rewards (P, N), undiscounted.
    scores:
        Relative scores (P, N) as the task defines them, None where it knows no maximum.
    seeds:
        Seeds of the P agents; empty for a reference policy.
    validation:
        Last validation score of each agent, by which it was chosen (P,); empty for a reference policy.
    runs:
        Finished runs among which the agents were chosen.
    """

    name: str
    returns: FloatArray
    scores: FloatArray | None
    seeds: tuple[int, ...] = ()
    validation: tuple[float, ...] = ()
    runs: int = 0

    def summary(self) -> dict[str, Any]:
        """Return mean, percentiles and extremes over all episodes, as plain values."""
        content: dict[str, Any] = {
            "policy": self.name,
            "agents": len(self.returns),
            "episodes": int(self.returns.shape[1]),
            "return": distribution(self.returns),
            "score": None if self.scores is None else distribution(self.scores),
        }
        if self.seeds:
            content |= {"runs": self.runs, "seeds": [self._agent(p) for p in range(len(self.seeds))]}
        return content

    def _agent(self, p: int) -> dict[str, Any]:
        return {
            "seed": self.seeds[p],
            "validation_score": self.validation[p],
            "mean_return": float(self.returns[p].mean()),
            "mean_score": None if self.scores is None else float(self.scores[p].mean()),
        }


def distribution(values: FloatArray) -> dict[str, float]:
    """Return mean, standard deviation, minimum, percentiles (`p5` .. `p95`) and maximum of all values."""
    flat = np.asarray(values, np.float64).ravel()
    levels = np.percentile(flat, PERCENTILES)
    return {
        "mean": float(flat.mean()),
        "std": float(flat.std()),
        "min": float(flat.min()),
        **{f"p{level}": float(value) for level, value in zip(PERCENTILES, levels)},
        "max": float(flat.max()),
    }


def best_runs(store: EntryStore, count: int) -> tuple[list[int], list[float], int]:
    """Choose the runs with the best last validation score, earlier seeds first where equal.

    Only finished runs with the largest number of epochs count; and if some of them have agents, only those runs: an
    entry may have been imported with some agents.

    Returns
    -------
    tuple
        Their seeds, their last validation scores, and the number of runs to choose from.
    """
    if count < 1:
        raise OptionError(f"--best {count}: at least one run is needed")
    records = {seed: store.seed(seed).record() for seed in store.seeds()}
    finished = {seed: record for seed, record in records.items() if record is not None and record.finished}
    longest = max((record.epochs for record in finished.values()), default=0)
    last: dict[int, float] = {}
    for seed in sorted(seed for seed, record in finished.items() if record.epochs == longest):
        curve = store.seed(seed).read().curve
        if len(curve):
            last[seed] = float(curve[-1])
    if not last:
        raise StoreError(
            f"{store.path}: no run has finished, so there is no trained agent; `qrlsuite run` finishes them"
        )
    published = {seed: score for seed, score in last.items() if finished[seed].agent}
    last = published or last
    most = -1 if store.record().task_file.score.goal == "below" else 1
    chosen = sorted(last, key=lambda seed: (-most * last[seed], seed))[:count]
    return chosen, [last[seed] for seed in chosen], len(last)


def trained_agents(entry: Entry, store: EntryStore, seeds: Sequence[int], device: str = "cpu") -> Trainer:
    """Return finished runs of an entry with their trained parameters, as one population that can act."""
    codes.require_installed(store, identity.of(store.entry()))  # not of another backend that they act on
    stored = [store.seed(seed).parameters() for seed in seeds]
    trainer = Trainer(entry, seeds, device)
    state = _state(trainer)
    for seed, arrays in zip(seeds, stored):
        require_fitting(trainer, arrays, store.seed(seed).agent)
    with torch.no_grad():
        for name, value in state.items():
            together = torch.from_numpy(np.stack([arrays[name] for arrays in stored]))
            value.copy_(together.reshape(value.shape))
    if trainer.statistics is not None:
        trainer.statistics.refresh()
    for name, loaded in trainer.algorithm.policy_state().items():
        value = state[name]
        if not torch.equal(value.cpu(), loaded.cpu()) and not bool(torch.isnan(value).any()):
            raise PluginError(
                f"algorithm '{type(trainer.algorithm).__name__}': policy_state() returns copies; it has to return "
                "the tensors that act() uses, into which trained parameters are loaded"
            )
    return trainer


def require_fitting(trainer: Trainer, agent: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Refuse trained parameters that do not fit a trainer's agents."""
    problem = _misfit({name: value[0] for name, value in _state(trainer).items()}, agent)
    if problem:
        raise StoreError(f"{path} does not fit the entry's model: {problem}")


def _state(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Return the tensors that a trained agent is loaded into, seed-first by name."""
    state = dict(trainer.algorithm.policy_state())
    return state if trainer.statistics is None else {**state, **trainer.statistics.published()}


def _misfit(expected: Mapping[str, torch.Tensor], stored: Mapping[str, NDArray[Any]]) -> str | None:
    """Say where names, shapes or types of stored parameters differ from the model's own; None where they agree."""
    missing, unexpected = sorted(set(expected) - set(stored)), sorted(set(stored) - set(expected))
    if missing:
        return f"it has no '{missing[0]}'" + (f", but '{unexpected[0]}'" if unexpected else "")
    if unexpected:
        return f"it has '{unexpected[0][:80]}', which the model has not"
    for name, value in expected.items():
        stored_value = stored[name]
        dtype = str(value.dtype).removeprefix("torch.")
        scalar = value.dim() == 0 and stored_value.shape == (1,)  # how a number per agent is stored
        if not (stored_value.shape == tuple(value.shape) or scalar) or stored_value.dtype.name != dtype:
            stored_form = f"{stored_value.dtype.name} of shape {stored_value.shape}"
            return f"'{name}' is {stored_form}, not {dtype} of shape {tuple(value.shape)}"
    return None


def trained_entry(store: EntryStore, on: Task | None = None) -> Entry:
    """Return a stored entry whose agents are to play.

    Parameters
    ----------
    on:
        The task that they play, if it is not the one that they were trained on.
    """
    if store.record().imported:
        raise StoreError(
            f"{store.path} was imported from other files, which hold learning curves and no trained parameters: "
            "train the entry here with `qrlsuite run` to evaluate its policies"
        )
    entry = store.entry()
    if on is None or on.hash == entry.task.hash:
        return entry
    there = replace(entry, task=on)
    envs = [build_envs(each, 1, lambda: None) for each in (entry, there)]
    for what in ("observation", "action"):
        trained_on, played = (getattr(each, f"single_{what}_space") for each in envs)
        if trained_on != played:
            raise OptionError(
                f"--task {on.name}: '{entry.label}' was trained on '{entry.task.name}', whose {what}s are "
                f"{_short(trained_on)}, but here {_short(played)}: agents play only where both are equal"
            )
    if envs[0].inner.running_statistics != envs[1].inner.running_statistics:
        raise OptionError(
            f"--task {on.name}: one of it and '{entry.task.name}' has normalization = 'running': not both"
        )
    return there


def _short(space: spaces.Space[Any]) -> str:
    return " ".join(str(space).split())[:100]


def policy_name(store: EntryStore, on: Task | None = None) -> str:
    """Return the label of an entry whose agents play, with the task of their training where they play another one."""
    entry = store.entry()
    elsewhere = on is not None and on.hash != entry.task.hash
    return f"{entry.label} (trained on {entry.task.name})" if elsewhere else entry.label


def trained(
    store: EntryStore,
    best: int = 10,
    episodes: int = 1000,
    seed: int = 0,
    device: str = "cpu",
    report: Report = lambda name, done, total: None,
    on: Task | None = None,
    perturb: float = 0.0,
) -> Played:
    """Evaluate the best runs of an entry.

    Parameters
    ----------
    best:
        Number of runs, chosen by the best last *validation* score. The evaluation has other episodes, so the choice
        does not raise its mean.
    seed:
        Evaluation seed; another one gives other episodes.
    on:
        The task that is played; None for the one that they were trained on.
    perturb:
        Multiply every trained number by 1 + perturb * z, z standard normal, drawn anew for each agent and each round of
        `EVALUATION_LANES` episodes. Equal seeds draw equal z, whatever the scale.
    """
    entry, name = trained_entry(store, on), policy_name(store, on)
    if not 0.0 <= perturb < np.inf:
        raise OptionError(f"--perturb {perturb:g}: give a relative size of the noise, such as 0.1")
    seeds, validation, runs = best_runs(store, best)
    agents = trained_agents(entry, store, seeds, device)
    shake = _perturbing(agents, perturb, Streams(entry.task.hash, seed)) if perturb else None

    def build(envs: LaneEnv, block: int) -> Policy:
        if shake is not None:
            shake(block)
        return agents.act

    name += f" perturbed {perturb:g}" if perturb else ""
    returns, scores, _ = play(entry, len(seeds), episodes, seed, build, name, report)
    return Played(name, returns, scores, tuple(seeds), tuple(validation), runs)


def _perturbing(agents: Trainer, scale: float, streams: Streams) -> Callable[[int], None]:
    """Return a function that perturbs the agents' trained numbers by a relative size, anew for each round."""
    learned = {p.data_ptr() for model in agents.models.built for p in model.parameters() if p.requires_grad}
    state = agents.algorithm.policy_state()
    exact = {n: state[n].detach().clone() for n in sorted(state) if state[n].data_ptr() in learned}

    def draw(block: int) -> None:
        drawn = [streams.numpy(f"evaluation perturbation {seed}", block) for seed in agents.seeds]
        now = agents.algorithm.policy_state()  # a pass may move parameters in memory
        for name, value in exact.items():
            noise = np.stack([stream.standard_normal(value.shape[1:]) for stream in drawn])
            now[name].detach().copy_(value * (1.0 + scale * torch.from_numpy(noise).to(value)))

    return draw


def references(
    entry: Entry,
    episodes: int = 1000,
    seed: int = 0,
    report: Report = lambda name, done, total: None,
) -> list[Played]:
    """Evaluate the environment's reference policies, and the random one, on the episodes of `trained`."""
    played = []
    for name, reference in entry.task.environment.policies.items():
        factory = specs.resolve(reference)

        def build(envs: LaneEnv, block: int, factory: Any = factory, name: str = name) -> Policy:
            return _checked(name, factory(envs), envs)

        returns, scores, _ = play(entry, 1, episodes, seed, build, name, report)
        played.append(Played(name, returns, scores))
    if "random" not in entry.task.environment.policies:
        streams = Streams(entry.task.hash, seed)

        def uniform(envs: LaneEnv, block: int) -> Policy:
            stream = streams.numpy("evaluation random", block)
            return lambda observations: draw(envs.single_action_space, stream, envs.num_envs)

        returns, scores, _ = play(entry, 1, episodes, seed, uniform, "random", report)
        played.append(Played("random", returns, scores))
    return played


def _checked(name: str, policy: Policy, envs: LaneEnv) -> Policy:
    """Return a reference policy whose actions are looked at before the environment takes them."""

    def act(observations: NDArray[np.float32]) -> NDArray[Any]:
        given = np.asarray(policy(observations))
        try:
            check_actions(given, envs.num_envs, envs.single_action_space)
        except InvalidAction as error:
            raise PluginError(f"reference policy '{name}': {error}") from None
        return given.astype(envs.single_action_space.dtype)

    return act


class Round(NamedTuple):
    """Episodes that P agents played side by side: returns and scores (P, lanes), and the steps of all together."""

    returns: FloatArray
    scores: FloatArray
    steps: int


class KeptRounds(Protocol):
    """A store of finished rounds, by number and lanes."""

    def get(self, block: int, lanes: int) -> Round | None:
        """Return a round that was finished before."""

    def add(self, block: int, lanes: int, played: Round) -> None:
        """Keep a finished round."""


def play(
    entry: Entry,
    agents: int,
    episodes: int,
    seed: int,
    build: Callable[[LaneEnv, int], Policy],
    name: str = "policy",
    report: Report = lambda name, done, total: None,
    most_lanes: int = EVALUATION_LANES,
    kept: KeptRounds | None = None,
) -> tuple[FloatArray, FloatArray | None, int]:
    """Play the evaluation's episodes with P agents at once.

    Parameters
    ----------
    build:
        Called at the beginning of each round of episodes with the lanes, seed-major in the agents, and the
        round's number.
    most_lanes:
        Episodes of an agent that are played side by side; which episodes are played does not depend on it.
    kept:
        Rounds found here are not played again, and others put there.

    Returns
    -------
    tuple
        Returns (P, N), scores (P, N) or None where the task knows no maximum, and the number of steps of all.
    """
    if episodes < 1:
        raise OptionError(f"--episodes {episodes}: at least one is needed")
    streams = Streams(entry.task.hash, seed)
    lanes = min(most_lanes, episodes)
    envs = build_envs(entry, agents * lanes, lambda: None)
    envs.inner.autoreset = False
    rounds = -(-episodes // lanes)
    returns, scores = (np.empty((agents, rounds * lanes)) for _ in range(2))
    steps = 0
    for block in range(rounds):
        columns = slice(block * lanes, (block + 1) * lanes)
        keys = range(columns.start, columns.stop)
        envs.seed_lanes([streams.numpy("evaluation", key) for _ in range(agents) for key in keys])
        report(name, block * lanes * agents, episodes * agents)
        played = None if kept is None else kept.get(block, lanes)
        if played is None:
            ended = play_episodes(envs, lambda: build(envs.inner, block))  # noqa: B023 - called in this round
            played = Round(
                ended.returns.reshape(agents, lanes),
                ended.scores.reshape(agents, lanes),
                int(ended.lengths.sum()),
            )
            if kept is not None:
                kept.add(block, lanes, played)
        returns[:, columns], scores[:, columns] = played.returns, played.scores
        steps += played.steps
    report(name, episodes * agents, episodes * agents)
    known = knows_scores(entry)
    return returns[:, :episodes].copy(), scores[:, :episodes].copy() if known else None, steps


def knows_scores(entry: Entry) -> bool:
    """Return whether the entry's task ranks another number than an episode's return."""
    section = entry.task.file.score
    return section.source == "info" or section.max_return is not None
