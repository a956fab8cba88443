"""par.txt of the Middlebury multi-view data: a count, then lines of an image name, K (9), R (9) and t (3).

P = K [R | t]. https://vision.middlebury.edu/mview/data/
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFile,
    CalibrationFormat,
    RawCamera,
    SourceLocation,
    image_names,
    row,
    without_suffix,
)
from humansim_ros.camera.image_size import size_of_named_image
from humansim_ros.errors import CameraError


def _is_par(file: CalibrationFile) -> bool:
    count, *images = file.head or [""]
    return count.isdecimal() and bool(images) and len(images[0].split()) > 12


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = file.lines()
    first, count = next(lines)
    cameras: dict[str, RawCamera] = {}
    folder = Path(file.path).parent
    for line, text in lines:
        image, *words = text.split()
        if len(words) != 21:
            message = f"needs an image name, K (9), R (9) and t (3): 21 numbers, not {len(words)}"
            raise CameraError(message, path=file.path, line=line)
        values = np.array(file.row(words, line))
        camera = RawCamera(
            values[:9].reshape(3, 3),
            values[9:18].reshape(3, 3),
            values[18:],
            size=size_of_named_image(folder, image),
            locations={"": SourceLocation(None, line)},
        )
        file.add(cameras, without_suffix(image), camera, line=line)
    if not 0 < len(cameras) == int(count[:9]):
        message = f"declares {count[:9]} cameras, but has {len(cameras)}: is the file complete?"
        raise CameraError(message, path=file.path, line=first)
    return cameras


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    images = image_names(cameras)
    lines = [str(len(cameras))]
    for name, camera in cameras.items():
        numbers = (*camera.K.ravel(), *camera.R.ravel(), *camera.t)
        lines.append(f"{images[name]} {row(numbers)}")
    return {"": "\n".join(lines) + "\n"}


MIDDLEBURY = CalibrationFormat(
    "middlebury", "Middlebury par.txt", "_par.txt", "text", _is_par, _read, _write, holds_size=False
)
