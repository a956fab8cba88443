"""Depth sensors: from the exact depth that their own optics see to the depth that a driver publishes.

The surface at a pixel is taken as a plane. The inverse depth of a plane n . X = 1 is linear in pixels, w(u,
v) = n . K^-1 (u, v, 1). So the differences between neighbouring pixels give the angle of the surface, and its
depth on rays nearby. On flat surfaces this has no error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera.camera import MAX_SIZE, Camera, pinhole_of_fov
from humansim_ros.cameras.sensor.config import MAX_DEPTH, DepthSensorConfig
from humansim_ros.cameras.sensor.sensor import generator, luminance, normal_numbers, srgb_to_light
from humansim_ros.errors import CameraError
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import from_degrees
from humansim_ros.types import Array, Float32Array, Image, Indices

#: Depth in millimetres, (H, W). It is 0 where nothing is measured (REP-118).
Millimetres = NDArray[np.uint16]

#: Reflectivity (H, W) of surfaces, or one number for all.
Reflectivity = Float32Array | np.float32
#: Depth (H, W) in metres, and mask (H, W) of the pixels that have a measurement.
Measurement = tuple[Float32Array, NDArray[np.bool_]]

#: Standard deviation of the blur of a time-of-flight sensor, pixels. The blur mixes surfaces at edges.
_SPREAD = 0.5
#: Largest width of the footprint of a depth pixel in the colour image, pixels.
_WIDEST = 16
#: Rounding changes the inverse depth by up to this share.
_ROUNDING = np.float32(1e-3)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Planes that the pixels of a depth image show.

    ``depth``: (H, W) metres along the optical axis, inf where nothing is. ``inverse``: (H, W) 1 / depth, 0
    where nothing is. ``slope_x``, ``slope_y``: (H, W) change of the inverse per pixel to the right and
    downward. ``rays``: (3, H, W) x and y of the rays of the pixels (z is 1), and the length of the rays.
    ``cosine``: (H, W) cosine of the angle between ray and normal.
    """

    depth: Float32Array
    inverse: Float32Array
    slope_x: Float32Array
    slope_y: Float32Array
    rays: Float32Array
    cosine: Float32Array

    @classmethod
    def of(cls, depth: Float32Array, K: Array, rays: Float32Array) -> Surfaces:
        """Find the planes of exact depth (H, W). Differences of depth across an edge are not used."""
        with np.errstate(divide="ignore"):
            inverse = np.float32(1) / depth
        slope_x, slope_y = _slope(inverse, 1), _slope(inverse, 0)
        # the normal n, from n . X = 1
        x, y = np.float32(K[0, 0]) * slope_x, np.float32(K[0, 1]) * slope_x + np.float32(K[1, 1]) * slope_y
        z = inverse - x * rays[0] - y * rays[1]
        length = np.sqrt(x * x + y * y + z * z) * rays[2]
        cosine = np.divide(inverse, length, out=np.zeros_like(inverse), where=length > 0)
        return cls(depth, inverse, slope_x, slope_y, rays, np.clip(cosine, 0, 1))

    @property
    def angle(self) -> Float32Array:
        """(H, W) angle between ray and normal, radians."""
        return np.arccos(self.cosine)


def _slope(inverse: Float32Array, axis: int) -> Float32Array:
    """Change of the inverse depth per pixel along an axis. Of both neighbours of a pixel, the one that
    differs less is used, since it is on the same surface."""
    step = np.diff(inverse, axis=axis)
    missing = np.full_like(np.take(inverse, [0], axis=axis), np.inf)
    before, after = np.concatenate([missing, step], axis), np.concatenate([step, missing], axis)
    slope = np.where(np.abs(before) < np.abs(after), before, after)
    return np.where(np.isfinite(slope), slope, np.float32(0))


@dataclass(frozen=True, eq=False)
class DepthSensor:
    """Depth sensor of one camera.

    ``name``: name of the camera. The random numbers depend on it, on the seed and on the scene time.

    Raises:
        CameraError: No camera has such a size and K, or its projector is too far away for its nearest depth.
    """

    config: DepthSensorConfig
    name: str = ""

    def __post_init__(self) -> None:
        if self.optics.size[0] + self._margin > MAX_SIZE:
            near, baseline = self.config.range[0], self.config.baseline
            message = (
                f"from {near:g} m on, a projector that is {baseline:g} m away lights what is far outside"
            )
            raise CameraError(f"{message} of the image: give a farther nearest depth", key="range")

    @cached_property
    def optics(self) -> Camera:
        """Size, K and pose of the depth sensor. The world of this camera is the optical frame of the colour
        camera."""
        config = self.config
        if config.K is not None:
            k = np.array(config.K)
        else:
            fov = float(np.radians(60.0 if config.fov_deg is None else config.fov_deg))
            k = pinhole_of_fov(config.size, fov)
        rotation = from_degrees(config.rotation_deg).as_matrix().T
        return Camera(config.size, k, rotation, -rotation @ np.array(config.position))

    def camera_at(self, R: Array, t: Array) -> Camera:
        """Camera of the depth image. ``R`` (3, 3), ``t`` (3,): from ``map`` to the frame of the camera."""
        own = self.optics
        return own.at(own.R @ R, own.R @ t + own.t)

    def second_camera(self, camera: Camera) -> Camera | None:
        """Projector, or right imager, for the camera of :meth:`camera_at`; None for time of flight. The rows
        of this camera are rows of the depth image. The image of a projector is wider, so that it contains all
        that the sensor sees in its range."""
        if self.config.baseline is None:
            return None
        return self._second.at(camera.R, camera.t - np.array([self.config.baseline, 0, 0]))

    @cached_property
    def _second(self) -> Camera:
        k = self.optics.K.copy()
        k[0, 2] += self._margin
        width, height = self.optics.size
        return replace(self.optics, size=(width + self._margin, height), K=k)

    @property
    def needs_light(self) -> bool:
        """Whether the sensor depends on the reflectivity of surfaces."""
        return self.config.dark is not None

    def measure(
        self,
        depth: Float32Array,
        stamp: int,
        second: Float32Array | None = None,
        colours: Image | None = None,
    ) -> Millimetres:
        """Compute the depth (H, W) that the sensor measures, in millimetres.

        Args:
            depth: Exact depth (H, W) of :meth:`camera_at`, metres; inf where nothing is.
            stamp: Scene time, nanoseconds. The random errors depend on it.
            second: Exact depth of :meth:`second_camera`.
            colours: (H, W, 3) sRGB of :meth:`camera_at`. If None, surfaces are white.
        """
        config = self.config
        surfaces = Surfaces.of(depth, self.optics.K, self._rays)
        random = generator(config.seed, f"{self.name} depth", stamp)
        reflectivity = np.float32(1) if colours is None else infrared_reflectivity(colours)
        model = {
            "structured_light": self._structured_light,
            "active_stereo": self._active_stereo,
            "time_of_flight": self._time_of_flight,
        }[cast(str, config.model)]
        with np.errstate(all="ignore"):  # pixels that show nothing cause warnings
            measured, seen = model(surfaces, reflectivity, random)
            seen = seen & (surfaces.cosine > np.cos(np.radians(config.grazing_deg)))
            if second is not None:
                seen &= self._lit(surfaces, second)
            nearest, farthest = config.range
            seen &= (measured >= nearest) & (measured <= min(farthest, MAX_DEPTH))
            return np.where(seen, np.rint(1000 * measured), 0).astype(np.uint16)

    def _structured_light(
        self, surfaces: Surfaces, _: Reflectivity, random: np.random.Generator
    ) -> Measurement:
        """Axial and lateral noise of [Nguyen 2012], and rounding to steps of the disparity."""
        angle = np.minimum(surfaces.angle, np.float32(np.radians(self.config.grazing_deg)))
        away = np.float32(np.pi / 2) - angle
        lateral = np.float32(self.config.noise) * (np.float32(0.8) + np.float32(0.035) * angle / away)
        depth = _moved(surfaces, lateral, random)
        axial = np.float32(self.config.noise) * axial_noise(depth, angle)
        step = depth**2 * np.float32(cast(float, self.config.disparity_step) / self._focal_baseline)
        # the noise that Nguyen measured contains the rounding error
        variance = axial**2 - step**2 / 12
        depth += np.sqrt(np.maximum(variance, 0)) * normal_numbers(depth.shape, random)
        return self._rounded(depth), np.isfinite(depth)

    def _active_stereo(
        self, surfaces: Surfaces, reflectivity: Reflectivity, random: np.random.Generator
    ) -> Measurement:
        """Error of the disparity, dz = z^2 dd / (f B), and rounding to its steps."""
        noise = self.config.noise * cast(float, self.config.disparity_noise)
        disparity = np.float32(self._focal_baseline) * surfaces.inverse
        disparity += np.float32(noise) * normal_numbers(disparity.shape, random)
        depth = self._rounded(np.float32(self._focal_baseline) / disparity)
        return depth, (surfaces.inverse > 0) & (reflectivity >= cast(float, self.config.dark))

    def _time_of_flight(
        self, surfaces: Surfaces, reflectivity: Reflectivity, random: np.random.Generator
    ) -> Measurement:
        """Phase of the light that returns from all surfaces of a pixel, with noise [Lange 2001]."""
        config = self.config
        along = surfaces.rays[2]
        distance = np.where(surfaces.inverse > 0, surfaces.depth * along, np.float32(0))
        signal = np.where(distance > 0, reflectivity * surfaces.cosine / distance**2, np.float32(0))
        # if the sensor has no ambiguity, everything that is measured is within half a turn
        turn = config.ambiguity or 4 * MAX_DEPTH
        phase = np.float32(2 * np.pi / turn) * distance
        mixed = cv2.GaussianBlur(np.dstack([signal * np.cos(phase), signal * np.sin(phase)]), (3, 3), _SPREAD)
        signal = np.hypot(mixed[..., 0], mixed[..., 1])
        distance = np.float32(turn / (2 * np.pi)) * np.arctan2(mixed[..., 1], mixed[..., 0])
        sigma = config.noise * cast(float, config.sigma)
        noise = np.float32(sigma) * np.sqrt(signal + np.float32(cast(float, config.background))) / signal
        distance = np.mod(distance + noise * normal_numbers(distance.shape, random), np.float32(turn))
        return distance / along, (signal > 0) & (signal >= cast(float, config.dark))

    def _lit(self, surfaces: Surfaces, second: Float32Array) -> NDArray[np.bool_]:
        """Mask (H, W) of pixels with a surface that the second camera sees, too. It sees the surface if its
        depth image ``second`` shows nothing nearer there."""
        inverse = surfaces.inverse
        shift = np.float32(self._focal_baseline)
        columns = np.arange(inverse.shape[1], dtype=np.float32) + np.float32(self._margin)
        place = np.rint(columns - shift * inverse).astype(np.intp)
        inside = (place >= 0) & (place < second.shape[1])
        behind = np.float32(1) / np.take_along_axis(second, np.where(inside, place, 0), axis=1)
        # the same plane in the second image; a surface that faces away has no width there
        width = 1 - shift * surfaces.slope_x
        slack = np.abs(surfaces.slope_x / width) / 2 + _ROUNDING * inverse
        return inside & (width > 0) & (behind <= inverse + slack)

    def _rounded(self, depth: Float32Array) -> Float32Array:
        """Depth (H, W), rounded to the nearest step of the disparity."""
        step = cast(float, self.config.disparity_step)
        if step == 0:
            return depth
        quantum = np.float32(self._focal_baseline / step)
        return quantum / np.rint(quantum / depth)

    @property
    def _focal_baseline(self) -> float:
        return float(self.optics.K[0, 0]) * cast(float, self.config.baseline)

    @cached_property
    def _margin(self) -> int:
        """Number of additional columns at the left of a projector's image; 0 for a right imager."""
        if self.config.model != "structured_light":
            return 0
        return int(np.ceil(self._focal_baseline / self.config.range[0]))

    @cached_property
    def _rays(self) -> Float32Array:
        width, height = self.optics.size
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        x, y = np.moveaxis(self.optics.rays(np.dstack([columns, rows])), -1, 0)[:2]
        return np.stack([x, y, np.sqrt(1 + x * x + y * y)]).astype(np.float32)


def infrared_reflectivity(colours: Image) -> Float32Array:
    """Reflectivity (H, W) of surfaces with sRGB colours (H, W, 3), at the wavelength of depth sensors: the
    square root of the luminance, since dyes of cloth and carpets absorb less in the near infrared."""
    return np.sqrt(luminance(srgb_to_light(colours)))


def axial_noise(depth: Float32Array, angle: Float32Array) -> Float32Array:
    """Standard deviation of the depth of structured light, metres [Nguyen 2012, eq. 2 and 3].

    Args:
        depth: Metres along the optical axis.
        angle: Angle between ray and normal, radians.
    """
    away = np.float32(np.pi / 2) - angle
    return np.asarray(
        0.0012 + 0.0019 * (depth - np.float32(0.4)) ** 2 + 0.0001 / np.sqrt(depth) * (angle / away) ** 2,
        dtype=np.float32,
    )


def _moved(surfaces: Surfaces, lateral: Float32Array, random: np.random.Generator) -> Float32Array:
    """Depth (H, W) when each pixel sees the surface of a randomly displaced pixel. The plane of the displaced
    pixel is intersected with the ray of the pixel itself, so that flat surfaces stay flat. ``lateral``: (H,
    W) standard deviation of the displacement along x and along y, pixels."""
    height, width = surfaces.inverse.shape
    across, down = (lateral * normal_numbers(lateral.shape, random) for _ in range(2))
    columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    x = np.clip(np.rint(columns + across), 0, width - 1)
    y = np.clip(np.rint(rows + down), 0, height - 1)
    places = y.astype(np.int32) * np.int32(width) + x.astype(np.int32)
    inverse, slope_x, slope_y = (
        part.reshape(-1).take(places) for part in (surfaces.inverse, surfaces.slope_x, surfaces.slope_y)
    )
    moved = inverse + slope_x * (columns - x) + slope_y * (rows - y)
    # if the plane would be behind the sensor, the depth of the displaced pixel is used
    return np.asarray(1 / np.where(moved > 0, moved, inverse), dtype=np.float32)


def metres(depth: Millimetres) -> Float32Array:
    """Convert depth to metres (H, W), as depth_image_proc converts 16UC1 to 32FC1. NaN where nothing is
    measured."""
    return np.where(depth > 0, depth * np.float32(0.001), np.float32(np.nan))


def points_of(depth: Float32Array, rays: Array) -> Float32Array:
    """Points (H, W, 3) of depth (H, W) in metres, optical frame. NaN where the depth is not finite. ``rays``:
    x and y (2, H W) of the rays of the pixels (z is 1)."""
    points = np.empty((*depth.shape, 3), np.float32)
    points[..., 2] = np.where(np.isfinite(depth), depth, np.float32(np.nan))
    points[..., 0], points[..., 1] = (ray.reshape(depth.shape) * points[..., 2] for ray in rays)
    return points


def aligned(depth: Millimetres, rays: Array, camera: Camera, other: Camera) -> Millimetres:
    """Convert the depth of one camera to the pixels of another, as drivers register depth to the colour
    image.

    Each depth pixel has a footprint in the other image and covers the pixels with centres in it. Where
    several footprints overlap, the nearest surface counts. Surfaces that only the other camera sees have no
    depth.

    Args:
        depth: (h, w) of ``camera``.
        rays: x and y (2, h w) of the rays of ``camera``.
        camera: Camera of the depth, without distortion, in the same world as ``other``.
        other: Camera of the result, with any lens.

    Returns:
        (H, W) along the axis of ``other``.
    """
    width, height = other.size
    seen = np.flatnonzero(depth)
    z = depth.reshape(-1)[seen] * np.float32(0.001)
    points = _in_frame_of(other, camera, np.stack([*rays.astype(np.float32)[:, seen] * z, z]))
    with np.errstate(all="ignore"):
        # half of the footprint, which is parallel to the image plane of the other camera
        half = z / points[2] / 2
        spans = [
            _span(pixels, half * np.float32(other.K[axis, axis] / camera.K[axis, axis]), size)
            for axis, (pixels, size) in enumerate(zip(_pixels(other, points), other.size, strict=True))
        ]
        levels = np.rint(1000 * points[2])
    (first, columns), (top, rows) = spans
    inside = (columns > 0) & (rows > 0) & (levels > 0) & (levels <= MAX_DEPTH * 1000)
    first, columns, top, rows = (part[inside] for part in (first, columns, top, rows))
    levels = levels[inside].astype(np.uint16)
    out = np.full(width * height, np.iinfo(np.uint16).max, np.uint16)
    for right in range(columns.max(initial=0)):
        for below in range(rows.max(initial=0)):
            covered = np.flatnonzero((right < columns) & (below < rows))
            places = (top[covered] + below) * width + first[covered] + right
            np.minimum.at(out, places, levels[covered])
    out[out == np.iinfo(np.uint16).max] = 0
    return out.reshape(height, width)


def _in_frame_of(other: Camera, camera: Camera, points: Float32Array) -> Float32Array:
    """Transform points (3, N) from the optical frame of ``camera`` to the optical frame of ``other``."""
    turn = other.R @ camera.R.T
    shift = other.t - turn @ camera.t
    return np.asarray(turn.astype(np.float32) @ points + shift.astype(np.float32)[:, None])


def _pixels(camera: Camera, points: Float32Array) -> Float32Array:
    """Pixels (2, N) of points (3, N) in the optical frame."""
    if camera.distorted:
        return camera.project_optical(points.T)[0].T.astype(np.float32)
    plane = points[:2] / points[2]
    return camera.K[:2, :2].astype(np.float32) @ plane + camera.K[:2, 2:].astype(np.float32)


def _span(centre: Float32Array, half: Float32Array, size: int) -> tuple[Indices, Indices]:
    """First pixel (N,) and number of pixels (N,) along one axis that footprints cover.

    Args:
        centre: (N,) middles of the footprints, pixels; NaN for none.
        half: (N,) half of the width of the footprints, pixels.
        size: Number of pixels of the image.
    """
    half = np.minimum(half, np.float32(_WIDEST / 2))
    # fmin turns NaN into the end of the image, too
    first, last = (
        np.fmax(np.fmin(np.ceil(end), size), 0).astype(np.intp) for end in (centre - half, centre + half)
    )
    return first, last - first


#: Reflectivity of a surface without colours.
_PLAIN = 0.5


def reflectivity(mesh: Mesh, triangles: NDArray[np.integer], weights: Array) -> Array:
    """Diffuse reflectivity (N,), 0 to 1, of points of a mesh in the near infrared, from its colours.

    Args:
        mesh: Mesh with vertex colours or a texture.
        triangles: (N,) triangles.
        weights: (N, 2) barycentric weights of the second and third corners of the triangles.
    """
    shares = np.column_stack([1 - weights.sum(axis=1), weights])
    if mesh.texture is not None and mesh.uv is not None and mesh.uv_triangles is not None:
        u, v = np.einsum("nk,nkc->cn", shares, mesh.uv[mesh.uv_triangles[triangles]])
        height, width = mesh.texture.shape[:2]
        column = np.minimum((np.mod(u, 1.0) * width).astype(int), width - 1)
        row = np.minimum((np.mod(1 - v, 1.0) * height).astype(int), height - 1)
        return _infrared(mesh.texture[row, column])
    if mesh.colors is not None:
        corners = _infrared(mesh.colors[mesh.triangles[triangles]])
        return np.asarray((shares * corners).sum(axis=1))
    return np.full(len(triangles), _PLAIN)


def _infrared(colors: NDArray[np.uint8]) -> Array:
    """Reflectivity (...) of sRGB colours (..., 3)."""
    return np.asarray(infrared_reflectivity(colors.reshape(1, -1, 3)).reshape(colors.shape[:-1]), dtype=float)
