"""Trajectories: interpolation, constant speed, rejection, and independence of the batch."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import UnivariateSpline, make_interp_spline

from qrlsuite.errors import StoreError
from qrlsuite.plugins.environments.beam6g import compiled, trajectory
from qrlsuite.plugins.environments.beam6g.options import BeamOptions
from qrlsuite.plugins.environments.beam6g.vector import BeamLanes
from tests.conftest import golden

EPISODES = golden("beam6g")
DEGREES = [2, 3, 4, 5, 6, 7, 9]


def sampled(count, degree, seed=0, rejection="tolerant"):
    return trajectory.sample([np.random.default_rng(seed)], [count], degree, rejection)


def on_grid(curve, values, grid):
    """Paths (B, T) through support values (B, n), as the compiled loops see them."""
    paths = np.empty((len(values), grid.size))
    for b, path in enumerate(paths):
        compiled._on_grid(curve.coefficients(values), b, curve.borders, curve.starts(grid), grid, path)
    return paths


@pytest.mark.parametrize("degree", DEGREES)
def test_spline_is_that_of_scipy(degree):
    values = np.random.default_rng(1).uniform(0, 6, (3, degree))
    curve = trajectory.spline(degree)
    grid = np.linspace(0, 1, 301)
    times, order = np.linspace(0, 1, degree), min(4, degree - 1)
    expected = make_interp_spline(times, values.T, k=order)(grid).T
    np.testing.assert_allclose(on_grid(curve, values, grid), expected, atol=1e-10)
    released = UnivariateSpline(times, values[0], k=order, s=0)(grid)
    np.testing.assert_allclose(on_grid(curve, values[:1], grid)[0], released, atol=1e-10)


def test_straight_path_is_walked_evenly():
    x, y = trajectory.positions(np.array([[[0.0, 1.0], [6.0, 4.0]]]), 3)
    np.testing.assert_allclose(x, [[0, 2, 4, 6]], atol=1e-12)
    np.testing.assert_allclose(y, [[1, 2, 3, 4]], atol=1e-12)


def test_path_that_stops_and_turns_is_walked_evenly():
    # x(t) = 24 t (1 - t): there and back on a line, at rest for a moment in the middle.
    x, _ = trajectory.positions(np.array([[[0.0, 2.0], [6.0, 2.0], [0.0, 2.0]]]), 4)
    np.testing.assert_allclose(x, [[0, 3, 6, 3, 0]], atol=1e-6)


def test_path_that_starts_at_rest_is_walked_evenly():
    # x(t) = 6 t^2: the speed is exactly 0 at t = 0.
    x, _ = trajectory.positions(np.array([[[0.0, 2.0], [1.5, 2.0], [6.0, 2.0]]]), 4)
    np.testing.assert_allclose(x, [[0, 1.5, 3, 4.5, 6]], atol=1e-9)


def turning(turn, steps):
    """Positions on a line and the exact ones: x(t) = b t - c t^2 rises to b^2 / 4c at t = `turn` and comes back."""
    b = 10.0 / turn
    c = b / (2 * turn)
    along = np.stack([np.zeros_like(turn), b / 2 - c / 4, b - c], axis=1)
    x, _ = trajectory.positions(np.stack([along, np.full_like(along, 2.0)], axis=2), steps)
    top = b**2 / (4 * c)
    walked = (2 * top - (b - c))[:, None] * np.arange(steps + 1) / steps
    return x, top[:, None] - np.abs(walked - top[:, None])


def test_paths_that_turn_on_a_line_are_walked_evenly():
    x, expected = turning(np.random.default_rng(0).uniform(0.3, 0.9, 300), 37)
    np.testing.assert_allclose(x, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("within", [0.0, 0.2, 0.25, 0.5, 0.75])
def test_a_kink_of_the_speed_throws_nobody_off_the_path(within, monkeypatch):
    # The quartic through |z - 0.25| at five points falls below zero: Newton's method must not leave the panel.
    monkeypatch.setattr(trajectory, "PANELS", 8)
    monkeypatch.setattr(trajectory, "FINE_PANELS", 8)
    x, expected = turning((np.arange(3, 7) + within) / 8, 500)
    np.testing.assert_allclose(x, expected, rtol=0, atol=0.25)  # the extent of a panel


@pytest.mark.parametrize("episode", EPISODES, ids=range(len(EPISODES)))
def test_released_positions(episode):
    x, y = trajectory.positions(np.array(episode["support_points"])[None], episode["steps"])
    np.testing.assert_allclose(np.stack([x[0], y[0]], axis=1), episode["positions"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("degree", [3, 4, 5, 6, 8])
def test_equal_arc_lengths_by_adaptive_quadrature(degree):
    support = sampled(3, degree, seed=4)
    x, y = trajectory.positions(support, 5)
    times, order = np.linspace(0, 1, degree), min(4, degree - 1)
    for lane in range(3):
        curve = make_interp_spline(times, support[lane], k=order)
        slope = curve.derivative()
        ends = [0.0]
        for k in range(1, 6):
            # the time of step k, from its position, on a fine grid refined by one more grid
            grid = np.linspace(0, 1, 100_001)
            near = grid[np.argmin(np.hypot(*(curve(grid) - [x[lane, k], y[lane, k]]).T))]
            fine = np.linspace(max(near - 2e-5, 0), min(near + 2e-5, 1), 40_001)
            ends.append(fine[np.argmin(np.hypot(*(curve(fine) - [x[lane, k], y[lane, k]]).T))])
        lengths = [
            quad(lambda t, slope=slope: np.hypot(*slope(t)), a, b, limit=500, points=None)[0]
            for a, b in itertools.pairwise(ends)
        ]
        np.testing.assert_allclose(lengths, np.mean(lengths), rtol=1e-5)


@pytest.mark.parametrize("degree", [3, 5, 6])
def test_paths_that_nearly_stop_are_refined(degree, monkeypatch):
    support = sampled(200, degree, seed=5)
    x, y = trajectory.positions(support, 50)
    monkeypatch.setattr(trajectory, "PANELS", 8000)
    exact_x, exact_y = trajectory.positions(support, 50)
    assert np.abs(x - exact_x).max() < 1e-6
    assert np.abs(y - exact_y).max() < 1e-6


@pytest.mark.parametrize("degree", DEGREES)
def test_samples_obey_the_rules(degree):
    support = sampled(40, degree)
    assert support.shape == (40, degree, 2)
    assert (support[:, 0, 0] == 0.0).all()
    assert (support[:, -1, 0] == 6.0).all()
    assert (np.diff(support[:, :, 0], axis=1) >= 0.0).all()
    times, order = np.linspace(0, 1, degree), min(4, degree - 1)
    paths = make_interp_spline(times, support, k=order, axis=1)(np.linspace(0, 1, 1000))
    assert paths.min() >= -1e-9 - 1e-12
    assert paths.max() <= 6.0 + 1e-9 + 1e-12


@pytest.mark.parametrize(
    ("middle", "valid"), [((3.0, 3.0), True), ((5.9, 3.0), False), ((0.1, 3.0), False), ((3.0, 5.99), False)]
)
def test_a_path_outside_the_field_is_rejected(middle, valid):
    # The parabola through x = 0, m, 6 leaves [0, 6] for m < 1.5 and m > 4.5.
    support = np.array([[[0.0, 3.0], middle, [6.0, 3.0]]])
    if middle == (3.0, 5.99):
        support[0, [0, 2], 1] = 0.5, 5.0  # y = 0.5, 5.99, 5 overshoots 6
    assert trajectory.inside(support).tolist() == [valid]


def test_leaving_by_less_than_the_tolerance_is_staying():
    over = np.array([[[0.0, 6.0 + 5e-10], [6.0, 3.0]], [[0.0, 6.0 + 2e-9], [6.0, 3.0]]])
    assert trajectory.inside(over).tolist() == [True, False]


def test_a_path_that_leaves_between_the_coarse_points_is_rejected():
    # It leaves near t = 0 only, for about 4 of the 1000 points, all before the second of the coarse 28.
    support = np.array([[[0.0, 3.0], [1.494, 3.0], [6.0, 3.0]]])
    curve = trajectory.spline(3)
    x = on_grid(curve, support[:, :, 0], np.linspace(0, 1, 1000))[0]
    outside = np.flatnonzero(x < -1e-9)
    assert outside.min() > 0
    assert outside.max() < trajectory._STRIDE
    assert trajectory.inside(support).tolist() == [False]


def test_middle_of_degree_three_is_symmetric_under_the_tolerant_rule():
    # Valid middles are uniform in [1.5, 4.5] (a little wider: 1000 points are checked, not all): the mean of
    # 2000 is 3 with a standard deviation of .02.
    middle = sampled(2000, 3)[:, 1, 0]
    assert abs(middle.mean() - 3.0) < 0.08
    assert middle.min() > 1.49
    assert middle.max() < 4.51


def test_released_rejection_leans_left():
    middle = sampled(600, 3, rejection="released")[:, 1, 0]
    assert abs(middle.mean() - 2.65) < 0.12
    kept = trajectory.inside(sampled(600, 3), "released").mean()
    assert 0.72 < kept < 0.86  # 21 percent of the valid paths are lost


def test_seeds():
    assert sampled(5, 4, seed=1).tobytes() == sampled(5, 4, seed=1).tobytes()
    assert sampled(5, 4, seed=1).tobytes() != sampled(5, 4, seed=2).tobytes()


def test_a_stream_yields_the_same_among_others():
    def streams():
        return [np.random.default_rng(seed) for seed in range(6)]

    together = trajectory.sample(streams(), [3, 1, 4, 0, 5, 9], 6)
    alone = [trajectory.sample([stream], [count], 6) for stream, count in zip(streams(), [3, 1, 4]) if count]
    assert together[:8].tobytes() == np.concatenate(alone).tobytes()
    one, other = streams()[1], streams()[1]
    trajectory.sample([streams()[0], one], [7, 2], 6)
    trajectory.sample([other], [2], 6)
    assert one.bit_generator.state == other.bit_generator.state


def test_valid_candidates_are_taken_in_order():
    for seed in range(5):
        assert sampled(1, 3, seed).tobytes() == sampled(9, 3, seed)[:1].tobytes()


@pytest.mark.parametrize("degree", [3, 6])
@pytest.mark.parametrize(("size", "offset"), [(1, 0), (1, 37), (2, 5), (17, 31), (100, 13)])
def test_bits_do_not_depend_on_the_batch(degree, size, offset):
    support = sampled(150, degree, seed=6)
    x, y = trajectory.positions(support, 40)
    part = slice(offset, offset + size)
    some_x, some_y = trajectory.positions(support[part], 40)
    assert some_x.tobytes() == x[part].tobytes()
    assert some_y.tobytes() == y[part].tobytes()


@pytest.mark.parametrize("value", [2.0, np.nan])
def test_points_that_make_no_path_are_written_nowhere_else(value, monkeypatch):
    """A path of no length, or of no numbers, as Python runs the loops: compiled, they do not look where they write."""
    monkeypatch.setattr(compiled, "walk", compiled.walk.py_func)
    monkeypatch.setattr(trajectory, "PANELS", 10)
    monkeypatch.setattr(trajectory, "FINE_PANELS", 20)
    with np.errstate(all="ignore"):
        x, y = trajectory.positions(np.full((1, 3, 2), value), 20)
    assert x.shape == y.shape == (1, 21)
    assert np.isnan(x).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-9, 6.1])
def test_saved_points_outside_of_the_field_are_refused(value):
    lanes = BeamLanes(BeamOptions(), 2)
    lanes.reset(seed=0)
    state = lanes.state_dict()
    state["support_points"][1, 1, 1] = value
    with pytest.raises(StoreError, match=r"beam6g: 'support_points' must lie in the field, 0\.\.6"):
        lanes.load_state_dict(state)
    assert lanes.support_points.max() <= 6
