"""Anti-aliasing where it shows: the outlines of bodies, blended by the exact place at which they cross a pixel.

The picture is drawn with one sample a pixel. An outline that crosses the line between the centres of two neighbouring pixels
leaves one of the two with a share of the other's surface: 0.5 less the distance from the crossing to its centre. That
share is blended in. (E. Persson, Geometric Post-process Anti-Aliasing, 2011; there per edge on the GPU.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.rotations import Array

#: A surface that curves away is nearer than its outline by less than this, metres, half a pixel inside it.
_RIM = 0.1


@dataclass(frozen=True)
class Crossings:
    """Where outlines cross between pixel centres: ``pixel`` (N,) takes ``share`` (N,) of the colour of ``neighbour`` (N,).

    Both are flat indices into the image. ``depth``: (N,) metres of the outline there.
    """

    pixel: NDArray[np.intp]
    neighbour: NDArray[np.intp]
    share: Array
    depth: Array


def crossings(camera: Camera, starts: NDArray[np.floating], ends: NDArray[np.floating]) -> Crossings:
    """Crossings of edges from ``starts`` to ``ends``, (N, 3) world, with the columns and rows of pixel centres."""
    width, height = camera.size
    (p, near), (q, far) = camera.project(starts), camera.project(ends)
    good = (near > 0) & (far > 0)
    p, q, near, far = p[good], q[good], 1 / near[good], 1 / far[good]
    found = []
    for axis, step, limit in ((0, width, height), (1, 1, width)):
        # axis: the coordinate that is a whole number at the crossing; the neighbour lies along the other
        low, high = np.minimum(p[:, axis], q[:, axis]), np.maximum(p[:, axis], q[:, axis])
        side = camera.size[axis]
        first = np.clip(np.ceil(low), 0, side).astype(np.intp)
        count = np.clip(np.ceil(high), 0, side).astype(np.intp) - first
        edge = np.repeat(np.arange(len(p)), count)
        line = np.arange(len(edge)) + np.repeat(first - np.cumsum(count) + count, count)
        along = (line - p[edge, axis]) / (q[edge, axis] - p[edge, axis])
        place = p[edge, 1 - axis] + along * (q[edge, 1 - axis] - p[edge, 1 - axis])
        centre = np.rint(np.clip(place, -2, limit + 2)).astype(np.intp)
        offset = place - centre
        other = centre + np.where(offset < 0, -1, 1)
        inside = (np.minimum(centre, other) >= 0) & (np.maximum(centre, other) < limit)
        edge, line, centre, other, offset, along = (
            v[inside] for v in (edge, line, centre, other, offset, along)
        )
        across = width + 1 - step  # from one line to the next
        depth = 1 / (near[edge] + along * (far[edge] - near[edge]))
        found.append(
            (line * across + centre * step, line * across + other * step, 0.5 - np.abs(offset), depth)
        )
    pixel, neighbour, share, depth = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Crossings(pixel, neighbour, share, depth)


def blend(image: NDArray[np.uint8], depth: NDArray[np.float32], outline: Crossings) -> None:
    """Blend the outlines that are seen into an image (H, W, 3) with its depth (H, W), in place."""
    z, z_neighbour = depth.ravel()[outline.pixel], depth.ravel()[outline.neighbour]
    # what lies in front is the outlined surface itself, not something that hides it; and something lies behind
    seen = (np.minimum(z, z_neighbour) > outline.depth - _RIM) & (np.maximum(z, z_neighbour) > outline.depth)
    seen = np.flatnonzero(seen)
    # where outlines share a pixel the largest share counts: along a slanted edge it is the right one of two
    order = seen[np.argsort(outline.share[seen], kind="stable")]
    pixel, share = outline.pixel[order], outline.share[order, None].astype(np.float32)
    flat = image.reshape(-1, 3)
    own = flat[pixel]
    flat[pixel] = np.rint(own + share * (flat[outline.neighbour[order]].astype(np.float32) - own)).astype(
        np.uint8
    )
