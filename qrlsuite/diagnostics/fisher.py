"""The Fisher information of a policy or of values, directions without effect, and the effective dimension.

With J (O, P) the derivatives of a network's O outputs by its P parameters at a state, and A (O, O) the Fisher
information of the distribution that the outputs parametrize, the Fisher information of the parameters is

    F = mean over states of J^T A J.

For a softmax policy A = diag(p) - p p^T, so that F is the mean over states, and over actions as the policy draws them,
of the outer product of the score, the gradient of log pi(a|s). For a normal policy A has the inverse variances on its
diagonal. For Q-values, and expectation values of a circuit, A is the identity: F = J^T J, as for Gaussians of unit
variance around them.

Directions in which F is 0 change nothing at any state, to first order: *gauge directions*.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
TOLERANCE = 1e-20
"""Eigenvalues below this part of the largest are rounding: singular values of Jacobians in float64 have 10 digits."""

ROUNDING = 1e-14
"""Eigenvalues of a metric below this part of the largest are rounding."""


class Information(NamedTuple):
    """The Fisher information of P parameters by its eigenvalues.

    Attributes
    ----------
    eigenvalues:
        (P,), the largest first; rounding errors are set to 0.
    gauge:
        (P,): the part of each parameter that lies in gauge directions, from 0 to 1. They sum to the number of gauge
        directions. NaN where too few states were seen to tell.
    """

    eigenvalues: Array
    gauge: Array

    @property
    def rank(self) -> int:
        """Number of directions that have an effect."""
        return int(np.count_nonzero(self.eigenvalues))


def information(jacobians: Array, metric: Array | None = None) -> Information:
    """Return the Fisher information of parameters from Jacobians at N states.

    Parameters
    ----------
    jacobians:
        (N, O, P).
    metric:
        (N, O, O), the Fisher information A of the outputs at each state; None stands for the identity.

    Returns
    -------
    Information
        Gauge directions are known where N O is at least 2 P.
    """
    states, outputs, size = jacobians.shape
    rows = jacobians if metric is None else _root(metric) @ jacobians
    _, values, directions = np.linalg.svd(rows.reshape(-1, size) / math.sqrt(states), full_matrices=False)
    eigenvalues = np.zeros(size)
    eigenvalues[: len(values)] = np.square(values)
    eigenvalues[eigenvalues <= TOLERANCE * eigenvalues[0]] = 0.0
    gauge = np.full(size, np.nan)
    if states * outputs >= 2 * size:
        gauge = 1.0 - np.square(directions[: np.count_nonzero(eigenvalues)]).sum(axis=0)
    return Information(eigenvalues, gauge)


def effective_dimension(
    eigenvalues: Array, samples: int = 10_000, gamma: float = 1.0, parameters: int | None = None
) -> float:
    """Return the effective dimension after Abbas et al. 2021 (arXiv:2011.00027).

    With k = gamma n / (2 pi log n) it is 2 log(mean over draws of sqrt(det(1 + k F'))) / log k. F' is the Fisher
    information, normalized so that the mean of its trace over the draws is the number of parameters. For the parameters
    of one agent it is the local effective dimension (arXiv:2112.04807), around a single point.

    Parameters
    ----------
    eigenvalues:
        (T, K), of the Fisher information at T draws of the parameters; further eigenvalues are 0.
    samples, gamma:
        n, the number of data, and gamma in (0, 1]. Both change the result: it grows with n towards the largest rank.
    parameters:
        Their number P; by default K.

    Returns
    -------
    float
        0 where no parameter has an effect.
    """
    k = gamma * samples / (2 * math.pi * math.log(samples)) if samples > 1 else 0.0
    if not (k > 1.0 and 0.0 < gamma <= 1.0):
        raise ValueError(f"n = {samples} and gamma = {gamma:g}: gamma n / (2 pi log n) must be above 1")
    values = np.atleast_2d(np.asarray(eigenvalues, np.float64))
    trace = values.sum(axis=1).mean()
    if trace == 0.0:
        return 0.0
    halves = 0.5 * np.log1p(k * values * ((parameters or values.shape[1]) / trace)).sum(axis=1)
    largest = halves.max()
    return float(2.0 * (largest + np.log(np.exp(halves - largest).mean())) / math.log(k))


def shares(gauge: Array, sizes: Mapping[str, int]) -> dict[str, float]:
    """Return how much of the gauge directions lies in each named part of the parameters, in their order.

    Parameters
    ----------
    gauge:
        (P,), see `Information`.
    sizes:
        Number of scalars of each part; they sum to P.
    """
    ends = np.cumsum(list(sizes.values()))
    return {name: float(part.sum()) for name, part in zip(sizes, np.split(gauge, ends[:-1]))}


def without_effect(gauge: Array, shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Return the names of single numbers that have no effect, such as `weights[3, 0, 2]`.

    Parameters
    ----------
    gauge:
        (P,), see `Information`.
    shapes:
        Shape of each named part of the parameters, in C order; they have P numbers.
    """
    names = [f"{name}{list(index)}" for name, shape in shapes.items() for index in np.ndindex(shape)]
    return [name for name, part in zip(names, gauge, strict=True) if part > 1.0 - 1e-6]


def _root(metric: Array) -> Array:
    """Return R with R^T R = A, for positive semidefinite A (..., O, O)."""
    values, vectors = np.linalg.eigh(metric)
    values = np.where(values > ROUNDING * values[..., -1:], values, 0.0)
    return np.asarray(np.sqrt(values)[..., None] * np.swapaxes(vectors, -1, -2))
