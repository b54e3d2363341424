"""The compiled loops of `trajectory`: path by path, every operation in the order and rounding of numpy's."""

from __future__ import annotations

from typing import Any

import numpy as np

from qrlsuite.compiled.cache import rounded


@rounded
def _on_grid(pieces: Any, b: int, borders: Any, starts: Any, grid: Any, out: Any) -> None:
    """Evaluate path `b` of pieces (P, k + 1, B) at an ascending grid (T,), in which piece p begins at starts[p]."""
    last = pieces.shape[1] - 1
    for piece in range(pieces.shape[0]):
        first, end, border = starts[piece], starts[piece + 1], borders[piece]
        out[first:end] = pieces[piece, last, b]
        for j in range(last - 1, -1, -1):
            coefficient = pieces[piece, j, b]
            for i in range(first, end):
                out[i] = out[i] * (grid[i] - border) + coefficient


@rounded
def inside(
    along_x: Any, along_y: Any, borders: Any, coarse: Any, coarse_starts: Any, fine: Any, fine_starts: Any,
    low: float, high: float, valid: Any,
) -> None:  # fmt: skip
    """Write to valid (B,) whether paths, pieces (P, k + 1, B) of x and y, stay in [low, high] on two grids."""
    values = np.empty(fine.shape[0])
    for b in range(valid.shape[0]):
        valid[b] = True
        for turn in range(4):
            if valid[b]:
                along = along_x if turn % 2 == 0 else along_y
                grid = coarse if turn < 2 else fine
                starts = coarse_starts if turn < 2 else fine_starts
                _on_grid(along, b, borders, starts, grid, values)
                within = True
                for i in range(grid.shape[0]):
                    within &= low <= values[i] <= high
                valid[b] = within


@rounded
def walk(
    along_x: Any, along_y: Any, slope_x: Any, slope_y: Any, borders: Any, starts: Any, grid: Any,
    shares: Any, newton: int, limit: float, x: Any, y: Any, slow: Any,
) -> None:  # fmt: skip
    """Write the positions x and y (B, K + 1) of users who walk paths at constant speed, and which paths are slow (B,).

    Parameters
    ----------
    along_x, along_y, slope_x, slope_y:
        Pieces (P, k + 1, B) of the paths, and (P, k, B) of their derivatives.
    borders, starts:
        Where each piece begins in [0, 1], (P + 1,), and in the grid, (P + 1,).
    grid:
        4 M + 1 places of the M panels.
    shares:
        k / K for every step k, (K + 1,).
    newton:
        Steps of Newton's method.
    limit:
        A path is slow if its speed falls below this fraction of its length, in units of a panel's width.
    """
    panels, steps = grid.shape[0] // 4, shares.shape[0] - 1
    speed, other = np.empty(grid.shape[0]), np.empty(grid.shape[0])
    length, before = np.empty(panels), np.zeros(panels + 1)
    counts = np.empty(steps + 2, np.int64)
    panel = np.empty(steps + 1, np.int64)
    rows = np.empty((11, steps + 1))
    target, z, v0, c1, c2, c3, c4 = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]
    q1, q2, q3, q4 = rows[7], rows[8], rows[9], rows[10]
    for b in range(x.shape[0]):
        _on_grid(slope_x, b, borders, starts, grid, speed)
        _on_grid(slope_y, b, borders, starts, grid, other)
        for i in range(grid.shape[0]):
            speed[i] = np.sqrt(speed[i] * speed[i] + other[i] * other[i])
        slowest = speed[0]
        for i in range(1, grid.shape[0]):
            slowest = min(slowest, speed[i])
        for p in range(panels):
            whole = 7.0 * (speed[4 * p] + speed[4 * p + 4])
            whole += 32.0 * (speed[4 * p + 1] + speed[4 * p + 3])
            length[p] = (whole + 12.0 * speed[4 * p + 2]) / 90.0
        for p in range(panels):
            before[p + 1] = before[p] + length[p]
        total = before[panels]
        slow[b] = slowest < limit * total

        # Step k lies in the panel whose number is that of the interior borders at or before its arc length.
        counts[:] = 0
        pace = steps / total
        for p in range(1, panels):
            place = before[p] * pace  # not a number where a path has no length, or points that are none
            counts[int(np.ceil(place)) if 0.0 <= place <= steps else steps + 1] += 1
        now = 0
        for k in range(steps + 1):
            now += counts[k]
            panel[k] = now
            target[k] = total * shares[k] - before[now]
            z[k] = target[k] / length[now]
            a0, a1, a2, a3 = speed[4 * now], speed[4 * now + 1], speed[4 * now + 2], speed[4 * now + 3]
            a4 = speed[4 * now + 4]
            # The quartic through the five speeds, as powers of z in [0, 1] across the panel.
            v0[k] = a0
            c1[k] = (-25.0 * a0 + 48.0 * a1 - 36.0 * a2 + 16.0 * a3 - 3.0 * a4) / 3.0
            c2[k] = (70.0 * a0 - 208.0 * a1 + 228.0 * a2 - 112.0 * a3 + 22.0 * a4) / 3.0
            c3[k] = (-80.0 * a0 + 288.0 * a1 - 384.0 * a2 + 224.0 * a3 - 48.0 * a4) / 3.0
            c4[k] = (32.0 * a0 - 128.0 * a1 + 192.0 * a2 - 128.0 * a3 + 32.0 * a4) / 3.0
        for k in range(steps + 1):
            q1[k], q2[k], q3[k], q4[k] = c1[k] * 0.5, c2[k] / 3.0, c3[k] * 0.25, c4[k] * 0.2
        for _ in range(newton):
            for k in range(steps + 1):
                t = z[k]
                arc = ((((q4[k] * t + q3[k]) * t + q2[k]) * t + q1[k]) * t + v0[k]) * t
                slope = (((c4[k] * t + c3[k]) * t + c2[k]) * t + c1[k]) * t + v0[k]
                t -= (arc - target[k]) / max(slope, 1e-12)
                z[k] = min(max(t, 0.0), 1.0)
        for k in range(steps + 1):
            t = (z[k] + panel[k]) / panels
            piece = 0
            while piece < along_x.shape[0] - 1 and t >= borders[piece + 1]:
                piece += 1
            local, last = t - borders[piece], along_x.shape[1] - 1
            u, v = along_x[piece, last, b], along_y[piece, last, b]
            for j in range(last - 1, -1, -1):
                u = u * local + along_x[piece, j, b]
                v = v * local + along_y[piece, j, b]
            x[b, k], y[b, k] = u, v
