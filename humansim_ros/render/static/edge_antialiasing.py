"""Anti-aliasing of outlines, from the exact crossings of contour edges with pixels [Persson 2011].

The image has one sample per pixel. Where an outline crosses the line between two neighbouring pixel centers,
a share of one pixel belongs to the surface of the other. The position and the slope of the crossing give the
share. The colour of the other surface is blended in with this share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.types import Array, Float32Array

#: An outline and its surface half a pixel inside differ in depth by at most this, metres.
_RIM = 0.1
#: The device rounds vertices to 1/256 of a pixel, so that an edge may pass a center on the other side than
#: computed.
_SNAP = 1 / 128


@dataclass(frozen=True)
class EdgeCrossings:
    """Places where outlines pass between two pixel centers: ``pixel`` gets ``share`` of the colour of
    ``neighbour``. All arrays are (N,). Pixels are flat indices into the image. ``depth``: depth of the
    outline, metres. ``edge``: number of the edge."""

    pixel: NDArray[np.intp]
    neighbour: NDArray[np.intp]
    share: Array
    depth: Array
    edge: NDArray[np.intp]

    def __add__(self, other: EdgeCrossings) -> EdgeCrossings:
        """Return the crossings of both."""
        both = ([getattr(one, field.name) for one in (self, other)] for field in fields(self))
        return EdgeCrossings(*(np.concatenate(values) for values in both))

    def take(self, which: NDArray[Any]) -> EdgeCrossings:
        """Return the crossings that a mask (N,) or indices select."""
        return EdgeCrossings(*(getattr(self, one.name)[which] for one in fields(self)))


class ImageEdges(NamedTuple):
    """Straight edges in an image: columns, rows and depths (N,) of their starts and ends."""

    start: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
    end: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]

    @classmethod
    def of(cls, camera: Camera, starts: NDArray[np.floating], ends: NDArray[np.floating]) -> ImageEdges:
        """Project straight edges from ``starts`` to ``ends``, (N, 3) in ``map``. The lens must not bend
        them."""
        (p, near), (q, far) = camera.project(starts), camera.project(ends)
        good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
        (px, py), (qx, qy) = p[good].T, q[good].T
        return cls((px, py, near[good]), (qx, qy, far[good]))


def edge_crossings(edges: Sequence[ImageEdges], size: tuple[int, int]) -> EdgeCrossings:
    """Find where edges cross columns and rows of pixel centers. ``size``: width and height of the image."""
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
    x, y, depth, centre, side, limit, slope, edge = (
        values.take(inside) for values in (x, y, depth, centre, side, limit, slope, edge)
    )
    rows = edge >= len(px)
    edge = np.where(rows, edge - len(px), edge)
    along = np.where(rows, 1, width)
    nearer = x * np.where(rows, width, 1) + centre.astype(np.intp) * along
    farther = nearer + side * along
    slope = np.minimum(np.abs(slope), 1)  # a steeper edge crosses the lines of the other axis
    distance = np.abs(y - centre)
    both = np.flatnonzero(distance + slope / 2 > 0.5)
    # where an edge passes through a center, either neighbour may be on the other side
    tie = np.flatnonzero((distance < _SNAP) & (centre - side >= 0) & (centre - side < limit))
    return EdgeCrossings(
        np.concatenate([nearer, farther[both], nearer[tie]]),
        np.concatenate([farther, nearer[both], 2 * nearer[tie] - farther[tie]]),
        np.concatenate(
            [
                share_beyond(distance, slope),
                share_beyond(1 - distance[both], slope[both]),
                0.5 - distance[tie],
            ]
        ),
        np.concatenate([depth, depth[both], depth[tie]]),
        np.concatenate([edge, edge[both], edge[tie]]),
    )


def share_beyond(distance: Array, slope: Array) -> Array:
    """Share of a pixel (at most half) beyond an edge. ``distance``: (N,) pixels from the center of the pixel
    to the crossing. ``slope``: (N,) change of the distance per pixel across, 0 to 1."""
    # the edge rises by the slope within the pixel, so that it may leave the pixel
    corner = np.maximum(0.5 + slope / 2 - distance, 0)
    return np.where(distance + slope / 2 > 0.5, corner**2 / np.maximum(2 * slope, 1e-9), 0.5 - distance)


def blend(
    images: Sequence[NDArray[np.uint8]], z: Float32Array, z_neighbour: Float32Array, outline: EdgeCrossings
) -> None:
    """Blend visible outlines into images in place.

    Args:
        images: (H, W) or (H, W, C).
        z: Depth (N,) of the pixels of the crossings.
        z_neighbour: Depth (N,) of their neighbours.
        outline: The N crossings.
    """
    # the nearer surface must be the outlined one, not an occluder, and another surface must be behind it
    front, behind = np.minimum(z, z_neighbour), np.maximum(z, z_neighbour)
    visible = np.flatnonzero((np.abs(front - outline.depth) < _RIM) & (behind > outline.depth))
    # the largest share in a pixel counts: a slanted edge crosses two lines, and the larger share is right
    order = visible[np.argsort(outline.share[visible], kind="stable")]
    pixel, neighbour = outline.pixel[order], outline.neighbour[order]
    share = outline.share[order, None].astype(np.float32)
    for image in images:
        flat = image.reshape(image.shape[0] * image.shape[1], -1)
        own = flat[pixel]
        flat[pixel] = np.rint(own + share * (flat[neighbour].astype(np.float32) - own)).astype(np.uint8)


def mix(image: NDArray[np.uint8], crossings: EdgeCrossings) -> None:
    """Blend colours across edges in an image (H, W, C), in place. A pixel may lie between two edges of a
    narrow surface. Then both opposite neighbours are blended in."""
    height, width = image.shape[:2]
    mark = np.zeros(height * width, bool)
    mark[crossings.pixel] = True
    pixels = np.flatnonzero(mark)
    place = np.searchsorted(pixels, crossings.pixel)
    steps = np.array([1, -1, width, -width])
    which = (crossings.neighbour - crossings.pixel)[:, None] == steps
    order = np.argsort(crossings.share)
    shares = np.zeros((4, len(pixels)), np.float32)
    # the last assignment remains: that of the largest share
    shares[which.argmax(axis=1)[order], place[order]] = crossings.share[order]
    # a slanted edge crosses lines of both axes: the axis of the larger share is the right one
    across = shares[:2].max(axis=0) >= shares[2:].max(axis=0)
    shares *= [across, across, ~across, ~across]
    flat = image.reshape(height * width, -1)
    mixed = flat[pixels] * (1 - shares.sum(axis=0))[:, None]
    for share, step in zip(shares, steps, strict=True):
        used = np.flatnonzero(share)
        mixed[used] += share[used, None] * flat[pixels[used] + step]
    flat[pixels] = np.rint(mixed).astype(np.uint8)
