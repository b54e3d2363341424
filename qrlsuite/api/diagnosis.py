"""Diagnostics by name: of a circuit over its size, and of trained agents beside themselves before training."""

from __future__ import annotations

import contextlib
import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console, ConsoleOptions, RenderResult

from qrlsuite.api.evaluation import find_players
from qrlsuite.circuit import Circuit, ansatz
from qrlsuite.circuit.api import require_computable
from qrlsuite.diagnostics import circuits, fisher, fourier, gradients
from qrlsuite.diagnostics.fisher import Information
from qrlsuite.diagnostics.gradients import Estimate
from qrlsuite.engine.display import Bar
from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import diagnosis as picture
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.training.diagnosis import EPISODES, MEASURES, PARAMETERS, Diagnosis, along_episodes

SAMPLES, GAMMA = 10_000, 1.0
"""n and gamma of effective dimensions."""
NAMED = 4
"""Numbers without effect that a table names; --json has all."""
ABBAS = (
    f"effective dimension: Abbas et al. 2021, n = {SAMPLES}, gamma = {GAMMA:g}; mean trace of the Fisher information "
    "normalized to the number of parameters"
)


@dataclass(frozen=True)
class Scanned:
    """A circuit of one size.

    Attributes
    ----------
    qubits, layers, parameters:
        Its size, and how many numbers are trained.
    variances:
        Of the gradient, by readout: `local` and `global`.
    shapes:
        Of each parameter of the circuit.
    information:
        Fisher information at each draw of the parameters; None where it is not computed, as all below.
    frequencies, power:
        The spectrum along its inputs, see `qrlsuite.diagnostics.circuits.spectrum`.
    expressibility, entanglement:
        NaN where nearly all fidelities fall into one bin.
    algebra:
        Dimension of the dynamical Lie algebra.
    """

    qubits: int
    layers: int
    parameters: int
    variances: Mapping[str, Estimate]
    shapes: Mapping[str, tuple[int, ...]]
    information: Sequence[Information] | None
    frequencies: np.ndarray[Any, np.dtype[np.float64]] | None
    power: np.ndarray[Any, np.dtype[np.float64]] | None
    expressibility: float | None
    entanglement: float | None
    algebra: int | None

    @property
    def rank(self) -> int | None:
        """Directions of the parameters that have an effect, at the draw that has most."""
        return None if self.information is None else max(each.rank for each in self.information)

    @property
    def without_effect(self) -> list[str] | None:
        """Names of the single parameters that have no effect at any draw."""
        if self.information is None:
            return None
        return fisher.without_effect(np.min([each.gauge for each in self.information], axis=0), self.shapes)

    @property
    def effective_dimension(self) -> float | None:
        """Over the draws."""
        if self.information is None:
            return None
        values = np.stack([each.eigenvalues for each in self.information])
        return fisher.effective_dimension(values, SAMPLES, GAMMA)

    @property
    def mean_frequency(self) -> float | None:
        """Weighted by power, without the constant: 1 is a wave in a turn of an input."""
        if self.power is None or self.frequencies is None:
            return None
        return fourier.mean_frequency(self.power[1:], float(self.frequencies[1]))

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values; NaN is null."""
        whole = self.power is not None and self.frequencies is not None
        values: dict[str, Any] = {
            "qubits": self.qubits,
            "layers": self.layers,
            "parameters": self.parameters,
            "gradient_variance": {name: each._asdict() for name, each in self.variances.items()},
            "rank": self.rank,
            "gauge_directions": None if self.rank is None else self.parameters - self.rank,
            "without_effect": self.without_effect,
            "effective_dimension": self.effective_dimension,
            "eigenvalues": None
            if self.information is None
            else [e.eigenvalues.tolist() for e in self.information],
            "mean_frequency": self.mean_frequency,
            "frequencies": self.frequencies.tolist() if whole else None,  # type: ignore[union-attr]
            "power": self.power.tolist() if whole else None,  # type: ignore[union-attr]
            "expressibility": self.expressibility,
            "meyer-wallach": self.entanglement,
            "lie_algebra_dimension": self.algebra,
        }
        return {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in values.items()}


@dataclass(frozen=True, eq=False, repr=False)
class CircuitDiagnosis(Shown):
    """A circuit over its size.

    Attributes
    ----------
    name:
        Of the ansatz, with its options.
    depth:
        The law of depth: how many layers there are at n qubits.
    draws, seed:
        Of the parameters and inputs for the gradients' variance.
    sizes:
        One by one.
    factors:
        By readout and law of depth, the factor of the gradient's variance with each further qubit.
    """

    name: str
    depth: str
    draws: int
    seed: int
    sizes: tuple[Scanned, ...]
    factors: Mapping[str, Mapping[str, Estimate]]

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "ansatz": self.name,
            "layers": self.depth,
            "draws": self.draws,
            "seed": self.seed,
            "effective_dimension": {"n": SAMPLES, "gamma": GAMMA, "normalization": "mean trace = parameters"},
            "factor_per_qubit": {
                readout: {law: each._asdict() for law, each in by_law.items()}
                for readout, by_law in self.factors.items()
            },
            "sizes": [each.as_dict() for each in self.sizes],
        }

    def figure(self) -> Figure:
        """Draw variance, eigenvalues of the Fisher information, spectrum, and measures of states."""
        return picture.draw_circuit(self)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show a row for each size, first of gradients, then of the rest."""
        size = [(str(each.qubits), str(each.layers), str(each.parameters)) for each in self.sizes]
        heads = ("qubits", "layers", "parameters")
        rows = [
            (*where, *_variance(each.variances.get("local")), *_variance(each.variances.get("global")))
            for where, each in zip(size, self.sizes)
        ]
        laws = [
            f"{readout}, layers = {law}: x {e.value:.2f} ({e.low:.2f} to {e.high:.2f}) with each further qubit"
            for readout, by_law in self.factors.items()
            for law, e in by_law.items()
        ]
        yield Sheet.of(
            f"{self.name}: variance of the gradient",
            (*heads, "local", "5% to 95%", "global", "5% to 95%"),
            rows,
            (
                f"of a derivative by a parameter, mean over the parameters that have an effect; {self.draws} draws; "
                "local: Z of qubit 0, global: product of all Z; interval: bootstrap over draws",
                "\n".join(laws),
            )[: 1 + bool(laws)],
        )
        yield "\n"
        able = []
        for where, each in zip(size, self.sizes):
            rank = each.rank
            able.append(
                (
                    *where[:2],
                    _text(rank, "d"),
                    _text(None if rank is None else each.parameters - rank, "d"),
                    _text(each.effective_dimension, ".1f"),
                    _text(each.mean_frequency, ".2f"),
                    _text(each.expressibility, ".3f"),
                    _text(each.entanglement, ".3f"),
                    _text(each.algebra, "d"),
                )
            )
        more = (
            "rank",
            "gauge",
            "effective dimension",
            "mean frequency",
            "express- ibility",
            "entangled",
            "Lie",
        )
        yield Sheet.of(
            f"{self.name}: what it can do",
            (*heads[:2], *more),
            able,
            (
                "rank, gauge: directions of the parameters with and without effect, by the Fisher information J^T J of "
                f"Gaussians of unit variance\n{ABBAS}\nmean frequency: waves in a turn of an input",
                "expressibility: divergence from Haar's fidelities, 0 is most; none beyond 8 qubits",
                "entangled: Meyer-Wallach; Lie: dimension of the dynamical Lie algebra\n-: not computed",
            ),
        )


@dataclass(frozen=True, eq=False, repr=False)
class AgentsDiagnosis(Shown):
    """Trained agents of entries, beside themselves before training.

    Attributes
    ----------
    task:
        The task that they play.
    entries:
        One by one.
    """

    task: str
    entries: tuple[Diagnosis, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "task": self.task,
            "effective_dimension": {"n": SAMPLES, "gamma": GAMMA, "normalization": "trace = parameters"},
            "entries": [each.as_dict() for each in self.entries],
        }

    def figure(self) -> Figure:
        """Draw eigenvalues of the Fisher information, spectra, and entanglement along the episodes."""
        return picture.draw_agents(self.entries, title=self.task)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show a row for each entry, trained and initial: means over agents."""
        algorithms = {each.name.partition(" ")[0] for each in self.entries}
        alike = f"{algorithms.pop()} " if len(algorithms) == 1 else ""
        heads = ("entry", "", "rank", "gauge", "effective dimension", "waves", *MEASURES)
        rows = [
            (each.name.removeprefix(alike) * (which == PARAMETERS[0]), which, *self._cells(each, which))
            for each in self.entries
            for which in PARAMETERS
        ]
        gauges = [self._gauge(each) for each in self.entries]
        kinds = {
            "policy": "of the policy, mean over states and actions",
            "values": "J^T J of Gaussians of unit variance around the outputs",
        }
        of = "; ".join(kinds[kind] for kind in dict.fromkeys(each.outputs for each in self.entries))
        yield Sheet.of(
            f"{' '.join([self.task, *alike.split()])}: trained agents, and the same before training",
            heads,
            rows,
            (
                f"means over agents; Fisher information {of}\nrank, gauge: directions of the parameters with and "
                f"without effect\n{ABBAS}",
                "waves: mean frequency, in the visited range of an input; meyer-wallach: 0 to 1; half-cut entropy: bits"
                "\n-: no circuit, a network that remembers, or too many parameters to tell",
                "\n".join(line for line in gauges if line),
            )[: 2 + any(gauges)],
            words=("entry", ""),
        )

    def _cells(self, each: Diagnosis, which: str) -> list[str]:
        infos = each.information.get(which, ())
        ranks = [float(i.rank) for i in infos]
        known = bool(infos) and each.gauge(which) is not None
        entangled = each.entanglement.get(which, {})
        frequencies = [fourier.mean_frequency(p) for p in each.powers.get(which, ())]
        return [
            _text(np.mean(ranks) if known else None, ".1f"),
            _text(each.parameters - np.mean(ranks) if known else None, ".1f"),
            _text(np.mean([each.effective_dimension(i) for i in infos]) if infos else None, ".1f"),
            _text(np.mean(frequencies) if frequencies else None, ".2f"),
            *(_text(np.nanmean(entangled[m]) if entangled else None, ".3f") for m in MEASURES),
        ]

    def _gauge(self, each: Diagnosis) -> str:
        """Say in which of the network's parameters the gauge directions are, trained."""
        found = each.gauge(PARAMETERS[0]) if each.information else None
        if not found or sum(found.values()) < 0.05:
            return ""
        parts = ", ".join(f"{name} {share:.1f}" for name, share in found.items() if share >= 0.05)
        alone = ", ".join(each.without_effect(PARAMETERS[0])[:NAMED])
        return (
            f"gauge directions of {each.name}, by parameter: {parts}"
            + f"; without effect: {alone}" * bool(alone)
        )


def diagnose_ansatz(
    name: str | Callable[[int, int], Circuit],
    qubits: str | int | Sequence[int] = "2:8",
    layers: str | int | Sequence[int] = 4,
    *,
    draws: int = 100,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> CircuitDiagnosis:
    """Diagnose a circuit over its size: gradients, Fisher information, frequencies, states, Lie algebra.

    Parameters are drawn from their initial distribution, inputs from a standard normal. Gradients are computed at every
    size; the rest up to 10 qubits (the Lie algebra up to 4), which takes seconds.

    Parameters
    ----------
    name:
        Name of an ansatz (`qrlsuite list ansatzes`), or a function of your own, (qubits, layers) to a `Circuit`.
    qubits:
        Numbers of qubits: one, several, or text: `4:12` is 4 to 12, both included, `2:16:2` every second, `4,6,10`.
    layers:
        Numbers of layers likewise; `n` is as many as qubits, `2n` twice as many: the law of depth.
    draws:
        Random parameters and inputs for the variance of gradients, 2 or more.
    seed:
        Seed of all draws.
    options:
        Options of the ansatz, such as `{"gate": "xyz"}`.
    progress:
        Whether to show a bar.

    Returns
    -------
    CircuitDiagnosis
        Printed, it is two tables; `figure()` draws it, `as_dict()` has all numbers.

    Raises
    ------
    UnknownNameError
        If no ansatz has that name.
    OptionError
        If a size, an option or a number of draws cannot be used, or a circuit has no parameters.
    """
    if isinstance(draws, bool) or not isinstance(draws, int) or draws < 2:
        raise OptionError(f"draws = {draws!r}: give a whole number, 2 or more")
    options = options or {}
    for wrong in options.keys() & {"name", "qubits", "layers"}:
        raise OptionError(
            f"{wrong}={options[wrong]}: no option of an ansatz; sizes are `qubits` and `layers`"
        )
    laws = _laws(layers)
    told = name if isinstance(name, str) else getattr(name, "__name__", "circuit")
    told = " ".join([told, *(f"{option}={value}" for option, value in options.items())])
    made = [
        (
            n,
            law,
            depth(n),
            ansatz(name, n, depth(n), **options) if isinstance(name, str) else name(n, depth(n)),
        )
        for law, depth in laws.items()
        for n in numbers("qubits", qubits)
    ]
    for n, _, _, circuit in made:
        if circuit.parameter_count == 0:
            raise OptionError(
                f"{told} with {n} qubits has no parameters: diagnostics say how results change with them"
            )
        for readout in circuits.readouts(circuit).values():
            require_computable(readout, "native")
    bar = Bar(Console(stderr=True, quiet=not progress, highlight=False))
    weights = [draws * 2.0**n * layer * n for n, _, layer, _ in made]
    sizes, found = [], []
    done = 0.0
    try:
        for (n, _, layer, circuit), weight in zip(made, weights):
            what = f"{n} qubits, {layer} layers"
            bar.start(sum(weights), what)
            bar.update(done, what)
            report = functools.partial(_moved, bar, what, done, weight / draws)
            one = circuits.gradients(circuit, draws, seed, report)
            found.append(one)
            sizes.append(_scanned(circuit, layer, one, seed))
            done += weight
    finally:
        bar.stop()
    factors: dict[str, dict[str, Estimate]] = {"local": {}, "global": {}}
    for which, by_law in factors.items():
        for law in laws:
            rows = [(n, g[which]) for (n, of, _, _), g in zip(made, found) if of == law and which in g]
            factor = (
                gradients.factor_per_qubit([n for n, _ in rows], [g for _, g in rows], seed) if rows else None
            )
            if factor is not None:
                by_law[law] = factor
    return CircuitDiagnosis(told, ", ".join(laws), draws, seed, tuple(sizes), factors)


def _moved(bar: Bar, what: str, done: float, each: float, draws: int) -> None:
    bar.update(done + each * draws, what)


def _scanned(circuit: Circuit, layers: int, found: Mapping[str, Any], seed: int) -> Scanned:
    """Return the facts on one size; slow computations are left out."""
    small = circuit.qubits <= circuits.LARGEST
    state = small and not circuit.mean_field
    frequencies = power = None
    if small:
        with contextlib.suppress(OptionError):  # frequencies that cannot be sampled
            frequencies, power = circuits.spectrum(circuit, circuits.draw(circuit, circuits.LINES, seed))
    expressive, entangled = circuits.expressibility(circuit, seed=seed) if state else (None, None)
    algebra = state and circuit.qubits <= circuits.LARGEST_ALGEBRA
    return Scanned(
        circuit.qubits,
        layers,
        circuit.parameter_count,
        {name: gradients.variance(each, seed) for name, each in found.items()},
        {name: parameter.shape for name, parameter in circuit.parameters.items()},
        circuits.fisher(circuit, seed=seed) if small else None,
        frequencies,
        power,
        expressive,
        entangled,
        circuits.algebra_dimension(circuit) if algebra else None,
    )


def diagnose(
    *entries: str,
    task: str | None = None,
    best: int = 10,
    episodes: int = EPISODES,
    seed: int = 0,
    device: str = "cpu",
    published: bool = False,
    runs: str | PathLike[str] = "runs",
    progress: bool = True,
) -> AgentsDiagnosis:
    """Diagnose the best trained agents of entries, beside the same agents before training.

    They play fresh episodes. At the observations that they visit, their networks are examined: Fisher information with
    directions without effect, effective dimension, spectrum along the inputs, and the entanglement of the states of
    circuits.

    Parameters
    ----------
    entries:
        Names, labels, beginnings of them, or folders.
    task:
        The task that is played, as for `evaluate`; None plays the entries' own.
    best:
        How many agents: the runs with the best last validation score.
    episodes:
        Episodes of each agent.
    seed:
        Of the episodes.
    published, runs:
        As for `load`.
    progress:
        Whether to show a bar.

    Raises
    ------
    UnknownNameError
        If no entry, or several, have a name.
    OptionError
        If none is named, they belong to several tasks, or a number cannot be used.
    StoreError
        If an entry has no trained agent.
    EnvironmentFailure
        If the environment fails.
    """
    if not entries:
        raise OptionError(
            "name an entry, or `ansatz` and the name of one, as in `qrlsuite diagnose ansatz iqp`"
        )
    on, stores = find_players(Selection.create(runs, task, published), entries)
    tasks = sorted({store.record().task_name for store in stores}) if on is None else [on.name]
    if len(tasks) > 1:
        raise OptionError(
            f"the entries belong to different tasks ({', '.join(tasks)}): diagnose them one by one"
        )
    bar = Bar(Console(stderr=True, quiet=not progress, highlight=False))

    def report(what: str, done: int, total: int) -> None:
        bar.start(1.0, what)
        bar.update(done / total, what)

    try:
        made = tuple(along_episodes(store, best, episodes, seed, device, on, report) for store in stores)
    finally:
        bar.stop()
    return AgentsDiagnosis(tasks[0], made)


def numbers(name: str, given: str | int | Sequence[int]) -> list[int]:
    """Read numbers: 4, [4, 6], or text such as `4:12` (both included), `2:16:2` or `4,6,10`."""
    text = (
        given if isinstance(given, str) else ",".join(map(str, [given] if isinstance(given, int) else given))
    )
    found: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,3})(?::(\d{1,3})(?::(\d{1,3}))?)?\s*", part)
        if match is None:
            found = []
            break
        low, high, step = int(match[1]), int(match[2] or match[1]), int(match[3] or 1)
        found += range(low, high + 1, step) if step else []
    if not found or len(set(found)) < len(found) or min(found) < 1:
        raise OptionError(
            f"{name} {text!r}: write one number, several as in 4,6,10, or a range as in 4:12, which includes both"
        )
    return sorted(found)


def _laws(layers: str | int | Sequence[int]) -> dict[str, Callable[[int], int]]:
    """Return by its text how many layers there are at n qubits."""
    law = re.fullmatch(r"\s*(\d{0,3})n\s*", layers) if isinstance(layers, str) else None
    if law and int(law[1] or 1):
        factor = int(law[1] or 1)
        return {f"{law[1]}n": lambda n: factor * n}
    return {str(each): functools.partial(_constant, each) for each in numbers("layers", layers)}


def _constant(layers: int, qubits: int) -> int:
    return layers


def _variance(of: Estimate | None) -> tuple[str, str]:
    return ("-", "-") if of is None else (f"{of.value:.1e}", f"{of.low:.1e} {of.high:.1e}")


def _text(value: float | np.floating[Any] | None, form: str) -> str:
    return "-" if value is None or math.isnan(value) else format(value, form)
