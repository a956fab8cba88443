"""Visible vertices of the bodies, and the surface points that pixels show.

Triangles are smaller than pixels, so an image of labels cannot tell which of their corners are visible. A
vertex far behind the depth image is hidden. For all others, the ray from the camera is intersected with the
triangles of the bodies.

Surface points are correspondences between pixels, views, frames and people. *Part, u, v* as in DensePose
[Güler 2018], with the part labels and texture coordinates of the body in place of DensePose's 24 charts.
*Rest points*: the visible point on the body at rest, which is metric and needs no texture coordinates; on an
object, in the axes and unit of its mesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.render.lens_tessellation import NEAR, near_plane
from humansim_ros.render.pixel_geometry import PixelGeometry, VisiblePixels
from humansim_ros.truth.joints import nearest_pixels
from humansim_ros.types import Array, Float32Array, Indices

#: A vertex is hidden if it is this far (metres) behind all surfaces around its pixel.
_HIDDEN_BEHIND_ALL = 0.05
#: A vertex is hidden if it is this far (metres) behind the room or an unlabelled object at its pixel.
_HIDDEN_BEHIND_SCENE = 0.01
#: Share of a vertex's distance by which a triangle must be nearer to hide it.
_MIN_GAP = 1e-5


def visible_vertices(camera: Camera, bodies: Sequence[Body], view: View) -> dict[int, NDArray[np.bool_]]:
    """Compute masks (V,) of the visible vertices of all labelled bodies, by instance label.

    A vertex is visible if it is inside the image and beyond the near plane (5 cm along the axis, 5 mm for
    wide fisheyes), no triangle of a labelled body intersects the ray to it, and neither the room nor an
    unlabelled object at its pixel is in front of it. ``view`` must have the channels depth and instance.
    """
    bodies = [body for body in bodies if body.instance]
    if not bodies:
        return {}
    offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    points = np.concatenate([body.vertices for body in bodies])
    visible = _visible(camera, bodies, points, np.arange(len(points)), view)
    return {
        body.instance: visible[start:end]
        for body, start, end in zip(bodies, offsets[:-1], offsets[1:], strict=True)
    }


def visible_points(camera: Camera, bodies: Sequence[Body], points: Array, view: View) -> NDArray[np.bool_]:
    """Compute a mask (N,) of the visible points (N, 3) of ``map``, by the rule of :func:`visible_vertices`.

    A triangle that the point lies on does not hide it.

    Args:
        camera: Camera of the view.
        bodies: All bodies at the stamp.
        points: (N, 3) in ``map``, metres.
        view: View with the channels depth and instance.
    """
    bodies = [body for body in bodies if body.instance]
    vertices = [body.vertices for body in bodies]
    first = sum(map(len, vertices))
    asked = np.arange(first, first + len(points))
    return _visible(camera, bodies, np.concatenate([*vertices, points]), asked, view)[asked]


def _visible(
    camera: Camera, bodies: Sequence[Body], points: Array, asked: Indices, view: View
) -> NDArray[np.bool_]:
    """Mask (P,) of the visible ones of some points.

    Args:
        camera: Camera of the view.
        bodies: Labelled bodies.
        points: (P, 3) in ``map``, the vertices of the bodies first.
        asked: Indices of the points to test.
        view: View with the channels depth and instance.
    """
    optical, near = camera.to_optical(points), near_plane(camera)
    offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    triangles = [
        _occluding_triangles(body, optical[offset : offset + len(body.vertices)], near) + offset
        for body, offset in zip(bodies, offsets[:-1], strict=True)
    ]
    candidates = _candidates(camera, optical[asked], view.depth, view.instance) & (optical[asked, 2] >= near)
    visible = np.zeros(len(points), bool)
    hiding = np.concatenate([np.zeros((0, 3), np.intp), *triangles])
    visible[_unoccluded(optical, asked[candidates], hiding, near)] = True
    return visible


def _candidates(
    camera: Camera, points: Array, depth_image: NDArray[np.float32], labels: NDArray[np.uint16]
) -> NDArray[np.bool_]:
    """Mask (V,) of points (V, 3) of the optical frame inside the image that may be visible."""
    pixels, depth = camera.project_optical(points)
    inside, row, column = nearest_pixels(pixels, camera.size)
    farthest = cv2.dilate(depth_image, np.ones((3, 3), np.uint8))
    hidden = farthest[row, column] < depth - _HIDDEN_BEHIND_ALL
    hidden |= (labels[row, column] == 0) & (depth_image[row, column] < depth - _HIDDEN_BEHIND_SCENE)
    return np.asarray(inside & ~hidden)


def _occluding_triangles(body: Body, points: Array, near: float) -> Indices:
    """Triangles (N, 3) of a body that can hide a vertex. ``points``: its vertices (V, 3) in the optical
    frame.

    Triangles within ``near`` are left out, and back faces of a closed surface that is seen from outside:
    a front face hides the same vertices.
    """
    triangles = body.mesh.triangles.astype(np.intp)
    if not body.mesh.closed or points[:, 2].min() < 2 * NEAR:
        far = points[:, 2] >= near
        return triangles[np.logical_or.reduce(far[triangles.T])]
    a, b, c = points[triangles.T]
    return triangles[np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0]


def _unoccluded(points: Array, candidates: Indices, triangles: Indices, near: float) -> Indices:
    """Candidates (indices of points) that no triangle hides from the origin."""
    point, triangle = _overlapping(points, candidates, triangles, near)
    rays, corners = points[point], triangles[triangle].T
    a, b, c = points[corners]
    # a ray p intersects the triangle a b c where p . (b x c), p . (c x a) and p . (a x b) have one sign
    across = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = np.einsum("ij,ij->i", a, across[0])
    sides = np.stack([np.einsum("ij,ij->i", n, rays) for n in across]) * np.sign(volume)
    # and the intersection is at the share |volume| / sum of the ray
    before = np.abs(volume) < sides.sum(axis=0) * (1 - _MIN_GAP)
    crossed = np.logical_and.reduce([*(sides >= 0), before, *(corners != point)])
    hidden = np.zeros(len(points), bool)
    hidden[point[crossed]] = True
    return candidates[~hidden[candidates]]


def _overlapping(
    points: Array, candidates: Indices, triangles: Indices, near: float
) -> tuple[Indices, Indices]:
    """Pairs (K,), (K,) of candidates (indices of points) and triangles with the candidate in their bounds."""
    plane = points[:, :2] / np.maximum(points[:, 2:], near)
    corners = plane.T[:, triangles.T]
    low, high = corners.min(axis=1), corners.max(axis=1)
    # the remaining part of a triangle that intersects the plane z = near
    cut = np.flatnonzero(np.logical_or.reduce(points[triangles.T, 2] < near))
    if len(cut):
        beside = points[triangles[cut].T, :2].transpose(2, 0, 1) / near
        low[:, cut] = np.minimum(low[:, cut], beside.min(axis=1))
        high[:, cut] = np.maximum(high[:, cut], beside.max(axis=1))
    (x0, y0), (x1, y1) = low, high
    # about as many rows as candidates per row; candidates of a row are sorted by x
    x, y = plane[candidates].T
    count = len(candidates)
    edges = np.sort(y)[:: max(1, int(np.sqrt(count)))]
    rank = np.empty(count, np.intp)
    rank[np.argsort(x, kind="stable")] = np.arange(count)
    keys = np.searchsorted(edges, y, side="right") * (count + 1) + rank
    order = np.argsort(keys)
    keys, by_x = keys[order], np.sort(x)
    # the rows of each triangle, and in each of these rows the candidates within its x range
    first, last = np.searchsorted(edges, y0, side="right"), np.searchsorted(edges, y1, side="right")
    triangle, row = _ranges(first, last + 1)
    left, right = np.searchsorted(by_x, x0), np.searchsorted(by_x, x1, side="right")
    start = np.searchsorted(keys, row * (count + 1) + left[triangle])
    end = np.searchsorted(keys, row * (count + 1) + right[triangle])
    which, position = _ranges(start, end)
    triangle, candidate = triangle[which], order[position]
    within = (y[candidate] >= y0[triangle]) & (y[candidate] <= y1[triangle])
    return candidates[candidate[within]], triangle[within]


def _ranges(start: Indices, end: Indices) -> tuple[Indices, Indices]:
    """Index of the range, and number, for all numbers of the ranges start to end - 1."""
    lengths = np.maximum(end - start, 0)
    which = np.repeat(np.arange(len(start)), lengths)
    firsts = np.cumsum(lengths) - lengths
    return which, np.arange(len(which)) - firsts[which] + start[which]


def part_u_v(view: View) -> Float32Array:
    """Part label and texture coordinates (H, W, 3), v up, of each pixel; 0, NaN, NaN where no body is.

    ``view`` must have the channels part and uv.
    """
    return np.dstack([view.part.astype(np.float32), view.uv])


def rest_points(camera: Camera, bodies: Sequence[Body], view: View) -> Float32Array:
    """Points (H, W, 3) of the rest mesh that each pixel shows; NaN where no labelled body is.

    Points of humans are in body space, metres. ``view`` must have the channels instance and face.
    """
    labelled = [body for body in bodies if body.instance]
    owners = np.full(65536, -1)
    owners[[body.instance for body in labelled]] = np.arange(len(labelled))
    pixels = np.flatnonzero(view.instance)
    visible = VisiblePixels(
        pixels, owners[view.instance.ravel()[pixels]], view.face.ravel()[pixels] - np.intp(1)
    )
    weights = PixelGeometry(camera, labelled, visible).weights.T
    points = np.full((*view.instance.shape, 3), np.nan, np.float32)
    for index, body in enumerate(labelled):
        own = visible.owner == index
        corners = body.mesh.vertices[body.mesh.triangles[visible.triangle[own]]]
        points.reshape(-1, 3)[pixels[own]] = np.einsum("mi,mik->mk", weights[own], corners)
    return points
