"""Trained agents on another circuit backend: the same network and parameters, its circuits run with shots, noise, or
on a device.

Finished rounds of episodes are kept in the entry's folder, so that an evaluation that was stopped, or that a device
ended half-way, goes on where it was. Sampling is keyed by the evaluation's seed and the round, not by earlier play: an
evaluation in two parts ends with the same numbers as in one go.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from qrlsuite import options, registry, specs
from qrlsuite.circuit import CircuitModel
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import Task
from qrlsuite.results.records import RoundLine
from qrlsuite.results.store import EntryStore, append, drop_torn_line, json_line, read_lines
from qrlsuite.seeding import Streams
from qrlsuite.training.evaluation import (
    Played,
    Report,
    Round,
    best_runs,
    play,
    policy_name,
    trained_agents,
    trained_entry,
)
from qrlsuite.training.trainer import Policy, Trainer, first_network

LANES = 10
"""Episodes of every agent in a round: the most that a device that stops half-way can lose."""


def on_backend(entry: Entry, backend: str, values: Mapping[str, Any]) -> Entry:
    """Return the entry with its circuits on another backend.

    Parameters
    ----------
    values:
        Options of that backend; others have their defaults, whatever the entry was trained with.
    """
    trained_on = getattr(entry.model_options, "backend", None)
    if trained_on is None:
        raise OptionError(f"--backend {backend}: model '{entry.model.name}' has no circuit")
    spec = registry.get(specs.CircuitBackendSpec, backend)
    options.build(specs.resolve(spec.options), values, f"circuit backend '{backend}'")
    registered = registry.load()
    for name in registered.names(specs.ModelSpec):
        model = registry.get(specs.ModelSpec, name)
        on_another = model.options.endswith("]") and not model.options.endswith(f"[{backend}]")
        if model.build != entry.model.build or on_another:
            continue
        cls = specs.resolve(model.options)
        if getattr(cls, "backend", None) == backend:
            break
    else:
        raise OptionError(
            f"--backend {backend}: no model computes the circuits of '{entry.model.name}' on that backend"
        )
    left_behind = options.field_names(
        specs.resolve(registry.get(specs.CircuitBackendSpec, trained_on).options)
    )
    kept = {
        name: value for name, value in options.plain(entry.model_options).items() if name not in left_behind
    }
    model_options = options.build(cls, {**kept, **values}, f"model '{model.name}'")
    if hasattr(model_options, "check"):
        model_options.check()
    return replace(entry, model=model, model_options=model_options)


@dataclass(frozen=True)
class Cost:
    """The cost of an evaluation on a backend.

    Attributes
    ----------
    circuits:
        Circuits to execute, about: one per step, agent and episode that is not kept from before.
    shots:
        Repetitions of each; None where the backend computes expectation values exactly.
    terms:
        The device's terms for that many executions.
    kept:
        Episodes of each agent that were played before.
    """

    agents: int
    episodes: int
    kept: int
    circuits: int
    shots: int | None
    terms: str = ""

    def __str__(self) -> str:
        shots = (
            "" if self.shots is None else f", {self.shots} shots each: {self.shots * self.circuits:,} shots"
        )
        kept = f" ({self.kept} of them are finished already)" if self.kept else ""
        terms = f"; {self.terms}" if self.terms else ""
        played = f"{self.agents} agents, {self.episodes} episodes each{kept}"
        return f"{played}: about {self.circuits:,} circuits{shots}{terms}"


class Deployment:
    """An entry's best agents on another backend.

    Attributes
    ----------
    simulator:
        Whether the backend only simulates; else executions may cost money and queue.
    """

    def __init__(
        self,
        store: EntryStore,
        backend: str,
        values: Mapping[str, Any],
        best: int,
        device: str = "cpu",
        on: Task | None = None,
    ) -> None:
        entry = trained_entry(store, on)
        self.entry = on_backend(entry, backend, values)
        self.seeds, self.validation, self.runs = best_runs(store, best)
        # Not the agents yet: what builds a population tries it out, which on a device executes circuits.
        network = cast(CircuitModel, first_network(self.entry))
        self.simulator, self.shots = network.simulator, network.executions.shots
        self._circuits = network.executions.bases
        self._terms: Callable[[int], str] = getattr(network, "terms", lambda circuits: "")
        self._store, self._device = store, device
        chosen = " ".join(f"{name}={value}" for name, value in values.items())
        self.name = f"{policy_name(store, on)} on {backend}{' ' if chosen else ''}{chosen}"
        self.folder = store.evaluations
        self._description: dict[str, Any] = {
            "format_version": 1,
            "model": self.entry.model.name,
            "model_options": options.plain(self.entry.model_options),
            "epochs": [store.seed(seed).trained_epochs() for seed in self.seeds],
            "agents": self.seeds,
        }
        if entry.task.hash != store.record().task_hash:
            self._description["task_hash"] = entry.task.hash

    @cached_property
    def agents(self) -> Trainer:
        """The trained agents, on the backend."""
        return trained_agents(self.entry, self._store, self.seeds, self._device)

    def kept(self, seed: int) -> Kept:
        """Return the stored rounds of the evaluation with a seed."""
        return Kept(self.folder, {**self._description, "evaluation_seed": seed})

    def cost(self, episodes: int, seed: int, steps: float) -> Cost:
        """Return the remaining executions, at a mean number of steps per episode."""
        lanes = min(LANES, episodes)
        rounds = -(-episodes // lanes)
        done = sum(1 for block in range(rounds) if self.kept(seed).get(block, lanes) is not None)
        circuits = round(len(self.seeds) * (rounds - done) * lanes * steps * self._circuits)
        kept = min(done * lanes, episodes)
        return Cost(len(self.seeds), episodes, kept, circuits, self.shots, self._terms(circuits))

    def play(self, episodes: int, seed: int, report: Report = lambda name, done, total: None) -> Played:
        """Play the episodes of `qrlsuite.training.evaluation.trained`; finished rounds are stored."""
        streams = Streams(self.entry.task.hash, seed)
        progress = [0]

        def begin(envs: LaneEnv, block: int) -> Policy:
            progress[0] = block * min(LANES, episodes)
            first = int(streams.numpy("evaluation shots", block).integers(2**62))
            for name, value in self.agents.algorithm.policy_state().items():
                if name.rpartition(".")[2] == "shot_count":
                    value.fill_(first)
            return self._guarded(progress)

        returns, scores, _ = play(
            self.entry, len(self.seeds), episodes, seed, begin, self.name, report, LANES, self.kept(seed)
        )
        return Played(self.name, returns, scores, tuple(self.seeds), tuple(self.validation), self.runs)

    def _guarded(self, progress: Sequence[int]) -> Policy:
        def act(observations: NDArray[np.float32], *more: Any) -> NDArray[Any]:
            try:
                return self.agents.act(observations, *more)
            except Exception as error:  # whatever a device's package raises
                reason = " ".join(str(error).split()) or type(error).__name__
                raise QrlSuiteError(
                    f"{self.name}: stopped after {progress[0]} episodes of each agent: {reason}; they are "
                    "kept, and the same command plays the rest"
                ) from error

        return act


class Kept:
    """Finished rounds of one evaluation, a JSON line each, below the entry's folder.

    Attributes
    ----------
    path:
        The file, named by the hash of the description in its first line.
    """

    def __init__(self, folder: Path, description: Mapping[str, Any]) -> None:
        text = json.dumps(description, sort_keys=True)
        self.path = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.jsonl"
        self._description = description
        rounds = [RoundLine.read(line, self.path) for line in read_lines(self.path) if "round" in line]
        self._rounds = {(line.round, line.lanes): line for line in rounds}

    def get(self, block: int, lanes: int) -> Round | None:
        """Return a round (P, lanes), or None."""
        line = self._rounds.get((block, lanes))
        if line is None:
            return None
        scores = np.array([[np.nan if x is None else x for x in row] for row in line.scores])
        return Round(np.array(line.returns), scores, line.steps)

    def add(self, block: int, lanes: int, played: Round) -> None:
        """Keep a finished round."""
        scores = [[None if np.isnan(x) else x for x in row] for row in played.scores.tolist()]
        returns = played.returns.tolist()
        line = RoundLine(round=block, lanes=lanes, steps=played.steps, returns=returns, scores=scores)
        if not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            append(self.path, json_line(self._description))
        drop_torn_line(self.path)
        append(self.path, json_line(line.content))


def steps_per_episode(
    store: EntryStore, best: int, episodes: int, seed: int, device: str = "cpu", on: Task | None = None
) -> float:
    """Return the mean steps of the first of the evaluation's episodes, played as the agents were trained."""
    entry = trained_entry(store, on)
    seeds, _, _ = best_runs(store, best)
    agents = trained_agents(entry, store, seeds, device)
    few = min(episodes, LANES)
    _, _, steps = play(entry, len(seeds), few, seed, lambda envs, block: agents.act)
    return steps / (len(seeds) * few)
