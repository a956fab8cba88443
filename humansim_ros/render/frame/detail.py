"""Levels of detail of bodies: choose those that look like the whole mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Simplification
from humansim_ros.render.device.lens_tessellation import NEAR
from humansim_ros.types import Array, FloatArray

#: Largest error of the surface of a level, pixels.
LARGEST_ERROR = 0.1
#: A level with more than this share of all vertices saves no time.
LARGEST_SHARE = 0.25
#: Metres by which points are moved, to measure how far they move in the image.
_STEP = 1e-3
#: Corners of a box.
_CORNERS = np.stack(np.meshgrid(*[(0, 1)] * 3), axis=-1).reshape(8, 3)


def coarsest(levels: Sequence[Simplification | None], boxes: FloatArray, camera: Camera) -> tuple[int, ...]:
    """Choose the coarsest level of each body with an error below a tenth of a pixel. ``levels``: levels of
    each body; None if there is only the whole mesh. ``boxes``: lowest and highest corner of each body, (M, 2,
    3) metres in ``map``."""
    scales = pixels_per_metre(boxes, camera)
    return tuple(
        0 if known is None else int(np.searchsorted(known.errors, LARGEST_ERROR / scale, side="right")) - 1
        for known, scale in zip(levels, scales.tolist(), strict=True)
    )


def pays(levels: Sequence[Simplification | None], chosen: Sequence[int]) -> bool:
    """Whether levels of detail save time, although labels need the whole meshes too."""
    known = [(each.counts, number) for each, number in zip(levels, chosen, strict=True) if each is not None]
    return sum(counts[number] for counts, number in known) < LARGEST_SHARE * sum(
        counts[0] for counts, _ in known
    )


def pixels_per_metre(boxes: FloatArray, camera: Camera) -> Array:
    """Largest number of pixels that a metre in any direction has within each box (M, 2, 3). It is infinite
    near the camera and beyond the lens."""
    corners = np.where(_CORNERS == 0, boxes[:, None, 0], boxes[:, None, 1])
    moved = corners[..., None, :] + _STEP * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    pixels, depth = camera.project(moved.reshape(-1, 3))
    at, *others = np.moveaxis(pixels.reshape(*moved.shape[:-1], 2), 2, 0)
    # the largest singular value of the derivatives (2 x 3)
    x, y = np.moveaxis((np.stack(others) - at) / _STEP, -1, 0)
    xx, yy, xy = (x * x).sum(axis=0), (y * y).sum(axis=0), (x * y).sum(axis=0)
    scales = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    unknown = np.isnan(scales) | (depth.reshape(moved.shape[:-1])[..., 0] < 2 * NEAR)
    return np.asarray(np.where(unknown, np.inf, scales).max(axis=1))
