"""Outlines of masks: signed distances, and points of the outline with the surface of the body there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array, Float32Array, Indices

#: Number of points along the outlines of a mask.
_COUNT = 160
#: Area in pixels of a part or a hole of a mask that is too small to count.
_SPECK = 30
#: Standard deviation in pixels of the smoothing of distances before their slopes are computed.
_SMOOTH = 1.5
#: Least length of a smoothed slope that has a direction.
_LEAST_SLOPE = 0.3
#: Outlines that are farther apart than this share of the size of the person are those of different things.
_FARTHEST = 0.5
#: Pixels around two masks, so that slopes at their outlines are known.
_MARGIN = 8


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """MaskOutline of a mask (H, W)."""

    mask: NDArray[np.bool_]

    @cached_property
    def distances(self) -> Float32Array:
        """(H, W) pixels from the outline, negative inside. The border of the image is no outline."""
        inside, outside = (
            np.asarray(cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
            for part in (self.mask, ~self.mask)
        )
        return np.asarray(np.where(self.mask, 0.5 - inside, outside - 0.5), dtype=np.float32)

    @cached_property
    def slopes(self) -> Float32Array:
        """(H, W, 2) direction away from the mask: unit vectors, shorter where the distance has a crease."""
        smooth = cv2.GaussianBlur(self.distances, (0, 0), _SMOOTH)
        down, right = np.gradient(smooth)
        return np.stack([right, down], axis=-1).astype(np.float32)

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """(N, 2) x, y of pixels of the mask along its outlines, but not along the border of the image."""
        height, width = self.mask.shape
        found, _ = cv2.findContours(self.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        large = [each[:, 0] for each in found if cv2.contourArea(each) >= _SPECK]
        step = max(sum(map(len, large)) // _COUNT, 1)
        kept = [each[::step] for each in large]
        pixels = np.concatenate(kept) if kept else np.zeros((0, 2), np.intp)
        x, y = pixels.T
        within = (x > 1) & (y > 1) & (x < width - 2) & (y < height - 2)
        return np.asarray(pixels[within], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Edges:
    """Points of the surface of a body that should move along a line in an image, to meet the outline.

    Attributes:
        vertices: (N,) nearest vertices of the body.
        normals: (N, 2) directions in the image.
        distances: (N,) pixels that the points have to move along the normals.
        size: Side of a square of the area of the given mask, pixels.
    """

    vertices: Indices
    normals: Array
    distances: Array
    size: float


def find_edges(
    given: MaskOutline, camera: Camera, vertices: Float32Array, mesh: Mesh, face: NDArray[np.int32]
) -> Edges:
    """Pairs of points of the outline of a rendered body and of the given outline.

    Each point of the rendered outline is paired with the nearest given one, and the reverse: an arm of the
    mask that the body does not cover attracts the nearest part of the body.

    Args:
        given: Outline of the given mask.
        camera: Camera of the image.
        vertices: Vertices (V, 3) of the body in ``map``.
        mesh: Mesh of the body.
        face: 1 + number of the triangle at each pixel of the rendered body, (H, W).
    """
    corner, cut = _cut_around(given.mask, face)
    rendered = MaskOutline(cut > 0)
    own, other, size = rendered.pixels + corner, given.pixels, float(np.sqrt(given.mask.sum()))
    if not len(own) or not len(other):
        return Edges(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0), size)
    nearest, there = _nearest(own, other), _at(other - corner)
    rows = [
        # the pixel of the mask at an outline is half a pixel inside of it
        (own, given.slopes[_at(own)], -given.distances[_at(own)] - 0.5),
        (own[nearest], rendered.slopes[there], rendered.distances[there] + 0.5),
    ]
    pixels, normals, distances = (np.concatenate([row[part] for row in rows]) for part in range(3))
    corners = mesh.triangles[face[_at(pixels)] - 1]
    seen = camera.project(vertices[corners].reshape(-1, 3))[0].reshape(-1, 3, 2)
    gaps = np.nan_to_num(np.linalg.norm(seen - pixels[:, None], axis=2), nan=np.inf)
    vertex = corners[np.arange(len(corners)), np.argmin(gaps, axis=1)]
    lengths = np.linalg.norm(normals, axis=1)
    # at a crease, between two outlines, the direction is not known
    clear = (lengths > _LEAST_SLOPE) & (np.abs(distances) < _FARTHEST * size)
    unit = normals[clear] / lengths[clear, None]
    own_distances = distances[clear].astype(float)
    return Edges(vertex[clear].astype(np.intp), unit.astype(float), own_distances, size)


def intersection_over_union(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Share of the pixels of either mask that both have; 0 if both are empty."""
    union = int((first | second).sum())
    return float((first & second).sum() / union) if union else 0.0


def _cut_around(
    mask: NDArray[np.bool_], face: NDArray[np.int32]
) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Cut of a face image around two masks, which saves time, and its corner (2,) x, y."""
    both = (face > 0) | mask
    ranges = [np.flatnonzero(both.any(axis=axis)) for axis in (0, 1)]
    if not len(ranges[0]):
        return np.zeros(2, np.intp), face
    low = [max(int(each[0]) - _MARGIN, 0) for each in ranges]
    high = [int(each[-1]) + _MARGIN + 1 for each in ranges]
    return np.array(low, np.intp), face[low[1] : high[1], low[0] : high[0]]


def _at(pixels: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return pixels[:, 1], pixels[:, 0]


def _nearest(points: NDArray[np.intp], targets: NDArray[np.intp]) -> Indices:
    """Number of the nearest point (N, 2) of each target (M, 2)."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(points).query(targets)[1], dtype=np.intp)
