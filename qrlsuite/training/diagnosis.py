"""Diagnostics of trained agents, beside the same agents before training.

Trained agents play, and their networks' inputs at every step are stored. At these inputs both networks are examined:
trained, and with their initial parameters.

- Fisher information of the trainable parameters, see `qrlsuite.diagnostics.fisher`: of the policy, if the algorithm
  defines `information` of its network's outputs, else of values;
- spectrum of the outputs along each input, over the visited range, see `qrlsuite.diagnostics.fourier`;
- entanglement of the circuits' states, see `qrlsuite.diagnostics.states`.

Circuits are computed exactly, by the native simulator, whatever they were trained with.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from qrlsuite.circuit import CircuitModel
from qrlsuite.diagnostics import fisher, fourier
from qrlsuite.diagnostics.states import half_cut_entropy, meyer_wallach
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.task import Task
from qrlsuite.population import remembers
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation
from qrlsuite.training.deployment import on_backend
from qrlsuite.training.trainer import Trainer, build_envs, play_episodes

EPISODES, STEPS = 20, 50
"""Episodes of each agent, and evenly spaced steps of them at which states are measured: one has 2^n amplitudes."""
MOST_STATES = 400
"""At which the outputs are differentiated."""
LINES, SAMPLES, MOST_INPUTS = 10, 128, 4
"""Of a spectrum: visited inputs from which lines are drawn, samples of each, inputs that are varied."""
MEASURES = ("meyer-wallach", "half-cut entropy")
PARAMETERS = ("trained", "initial")

Array = NDArray[np.float64]
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Diagnostics of P agents with `trained` and `initial` parameters.

    Attributes
    ----------
    name:
        The entry's label.
    outputs:
        `policy` if the Fisher information is of the policy, else `values`: Gaussians of unit variance.
    shapes:
        Shapes of one agent's trainable parameters.
    information:
        Fisher information of each agent; empty for a network that remembers: its outputs depend on more than its input.
    powers:
        Of each agent (P, F), at 1, 2, ... waves in the range of an input that was visited, mean over inputs and outputs
        of each agent's network; empty for a network that remembers.
    qubits:
        Qubits of the circuit; None without a circuit, or if it drops all correlations.
    steps:
        Steps (K,) of the episodes at which states were measured.
    entanglement:
        By measure: (P, E, K), NaN after an episode's end; empty where there is nothing to measure.
    """

    name: str
    seeds: tuple[int, ...]
    outputs: str
    shapes: Mapping[str, tuple[int, ...]]
    information: Mapping[str, tuple[fisher.Information, ...]]
    powers: Mapping[str, Array]
    qubits: int | None
    steps: NDArray[np.int64]
    entanglement: Mapping[str, Mapping[str, Array]]

    @property
    def parameters(self) -> int:
        """Numbers of an agent that learn."""
        return sum(map(math.prod, self.shapes.values()))

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values; of entanglement mean and percentiles over agents, episodes and steps."""
        found: dict[str, Any] = {
            "entry": self.name,
            "seeds": list(self.seeds),
            "parameters": self.parameters,
            "fisher_information_of": self.outputs,
        }
        for which in PARAMETERS:
            row: dict[str, Any] = {}
            if self.information:
                infos = self.information[which]
                row["effective_dimension"] = [self.effective_dimension(each) for each in infos]
                row["rank"] = [each.rank for each in infos]
                row["eigenvalues"] = [each.eigenvalues[: each.rank].tolist() for each in infos]
                row["gauge_directions"] = self.gauge(which)
                row["without_effect"] = self.without_effect(which)
                row["mean_frequency"] = [fourier.mean_frequency(each) for each in self.powers[which]]
                row["power"] = self.powers[which].mean(axis=0).tolist()
            if self.entanglement:
                for measure, values in self.entanglement[which].items():
                    row[measure] = evaluation.distribution(values[~np.isnan(values)])
            found[which] = row
        return found

    def effective_dimension(self, of: fisher.Information) -> float:
        """Return the local effective dimension around an agent's parameters."""
        return fisher.effective_dimension(of.eigenvalues, parameters=self.parameters)

    def gauge(self, which: str) -> dict[str, float] | None:
        """Return how many gauge directions each of the network's parameters has, mean over agents; None if unknown."""
        known = [each.gauge for each in self.information[which] if not np.isnan(each.gauge).any()]
        sizes = {name: math.prod(shape) for name, shape in self.shapes.items()}
        return fisher.shares(np.mean(known, axis=0), sizes) if known else None

    def without_effect(self, which: str) -> list[str]:
        """Return the names of the single numbers that have no effect, of any agent."""
        known = [each.gauge for each in self.information[which]]
        return fisher.without_effect(np.min(known, axis=0), self.shapes)


def along_episodes(
    store: EntryStore,
    best: int = 10,
    episodes: int = EPISODES,
    seed: int = 0,
    device: str = "cpu",
    on: Task | None = None,
    report: Report = lambda what, done, total: None,
) -> Diagnosis:
    """Play with the best agents of an entry, and look at their networks where they were.

    Parameters
    ----------
    best, seed, device, on:
        As for `qrlsuite.training.evaluation.trained`; the episodes are its first ones.
    report:
        Called with the name of the computation and its progress.
    """
    entry = evaluation.trained_entry(store, on)
    if getattr(entry.model_options, "backend", None) is not None:
        entry = on_backend(entry, "native", {})
    seeds, _, _ = evaluation.best_runs(store, best)
    agents = evaluation.trained_agents(entry, store, seeds, device)
    report("episodes", 0, 1)
    inputs, lengths = _play(entry, agents, len(seeds), episodes, seed)
    trainers = {"trained": agents, "initial": Trainer(entry, seeds, device)}
    networks = {which: trainer.models.built[0] for which, trainer in trainers.items()}
    of_outputs = {
        which: getattr(trainer.algorithm, "information", None) for which, trainer in trainers.items()
    }
    learned = {n: p for n, p in networks["trained"].named_parameters() if p.requires_grad}
    shapes = {name: tuple(p.shape[1:]) for name, p in learned.items()}
    information: dict[str, tuple[fisher.Information, ...]] = {}
    powers: dict[str, Array] = {}
    steps = np.unique(np.linspace(0, len(inputs) - 1, STEPS).round().astype(np.int64))
    entanglement: dict[str, dict[str, Array]] = {}
    qubits = None
    for which, network in networks.items():
        if not remembers(network):
            exact = copy.deepcopy(network).double()
            with torch.no_grad():
                outputs = exact.forward(inputs[0][:, :1].double()).shape[-1]
            enough = min(-(-2 * sum(map(math.prod, shapes.values())) // outputs) + 8, MOST_STATES)
            x = _inputs(inputs, lengths, enough)
            information[which] = _information(exact, x, of_outputs[which], which, report)
            powers[which] = _powers(exact, inputs, lengths)
            if isinstance(network, CircuitModel) and not network.description.mean_field:
                qubits = network.description.qubits
                entanglement[which] = _entanglement(network, inputs, lengths, steps)
    return Diagnosis(
        evaluation.policy_name(store, on),
        tuple(seeds),
        "values" if of_outputs["trained"] is None else "policy",
        shapes,
        information,
        powers,
        qubits,
        steps,
        entanglement,
    )


def _play(
    entry: Entry, agents: Trainer, count: int, episodes: int, seed: int
) -> tuple[list[Tensor], NDArray[np.int64]]:
    """Return the policy network's inputs at every step, each (P, E, in), and the episodes' lengths (P, E)."""
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


def _inputs(inputs: list[Tensor], lengths: NDArray[np.int64], count: int) -> Tensor:
    """Return inputs (P, N, in) of steps before the episodes' ends, evenly spaced over all, at most `count`."""
    together = torch.stack(inputs, dim=2)  # (P, E, K, in)
    flat = together.flatten(1, 2)
    valid = [np.flatnonzero(np.arange(together.shape[2]) < each[:, None]) for each in lengths]
    count = min(count, *map(len, valid))
    chosen = [each[np.linspace(0, len(each) - 1, count).round().astype(np.int64)] for each in valid]
    return torch.stack([flat[p, each] for p, each in enumerate(chosen)]).double()


def _information(
    network: nn.Module,
    x: Tensor,
    of_outputs: Callable[[Array], Array] | None,
    which: str,
    report: Report,
) -> tuple[fisher.Information, ...]:
    """Return the Fisher information of each agent of a network in float64, at inputs (P, N, in)."""
    learned = [p for p in network.parameters() if p.requires_grad]
    rows, outputs = [], []
    for n in range(x.shape[1]):
        values = network.forward(x[:, n : n + 1])[:, 0]
        outputs.append(values.detach().cpu().numpy())
        row = []
        for output in range(values.shape[1]):
            gradients = torch.autograd.grad(
                values[:, output].sum(), learned, retain_graph=True, materialize_grads=True
            )
            row.append(torch.cat([g.flatten(1) for g in gradients], dim=1))
        rows.append(torch.stack(row, dim=1).cpu().numpy())
        report(f"Fisher information, {which}", n + 1, x.shape[1])
    jacobians, logits = np.stack(rows, axis=1), np.stack(outputs, axis=1)  # (P, N, O, params), (P, N, O)
    metric = [None] * len(jacobians) if of_outputs is None else of_outputs(logits)
    return tuple(fisher.information(J, A) for J, A in zip(jacobians, metric))


def _powers(network: nn.Module, inputs: list[Tensor], lengths: NDArray[np.int64]) -> Array:
    """Return the power (P, F) of each agent's outputs along its inputs, over the range that was visited."""
    x = _inputs(inputs, lengths, MOST_STATES)
    low, high = x.amin(dim=1), x.amax(dim=1)  # (P, in)
    base = x[:, np.linspace(0, x.shape[1] - 1, min(LINES, x.shape[1])).astype(int)]
    found = []
    for feature in range(min(x.shape[2], MOST_INPUTS)):
        lines = base[:, :, None].repeat(1, 1, SAMPLES, 1)
        parts = torch.arange(SAMPLES, dtype=torch.float64, device=x.device) / SAMPLES
        lines[..., feature] = low[:, None, None, feature] + (high - low)[:, None, None, feature] * parts
        with torch.no_grad():
            values = network.forward(lines.flatten(1, 2)).reshape(*lines.shape[:3], -1)
        _, powers = fourier.power(np.moveaxis(values.cpu().numpy(), 2, -1), window=True)
        found.append(powers.mean(axis=(1, 2)))
    return np.asarray(np.mean(found, axis=0))


def _entanglement(
    network: CircuitModel, inputs: list[Tensor], lengths: NDArray[np.int64], steps: NDArray[np.int64]
) -> dict[str, Array]:
    """Return the measures of a circuit's states, each (P, E, K)."""
    rows = []
    for step in steps.tolist():
        with torch.no_grad():
            states = network.circuit_states(inputs[step]).cpu().numpy()
        rows.append([meyer_wallach(states), half_cut_entropy(states)])
    return {
        measure: np.where(steps < lengths[..., None], np.stack(each, axis=-1), np.nan)
        for measure, each in zip(MEASURES, zip(*rows))
    }
