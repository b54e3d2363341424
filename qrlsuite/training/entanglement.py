"""How entangled a circuit's states are along the episodes of trained agents, beside their initial parameters.

The measures are those of `qrlsuite.diagnostics.states`.

Trained agents play; what their networks are given at every step is kept, and the states that circuit and linear layer
make of it are compared with those that the same agents' initial parameters make of the same observations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from qrlsuite.circuit import CircuitModel
from qrlsuite.diagnostics.states import half_cut_entropy, meyer_wallach
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import Task
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation
from qrlsuite.training.trainer import Trainer, build_envs, play_episodes

EPISODES, STEPS = 20, 50
"""Episodes of each agent, and evenly spaced steps of them, at most: a state has 2^n amplitudes."""

MEASURES = ("meyer-wallach", "half-cut entropy")
PARAMETERS = ("trained", "initial")

Values = dict[str, dict[str, NDArray[np.float64]]]


@dataclass(frozen=True, eq=False)
class Entanglement:
    """The entanglement of P agents' states over E episodes at K steps.

    Attributes
    ----------
    name:
        The entry's label.
    qubits:
        Number n of qubits.
    seeds:
        Seeds of the agents.
    steps:
        The steps (K,), 0 for the first observation of an episode.
    values:
        By measure and by parameters (`trained`, `initial`): (P, E, K) float64, NaN after an episode's end.
    """

    name: str
    qubits: int
    seeds: tuple[int, ...]
    steps: NDArray[np.int64]
    values: Values

    def as_dict(self) -> dict[str, Any]:
        """Return mean and percentiles over agents, episodes and steps, as plain values."""
        return {
            "policy": self.name,
            "qubits": self.qubits,
            "seeds": list(self.seeds),
            "episodes": int(self.values[MEASURES[0]][PARAMETERS[0]].shape[1]),
            "steps": self.steps.tolist(),
            **{
                measure: {which: evaluation.distribution(v[~np.isnan(v)]) for which, v in by_network.items()}
                for measure, by_network in self.values.items()
            },
        }


def along_episodes(
    store: EntryStore,
    best: int = 10,
    episodes: int = EPISODES,
    seed: int = 0,
    device: str = "cpu",
    on: Task | None = None,
) -> Entanglement:
    """Play with the best agents of an entry and measure their circuits' states.

    Parameters
    ----------
    best, seed, device, on:
        As for `qrlsuite.training.evaluation.trained`; the episodes are the first of those.
    episodes:
        Episodes of each agent; more than `EPISODES` are not played.

    Raises
    ------
    OptionError
        If the model has no circuit whose states could be entangled.
    StoreError
        If there is no trained agent.
    EnvironmentFailure
        If the environment fails.
    """
    entry = evaluation.trained_entry(store, on)
    states_of(Trainer(entry, [0], device).models.built[0], entry, torch.zeros(1, 1, 0), check=True)
    seeds, _, _ = evaluation.best_runs(store, best)
    agents = evaluation.trained_agents(entry, store, seeds, device)
    inputs, lengths = _play(entry, agents, len(seeds), min(episodes, EPISODES), seed)
    steps = np.unique(np.linspace(0, len(inputs) - 1, STEPS).round().astype(np.int64))
    networks = {"trained": agents.models.built[0], "initial": Trainer(entry, seeds, device).models.built[0]}
    values: Values = {measure: {} for measure in MEASURES}
    qubits = 0
    for which, network in networks.items():
        rows = []
        for step in steps.tolist():
            states = states_of(network, entry, inputs[step]).cpu().numpy()
            qubits = states.shape[-1].bit_length() - 1
            rows.append([meyer_wallach(states), half_cut_entropy(states)])
        for measure, per_step in zip(MEASURES, zip(*rows)):
            array = np.stack(per_step, axis=-1)
            values[measure][which] = np.where(steps < lengths[..., None], array, np.nan)
    return Entanglement(evaluation.policy_name(store, on), qubits, tuple(seeds), steps, values)


def states_of(network: nn.Module, entry: Entry, x: Tensor, check: bool = False) -> Tensor:
    """Return the circuit's states (P, E, 2^n) for a network's inputs (P, E, in); `check` only asks whether it has some.

    Raises
    ------
    OptionError
        If the network has no circuit, or one whose qubits share no state.
    """
    if not isinstance(network, CircuitModel):
        raise OptionError(f"--entanglement: model '{entry.model.name}' of '{entry.label}' has no circuit")
    if network.description.mean_field:
        raise OptionError(f"--entanglement: '{entry.label}' drops all correlations, so nothing is entangled")
    if check:
        return x
    with torch.no_grad():
        return network.circuit_states(x)


def _play(
    entry: Entry, agents: Trainer, count: int, episodes: int, seed: int
) -> tuple[list[Tensor], NDArray[np.int64]]:
    """Return what the policy network was given at every step, each (P, E, in), and the episodes' lengths (P, E)."""
    if episodes < 1:
        raise OptionError(f"--episodes {episodes}: at least one is needed")
    streams = Streams(entry.task.hash, seed)
    envs = build_envs(entry, count * episodes, lambda: None)
    envs.inner.autoreset = False
    envs.seed_lanes([streams.numpy("evaluation", key) for _ in range(count) for key in range(episodes)])
    inputs: list[Tensor] = []
    # registered after the standardization's own, so that it sees what the network computes with
    hook = agents.models.built[0].register_forward_pre_hook(
        lambda module, args: inputs.append(args[0].clone())
    )
    try:
        ended = play_episodes(envs, lambda: agents.act)
    finally:
        hook.remove()
    return inputs, ended.lengths.reshape(count, episodes)
