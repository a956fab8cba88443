"""Bounding boxes of humans and objects in an image: of their visible pixels, and of the whole body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.render.lens_tessellation import near_plane
from humansim_ros.render.renderer import Kind
from humansim_ros.types import Array


@dataclass(frozen=True)
class BodyBox:
    """Boxes of a human or labelled object in an image. A box is (4,): left, top, right, bottom, in pixels.

    Attributes:
        visible: Box of the visible pixels, areas included: one pixel (x, y) has x - 0.5, y - 0.5, x + 0.5,
            y + 0.5. NaN without visible pixels.
        whole: Box of the projection of the whole body, also outside the image and behind occluders. NaN if
            nothing of the body is in front of the camera.
        truncation: Share of the area of the whole box outside the image, 0 to 1; 1 if there is no whole box.
        visible_fraction: Visible pixels as a share of the amodal mask; NaN if the mask is empty.
        pixels: Number of visible pixels.
        kind: Human or object.
    """

    visible: Array
    whole: Array
    truncation: float
    visible_fraction: float
    pixels: int
    kind: Kind = "human"


def view_boxes(camera: Camera, bodies: Sequence[Body], view: View) -> dict[int, BodyBox]:
    """Compute the boxes of all labelled bodies by instance label.

    ``view`` must have the channels instance and amodal.
    """
    boxes = {}
    for body in bodies:
        if not body.instance:
            continue
        visible, pixels = _box_of(view.instance == body.instance)
        amodal = np.count_nonzero(view.amodal[body.instance])
        whole = whole_box(camera, body)
        boxes[body.instance] = BodyBox(
            visible,
            whole,
            truncation(whole, camera.size),
            pixels / amodal if amodal else np.nan,
            pixels,
            body.kind,
        )
    return boxes


def whole_box(camera: Camera, body: Body) -> Array:
    """Box (4,) of the projection of a whole body, also of its occluded parts; NaN if nothing is projected.

    The body is cut at the near plane of the renderer (5 cm along the axis, 5 mm for wide fisheyes). Points
    outside the field of view of the lens are left out.
    """
    points, plane = camera.to_optical(body.vertices), near_plane(camera)
    near = points[:, 2] < plane
    if near.any():
        points = np.concatenate([points[~near], _crossings(points, body.mesh.triangles, plane)])
    pixels = camera.project_optical(points)[0]
    pixels = pixels[np.isfinite(pixels[:, 0])]
    if not len(pixels):
        return np.full(4, np.nan)
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def truncation(whole: Array, size: tuple[int, int]) -> float:
    """Share of the area of a box outside an image of a size (width, height), as "truncated" in KITTI
    [Geiger 2012].
    """
    if not np.isfinite(whole).all():
        return 1.0
    inside = np.clip(whole.reshape(2, 2), -0.5, np.array(size) - 0.5)
    sides = whole[2:] - whole[:2]
    # a side without length is not truncated
    shares = np.divide(inside[1] - inside[0], sides, out=np.ones(2), where=sides > 0)
    return float(np.clip(1 - shares.prod(), 0, 1))


def _box_of(mask: NDArray[np.bool_]) -> tuple[Array, int]:
    """Box (4,) and number of the pixels of a mask (H, W); the box is NaN without pixels."""
    image = mask.view(np.uint8)
    pixels = cv2.countNonZero(image)
    if not pixels:
        return np.full(4, np.nan), 0
    x, y, width, height = cv2.boundingRect(image)
    return np.array([x, y, x + width, y + height]) - 0.5, pixels


def _crossings(points: Array, triangles: NDArray[np.integer], plane: float) -> Array:
    """Intersections (N, 3) of the edges of triangles with the plane z = ``plane``."""
    edges, near = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), points[:, 2] < plane
    a, b = points[edges[near[edges[:, 0]] != near[edges[:, 1]]].T]
    share = (plane - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.asarray(a + share[:, None] * (b - a), dtype=float)
