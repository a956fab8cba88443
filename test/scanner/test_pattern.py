"""Patterns: angles, firing times and rings as manuals state them."""

from __future__ import annotations

import numpy as np
import pytest

from humansim_ros.cameras.scanner.models import MODELS, SUBRAYS, rosette, spinning

#: Elevation in degrees of each ring, as the driver has it: velodyne_pointcloud (vert_correction by rank, in
#: VLP16db.yaml and 32db.yaml), ouster-ros (ring is the row of beam_altitude_angles; even ones here), nebula
#: (PandarXT32.csv, rounded to whole degrees as in the manual).
BY_RING = {
    "velodyne_vlp16": [-15, -13, -11, -9, -7, -5, -3, -1, 1, 3, 5, 7, 9, 11, 13, 15],
    "velodyne_hdl32e": [
        *(-30.67, -29.33, -28.0, -26.67, -25.33, -24.0, -22.67, -21.33, -20.0, -18.67, -17.33, -16.0),
        *(-14.67, -13.33, -12.0, -10.67, -9.33, -8.0, -6.67, -5.33, -4.0, -2.67, -1.33, 0.0),
        *(1.33, 2.67, 4.0, 5.33, 6.67, 8.0, 9.33, 10.67),
    ],
    "ouster_os0_128": np.linspace(45, -45, 128).tolist(),
    "ouster_os1_64": np.linspace(22.5, -22.5, 64).tolist(),
    "hesai_xt32": list(range(15, -17, -1)),
}
#: Number of rings without an elevation: channels of rs_driver, lines of livox_ros_driver2.
RINGS = {"robosense_m1": 5, "livox_mid40": 1, "livox_mid360": 4}
#: First angle, last angle and step of a LaserScan in radians, and seconds between its rays: urg_node (1024 or
#: 1440 steps a turn) and sick_scan_xd.
SCANS = {
    "hokuyo_utm30lx": (-2.35619449, 2.35619449, 0.00436332313, 1.73611e-5),
    "hokuyo_urg04lx": (-2.08621382, 2.09234976, 0.00613592315, 9.765625e-5),
    "sick_lms111": (-2.35619449, 2.35619449, 0.00872664626, 2.77777e-5),
    "sick_tim571": (-2.35619449, 2.35619449, 0.00581776417, 6.17284e-5),
}


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


@pytest.mark.parametrize("name", MODELS)
def test_rings_are_those_of_the_driver(name: str) -> None:
    model = MODELS[name]
    rays = model.pattern(model.rate).rays(1)
    if name in SCANS:
        first, step = rays.azimuths or (0, 0)
        last = first + step * (len(rays) - 1)
        between = float(rays.times[1] - rays.times[0]) * 1e-9
        assert (first, last, step, between) == pytest.approx(SCANS[name], rel=1e-4)
    elif name in RINGS:
        assert sorted(set(rays.rings.tolist())) == list(range(RINGS[name]))
    else:
        elevation = np.degrees(np.arcsin(rays.directions[:, 2]))
        np.testing.assert_allclose(elevation, np.array(BY_RING[name])[rays.rings], atol=0.01)
        # from behind, clockwise as seen from above
        azimuth = np.degrees(np.arctan2(rays.directions[:, 1], rays.directions[:, 0]))
        turned = np.mod(180 - azimuth + 0.01, 360)
        assert turned[0] == pytest.approx(0.01) and (np.diff(turned) > -1e-6).all()


def test_lasers_of_an_xt32_fire_from_the_top_every_1512_ns() -> None:
    for rate, columns in ((10.0, 2000), (20.0, 1000), (5.0, 4000)):
        rays = MODELS["hesai_xt32"].pattern(rate).rays(0)
        column, channel = np.divmod(np.arange(len(rays)), 32)
        assert rays.grid == (32, columns)
        np.testing.assert_array_equal(rays.rings, channel)
        np.testing.assert_allclose(rays.times, 50_000 * column + 1512 * channel, atol=1)


def test_five_channels_of_an_m1_are_side_by_side_and_fire_together() -> None:
    rays = MODELS["robosense_m1"].pattern(10.0).rays(0)
    assert len(rays) == 78_750  # 787,500 a second
    assert (rays.times.reshape(-1, 5) == rays.times[::5, None]).all()
    azimuth = np.degrees(np.arctan2(rays.directions[:, 1], rays.directions[:, 0]))
    for channel, middle in enumerate((48, 24, 0, -24, -48)):
        own = azimuth[rays.rings == channel]
        assert (own.min(), own.max()) == pytest.approx((middle - 12.4, middle + 12.4))
    elevation = np.degrees(np.arcsin(rays.directions[:, 2]))
    assert (elevation.max(), elevation.min()) == pytest.approx((12.5, -12.5))


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
