"""Returns of beams, noise, drop-outs and intensity."""

from __future__ import annotations

import numpy as np
import pytest

from humansim_ros.cameras.scanner.models import ONLY, STRONGEST_FIRST, WEAK_LAST, Measuring, Returns, measure
from humansim_ros.cameras.sensor.depth import reflectivity
from humansim_ros.files.mesh.mesh import Mesh


def echoes(rays: list[int], ranges: list[float], light: list[float]) -> Returns:
    count = len(rays)
    distances = np.array(ranges, dtype=float)
    return Returns(
        np.array(rays),
        np.zeros(count, np.uint8),
        distances,
        distances,
        np.array(light, dtype=float),
        np.arange(count, dtype=np.int32),
        np.zeros(count, np.int32),
    )


def measured(found: Returns, subrays: int = 1, **settings: object) -> Returns:
    values: dict[str, object] = {"range": (0.5, 50.0), **settings}
    return measure(found, subrays, Measuring(**values), np.random.default_rng(1))  # type: ignore[arg-type]


def test_distances_beyond_the_limits_are_not_measured() -> None:
    kept = measured(echoes([0, 1, 2, 3], [0.4, 0.5, 50.0, 50.1], [1, 1, 1, 1]))
    assert kept.rays.tolist() == [1, 2]


def test_dual_returns_are_the_strongest_and_the_last() -> None:
    # beam 0: four rays on a near edge, three on a wall behind; beam 1: all on the wall
    rays = [*range(7), *range(7, 14)]
    ranges = [2.0] * 4 + [6.0] * 3 + [6.0] * 7
    found = measured(echoes(rays, ranges, [0.5] * 14), 7, returns="dual", divergence=0.003)
    assert found.rays.tolist() == [0, 0, 1]
    np.testing.assert_allclose(found.ranges, [2, 6, 6])
    assert found.kinds.tolist() == [STRONGEST_FIRST, WEAK_LAST, ONLY]
    np.testing.assert_allclose(found.intensities, [0.5 * 4 / 7, 0.5 * 3 / 7, 0.5])
    last = measured(echoes(rays, ranges, [0.5] * 14), 7, returns="last", divergence=0.003)
    np.testing.assert_allclose(last.ranges, [6, 6])


def test_if_the_strongest_is_the_last_the_second_strongest_comes_too() -> None:
    ranges = [2.0, 2.0, 4.0, 6.0, 6.0, 6.0, 6.0]
    light = [0.02, 0.02, 0.9, 0.9, 0.9, 0.9, 0.9]
    found = measured(echoes(list(range(7)), ranges, light), 7, returns="dual", divergence=0.003)
    # power: 0.04 / 4 = 0.01, 0.9 / 16 = 0.056, 3.6 / 36 = 0.1
    assert sorted(found.ranges) == pytest.approx([4, 6])


def test_near_surfaces_of_a_beam_give_one_return_at_their_mean() -> None:
    found = measured(echoes([0, 1], [3.0, 3.2], [0.5, 0.5]), 7, returns="strongest", divergence=0.003)
    power = 0.5 / np.array([3.0, 3.2]) ** 2
    assert found.ranges == pytest.approx([float((power * [3.0, 3.2]).sum() / power.sum())])


def test_dark_surfaces_are_lost_where_the_law_of_their_range_says() -> None:
    found = echoes([0, 1, 2, 3], [19.9, 20.1, 39.9, 40.1], [0.1, 0.1, 0.4, 0.4])
    assert measured(found, range_10=20.0).rays.tolist() == [0, 2]


def test_noise_and_losses_have_their_statistics() -> None:
    count = 40_000
    found = measured(echoes(list(range(count)), [10.0] * count, [1.0] * count), noise=0.03, dropout=0.25)
    assert len(found.rays) / count == pytest.approx(0.75, abs=0.012)
    assert np.std(found.measured - 10) == pytest.approx(0.03, rel=0.03)
    assert np.mean(found.measured - 10) == pytest.approx(0, abs=8e-4)
    np.testing.assert_array_equal(found.ranges, 10)


def test_raw_intensity_falls_with_the_squared_distance() -> None:
    found = measured(echoes([0, 1], [2.0, 4.0], [0.8, 0.8]), intensity="raw")
    np.testing.assert_allclose(found.intensities, [0.2, 0.05])


def test_reflectivity_is_that_of_the_colour_in_infrared() -> None:
    grey, triangles = np.array([188, 188, 188], np.uint8), np.array([[0, 1, 2, -1]], np.int32)
    mesh = Mesh(np.eye(3), triangles, colors=np.tile(grey, (3, 1)))
    inside = np.array([[0.2, 0.3]])
    # 188 of 255 in sRGB is half of the light; the square root of it is reflected
    assert reflectivity(mesh, np.zeros(1, int), inside) == pytest.approx([np.sqrt(0.5)], abs=3e-3)
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 1] = 255  # at the top right
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    textured = Mesh(np.eye(3), triangles, uv, triangles, texture=texture)
    corner = np.array([[0.05, 0.9], [0.5, 0.1]])
    np.testing.assert_allclose(reflectivity(textured, np.zeros(2, int), corner), [1, 0], atol=1e-9)
