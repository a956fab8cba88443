"""Cameras set up around a place: on a ring, a wall, a dome, or as a stereo pair.

All look at one point of ``map`` and see it. Azimuths are radians from +x to the left (towards +y).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.lens import Lens
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: Cameras of the largest rig.
MAX_CAMERAS = 1000
#: The turn between neighbours by which a dome spreads its cameras evenly.
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Optics:
    """What all cameras of a rig have: the principal point in the middle, square pixels.

    ``size``: (width, height) pixels. ``fov``: horizontal field of view through the lens, radians.
    ``distortion``, ``model``: as of :class:`Camera`. Raises CameraError where the lens does not see so wide.
    """

    size: tuple[int, int] = (640, 480)
    fov: float = np.radians(60.0)
    distortion: tuple[float, ...] = ()
    model: str | None = None

    def camera(self, position: ArrayLike, target: ArrayLike) -> Camera:
        """The camera at a place (3,) that looks at another (3,)."""
        ideal = Camera.look_at(position, target, self.size, self.fov)
        lens = Lens.of(self.distortion, self.model)
        edge = lens.distort([[np.tan(self.fov / 2), 0.0]])[0, 0]
        if not edge > 0:
            widest = np.degrees(2 * np.arctan(lens.valid_radius))
            raise CameraError(f"this lens sees no more than {widest:.1f} degrees", key="fov")
        k = ideal.K.copy()
        k[[0, 1], [0, 1]] = self.size[0] / 2 / edge
        return replace(ideal, K=k, distortion=lens.coefficients, model=lens.model)


def ring(
    count: int, radius: float, height: float, look_at: ArrayLike, optics: Optics, start: float = 0.0
) -> dict[str, Camera]:
    """``count`` cameras evenly on a circle of ``radius`` about a point (3,), ``height`` over the floor.

    The first stands at azimuth ``start``; the others follow to the left.
    """
    middle = _checked(count, radius, look_at)
    azimuths = start + np.arange(count) * 2 * np.pi / count
    around = np.column_stack([np.cos(azimuths), np.sin(azimuths)])
    places = np.column_stack([middle[:2] + radius * around, np.full(count, height)])
    return _named(places, middle, optics)


def grid(
    rows: int,
    columns: int,
    spacing: float,
    radius: float,
    height: float,
    look_at: ArrayLike,
    optics: Optics,
    start: float = 0.0,
) -> dict[str, Camera]:
    """A wall of cameras, ``spacing`` metres apart, ``radius`` away from a point (3,) that all look at.

    The middle of the wall is at azimuth ``start`` and ``height``. Seen from the point, the first camera is at
    the top left, and each row goes to the right.
    """
    middle = _checked(rows * columns if min(rows, columns) > 0 else 0, radius, look_at)
    if not 0 < spacing < np.inf:
        raise CameraError(f"must be above zero, not {spacing:g}", key="spacing")
    out = np.array([np.cos(start), np.sin(start), 0.0])
    right = np.array([out[1], -out[0], 0.0])
    across = (np.arange(columns) - (columns - 1) / 2) * spacing
    up = ((rows - 1) / 2 - np.arange(rows)) * spacing
    foot = np.array([*middle[:2], height]) + radius * out
    places = foot + (up[:, None, None] * [0.0, 0.0, 1.0]) + across[None, :, None] * right
    return _named(places.reshape(-1, 3), middle, optics)


def dome(
    count: int, radius: float, look_at: ArrayLike, optics: Optics, start: float = 0.0
) -> dict[str, Camera]:
    """``count`` cameras evenly over the half of a sphere of ``radius`` that is above a point (3,).

    They wind up a spiral of golden angles, each with the same share of the half sphere; the first, the
    lowest, is at azimuth ``start``.
    """
    middle = _checked(count, radius, look_at)
    sine = (np.arange(count) + 0.5) / count
    azimuths = start + np.arange(count) * _GOLDEN_ANGLE
    flat = np.sqrt(1 - sine * sine)
    directions = np.column_stack([flat * np.cos(azimuths), flat * np.sin(azimuths), sine])
    return _named(middle + radius * directions, middle, optics)


def stereo(
    baseline: float, radius: float, height: float, look_at: ArrayLike, optics: Optics, start: float = 0.0
) -> dict[str, Camera]:
    """``left`` and ``right``, ``baseline`` metres apart and parallel, as ROS wants a stereo pair.

    The point between them is at azimuth ``start``, ``radius`` and ``height`` from a point (3,) that it looks
    at. Both have the same K, D and P, R is the identity, and the right one's P[0, 3] is -fx baseline: it
    takes points of the *left* optical frame to pixels of the right rectified image.
    """
    middle = _checked(2, radius, look_at)
    if not 0 < baseline < np.inf:
        raise CameraError(f"must be above zero, not {baseline:g}", key="baseline")
    place = np.array([*middle[:2], height]) + radius * np.array([np.cos(start), np.sin(start), 0.0])
    between = optics.camera(place, middle)
    pair = {}
    for name, side in (("left", -0.5), ("right", 0.5)):
        rectified = between.rectified_projection.copy()
        if name == "right":
            rectified[0, 3] = -rectified[0, 0] * baseline
        t = between.t - np.array([side * baseline, 0.0, 0.0])
        pair[name] = replace(between, t=t, rectification=np.eye(3), rectified=rectified)
    _check_all_see(pair, middle)
    return pair


def _checked(count: int, radius: float, look_at: ArrayLike) -> Array:
    """The point that is looked at, if a rig can be set up around it."""
    if not 0 < count <= MAX_CAMERAS:
        raise CameraError(f"a rig has 1 to {MAX_CAMERAS} cameras, not {count}")
    if not 0 < radius < np.inf:
        raise CameraError(f"must be above zero, not {radius:g}", key="radius")
    middle = np.asarray(look_at, dtype=float)
    if middle.shape != (3,) or not np.isfinite(middle).all():
        raise CameraError("must be three numbers, x y z", key="look_at")
    return middle


def _named(places: Iterable[Array], target: Array, optics: Optics) -> dict[str, Camera]:
    cameras = {f"camera_{number}": optics.camera(place, target) for number, place in enumerate(places, 1)}
    _check_all_see(cameras, target)
    return cameras


def _check_all_see(cameras: dict[str, Camera], target: Array) -> None:
    for name, camera in cameras.items():
        pixel = camera.project(target[None])[0][0]
        if not ((pixel >= -0.5) & (pixel < np.array(camera.size) - 0.5)).all():
            raise CameraError(f"{name} does not see the point that is looked at")
