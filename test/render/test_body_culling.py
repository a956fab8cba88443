"""Triangles and bodies that are not drawn leave no trace in the image."""

from __future__ import annotations

import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render.body_buffers import ProjectedPoints

SIZE = (32, 24)
CAMERA = Camera(SIZE, np.array([[20.0, 0, 15.5], [0, 20.0, 11.5], [0, 0, 1]]), np.eye(3), np.zeros(3))


def seen(pixels: np.ndarray, depth: float = 2.0) -> ProjectedPoints:
    """Projection of points that are at pixels (N, 2), at a depth."""
    rays = (pixels - CAMERA.K[:2, 2]) / CAMERA.K[0, 0]
    points = depth * np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return ProjectedPoints(np.ascontiguousarray(points.T, dtype=np.float32), CAMERA)


def test_every_triangle_that_covers_a_pixel_center_is_drawn_and_few_others() -> None:
    rng = np.random.default_rng(3)
    middles = rng.uniform((-4, -4), (36, 28), (4000, 1, 2))
    corners = middles + rng.uniform(-1, 1, (4000, 3, 2)) * rng.choice([0.2, 1.0, 3.0], (4000, 1, 1))
    centers = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 2)
    a, b, c = (corners[:, None, i] - centers for i in range(3))
    sides = [p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0] for p, q in ((a, b), (b, c), (c, a))]
    covers = (np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)).any(axis=1)
    number = np.arange(12000).reshape(-1, 3)
    drawn = seen(corners.reshape(-1, 2)).covering([number[:, i] for i in range(3)])
    assert drawn[covers].all()
    low, high = corners.min(axis=1), corners.max(axis=1)
    inside = (np.ceil(np.maximum(low, 0)) <= np.floor(np.minimum(high, np.array(SIZE) - 1))).all(axis=1)
    assert np.mean(drawn & ~inside) < 0.02  # within 1/64 of a pixel of a center
    assert 0.2 < covers.mean() < 0.5


def test_triangle_on_a_pixel_center_is_drawn() -> None:
    corners = np.array([[5.0, 5.0], [5.001, 5.0], [5.0, 5.001]])
    assert seen(corners).covering([np.array([i]) for i in range(3)]).all()
    assert not seen(corners + 0.5).covering([np.array([i]) for i in range(3)]).any()


def test_body_is_hidden_outside_the_image_and_behind_everything() -> None:
    box = np.array([[8.0, 6], [14, 6], [14, 12], [8, 12]])
    near, far = np.full(SIZE[::-1], 1.9, np.float32), np.full(SIZE[::-1], np.inf, np.float32)
    assert seen(box).is_hidden(near)
    assert not seen(box).is_hidden(far)
    assert not seen(box, 1.8).is_hidden(near)
    assert seen(box + 40).is_hidden(far)
    assert not seen(box + np.array([24, 0])).is_hidden(far)  # its corner is the last column
    peephole = near.copy()
    peephole[9, 11] = 5.0
    assert not seen(box).is_hidden(peephole)
