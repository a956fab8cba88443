"""Anti-aliasing of outlines, from the exact crossings of contour edges with pixels [Persson 2011].

The image has one sample per pixel. Where an outline crosses the line between two neighbouring pixel centers,
a share of one pixel belongs to the surface of the other. The share follows from the position and the slope of
the crossing, and that share of the other colour is blended in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.types import Array

#: Largest difference of depth, in metres, between an outline and its surface half a pixel inside.
_RIM = 0.1
#: The device rounds vertices to 1/256 of a pixel: an edge may pass a center on the other side than computed.
_SNAP = 1 / 128


@dataclass(frozen=True)
class EdgeCrossings:
    """Crossings of outlines between pixel centers: ``pixel`` gets ``share`` of the colour of ``neighbour``.

    All arrays are (N,); pixels are flat indices into the image. ``depth``: of the outline, metres.
    """

    pixel: NDArray[np.intp]
    neighbour: NDArray[np.intp]
    share: Array
    depth: Array


class ImageEdges(NamedTuple):
    """Straight edges in an image: columns, rows and depths (N,) of their starts and ends."""

    start: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
    end: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]

    @classmethod
    def of(cls, camera: Camera, starts: NDArray[np.floating], ends: NDArray[np.floating]) -> ImageEdges:
        """Project edges from ``starts`` to ``ends``, (N, 3) in ``map``, that the lens does not bend."""
        (p, near), (q, far) = camera.project(starts), camera.project(ends)
        good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
        (px, py), (qx, qy) = p[good].T, q[good].T
        return cls((px, py, near[good]), (qx, qy, far[good]))


def edge_crossings(edges: Sequence[ImageEdges], size: tuple[int, int]) -> EdgeCrossings:
    """Find the crossings of edges with columns and rows of pixel centers. ``size``: of the image, pixels."""
    (px, py, near), (qx, qy, far) = (
        [np.concatenate(values, dtype=float) for values in zip(*side, strict=True)]
        for side in zip(*edges, strict=True)
    )
    # columns, then rows: x is across the crossed line, y is along it
    width, height = size
    x0, x1 = np.concatenate([px, py]), np.concatenate([qx, qy])
    y0, y1 = np.concatenate([py, px]), np.concatenate([qy, qx])
    # 1 / z is linear along an edge in the image
    inverse0, inverse1 = 1 / np.concatenate([near, near]), 1 / np.concatenate([far, far])
    lines, pixels = (np.repeat(limit, len(px)) for limit in ((width, height), (height, width)))
    first, end = (
        np.minimum(np.maximum(np.ceil(x), 0), lines).astype(np.intp)
        for x in (np.minimum(x0, x1), np.maximum(x0, x1))
    )
    count = end - first
    edge = np.repeat(np.arange(len(count)), count)
    x = np.arange(len(edge)) + (first - np.cumsum(count) + count).take(edge)
    slope = ((y1 - y0) / np.where(count > 0, x1 - x0, 1)).take(edge)
    offset = x - x0.take(edge)
    y = y0.take(edge) + slope * offset
    depth = 1 / (
        inverse0.take(edge) + ((inverse1 - inverse0) / np.where(count > 0, x1 - x0, 1)).take(edge) * offset
    )
    centre = np.rint(y)
    side = np.where(y < centre, -1, 1)
    limit = pixels.take(edge)
    inside = np.flatnonzero(
        (np.minimum(centre, centre + side) >= 0) & (np.maximum(centre, centre + side) < limit)
    )
    x, y, depth, centre, side, limit, slope = (
        values.take(inside) for values in (x, y, depth, centre, side, limit, slope)
    )
    rows = edge.take(inside) >= len(px)
    along = np.where(rows, 1, width)
    nearer = x * np.where(rows, width, 1) + centre.astype(np.intp) * along
    farther = nearer + side * along
    slope = np.minimum(np.abs(slope), 1)  # steeper edges cross the lines of the other axis
    distance = np.abs(y - centre)
    both = np.flatnonzero(distance + slope / 2 > 0.5)
    # at a center, either neighbour may be on the other side of the edge
    tie = np.flatnonzero((distance < _SNAP) & (centre - side >= 0) & (centre - side < limit))
    return EdgeCrossings(
        np.concatenate([nearer, farther[both], nearer[tie]]),
        np.concatenate([farther, nearer[both], 2 * nearer[tie] - farther[tie]]),
        np.concatenate(
            [_share(distance, slope), _share(1 - distance[both], slope[both]), 0.5 - distance[tie]]
        ),
        np.concatenate([depth, depth[both], depth[tie]]),
    )


def _share(distance: Array, slope: Array) -> Array:
    """Share of a pixel, at most half, beyond an edge that crosses at a distance from its center."""
    # within the pixel the edge rises by the slope, and may leave the pixel
    corner = np.maximum(0.5 + slope / 2 - distance, 0)
    return np.where(distance + slope / 2 > 0.5, corner**2 / np.maximum(2 * slope, 1e-9), 0.5 - distance)


def blend(images: Sequence[NDArray[np.uint8]], depth: NDArray[np.float32], outline: EdgeCrossings) -> None:
    """Blend visible outlines into images (H, W) or (H, W, C) in place. ``depth``: (H, W) of the images."""
    z, z_neighbour = depth.ravel()[outline.pixel], depth.ravel()[outline.neighbour]
    # the surface in front is the outlined one, not an occluder; and another surface is behind it
    front, behind = np.minimum(z, z_neighbour), np.maximum(z, z_neighbour)
    visible = np.flatnonzero((np.abs(front - outline.depth) < _RIM) & (behind > outline.depth))
    # of several crossings in a pixel the largest share counts: on a slanted edge it is the right one of two
    order = visible[np.argsort(outline.share[visible], kind="stable")]
    pixel, neighbour = outline.pixel[order], outline.neighbour[order]
    share = outline.share[order, None].astype(np.float32)
    for image in images:
        flat = image.reshape(depth.size, -1)
        own = flat[pixel]
        flat[pixel] = np.rint(own + share * (flat[neighbour].astype(np.float32) - own)).astype(np.uint8)
