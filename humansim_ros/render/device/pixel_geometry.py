"""Surface points at pixel centers: normals, texture coordinates, optical flow; and backdrops.

A renderer determines the triangle at each pixel center. From triangle and ray, the surface point and its
barycentric coordinates follow exactly, without interpolation or rounding by the renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Lens
from humansim_ros.geometry import cross
from humansim_ros.render.device.caches import LruCache
from humansim_ros.render.interface.renderer import AdjacentFrame, Body
from humansim_ros.types import Array, Float32Array, Indices, LinearColor

#: A point counts as visible if the nearest surface is in front of it by at most this many metres plus this
#: share of its distance. Neighbouring pixels of a slanted surface have such differences of depth.
_SLACK, _SLANT = 0.01, 0.01
#: Largest memory of cached pixel rays: enough for 15 lenses at 1920 x 1080.
_MAX_RAY_BYTES = 512 << 20


@dataclass(frozen=True)
class VisiblePixels:
    """Pixels that show bodies. ``pixels``: (M,) flat indices into the image. ``owner``: (M,) index of the
    body at the pixel. ``triangle``: (M,) triangle of its mesh."""

    pixels: Indices
    owner: Indices
    triangle: Indices


class PixelGeometry:
    """Surface points of bodies at the pixels of a camera. It holds no reference to the bodies, so that they
    can be freed."""

    def __init__(self, camera: Camera, bodies: Sequence[Body], visible: VisiblePixels) -> None:
        self.camera = camera
        self.visible = visible
        # vertices and triangles of all bodies are numbered consecutively
        offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
        first = np.cumsum([0, *(len(body.mesh.triangles) for body in bodies)])
        numbers = first[visible.owner] + visible.triangle
        # each triangle is computed once, even if many pixels show it
        distinct, self._which = _distinct(numbers, int(first[-1]))
        self._owner = np.searchsorted(first, distinct, side="right") - 1
        self._triangle = distinct - first[self._owner]
        self._uv = [(body.mesh.uv, body.mesh.uv_triangles) for body in bodies]
        self._corners = np.empty((3, len(distinct)), np.intp)
        for index, body in enumerate(bodies):
            mine = self._owner == index
            self._corners[:, mine] = body.mesh.triangles[self._triangle[mine]].T + offsets[index]
        self._positions = self._posed(bodies, camera)

    def _posed(self, bodies: Sequence[Body], camera: Camera) -> Array:
        """(3, 3, T) corners of the visible triangles in the optical frame. The first axis is x, y, z."""
        points = np.concatenate([np.zeros((0, 3)), *(camera.to_optical(body.vertices) for body in bodies)])
        x_y_z = np.ascontiguousarray(points.T)
        return np.stack([x_y_z.take(corner, axis=1) for corner in self._corners])

    @cached_property
    def coordinates(self) -> Array:
        """(M, 2) columns and rows of the pixels."""
        pixels, width = self.visible.pixels, self.camera.size[0]
        rows = np.trunc(pixels / width)  # faster than an integer division
        return np.stack([pixels - width * rows, rows], axis=1)

    @cached_property
    def weights(self) -> Array:
        """(3, M) barycentric coordinates of the points."""
        a, b, c = self._positions
        x, y = (component.take(self.visible.pixels) for component in pixel_rays(self.camera))
        # the ray d meets the plane of a, b, c; the weights are proportional to d . (b x c), d . (c x a), d .
        # (a x b)
        weights = np.empty((3, len(x)))
        for weight, plane in zip(weights, (cross(b, c), cross(c, a), cross(a, b)), strict=True):
            along_x, along_y, along_z = plane.take(self._which, axis=1)
            weight[:] = along_x * x + along_y * y + along_z
        total = weights.sum(axis=0)
        weights /= np.where(np.abs(total) > 1e-30, total, 1.0)
        # because of rounding, a pixel center at the border of a triangle may be slightly outside it
        return np.clip(weights, -0.01, 1.01, out=weights)

    def normals(self) -> Float32Array:
        """(M, 3) unit outward normals in the optical frame."""
        a, b, c = self._positions
        normals = cross(b - a, c - a)
        normals /= np.maximum(np.sqrt(np.einsum("ij,ij->j", normals, normals)), 1e-30)
        return normals.T.astype(np.float32).take(self._which, axis=0)

    def texture_coordinates(self) -> Float32Array:
        """(M, 2) texture coordinates, v up. NaN for bodies without texture coordinates."""
        corners = np.full((3, 2, len(self._owner)), np.nan)
        for index, (uv, triangles) in enumerate(self._uv):
            if uv is not None and triangles is not None:
                mine = self._owner == index
                corners[:, :, mine] = uv[triangles[self._triangle[mine]]].transpose(1, 2, 0)
        return np.asarray(self._interpolated(corners).T, dtype=np.float32)

    def in_frame(self, other: AdjacentFrame) -> tuple[Array, Array]:
        """Pixels (M, 2) and depths (M,) of the same surface points in another frame."""
        return other.camera.project_optical(self._interpolated(self._posed(other.bodies, other.camera)).T)

    def _interpolated(self, values: Array) -> Array:
        """Interpolate values (3, k, T) at the corners of triangles. Returns (k, M) values at the points."""
        # one component of all points after the other: several times faster than point by point
        points = np.zeros((values.shape[1], len(self._which)))
        for weight, corner in zip(self.weights, values, strict=True):
            points += weight * corner.take(self._which, axis=1)
        return points


@dataclass(frozen=True)
class Flow:
    """Optical flow of an image. ``flow``: (H, W, 2) float32 pixels from each pixel center to the same point
    in the other frame. NaN where there is no surface, or if the point is behind the camera in the other
    frame. ``hidden``: (H, W) uint8, 1 where the point is occluded in the other frame or outside its image."""

    flow: Float32Array
    hidden: NDArray[np.uint8]


def optical_flow(
    camera: Camera,
    geometry: PixelGeometry,
    depth: Float32Array,
    other: AdjacentFrame,
    other_depth: Float32Array | None,
    touched: tuple[slice, slice],
) -> Flow:
    """Compute the optical flow from one frame to another.

    Args:
        camera: Camera of the frame.
        geometry: Surface points of bodies in the frame.
        depth: (H, W) depth of the frame.
        other: The other frame.
        other_depth: (H, W) depth of the other frame; may be None if ``hidden`` is not needed.
        touched: Part of the other image that may show bodies.
    """
    static_camera = np.array_equal(camera.R, other.camera.R) and np.array_equal(camera.t, other.camera.t)
    pixels = geometry.visible.pixels
    targets, distance = geometry.in_frame(other)
    displacement = targets - geometry.coordinates
    hidden = np.zeros(depth.shape, np.uint8)
    if static_camera:
        flow = np.zeros((*depth.shape, 2), np.float32)
        nothing = np.isinf(depth)
        if nothing.any():
            flow[nothing] = np.nan
            hidden[nothing] = other_depth is not None
        if other_depth is not None:
            limit = depth[touched] * np.float32(1 - _SLANT) - np.float32(_SLACK)
            hidden[touched] |= other_depth[touched] < limit
            hidden.ravel()[pixels] = _hidden(targets, distance, other_depth)
        flow.reshape(-1, 2)[pixels] = displacement
        return Flow(flow, hidden)
    flow, far = _static_flow(camera, depth, other.camera)
    flow.reshape(-1, 2)[pixels] = displacement
    if other_depth is not None:
        far.ravel()[pixels] = distance
        everywhere = (_pixel_grid(camera.size) + flow).reshape(-1, 2)
        hidden.ravel()[:] = _hidden(everywhere, far.ravel(), other_depth)
    return Flow(flow, hidden)


def _static_flow(camera: Camera, depth: Float32Array, other: Camera) -> tuple[Float32Array, Float32Array]:
    """Flow (H, W, 2) of static surfaces to the image of another camera, and their depths (H, W) there."""
    with np.errstate(invalid="ignore"):  # infinite depth
        world = (ray_grid(camera) * depth[..., None] - camera.t) @ camera.R
        pixels, distance = other.project(world.reshape(-1, 3))
    flow = (pixels.reshape(*depth.shape, 2) - _pixel_grid(camera.size)).astype(np.float32)
    return flow, distance.astype(np.float32).reshape(depth.shape)


def _hidden(targets: Array, distance: NDArray[np.floating], other_depth: Float32Array) -> NDArray[np.bool_]:
    """(M,) whether points are occluded or outside the image. ``targets``: (M, 2) pixels of the points.
    ``distance``: (M,) their depths."""
    height, width = other_depth.shape
    column, row = np.rint(np.nan_to_num(targets.T, nan=-1.0)).clip(-1, max(width, height)).astype(np.intp)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    nearest = other_depth.ravel().take(np.where(inside, row * width + column, 0))
    return ~inside | (nearest < distance * (1 - _SLANT) - _SLACK)


def ray_grid(camera: Camera) -> Array:
    """(H, W, 3) ray directions through all pixel centers, with z = 1, optical frame. NaN beyond the lens."""
    width, height = camera.size
    rays: Array = np.ones((height, width, 3))
    rays[..., 0], rays[..., 1] = pixel_rays(camera).reshape(2, height, width)
    return rays


#: Cache of pixel rays by lens, image size and intrinsics.
_RAYS: LruCache[tuple[Lens, tuple[int, int], tuple[float, ...]], Array] = LruCache(
    64, _MAX_RAY_BYTES, nbytes=lambda rays: rays.nbytes
)


def pixel_rays(camera: Camera) -> Array:
    """(2, H W) x and y of the rays of :func:`ray_grid`, read-only."""
    k = tuple(camera.K.ravel().tolist())

    def make() -> Array:
        x_y: Array = np.ascontiguousarray(camera.rays(_pixel_grid(camera.size))[..., :2].reshape(-1, 2).T)
        x_y.setflags(write=False)
        return x_y

    return _RAYS.get_or_make((camera.lens, camera.size, k), make)


def _pixel_grid(size: tuple[int, int]) -> Array:
    """(H, W, 2) column and row of each pixel of an image."""
    grid: Array = np.empty((size[1], size[0], 2))
    grid[..., 0], grid[..., 1] = np.arange(size[0]), np.arange(size[1])[:, None]
    return grid


def _distinct(numbers: NDArray[Any], count: int) -> tuple[Indices, Indices]:
    """Like np.unique with inverse, but faster: the distinct ``numbers``, which are all below ``count``; and
    the index of each number in this list."""
    present = np.zeros(count, bool)
    present[numbers] = True
    distinct = np.flatnonzero(present)
    index = np.empty(count, np.intp)
    index[distinct] = np.arange(len(distinct))
    return distinct, index[numbers]


#: The panorama repeats this many columns at each side, to interpolate across the seam.
_WRAP = 2


@dataclass(frozen=True, eq=False)
class ImageBackdrop:
    """A photograph ``image`` (H, W, 3) uint8 sRGB, scaled to cover the camera's image."""

    image: NDArray[np.uint8]

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 sRGB, in the image size of the camera."""
        (width, height), (h, w) = camera.size, self.image.shape[:2]
        scale = max(width / w, height / h)
        # the visible part, at the center of the photograph
        part_w, part_h = min(w, max(1, round(width / scale))), min(h, max(1, round(height / scale)))
        x, y = (w - part_w) // 2, (h - part_h) // 2
        part = self.image[y : y + part_h, x : x + part_w]
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(part, camera.size, interpolation=interpolation), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Panorama:
    """An equirectangular panorama at infinite distance. ``image``: (H, W, 3) uint8 sRGB. Its center is in
    direction +x of ``map``, the first row straight up. ``yaw``: rotation of the panorama to the left,
    radians."""

    image: NDArray[np.uint8]
    yaw: float = 0.0

    @cached_property
    def _wrapped(self) -> NDArray[np.uint8]:
        """The panorama with the first columns added after the last, and the last columns added before the
        first."""
        return np.pad(self.image, ((0, 0), (_WRAP, _WRAP), (0, 0)), mode="wrap")

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 sRGB, in the image size of the camera."""
        height, width = self.image.shape[:2]
        with np.errstate(invalid="ignore"):  # beyond the field of view of the lens
            x, y, z = np.moveaxis(ray_grid(camera) @ camera.R, -1, 0)
            left = np.arctan2(y, x) - self.yaw
            up = np.arctan2(z, np.hypot(x, y))
        column = np.mod(0.5 - left / (2 * np.pi), 1.0) * width - 0.5 + _WRAP
        row = np.clip((0.5 - up / np.pi) * height - 0.5, 0, height - 1)
        across, down = (np.nan_to_num(axis, nan=-10.0).astype(np.float32) for axis in (column, row))
        image = cv2.remap(self._wrapped, across, down, interpolation=cv2.INTER_LINEAR)
        return np.asarray(image, dtype=np.uint8)


def ambient(radiance: NDArray[np.float32]) -> tuple[LinearColor, LinearColor]:
    """Compute the ambient light of a panorama (H, W, 3) of linear light.

    Returns:
        Colour of the light from above, and of the light from below, on level surfaces.
    """
    rows = len(radiance)
    up = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)
    # share of the sphere of each row, and cosine of its angle to the vertical
    weight = np.cos(up) * np.abs(np.sin(up))
    means = radiance.mean(axis=1, dtype=float)
    sky, ground = (
        np.average(means[half], axis=0, weights=weight[half]).tolist() for half in (up > 0, up < 0)
    )
    return tuple(sky), tuple(ground)
