"""Images of moving cameras: one sample in each pixel and anti-aliased edges, compared with many samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from render_scenes import EVEN, along_x, block_means, finer, quad, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Lighting
from humansim_ros.render.frame import static_layers
from humansim_ros.render.frame.edge_antialiasing import StaticEdges
from humansim_ros.scene import Scene
from humansim_ros.types import Image

BARREL = (-0.2, 0.04)
FINE = 8


def square(angle: float, half: float = 0.5, x: float = 3.0) -> Mesh:
    """A square that faces the camera, rotated by an angle in degrees."""
    c, s = half * np.cos(np.radians(angle)), half * np.sin(np.radians(angle))
    return quad([(x, y + 0.0123, z + 1.0077) for y, z in ((c, s), (s, -c), (-c, -s), (-s, c))])


def moving(
    meshes: Sequence[Mesh], camera: Camera, light: Lighting = EVEN
) -> tuple[Image, NDArray[np.float64]]:
    """Image of a moving camera, and the mean of many samples of each pixel."""
    renderer = renderer_or_skip(meshes, light)
    image = renderer.render([], camera, ("rgb",), moving_camera=True).rgb
    fine = replace(finer(camera, FINE), distortion=camera.distortion)
    many = block_means(renderer.render([], fine, ("rgb",)).rgb, FINE)
    renderer.close()
    return image, many


def errors(image: Image, many: NDArray[np.float64], low: int, high: int) -> tuple[NDArray[np.float64], float]:
    """Errors, as a share of the step from one grey to another, of the pixels between; and that of a step."""
    part = (many[..., 0] - low) / (high - low)
    edge = (part > 0.02) & (part < 0.98)
    assert edge.sum() > 60
    found = (image[..., 0].astype(float) - low) / (high - low)
    return np.abs(found - part)[edge], float(np.minimum(part, 1 - part)[edge].mean())


@pytest.mark.daily("45-distortion0")
@pytest.mark.parametrize("distortion", [(), BARREL])
@pytest.mark.parametrize("angle", [3, 17, 45])
def test_outlines_are_as_bright_as_they_cover_pixels(angle: float, distortion: tuple[float, ...]) -> None:
    camera = replace(along_x((160, 120), focal=150.0), distortion=distortion)
    black = replace(EVEN, background=(0, 0, 0))
    off, jagged = errors(*moving([square(angle)], camera, black), 0, 255)
    assert off.mean() < 0.3 * jagged, (off.mean(), jagged)


@pytest.mark.nightly
def test_surfaces_that_intersect_without_an_edge_have_a_smooth_line() -> None:
    level = quad([(2, -3, 0.6), (6, -3, 0.6), (6, 3, 0.6), (2, 3, 0.6)], (255, 255, 255))
    upright = quad([(3.5, -3, 0), (3.9, 3, 0), (3.9, 3, 2), (3.5, -3, 2)], (60, 60, 60))
    for distortion in ((), BARREL):
        camera = replace(along_x((160, 120), focal=150.0), distortion=distortion)
        image, many = moving([level, upright], camera)
        rows = slice(30, None)  # below the upper end of the upright
        off, jagged = errors(image[rows], many[rows], 60, 255)
        assert off.mean() < 0.3 * jagged, (off.mean(), jagged)


def test_edges_that_pass_the_camera_are_smooth() -> None:
    floor = quad([(-4, -0.3, 0.4), (9, -0.7, 0.4), (9, 0.8, 0.4), (-4, 0.2, 0.4)])
    off, jagged = errors(
        *moving([floor], along_x((160, 120), focal=150.0), replace(EVEN, background=(0, 0, 0))), 0, 255
    )
    assert off.mean() < 0.3 * jagged, (off.mean(), jagged)


def decibels(image: Image, reference: NDArray[np.float64]) -> float:
    """Peak signal-to-noise ratio."""
    return float(10 * np.log10(255**2 / ((image.astype(float) - reference) ** 2).mean()))


@pytest.mark.daily("distortion0")
@pytest.mark.parametrize("distortion", [(), BARREL])
def test_the_room_is_smooth_and_its_depth_is_that_of_a_still_camera(
    distortion: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene.load()
    camera = next(iter(scene.cameras.values()))
    camera = replace(camera, size=(320, 240), K=np.diag([0.5, 0.5, 1]) @ camera.K, distortion=distortion)
    renderer = renderer_or_skip(scene.static_meshes, Lighting())
    still = renderer.render([], camera, ("rgb", "depth"))
    passing = renderer.render([], camera, ("rgb", "depth"), moving_camera=True)
    monkeypatch.setattr(static_layers, "_OFFSETS", 1)
    fine = replace(finer(camera, FINE), distortion=distortion)
    many = block_means(renderer.render([], fine, ("rgb",)).rgb, FINE)
    renderer.close()
    monkeypatch.setattr(StaticEdges, "smooth", lambda *_: None)
    renderer = renderer_or_skip(scene.static_meshes, Lighting())
    jagged = renderer.render([], camera, ("rgb",), moving_camera=True)
    renderer.close()
    if not distortion:
        np.testing.assert_array_equal(passing.depth, still.depth)
    assert decibels(passing.rgb, many) > max(36, decibels(jagged.rgb, many) + 1.5)


@pytest.mark.daily("20-distortion1", "80-distortion0")
@pytest.mark.slow
@pytest.mark.parametrize("distortion", [(), BARREL])
@pytest.mark.parametrize("angle", [2, 20, 45, 80])
def test_surfaces_narrower_than_a_pixel_are_no_dashed_lines(
    angle: float, distortion: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = replace(along_x((160, 120), focal=150.0), distortion=distortion)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    half, x = 0.4 / 150 * 3 / 2, 3.0  # 0.4 pixels wide
    ends = [(0.9 * along, across) for along, across in ((1, half), (1, -half), (-1, -half), (-1, half))]
    pole = quad([(x, s * u - c * v + 0.003, c * u + s * v + 1) for u, v in ends])
    black = replace(EVEN, background=(0, 0, 0))
    image, many = moving([pole], camera, black)
    monkeypatch.setattr(StaticEdges, "smooth", lambda *_: None)
    jagged, _ = moving([pole], camera, black)
    inside = cv2.dilate((many[..., 0] > 0).astype(np.uint8), np.ones((3, 3))) > 0
    off, dashed = (np.abs(one[..., 0] - many[..., 0])[inside].mean() for one in (image, jagged))
    assert off < 0.35 * dashed, (off, dashed)
    assert abs(image.sum() / many.sum() - 1) < 0.2
