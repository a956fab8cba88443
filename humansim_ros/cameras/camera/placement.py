"""Placement of a rig: the pose of the world of a calibration file in ``map``, and ways to find it.

The world of most calibrations is the first camera or a board. A placement moves all cameras of a file
together, so that ``map`` has its floor at z = 0. The functions ``place_by_…`` find the placement from the
height and tilt of a camera, from floor points, from a board, or by levelling. Their cameras are in the world
of the file, in metres. If the input does not determine the heading, the smallest rotation is used. If it does
not determine the position, the point at which the cameras look is placed above (0, 0).

A file of floor points (YAML or JSON) has a list ``points``. Each point has ``xyz`` (3 numbers, in the unit
and axes of the calibration file) or ``pixels`` (x, y by name of camera, for two or more cameras). It has
``map`` (x, y in metres) if its place in the room is known.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, model_validator

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.errors import CameraError, unknown
from humansim_ros.files.yaml import Section, read_yaml, validated
from humansim_ros.geometry import angle_between, from_degrees
from humansim_ros.types import Array

#: Optical axes meet in a point if the condition number of their equations is below this.
_PARALLEL = 1e4


@dataclass(frozen=True)
class RigPlacement:
    """Pose of the world of a file in ``map``: x_map = rotation x_file + position.

    ``rotation`` (3, 3), ``position`` (3,) metres.
    """

    rotation: Array = field(default_factory=lambda: np.eye(3))
    position: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def from_degrees(cls, rotation_deg: ArrayLike, position: ArrayLike = (0.0, 0.0, 0.0)) -> RigPlacement:
        """Create a placement from angles (3,) about the x axis of ``map``, then y, then z, in degrees."""
        rotation = from_degrees(np.asarray(rotation_deg, dtype=float)).as_matrix()
        return cls(np.asarray(rotation), np.asarray(position, dtype=float))

    @property
    def rotation_deg(self) -> Array:
        """Angles (3,) of :meth:`from_degrees`, degrees."""
        with warnings.catch_warnings():
            # a quarter turn about y has several triples of angles, and each is correct
            warnings.simplefilter("ignore")
            angles = scipy.spatial.transform.Rotation.from_matrix(self.rotation).as_euler("xyz", degrees=True)
        return np.asarray(angles, dtype=float)

    def points(self, points: ArrayLike) -> Array:
        """Convert points (..., 3) of the file to ``map``."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.position

    def camera(self, camera: Camera) -> Camera:
        """Convert a camera from the world of the file to ``map``."""
        r = camera.R @ self.rotation.T
        return replace(camera, R=r, t=camera.t - r @ self.position)

    def moved(self, offset: ArrayLike) -> RigPlacement:
        """The same placement, moved by an offset (3,) in ``map``, metres."""
        return RigPlacement(self.rotation, self.position + np.asarray(offset, dtype=float))


def common_point(cameras: Iterable[Camera]) -> Array | None:
    """Point (3,) nearest to the optical axes of all cameras. Returns None if the axes are parallel, or if the
    point is behind most cameras."""
    rig = list(cameras)
    axes = np.array([camera.R[2] for camera in rig])
    centers = np.array([camera.center for camera in rig])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    if np.linalg.cond(total) > _PARALLEL:
        return None
    point = np.linalg.solve(total, np.einsum("nij,nj->i", across, centers))
    in_front = np.einsum("ni,ni->n", point - centers, axes) > 0
    return np.asarray(point, dtype=float) if in_front.mean() > 0.5 else None


BoardSide = Literal["floor", "z_up", "z_down", "standing"]
_UP = np.array([0.0, 0.0, 1.0])
#: Heights in metres: assumed height of the point at which cameras look; assumed height of cameras that do not
#: look at a common point; lowest height of a camera.
_TARGET_HEIGHT, _CAMERA_HEIGHT, _LOWEST_CAMERA = 1.0, 1.8, 0.3
#: Assumed distance to the target for cameras that do not look at a common point: least, most, usual, metres.
_NEAREST, _FARTHEST, _AHEAD = 1.0, 10.0, 3.0
#: The horizontal axes of cameras determine the vertical if the smallest eigenvalue per camera is above this.
_DETERMINED = 0.01
#: Cameras stand upright if the length of their mean up axis is above this.
_UPRIGHT = 0.3
#: Smallest width of the area of floor points, as a share of its length.
_NARROW = 0.02


_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
#: In the text of a floor point, ``map:`` is followed by a place in ``map``; other names are those of cameras.
_MAP = "map"


class FloorPoint(Section):
    """A point on the floor, in the world of the file or as pixels of cameras. ``xyz``: (3,), metres; in a
    file, in its unit and axes. ``pixels``: pixel (2,) by name of camera, for two or more cameras. ``map``: x,
    y in ``map``, metres; None if unknown."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    xyz: tuple[_Number, _Number, _Number] | None = None
    pixels: dict[str, tuple[_Number, _Number]] = Field(default_factory=dict)
    map: tuple[_Number, _Number] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> FloorPoint:
        if (self.xyz is None) == (not self.pixels):
            raise ValueError("needs xyz, or pixels of two cameras or more")
        return self

    def converted(self, in_metres: Array) -> FloorPoint:
        """The same point with ``xyz`` multiplied by a matrix (3, 3)."""
        if self.xyz is None:
            return self
        return self.model_copy(update={"xyz": tuple((in_metres @ self.xyz).tolist())})


@dataclass(frozen=True)
class FoundPlacement:
    """A placement, and how well it agrees with the input.

    ``residuals``: root mean square errors by name. ``reprojection_px``, ``plane_mm`` and ``map_mm`` are
    errors of floor points. ``roll_deg`` is the roll of the cameras. ``axes_mm`` is the distance of the
    optical axes from their common point. ``scale``: ratio of distances in ``map`` to distances in the file,
    if floor points give both. ``points``: the floor points (N, 3) in ``map``.
    """

    placement: RigPlacement
    residuals: dict[str, float]
    scale: float | None = None
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))


def place_by_tilt(
    cameras: Mapping[str, Camera], name: str, height: float, tilt: float, roll: float = 0.0
) -> FoundPlacement:
    """Place a rig by the height and the tilt of one camera.

    Args:
        cameras: Cameras in the world of the file.
        name: Name of the camera.
        height: Height of this camera above the floor, metres.
        tilt: Angle by which the camera looks down, radians. It is negative if the camera looks up.
        roll: Angle by which the camera is turned clockwise about its optical axis, radians.

    Returns:
        The placement. Its residual ``roll_deg`` is the roll of the other cameras.
    """
    if not abs(tilt) <= np.pi / 2:
        raise CameraError("must be from -90 to 90 degrees", key="tilt")
    camera = cameras[name]
    upright = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    in_camera = scipy.spatial.transform.Rotation.from_rotvec([0, 0, -roll]).apply(upright)
    placement = _standing(np.asarray(in_camera @ camera.R), camera.center, height)
    others = {key: one for key, one in cameras.items() if key != name}
    return FoundPlacement(_over_origin(placement, cameras), _rolls(placement, others))


def place_by_floor(cameras: Mapping[str, Camera], points: Sequence[FloorPoint]) -> FoundPlacement:
    """Place a rig by three or more points of the floor. The place of some points in ``map`` may be known.

    Raises:
        CameraError: There are too few points, they lie on a line, or the rays of their pixels do not meet.
    """
    if len(points) < 3:
        raise CameraError(f"the plane of the floor needs three points or more, not {len(points)}")
    residuals: dict[str, float] = {}
    scale = None
    positions, errors = [], []
    for number, point in enumerate(points, 1):
        if point.xyz is not None:
            positions.append(np.asarray(point.xyz, dtype=float))
        else:
            position, error = triangulate(cameras, point.pixels, number)
            positions.append(position)
            errors.append(error)
    if errors:
        residuals["reprojection_px"] = _rms(errors)
    floor = np.array(positions)
    middle = floor.mean(0)
    _, spread, axes = np.linalg.svd(floor - middle)
    if spread[1] <= _NARROW * spread[0]:
        raise CameraError("the floor points lie on a line: give points that are apart in both directions")
    residuals["plane_mm"] = _rms((floor - middle) @ axes[2]) * 1000
    centers = np.array([camera.center for camera in cameras.values()])
    above = float(np.median((centers - middle) @ axes[2]))
    placement = _standing(axes[2] if above >= 0 else -axes[2], middle, 0.0)
    known = [index for index, point in enumerate(points) if point.map is not None]
    if known:
        on_map = np.array([points[index].map for index in known], dtype=float)
        placement, residuals["map_mm"], scale = _aligned(placement, floor[known], on_map)
    else:
        placement = _over_origin(placement, cameras)
    return FoundPlacement(placement, residuals, scale, placement.points(floor))


def place_by_board(
    cameras: Mapping[str, Camera], board: Array, side: BoardSide = "floor", height: float = 0.0
) -> FoundPlacement:
    """Place a rig by a board that lies on the floor or stands upright.

    Args:
        cameras: Cameras in the world of the file.
        board: Pose (4, 4) of the board in the world of the file.
        side: How the board stands or lies. ``floor``: it lies with the visible side up. ``z_up``, ``z_down``:
            it lies with its z axis up or down. ``standing``: its y axis points down, as boards are printed.
        height: Height of the origin of the board above the floor, metres.
    """
    centers = np.array([camera.center for camera in cameras.values()])
    above = float(np.median((centers - board[:3, 3]) @ board[:3, 2]))
    ups = {"z_up": board[:3, 2], "z_down": -board[:3, 2], "standing": -board[:3, 1]}
    ups["floor"] = ups["z_up"] if above >= 0 else ups["z_down"]
    # the x axis of the board is the x axis of map
    up, along = ups[side], board[:3, 0]
    rotation = np.stack([along, np.cross(up, along), up])
    placement = RigPlacement(rotation, np.array([0, 0, height]) - rotation @ board[:3, 3])
    return FoundPlacement(placement, _rolls(placement, cameras))


def place_by_level(cameras: Mapping[str, Camera], height: float | None = None) -> FoundPlacement:
    """Place a rig of upright cameras: the horizontal axes of their images are horizontal in ``map``.

    Args:
        cameras: Cameras in the world of the file.
        height: Mean height of the cameras above the floor, metres. If None, the point at which the cameras
            look is assumed to be 1 m above the floor. If they do not look at a point, the cameras are assumed
            to be at 1.8 m.

    Raises:
        CameraError: The cameras have no common up direction.
    """
    rig = list(cameras.values())
    mean = -np.mean([camera.R[1] for camera in rig], axis=0)
    if np.linalg.norm(mean) < _UPRIGHT:
        raise CameraError("the cameras do not stand upright: place them by floor points")
    right = np.array([camera.R[0] for camera in rig])
    values, vectors = np.linalg.eigh(right.T @ right)
    up = mean / np.linalg.norm(mean)
    if values[1] > _DETERMINED * len(rig):  # otherwise all cameras look in one direction
        up = vectors[:, 0] * (1 if vectors[:, 0] @ mean >= 0 else -1)
    centers = np.array([camera.center for camera in rig])
    placement = _standing(up, centers.mean(0), _CAMERA_HEIGHT if height is None else height)
    target = common_point(rig)
    if height is None and target is not None:
        offset = _TARGET_HEIGHT - float(placement.points(target)[2])
        lowest = float(placement.points(centers)[:, 2].min()) + offset
        placement = placement.moved([0, 0, offset + max(_LOWEST_CAMERA - lowest, 0.0)])
    residuals = _rolls(placement, cameras)
    if target is not None:
        across = [_distance_to_axis(camera, target) for camera in rig]
        residuals["axes_mm"] = _rms(across) * 1000
    return FoundPlacement(_over_origin(placement, cameras), residuals)


def turned(found: FoundPlacement, yaw: float, at: ArrayLike) -> FoundPlacement:
    """The same placement, turned about the z axis of ``map`` by ``yaw`` (radians), then moved by ``at`` (x, y
    in metres)."""
    turn = RigPlacement(
        scipy.spatial.transform.Rotation.from_rotvec(yaw * _UP).as_matrix(),
        np.array([*np.asarray(at, dtype=float), 0.0]),
    )
    placement = RigPlacement(turn.rotation @ found.placement.rotation, turn.points(found.placement.position))
    return replace(found, placement=placement, points=turn.points(found.points))


def triangulate(
    cameras: Mapping[str, Camera], pixels: Mapping[str, ArrayLike], number: int = 1
) -> tuple[Array, float]:
    """Find the point (3,) with projections nearest to the given pixels (least squares). Returns also the root
    mean square of the distances between projections and pixels.

    Args:
        cameras: Cameras by name.
        pixels: Pixel (2,) of the point by name of camera, for two or more cameras.
        number: Number of the point, for errors.

    Raises:
        CameraError: A camera is unknown, or the rays do not meet in front of the cameras.
    """
    missing = [name for name in pixels if name not in cameras]
    if missing:
        raise CameraError(f"floor point {number}: {unknown('camera', missing[0], cameras)}")
    if len(pixels) < 2:
        raise CameraError(f"floor point {number}: needs pixels of two cameras or more, or a point in space")
    seen = [cameras[name] for name in pixels]
    wanted = np.array([pixels[name] for name in pixels], dtype=float)
    rays = np.array([camera.rays(pixel) @ camera.R for camera, pixel in zip(seen, wanted, strict=True)])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    centers = np.array([camera.center for camera in seen])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    if not np.isfinite(rays).all():
        raise CameraError(f"floor point {number}: a pixel is outside the view of the lens")
    if np.linalg.cond(across.sum(0)) > 1e8:
        raise CameraError(f"floor point {number}: the rays of its pixels are parallel")
    start = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centers))
    if (np.einsum("ni,ni->n", start - centers, rays) <= 0).any():
        raise CameraError(f"floor point {number}: the rays of its pixels do not meet in front of the cameras")

    def errors(point: Array) -> Array:
        found = np.array([camera.project(point[None])[0][0] for camera in seen])
        return np.nan_to_num((found - wanted).ravel(), nan=1e6)

    solved = scipy.optimize.least_squares(
        errors, start, x_scale=float(np.linalg.norm(start - centers, axis=1).mean())
    )
    return np.asarray(solved.x, dtype=float), _rms(np.linalg.norm(solved.fun.reshape(-1, 2), axis=1))


def look_target(cameras: Mapping[str, Camera]) -> Array:
    """Point (3,) at which cameras in ``map`` look: where their axes meet, or else a point in front of
    them."""
    point = common_point(cameras.values())
    if point is not None:
        return point
    center = np.mean([camera.center for camera in cameras.values()], axis=0)
    axis = np.mean([camera.R[2] for camera in cameras.values()], axis=0)
    down = -float(axis[2])
    distance = (center[2] - _TARGET_HEIGHT) / down if abs(down) > 1e-6 else np.inf
    if not _NEAREST < distance < _FARTHEST:
        distance = _AHEAD
    return np.asarray(center + distance * axis, dtype=float)


def _standing(up: Array, point: Array, height: float) -> RigPlacement:
    """Placement with the smallest rotation that turns ``up`` (3,) to z. It puts ``point`` (3,) at ``height``
    metres above the floor."""
    direction = up / np.linalg.norm(up)
    axis, cosine = np.cross(direction, _UP), float(direction @ _UP)
    if cosine < -1 + 1e-12:
        rotation = np.diag([1.0, -1.0, -1.0])
    else:
        matrix = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        rotation = np.eye(3) + matrix + matrix @ matrix / (1 + cosine)
    return RigPlacement(rotation, np.array([0, 0, height - rotation[2] @ point]))


def _over_origin(placement: RigPlacement, cameras: Mapping[str, Camera]) -> RigPlacement:
    """The same placement, moved along the floor so that the cameras look at a point above (0, 0)."""
    target = look_target({name: placement.camera(camera) for name, camera in cameras.items()})
    return placement.moved([-target[0], -target[1], 0.0])


def _aligned(
    placement: RigPlacement, floor: Array, on_map: Array
) -> tuple[RigPlacement, float, float | None]:
    """Turn and move a placement along the floor, so that the points ``floor`` (N, 3) come to the places
    ``on_map`` (N, 2). Returns also the root mean square of the distances between points and places, mm, and
    ``scale`` of FoundPlacement."""
    level = placement.points(floor)[:, :2]
    here, there = level - level.mean(0), on_map - on_map.mean(0)
    yaw = float(np.arctan2((here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]).sum(), (here * there).sum()))
    turn = np.asarray(scipy.spatial.transform.Rotation.from_rotvec(yaw * _UP).as_matrix())
    rotated = RigPlacement(turn @ placement.rotation, turn @ placement.position)
    offset = on_map.mean(0) - rotated.points(floor)[:, :2].mean(0)
    moved = rotated.moved([*offset, 0.0])
    errors = np.linalg.norm(moved.points(floor)[:, :2] - on_map, axis=1)
    lengths = float(np.linalg.norm(here)), float(np.linalg.norm(there))
    return moved, 1000 * _rms(errors), lengths[1] / lengths[0] if min(lengths) > 0 else None


def _rolls(placement: RigPlacement, cameras: Mapping[str, Camera]) -> dict[str, float]:
    """Residual ``roll_deg``: root mean square of the angles between the floor and the x axes of images."""
    if not cameras:
        return {}
    right = np.array([placement.camera(camera).R[0] for camera in cameras.values()])
    return {"roll_deg": float(np.degrees(_rms(np.pi / 2 - angle_between(right, _UP))))}


def _distance_to_axis(camera: Camera, point: Array) -> float:
    offset = point - camera.center
    return float(np.linalg.norm(offset - (offset @ camera.R[2]) * camera.R[2]))


def _rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


class _File(Section):
    """Content of a file of floor points."""

    points: tuple[FloorPoint, ...] = Field(min_length=1, max_length=10_000)


def read_floor_points(path: str | os.PathLike[str], in_metres: Array) -> list[FloorPoint]:
    """Read a file of floor points.

    ``in_metres``: matrix (3, 3) from the unit and axes of the calibration file to metres and z up.

    Raises:
        CameraError: The file cannot be read. The error names line and key.
    """
    data, tree = read_yaml(path, CameraError, "floor points")
    if not isinstance(data, dict):
        raise CameraError("floor points are a mapping with the list 'points'", path=path)
    file = validated(_File, data, CameraError, path, tree)
    return [point.converted(in_metres) for point in file.points]


def parse_floor_point(text: str, in_metres: Array) -> FloorPoint:
    """Parse a floor point from a text such as ``left:312,400 right:280.5,410`` or ``0.1,0.2,3 map:0,1``.

    ``in_metres`` is the same as for :func:`read_floor_points`.

    Raises:
        CameraError: The text is not a floor point.
    """
    point: dict[str, Any] = {"pixels": {}}
    for word in text.split():
        name, _, numbers = word.rpartition(":")
        values = point if name in ("", _MAP) else point["pixels"]
        if (name or "xyz") in values:
            raise CameraError(f"{word!r} is repeated", key="--floor-point")
        values[name or "xyz"] = numbers.split(",")
    try:
        return validated(FloorPoint, point, CameraError).converted(in_metres)
    except CameraError as error:
        hint = "use 'left:312,400 right:280.5,410' (pixels) or '0.1,0.2,3' (in the world of the file)"
        raise CameraError(f"{text!r} is no floor point: {error}; {hint}", key="--floor-point") from None
