"""KRTD of Kitware's tools: K (3x3), R (3x3), t (3) and the lens' coefficients, in this order, as text.

The coefficients are OpenCV's, as many as are not zero; a single 0 is no distortion.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFormat,
    CalibrationSource,
    FilePosition,
    RawCamera,
    row,
)
from humansim_ros.errors import CameraError

#: OpenCV has no more, and nobody writes them one a line.
_MAX_COEFFICIENTS, _MAX_LINES = 14, 21


def _is_krtd(source: CalibrationSource) -> bool:
    return len(source.head) == 3 and all(len(line.split()) == 3 for line in source.head)


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    lines = [(line, text.split()) for line, text in islice(source.lines(), _MAX_LINES + 1)]
    if len(lines) < 7 or any(len(words) != 3 for _, words in lines[:7]):
        message = "needs K (3 x 3), R (3 x 3) and t (3), then the distortion coefficients or a 0"
        raise CameraError(message, path=source.path, line=lines[-1][0])
    count = sum(len(words) for _, words in lines) - 21
    if count > _MAX_COEFFICIENTS:
        message = (
            f"more than {_MAX_COEFFICIENTS} distortion coefficients: is there more than one camera in it?"
        )
        raise CameraError(message, path=source.path, line=lines[7][0])
    numbers = np.array([value for line, words in lines for value in source.row(words, line)])
    distortion = numbers[21:]
    places = {
        "K": FilePosition("K", lines[0][0]),
        "R": FilePosition("R", lines[3][0]),
        "t": FilePosition("t", lines[6][0]),
    }
    if len(distortion):
        places["distortion"] = FilePosition("distortion", lines[7][0])
    camera = RawCamera(
        numbers[:9].reshape(3, 3),
        numbers[9:18].reshape(3, 3),
        numbers[18:21],
        distortion=tuple(distortion),
        places=places,
    )
    return {Path(source.path).stem: camera}


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    (camera,) = cameras.values()
    distortion = np.trim_zeros(np.array(camera.distortion), "b")
    blocks = [
        *("\n".join(row(values) for values in matrix) for matrix in (camera.K, camera.R)),
        row(camera.t),
        row(distortion) if len(distortion) else "0",
    ]
    return {"": "\n\n".join(blocks) + "\n"}


KRTD = CalibrationFormat(
    "krtd",
    "KRTD",
    ".krtd",
    "text",
    _is_krtd,
    _read,
    _write,
    several=False,
    holds_size=False,
    lenses={"plumb_bob": 5, "rational_polynomial": 8},
)
