"""Random trajectories: sampled with rejection, interpolated, walked at constant speed.

Source: the paper's appendix, section "Trajectory sampling", with the released code's choices: sorted
support points and a spline of order min(4, n - 1) instead of a cubic one. A trajectory of degree n has n
support points at evenly spaced t in [0, 1]; the spline through them (for n <= 5 the interpolating
polynomial, beyond that the quartic spline of `scipy.interpolate.make_interp_spline`) is linear in their
coordinates, so the coefficients of a whole batch are one matrix product.

The user's speed is made constant by the arc length: the position at step k of K is s(t_k) with S(t_k) =
(k/K) S(1), S the arc length. The speed is sampled at 4 M + 1 points; each of the M panels integrates its
quartic interpolant (Boole's rule), and the same quartic is inverted by Newton's method. M is 500, and 4000
where a path has almost a cusp. Largest error of a position among 6000 paths of degree 3, 4, 5, 6, 8, against
8000 panels: 1e-11, 6e-9, 6e-8, 2e-7, 7e-7.

**A trajectory never depends on its batch**: its compiled loops (`compiled`) and numpy's elementwise operations sum in a
fixed order, without BLAS products and pairwise sums. So one trajectory has the same bits alone as among 10,000.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import StoreError
from qrlsuite.plugins.environments.beam6g.physics import FIELD, FloatArray

Rejection = Literal["tolerant", "released"]

TOLERANCE = 1e-9
"""How far a path may leave the field: rounding moves its ends by 1e-16, which is no reason to reject it."""
CHECKED = 1000
"""Evenly spaced points of a path that must lie in the field."""
PANELS = 500
"""Panels M of the arc length."""
FINE_PANELS = 4000
"""Panels for a path on which the user, at even t, would almost stop: there the speed has nearly a kink."""
SLOW = 0.05
"""A path is such a one if its speed falls below this fraction of its mean."""
_STRIDE = 37
"""Every 37th of the checked points comes first: these 28 reject most candidates at little cost."""
_NEWTON = 4


@dataclass(frozen=True, eq=False)
class Spline:
    """The interpolating spline through n support points as polynomial pieces.

    Attributes
    ----------
    points:
        Number of support points, n.
    order:
        Order of the pieces, k = min(4, n - 1).
    borders:
        Where pieces begin and end, (P + 1,), ascending from 0 to 1.
    matrix:
        (P, k + 1, n): coefficient of (t - border)^j in a piece as a combination of the support values.
    """

    points: int
    order: int
    borders: FloatArray
    matrix: FloatArray

    def coefficients(self, values: FloatArray) -> FloatArray:
        """Return the pieces' coefficients (P, k + 1, B) of support values (B, n), summed in a fixed order."""
        columns = np.ascontiguousarray(values.T)
        result: FloatArray = self.matrix[:, :, 0, None] * columns[0]
        for i in range(1, self.points):
            result += self.matrix[:, :, i, None] * columns[i]
        return result

    def starts(self, grid: FloatArray) -> NDArray[np.int64]:
        """Return where in an ascending `grid` (T,) each piece begins, and T: (P + 1,)."""
        cuts = np.searchsorted(grid, self.borders[1:-1], side="left")
        return np.concatenate([[0], cuts, [grid.size]]).astype(np.int64)


def derivative(coefficients: FloatArray) -> FloatArray:
    """Return the coefficients (P, k, B) of the derivative of pieces (P, k + 1, B)."""
    return coefficients[:, 1:] * np.arange(1.0, coefficients.shape[1])[:, None]


@functools.cache
def spline(points: int) -> Spline:
    """Return the interpolating spline through `points` >= 2 support points."""
    from scipy.interpolate import PPoly, make_interp_spline

    order = min(4, points - 1)
    times = np.linspace(0.0, 1.0, points)
    units = (make_interp_spline(times, unit, k=order) for unit in np.eye(points))
    pieces = [PPoly.from_spline(unit.tck) for unit in units]
    knots = pieces[0].x
    real = np.flatnonzero(np.diff(knots) > 0)  # the ends are repeated knots, their pieces are empty
    matrix = np.stack([p.c[::-1, real].T for p in pieces], axis=-1)
    matrix[0, 0] = np.eye(points)[0]  # exactly: a path begins at its first support point
    borders = np.append(knots[real], 1.0)
    return Spline(points, order, borders, np.ascontiguousarray(matrix))


def inside(support: FloatArray, rejection: Rejection = "tolerant") -> NDArray[np.bool_]:
    """Return whether candidates (B, n, 2) give a path that stays in the field: (B,).

    Parameters
    ----------
    support:
        Support points, x and y.
    rejection:
        "tolerant": none of 1000 evenly spaced points leaves the field by more than 1e-9. "released": in
        addition, as the released code does by comparing without tolerance, reject a path whose
        `scipy.interpolate.UnivariateSpline` for x is below 0 at its first point, where it should be 0; at
        degree 3 this rejects about a fifth of the valid paths: paths that lean right.
    """
    from qrlsuite.plugins.environments.beam6g import compiled

    curve = spline(support.shape[1])
    grid = np.linspace(0.0, 1.0, CHECKED)
    coarse = grid[::_STRIDE].copy()
    valid = np.empty(len(support), dtype=np.bool_)
    compiled.inside(
        curve.coefficients(support[:, :, 0]),
        curve.coefficients(support[:, :, 1]),
        curve.borders,
        coarse,
        curve.starts(coarse),
        grid,
        curve.starts(grid),
        -TOLERANCE,
        FIELD + TOLERANCE,
        valid,
    )
    if rejection == "released":
        from scipy.interpolate import UnivariateSpline

        order: Any = curve.order
        times = np.linspace(0.0, 1.0, curve.points)
        for i in np.flatnonzero(valid):
            through: Any = UnivariateSpline(times, support[i, :, 0], k=order, s=0)
            valid[i] = through(0.0) >= 0.0
    return valid


def sample(
    streams: list[np.random.Generator], counts: list[int], points: int, rejection: Rejection = "tolerant"
) -> FloatArray:
    """Draw valid support points, `counts[g]` trajectories from stream g: (sum of counts, points, 2).

    Each stream yields blocks of candidates, 6 and 2, 4, 8, ... for every trajectory that it still lacks,
    and the valid ones are taken in order; so a stream's candidates depend on the stream and its count alone.
    x: uniform in [0, 6], the first forced to 0, the last to 6, sorted. y: uniform in [0, 6].
    """
    accepted: list[list[FloatArray]] = [[] for _ in streams]
    missing = list(counts)
    growth = 2
    while waiting := [g for g, count in enumerate(missing) if count > 0]:
        sizes = [6 + growth * missing[g] for g in waiting]
        numbers = np.concatenate(
            [streams[g].random((size, 2 * points - 2)) for g, size in zip(waiting, sizes)]
        )
        support = np.empty((len(numbers), points, 2))
        support[:, 0, 0], support[:, -1, 0] = 0.0, FIELD
        support[:, 1:-1, 0] = np.sort(numbers[:, : points - 2], axis=1) * FIELD
        support[:, :, 1] = numbers[:, points - 2 :] * FIELD
        valid = inside(support, rejection)
        ends = np.cumsum(sizes)
        for g, start, end in zip(waiting, ends - sizes, ends):
            taken = start + np.flatnonzero(valid[start:end])[: missing[g]]
            accepted[g].append(support[taken])
            missing[g] -= len(taken)
        growth *= 2
    return np.concatenate([block for blocks in accepted for block in blocks])


def require_inside(owner: str, support: FloatArray) -> None:
    """Refuse saved support points (B, n, 2) outside the field; `owner` is the environment's name."""
    if not ((support >= 0.0) & (support <= FIELD)).all():
        raise StoreError(f"{owner}: 'support_points' must lie in the field, 0..{FIELD:g}")


def positions(support: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
    """Return x and y, each (B, steps + 1), of users who walk paths (B, n, 2) at constant speed."""
    x, y, slow = _walk(support, steps, PANELS)
    if slow.any():
        x[slow], y[slow], _ = _walk(support[slow], steps, FINE_PANELS)
    return x, y


def _walk(support: FloatArray, steps: int, panels: int) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return x and y (B, steps + 1) by an arc length of that many panels, and which paths are slow, (B,)."""
    from qrlsuite.plugins.environments.beam6g import compiled

    curve = spline(support.shape[1])
    x = np.empty((len(support), steps + 1))
    y = np.empty_like(x)
    slow = np.empty(len(support), dtype=np.bool_)
    along_x, along_y = (curve.coefficients(support[:, :, axis]) for axis in (0, 1))
    grid = np.linspace(0.0, 1.0, 4 * panels + 1)
    compiled.walk(
        along_x,
        along_y,
        derivative(along_x),
        derivative(along_y),
        curve.borders,
        curve.starts(grid),
        grid,
        np.arange(steps + 1) / steps,
        _NEWTON,
        SLOW / panels,
        x,
        y,
        slow,
    )
    return x, y, slow
