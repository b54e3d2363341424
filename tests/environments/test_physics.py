"""Intensities: by hand, against the released code's numbers, and against the plain formula."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qrlsuite.plugins.environments.beam6g import compiled, physics
from tests.conftest import golden

EPISODES = golden("beam6g")
MIDDLE = ((3.0, 3.0), (1.0, 0.0))


def antennas(episode):
    return [
        (tuple(position), tuple(orientation))
        for position, orientation in zip(episode["antenna_positions"], episode["antenna_orientations"])
    ]


def test_codebook_of_the_released_code():
    released = [3.13, 2.8, 2.11, 1.13, 0, -1.13, -2.11, -2.8, -3.13]
    assert physics.physics("released").phases.tolist() == released


def test_codebook_of_the_text_has_five_distinct_beams():
    phases = physics.physics("text").phases
    assert len(np.unique(phases.round(9))) == 5
    np.testing.assert_allclose(phases, np.pi * np.cos(2 * np.pi * np.arange(9) / 9), atol=1e-12)


@pytest.mark.parametrize("name", ["released", "text"])
def test_broadside_at_distance_one_is_one_over_r_squared(name):
    # Straight across the array u = 0, the released codebook's beam 4 (phi = 0) peaks; R^2 = 1 + 1.
    x, y = np.array([3.0]), np.array([4.0])
    released = physics.all_intensities(physics.physics(name), x, y, MIDDLE)
    if name == "released":
        assert released[4, 0] == 0.5  # the spike: 1/R^2, where the limit is 1/R^4 = 1/4
    u, r2 = physics.offsets(x, y, MIDDLE)
    assert u[0] == 0.0
    assert r2[0] == 2.0


def test_spike_is_only_where_the_squared_sine_is_below_1e_10():
    model = physics.physics("released")
    r2 = np.full(4, 9.0)
    edge = 2 * np.arcsin(1e-5)
    xi = np.array([0.0, 0.999 * edge, 1.001 * edge, -0.999 * edge])
    np.testing.assert_allclose(model.intensity(xi, r2, 0.0), [1 / 9, 1 / 9, 1 / 81, 1 / 9], rtol=1e-6)


def test_text_takes_the_limit_on_the_peak():
    model = physics.physics("text")
    r2 = np.full(3, 9.0)
    np.testing.assert_allclose(model.intensity(np.array([0.0, 1e-9, -1e-6]), r2, 0.0), 1 / 9, rtol=1e-9)


@pytest.mark.parametrize("episode", EPISODES, ids=range(len(EPISODES)))
def test_released_numbers_at_golden_positions(episode):
    x, y = np.array(episode["positions"]).T.copy()
    for i, antenna in enumerate(antennas(episode)):
        intensity, beam = physics.best_intensity(physics.physics("released"), x, y, antenna)
        expected = np.array(episode["best_intensity"])[:, i]
        np.testing.assert_allclose(intensity, expected, rtol=0, atol=1e-9)
        assert beam.tolist() == np.array(episode["best_codebook"])[:, i].tolist()


def plain(name, x, y, antenna):
    """The module's formula, written out for all nine beams: (9, n)."""
    model = physics.physics(name)
    (ax, ay), (dx, dy) = antenna
    r = np.sqrt((x - ax) ** 2 + (y - ay) ** 2 + 1)
    half = (np.pi * ((x - ax) * dx + (y - ay) * dy) / r - model.phases[:, None]) / 2
    with np.errstate(invalid="ignore"):
        value = np.sin(17 * half) ** 2 / (289 * r ** (4 if name == "released" else 2) * np.sin(half) ** 2)
    return np.where(np.sin(half) ** 2 <= (1e-10 if name == "released" else 0.0), 1 / r**2, value)


@pytest.mark.parametrize("name", ["released", "text"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_best_beam_is_the_largest_of_all_nine(name, seed):
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(0, 6, (2, 500))
    angle = generator.uniform(0, 2 * np.pi)
    antenna = (tuple(generator.uniform(0, 6, 2)), (np.cos(angle), np.sin(angle)))
    everything = plain(name, x, y, antenna)
    intensity, beam = physics.best_intensity(physics.physics(name), x, y, antenna)
    np.testing.assert_allclose(intensity, everything.max(axis=0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(everything[beam, np.arange(500)], everything.max(axis=0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        physics.all_intensities(physics.physics(name), x, y, antenna), everything, rtol=0, atol=1e-12
    )
    assert intensity.min() >= 0.0
    assert intensity.max() <= 1.0


@pytest.mark.parametrize("name", ["released", "text"])
def test_best_beam_on_a_fine_scan_between_the_ends(name):
    model = physics.physics(name)
    u = np.linspace(-np.pi, np.pi, 300_001)[1:-1]
    lobes = np.stack([physics._lobes(u - phase) for phase in model.phases])
    chosen = lobes[model.best_beam(u), np.arange(u.size)]
    np.testing.assert_allclose(chosen, lobes.max(axis=0), rtol=0, atol=1e-9 * 289)


@pytest.mark.parametrize("size", [1, 2, 17, 100])
@pytest.mark.parametrize("offset", [0, 1, 5, 13])
def test_bits_do_not_depend_on_the_place_in_an_array(size, offset):
    x, y = np.random.default_rng(3).uniform(0, 6, (2, 200))
    model = physics.physics("released")
    whole, beams = physics.best_intensity(model, x, y, MIDDLE)
    part = slice(offset, offset + size)
    intensity, beam = physics.best_intensity(model, x[part], y[part], MIDDLE)
    assert intensity.tobytes() == whole[part].tobytes()
    assert beam.tobytes() == beams[part].tobytes()


@pytest.mark.parametrize("name", ["released", "text"])
def test_compiled_tables_have_the_bits_of_the_physics(name: physics.Name) -> None:
    """Also on a beam's peak, where the intensity is 1 / R^2, and next to it."""
    model, half = physics.physics(name), np.array([[[0.0, 1e-6, 1e-4, 0.3]]])
    r2, intensity, optimal = np.linspace(1.0, 4.0, 4)[None, None], np.empty((1, 1, 4)), np.empty(1)
    compiled.tabulate(
        np.sin(half), np.sin(half * physics.SENDERS), r2, float(physics.SENDERS), model.fourth_power, model.peak,
        np.zeros(1, np.int64), intensity, optimal,
    )  # fmt: skip
    assert intensity.tobytes() == model.intensity(2 * half, r2, 0.0).tobytes()
    assert optimal[0] == np.cumsum(intensity)[-1]
