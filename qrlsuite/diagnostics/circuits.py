"""Diagnostics of a circuit at random parameters from its initial distribution, and standard normal inputs."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.api import create_backend
from qrlsuite.circuit.description import Circuit
from qrlsuite.circuit.jacobian import jacobians
from qrlsuite.diagnostics import algebra, fourier, states
from qrlsuite.diagnostics.fisher import Information, information
from qrlsuite.errors import OptionError

Array = NDArray[np.float64]
Report = Callable[[int], Any]

FISHER_DRAWS = 10
PAIRS = 5000
"""Of states, whose fidelities are counted, as in the paper of expressibility."""
FEW_PAIRS = 200
"""Where they tell entanglement alone."""
LARGEST = 10
"""Qubits up to which Fisher information, spectrum and states are quick: seconds."""
LARGEST_ALGEBRA = 4
LINES, TURNS, MOST_INPUTS, MOST_SAMPLES = 10, 8, 4, 4096
"""Of a spectrum: lines through the inputs' space, turns of an angle along each, inputs that are varied, samples."""


class Points(NamedTuple):
    """N draws: inputs (N, circuit.inputs) and every parameter (N, *shape)."""

    inputs: Array
    parameters: dict[str, Array]


def draw(circuit: Circuit, count: int, seed: int = 0) -> Points:
    """Draw standard normal inputs, and parameters from their initial distribution."""
    if circuit.parameter_count == 0:
        raise OptionError("the circuit has no parameters: diagnostics say how results change with them")
    source = np.random.default_rng(seed)
    inputs = source.standard_normal((count, circuit.inputs))
    return Points(
        inputs,
        {
            name: p.low + (p.high - p.low) * source.random((count, *p.shape))
            for name, p in circuit.parameters.items()
        },
    )


def readouts(circuit: Circuit) -> dict[str, Circuit]:
    """Return the circuit measured once as `local`, Z of the first qubit, and once as `global`, the product of all Z.

    A mean-field approximation, and a single qubit, have no product.
    """
    of: dict[str, list[Any]] = {"local": [0], "global": [tuple(range(_named(circuit)))]}
    if circuit.mean_field or _named(circuit) == 1:
        del of["global"]
    return {name: _measuring(circuit, observables) for name, observables in of.items()}


def _named(circuit: Circuit) -> int:
    """Return the number of qubits, without the ones that stand for earlier measurements and resets."""
    return circuit.qubits - circuit.deferred


def _measuring(circuit: Circuit, observables: list[Any]) -> Circuit:
    other = copy.deepcopy(circuit)
    other.measure(observables)
    return other


def gradients(
    circuit: Circuit, draws: int = 100, seed: int = 0, report: Report = lambda done: None
) -> dict[str, Array]:
    """Return the derivatives (draws, P) of each readout by all parameters."""
    points = draw(circuit, draws, seed)
    names = list(readouts(circuit))
    together = _measuring(circuit, [0, tuple(range(_named(circuit)))][: len(names)])
    found = jacobians(together, *points, report)
    return {name: found[:, place] for place, name in enumerate(names)}


def fisher(circuit: Circuit, draws: int = FISHER_DRAWS, seed: int = 0) -> list[Information]:
    """Return the Fisher information J^T J of the circuit's expectation values at each draw of the parameters.

    Each is the mean over as many inputs as it takes to see all P directions.
    """
    inputs = -(-2 * circuit.parameter_count // len(circuit.observables)) + 8
    points = draw(circuit, draws, seed)
    x = np.random.default_rng(seed + 1).standard_normal((draws * inputs, circuit.inputs))
    repeated = {name: np.repeat(value, inputs, axis=0) for name, value in points.parameters.items()}
    found = jacobians(circuit, x, repeated)
    return [information(each) for each in found.reshape(draws, inputs, *found.shape[1:])]


def highest_frequency(circuit: Circuit, feature: int, parameters: Mapping[str, Array]) -> float:
    """Return a bound on the frequencies along an input: the sum of the factors of all angles that have it.

    Parameters
    ----------
    parameters:
        By name, (N, *shape); the bound holds for each of the N.
    """
    total = np.zeros(1)
    for operation in circuit:
        for angle in operation.angles:
            if feature not in angle.inputs:
                continue
            if angle.input != feature or angle.factor is not None:
                return math.inf
            scale = np.ones(1)
            if angle.scale is not None:
                values = parameters[angle.scale.parameter]
                scale = values.reshape(len(values), -1)[:, angle.scale.index]
            total = total + np.abs(scale * angle.times)
    return float(total.max())


def spectrum(circuit: Circuit, points: Points) -> tuple[Array, Array]:
    """Return the power of the circuit's expectation values by frequency, along its inputs one by one.

    Along each of the first inputs, the input runs through some turns of 2 pi from each point; the others stay. Powers
    are means over points, inputs and observables.

    Returns
    -------
    tuple
        Frequencies (F,), 1 for one wave in a turn, and their power, the constant's (frequency 0) first.
    """
    count, features = len(points.inputs), min(circuit.inputs, MOST_INPUTS)
    bound = max(highest_frequency(circuit, each, points.parameters) for each in range(features))
    whole = all(a.scale is None or a.input is None for o in circuit for a in o.angles) and all(
        float(a.times).is_integer() for o in circuit for a in o.angles
    )
    turns = 2 if whole else TURNS  # two: a controlled gate has halves
    samples = 2 * math.ceil(bound * turns) + 8 if math.isfinite(bound) else MOST_SAMPLES + 1
    if samples > MOST_SAMPLES:
        raise OptionError(f"frequencies of the circuit reach {bound:.0f} in a turn, too high to be sampled")
    along = 2 * math.pi * turns / samples * np.arange(samples)
    x = np.tile(points.inputs[:, None, None], (1, features, samples, 1))
    for each in range(features):
        x[:, each, :, each] += along
    values = expectation_values(circuit, Points(x.reshape(count, -1, circuit.inputs), points.parameters))
    values = np.moveaxis(values.reshape(count, features, samples, -1), 2, -1)
    constant, powers = fourier.power(values, window=not whole)
    together = np.concatenate([[constant.mean()], powers.mean(axis=(0, 1, 2))])
    return np.arange(len(together)) / turns, together


def expectation_values(circuit: Circuit, points: Points) -> Array:
    """Return expectation values (N, B, O) of inputs (N, B, in), each of the N with parameters of its own."""
    import torch

    backend = create_backend("native", circuit)
    with torch.no_grad():
        values = backend(
            torch.from_numpy(points.inputs), {n: torch.from_numpy(v) for n, v in points.parameters.items()}
        )
    return np.asarray(values.numpy())


def final_states(circuit: Circuit, points: Points) -> states.States:
    """Return the circuit's final states (N, 2^n)."""
    import torch

    backend: Any = create_backend("native", _measuring(circuit, [0]))
    with torch.no_grad():
        found = backend.states(
            torch.from_numpy(points.inputs).float()[:, None],
            {n: torch.from_numpy(v).float() for n, v in points.parameters.items()},
        )
    return np.asarray(found[:, 0].numpy())


def expressibility(circuit: Circuit, pairs: int = PAIRS, seed: int = 0) -> tuple[float, float]:
    """Return the expressibility, and the mean entanglement (Meyer-Wallach) of the same states.

    The two states of a pair have the same input. Where the number of qubits is beyond `states.most_expressible`, the
    expressibility is NaN.
    """
    known = circuit.qubits <= states.most_expressible()
    pairs = pairs if known else min(pairs, FEW_PAIRS)
    first, second = draw(circuit, pairs, seed), draw(circuit, pairs, seed + 1)
    both = [final_states(circuit, first), final_states(circuit, Points(first.inputs, second.parameters))]
    entangled = float(np.mean([states.meyer_wallach(each).mean() for each in both]))
    divergence = states.expressibility(states.fidelities(*both), circuit.qubits) if known else math.nan
    return divergence, entangled


def algebra_dimension(circuit: Circuit) -> int:
    """Return the dimension of the circuit's dynamical Lie algebra; up to `LARGEST_ALGEBRA` qubits it takes seconds."""
    return algebra.dimension(algebra.generators(circuit))
