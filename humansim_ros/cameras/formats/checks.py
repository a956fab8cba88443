"""Plausibility checks of cameras and rigs: field of view, principal point, image size. Checks return
messages.

Image sizes come from image files. Where a calibration has no size, it is guessed from principal points.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import (
    MAX_IMAGE_BYTES,
    declared_size,
    open_file,
    read_table,
    reading_errors,
    resolve_inside,
)
from humansim_ros.geometry import angle_between
from humansim_ros.types import Array, ImageSize

#: Largest plausible ratio of image width to focal length. A fisheye of 220 degrees has four.
_MOST_IN_WIDTH = 20
#: Largest plausible distance of a principal point from the image centre, as a fraction of the image side.
_OFF_CENTER = 0.075
#: Another image size fits better if its centre is nearer to the principal point by this factor. The ratios of
#: width to height may differ by the second number.
_BETTER, _SAME_SHAPE = 6.0, 0.02
#: No lens has a principal point this far from the centre, as a fraction of the image side. The image was
#: scaled, not cropped, if x / width and y / height of the point differ by less than the second number.
_FAR_OFF, _SAME_SCALE = 0.2, 0.1
#: Smallest and largest plausible focal length of the rectified image, as multiples of that of the real image.
_ZOOM = (0.4, 2.5)
#: Largest plausible difference between the focal lengths, and largest plausible skew, as fractions of a focal
#: length.
_NOT_SQUARE, _SKEWED = 0.1, 0.02
#: Smallest and largest plausible focal length, as fractions of the image width.
_FOCAL_LENGTHS = (0.1, 60)
#: Largest and smallest plausible extent of a rig, and longest baseline, metres.
_FAR, _NEAR, _LONG_BASELINE = 300.0, 0.05, 5.0
#: Lowest plausible height of a camera, metres.
_LOWEST = -0.05
#: A camera looks straight up if the cosine of its angle to the vertical is above this.
_STRAIGHT_UP = np.cos(np.radians(20))


@dataclass(frozen=True)
class FieldOfView:
    """Angles in radians between the rays of opposite edges and corners of the image, through the lens. An
    angle is NaN where the lens model is not valid at the edge."""

    horizontal: float
    vertical: float
    diagonal: float


def field_of_view(camera: Camera) -> FieldOfView:
    """Field of view of a camera, along both axes through its principal point and between opposite corners."""
    width, height = camera.size
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    cx, cy = camera.K[:2, 2]
    starts = [(left, cy), (cx, top), (left, top), (left, bottom)]
    ends = [(right, cy), (cx, bottom), (right, bottom), (right, top)]
    angles = angle_between(camera.rays(starts), camera.rays(ends))
    return FieldOfView(float(angles[0]), float(angles[1]), float(np.max(angles[2:])))


def has_pose(camera: Camera) -> bool:
    """Whether a camera has extrinsics other than the identity."""
    return bool(camera.t.any() or not np.array_equal(camera.R, np.eye(3)))


def baseline(camera: Camera) -> float:
    """Baseline of a stereo camera, from its rectified P: by how many metres it is to the right of the first
    camera of the pair. 0 for the first camera."""
    return float(-camera.rectified_projection[0, 3] / camera.rectified_projection[0, 0])


def check_camera(camera: Camera) -> list[str]:
    """Check the plausibility of a camera. Returns messages, empty for a plausible camera."""
    checks = (_check_intrinsics, _check_lens, _check_rectified, _check_pose)
    return [message for check in checks for message in check(camera)]


def check_rig(cameras: Mapping[str, Camera]) -> list[str]:
    """Check the plausibility of the poses of cameras of one rig. Returns messages."""
    posed = [camera for camera in cameras.values() if has_pose(camera)]
    if len(posed) < 2:
        return []
    messages = []
    centers = np.array([camera.center for camera in posed])
    across = float(np.linalg.norm(np.ptp(centers, axis=0)))
    if across > _FAR or 0 < across < _NEAR:
        messages.append(
            f"the cameras are {across:.3g} m apart: is the unit of the file correct? set it (unit)"
        )
    up = -np.mean([camera.R[1] for camera in posed], axis=0)
    length = float(np.linalg.norm(up))
    if length > 0.5 and up[2] < 0.5 * length:
        axis = int(np.argmax(np.abs(up)))
        name = ("-" if up[axis] < 0 else "") + "xyz"[axis]
        messages.append(f"for most of the cameras {name} is up, not z: if it is so in the file, set it (up)")
    return messages


def check_focal_length(camera: Camera) -> list[str]:
    """Check whether K is in pixels. Returns a message if it seems to be in millimetres or fractions of the
    image."""
    is_long = camera.K[0, 0] * _MOST_IN_WIDTH >= camera.size[0]
    return [] if is_long else [_not_in_pixels(camera)]


def check_image_size(camera: Camera) -> list[str]:
    """Check whether K belongs to an image of this size. Returns messages. Principal points of real cameras
    may be far from the centre. The evidence is strong only if the centre of another image size fits much
    better, and both images have the same shape."""
    (width, height), (cx, cy) = camera.size, camera.K[:2, 2]
    share = _principal_share(camera)
    distance = float(np.abs(share - 0.5).max())
    low, high = sorted(share)
    if distance <= _OFF_CENTER or low <= 0:
        return []
    fitting = guess_image_size((cx, cy))
    rest = float(np.abs((camera.K[:2, 2] + 0.5) / fitting - 0.5).max())
    same_shape = abs(fitting[0] * height / (fitting[1] * width) - 1) < _SAME_SHAPE
    common = fitting in COMMON or fitting[::-1] in COMMON
    far = distance > _FAR_OFF and high / low < 1 + _SAME_SCALE
    if not far and not (common and same_shape and rest < distance / _BETTER):
        return []
    where = f"the principal point ({cx:.1f}, {cy:.1f}) is at {share[0]:.0%} and {share[1]:.0%}"
    size = "{}x{}".format(*fitting)
    what = f"this K belongs to an image of about {size}; is the size wrong, or was the image scaled?"
    return [f"{where} of a {width}x{height} image: {what}"]


def note_principal_points(cameras: Mapping[str, Camera]) -> list[str]:
    """Look for principal points far from the image centre. Returns at most one message, about all cameras."""
    distances = {
        name: float(np.abs(_principal_share(camera) - 0.5).max())
        for name, camera in cameras.items()
        if not check_focal_length(camera) and not check_image_size(camera)
    }
    far = {name: distance for name, distance in distances.items() if distance > _OFF_CENTER}
    if not far:
        return []
    name = max(far, key=far.__getitem__)
    (cx, cy), (width, height) = cameras[name].K[:2, 2], cameras[name].size
    what = (
        f"the principal point of {name}, ({cx:.1f}, {cy:.1f}), is {far[name]:.0%} of a side from the centre"
    )
    others = f", and {len(far) - 1} more are above {_OFF_CENTER:.1%}" if len(far) > 1 else ""
    return [f"note: {what} of its {width}x{height} image{others}: a real lens, or a cropped image"]


def _principal_share(camera: Camera) -> Array:
    """Principal point (2,) as fractions of image width and height."""
    return np.asarray((camera.K[:2, 2] + 0.5) / camera.size)


def _check_intrinsics(camera: Camera) -> Iterator[str]:
    width = camera.size[0]
    (fx, skew, _), (_, fy, _) = camera.K[:2]
    yield from (short := check_focal_length(camera)) or check_image_size(camera)
    if abs(fx / fy - 1) > _NOT_SQUARE:
        yield f"the pixels are not square: fx / fy is {fx / fy:.3f}"
    if abs(skew) > _SKEWED * fx:
        yield f"there is a skew of {skew:.3g}, {abs(skew) / fx:.1%} of the focal length"
    plausible = _FOCAL_LENGTHS[0] < fx / width < _FOCAL_LENGTHS[1]
    if not camera.distorted and not plausible and not short:
        yield _not_in_pixels(camera)


def _not_in_pixels(camera: Camera) -> str:
    return f"the focal length is {camera.K[0, 0]:.3g} pixels for {camera.size[0]} of width: is K in pixels?"


def _check_lens(camera: Camera) -> Iterator[str]:
    if not camera.distorted:
        return
    width, height = camera.size
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 49), np.linspace(0, height - 1, 37))
    valid = np.isfinite(camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))).all(axis=1)
    if not valid.all():
        limit = np.degrees(np.arctan(camera.lens.valid_radius))
        why = "this lens model folds" if limit < 89 else "cameras are limited"
        lost = 1 - valid.mean()
        share = f"{lost:.0%}" if lost >= 0.01 else "less than 1%"
        yield f"{share} of the image sees nothing: {why} at {limit:.1f} degrees off the axis"


def _check_rectified(camera: Camera) -> Iterator[str]:
    if camera.rectified is None:
        return
    zoom = camera.rectified[[0, 1], [0, 1]] / camera.K[[0, 1], [0, 1]]
    if zoom.min() < _ZOOM[0] or zoom.max() > _ZOOM[1]:
        yield f"P and K disagree: focal lengths of P are {zoom[0]:.2g} and {zoom[1]:.2g} times K"
    middle = camera.rectified[:2, 2] / camera.rectified[2, 2]
    if (middle < 0).any() or (middle > camera.size).any():
        yield f"the principal point of P, ({middle[0]:.1f}, {middle[1]:.1f}), is outside the image"
    if abs(baseline(camera)) > _LONG_BASELINE:
        yield f"P has a baseline of {baseline(camera):.3g} m: is its unit metres?"


def _check_pose(camera: Camera) -> Iterator[str]:
    if not has_pose(camera):
        return
    forward, down, center = camera.R[2], camera.R[1], camera.center
    if forward[2] > _STRAIGHT_UP:
        yield "the camera looks straight up: is z up in the file?"
    elif down[2] > 0.5:
        yield "the camera is upside down: is z up in the file?"
    if center[2] < _LOWEST:
        yield f"the camera is below the floor, at z = {center[2]:.2f} m"
    if np.linalg.norm(center) > _FAR:
        distance = f"{np.linalg.norm(center):.3g} m"
        yield f"the camera is {distance} from the origin: is the unit of the file correct?"


#: Common image sizes (landscape), and the sizes of cameras of some formats.
IMAGE_SIZES = read_table("image_sizes")
COMMON: tuple[ImageSize, ...] = tuple((width, height) for width, height in IMAGE_SIZES["common"])
#: In an image that was not cropped, the principal point is at most this fraction of the side from the centre.
_FAR_FROM_MIDDLE = 0.06
#: The size of an image is in its header, within this number of bytes.
_HEADER_BYTES = 1 << 20


def guess_image_size(principal_points: ArrayLike, preferred: Sequence[ImageSize] = ()) -> ImageSize:
    """Guess the image size from principal points (N, 2), which are near the image centre. The first of these
    is taken: a size of ``preferred`` that fits within 6 %, a common size that fits within 6 %, the size that
    fits best."""
    center = np.median(np.atleast_2d(np.asarray(principal_points, dtype=float)), axis=0)
    fitted = 2 * center + 1
    return (
        _nearest(fitted, preferred)
        or _nearest(fitted, (*COMMON, *((h, w) for w, h in COMMON)))
        or (max(1, round(float(fitted[0]))), max(1, round(float(fitted[1]))))
    )


def _nearest(fitted: Array, sizes: Iterable[ImageSize]) -> ImageSize | None:
    def difference(size: ImageSize) -> float:
        return float(np.abs(fitted / size - 1).max())

    best = min(sizes, key=difference, default=None)
    return best if best is not None and difference(best) < _FAR_FROM_MIDDLE else None


def size_of_named_image(folder: Path, name: str) -> ImageSize | None:
    """Read the size of an image that a file in ``folder`` refers to by ``name``. Returns None if the image is
    missing."""
    path = resolve_inside(folder, name)
    return _declared_size(path) if path is not None and path.is_file() else None


def image_size(path: str | os.PathLike[str]) -> ImageSize:
    """Read the width and height of a PNG or JPEG file. Raises CameraError."""
    size = _declared_size(path)
    if size is None:
        raise CameraError("this is not a PNG or JPEG image", path=path)
    return size


def _declared_size(path: str | os.PathLike[str]) -> ImageSize | None:
    """Read the size in the header of an image file. Returns None for other files. Raises CameraError."""
    file = open_file(path, CameraError, "image", MAX_IMAGE_BYTES)
    with file, reading_errors(path, CameraError, "image"):
        return declared_size(file.read(_HEADER_BYTES))
