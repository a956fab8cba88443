"""Anti-aliasing where it shows: the outlines of bodies, blended by where exactly they cross a pixel.

The picture is drawn with one sample a pixel. An outline that crosses the line between the centres of two
neighbouring pixels leaves the one whose centre is nearer with a share of the other's surface: 0.5 less the
distance from the crossing to that centre. This share is blended in (E. Persson, Geometric Post-process
Anti-Aliasing, 2011).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.rotations import Array

#: A surface that curves away is nearer than its outline by less than this, metres, half a pixel inside it.
_RIM = 0.1


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
    """Where edges from ``starts`` to ``ends``, (N, 3) world, cross columns and rows of pixel centres."""
    (p, near), (q, far) = camera.project(starts), camera.project(ends)
    good = (near > 0) & (far > 0)
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
    pixel, neighbour = (x * stride[0] + row.astype(np.intp) * stride[1] for row in (centre, other))
    return pixel, neighbour, 0.5 - np.abs(y - centre), 1 / inverse


def blend(image: NDArray[np.uint8], depth: NDArray[np.float32], outline: Crossings) -> None:
    """Blend the outlines that are seen into an image (H, W, 3) with its depth (H, W), in place."""
    z, z_neighbour = depth.ravel()[outline.pixel], depth.ravel()[outline.neighbour]
    # what lies in front is the outlined surface, not something that hides it; and something lies behind
    front, behind = np.minimum(z, z_neighbour), np.maximum(z, z_neighbour)
    seen = np.flatnonzero((front > outline.depth - _RIM) & (behind > outline.depth))
    # where outlines share a pixel the largest share counts: along a slanted edge it is the right one of two
    order = seen[np.argsort(outline.share[seen], kind="stable")]
    pixel, share = outline.pixel[order], outline.share[order, None].astype(np.float32)
    flat = image.reshape(-1, 3)
    own = flat[pixel]
    flat[pixel] = np.rint(own + share * (flat[outline.neighbour[order]].astype(np.float32) - own)).astype(
        np.uint8
    )
