"""The compiled loops of paths and of steps: every operation in the order and rounding of numpy's."""

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
        values, places = out[first:end], grid[first:end]  # of slices, loops have no index below 0
        values[:] = pieces[piece, last, b]
        for j in range(last - 1, -1, -1):
            coefficient = pieces[piece, j, b]
            for i in range(end - first):
                values[i] = values[i] * (places[i] - border) + coefficient


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
        for p in range(panels):
            whole = 7.0 * (speed[4 * p] + speed[4 * p + 4])
            whole += 32.0 * (speed[4 * p + 1] + speed[4 * p + 3])
            length[p] = (whole + 12.0 * speed[4 * p + 2]) / 90.0
        for p in range(panels):
            before[p + 1] = before[p] + length[p]
        total = before[panels]
        below = 0  # counted, for a minimum is found one by one
        for i in range(grid.shape[0]):
            below += speed[i] < limit * total
        slow[b] = below > 0

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
            z[k] = length[now]
            v0[k], c1[k], c2[k] = speed[4 * now], speed[4 * now + 1], speed[4 * now + 2]
            c3[k], c4[k] = speed[4 * now + 3], speed[4 * now + 4]
        for k in range(steps + 1):
            z[k] = target[k] / z[k]
            a0, a1, a2, a3, a4 = v0[k], c1[k], c2[k], c3[k], c4[k]
            # The quartic through the five speeds, as powers of z in [0, 1] across the panel.
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


@rounded
def serve(
    actions: Any, intensity: Any, beam: Any, last_beam: int, step: Any, received: Any, observations: Any, rewards: Any,
    ends: Any,
) -> bool:  # fmt: skip
    """Let antennas `actions` (L,) serve the lanes whose episodes go on; return False, and do nothing, if one is none.

    Parameters
    ----------
    intensity, beam:
        Tables (L, A, K + 1), see `Tables`.
    last_beam:
        The number of the codebook's last beam.
    step, received, observations:
        Changed in place: (L,), (L,) and (L, 3 stack), into which a step shifts three numbers.
    rewards, ends:
        Written: (L,) each; whether an episode ends.
    """
    antennas, last = intensity.shape[1], intensity.shape[2] - 1
    for lane in range(actions.shape[0]):
        if not 0 <= actions[lane] < antennas:
            return False
    for lane in range(actions.shape[0]):
        goes_on = step[lane] < last
        rewards[lane], ends[lane] = 0.0, False
        if goes_on:
            step[lane] += 1
            antenna, k, seen = actions[lane], step[lane], observations[lane]
            rewards[lane], ends[lane] = intensity[lane, antenna, k], k == last
            received[lane] += rewards[lane]
            for i in range(seen.shape[0] - 3):
                seen[i] = seen[i + 3]
            seen[-3] = antenna / (antennas - 1)
            seen[-2] = rewards[lane]
            seen[-1] = beam[lane, antenna, k] / last_beam
    return True


@rounded
def aim(
    x: Any, y: Any, antennas: Any, borders: Any, best: Any, phases: Any, lanes: Any, halves: Any, r2: Any, beam: Any
) -> None:  # fmt: skip
    """Write how every antenna sees users at x, y (B, K + 1): half of xi, and R^2, (B, A, K + 1); see `physics`.

    Parameters
    ----------
    antennas:
        Positions and orientations (A, 4).
    borders, best, phases:
        The physics's `steps`, `best` and `phases`.
    lanes, beam:
        The best beam goes to the rows `lanes` (B,) of `beam`, (L, A, K + 1).
    """
    for b in range(x.shape[0]):
        for a in range(antennas.shape[0]):
            half, squared, beams = halves[b, a], r2[b, a], beam[lanes[b], a]
            for k in range(x.shape[1]):
                dx, dy = x[b, k] - antennas[a, 0], y[b, k] - antennas[a, 1]
                squared[k] = dx * dx + dy * dy + 1.0
                half[k] = (dx * antennas[a, 2] + dy * antennas[a, 3]) / np.sqrt(squared[k]) * np.pi
            piece = 0  # that of the last step, which is near
            for k in range(x.shape[1]):
                u = half[k]
                while piece < borders.shape[0] and borders[piece] <= u:
                    piece += 1
                while piece > 0 and borders[piece - 1] > u:
                    piece -= 1
                beams[k] = best[piece]
                half[k] = (u - phases[best[piece]]) * 0.5


@rounded
def tabulate(
    below: Any, above: Any, r2: Any, senders: float, fourth_power: bool, peak: float, lanes: Any, intensity: Any,
    optimal: Any,
) -> None:  # fmt: skip
    """Write intensities (L, A, K + 1), and the sums of the best antenna's (L,), to the rows `lanes`; see `physics`.

    Parameters
    ----------
    below, above:
        The sines of half of xi and of so many times that, (B, A, K + 1), as numpy has them.
    """
    for b in range(r2.shape[0]):
        lane, total = lanes[b], 0.0
        for k in range(r2.shape[2]):
            most = 0.0
            for a in range(r2.shape[1]):
                sine, square, fall = (
                    below[b, a, k] * below[b, a, k],
                    above[b, a, k] * above[b, a, k],
                    r2[b, a, k],
                )
                if sine <= peak:
                    value = 1.0 / fall
                else:
                    value = square / (sine * (fall * fall if fourth_power else fall) * (senders * senders))
                intensity[lane, a, k] = value
                most = max(most, value)
            total += most  # in the order of the steps
        optimal[lane] = total
