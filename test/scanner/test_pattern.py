"""Patterns: angles, firing times and rings as manuals state them."""

from __future__ import annotations

import numpy as np
import pytest

from humansim_ros.scanner.models import MODELS
from humansim_ros.scanner.pattern import SUBRAYS, rosette, spinning


def test_firing_times_and_rings_of_a_vlp16_are_those_of_its_manual() -> None:
    rays = MODELS["velodyne_vlp16"].pattern(10.0).rays(0)
    assert rays.grid == (16, 1808)
    column, laser = np.divmod(np.arange(len(rays)), 16)
    np.testing.assert_allclose(rays.times, 55_296 * column + 2_304 * laser, atol=1)
    elevation = np.degrees(np.arcsin(rays.directions[:, 2]))
    np.testing.assert_allclose(elevation[:6], [-15, 1, -13, 3, -11, 5], atol=1e-9)
    np.testing.assert_allclose(elevation, -15 + 2.0 * rays.rings, atol=1e-9)
    # ten turns a second, clockwise as seen from above, from behind
    azimuth = np.degrees(np.arctan2(rays.directions[:, 1], rays.directions[:, 0]))
    np.testing.assert_allclose(np.mod(180 - azimuth + 0.01, 360) - 0.01, 3600e-9 * rays.times, atol=1e-5)


def test_rays_of_a_plane_are_those_of_a_laser_scan() -> None:
    rays = MODELS["hokuyo_utm30lx"].pattern(40.0).rays(0)
    assert rays.azimuths is not None
    first, step = rays.azimuths
    assert (np.degrees(first), np.degrees(step)) == pytest.approx((-135, 0.25))
    angles = first + step * np.arange(1081)
    expected = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    np.testing.assert_allclose(rays.directions, expected, atol=1e-12)
    assert rays.times[-1] == pytest.approx(0.75 * 25e6)


@pytest.mark.parametrize("name", MODELS)
def test_each_model_fires_its_rays_within_its_sweep(name: str) -> None:
    model = MODELS[name]
    pattern = model.pattern(model.rate)
    for number in (0, 7):
        rays = pattern.rays(number)
        assert len(rays) == pattern.count
        assert (np.diff(rays.times) >= 0).all()
        assert 0 <= rays.times[0] <= rays.times[-1] < pattern.period
        np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, rtol=1e-12)


def test_a_rosette_fills_its_cone_and_does_not_repeat() -> None:
    pattern = rosette(10.0, 100_000, 38.4, (7294 / 60, -4664 / 60))
    off = np.degrees(np.arccos(pattern.rays(0).directions[:, 0]))
    assert off.max() == pytest.approx(19.2, abs=0.02)
    assert off.min() < 0.1
    gaps = np.linalg.norm(pattern.rays(0).directions - pattern.rays(1).directions, axis=1)
    assert np.median(gaps) > 0.02


def test_rays_of_a_beam_are_within_its_divergence() -> None:
    rays = spinning(10.0, (-90.0, -20.0, 0.0, 80.0), 30).rays(0)
    beams = rays.spread(0.01)
    off = beams.directions.reshape(-1, SUBRAYS, 3)
    np.testing.assert_allclose(off[:, 0], rays.directions, atol=1e-12)
    angles = np.arccos(np.clip(np.einsum("nkc,nc->nk", off[:, 1:], rays.directions), -1, 1))
    np.testing.assert_allclose(angles, 0.0035, rtol=1e-3)
    # evenly around: their mean is the middle
    np.testing.assert_allclose(off[:, 1:].mean(axis=1), rays.directions, atol=1e-5)
