"""Derivatives of a circuit's expectation values by all its parameters, as one array."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Circuit

AT_ONCE = 1 << 21
"""Amplitudes of the states that are differentiated together."""

Array = NDArray[np.float64]


def jacobians(
    circuit: Circuit,
    inputs: Array,
    parameters: Mapping[str, Array],
    report: Callable[[int], Any] = lambda done: None,
) -> Array:
    """Differentiate every expectation value by every parameter at N points, on the native simulator.

    Parameters
    ----------
    circuit:
        With P parameters, counted in the order of their declaration, each in C order, and O observables.
    inputs:
        (N, circuit.inputs), radians.
    parameters:
        Every declared parameter by name, (N, *shape): each point has its own.
    report:
        Called with the number of points done.

    Returns
    -------
    array
        (N, O, P).

    Raises
    ------
    OptionError
        If the circuit is too large, or a number is not finite.
    """
    import torch

    from qrlsuite.circuit.api import create_backend

    backend = create_backend("native", circuit)
    count, outputs = len(inputs), len(circuit.observables)
    size = 0 if circuit.mean_field else max(map(len, circuit.components()))
    step = max(1, AT_ONCE >> size)
    found = np.zeros((count, outputs, circuit.parameter_count))
    for begin in range(0, count, step):
        points = slice(begin, begin + step)
        leaves = {
            name: torch.tensor(parameters[name][points], dtype=torch.float64, requires_grad=True)
            for name in circuit.parameters
        }
        values = backend(torch.tensor(inputs[points, None], dtype=torch.float64), leaves)
        for output in range(outputs if values.requires_grad else 0):
            each = torch.autograd.grad(
                values[..., output].sum(), list(leaves.values()), retain_graph=True, materialize_grads=True
            )
            found[points, output] = torch.cat([g.flatten(1) for g in each], dim=1).numpy()
        report(min(count, begin + step))
    return found
