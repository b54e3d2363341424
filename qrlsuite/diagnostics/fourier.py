"""The frequencies of a function along one of its inputs.

A circuit whose input x is the angle of a rotation is a Fourier series in x. Its frequencies are differences of
eigenvalues of the encoding gates (after Schuld, Sweke & Meyer 2021, Phys. Rev. A 103, 032430): a single RX has
frequency 1, and every repetition adds one. Scaled by a trained number, frequencies are no whole numbers: then the
function has no period, and a window of several turns is looked at.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def power(values: Array, window: bool) -> tuple[Array, Array]:
    """Return the power at the frequencies 0, 1, 2, ... per interval, of functions sampled evenly over an interval.

    Parameters
    ----------
    values:
        (..., K): the function at the beginning of each of K equal parts of the interval.
    window:
        False for a function that repeats itself with the interval: the power of a whole frequency is exact, and all
        powers sum to the mean of the squares. True applies the window of Hann, after the mean was taken out, for any
        other function: a frequency then shows in its two neighbors, too.

    Returns
    -------
    tuple
        The constant's power (...), and the others' (..., K // 2).
    """
    count = values.shape[-1]
    weights = np.full(count, 1.0 / count)
    if window:
        weights = 1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)
        weights /= weights.sum()
    mean = (values * weights).sum(axis=-1, keepdims=True)
    scale = 1.0 / (count * np.square(weights).sum())  # keeps the sum of powers where a window widens peaks
    parts = np.square(np.abs(np.fft.rfft((values - mean) * weights, axis=-1))) * scale
    parts = 2.0 * parts[..., 1:]
    if count % 2 == 0:
        parts[..., -1] /= 2.0
    return np.square(mean[..., 0]), parts


def mean_frequency(powers: Array, per_unit: float = 1.0) -> float:
    """Return the mean frequency, weighted by power, without the constant.

    Parameters
    ----------
    powers:
        (F,), of the frequencies 1, 2, ... per interval.
    per_unit:
        The unit's part of the interval: with an interval of 8 turns, 1 / 8 gives frequencies per turn.

    Returns
    -------
    float
        NaN where the function is constant.
    """
    total = powers.sum()
    if total <= 1e-24:
        return float("nan")
    return float(powers @ np.arange(1, len(powers) + 1) / total * per_unit)
