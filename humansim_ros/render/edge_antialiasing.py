"""Anti-aliasing where it shows: the outlines of bodies, blended by where exactly they cross a pixel.

The picture is drawn with one sample a pixel. Where an outline crosses the line between the centres of two
neighbouring pixels, it leaves each with a share of the other's surface, which follows from the place and the
slope of the crossing. This share is blended in (after E. Persson, Geometric Post-process Anti-Aliasing).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.types import Array

#: A surface that curves away is nearer than its outline by less than this, metres, half a pixel inside it.
_RIM = 0.1
#: Vertices are drawn on a grid of 1/256 pixel: an edge may pass a centre on the other side than computed.
_SNAP = 1 / 128


@dataclass(frozen=True)
class EdgeCrossings:
    """Where outlines cross between pixel centres: ``pixel`` takes ``share`` of the colour of ``neighbour``.

    All are (N,); pixels are flat indices into the image. ``depth``: metres of the outline there.
    """

    pixel: NDArray[np.intp]
    neighbour: NDArray[np.intp]
    share: Array
    depth: Array


class ImageEdges(NamedTuple):
    """Edges that are straight in an image: columns, rows and depths (N,) of their starts and ends."""

    start: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
    end: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]

    @classmethod
    def of(cls, camera: Camera, starts: NDArray[np.floating], ends: NDArray[np.floating]) -> ImageEdges:
        """Edges from ``starts`` to ``ends``, (N, 3) world, that a camera sees; those that the lens bends cut
        to pieces before.
        """
        (p, near), (q, far) = camera.project(starts), camera.project(ends)
        good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
        (px, py), (qx, qy) = p[good].T, q[good].T
        return cls((px, py, near[good]), (qx, qy, far[good]))


def edge_crossings(edges: Sequence[ImageEdges], size: tuple[int, int]) -> EdgeCrossings:
    """Where edges cross columns and rows of pixel centres of an image of a width and a height."""
    (px, py, near), (qx, qy, far) = (
        [np.concatenate(values, dtype=float) for values in zip(*side, strict=True)]
        for side in zip(*edges, strict=True)
    )
    # columns, then rows: x is the coordinate of the line that is crossed, y goes along it
    width, height = size
    x0, x1 = np.concatenate([px, py]), np.concatenate([qx, qy])
    y0, y1 = np.concatenate([py, px]), np.concatenate([qy, qx])
    # along an edge in the image 1 / z is what changes evenly
    inverse0, inverse1 = 1 / np.concatenate([near, near]), 1 / np.concatenate([far, far])
    lines, places = (np.repeat(limit, len(px)) for limit in ((width, height), (height, width)))
    first, end = (
        np.minimum(np.maximum(np.ceil(x), 0), lines).astype(np.intp)
        for x in (np.minimum(x0, x1), np.maximum(x0, x1))
    )
    count = end - first
    edge = np.repeat(np.arange(len(count)), count)
    x = np.arange(len(edge)) + (first - np.cumsum(count) + count).take(edge)
    slope = ((y1 - y0) / np.where(count > 0, x1 - x0, 1)).take(edge)
    way = x - x0.take(edge)
    y = y0.take(edge) + slope * way
    depth = 1 / (
        inverse0.take(edge) + ((inverse1 - inverse0) / np.where(count > 0, x1 - x0, 1)).take(edge) * way
    )
    centre = np.rint(y)
    side = np.where(y < centre, -1, 1)
    limit = places.take(edge)
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
    slope = np.minimum(np.abs(slope), 1)  # what is steeper is found along the other axis
    distance = np.abs(y - centre)
    both = np.flatnonzero(distance + slope / 2 > 0.5)
    # right on a centre either neighbour may be the one on the other side
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
    """How much of a pixel lies beyond an edge that crosses at a distance from its centre; at most half."""
    # over the pixel's width the edge goes up and down by half the slope, and may leave the pixel
    corner = np.maximum(0.5 + slope / 2 - distance, 0)
    return np.where(distance + slope / 2 > 0.5, corner**2 / np.maximum(2 * slope, 1e-9), 0.5 - distance)


def blend(images: Sequence[NDArray[np.uint8]], depth: NDArray[np.float32], outline: EdgeCrossings) -> None:
    """Blend the outlines that are seen into images (H, W) or (H, W, C) with their depth (H, W), in place."""
    z, z_neighbour = depth.ravel()[outline.pixel], depth.ravel()[outline.neighbour]
    # what lies in front is the outlined surface, not something that hides it; and something lies behind
    front, behind = np.minimum(z, z_neighbour), np.maximum(z, z_neighbour)
    seen = np.flatnonzero((np.abs(front - outline.depth) < _RIM) & (behind > outline.depth))
    # where outlines share a pixel the largest share counts: along a slanted edge it is the right one of two
    order = seen[np.argsort(outline.share[seen], kind="stable")]
    pixel, neighbour = outline.pixel[order], outline.neighbour[order]
    share = outline.share[order, None].astype(np.float32)
    for image in images:
        flat = image.reshape(depth.size, -1)
        own = flat[pixel]
        flat[pixel] = np.rint(own + share * (flat[neighbour].astype(np.float32) - own)).astype(np.uint8)
