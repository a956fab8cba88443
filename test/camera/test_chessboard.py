"""Calibration by OpenCV from rendered images of a chessboard."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from chessboard import BARREL, CORNERS, VIEWS, Floats, assert_finds, board, calibrate, found, held_up
from render_scenes import EVEN, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.render import Body

MODELS = {
    "plumb_bob": (520.0, BARREL),
    "rational_polynomial": (
        520.0,
        (0.189544, -0.018229, -0.00063, 0.000054, -0.000212, 0.543582, -0.027892, 0.0),
    ),
    "equidistant": (300.0, (-0.013, 0.021, -0.0031, 0.0004)),
}


@pytest.mark.daily("equidistant")
@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_calibration_with_a_rendered_chessboard_recovers_the_lens(model: str) -> None:
    focal, distortion = MODELS[model]
    k = np.array([[focal, 0, 301.4], [0, 0.97 * focal, 252.9], [0, 0, 1]])
    camera = Camera((640, 480), k, np.eye(3), np.zeros(3), distortion, model)
    renderer, mesh, rng = renderer_or_skip(lighting=EVEN), board(), np.random.default_rng(5)
    views: list[Floats] = []
    errors: list[Floats] = []
    for _ in range(2 * VIEWS):
        rotation, middle = held_up(camera, rng)
        vertices = (rotation.apply(mesh.vertices) + middle).astype(np.float32)
        picture = renderer.render([Body(mesh, vertices, np.zeros(2, np.uint8), 0)], camera, ["rgb"]).rgb
        corners = found(picture[..., 0])
        if corners is not None:
            views.append(corners)
            errors.append(corners - camera.project(rotation.apply(CORNERS) + middle)[0])
        if len(views) == VIEWS:
            break
    renderer.close()
    assert len(views) == VIEWS
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.01, "corners are where they should be"

    result = calibrate(CORNERS, views, camera.size, model)
    assert_finds(result, k)
    # other coefficients of a rational function can describe the same lens
    if model != "rational_polynomial":
        np.testing.assert_allclose(result.D, distortion, atol=0.01)
    # in the area of the board, the distortion is the same
    pixels = np.concatenate(views)
    rays = camera.rays(pixels)[:, None]
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    again = project(rays, np.zeros(3), np.zeros(3), result.K, result.D)[0].reshape(-1, 2)
    off = np.linalg.norm(again - pixels, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.1
    assert off.max() < 0.5
