"""The variance of gradients over random parameters, and how it falls with the number of qubits.

The variance of one derivative of an expectation value over random parameters, after McClean et al. 2018
(arXiv:1803.11173): where it falls exponentially with the number of qubits, training is on a *barren plateau*. It
depends on the readout, local or global, and on how the number of layers grows with the number of qubits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEVELS = (5.0, 95.0)
"""Percentiles of the resamples that are an interval's ends."""
RESAMPLES = 1000
ROUNDING = 1e-12
"""Derivatives that are smaller than this at every draw are taken for 0."""


class Estimate(NamedTuple):
    """A number with its interval, the 5th to 95th percentile over resamples of the draws."""

    value: float
    low: float
    high: float


def variance(gradients: Array, seed: int = 0) -> Estimate:
    """Estimate the variance of a derivative over draws, as the mean over parameters.

    Parameters without any effect, whose derivative is 0 at every draw, are left out: with a readout on one qubit these
    are the ones outside its light cone.

    Parameters
    ----------
    gradients:
        (N, P): at N draws, the derivatives by P parameters.
    seed:
        Of the resamples.

    Returns
    -------
    Estimate
        0 where no parameter has an effect.
    """
    return Estimate(*_summary(_resampled(gradients, seed)))


def factor_per_qubit(qubits: Sequence[int], gradients: Sequence[Array], seed: int = 0) -> Estimate | None:
    """Estimate by which factor the variance changes with each further qubit.

    It is 2 to the slope of a straight line through the base-2 logarithms of the variances, by least squares. A factor
    below 1 at every size indicates a barren plateau; the fit of a straight line is not tested.

    Parameters
    ----------
    qubits:
        Numbers of qubits, K of them, distinct.
    gradients:
        As for `variance`, of each.

    Returns
    -------
    Estimate or None
        None for fewer than two sizes, or where some variance is 0.
    """
    if len(gradients) < 2:
        return None
    values = np.stack([_resampled(each, seed + k) for k, each in enumerate(gradients)])
    if not np.all(values[:, 0] > 0):
        return None
    values = values[:, np.all(values > 0, axis=0)]  # of few draws, a resample may be one draw again and again
    away = np.asarray(qubits, np.float64) - np.mean(qubits)
    slopes = away @ np.log2(values) / (away @ away)
    return Estimate(*_summary(2.0**slopes))


def _resampled(gradients: Array, seed: int) -> Array:
    """Return the variance (1 + RESAMPLES,) of the draws, and of resamples of them."""
    g = np.asarray(gradients, np.float64)
    g = g[:, (np.abs(g) > ROUNDING).any(axis=0)]
    count = len(g)
    if g.shape[1] == 0 or count < 2:
        return np.zeros(1 + RESAMPLES)
    source = np.random.default_rng(seed)
    drawn = source.multinomial(count, np.full(count, 1 / count), RESAMPLES)
    weights = np.concatenate([np.ones((1, count)), drawn]) / count
    g = g - g.mean(axis=0)  # a shift changes no variance, and keeps digits
    spread = weights @ np.square(g).mean(axis=1) - np.square(weights @ g).mean(axis=1)
    return np.asarray(spread * count / (count - 1))


def _summary(values: Array) -> tuple[float, float, float]:
    low, high = np.percentile(values[1:], LEVELS)
    return float(values[0]), float(low), float(high)
