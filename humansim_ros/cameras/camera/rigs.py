"""Camera rigs around a target point: ring, wall, dome, stereo pair.

All cameras look at the target. Azimuths are radians from +x towards +y in ``map``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.camera.lens import Lens
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: Most cameras of a rig.
MAX_CAMERAS = 1000
#: Angle between consecutive cameras of a dome, radians. It spreads them evenly.
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Optics:
    """Image size and lens of all cameras of a rig, with square pixels and a centred principal point.
    ``size``: (width, height) pixels. ``fov``: horizontal field of view through the lens, radians.
    ``distortion``, ``model``: see :class:`Camera`."""

    size: tuple[int, int] = (640, 480)
    fov: float = math.radians(60)
    distortion: tuple[float, ...] = ()
    model: str | None = None

    def camera(self, position: ArrayLike, target: ArrayLike) -> Camera:
        """Camera at a position (3,) that looks at a target (3,).

        Raises:
            CameraError: The field of view of the lens is smaller than ``fov``.
        """
        ideal = Camera.look_at(position, target, self.size, self.fov)
        lens = Lens.of(self.distortion, self.model)
        edge = lens.distort([[np.tan(self.fov / 2), 0.0]])[0, 0]
        if not edge > 0:
            widest = np.degrees(2 * np.arctan(lens.valid_radius))
            raise CameraError(f"the field of view of this lens is at most {widest:.1f} degrees", key="fov")
        k = ideal.K.copy()
        k[[0, 1], [0, 1]] = self.size[0] / 2 / edge
        return replace(ideal, K=k, distortion=self.distortion, model=self.model)


def ring(
    count: int, radius: float, height: float, look_at: ArrayLike, optics: Optics, start: float = 0.0
) -> dict[str, Camera]:
    """Place cameras evenly on a circle around a target.

    Args:
        count: Number of cameras.
        radius: Radius of the circle, metres.
        height: Height of the circle above the floor, metres.
        look_at: Target, (3,) metres in ``map``.
        optics: Image size and lens of the cameras.
        start: Azimuth of the first camera, radians; the next cameras follow counterclockwise.

    Raises:
        CameraError: A number is out of range, or a camera does not see the target.
    """
    target = _checked_target(count, radius, look_at)
    azimuths = start + np.arange(count) * 2 * np.pi / count
    circle = np.column_stack([np.cos(azimuths), np.sin(azimuths)])
    positions = np.column_stack([target[:2] + radius * circle, np.full(count, height)])
    return _named(positions, target, optics)


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
    """Place cameras on a wall in rows and columns.

    Args:
        rows: Number of rows.
        columns: Number of columns.
        spacing: Distance of neighbouring cameras, metres.
        radius: Horizontal distance of the wall from the target, metres.
        height: Height of the centre of the wall above the floor, metres.
        look_at: Target, (3,) metres in ``map``.
        optics: Image size and lens of the cameras.
        start: Azimuth of the centre of the wall, radians.

    Returns:
        Cameras row by row; as seen from the target, from the top left to the right.

    Raises:
        CameraError: A number is out of range, or a camera does not see the target.
    """
    target = _checked_target(rows * columns if min(rows, columns) > 0 else 0, radius, look_at)
    if not 0 < spacing < np.inf:
        raise CameraError(f"must be above zero, not {spacing:g}", key="spacing")
    out = np.array([np.cos(start), np.sin(start), 0.0])
    right = np.array([out[1], -out[0], 0.0])
    across = (np.arange(columns) - (columns - 1) / 2) * spacing
    up = ((rows - 1) / 2 - np.arange(rows)) * spacing
    center = np.array([*target[:2], height]) + radius * out
    positions = center + (up[:, None, None] * [0.0, 0.0, 1.0]) + across[None, :, None] * right
    return _named(positions.reshape(-1, 3), target, optics)


def dome(
    count: int, radius: float, look_at: ArrayLike, optics: Optics, start: float = 0.0
) -> dict[str, Camera]:
    """Distribute cameras evenly over the upper half of a sphere around a target, on a spiral.

    Args:
        count: Number of cameras. Each has the same share of the half sphere.
        radius: Radius of the sphere, metres.
        look_at: Target, (3,) metres in ``map``.
        optics: Image size and lens of the cameras.
        start: Azimuth of the first and lowest camera, radians.

    Raises:
        CameraError: A number is out of range, or a camera does not see the target.
    """
    target = _checked_target(count, radius, look_at)
    sine = (np.arange(count) + 0.5) / count
    azimuths = start + np.arange(count) * _GOLDEN_ANGLE
    cosine = np.sqrt(1 - sine * sine)
    directions = np.column_stack([cosine * np.cos(azimuths), cosine * np.sin(azimuths), sine])
    return _named(target + radius * directions, target, optics)


def stereo(
    baseline: float, radius: float, height: float, look_at: ArrayLike, optics: Optics, start: float = 0.0
) -> dict[str, Camera]:
    """Place a stereo pair, ``left`` and ``right``, with parallel axes and the conventions of ROS.

    Both cameras have the same K and D, and R is the identity. P differs only in P[0, 3], which is -fx
    baseline for the right camera. So P projects points of the *left* optical frame to pixels of the right
    rectified image.

    Args:
        baseline: Distance of the cameras, metres.
        radius: Horizontal distance of the centre of the pair from the target, metres.
        height: Height of the pair above the floor, metres.
        look_at: Target of the centre of the pair, (3,) metres in ``map``.
        optics: Image size and lens of the cameras.
        start: Azimuth of the pair, radians.

    Raises:
        CameraError: A number is out of range, or a camera does not see the target.
    """
    target = _checked_target(2, radius, look_at)
    if not 0 < baseline < np.inf:
        raise CameraError(f"must be above zero, not {baseline:g}", key="baseline")
    position = np.array([*target[:2], height]) + radius * np.array([np.cos(start), np.sin(start), 0.0])
    center = optics.camera(position, target)
    pair = {}
    for name, side in (("left", -0.5), ("right", 0.5)):
        rectified = center.rectified_projection.copy()
        if name == "right":
            rectified[0, 3] = -rectified[0, 0] * baseline
        t = center.t - np.array([side * baseline, 0.0, 0.0])
        pair[name] = replace(center, t=t, rectification=np.eye(3), rectified=rectified)
    _check_all_see(pair, target)
    return pair


def _checked_target(count: int, radius: float, look_at: ArrayLike) -> Array:
    """Check the arguments of a rig, and return its target."""
    if not 0 < count <= MAX_CAMERAS:
        raise CameraError(f"a rig has 1 to {MAX_CAMERAS} cameras, not {count}")
    if not 0 < radius < np.inf:
        raise CameraError(f"must be above zero, not {radius:g}", key="radius")
    target = np.asarray(look_at, dtype=float)
    if target.shape != (3,) or not np.isfinite(target).all():
        raise CameraError("must be three numbers, x y z", key="look_at")
    return target


def _named(positions: Iterable[Array], target: Array, optics: Optics) -> dict[str, Camera]:
    cameras = {
        f"camera_{number}": optics.camera(position, target) for number, position in enumerate(positions, 1)
    }
    _check_all_see(cameras, target)
    return cameras


def _check_all_see(cameras: dict[str, Camera], target: Array) -> None:
    for name, camera in cameras.items():
        pixel = camera.project(target[None])[0][0]
        if not ((pixel >= -0.5) & (pixel < np.array(camera.size) - 0.5)).all():
            raise CameraError(f"{name} does not see its target")
