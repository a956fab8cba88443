"""How large images are whose size a calibration does not say, or says wrong."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.errors import CameraError
from humansim_ros.io.files import reading_errors, resolve_inside
from humansim_ros.io.images import declared_size
from humansim_ros.types import ImageSize

#: What cameras and data sets commonly have, landscape.
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
#: How far principal points are from the middle, as a fraction of the side, in images that were not cropped.
_OFF_CENTRE = 0.06
#: Bytes of an image file in which its size is said.
_HEAD = 1 << 20


def likely_size(principal_points: ArrayLike, likelier: Sequence[ImageSize] = ()) -> ImageSize:
    """The image size that has these principal points (N, 2) in its middle: one of ``likelier``, else a common
    one, where that fits within 6 %, else the one that fits best.
    """
    middle = np.median(np.atleast_2d(np.asarray(principal_points, dtype=float)), axis=0)
    wanted = 2 * middle + 1
    return (
        _nearest(wanted, likelier)
        or _nearest(wanted, (*COMMON, *((h, w) for w, h in COMMON)))
        or (max(1, round(float(wanted[0]))), max(1, round(float(wanted[1]))))
    )


def _nearest(
    wanted: np.ndarray[tuple[int, ...], np.dtype[np.float64]], sizes: Iterable[ImageSize]
) -> ImageSize | None:
    def off(size: ImageSize) -> float:
        return float(np.abs(wanted / size - 1).max())

    best = min(sizes, key=off, default=None)
    return best if best is not None and off(best) < _OFF_CENTRE else None


def size_of_image(folder: Path, name: str) -> ImageSize | None:
    """Size of an image that a file in ``folder`` names, if it is there."""
    path = resolve_inside(folder, name)
    return _stated(path) if path is not None and path.is_file() else None


def image_size(path: str | os.PathLike[str]) -> ImageSize:
    """Width and height of a PNG or JPEG file. Raises CameraError."""
    with reading_errors(path, CameraError, "image"):
        size = _stated(Path(path))
    if size is None:
        raise CameraError("this is no PNG or JPEG image", path=path)
    return size


def _stated(path: Path) -> ImageSize | None:
    with path.open("rb") as file:
        return declared_size(file.read(_HEAD))
