"""Beam intensity of phased antenna arrays, and the beam that serves a user best.

Source: the paper's appendix "6G Beam forming and RL environment", the equations of the final intensity and
of the codebook's angles, with the differences of the released code. An array of N_s = 17 senders along
the unit vector d, tuned to the phase gradient phi, has at the offset (dx, dy) from its center the intensity

    I = sin^2(N_s xi / 2) / (N_s^2 R^p sin^2(xi / 2)),   xi = u - phi,   u = pi (dx d_x + dy d_y) / R,
    R^2 = dx^2 + dy^2 + 1,

in [0, 1], lengths in units of the model. The two physics differ in three points:

========  ===  ==================================  =====================================================
physics   p    where xi tends to 0                 codebook phi_i = pi cos(theta_i), i = 0..8
========  ===  ==================================  =====================================================
released  4    1 / R^2 if sin^2(xi/2) <= 1e-10     theta_i evenly over [0.1, pi - 0.1], phi_i to 2 decimals
text      2    1 / R^2, the limit                  theta_i evenly over [0, 2 pi): 5 distinct beams
========  ===  ==================================  =====================================================

In the released physics 1 / R^2 is not the limit, which is 1 / R^4: exactly on a beam's peak there is an
isolated spike. The text softens nothing but cuts the intensity off at R = 0.001, which would push every
reachable intensity to about 1e-7 of the maximum; here both physics have the softened R.

**Which beam is best depends on u alone**, because R is the same for all beams of an antenna. So the best
beam is a step function of one variable, tabulated once: a search in its few dozen steps replaces nine
evaluations. Every operation here is elementwise, so a value never depends on its neighbors in an array.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BeamArray = NDArray[np.int8]
Name = Literal["released", "text"]
Antenna = tuple[tuple[float, float], tuple[float, float]]
"""Position (x, y) in the field and orientation (d_x, d_y), a unit vector: the axis of the sender array."""

FIELD = 6.0
"""Side of the square field [0, 6] x [0, 6], in units of the model."""
SENDERS = 17
"""Senders of an array, N_s."""
BEAMS = 9
"""Elements of the codebook, N_c."""

_SCAN = 1 << 16
"""Points of the scan for changes of the best beam; two changes closer than 1e-4 in u would be missed."""


@dataclass(frozen=True, eq=False)
class Physics:
    """Constants of one physics, and the steps of its best beam.

    Attributes
    ----------
    phases:
        Phase gradients phi_i of the codebook, (9,), radians.
    fourth_power:
        Whether the intensity falls with R^4 instead of R^2.
    peak:
        Largest sin^2(xi/2) at which the intensity is 1 / R^2.
    steps:
        Values of u, ascending, at which the best beam changes, (m,), radians.
    best:
        The best beam between consecutive `steps`, (m + 1,), indices into `phases`.
    """

    phases: FloatArray
    fourth_power: bool
    peak: float
    steps: FloatArray
    best: BeamArray

    def intensity(self, u: FloatArray, r2: FloatArray, phase: FloatArray | float) -> FloatArray:
        """Return the intensity of beams with phase gradients `phase` at the same shape as `u` and `r2`.

        Parameters
        ----------
        u:
            Phase difference of neighboring senders towards the user, radians, in (-pi, pi); see `offsets`.
        r2:
            Softened squared distance R^2, at least 1.
        phase:
            Phase gradients phi, radians, broadcastable to `u`.
        """
        half = u - phase
        half *= 0.5
        below = np.sin(half)
        below *= below
        half *= SENDERS
        above = np.sin(half)
        above *= above
        peak = below <= self.peak
        fall = r2 * r2 if self.fourth_power else r2.copy()
        below *= fall
        below *= float(SENDERS * SENDERS)
        below[peak] = 1.0
        above /= below
        np.copyto(above, 1.0 / r2, where=peak)
        return above

    def best_beam(self, u: FloatArray) -> BeamArray:
        """Return the index of the strongest beam, the first of equals, in the shape of `u`."""
        return self.best.take(np.searchsorted(self.steps, u, side="right"))


def offsets(x: FloatArray, y: FloatArray, antenna: Antenna) -> tuple[FloatArray, FloatArray]:
    """Return u (radians) and R^2 of users at `x`, `y` (any common shape) as an antenna sees them."""
    (antenna_x, antenna_y), (d_x, d_y) = antenna
    dx = x - antenna_x
    dy = y - antenna_y
    r2 = dx * dx
    r2 += dy * dy
    r2 += 1.0
    dx *= d_x
    dy *= d_y
    dx += dy
    dx /= np.sqrt(r2)
    dx *= np.pi
    return dx, r2


def best_intensity(
    physics: Physics, x: FloatArray, y: FloatArray, antenna: Antenna
) -> tuple[FloatArray, BeamArray]:
    """Return the intensity and the index of an antenna's best beam for users at `x`, `y`, in their shape."""
    u, r2 = offsets(x, y, antenna)
    beam = physics.best_beam(u)
    return physics.intensity(u, r2, physics.phases.take(beam)), beam


def all_intensities(physics: Physics, x: FloatArray, y: FloatArray, antenna: Antenna) -> FloatArray:
    """Return the intensity of every beam of an antenna, shape (9, *x.shape), for pictures and checks."""
    u, r2 = offsets(x, y, antenna)
    return np.stack([physics.intensity(u, r2, float(phase)) for phase in physics.phases])


@functools.cache
def physics(name: Name) -> Physics:
    """Return a physics by name, "released" or "text"."""
    if name == "released":
        phases = np.round(np.pi * np.cos(np.linspace(0.1, np.pi - 0.1, BEAMS)), 2)
        fourth_power, peak = True, 1e-10
    else:
        phases = np.pi * np.cos(np.linspace(0.0, 2 * np.pi, BEAMS, endpoint=False))
        fourth_power, peak = False, 0.0
    steps, best = _best_beams(phases)
    return Physics(phases, fourth_power, peak, steps, best)


def _best_beams(phases: FloatArray) -> tuple[FloatArray, BeamArray]:
    """Find where the largest lobe changes from one beam to another: a scan, then bisection of each change."""
    _, first = np.unique(np.round(phases, 9), return_index=True)
    distinct: NDArray[np.intp] = np.sort(first)

    def leader(u: FloatArray) -> NDArray[np.intp]:
        best: NDArray[np.intp] = distinct.take(np.argmax([_lobes(u - phases[i]) for i in distinct], axis=0))
        return best

    grid = np.linspace(-np.pi, np.pi, _SCAN)
    leaders = leader(grid)
    change = np.flatnonzero(leaders[1:] != leaders[:-1])
    low, high, left = grid[change], grid[change + 1], leaders[change]
    for _ in range(60):
        middle = 0.5 * (low + high)
        same = leader(middle) == left
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return high, np.append(left, leaders[-1]).astype(np.int8)


def _lobes(xi: FloatArray) -> FloatArray:
    """Return sin^2(N_s xi/2) / sin^2(xi/2) as a sum of cosines, which has no singular point at xi = 0."""
    orders = np.arange(1, (SENDERS - 1) // 2 + 1)
    total: FloatArray = 1.0 + 2.0 * np.cos(orders[:, None] * xi).sum(axis=0)
    return total * total
