"""What follows from which triangle a pixel shows: normals, texture coordinates, where its point goes.

A renderer says for every pixel which triangle of which body its centre shows. The point of that triangle on
the pixel's ray is then known exactly, by its barycentric coordinates, and with it all that belongs to the
point: no renderer interpolates or rounds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.camera.lens import Lens
from humansim_ros.render.renderer import AdjacentFrame, Body
from humansim_ros.rotations import cross
from humansim_ros.types import Array, Float32Array

#: Metres, and share of the distance, that a surface may lie before a point that is seen all the same: the
#: depth between two pixels of a surface that slants away.
_SLACK, _SLANT = 0.01, 0.01


@dataclass(frozen=True)
class VisiblePixels:
    """The pixels of an image that show bodies. ``pixels``: (M,) flat indices. ``owner``: (M,) which of the
    bodies; ``triangle``: (M,) which of its triangles.
    """

    pixels: NDArray[np.intp]
    owner: NDArray[np.intp]
    triangle: NDArray[np.intp]


class PixelGeometry:
    """The points of bodies' surfaces that the pixels of a camera show."""

    def __init__(self, camera: Camera, bodies: Sequence[Body], shown: VisiblePixels) -> None:
        self.camera = camera
        self.shown = shown
        # which vertices each pixel's triangle has, of those of all bodies one after the other
        offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
        first = np.cumsum([0, *(len(body.mesh.triangles) for body in bodies)])
        self._bodies = bodies
        numbers = first[shown.owner] + shown.triangle
        # a triangle is worked out once, however many pixels show it
        self._seen, self._which = _distinct(numbers, int(first[-1]))
        owner = np.searchsorted(first, self._seen, side="right") - 1
        self._owner, self._triangle = owner, self._seen - first[owner]
        self._corners = np.empty((3, len(owner)), np.intp)
        for index, body in enumerate(bodies):
            mine = owner == index
            self._corners[:, mine] = body.mesh.triangles[self._triangle[mine]].T + offsets[index]

    def _posed(self, bodies: Sequence[Body], camera: Camera) -> Array:
        """(3, 3, T) corners of the triangles that are seen, x, y and z of each, optical frame of a camera."""
        points = np.concatenate([np.zeros((0, 3)), *(camera.to_optical(body.vertices) for body in bodies)])
        x_y_z = np.ascontiguousarray(points.T)
        return np.stack([x_y_z.take(corner, axis=1) for corner in self._corners])

    @cached_property
    def _now(self) -> Array:
        return self._posed(self._bodies, self.camera)

    @cached_property
    def weights(self) -> Array:
        """(3, M) barycentric coordinates of the points."""
        a, b, c = self._now
        x, y = (component.take(self.shown.pixels) for component in _ray_components(self.camera))
        # the ray d meets the plane of a b c where d . (b x c), d . (c x a), d . (a x b) are as the weights
        weights = np.empty((3, len(x)))
        for weight, plane in zip(weights, (cross(b, c), cross(c, a), cross(a, b)), strict=True):
            along_x, along_y, along_z = plane.take(self._which, axis=1)
            weight[:] = along_x * x + along_y * y + along_z
        total = weights.sum(axis=0)
        weights /= np.where(np.abs(total) > 1e-30, total, 1.0)
        # centres that only just are on a triangle may be a rounding beside it
        return np.clip(weights, -0.01, 1.01, out=weights)

    def normals(self) -> Float32Array:
        """(M, 3) unit outward normals in the optical frame."""
        a, b, c = self._now
        normals = cross(b - a, c - a)
        normals /= np.maximum(np.sqrt(np.einsum("ij,ij->j", normals, normals)), 1e-30)
        return normals.T.astype(np.float32).take(self._which, axis=0)

    def texture_coordinates(self) -> Float32Array:
        """(M, 2) texture coordinates, v up; NaN where a body has none."""
        uv = np.full((3, 2, len(self._owner)), np.nan)
        for index, body in enumerate(self._bodies):
            mesh, mine = body.mesh, self._owner == index
            if mesh.uv is not None and mesh.uv_triangles is not None:
                uv[:, :, mine] = mesh.uv[mesh.uv_triangles[self._triangle[mine]]].transpose(1, 2, 0)
        return np.asarray(self._of_corners(uv).T, dtype=np.float32)

    def where(self, other: AdjacentFrame) -> tuple[Array, Array]:
        """Pixels (M, 2) and depths (M,) of the same points of the surfaces at another moment."""
        return other.camera.project_optical(self._of_corners(self._posed(other.bodies, other.camera)).T)

    def _of_corners(self, values: Array) -> Array:
        """(k, M) of what the corners of the triangles have, (3, k, T)."""
        # one number of all points at a time: several times faster than one point's numbers at a time
        found = np.zeros((values.shape[1], len(self._which)))
        for weight, corner in zip(self.weights, values, strict=True):
            found += weight * corner.take(self._which, axis=1)
        return found


@dataclass(frozen=True)
class Flow:
    """``flow``: (H, W, 2) float32 pixels from each pixel's centre to where the point that it shows is at the
    other moment, NaN where nothing is or it is not before the lens. ``hidden``: (H, W) uint8, 1 where that
    point is not seen there: hidden by something, or outside the image.
    """

    flow: Float32Array
    hidden: NDArray[np.uint8]


def optical_flow(
    camera: Camera,
    detail: PixelGeometry,
    depth: Float32Array,
    other: AdjacentFrame,
    other_depth: Float32Array | None,
    touched: tuple[slice, slice],
) -> Flow:
    """Where what a camera sees goes. ``depth``: (H, W) what it sees; ``other_depth``: what is seen at the
    other moment, needed for what is hidden; ``touched``: the part of it that shows bodies.
    """
    stays = np.array_equal(camera.R, other.camera.R) and np.array_equal(camera.t, other.camera.t)
    shown = detail.shown.pixels
    pixels, distance = detail.where(other)
    hidden = np.zeros(depth.shape, np.uint8)
    if stays:
        flow = np.zeros((*depth.shape, 2), np.float32)
        nothing = np.isinf(depth)
        if nothing.any():
            flow[nothing] = np.nan
            hidden[nothing] = other_depth is not None
        if other_depth is not None:
            before, there = other_depth[touched], depth[touched]
            hidden[touched] |= before < there * np.float32(1 - _SLANT) - np.float32(_SLACK)
            hidden.ravel()[shown] = _hidden(pixels, distance, other_depth)
        flow.reshape(-1, 2)[shown] = pixels - _pixel_grid(camera.size)[shown]
        return Flow(flow, hidden)
    flow, far = _camera_moves(camera, depth, other.camera)
    flow.reshape(-1, 2)[shown] = pixels - _pixel_grid(camera.size)[shown]
    if other_depth is not None:
        far.ravel()[shown] = distance
        to = (_pixel_grid(camera.size) + flow.reshape(-1, 2)).astype(float)
        hidden.ravel()[:] = _hidden(to, far.ravel(), other_depth)
    return Flow(flow, hidden)


def _camera_moves(camera: Camera, depth: Float32Array, other: Camera) -> tuple[Float32Array, Float32Array]:
    """Flow (H, W, 2), and depths (H, W) at the other moment, of what stands still before a camera that is
    elsewhere then.
    """
    with np.errstate(invalid="ignore"):  # endlessly far away
        world = (ray_grid(camera) * depth[..., None] - camera.t) @ camera.R
        pixels, there = other.project(world.reshape(-1, 3))
    flow = (pixels - _pixel_grid(camera.size)).astype(np.float32).reshape(*depth.shape, 2)
    return flow, there.astype(np.float32).reshape(depth.shape)


def _hidden(to: Array, distance: NDArray[np.floating], other_depth: Float32Array) -> NDArray[np.bool_]:
    """(M,) which points at pixels (M, 2) are not seen: something is before them, or they are outside."""
    height, width = other_depth.shape
    column, row = np.rint(np.nan_to_num(to.T, nan=-1.0)).clip(-1, max(width, height)).astype(np.intp)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    nearest = other_depth.ravel().take(np.where(inside, row * width + column, 0))
    return ~inside | (nearest < distance * (1 - _SLANT) - _SLACK)


def _ray_components(camera: Camera) -> Array:
    """(2, H W) x and y of the rays of :func:`ray_grid`."""
    return _components(camera.lens, camera.size, tuple(camera.K.ravel().tolist()))


@lru_cache(maxsize=16)
def _components(lens: Lens, size: tuple[int, int], k: tuple[float, ...]) -> Array:
    return np.ascontiguousarray(_ray_grid(lens, size, k)[..., :2].reshape(-1, 2).T)


def ray_grid(camera: Camera) -> Array:
    """(H, W, 3) directions with z = 1, optical frame, that the pixels' centres see; NaN where the lens is
    dark.
    """
    return _ray_grid(camera.lens, camera.size, tuple(camera.K.ravel().tolist()))


@lru_cache(maxsize=16)
def _ray_grid(lens: Lens, size: tuple[int, int], k: tuple[float, ...]) -> Array:
    camera = Camera(size, np.reshape(k, (3, 3)), np.eye(3), np.zeros(3), lens.coefficients, lens.model)
    return camera.rays(_pixel_grid(size).reshape(size[1], size[0], 2))


@lru_cache(maxsize=16)
def _pixel_grid(size: tuple[int, int]) -> Array:
    """(H W, 2) pixels of an image."""
    columns, rows = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _distinct(numbers: NDArray[Any], count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The distinct ones of numbers below ``count``, and which of these each is: np.unique without sorting."""
    there = np.zeros(count, bool)
    there[numbers] = True
    distinct = np.flatnonzero(there)
    place = np.empty(count, np.intp)
    place[distinct] = np.arange(len(distinct))
    return distinct, place[numbers]
