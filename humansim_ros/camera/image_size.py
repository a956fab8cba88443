"""Image sizes: from image files, or guessed from principal points where a calibration has none."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.errors import CameraError
from humansim_ros.io.files import open_file, reading_errors, resolve_inside
from humansim_ros.io.images import MAX_IMAGE_BYTES, declared_size
from humansim_ros.types import Array, ImageSize

#: Common image sizes of cameras and data sets, landscape.
COMMON = (
    *((160, 120), (176, 144), (320, 240), (352, 288), (360, 288), (384, 288), (400, 300), (410, 308)),
    *((480, 270), (512, 424), (512, 512), (640, 360), (640, 480), (640, 512), (656, 492), (704, 576)),
    *((720, 480), (720, 576), (752, 480), (768, 576), (800, 600), (820, 616), (848, 480), (960, 540)),
    *((960, 720), (1000, 1000), (1024, 576), (1024, 768), (1024, 1024), (1032, 776), (1242, 375)),
    *((1280, 720), (1280, 800), (1280, 960), (1280, 1024), (1296, 972), (1440, 1080), (1600, 1200)),
    *((1624, 1224), (1640, 1232), (1920, 1080), (1920, 1200), (1936, 1216), (2028, 1520), (2048, 1088)),
    *((2048, 1536), (2048, 2048), (2448, 2048), (2560, 1440), (2592, 1944), (3280, 2464), (3840, 2160)),
    *((4000, 3000), (4032, 3024), (4056, 3040), (4096, 2160), (4096, 3000), (5472, 3648)),
)
#: Largest distance of the principal point of an image that was not cropped from its centre, as a fraction of
#: the side.
_OFF_CENTER = 0.06
#: Bytes at the start of an image file that contain its size.
_HEADER_BYTES = 1 << 20


def guess_image_size(principal_points: ArrayLike, preferred: Sequence[ImageSize] = ()) -> ImageSize:
    """Guess the image size whose centre is at these principal points (N, 2).

    It is one of ``preferred``, else a common size, if such a size fits within 6 %, else the best fit.
    """
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
    return best if best is not None and difference(best) < _OFF_CENTER else None


def size_of_named_image(folder: Path, name: str) -> ImageSize | None:
    """Size of an image that a file in ``folder`` names; None if the image is missing."""
    path = resolve_inside(folder, name)
    return _declared_size(path) if path is not None and path.is_file() else None


def image_size(path: str | os.PathLike[str]) -> ImageSize:
    """Read the width and height of a PNG or JPEG file. Raises CameraError."""
    size = _declared_size(path)
    if size is None:
        raise CameraError("this is not a PNG or JPEG image", path=path)
    return size


def _declared_size(path: str | os.PathLike[str]) -> ImageSize | None:
    """Size in the header of an image file; None for other files. Raises CameraError."""
    file = open_file(path, CameraError, "image", MAX_IMAGE_BYTES)
    with file, reading_errors(path, CameraError, "image"):
        return declared_size(file.read(_HEADER_BYTES))
