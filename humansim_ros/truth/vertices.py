"""Which vertices of the bodies a camera sees.

Triangles are smaller than pixels, so an image of labels does not say which of their corners are seen. What
the image shows far before a vertex hides it; the rays to all others are cut with the bodies' triangles.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.render.lens_tessellation import NEAR, nearest
from humansim_ros.truth.joints import nearest_pixels
from humansim_ros.types import Array, Indices

#: Metres before a vertex at which all surfaces round its pixel surely hide it; and at which the room or an
#: object at its pixel does.
_SURELY, _TOUCHING = 0.05, 0.01
#: Share of a vertex's distance by which a triangle must be nearer to hide it.
_NEARER = 1e-5


def visible_vertices(camera: Camera, bodies: Sequence[Body], view: View) -> dict[int, NDArray[np.bool_]]:
    """Which vertices (V,) of every labelled body are seen, by instance, by a camera whose ``view`` has depth
    and instance labels.

    A vertex is seen if it is inside the image and not too near (5 cm along the axis, 5 mm for wide fisheyes),
    no triangle of a body crosses the ray to it, and what else its pixel shows, room and objects, is not
    before it.
    """
    assert view.depth is not None and view.instance is not None
    bodies = [body for body in bodies if body.instance]
    if not bodies:
        return {}
    offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    points, near = camera.to_optical(np.concatenate([body.vertices for body in bodies])), nearest(camera)
    triangles = np.concatenate(
        [
            _hiding(body, points[offset : offset + len(body.vertices)], near) + offset
            for body, offset in zip(bodies, offsets[:-1], strict=True)
        ]
    )
    candidates = _perhaps_seen(camera, points, view.depth, view.instance) & (points[:, 2] >= near)
    seen = np.zeros(len(points), bool)
    seen[_unhidden(points, np.flatnonzero(candidates), triangles, near)] = True
    return {
        body.instance: seen[start:end]
        for body, start, end in zip(bodies, offsets[:-1], offsets[1:], strict=True)
    }


def _perhaps_seen(
    camera: Camera, points: Array, shown: NDArray[np.float32], labels: NDArray[np.uint16]
) -> NDArray[np.bool_]:
    """(V,) which points (V, 3) of the optical frame are in the image and not surely hidden."""
    pixels, depth = camera.project_optical(points)
    inside, row, column = nearest_pixels(pixels, camera.size)
    farthest = cv2.dilate(shown, np.ones((3, 3), np.uint8))
    hidden = farthest[row, column] < depth - _SURELY
    hidden |= (labels[row, column] == 0) & (shown[row, column] < depth - _TOUCHING)
    return np.asarray(inside & ~hidden)


def _hiding(body: Body, points: Array, near: float) -> Indices:
    """(N, 3) the triangles of a body that can hide something, those wholly within ``near`` left out;
    ``points``: (V, 3) where it is in the optical frame. From outside a closed surface, whatever a back face
    hides is hidden by a front face as well.
    """
    triangles = body.mesh.triangles.astype(np.intp)
    if not body.mesh.closed or points[:, 2].min() < 2 * NEAR:
        far = points[:, 2] >= near
        return triangles[np.logical_or.reduce(far[triangles.T])]
    a, b, c = points[triangles.T]
    return triangles[np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0]


def _unhidden(points: Array, candidates: Indices, triangles: Indices, near: float) -> Indices:
    """Those of the candidates (indices of points) that no triangle hides from the origin."""
    point, triangle = _overlapping(points, candidates, triangles, near)
    rays, corners = points[point], triangles[triangle].T
    a, b, c = points[corners]
    # a ray p crosses the triangle a b c where p . (b x c), p . (c x a) and p . (a x b) have one sign
    across = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = np.einsum("ij,ij->i", a, across[0])
    sides = np.stack([np.einsum("ij,ij->i", n, rays) for n in across]) * np.sign(volume)
    # and does so at the share |volume| / sum of its way
    before = np.abs(volume) < sides.sum(axis=0) * (1 - _NEARER)
    crossed = np.logical_and.reduce([*(sides >= 0), before, *(corners != point)])
    hidden = np.zeros(len(points), bool)
    hidden[point[crossed]] = True
    return candidates[~hidden[candidates]]


def _overlapping(
    points: Array, candidates: Indices, triangles: Indices, near: float
) -> tuple[Indices, Indices]:
    """Pairs (K,), (K,) of candidates (indices of points) and triangles whose bounds they are in, as seen from
    the origin.
    """
    plane = points[:, :2] / np.maximum(points[:, 2:], near)
    corners = plane.T[:, triangles.T]
    low, high = corners.min(axis=1), corners.max(axis=1)
    # what is left of a triangle that passes the plane z = near
    cut = np.flatnonzero(np.logical_or.reduce(points[triangles.T, 2] < near))
    if len(cut):
        beside = points[triangles[cut].T, :2].transpose(2, 0, 1) / near
        low[:, cut] = np.minimum(low[:, cut], beside.min(axis=1))
        high[:, cut] = np.maximum(high[:, cut], beside.max(axis=1))
    (x0, y0), (x1, y1) = low, high
    # rows with about as many candidates in each as there are rows, sorted by x within each
    x, y = plane[candidates].T
    count = len(candidates)
    edges = np.sort(y)[:: max(1, int(np.sqrt(count)))]
    rank = np.empty(count, np.intp)
    rank[np.argsort(x, kind="stable")] = np.arange(count)
    keys = np.searchsorted(edges, y, side="right") * (count + 1) + rank
    order = np.argsort(keys)
    keys, by_x = keys[order], np.sort(x)
    # the rows of each triangle, and the candidates of each of these rows that are within its x
    first, last = np.searchsorted(edges, y0, side="right"), np.searchsorted(edges, y1, side="right")
    triangle, row = _ranges(first, last + 1)
    left, right = np.searchsorted(by_x, x0), np.searchsorted(by_x, x1, side="right")
    start = np.searchsorted(keys, row * (count + 1) + left[triangle])
    end = np.searchsorted(keys, row * (count + 1) + right[triangle])
    which, place = _ranges(start, end)
    triangle, candidate = triangle[which], order[place]
    within = (y[candidate] >= y0[triangle]) & (y[candidate] <= y1[triangle])
    return candidates[candidate[within]], triangle[within]


def _ranges(start: Indices, end: Indices) -> tuple[Indices, Indices]:
    """All numbers of the ranges start..end - 1, and which range each is of."""
    lengths = np.maximum(end - start, 0)
    which = np.repeat(np.arange(len(start)), lengths)
    firsts = np.cumsum(lengths) - lengths
    return which, np.arange(len(which)) - firsts[which] + start[which]
