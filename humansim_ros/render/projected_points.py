"""Projected vertices of a body: the pixels that it may cover, and its contour in the image."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.edge_antialiasing import ImageEdges
from humansim_ros.render.lens_tessellation import NEAR, LensView
from humansim_ros.render.posed_mesh import PosedMesh
from humansim_ros.render.target import Rectangle
from humansim_ros.types import Array, Float32Array

#: Pixels of tolerance when a triangle is tested for pixel centers: projections are in single precision, and
#: the device rounds them to 1/256 of a pixel.
_ROUNDING = np.float32(1 / 64)


class ProjectedPoints:
    """Projections of world points (3, N) into a camera.

    ``near``: some points are so near that the camera may be inside their surface; ``behind``: all points are
    behind the camera. ``plane``: two of (N,): columns and rows; x and y of the normalised image plane if the
    lens distorts; not valid if ``near``.
    """

    def __init__(self, points: Float32Array, camera: Camera) -> None:
        self.camera = camera
        p = (camera.optical_from_world[:3] if camera.distorted else camera.P).astype(np.float32)
        x, y, self.depth = p[:, :3] @ points + p[:, 3:]
        self.near, self.behind = bool(self.depth.min() < 2 * NEAR), bool(self.depth.max() < 0)
        if not self.near:
            x /= self.depth
            y /= self.depth
        self.plane = x, y

    @cached_property
    def pixels(self) -> tuple[Float32Array, Float32Array]:
        """Columns and rows (N,); NaN beyond the field of view of the lens."""
        camera = self.camera
        if not camera.distorted:
            return self.plane
        x, y = camera.K[:2, :2] @ camera.lens.distort(np.stack(self.plane, axis=1)).T + camera.K[:2, 2:]
        return x.astype(np.float32), y.astype(np.float32)

    def covering(self, corners: Sequence[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """(M,) whether each triangle may cover a pixel center; ``corners``: its vertices, three of (M,).

        The other triangles, half of those of a human, leave no trace in the image.
        """
        covering: NDArray[np.bool_] = np.ones(len(corners[0]), bool)
        for positions in self.pixels:
            a, b, c = (positions.take(corner) for corner in corners)
            low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
            covering &= ~(np.floor(high + _ROUNDING) < np.ceil(low - _ROUNDING))  # true for NaN
        return covering


def image_bounds(clouds: Sequence[ProjectedPoints], camera: Camera) -> Rectangle:
    """Return the pixels that surfaces between the points may touch: the whole image if one is near."""
    width, height = camera.size
    low: Array = np.full(2, np.inf)
    high: Array = np.full(2, -np.inf)
    for cloud in clouds:
        if cloud.behind:
            continue
        if cloud.near:
            return Rectangle(0, 0, width, height, near=True)
        low = np.minimum(low, [axis.min() for axis in cloud.plane])
        high = np.maximum(high, [axis.max() for axis in cloud.plane])
    if camera.distorted:
        low, high = LensView(camera).image_of(low, high)
    if not np.isfinite(low).all():
        return Rectangle(0, 0, 0, 0)
    x0, y0 = np.clip(np.floor(low) - 2, 0, camera.size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 3, 0, camera.size).astype(int)
    return Rectangle(int(x0), int(y0), int(x1), int(y1))


def straight_angle(camera: Camera, rectangle: Rectangle) -> float:
    """Return the angle (radians) below which edges are visibly straight within a rectangle."""
    return LensView(camera).straight_angle(rectangle.low, rectangle.high) if camera.distorted else 0.0


def contour(
    posed: PosedMesh, projected: ProjectedPoints, facing: NDArray[np.bool_], angle: float
) -> list[ImageEdges]:
    """Return the contour edges of a body in the image.

    Args:
        posed: The body.
        projected: Its projected vertices.
        facing: (N,) whether each triangle shows its front to the camera.
        angle: See :func:`straight_angle`.
    """
    starts, ends = posed.contour(facing)
    camera, vertices = projected.camera, posed.vertices
    bent: NDArray[np.bool_] = np.zeros(len(starts), bool)
    if camera.distorted:
        bent = wider_than(angle, vertices.take(starts, axis=0), vertices.take(ends, axis=0), camera)
    edges = []
    if bent.any():
        pieces = LensView(camera).divide_edges(vertices[starts[bent]], vertices[ends[bent]])
        edges.append(ImageEdges.of(camera, *pieces))
        starts, ends = starts[~bent], ends[~bent]
    if projected.near:
        edges.append(ImageEdges.of(camera, vertices.take(starts, axis=0), vertices.take(ends, axis=0)))
        return edges
    (x, y), z = projected.pixels, projected.depth
    if camera.distorted:
        finite = np.isfinite(x.take(starts)) & np.isfinite(x.take(ends))
        starts, ends = starts[finite], ends[finite]
    edges.append(ImageEdges(*((x.take(which), y.take(which), z.take(which)) for which in (starts, ends))))
    return edges


def wider_than(angle: float, starts: Float32Array, ends: Float32Array, camera: Camera) -> NDArray[np.bool_]:
    """Find edges that may span more than an angle, seen from a camera.

    Args:
        angle: Radians.
        starts, ends: Ends of the edges, (N, 3) metres in ``map``.
        camera: Camera that sees them.

    Returns:
        (N,) mask.
    """
    eye = camera.center.astype(np.float32)
    nearest = np.minimum(_squares(starts - eye), _squares(ends - eye))
    return np.asarray(_squares(ends - starts) > angle * angle * nearest)


def _squares(vectors: Float32Array) -> Float32Array:
    """(N,) squared lengths."""
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))
