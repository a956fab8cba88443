"""Boxes round humans and objects in an image: of what is seen of them, and of the whole body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.render.lens_tessellation import nearest
from humansim_ros.render.renderer import Kind
from humansim_ros.types import Array


@dataclass(frozen=True)
class BodyBox:
    """A human or labelled object in an image. Boxes are (4,): left, top, right, bottom, in pixels.

    ``visible``: round the areas of the pixels that show it, so that one pixel (x, y) has the box x - 0.5, y -
    0.5, x + 0.5, y + 0.5; NaN where none does. ``whole``: round the projection of the whole body, also
    outside the image and behind other things; NaN where nothing of the body is before the camera.
    ``truncation``: share of the whole box's area that is outside the image, 0 to 1; 1 where nothing of the
    body is before the camera. ``visible_fraction``: pixels that show it, of those that would if nothing hid
    it (of the image only); NaN where none would. ``pixels``: how many show it. ``kind``: what it is.
    """

    visible: Array
    whole: Array
    truncation: float
    visible_fraction: float
    pixels: int
    kind: Kind = "human"


def view_boxes(camera: Camera, bodies: Sequence[Body], view: View) -> dict[int, BodyBox]:
    """The boxes of every labelled body, by instance, seen by a camera whose ``view`` has instance labels and
    amodal masks.
    """
    assert view.instance is not None and view.amodal is not None
    boxes = {}
    for body in bodies:
        if not body.instance:
            continue
        visible, pixels = _box_of(view.instance == body.instance)
        there = np.count_nonzero(view.amodal[body.instance])
        whole = whole_box(camera, body)
        boxes[body.instance] = BodyBox(
            visible,
            whole,
            truncation(whole, camera.size),
            pixels / there if there else np.nan,
            pixels,
            body.kind,
        )
    return boxes


def whole_box(camera: Camera, body: Body) -> Array:
    """(4,) left, top, right, bottom of the projection of all of a body that a camera could draw: what is not
    too near (5 cm along its axis, 5 mm for wide fisheyes) and within what its lens sees. NaN where that is
    nothing.
    """
    points, plane = camera.to_optical(body.vertices), nearest(camera)
    near = points[:, 2] < plane
    if near.any():
        points = np.concatenate([points[~near], _crossings(points, body.mesh.triangles, plane)])
    pixels = camera.project_optical(points)[0]
    pixels = pixels[np.isfinite(pixels[:, 0])]
    if not len(pixels):
        return np.full(4, np.nan)
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def truncation(whole: Array, size: tuple[int, int]) -> float:
    """Share of the area of a box that is outside an image of a size (width, height): what KITTI calls
    truncated (Geiger et al. 2012: how far an object leaves the image's boundaries).
    """
    if not np.isfinite(whole).all():
        return 1.0
    inside = np.clip(whole.reshape(2, 2), -0.5, np.array(size) - 0.5)
    sides = whole[2:] - whole[:2]
    # of a side without length, none is lost
    kept = np.divide(inside[1] - inside[0], sides, out=np.ones(2), where=sides > 0)
    return float(np.clip(1 - kept.prod(), 0, 1))


def _box_of(mask: NDArray[np.bool_]) -> tuple[Array, int]:
    """(4,) box round the pixels of a mask (H, W), NaN where there are none; and how many there are."""
    image = mask.view(np.uint8)
    pixels = cv2.countNonZero(image)
    if not pixels:
        return np.full(4, np.nan), 0
    x, y, width, height = cv2.boundingRect(image)
    return np.array([x, y, x + width, y + height]) - 0.5, pixels


def _crossings(points: Array, triangles: NDArray[np.integer], plane: float) -> Array:
    """(N, 3) where the edges of triangles pass through the plane z = ``plane``."""
    edges, near = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), points[:, 2] < plane
    a, b = points[edges[near[edges[:, 0]] != near[edges[:, 1]]].T]
    share = (plane - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.asarray(a + share[:, None] * (b - a), dtype=float)
