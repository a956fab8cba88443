"""What there is to know of a camera beyond its numbers: how wide it sees, and what looks wrong with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.image_size import likely_size
from humansim_ros.rotations import angle_between
from humansim_ros.types import Array

#: How far a principal point is from the middle in sound calibrations, as a fraction of the image's side.
_OFF_MIDDLE = 0.075
#: By how much the two sides' fractions may differ where an image was scaled, not cropped.
_SAME_SCALE = 0.1
#: Focal length of the rectified image, as a multiple of the real one's.
_ZOOM = (0.4, 2.5)
_NOT_SQUARE, _SKEWED = 0.1, 0.02
#: Distances in metres that no rig has.
_FAR, _NEAR, _LONG_BASELINE = 300.0, 0.05, 5.0
_BELOW = -0.05
_STEEP = np.cos(np.radians(20))


@dataclass(frozen=True)
class FieldOfView:
    """Angles between the outermost rays through the lens, radians, to the pixels' outer edges.

    NaN where a lens model does not reach the image's edge.
    """

    horizontal: float
    vertical: float
    diagonal: float


def rays(camera: Camera, pixels: ArrayLike) -> Array:
    """Unit vectors (N, 3) in the optical frame that pixels (N, 2) look along; NaN where none falls."""
    uv = np.asarray(pixels, dtype=float)
    ideal = np.linalg.solve(camera.K, np.column_stack([uv, np.ones(len(uv))]).T).T[:, :2]
    n = np.column_stack([camera.lens.undistort(ideal), np.ones(len(uv))])
    return np.asarray(n / np.linalg.norm(n, axis=1)[:, None], dtype=float)


def field_of_view(camera: Camera) -> FieldOfView:
    """How wide a camera sees: across its principal point, and from corner to corner."""
    width, height = camera.size
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    cx, cy = camera.K[:2, 2]
    starts = [(left, cy), (cx, top), (left, top), (left, bottom)]
    ends = [(right, cy), (cx, bottom), (right, bottom), (right, top)]
    angles = angle_between(rays(camera, starts), rays(camera, ends))
    return FieldOfView(float(angles[0]), float(angles[1]), float(np.max(angles[2:])))


def has_pose(camera: Camera) -> bool:
    """Whether it is told where the camera stands."""
    return bool(camera.t.any() or not np.array_equal(camera.R, np.eye(3)))


def baseline(camera: Camera) -> float:
    """Metres that a stereo camera stands to the right of the first one, by the P of its rectified image."""
    return float(-camera.rectified_projection[0, 3] / camera.rectified_projection[0, 0])


def check_camera(camera: Camera) -> list[str]:
    """What looks wrong with a camera, for people."""
    return [*_of_matrix(camera), *_of_lens(camera), *_of_rectified(camera), *_of_pose(camera)]


def check_rig(cameras: Mapping[str, Camera]) -> list[str]:
    """What looks wrong with cameras that belong together."""
    standing = [camera for camera in cameras.values() if has_pose(camera)]
    if len(standing) < 2:
        return []
    found = []
    centers = np.array([camera.center for camera in standing])
    across = float(np.linalg.norm(np.ptp(centers, axis=0)))
    if across > _FAR or 0 < across < _NEAR:
        found.append(f"the cameras stand {across:.3g} m apart: is this the file's unit? say it (unit)")
    up = -np.mean([camera.R[1] for camera in standing], axis=0)
    length = float(np.linalg.norm(up))
    if length > 0.5 and up[2] < 0.5 * length:
        axis = int(np.argmax(np.abs(up)))
        name = ("-" if up[axis] < 0 else "") + "xyz"[axis]
        found.append(f"to most of the cameras {name} is up, not z: if it is so in the file, say it (up)")
    return found


def check_image_size(camera: Camera) -> list[str]:
    """Whether K seems to be of an image of another size."""
    (width, height), (cx, cy) = camera.size, camera.K[:2, 2]
    share = (camera.K[:2, 2] + 0.5) / camera.size
    low, high = sorted(share)
    if np.abs(share - 0.5).max() <= _OFF_MIDDLE or low <= 0 or high / low >= 1 + _SAME_SCALE:
        return []
    fitting = "{}x{}".format(*likely_size((cx, cy)))
    where = f"the principal point ({cx:.1f}, {cy:.1f}) is at {share[0]:.0%} and {share[1]:.0%}"
    what = f"this K is of an image of about {fitting}; is the size wrong, or was the image scaled?"
    return [f"{where} of a {width}x{height} image: {what}"]


def _of_matrix(camera: Camera) -> Iterator[str]:
    width = camera.size[0]
    (fx, skew, cx), (_, fy, cy) = camera.K[:2]
    share = (camera.K[:2, 2] + 0.5) / camera.size
    of_size = check_image_size(camera)
    yield from of_size
    if not of_size and np.abs(share - 0.5).max() > _OFF_MIDDLE:
        where = f"({cx:.1f}, {cy:.1f}) is at {share[0]:.0%} and {share[1]:.0%} of the image's sides"
        yield f"the principal point {where}: was the image cropped?"
    if abs(fx / fy - 1) > _NOT_SQUARE:
        yield f"the pixels are not square: fx / fy is {fx / fy:.3f}"
    if abs(skew) > _SKEWED * fx:
        yield f"there is a skew of {skew:.3g}, {abs(skew) / fx:.1%} of the focal length"
    if not camera.distorted and not 0.1 < fx / width < 60:
        yield f"the focal length is {fx:.3g} pixels for {width} of width: is K in pixels?"


def _of_lens(camera: Camera) -> Iterator[str]:
    if not camera.distorted:
        return
    width, height = camera.size
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 49), np.linspace(0, height - 1, 37))
    seen = np.isfinite(rays(camera, np.column_stack([columns.ravel(), rows.ravel()]))).all(axis=1)
    if not seen.all():
        limit = np.degrees(np.arctan(camera.lens.valid_radius))
        why = "this lens model folds" if limit < 89 else "cameras here see no farther"
        yield f"{1 - seen.mean():.0%} of the image sees nothing: {why} at {limit:.1f} degrees off the axis"


def _of_rectified(camera: Camera) -> Iterator[str]:
    if camera.rectified is None:
        return
    zoom = camera.rectified[[0, 1], [0, 1]] / camera.K[[0, 1], [0, 1]]
    if zoom.min() < _ZOOM[0] or zoom.max() > _ZOOM[1]:
        yield f"P and K disagree: focal lengths of P are {zoom[0]:.2g} and {zoom[1]:.2g} times those of K"
    middle = camera.rectified[:2, 2] / camera.rectified[2, 2]
    if (middle < 0).any() or (middle > camera.size).any():
        yield f"the principal point of P, ({middle[0]:.1f}, {middle[1]:.1f}), is outside the image"
    if abs(baseline(camera)) > _LONG_BASELINE:
        yield f"P has a baseline of {baseline(camera):.3g} m: is its unit metres?"


def _of_pose(camera: Camera) -> Iterator[str]:
    if not has_pose(camera):
        return
    forward, down, center = camera.R[2], camera.R[1], camera.center
    if forward[2] > _STEEP:
        yield "the camera looks straight up: is z up in the file?"
    elif down[2] > 0.5:
        yield "the camera is upside down: is z up in the file?"
    if center[2] < _BELOW:
        yield f"the camera is below the floor, at z = {center[2]:.2f} m"
    if np.linalg.norm(center) > _FAR:
        yield f"the camera is {np.linalg.norm(center):.3g} m from the origin: is this the file's unit?"
