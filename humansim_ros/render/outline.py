"""Anti-aliasing where it shows: the outlines of bodies, blended by where exactly they cross a pixel.

The picture is drawn with one sample a pixel. Where an outline crosses the line between the centres of two
neighbouring pixels, it leaves each with a share of the other's surface, which follows from the place and the
slope of the crossing. This share is blended in (after E. Persson, Geometric Post-process Anti-Aliasing).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.rotations import Array

#: A surface that curves away is nearer than its outline by less than this, metres, half a pixel inside it.
_RIM = 0.1
#: Vertices are drawn on a grid of 1/256 pixel: an edge may pass a centre on the other side than computed.
_SNAP = 1 / 128


@dataclass(frozen=True)
class Crossings:
    """Where outlines cross between pixel centres: ``pixel`` takes ``share`` of the colour of ``neighbour``.

    All are (N,); pixels are flat indices into the image. ``depth``: metres of the outline there.
    """

    pixel: NDArray[np.intp]
    neighbour: NDArray[np.intp]
    share: Array
    depth: Array


def crossings(camera: Camera, starts: NDArray[np.floating], ends: NDArray[np.floating]) -> Crossings:
    """Where edges from ``starts`` to ``ends``, (N, 3) world, cross columns and rows of pixel centres.

    They are straight in the image: what a lens bends is to be cut into pieces before.
    """
    (p, near), (q, far) = camera.project(starts), camera.project(ends)
    good = np.isfinite(p[:, 0]) & np.isfinite(q[:, 0])
    # along an edge in the image 1 / z is what changes evenly
    p, q = np.column_stack([p[good], 1 / near[good]]), np.column_stack([q[good], 1 / far[good]])
    width, height = camera.size
    columns = _crossings(p, q, (width, height), (1, width))
    rows = _crossings(p[:, [1, 0, 2]], q[:, [1, 0, 2]], (height, width), (width, 1))
    return Crossings(*(np.concatenate(both) for both in zip(columns, rows, strict=True)))


def _crossings(
    p: Array, q: Array, size: tuple[int, int], stride: tuple[int, int]
) -> tuple[NDArray[Any], ...]:
    """Crossings of edges, (N, 3) of x, y and 1 / z, with the lines where x is a whole number."""
    low, high = np.minimum(p[:, 0], q[:, 0]), np.maximum(p[:, 0], q[:, 0])
    first, end = (np.clip(np.ceil(x), 0, size[0]).astype(np.intp) for x in (low, high))
    count = end - first
    edge = np.repeat(np.arange(len(p)), count)
    x = np.arange(len(edge)) + np.repeat(first - np.cumsum(count) + count, count)
    start, way = p[edge], q[edge] - p[edge]
    _, y, inverse = (start + way * ((x - start[:, 0]) / way[:, 0])[:, None]).T
    centre = np.rint(y)
    other = centre + np.where(y < centre, -1, 1)
    inside = np.flatnonzero((np.minimum(centre, other) >= 0) & (np.maximum(centre, other) < size[1]))
    x, y, inverse, centre, other = (values[inside] for values in (x, y, inverse, centre, other))
    nearer, farther = (x * stride[0] + row.astype(np.intp) * stride[1] for row in (centre, other))
    slope = np.minimum(
        np.abs(way[inside, 1] / way[inside, 0]), 1
    )  # what is steeper is found along the other axis
    distance, depth = np.abs(y - centre), 1 / inverse
    both = np.flatnonzero(distance + slope / 2 > 0.5)
    # right on a centre either neighbour may be the one on the other side
    tie = np.flatnonzero((distance < _SNAP) & (2 * centre - other >= 0) & (2 * centre - other < size[1]))
    return (
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


def blend(images: Sequence[NDArray[np.uint8]], depth: NDArray[np.float32], outline: Crossings) -> None:
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
